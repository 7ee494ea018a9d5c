"""Which photographs are of one rig, by their folders: rig1/cam0/0001.jpg and rig1/cam1/0001.jpg."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np

from vdgs.captures.capture_dates import time_of
from vdgs.captures.name_resolution import match_key
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.geometry.similarity import nearest_rotation
from vdgs.sfm.focal_length import lens_numbers
from vdgs.sfm.image_metadata import ImageMetadata

#: What folders of the cameras of a rig are called. Folders of a memory card (100MEDIA, 101MEDIA) are none.
_SENSOR = re.compile(
    r"(cam|camera|sensor|lens)[ _-]?\w{1,2}|left|right|front|rear|back(ward)?s?|forwards?|nadir|down|up|middle|center",
    re.IGNORECASE,
)
#: Folders share so many names, and so large a share of those of the smaller one, where the cameras release together.
MIN_FRAMES, MIN_SHARED = 3, 0.5
#: Photographs of one frame are taken within so many seconds and metres of each other, as cameras and receivers tell
#: it; the angle between their views stays within so many degrees, as gimbals tell it (choice).
SAME_S, SAME_M, SAME_DEG = 2.0, 5.0, 15.0
#: A receiver that states its error is off by up to so many times as much.
_SIGMAS = 3.0

Frames = list[tuple[ImageMetadata, ImageMetadata]]


def may_be_sensor(folder: str) -> bool:
    """Whether a folder is called as those of the cameras of a rig are."""
    return _SENSOR.fullmatch(PurePosixPath(folder).name) is not None


def with_sensors(photographs: Sequence[ImageMetadata]) -> tuple[list[ImageMetadata], list[str]]:
    """The photographs, each with the folder of its camera where that is one of a rig, and what to say of the rigs."""
    folders: dict[str, list[ImageMetadata]] = {}
    for photo in photographs:
        folders.setdefault(str(PurePosixPath(photo.name).parent), []).append(photo)
    rigs: dict[str, dict[str, list[ImageMetadata]]] = {}
    for folder, members in folders.items():
        path = PurePosixPath(folder)
        one = len({(photo.camera, photo.size, photo.lens) for photo in members}) == 1  # camera, as it was set
        alike = one and len(set(lens_numbers([photo.focal_mm for photo in members]))) == 1
        if _SENSOR.fullmatch(path.name) and alike and not any(photo.is_panorama for photo in members):
            rigs.setdefault(str(path.parent), {})[f"{folder}/"] = members
    sensor_of, notes = dict[str, str](), list[str]()
    for parent, sensors in sorted(rigs.items()):
        together, apart = _together(sensors)
        notes += [f"{one[:-1]} and {other[:-1]} have the same names, but {why}: no rig." for one, other, why in apart]
        if len(together) > 1:
            sensor_of |= {photo.name: prefix for prefix in together for photo in sensors[prefix]}
            names = ", ".join(PurePosixPath(prefix).name for prefix in together)
            where = "" if parent == "." else f" in {parent}"
            notes.append(f"{names}{where} have the same names: tried as one rig of {len(together)} cameras.")
    return [replace(photo, sensor=sensor_of.get(photo.name, "")) for photo in photographs], notes


def _together(sensors: Mapping[str, Sequence[ImageMetadata]]) -> tuple[list[str], list[tuple[str, str, str]]]:
    """The folders whose cameras release together, that of most photographs first; and pairs of folders of the same
    names that do not, with what says so."""
    by_stem = {
        prefix: {match_key(photo.name[len(prefix) :]): photo for photo in members}
        for prefix, members in sensors.items()
    }
    left, apart = sorted(by_stem, key=lambda prefix: (-len(by_stem[prefix]), prefix)), list[tuple[str, str, str]]()
    while len(left) > 1:
        first, *left = left
        together = [first]
        for prefix in sorted(left):
            shared = sorted(by_stem[first].keys() & by_stem[prefix].keys())
            if len(shared) < max(MIN_FRAMES, MIN_SHARED * len(by_stem[prefix])):
                continue
            why = _why_apart([(by_stem[first][stem], by_stem[prefix][stem]) for stem in shared])
            if why:
                apart.append((first, prefix, why))
            else:
                together.append(prefix)
        if len(together) > 1:
            return together, apart
    return [], apart


def _why_apart(frames: Frames) -> str:
    """What says that the two cameras of frames do not release together: flights one after the other, each of which
    counts from 1, have the same names, too. Empty where nothing does."""
    away = _distances(frames)
    if away is not None and np.median(away[0]) > 1:
        return "were taken at other places"
    # Clocks that were set apart stay apart, as those of flights by a timer do: places tell.
    near = away is not None and np.median(away[0]) < np.median(away[1]) / 2
    late = _delays(frames)
    if late is not None and (np.quantile(np.abs(late - np.median(late)), 0.9) > SAME_S):
        return "were taken at other moments"
    if late is not None and abs(np.median(late)) > SAME_S and not near:
        return "were taken at other moments"
    turned = _turns(frames)
    if turned is not None and np.median(turned) > SAME_DEG:
        return "the angle between their views changes"
    return ""


def _delays(frames: Frames) -> np.ndarray | None:
    """By how many seconds the second photograph of each frame [n] comes after the first; None where few tell it."""
    moments = [(time_of(one.datetime), time_of(other.datetime)) for one, other in frames]
    known = [(other - one).total_seconds() for one, other in moments if one and other]
    return np.array(known) if len(known) >= MIN_FRAMES else None


def _distances(frames: Frames) -> tuple[np.ndarray, np.ndarray] | None:
    """How far across the photographs of each frame are from each other, and from that of the next frame [n] each, as a
    share of what receivers may be off by; None where few tell it."""
    known = [(one, other) for one, other in frames if one.lat_lon and other.lat_lon]
    if len(known) < MIN_FRAMES:
        return None
    places = np.array([[(*(photo.lat_lon or ()), 0.0) for photo in frame] for frame in known])
    enu = enu_from_geodetic(places.reshape(-1, 3), tuple(places[0, 0])).reshape(-1, 2, 3)
    allowed = np.array([max(SAME_M, _SIGMAS * max(map(_stated_error, frame))) for frame in known])
    seconds = enu[:, 1], np.roll(enu[:, 1], -1, axis=0)
    here, there = (np.linalg.norm(enu[:, 0] - second, axis=1) / allowed for second in seconds)
    return here, there


def _stated_error(photo: ImageMetadata) -> float:
    return max(photo.gps_std[:2]) if photo.gps_std else photo.gps_error_m or 0.0


def _turns(frames: Frames) -> np.ndarray | None:
    """By how many degrees the second view of each frame [n] is turned from the first otherwise than it is in the mean;
    None where few tell it."""
    known = [(one.attitude, other.attitude) for one, other in frames if one.attitude and other.attitude]
    if len(known) < MIN_FRAMES:
        return None
    return degrees_from_mean(np.array([other.camera_from_enu @ one.camera_from_enu.T for one, other in known]))


def degrees_from_mean(rotations: np.ndarray) -> np.ndarray:
    """By how many degrees each rotation [n, 3, 3] is turned from the mean of all."""
    cosines = (np.einsum("nij,ij->n", rotations, nearest_rotation(rotations.sum(axis=0))) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))
