"""What lies among photographs and is none: folders of programs, products, previews, masks by their names."""

from __future__ import annotations

import errno
import os
import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path, PurePath

from vdgs.errors import CaptureError
from vdgs.system.atomic_files import read_json_or_empty
from vdgs.system.permissions import refusal
from vdgs.system.quoting import shell_word

#: Files that systems lay into any folder.
_SYSTEM_FILES = {".ds_store", "thumbs.db", "desktop.ini"}
#: Folders that systems and programs keep for themselves; so are all whose names begin with a dot.
_HIDDEN = re.compile(
    r"\..*|@.*|#recycle|\$recycle\.bin|__macosx|system volume information|lost\+found|_?thumb(nail)?s?|_?previews?"
    r"|thumbs?_.*|prox(y|ies)( media)?|cache|__pycache__",
    re.IGNORECASE,
)
#: Folders of what programs made of photographs: ODM, OpenSfM, COLMAP, Pix4D, Metashape, and their maps; and of what
#: people say that photographs show (UAVid, UDD, FloodNet).
_PRODUCTS = re.compile(
    r"odm_\w+|opensfm|entwine_pointcloud|3d_tiles|dsm|dtm|dem|chm|ndvi|ortho(photos?|mosaics?)|dsm_ortho|mosaics?"
    r"|1_initial|2_densification|3_dsm_ortho|4_index|.+\.files|.+\.rcproj|stereo|depth_?maps?|normal_maps?|depths?"
    r"|normals?|contact_?sheets?|renders?|reports?|textures?|texturing|\d+_orthophoto|undistorted_depths"
    r"|meshroomcache|semantics?|labels?(_\w+)?|\w+-label-img|annotations?|gt|ground_?truth|seg(mentations?)?",
    re.IGNORECASE,
)
#: Folders of pictures that say something of photographs, which may as well be called after a place: only where the
#: photographs lie elsewhere.
_LAYERS = re.compile(
    r"conf(idences?)?([_-]?maps?)?|mono[_-]?depths?|depth_(da|dav2|anything\w*)|rgb_depth|disparit(y|ies)|disp"
    r"|instances?|segments?|sam_masks|(optical_)?flows?|edges|canny|sky_?masks?|masks?_sky|(mono|stable)_?normals?",
    re.IGNORECASE,
)
#: Files by which programs mark a folder of their results (ours: maps, renders, runs).
_MARKS = ("map.json", "render.json", "capture.json", "partition.json", "export.json", "steps.json")
#: What folders of maps and of `vdgs inspect` hold that is no photograph, where the file lies beside it that marks them.
_OF_RESULTS = {
    "map.json": {"orthophoto.tif", "dsm.tif", "visibility.tif", "hillshade.png", "preview.png"},
    "report.json": {"visibility_map.png", "visibility.png"},
}
#: Pictures of ours, and what screens leave on a disk.
_PICTURES = re.compile(
    r"(photographs|reconstruction|contact[_ -]?sheet)\.(png|jpe?g)|screen[ _-]?shots?(?![a-z]).*|bildschirmfoto.*"
    r"|capture[ _-]d.[eé]cran.*|captura[ _-]de[ _-](pantalla|tela|ecrã).*|schermata.*|schermafbeelding.*"
    r"|skärm(avbild|klipp).*|skærmbillede.*|skjermbilde.*|zrzut[ _-]ekranu.*|снимок[ _-]экрана.*|スクリーンショット.*"
    r"|(屏幕|螢幕)?(截图|截圖|截屏|快照).*|스크린샷.*"
    r"|(odm_)?(orthophoto|orthomosaic|ortho|dsm|dtm|dem|hillshade|mosaic)([_-].*)?\.(tiff?|png|jpe?g)"
    r"|.+[_-](orthophoto|orthomosaic|transparent_mosaic[_-]?\w*|mosaic_\w+|dsm|dtm|ortho)\.(tiff?|png|jpe?g)",
    re.IGNORECASE,
)
#: Folders of undistorted copies, as COLMAP, OpenMVS, Meshroom, Polycam and people call them.
_UNDISTORTED_FOLDER = re.compile(
    r"(images?|photos?|pictures?)?[ _-]?(undist(ort(ed|ion)?)?|rectif(ied|y)|corrected)"
    r"[ _-]?(images?|photos?|pictures?)?|dense|mvs|preparedensescene|imagecorrection",
    re.IGNORECASE,
)
#: What folders of masks are called, the usual name first.
MASK_FOLDERS = ("masks", "mask", "_masks", "images_masks", "image_masks", "Masks")
_MASK_FOLDER = re.compile(r"_?(images?_?)?(masks?|msk)(_?images?)?|.+_masks", re.IGNORECASE)
_MASK_STEM = re.compile(r"(?P<before>.+?)[ ._-](mask|msk)|(dynamic_)?(mask|msk)[ ._-](?P<after>.+)", re.IGNORECASE)
_PREVIEW_STEM = re.compile(
    r"(?P<before>.+?)[ ._-](thumb|thumbnail|preview|small|proxy|tn)|(thumb|tn)[ ._-](?P<after>.+)", re.I
)
#: How BlendedMVS ends the names of copies that are black where the mesh shows nothing: no photographs, and no masks.
MASKED = "_masked"


