"""Pictures that other cameras of a drone took beside its photographs: thermal ones, and those of the screen."""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import PurePosixPath

from vdgs.sfm.flights import time_of
from vdgs.sfm.image_metadata import ImageMetadata

#: How DJI names what cameras of one drone take at a moment: DJI_20240329124328_0001_T, maybe with a flight behind it.
_DJI_NAME = re.compile(
    r"(?:(?P<before>.*?)(?P<time>\d{14})|)(?P<number>.*?)_(?P<camera>[TSVWZ])(?P<after>_.*)?", re.IGNORECASE
)
#: What names of pictures and folders of thermal cameras have in them: Autel's IRX_0001, thermal/, site_IR.
_THERMAL_WORD = re.compile(
    r"(?:^|[\W_])(?:t?ir|irx|lwir|flir|thermals?|thermique|t[eé]rmicas?|infra-?red|infrarouge|infrarot)(?:[\W_]|\d|$)",
    re.IGNORECASE,
)
#: What makers put behind the names of them (DJI's XT2: DJI_0001_R beside DJI_0001).
_THERMAL_TAIL = re.compile(r".*_[RT](?:_.*)?", re.IGNORECASE)
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
#: Where fewer photographs would be left, thermal pictures are what is wanted.
LEAST_VISIBLE = 3
_REMEDY = "give a folder of those alone to use them"


def other_cameras(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Pictures of a thermal camera and of the screen among photographs, with the reason.

    Thermal is what its maker's tags call so, and by its name what also has the size of a thermal sensor, smaller than
    the photographs, or a larger one of its moment beside it. None are left out where few others would be left.
    """
    thermal, screen = _beside(photographs)
    thermal |= {
        photo.name: f"is a thermal picture ({photo.thermal}): {_REMEDY}" for photo in photographs if photo.thermal
    }
    thermal |= _by_name([photo for photo in photographs if photo.name not in thermal | screen])
    thermal |= _unnamed([photo for photo in photographs if photo.name not in thermal | screen])
    thermal |= _like_others(photographs, thermal)
    visible = [photo for photo in photographs if photo.name not in thermal | screen and not photo.is_bare]
    return screen | thermal if len(visible) >= LEAST_VISIBLE else screen


def _beside(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], dict[str, str]]:
    """Pictures of a thermal camera and of the screen beside those of the same moment, as DJI names them: `_T` and `_S`
    beside `_V`, `_W` or `_Z`, in one folder or sorted into several."""
    moments: dict[str, list[tuple[re.Match[str], ImageMetadata]]] = {}
    for photo in photographs:
        if match := _DJI_NAME.fullmatch(PurePosixPath(photo.name).stem):
            key = f"{match['before']} {match['number']} {match['after']}".upper()
            moments.setdefault(key, []).append((match, photo))
    thermal, screen = dict[str, str](), dict[str, str]()
    for shots in moments.values():
        for match, photo in shots:
            camera = match["camera"].upper()
            if camera not in "TS":
                continue
            taken = [
                other
                for name, other in shots
                if name["camera"].upper() in "VWZ" and _are_of_one_moment((match, photo), (name, other))
            ]
            if camera == "T" and any(_is_larger(each, photo) for each in taken):
                thermal[photo.name] = f"is the thermal picture beside {taken[0].name}: {_REMEDY}"
            elif camera == "S" and taken:
                screen[photo.name] = f"is the picture of the screen beside {taken[0].name}"
    return thermal, screen


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
    tailed = [photo for photo in photographs if _THERMAL_TAIL.fullmatch(PurePosixPath(photo.name).stem)]
    names = {photo.name for photo in (*named, *tailed)}
    others = [photo for photo in photographs if photo.name not in names]
    if not others:
        return {}
    usual = Counter(photo.size for photo in others).most_common(1)[0][0]
    found = {
        photo.name: f"is a thermal picture by its name and size ({photo.width} x {photo.height}): {_REMEDY}"
        for photo in (*named, *tailed)
        if _has_thermal_size(photo) and photo.width * photo.height < usual[0] * usual[1]
    }
    moments = _Moments(others)
    for photo in named:
        beside = moments.larger_than(photo)
        if photo.name not in found and beside is not None:
            found[photo.name] = f"is a thermal picture by its name, and {beside.name} is of its moment: {_REMEDY}"
    return found


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
        """The first larger photograph of the moment of another; None where there is none."""
        taken = time_of(photo.datetime)
        if taken is None:
            return None
        first, last = bisect_left(self._times, taken - _SAME_MOMENT), bisect_right(self._times, taken + _SAME_MOMENT)
        return next((other for _, other in self._taken[first:last] if _is_larger(other, photo)), None)


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
