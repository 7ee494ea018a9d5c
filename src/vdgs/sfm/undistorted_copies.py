"""Photographs that another folder has too, undistorted, cut to the edge or merely saved again.

Such copies rarely have tags, and their size differs a little from that of the originals. Where they were used beside
these, every test photograph would have its double in training, and metrics would measure nothing.

A copy is told by its folder's name (`undistorted_images`), where a photograph of its name lies beside that folder; else
by what a few photographs of two folders with the same names show: a lens moves what it shows towards the middle or
away from it, and a camera that moved or turned moves it in any other way.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageOps

from vdgs.captures.image_files import open_image
from vdgs.captures.strays import is_undistorted_folder
from vdgs.sfm.brackets import SAME_STOPS
from vdgs.sfm.edited_names import say_copy
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.photograph_versions import taken_apart
from vdgs.sfm.rig_folders import may_be_sensor

#: Each side of a copy is as long as that of its photograph to this factor (choice).
_SIZES = 0.7
#: So many names are common to two folders of copies, and so large a share of the smaller one's; so many are looked at.
_MIN_COMMON, _MIN_SHARE, _LOOKED_AT = 3, 0.5, 3
#: Longer side of the picture that is looked at, features in it, and how much nearer the best match is than the next.
_LOOKED_AT_PX, _FEATURES, _RATIO = 480, 600, 0.75
#: Matches that tell, and the share of them that a lens explains to within so many pixels (choices).
_MIN_MATCHES, _MIN_EXPLAINED, _TOLERANCE_PX = 25, 0.7, 1.5
#: How far the middle moves, as a share of the longer side, and by which factor it grows (choices; a camera that moved
#: by a fiftieth of the picture moves all of it by that).
_MAX_SHIFT, _MAX_GROWTH = 0.01, 0.25
#: Folders that differ by these words alone are of the two cameras of a stereo rig.
_SIDES = re.compile(r"left|right|\d+", re.IGNORECASE)

Folder = Mapping[str, ImageMetadata]


@dataclass(frozen=True, eq=False)
class _Features:
    """What is found in a picture: places from its middle in shares of its longer side, and descriptors."""

    places: Float[np.ndarray, "n 2"]
    descriptors: Float[np.ndarray, "n 128"] | None


def undistorted_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs whose original is among the others in another folder, with the reason."""
    found = _by_folder_name(photographs)
    return found | _by_what_they_show([photo for photo in photographs if photo.name not in found])