def is_system_file(name: str) -> bool:
    """Whether a file is one that systems lay into any folder, by its name."""
    return name.startswith("._") or name.lower() in _SYSTEM_FILES


def is_of_system(name: str) -> bool:
    """Whether a file or a folder is hidden or a system's or a program's own, by its name."""
    return is_system_file(name) or _HIDDEN.fullmatch(name) is not None


def why_not_read(folder: Path) -> str | None:
    """Why pictures in a folder below photographs are none, by its name or what marks it; None where they may be."""
    if _HIDDEN.fullmatch(folder.name):
        return "hidden, or of a system's or a program's own"
    if _PRODUCTS.fullmatch(folder.name) or is_run(folder) or any(os.path.isfile(folder / mark) for mark in _MARKS):
        return "results of a program"
    return None


def is_run(folder: Path) -> bool:
    """Whether a folder is a run of ours, by the first line of its config.yaml."""
    try:
        with (folder / "config.yaml").open("rb") as handle:
            return handle.readline().rstrip() == b"vdgs:"
    except OSError:
        return False


def folder_in_run(output: Path, name: str) -> Path:
    """A folder of this name where the output is a run, whose own files lie in its root; else the output."""
    return output / name if is_run(output) else output


def check_no_run(folder: Path) -> None:
    """Raise CaptureError where a folder that is given as a capture, or as photographs, is a run: its pictures are
    renders."""
    if is_run(folder):
        raise CaptureError(
            f"{folder}: is a run, neither a capture nor photographs. Give what it was made of; to continue it, add "
            f"--output {shell_word(folder)}"
        )


def is_result(file: Path) -> bool:
    """Whether a picture is by its name a map, an overview or a picture of a screen, not a photograph."""
    marks = [mark for mark, names in _OF_RESULTS.items() if file.name.lower() in names]
    name = unicodedata.normalize("NFC", file.name)  # systems write letters and their accents apart
    return any((file.parent / mark).is_file() for mark in marks) or bool(_PICTURES.fullmatch(name))


def is_undistorted_here(picture: Path) -> bool:
    """Whether a picture is one that vdgs undistorted, by the record beside it, or the mask of such a one."""
    record = picture.with_name(f"{picture.name.removesuffix('.mask.png')}.json")
    return record.is_file() and "made_from" in read_json_or_empty(record)


def is_layer_folder(name: str) -> bool:
    """Whether a folder is called as those of pictures of depth, classes, motion and the like, which may be a place's
    name too."""
    return bool(_LAYERS.fullmatch(name))


def is_undistorted_folder(name: str) -> bool:
    """Whether a folder is called as those are into which programs write undistorted copies of photographs."""
    return bool(_UNDISTORTED_FOLDER.fullmatch(name))


def walk(folder: Path) -> Iterator[tuple[Path, list[Path], dict[Path, str]]]:
    """Each folder with its files, sorted, and the folders in it that are not entered, with the reason. Links are
    followed, but not to a folder that is entered already or holds `folder`. Raises CaptureError for a folder that
    cannot be read: nobody knows what is missing then."""
    top = Path(os.path.realpath(folder))
    been = {top, *top.parents}
    for at, folders, files in os.walk(folder, followlinks=True, onerror=_refuse):
        here = Path(at)
        if not os.access(here, os.X_OK):
            _refuse(PermissionError(errno.EACCES, os.strerror(errno.EACCES), at))
        reasons = {here / name: why_not_read(here / name) for name in sorted(folders)}
        folders.clear()
        for path in sorted((path for path, why in reasons.items() if why is None), key=os.path.islink):
            if (real := Path(os.path.realpath(path))) not in been:
                been.add(real)
                folders.append(path.name)
        folders.sort()
        yield here, [here / name for name in sorted(files)], {path: why for path, why in reasons.items() if why}


def _refuse(error: OSError) -> None:
    """Raise CaptureError for a folder whose files cannot be listed or read."""
    folder = Path(error.filename)
    raise CaptureError(f"{folder}: the folder {refusal(folder, error)}, or move it elsewhere.")


def is_hidden(name: PurePath) -> bool:
    """Whether a file lies in a folder that a system keeps for itself (`.thumbnails`, `@eaDir`, `__MACOSX`)."""
    return any(part.startswith((".", "@", "__MACOSX")) for part in name.parts)


def is_mask_folder(name: str) -> bool:
    """Whether a folder is called as folders of masks are."""
    return bool(_MASK_FOLDER.fullmatch(name))


def masked_stem(stem: str) -> str | None:
    """The stem of the photograph that a mask is of by its name (`x_mask`, `mask_x`, `x.jpg.mask`); None for others."""
    return _stem(_MASK_STEM.fullmatch(stem))


def previewed_stem(stem: str) -> str | None:
    """The stem of the photograph that a preview is of by its name (`x_thumb`, `x.preview`); None for others."""
    return _stem(_PREVIEW_STEM.fullmatch(stem))


def _stem(match: re.Match[str] | None) -> str | None:
    return (match["before"] or match["after"]) if match else None
