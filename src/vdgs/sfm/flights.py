"""Which photographs belong to one flight, and by how much the altitudes of flights differ that share no datum."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from vdgs.captures.capture_dates import time_of
from vdgs.captures.capture_order import natural_key
from vdgs.sfm.image_metadata import ImageMetadata

#: A pause that is so long (seconds) and so many times the usual time between photographs parts flights (choice).
PAUSE_S, PAUSE_TIMES = 120.0, 10.0
#: So do altitudes that change so much (metres), and so many times more than usual, from photograph to photograph.
STEP_M, STEP_TIMES = 10.0, 8.0
#: Fewer photographs tell no difference of altitudes, nor does one below so many metres or standard errors (choice).
LEAST_PHOTOGRAPHS, LEAST_OFFSET_M, LEAST_SIGMAS = 3, 5.0, 4.0
#: A receiver that states a better accuracy up (metres) has fixed its altitudes (RTK).
FIXED_M = 0.5


def time_key(photo: ImageMetadata, across_folders: bool = False) -> tuple[str, float, Any]:
    """A key to sort photographs by into the order in which they were taken: by the clock, then, as those without a
    date, by their names as cameras count them, frame2 before frame10; of one folder after those of another, unless
    photographs of one time were sorted into several folders."""
    name = PurePosixPath(photo.name).name if across_folders else photo.name
    return photo.datetime, photo.subsecond or 0.0, natural_key(name)


def time_order(photographs: Sequence[ImageMetadata]) -> list[int]:
    """The numbers of photographs in the order in which they were taken."""
    return sorted(range(len(photographs)), key=lambda index: time_key(photographs[index]))


def flights_of(
    photographs: Sequence[ImageMetadata],
    kinds: Sequence[Hashable] | None = None,
    altitudes: np.ndarray | None = None,
) -> np.ndarray:
    """The number of the flight of each photograph [n] int: by folder, camera and pauses; also by the kind of its
    altitude, and by steps in the altitudes [n], where these are given."""
    groups: dict[Hashable, list[int]] = {}
    for index, photo in enumerate(photographs):
        kind = kinds[index] if kinds is not None else None
        groups.setdefault((str(PurePosixPath(photo.name).parent), photo.camera, kind), []).append(index)
    labels, count = np.zeros(len(photographs), int), 0
    for members in groups.values():
        members.sort(key=lambda index: time_key(photographs[index]))
        parts = _pauses([time_of(photographs[index].datetime) for index in members])
        if altitudes is not None:
            parts |= _steps(altitudes[members])
        labels[members] = count + np.cumsum(parts)
        count = int(labels[members].max()) + 1
    return labels


def _pauses(moments: Sequence[datetime | None]) -> np.ndarray:
    """Before which photographs [n] bool there is a pause."""
    known = [np.nan if moment is None else (moment - datetime(1970, 1, 1)).total_seconds() for moment in moments]
    return _jumps(np.array(known), PAUSE_S, PAUSE_TIMES)


def _steps(altitudes: np.ndarray) -> np.ndarray:
    return _jumps(altitudes, STEP_M, STEP_TIMES)


def _jumps(values: np.ndarray, least: float, times: float) -> np.ndarray:
    changes = np.abs(np.diff(values, prepend=values[:1]))
    known = changes[1:][np.isfinite(changes[1:])]
    usual = float(np.median(known)) if len(known) else 0.0
    return np.asarray(np.nan_to_num(changes) > max(least, times * usual))


@dataclass(frozen=True, eq=False)
class AltitudeOffsets:
    """By how much the altitudes of each position [n] lie over those of the flight that heights are taken from."""

    by_position: np.ndarray
    reference: np.ndarray
    """Positions of that flight, and of those with its datum [n] bool."""

    @property
    def different(self) -> list[float]:
        """The offsets that are not 0, each once, in metres."""
        return sorted({float(value) for value in self.by_position if value})


def altitude_offsets(
    placed: np.ndarray, recorded: np.ndarray, labels: np.ndarray, tilt_deg: float, up_std: np.ndarray
) -> AltitudeOffsets | None:
    """How altitudes differ between flights, by places [n, 3] that do not depend on altitudes and recorded ones [n, 3];
    None where they do not. Up of the places may be off by `tilt_deg`: flights beside each other tell less than flights
    over each other. Heights are taken from the largest flight, of those with RTK by the accuracy up `up_std` [n] first.
    """
    numbers, counts = np.unique(labels, return_counts=True)
    numbers = numbers[counts >= LEAST_PHOTOGRAPHS]
    if len(numbers) < 2:
        return None
    off = recorded[:, 2] - placed[:, 2]
    members = labels[:, None] == numbers
    plane = placed[:, :2] - placed[:, :2].mean(axis=0)
    medians, errors, slope = _medians(off, members, plane, np.tan(np.radians(tilt_deg)))
    groups = _alike(medians, errors)
    if len(groups) < 2:
        return None

    def rank(group: list[int]) -> tuple[bool, int]:
        inside = members[:, group].any(axis=1)
        return bool(np.median(up_std[inside]) > FIXED_M), -int(inside.sum())

    groups.sort(key=rank)
    rest = off - plane @ slope
    levels = np.array([rest[members[:, group].any(axis=1)].mean() for group in groups])  # one for each datum
    nearest = np.abs(rest[:, None] - levels).argmin(axis=1)  # of the few photographs that are no flight
    for datum, group in enumerate(groups):
        nearest[members[:, group].any(axis=1)] = datum
    return AltitudeOffsets((levels - levels[0])[nearest], nearest == 0)


def untrusted_offsets(off: np.ndarray, trusted: np.ndarray, labels: np.ndarray) -> AltitudeOffsets | None:
    """The same of flights none of whose positions is `trusted` [n], by how far recorded altitudes are above the placed
    ones [n]: where one drifts, no single datum explains it, and its median is told; also where all of a flight at
    another height are off alike. None where none is, beyond what trusted ones differ by."""
    over, usual = np.zeros(len(off)), float(np.std(off[trusted])) if trusted.any() else 0.0
    for flight in np.unique(labels[~trusted]):
        here = labels == flight
        apart = float(np.median(off[here]))
        error = 1.25 * float(np.std(off[here])) / np.sqrt(here.sum())
        enough = here.sum() >= LEAST_PHOTOGRAPHS and not trusted[here].any()
        if enough and abs(apart) > LEAST_SIGMAS * max(error, usual):
            over[here] = apart
    return AltitudeOffsets(over, trusted) if over.any() else None


def _medians(
    off: np.ndarray, members: np.ndarray, plane: np.ndarray, tilt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each flight the offset and its standard error, and the slope [2] that all share, by least squares."""
    used = members.any(axis=1)
    rows = np.concatenate([members.astype(float), plane], axis=1)[used]
    residuals = off[used] - np.array([np.median(off[flight]) for flight in members.T])[members[used].argmax(axis=1)]
    sigma = max(0.1, 1.4826 * float(np.median(np.abs(residuals))))
    weighed = np.concatenate([rows / sigma, np.eye(members.shape[1] + 2)[-2:] / tilt])
    values = np.concatenate([off[used] / sigma, np.zeros(2)])
    found = np.linalg.lstsq(weighed, values, rcond=None)[0]
    errors = np.sqrt(np.diag(np.linalg.pinv(weighed.T @ weighed, hermitian=True)))
    return found[:-2], errors[:-2], found[-2:]


def _alike(medians: np.ndarray, errors: np.ndarray) -> list[list[int]]:
    """Flights whose offsets do not differ, by their columns."""
    order = np.argsort(medians)
    groups = [[int(order[0])]]
    for before, k in pairwise(order):
        apart, error = medians[k] - medians[before], np.hypot(errors[k], errors[before])
        if apart > max(LEAST_OFFSET_M, LEAST_SIGMAS * error):
            groups.append([])
        groups[-1].append(int(k))
    return groups
