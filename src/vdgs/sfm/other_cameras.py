"""Pictures that other cameras of a drone took beside its photographs: thermal ones, and those of the screen."""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import PurePosixPath

import numpy as np

from vdgs.captures.capture_dates import time_of
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.sfm.image_metadata import UNKNOWN_CAMERA, ImageMetadata
from vdgs.sfm.picture_colors import looks_visible

#: How DJI names what cameras of one drone take at a moment: DJI_20240329124328_0001_T, maybe with a flight behind it;
#: DJI_0001_THRM by the first programs of the Zenmuse H20T.
_DJI_NAME = re.compile(
    r"(?:(?P<before>.*?)(?P<time>\d{14})|)(?P<number>.*?)_(?P<camera>[TSVWZ]|THRM|SCRN|WIDE|ZOOM)(?P<after>_.*)?",
    re.IGNORECASE,
)
#: What names of pictures and folders of thermal cameras have in them: Autel's IRX_0001, thermal/, site_IR.
_THERMAL_WORD = re.compile(
    r"(?:^|[\W_])(?:t?ir|irx|lwir|flir|thermals?|thermique|t[eé]rmicas?|infra-?red|infrarouge|infrarot)(?:[\W_]|\d|$)",
    re.IGNORECASE,
)
#: What makers put behind the names of them (DJI's XT2: DJI_0001_R beside DJI_0001).
_THERMAL_TAIL = re.compile(r".*_(?:[RT]|THRM)(?:_.*)?", re.IGNORECASE)
#: A name with the letter of a camera.
_LETTERED = re.compile(r"(?P<number>.*)_(?P<letter>[A-Z])(?P<after>_.*)?", re.IGNORECASE)
#: The letters of DJI's cameras, by which the picture of the screen is told; others are those of a rig.
_DJI_LETTERS = "TSVWZ"
#: Folders of memory cards, below which a person's own are.
_CARD_FOLDER = re.compile(r"DCIM|\d{3}[A-Z_]\w*", re.IGNORECASE)
#: Sizes of thermal sensors, and those that makers enlarge them to (pixels).
_THERMAL_SIZES = {
    (160, 120), (206, 156), (240, 180), (320, 240), (320, 256), (336, 256), (384, 288), (464, 348), (640, 480),
    (640, 512), (1024, 768), (1280, 1024),
}  # fmt: skip
#: Cameras of one drone take their pictures of a moment within so much: their clocks differ by a second or two.
_SAME_MOMENT = timedelta(seconds=2)
#: A lens whose focal length by the width is so many times another's is longer (choice; thermal cameras of drones that
#: name all alike: 1.5 and more).
_LONGER = 1.2
#: Of pictures that nothing names thermal, so many have a photograph of their moment beside them (choice).
_SHARE_BESIDE = 0.9
#: So far apart (metres; choice) are cameras of one moment on one drone at most.
_SAME_PLACE_M = 30.0
#: So many pictures of a camera, folder and size are looked at; more than half must show colors to be used (choice).
_LOOKED_AT = 5
#: Where fewer photographs would be left, thermal pictures are what is wanted.
LEAST_VISIBLE = 3
_REMEDY = "give a folder of those alone to use them"


