"""Pictures of depth, classes and normals beside the photographs that they are of: `0001_depth.png`, `depth_0001.png`;
and folders of such, and pictures that programs write of a whole set.

A picture is one only where its name says so, a photograph of the same name but for that word lies in its folder, its
pixels are those of such a picture and no camera is named in its tags: photographs of a depth gauge stay.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from vdgs.captures.image_files import has_camera, mode_of, open_image
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES
from vdgs.captures.strays import is_layer_folder

#: Words of names, in small letters, and what the picture shows.
_LAYER = re.compile(
    r"(?<![a-z])(?:(?P<depth>depths?([ _-]?map)?|disparity|disp|distance[ _-]to[ _-](?:camera|image[ _-]plane))"
    r"|(?P<normals>(?:surface[ _-]?)?normals?([ _-]?map)?)"
    r"|(?P<classes>(?:(?:semantic|instance|panoptic)s?(?:[ _-]?id)?[ _-]?)?(?:segmentation|seg)"
    r"|(?:semantic|instance|panoptic)s?(?:[ _-]?(?:ids?|labels?|map))?|label[ _-]?ids?|instance[ _-]?ids))(?![a-z])"
)
#: Words of the names of photographs, as opposed to those.
_PHOTOGRAPH = re.compile(r"(?<![a-z])(rgba?|colou?r|image|img|frame|photo|view)(?![a-z])")
#: What programs call pictures of a set, in small letters (MonST3R's masks of what moves, by number; a phone's preview).
_OF_SETS = re.compile(r"(?:enlarged_)?dynamic_mask_(?P<of>\w+)|thumb(?:nail)?|preview")
_ONE_CHANNEL = {"L", "P", "1", "I", "F", "I;16", "I;16B", "I;16L"}
#: Pictures looked at of each kind in a folder; colors of classes, and of a palette of depth, at most; of pixels that
#: are no background the share that are unit vectors, and how far from 1 their length may be (choices).
_LOOKED_AT, _MAX_COLORS, _MIN_UNIT, _TOLERANCE = 3, 256, 0.9, 0.1


def picture_layers(named: Mapping[str, Path]) -> dict[str, str]:
    """Of pictures by their names those that are none of photographs, with the reason."""
    photographs, groups = dict[tuple[Path, str], Path](), dict[tuple[Path, str], list[tuple[str, str]]]()
    for name, path in named.items():
        layer = _LAYER.search(path.stem.lower())
        if layer is None:
            photographs[path.parent, _key(path.stem.lower())] = path
        elif path.suffix.lower() in IMAGE_SUFFIXES:
            rest = path.stem.lower()[: layer.start()] + path.stem.lower()[layer.end() :]
            groups.setdefault((path.parent, layer.lastgroup or ""), []).append((name, _key(rest)))
    found = dict[str, str]()
    for (folder, kind), members in groups.items():
        beside = [(name, photographs[folder, key]) for name, key in members if (folder, key) in photographs]
        looked_at = beside[:: max(1, len(beside) // _LOOKED_AT)][:_LOOKED_AT]
        if looked_at and all(_shows(kind, named[name], photograph) for name, photograph in looked_at):
            reason = f"is a picture of {kind}, by its name and pixels, of"
            found |= {name: f"{reason} {photograph.name} beside it" for name, photograph in beside}
    return found


def layer_folders(named: Mapping[str, Path]) -> set[str]:
    """Folders of pictures by their names that are called as those of depth, classes and the like, where photographs of
    most of the names in them lie outside of such folders and no camera took what is in them."""
    inside, outside = dict[str, dict[str, Path]](), set[str]()
    for name, file in named.items():
        path = PurePosixPath(name)
        depth = next((k for k, part in enumerate(path.parts[:-1], 1) if is_layer_folder(part)), None)
        if depth is None:
            outside.add(path.stem.lower())
        else:
            inside.setdefault(str(PurePosixPath(*path.parts[:depth])), {})[path.stem.lower()] = file
    return {
        folder
        for folder, files in inside.items()
        if 2 * len(files.keys() & outside) > len(files) and not any(map(has_camera, list(files.values())[:_LOOKED_AT]))
    }


def unnamed_pictures(named: Mapping[str, Path]) -> dict[str, str]:
    """Of pictures by their names those that are called as masks or previews that programs write of a whole set
    (`dynamic_mask_7.png`, `thumbnail.jpg`), of no photograph beside them, with the reason; none where there is nothing
    else, and where a camera took one."""
    reasons = dict[str, str]()
    stems = {(path.parent, path.stem.lower()) for path in named.values()}
    for name, path in named.items():
        match = _OF_SETS.fullmatch(path.stem.lower())
        if match and not (match["of"] and (path.parent, match["of"]) in stems):
            kind = "a mask" if match["of"] else "a preview"
            reasons[name] = f"is {kind} by its name, and of no photograph beside it"
    return reasons if len(reasons) < len(named) and not any(has_camera(named[name]) for name in reasons) else {}


def _key(stem: str) -> str:
    """What a picture and the photograph that it is of share of their names."""
    return re.sub(r"[^0-9a-z]", "", _PHOTOGRAPH.sub("", stem))


def _shows(kind: str, picture: Path, photograph: Path) -> bool:
    """Whether pixels are those of such a picture. Cameras' tags, and pictures that cannot be opened, say no."""
    try:
        if has_camera(picture):
            return False
        with open_image(photograph) as shown, open_image(picture) as image:
            if mode_of(image) in _ONE_CHANNEL and mode_of(image) != mode_of(shown):
                return kind != "normals"
            if kind == "classes":
                return image.mode in ("RGB", "RGBA", "P") and image.getcolors(_MAX_COLORS) is not None
            if image.mode not in ("RGB", "RGBA"):
                return False
            if kind == "depth":
                return _is_one_value(image) and not _is_one_value(shown)
            return _are_unit_vectors(np.asarray(image.convert("RGB"))[::4, ::4])
    except Exception:  # of decoders: whether it is damaged is found when it is read as a photograph
        return False


def _is_one_value(image: Image.Image) -> bool:
    """Whether three channels show one value a pixel, as programs that estimate depth write it: gray, or the colors of a
    palette."""
    if image.getcolors(_MAX_COLORS) is not None:
        return True
    pixels = np.asarray(image.convert("RGB"))[::4, ::4]
    return bool((pixels == pixels[..., :1]).all())


def _are_unit_vectors(pixels: np.ndarray) -> bool:
    """Whether colors [h, w, 3] uint8 are directions, -1 to 1 as 0 to 255, but for a background of one color."""
    colors, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    lengths = np.linalg.norm(colors / 127.5 - 1, axis=1)
    background = np.arange(len(counts)) == counts.argmax()
    is_unit, counted = np.abs(lengths - 1) <= _TOLERANCE, counts * ~(background & (np.abs(lengths - 1) > _TOLERANCE))
    return bool(counted.sum() and (is_unit * counted).sum() >= _MIN_UNIT * counted.sum())
