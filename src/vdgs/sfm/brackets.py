"""Photographs of one view in several exposures (brackets, AEB), of which the middle one is used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import chain
from pathlib import PurePosixPath

import numpy as np

from vdgs.captures.capture_dates import time_of
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.sfm.flights import time_key
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.units import first_names

#: A bracket's photographs follow each other within so many seconds and metres (choice).
NEXT_S, NEXT_M = 2.0, 2.0
#: A camera that turned by more (degrees; choice) shows another view: panoramas, and corners of a flight.
SAME_VIEW_DEG = 10.0
#: Exposures nearer than this (stops) are one exposure; steps of a bracket differ by less.
SAME_STOPS = 0.2
#: A camera that takes brackets takes some of so many exposures at least, and none of more (choice).
LEAST, MOST = 3, 9
#: Without a bias in EXIF exposures must span so many stops, and such brackets be so much of all (choice): automatic
#: exposure varies, too.
LEAST_SPAN, LEAST_SHARE = 1.0, 0.5

Bracket = list[ImageMetadata]


def unused_exposures(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], list[str]]:
    """The photographs of brackets that are not used, with the reason, and what people should know of them."""
    cameras: dict[tuple[str, tuple[int, int]], dict[str, Bracket]] = {}
    for photo in sorted(photographs, key=time_key):
        folders = cameras.setdefault((photo.camera, photo.size), {})
        folders.setdefault(str(PurePosixPath(photo.name).parent), []).append(photo)
    left, used, sizes = dict[str, str](), list[str](), Counter[int]()
    for brackets, by_bias in (found for folders in cameras.values() for found in _brackets(folders)):
        usual = Counter(sorted(map(_bias, each))[len(each) // 2] for each in brackets if len(each) % 2)
        for bracket in brackets:
            values = [_bias(photo) if by_bias else _stops(photo) for photo in bracket]
            aim = usual.most_common(1)[0][0] if by_bias and usual else float(np.median(values))
            middle = bracket[int(np.abs(np.subtract(values, aim)).argmin())]
            used.append(middle.name)
            sizes[len(bracket)] += 1
            for photo, value in zip(bracket, values, strict=True):
                if photo is not middle:
                    how = f"{value - aim:+.1f} stops"
                    left[photo.name] = f"is of one bracket with {middle.name}, whose exposure is the middle one ({how})"
    if not used:
        return left, []
    kinds = " and ".join(f"{number} of {size}" for size, number in sorted(sizes.items()))
    return left, [
        f"{first_names(used)}: exposures of brackets (AEB: {kinds}); the middle one of each is used, the other "
        f"{len(left)} are left out. To use all: --brackets all."
    ]


def _brackets(folders: dict[str, Bracket]) -> list[tuple[list[Bracket], bool]]:
    """Brackets of one camera, and whether by their bias: those in each folder, else those of which each exposure was
    sorted into a folder of its own."""
    found = [
        (by_bias or _by_stops(taken), bool(by_bias)) for taken in folders.values() for by_bias in [_by_bias(taken)]
    ]
    if len(folders) < LEAST or any(brackets for brackets, _ in found):
        return found
    taken = sorted(chain(*folders.values()), key=lambda photo: time_key(photo, across_folders=True))
    biases = [[_bias(photo) for photo in each] for each in folders.values()]
    steady = all(np.ptp(each) < SAME_STOPS for each in biases)  # false for NaN
    if steady and (brackets := _by_bias(taken)):
        return [(brackets, True)] if _are_numbered(brackets) else []
    brackets = _by_stops(taken)
    orders = Counter(
        tuple(PurePosixPath(photo.name).parent.name for photo in sorted(bracket, key=_stops)) for bracket in brackets
    )
    is_sorted = any(count > LEAST_SHARE * len(brackets) and len({*names}) > 1 for names, count in orders.items())
    return [(brackets, False)] if is_sorted and _are_numbered(brackets) else []


def _are_numbered(brackets: list[Bracket]) -> bool:
    """Whether names differ, as of one camera: those of a rig each count their own, and call theirs the same."""
    return all(len({PurePosixPath(photo.name).name for photo in each}) == len(each) for each in brackets)


def _bias(photo: ImageMetadata) -> float:
    return np.nan if photo.exposure_bias is None else photo.exposure_bias


def _stops(photo: ImageMetadata) -> float:
    return np.nan if photo.exposure_stops is None else photo.exposure_stops


def _by_bias(taken: Bracket) -> list[Bracket]:
    """Brackets by EXIF's exposure bias, also those that lack an exposure, where one is whole. A camera repeats its
    brackets; cameras that release together, each with an exposure of its own, do not."""
    found = _runs(taken, [_bias(photo) for photo in taken])
    kinds = Counter(
        tuple(np.round(np.diff(sorted(map(_bias, each))), 1).tolist()) for each in found if len(each) >= LEAST
    )
    return found if kinds and (kinds.total() < LEAST or max(kinds.values()) >= LEAST_SHARE * kinds.total()) else []


def _by_stops(taken: Bracket) -> list[Bracket]:
    """Brackets by the exposure itself, in equal steps, which are the same in all brackets."""
    equal = dict[int, float]()
    runs = _runs(taken, [_stops(photo) for photo in taken])
    for number, run in enumerate(runs):
        steps = np.diff(sorted(_stops(photo) for photo in run))
        if len(run) >= LEAST and len(run) % 2 and steps.sum() >= LEAST_SPAN and np.ptp(steps) < SAME_STOPS:
            equal[number] = float(steps.mean())
    usual = float(np.median(list(equal.values()))) if equal else 0.0
    found = [runs[number] for number, step in equal.items() if abs(step - usual) < SAME_STOPS]
    return found if sum(map(len, found)) >= LEAST_SHARE * len(taken) else []


def _runs(taken: Bracket, values: Sequence[float]) -> list[Bracket]:
    """Photographs that follow each other at one place, each of another exposure; two or more. Exposures that
    go on changing are no bracket: dusk."""
    runs: list[list[int]] = []
    for index, value in enumerate(values):
        run = runs[-1] if runs else []
        other = bool(run) and all(abs(value - values[k]) > SAME_STOPS for k in run)  # false for NaN
        if other and _is_next(taken[run[-1]], taken[index]):
            run.append(index)
        else:
            runs.append([index])
    return [[taken[k] for k in run] for run in runs if 1 < len(run) <= MOST]


def _is_next(before: ImageMetadata, photo: ImageMetadata) -> bool:
    """Whether a photograph was taken right after another and where that was, as far as either is known; one must be."""
    moments, places = (time_of(before.datetime), time_of(photo.datetime)), (before.lat_lon, photo.lat_lon)
    known = [each is not None for each in moments], [each is not None for each in places]
    if moments[0] and moments[1] and (moments[1] - moments[0]).total_seconds() > NEXT_S:
        return False
    if places[0] and places[1]:
        away = enu_from_geodetic(np.array([[*places[1], 0.0]]), (*places[0], 0.0))[0]
        if np.linalg.norm(away) > NEXT_M:
            return False
    if before.attitude is not None and photo.attitude is not None:
        turned = np.trace(before.attitude.camera_from_enu @ photo.attitude.camera_from_enu.T)
        if (turned - 1) / 2 < np.cos(np.radians(SAME_VIEW_DEG)):
            return False
    return all(known[0]) or all(known[1])