def other_cameras(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures of a thermal camera and of the screen among photographs, with the reason.

    Thermal is what its maker's tags call so, and by its name what also has the size of a thermal sensor, smaller than
    the photographs, or a larger one of its moment beside it, and looks so. None are left out where few others would be
    left.
    """
    thermal, screen = _beside(photographs)
    said = {photo.name: f"is a thermal picture ({photo.thermal}): {_REMEDY}" for photo in photographs if photo.thermal}
    thermal |= said
    thermal |= _by_name([photo for photo in photographs if photo.name not in thermal | screen])
    thermal |= _unnamed([photo for photo in photographs if photo.name not in thermal | screen])
    thermal |= _like_others(photographs, thermal)
    colored = _in_color([photo for photo in photographs if photo.name in thermal and photo.name not in said])
    thermal = {name: why for name, why in thermal.items() if name not in colored}
    visible = [photo for photo in photographs if photo.name not in thermal | screen and not photo.is_bare]
    return screen | thermal if len(visible) >= LEAST_VISIBLE else screen


def _beside(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], dict[str, str]]:
    """Pictures of a thermal camera and of the screen beside those of the same moment, as DJI names them: `_T` and `_S`
    beside larger `_V`, `_W` or `_Z`, in one folder or sorted into several. Rigs name their lenses by letters, too."""
    moments: dict[str, list[tuple[re.Match[str], ImageMetadata]]] = {}
    for photo in photographs:
        if match := _DJI_NAME.fullmatch(PurePosixPath(photo.name).stem):
            key = f"{match['before']} {match['number']} {match['after']}".upper()
            moments.setdefault(key, []).append((match, photo))
    of_rigs = _numbers_of_rigs(photographs)
    thermal, screen = dict[str, str](), dict[str, str]()
    for shots in moments.values():
        for match, photo in shots:
            camera = _letter(match)
            if camera not in "TS":
                continue
            taken = [
                other
                for name, other in shots
                if _letter(name) in "VWZ" and _are_of_one_moment((match, photo), (name, other))
            ]
            if not any(_is_larger(each, photo) for each in taken):
                continue
            if camera == "T":
                thermal[photo.name] = f"is the thermal picture beside {taken[0].name}: {_REMEDY}"
            elif _may_be_by_dji(photo) and _number_of(photo)[0] not in of_rigs:
                screen[photo.name] = f"is the picture of the screen beside {taken[0].name}"
    return thermal, screen


def _letter(name: re.Match[str]) -> str:
    """Of the camera that DJI names: T(HRM), S(CRN), V, W(IDE) or Z(OOM)."""
    return name["camera"][0].upper()


def _may_be_by_dji(photo: ImageMetadata) -> bool:
    """By its maker, or by its name: pictures of the screen may lack tags."""
    return photo.camera.upper().startswith("DJI") or PurePosixPath(photo.name).name.upper().startswith("DJI_")


def _number_of(photo: ImageMetadata) -> tuple[str, str]:
    """What its name has around the letter of a camera, and that letter; both empty for other names."""
    match = _LETTERED.fullmatch(PurePosixPath(photo.name).stem.upper())
    return (f"{match['number']} {match['after'] or ''}", match["letter"]) if match else ("", "")


def _numbers_of_rigs(photographs: Sequence[ImageMetadata]) -> set[str]:
    """Numbers that a photograph has with the letter of a camera that DJI has not."""
    named = map(_number_of, photographs)
    return {number for number, letter in named if letter and letter not in _DJI_LETTERS}


def _are_of_one_moment(*shots: tuple[re.Match[str], ImageMetadata]) -> bool:
    """By the times in the names; without, by the folder, else by EXIF."""
    (one, photo), (other, beside) = shots
    if one["time"] or other["time"]:
        return _near(_time_in(one), _time_in(other))
    alone = PurePosixPath(photo.name).parent == PurePosixPath(beside.name).parent
    return alone or _near(time_of(photo.datetime), time_of(beside.datetime))


def _time_in(name: re.Match[str]) -> datetime | None:
    try:
        return datetime.strptime(name["time"] or "", "%Y%m%d%H%M%S")
    except ValueError:
        return None


def _near(one: datetime | None, other: datetime | None) -> bool:
    return one is not None and other is not None and abs(one - other) <= _SAME_MOMENT


def _is_larger(photo: ImageMetadata, other: ImageMetadata) -> bool:
    return photo.width * photo.height > other.width * other.height


def _has_thermal_size(photo: ImageMetadata) -> bool:
    return (max(photo.size), min(photo.size)) in _THERMAL_SIZES


def _has_thermal_word(photo: ImageMetadata) -> bool:
    """In its own name, or in that of its folder."""
    path = PurePosixPath(photo.name)
    folders = [part for part in path.parent.parts if not _CARD_FOLDER.fullmatch(part)]
    return any(_THERMAL_WORD.search(part) for part in (path.stem, *folders[-1:]))


def _by_name(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures with the name of a thermal one and its size, or with a larger photograph of their moment."""
    named = [photo for photo in photographs if _has_thermal_word(photo)]
    tailed = _tailed(photographs)
    names = {photo.name for photo in (*named, *tailed)}
    others = [photo for photo in photographs if photo.name not in names]
    if not others:
        return {}
    counts = Counter(photo.width * photo.height for photo in others)
    usual = min(counts, key=lambda area: (-counts[area], area))
    found = {
        photo.name: f"is a thermal picture by its name and size ({photo.width} x {photo.height}): {_REMEDY}"
        for photo in (*named, *tailed)
        if _has_thermal_size(photo) and photo.width * photo.height < usual
    }
    moments = _Moments(others)
    for photo in named:
        beside = moments.larger_than(photo)
        if photo.name not in found and beside is not None:
            found[photo.name] = f"is a thermal picture by its name, and {beside.name} is of its moment: {_REMEDY}"
    return found


def _tailed(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """Pictures with a thermal camera's letter and a partner: of their number and moment, without a letter or with
    another. Right ones of a pair have a left one of their size."""
    shots: dict[str, list[tuple[str, ImageMetadata]]] = {}
    lettered = list[tuple[str, str, ImageMetadata]]()
    for photo in photographs:
        stem = PurePosixPath(photo.name).stem.upper()
        shots.setdefault(stem, []).append(("", photo))
        if match := _LETTERED.fullmatch(stem):
            number = f"{match['number']}{match['after'] or ''}"
            lettered.append((number, match["letter"], photo))
            shots.setdefault(number, []).append((match["letter"], photo))
    found = []
    for number, letter, photo in lettered:
        others = [(name, other) for name, other in shots[number] if name != letter]
        is_right = any(name == "L" and other.size == photo.size for name, other in others)
        if letter in "RT" and not is_right and any(_may_be_beside(photo, other) for _, other in others):
            found.append(photo)
    return found


def _may_be_beside(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether another is larger, and of the moment as far as both are known."""
    moments = time_of(photo.datetime), time_of(other.datetime)
    return _is_larger(other, photo) and (None in moments or _near(*moments))


def _unnamed(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures of the size of a thermal sensor through a longer lens, each beside a larger one of its moment by the
    same drone (DJI's Mavic 2 Enterprise counts both in one row)."""
    kinds: dict[tuple[str, tuple[int, int]], list[ImageMetadata]] = {}
    for photo in photographs:
        if photo.lens is not None:
            kinds.setdefault((photo.camera, photo.size), []).append(photo)
    found = {}
    for (camera, size), taken in kinds.items():
        if not _has_thermal_size(taken[0]):
            continue
        longest = min(photo.lens.focal for photo in taken if photo.lens) / _LONGER
        others = [
            photo
            for (other, _), each in kinds.items()
            for photo in each
            if other == camera and _is_larger(photo, taken[0]) and photo.lens and photo.lens.focal <= longest
        ]
        moments = _Moments(others)
        pairs = {photo.name: beside for photo in taken if (beside := moments.larger_than(photo))}
        if len(pairs) >= max(LEAST_VISIBLE, _SHARE_BESIDE * len(taken)):
            for photo in taken:
                beside = pairs.get(photo.name, next(iter(pairs.values())))
                found[photo.name] = (
                    f"is a thermal picture by its size ({size[0]} x {size[1]}), its longer lens and its moment, that "
                    f"of {beside.name}: {_REMEDY}"
                )
    return found


class _Moments:
    """Photographs in the order of their moments, as EXIF has them."""

    def __init__(self, photographs: Sequence[ImageMetadata]) -> None:
        known = [(taken, photo) for photo in photographs if (taken := time_of(photo.datetime))]
        self._taken = sorted(known, key=lambda each: each[0])
        self._times = [taken for taken, _ in self._taken]

    def larger_than(self, photo: ImageMetadata) -> ImageMetadata | None:
        """The first larger photograph of the moment of another, of its maker or place; None where there is none."""
        taken = time_of(photo.datetime)
        if taken is None:
            return None
        first, last = bisect_left(self._times, taken - _SAME_MOMENT), bisect_right(self._times, taken + _SAME_MOMENT)
        near = (other for _, other in self._taken[first:last])
        return next((other for other in near if _is_larger(other, photo) and _are_together(photo, other)), None)


def _are_together(photo: ImageMetadata, other: ImageMetadata) -> bool:
    """Whether both are of one maker, or were taken at one place."""
    if photo.camera.split()[0] == other.camera.split()[0] and not photo.camera.startswith(UNKNOWN_CAMERA):
        return True
    if photo.lat_lon is None or other.lat_lon is None:
        return False
    away = enu_from_geodetic(np.array([[*photo.lat_lon, 0.0]]), (*other.lat_lon, 0.0))[0]
    return bool(np.linalg.norm(away) <= _SAME_PLACE_M)


def _like_others(photographs: Sequence[ImageMetadata], thermal: dict[str, str]) -> dict[str, str]:
    """Pictures with the name of a thermal one, of the camera and size of those that are left out for one."""
    kinds = {(photo.camera, photo.size): photo.name for photo in reversed(photographs) if photo.name in thermal}
    return {
        photo.name: f"is a thermal picture by its name, of the size of {like}: {_REMEDY}"
        for photo in photographs
        if (like := kinds.get((photo.camera, photo.size))) and photo.name not in thermal and _is_named(photo)
    }


def _is_named(photo: ImageMetadata) -> bool:
    return _has_thermal_word(photo) or _THERMAL_TAIL.fullmatch(PurePosixPath(photo.name).stem) is not None


def _in_color(photographs: Sequence[ImageMetadata]) -> set[str]:
    """The names of those that no thermal camera took, by the pixels of some of each camera, folder and size."""
    groups: dict[tuple[str, PurePosixPath, tuple[int, int]], list[ImageMetadata]] = {}
    for photo in photographs:
        groups.setdefault((photo.camera, PurePosixPath(photo.name).parent, photo.size), []).append(photo)
    found = set[str]()
    for taken in groups.values():
        looked_at = taken[:: -(-len(taken) // _LOOKED_AT)]
        if 2 * sum(looks_visible(photo.path) for photo in looked_at) > len(looked_at):
            found |= {photo.name for photo in taken}
    return found
