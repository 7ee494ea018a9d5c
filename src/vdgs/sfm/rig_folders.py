"""Which photographs are of one rig, by their folders: rig1/cam0/0001.jpg and rig1/cam1/0001.jpg."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

from vdgs.captures.name_resolution import match_key
from vdgs.sfm.image_metadata import ImageMetadata

#: What folders of the cameras of a rig are called. Folders of a memory card (100MEDIA, 101MEDIA) are none.
_SENSOR = re.compile(
    r"(cam|camera|sensor|lens)[ _-]?\w{1,2}|left|right|front|rear|back(ward)?s?|forwards?|nadir|down|up|middle|center",
    re.IGNORECASE,
)
#: Folders share so many names, and so large a share of those of the smaller one, where the cameras release together.
MIN_FRAMES, MIN_SHARED = 3, 0.5


def with_sensors(photographs: Sequence[ImageMetadata]) -> tuple[list[ImageMetadata], list[str]]:
    """The photographs, each with the folder of its camera where that is one of a rig, and what to say of the rigs."""
    folders: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        folders.setdefault(str(PurePosixPath(photo.name).parent), []).append(photo)
    rigs: dict[str, dict[str, list[ImageMetadata]]] = {}
    for folder, members in folders.items():
        path = PurePosixPath(folder)
        alike = len({(photo.camera, photo.size, photo.lens) for photo in members}) == 1  # one camera, as it was set
        if _SENSOR.fullmatch(path.name) and alike and not any(photo.is_panorama for photo in members):
            rigs.setdefault(str(path.parent), {})[f"{folder}/"] = members
    sensor_of, notes = dict[str, str](), list[str]()
    for parent, sensors in sorted(rigs.items()):
        together = _together(sensors)
        if len(together) > 1:
            sensor_of |= {photo.name: prefix for prefix in together for photo in sensors[prefix]}
            names = ", ".join(PurePosixPath(prefix).name for prefix in together)
            where = "" if parent == "." else f" in {parent}"
            notes.append(f"{names}{where} have the same names: taken for one rig of {len(together)} cameras.")
    return [replace(photo, sensor=sensor_of.get(photo.name, "")) for photo in photographs], notes


def _together(sensors: Mapping[str, Sequence[ImageMetadata]]) -> list[str]:
    """The folders whose cameras release together with that of most photographs, which comes first."""
    stems = {prefix: {match_key(photo.name[len(prefix) :]) for photo in members} for prefix, members in sensors.items()}
    first = max(sorted(stems), key=lambda prefix: len(stems[prefix]))
    shared = {prefix: len(stems[first] & names) for prefix, names in stems.items()}
    least = {prefix: max(MIN_FRAMES, MIN_SHARED * len(names)) for prefix, names in stems.items()}
    return [first, *(prefix for prefix in sorted(stems) if prefix != first and shared[prefix] >= least[prefix])]
