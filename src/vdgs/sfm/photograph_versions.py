"""Which photographs are copies, previews or edited versions of others."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image, ImageOps

from vdgs.captures.image_files import open_image, same_aspect
from vdgs.sfm.brackets import SAME_STOPS
from vdgs.sfm.edited_names import first_stems, say_copy
from vdgs.sfm.image_metadata import SERIAL, UNKNOWN_CAMERA, ImageMetadata
from vdgs.sfm.rig_folders import may_be_sensor

#: A smaller copy has at most this share of the longer side of the photograph of its name.
SMALLER = 0.7
#: How systems count what they download again, and how cameras count photographs of one second.
_COUNTED_NAME = re.compile(r"(.+?)(?:[ _]?\(\d{1,2}\)|[-_~]\d)")
#: Programs may cut off the digits of parts of a second behind the second one.
_SAME_SUBSECOND = 0.01
#: And round focal lengths by so much (millimetres).
SAME_FOCAL_MM = 0.1
#: Programs that convert photographs may round places by so much (about a metre; choice).
_ROUNDED_DEG = 1e-5
#: Photographs show the same where the order of the gray values of their pixels correlates so well, by so many of them
#: (choice; five aerial photographs and themselves moved by 2 % of the width: 0.54 to 0.92).
SAME_PICTURE, LOOKED_AT_PAIRS = 0.95, 3
#: And are one that was saved again from so much on (choice; photographs of 400 pixels as JPEG of quality 30:
#: from 0.992; moved by one pixel: up to 0.974).
SAVED_AGAIN = 0.99
#: A picture that was cut from another is looked for in so small a one, in so many sizes, and found where gray values
#: correlate so well (choice: every size is within a few per cent of one that is tried).
_SEARCHED_PX, _SEARCHED_SIZES, _SAME_PART = 320, 24, 0.8
#: Smaller parts are in any picture (choice).
_LEAST_PART_PX = 40
#: Sides of the small picture that tells it.
_LOOKED_AT = (128, 128)
#: So many of these are kept where photographs are compared with several others.
_KEPT_LOOKS = 512

Folder = Mapping[str, ImageMetadata]
Pair: TypeAlias = tuple[ImageMetadata, ImageMetadata]
Ranks: TypeAlias = Callable[[Path], Float32[np.ndarray, "n"]]


def versions(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs of which another version is among the others, with the reason."""
    reasons = _cut_copies(photographs) | _smaller_copies(photographs) | _later_copies(photographs)
    reasons |= _saved_again([photo for photo in photographs if photo.name not in reasons])
    return reasons | _versions_elsewhere([photo for photo in photographs if photo.name not in reasons])