def _by_folder_name(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Those in a folder that is called undistorted, where a photograph of their name lies beside it."""
    originals: dict[tuple[str, str], list[ImageMetadata]] = {}
    inside = list[tuple[ImageMetadata, PurePosixPath]]()
    for photo in photographs:
        path = PurePosixPath(photo.name)
        apart = next((k for k, part in enumerate(path.parts[:-1]) if is_undistorted_folder(part)), None)
        if apart is not None:
            inside.append((photo, PurePosixPath(*path.parts[:apart])))
            continue
        for parent in path.parents:
            originals.setdefault((str(parent), _stem(photo)), []).append(photo)
    found = dict[str, str]()
    for photo, parent in inside:
        beside = originals.get((str(parent), _stem(photo)), ())
        original = next((one for one in beside if not taken_apart(photo, one)), None)
        if original is not None:
            found[photo.name] = f"is an undistorted copy of {original.name}, by its folder"
    return found


def _by_what_they_show(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    folders: dict[str, dict[str, ImageMetadata]] = {}
    for photo in photographs:
        folders.setdefault(str(PurePosixPath(photo.name).parent), {})[_stem(photo)] = photo

    def order(folder: str) -> tuple[bool, bool, float, int, int, str]:
        path, members = PurePosixPath(folder), folders[folder]
        bare = sum(photo.is_bare for photo in members.values()) / len(members)
        is_copy = any(map(is_undistorted_folder, path.parts)) or say_copy(path / "photograph")
        return path.name.lower() != "input", is_copy, bare, -len(members), len(folder), folder

    found, kept = dict[str, str](), list[str]()
    features = lru_cache(maxsize=64)(_features)
    for folder in sorted(folders, key=order):
        for other in kept:
            pairs = _pairs(folders[other], folders[folder], found)
            if _may_be_copies(other, folder, pairs, folders[folder]) and _all_by_a_lens(pairs, features):
                why = "by its name and what it shows"
                found |= {
                    photo.name: f"is a copy of {one.name}, undistorted or saved again, {why}" for one, photo in pairs
                }
        kept.append(folder)
    return found


def _stem(photo: ImageMetadata) -> str:
    return PurePosixPath(photo.name).stem.lower()


def _pairs(one: Folder, other: Folder, found: Mapping[str, str]) -> list[tuple[ImageMetadata, ImageMetadata]]:
    """The photographs of the same names that may be of the same moment and camera."""
    names = sorted(one.keys() & other.keys())
    return [(one[n], other[n]) for n in names if other[n].name not in found and _may_be_one(one[n], other[n])]


def _may_be_one(one: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether tags and sizes allow that one of two photographs was made of the other."""
    if taken_apart(one, other) or one.band != other.band or one.thermal != other.thermal or one.is_panorama:
        return False
    if not (one.is_bare or other.is_bare) and one.camera != other.camera:
        return False
    stops, others = one.exposure_stops, other.exposure_stops
    if stops is not None and others is not None and abs(stops - others) >= SAME_STOPS:
        return False
    factors = [a / b for a, b in zip(one.size, other.size, strict=True)]
    return all(_SIZES <= factor <= 1 / _SIZES for factor in factors)


def _may_be_copies(one: str, other: str, pairs: Sequence[tuple[ImageMetadata, ImageMetadata]], smaller: Folder) -> bool:
    """Whether two folders share so many photographs, and are not called as those of the cameras of a rig."""
    if len(pairs) < max(_MIN_COMMON, _MIN_SHARE * len(smaller)):
        return False
    if may_be_sensor(one) and may_be_sensor(other):
        return False
    return _SIDES.sub("", one) != _SIDES.sub("", other)


def _all_by_a_lens(pairs: Sequence[tuple[ImageMetadata, ImageMetadata]], features: Callable[[Path], _Features]) -> bool:
    """Whether a lens alone may be between the two of each pair, by a few of them."""
    chosen = [pairs[k] for k in sorted({len(pairs) * part // _LOOKED_AT for part in range(_LOOKED_AT)})]
    return all(_by_a_lens(features(one.path), features(other.path)) for one, other in chosen)


def _features(path: Path) -> _Features:
    """The features of a picture; none of one that Pillow does not read."""
    try:
        with open_image(path) as image:
            image.draft("L", (2 * _LOOKED_AT_PX, 2 * _LOOKED_AT_PX))
            small = ImageOps.exif_transpose(image).convert("L")
            small.thumbnail((_LOOKED_AT_PX, _LOOKED_AT_PX), Image.Resampling.BOX)
            gray = np.asarray(small)
    except (OSError, SyntaxError, ValueError):
        return _Features(np.zeros((0, 2)), None)
    points, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(gray, None)
    places = np.array([point.pt for point in points]).reshape(-1, 2) + 0.5
    return _Features((places - np.divide(gray.shape[::-1], 2)) / max(gray.shape), descriptors)


def _by_a_lens(one: _Features, other: _Features) -> bool:
    """Whether what two pictures show differs by a lens alone: each is the other, moved along the lines from the middle
    by a polynomial of the distance."""
    if one.descriptors is None or other.descriptors is None or min(len(one.places), len(other.places)) < _MIN_MATCHES:
        return False
    found = cv2.BFMatcher().knnMatch(one.descriptors, other.descriptors, k=2)
    good = [best for best, second in found if best.distance < _RATIO * second.distance]
    if len(good) < _MIN_MATCHES:
        return False
    here = one.places[[match.queryIdx for match in good]]
    there = other.places[[match.trainIdx for match in good]]
    square = (here**2).sum(axis=1)
    rows = np.zeros((len(here), 2, 5))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    for k in range(3):
        rows[:, :, 2 + k] = here * square[:, None] ** k
    kept = np.ones(len(here), bool)
    for limit in (16, 4, 2, 1):
        model = np.linalg.lstsq(rows[kept].reshape(-1, 5), there[kept].ravel(), rcond=None)[0]
        off = np.linalg.norm(rows @ model - there, axis=1) * _LOOKED_AT_PX
        kept = off < limit * _TOLERANCE_PX
        if kept.sum() < _MIN_MATCHES:
            return False
    shift, growth = float(np.hypot(*model[:2])), abs(float(model[2]) - 1)
    return bool(kept.mean() >= _MIN_EXPLAINED and shift <= _MAX_SHIFT and growth <= _MAX_GROWTH)