def taken_apart(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether two photographs were taken at other moments or places, as far as both say it."""
    moments = photo.datetime, other.datetime
    apart = all(moments) and (moments[0] != moments[1] or _are_of_other_parts(photo, other))
    return apart or _are_of_other_places(photo, other)


def _are_of_other_parts(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether both say the part of their second, and these differ."""
    if photo.subsecond is None or other.subsecond is None:
        return False
    return abs(photo.subsecond - other.subsecond) >= _SAME_SUBSECOND


def _are_of_other_places(photo: ImageMetadata, other: ImageMetadata) -> bool:
    if photo.lat_lon is None or other.lat_lon is None:
        return False
    return bool(np.abs(np.subtract(photo.lat_lon, other.lat_lon)).max() > _ROUNDED_DEG)


def _are_of_other_cameras(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether both say their camera, and these differ. Programs may drop the serial number, or all."""
    (model, _, serial), (other_model, _, other_serial) = (each.camera.partition(SERIAL) for each in (photo, other))
    if UNKNOWN_CAMERA not in (model, other_model) and model != other_model:
        return True
    return bool(serial and other_serial) and serial != other_serial


def _cut_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures that a program cut from a photograph of their name, camera and moment, which is there."""
    stems: dict[tuple[str, ...], list[ImageMetadata]] = {}
    for photo in photographs:
        if photo.datetime and not photo.is_bare and photo.kind != "raw":
            stem = PurePosixPath(photo.name).stem.lower()
            stems.setdefault((stem, photo.camera, photo.datetime), []).append(photo)
    reasons = {}
    for alike in stems.values():
        for photo in alike:
            whole = next((other for other in alike if _is_cut_from(photo, other)), None)
            if whole:
                reasons[photo.name] = f"is cut from {whole.name}, by its name, moment and shape"
    return reasons


def _is_cut_from(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether a picture of the name, camera and moment of another is of another shape and has fewer pixels on a side,
    more on none. Lenses of a rig may share all that."""
    (short, longer), (whole_short, whole_longer) = sorted(photo.size), sorted(other.size)
    lies_in = short <= whole_short and longer <= whole_longer
    if not lies_in or same_aspect((longer, short), (whole_longer, whole_short)) or _are_of_a_rig(photo, other):
        return False
    if photo.focal_mm and other.focal_mm and abs(photo.focal_mm - other.focal_mm) > SAME_FOCAL_MM:
        return False
    return not taken_apart(photo, other) and _may_be_one_exposure(photo, other) and _shows_part_of(photo, other)


def _shows_part_of(photo: ImageMetadata, whole: ImageMetadata) -> bool:
    """Whether a picture is somewhere in another, in any brightness and contrast: as large as there, or shrunk from as
    much as its whole width or height."""
    frame, shown = _small_gray(whole), _small_gray(photo)
    if frame is None or shown is None:
        return False
    shape = np.array(shown.shape) / max(shown.shape)
    most = float(np.min(np.array(frame.shape) / shape))  # pixels of the longer side
    as_cut = max(photo.size) * max(frame.shape) / max(whole.size)
    for longer in np.geomspace(min(as_cut, most), most, _SEARCHED_SIZES):
        height, width = np.maximum(1, (shape * longer).astype(int)).tolist()
        part = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA)
        if min(height, width) < _LEAST_PART_PX or part.std() < 1:  # a picture of one gray is in any other
            continue
        if cv2.matchTemplate(frame, part, cv2.TM_CCOEFF_NORMED).max() >= _SAME_PART:
            return True
    return False


def _small_gray(photo: ImageMetadata) -> UInt8[np.ndarray, "h w"] | None:
    """Gray values of a small upright picture; None for one that Pillow does not read, or that has not 8 bits a
    sample."""
    try:
        with open_image(photo.path) as image:
            image.draft("L", (2 * _SEARCHED_PX, 2 * _SEARCHED_PX))
            if image.mode.startswith(("I", "F")):
                return None
            upright = ImageOps.exif_transpose(image).convert("L")
            upright.thumbnail((_SEARCHED_PX, _SEARCHED_PX), Image.Resampling.BOX)
            return np.asarray(upright)
    except (OSError, SyntaxError, ValueError):
        return None


def _are_of_a_rig(photo: ImageMetadata, other: ImageMetadata) -> bool:
    folders = [str(PurePosixPath(each.name).parent) for each in (photo, other)]
    return all(may_be_sensor(folder) for folder in folders)


def _smaller_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Previews and thumbnails: of the name and shape of a larger photograph of the camera and place, as far as both say
    these, and they show the same. Frames of other films and photographs of other flights count from 1, too."""
    stems: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        stems.setdefault(PurePosixPath(photo.name).stem.lower(), []).append(photo)
    usual = Counter(photo.size for photo in photographs).most_common(1)[0][0] if photographs else (0, 0)
    pairs: dict[tuple[object, ...], list[Pair]] = {}
    for alike in stems.values():
        for photo in alike:
            for other in alike if photo.size != usual else ():
                if _may_be_smaller_copy(photo, other):
                    folders = PurePosixPath(photo.name).parent, PurePosixPath(other.name).parent
                    pairs.setdefault((*folders, taken_apart(photo, other)), []).append((photo, other))
    ranks = lru_cache(_KEPT_LOOKS)(_gray_ranks)
    copies = [pair for each in pairs.values() for pair in _showing_the_same(each, ranks)]
    copies.sort(key=lambda pair: pair[1].width * pair[1].height)  # the largest is the last that is named
    found = {photo.name: f"is a smaller copy of {other.name}" for photo, other in copies}
    return {photo.name: found[photo.name] for photo in photographs if photo.name in found}


def _may_be_smaller_copy(photo: ImageMetadata, other: ImageMetadata) -> bool:
    if max(photo.size) > SMALLER * max(other.size) or not same_aspect(photo.size, other.size):
        return False
    return not (_are_of_other_places(photo, other) or _are_of_other_cameras(photo, other))


def _showing_the_same(pairs: Sequence[Pair], ranks: Ranks) -> Sequence[Pair]:
    """Of pairs of the photographs of two folders those that show the same: all or none where a few agree on that, as
    to decode thousands takes minutes; else each is looked at."""
    few = {_is_seen_to_be_one(*pair, ranks) for pair in _few(pairs)}
    if len(few) == 1:
        return pairs if few.pop() else []
    return [pair for pair in pairs if _is_seen_to_be_one(*pair, ranks)]


def _is_seen_to_be_one(photo: ImageMetadata, other: ImageMetadata, ranks: Ranks) -> bool:
    """Whether two photographs show the same; of raw files, which are not looked at, whether both say one moment."""
    if "raw" in (photo.kind, other.kind):
        return bool(photo.datetime and other.datetime) and not taken_apart(photo, other)
    return _alike(photo, other, ranks) >= SAME_PICTURE


def _later_copies(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs that were edited, merged or downloaded twice, where the first is there, which they are named after,
    in any folder those whose name says so. A name that merely counts may be that of the next photograph of the same
    second: there both must show the same."""
    stems: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        stem = unicodedata.normalize("NFC", PurePosixPath(photo.name).stem)
        stems.setdefault(stem.lower(), []).append(photo)
    found = {}
    for photo in photographs:
        path = PurePosixPath(photo.name)
        edited = first_stems(path.stem)
        counted = None if edited else _COUNTED_NAME.fullmatch(path.stem)
        named = [first for stem in edited for first in stems.get(stem, ())]
        named += stems.get(counted[1].lower(), []) if counted else []
        named.sort(key=lambda first: PurePosixPath(first.name).parent != path.parent)
        for first in named:
            beside = PurePosixPath(first.name).parent == path.parent
            if (edited or beside) and (why := _why_version(photo, first, bool(edited))):
                found[photo.name] = f"is a copy or another version of {first.name}, by {why}"
                break
    return found


def _why_version(photo: ImageMetadata, first: ImageMetadata, edited: bool) -> str:
    """What says that a photograph is a version of the one that it is named after; empty for nothing. Programs that edit
    may drop or rewrite tags."""
    shown = "its name, moment, place and what it shows"
    if not edited:
        known = bool(photo.datetime) and photo.camera == first.camera
        known &= (photo.datetime, photo.lat_lon) == (first.datetime, first.lat_lon) and not taken_apart(photo, first)
        return shown if known and _show_the_same([(first, photo)]) else ""
    if photo.camera != first.camera and not photo.is_bare:
        return ""
    if photo.datetime and first.datetime and not taken_apart(photo, first):
        return "its name, moment and place"
    seen = not _are_of_other_places(photo, first) and _show_the_same([(first, photo)])
    return "its name and what it shows" if seen else ""


def _saved_again(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs that were saved again beside the first one under a name of another kind (`edit_7.jpg` for
    `DJI_0007.JPG`): of one folder, camera, moment and place, and they show the same. Photographs of a burst
    or a bracket are named alike, and bands and lenses of one moment show something else."""
    moments: dict[tuple[str, ...], list[ImageMetadata]] = {}
    for photo in photographs:
        if photo.datetime and not photo.is_bare and photo.kind != "raw":
            folder = str(PurePosixPath(photo.name).parent)
            moments.setdefault((folder, photo.camera, photo.datetime), []).append(photo)
    kinds = {photo.name: _kind_of_name(photo) for photo in photographs}
    usual = Counter(kinds.values())
    found, ranks = dict[str, str](), lru_cache(_KEPT_LOOKS)(_gray_ranks)
    for alike in moments.values():
        if len({kinds[photo.name] for photo in alike}) == 1:  # of a clock that stood still, all may be of one moment
            continue
        firsts: dict[str, list[ImageMetadata]] = {}  # by the kinds of their names
        for photo in sorted(alike, key=lambda photo: (-usual[kinds[photo.name]], -photo.width, photo.name)):
            others = (one for kind, each in firsts.items() if kind != kinds[photo.name] for one in each)
            first = next((one for one in others if _is_saved_again(photo, one, ranks)), None)
            if first is not None:
                found[photo.name] = f"is a copy of {first.name}, by its camera, moment, place and what it shows"
            else:
                firsts.setdefault(kinds[photo.name], []).append(photo)
    return found


def _kind_of_name(photo: ImageMetadata) -> str:
    """The folder and what a name says without its numbers."""
    return re.sub(r"\d+", "#", PurePosixPath(photo.name).with_suffix("").as_posix().lower())


def _is_saved_again(photo: ImageMetadata, first: ImageMetadata, ranks: Ranks) -> bool:
    if (photo.lat_lon is None) != (first.lat_lon is None):
        return False
    if _are_of_two_lenses(*(PurePosixPath(each.name).stem for each in (photo, first))):
        return False
    return _is_one_exposure(first, photo) and _alike(first, photo, ranks) >= SAVED_AGAIN


def _are_of_two_lenses(one: str, other: str) -> bool:
    """Whether stems have a number in common and an ending each, as of lenses and bands: DJI_0001_W and DJI_0001_Z."""
    count = next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    return any(map(str.isdigit, one[:count])) and count < min(len(one), len(other))


def _versions_elsewhere(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Photographs that another folder has too, edited or as raw files: of one name, or of a camera and a moment that no
    other of their folder has; of one moment, place and shape, and they show the same. The folder of more photographs is
    used. Folders of the cameras of a rig are not compared with each other: they share names, moments and places, and
    may show nearly the same."""
    folders: dict[str, dict[str, ImageMetadata]] = {}
    for photo in photographs:
        path = PurePosixPath(photo.name)
        folders.setdefault(str(path.parent), {})[path.stem.lower()] = photo
    found, kept = dict[str, str](), list[tuple[str, dict[str, ImageMetadata]]]()

    def order(folder: str) -> tuple[bool, int, bool, int, str]:
        is_copy = say_copy(PurePosixPath(folder) / "photograph")
        return _are_raw(folders[folder]), -len(folders[folder]), is_copy, len(folder), folder

    for folder in sorted(folders, key=order):
        for name, other in kept:
            if may_be_sensor(folder) and may_be_sensor(name):
                continue
            for pairs, how in ((_of_one_name, "name, moment, place"), (_of_one_moment, "camera, moment, place")):
                new = [pair for pair in pairs(other, folders[folder]) if not any(photo.name in found for photo in pair)]
                alike = [(one, photo) for one, photo in new if _is_one_exposure(one, photo)]
                if alike and _show_the_same(alike):
                    why = f"by its {how} and what it shows"
                    found |= {photo.name: f"is another version of {one.name}, {why}" for one, photo in alike}
        kept.append((folder, folders[folder]))
    return found


def _of_one_name(one: Folder, other: Folder) -> list[Pair]:
    return [(one[stem], other[stem]) for stem in sorted(one.keys() & other.keys())]


def _of_one_moment(one: Folder, other: Folder) -> list[Pair]:
    """The photographs of two folders by one camera of a moment at which it took no others of theirs."""
    moments, others = _by_moment(one), _by_moment(other)
    return [(moments[when], others[when]) for when in sorted(moments.keys() & others.keys())]


def _by_moment(folder: Folder) -> dict[tuple[str, str, float], ImageMetadata]:
    found: dict[tuple[str, str, float], list[ImageMetadata]] = {}
    for photo in folder.values():
        if photo.datetime and not photo.is_bare:
            found.setdefault((photo.datetime, photo.camera, photo.subsecond or 0.0), []).append(photo)
    return {when: taken[0] for when, taken in found.items() if len(taken) == 1}


def _are_raw(folder: Folder) -> bool:
    return all(photo.kind == "raw" for photo in folder.values())


def _is_one_exposure(one: ImageMetadata, other: ImageMetadata) -> bool:
    known = bool(one.datetime and other.datetime) and not taken_apart(one, other) and _may_be_one_exposure(one, other)
    return known and ("raw" in (one.kind, other.kind) or same_aspect(one.size, other.size))


def _may_be_one_exposure(one: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether both have the same exposure, as far as they say it: of a bracket each may lie in a folder of its own."""
    if one.exposure_stops is None or other.exposure_stops is None:
        return True
    return abs(one.exposure_stops - other.exposure_stops) < SAME_STOPS


def _show_the_same(pairs: Sequence[Pair]) -> bool:
    """Whether the photographs of each pair show the same in any brightness and contrast, by a few of them. A raw file
    and a picture of one exposure do."""
    for one, other in _few(pairs):
        if (one.kind == "raw") == (other.kind == "raw") and _alike(one, other, _gray_ranks) < SAME_PICTURE:
            return False
    return True


def _few(pairs: Sequence[Pair]) -> list[Pair]:
    """Some of many, evenly; all of few."""
    return [pairs[k] for k in sorted({len(pairs) * part // LOOKED_AT_PAIRS for part in range(LOOKED_AT_PAIRS)})]


def _alike(one: ImageMetadata, other: ImageMetadata, ranks: Ranks) -> float:
    """How well the order of the gray values of two photographs correlates; -1 where one shows nothing."""
    seen = ranks(one.path), ranks(other.path)
    return float(np.corrcoef(seen)[0, 1]) if all(np.any(each) for each in seen) else -1.0


def _gray_ranks(path: Path) -> Float32[np.ndarray, "n"]:
    """Which place each pixel of a small upright picture has by its brightness, from the middle one; zeros for a
    picture of one gray value, and for one that Pillow does not read."""
    try:
        with open_image(path) as image:
            image.draft("L", (2 * _LOOKED_AT[0], 2 * _LOOKED_AT[1]))
            gray_mode = "F" if image.mode.startswith(("I", "F")) else "L"  # Pillow cuts off what has more than 8 bits
            small = ImageOps.exif_transpose(image).convert(gray_mode).resize(_LOOKED_AT, Image.Resampling.BOX)
            gray = np.asarray(small).ravel()
    except (OSError, SyntaxError, ValueError):
        return np.zeros(_LOOKED_AT[0] * _LOOKED_AT[1], np.float32)
    ordered = np.sort(gray)
    ranks = np.searchsorted(ordered, gray) + np.searchsorted(ordered, gray, side="right")
    return np.asarray(ranks - ranks.mean(), np.float32)
