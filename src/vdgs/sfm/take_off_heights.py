"""Heights over the take-off: which are measured, and how they stand in for altitudes that drones do not write."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vdgs.captures.gps_altitudes import without_zero_altitudes
from vdgs.sfm.flights import flights_of
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.units import two_digits

#: What heights over the take-off are measured from: they say nothing of the sea.
OVER_TAKE_OFF = "above the take-off, by XMP"
#: The same on the altitude that the take-off of other flights has.
OVER_KNOWN_TAKE_OFF = "above the take-off, by XMP, as high as that of other flights"


def without_default_heights(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """The photographs without heights over the take-off that are exactly 0 in a whole flight: those of drones that do
    not know them. Others of 0 were taken on the ground."""
    found = list(photographs)
    heights = recorded_heights(photographs)
    if not (heights == 0).any():
        return found
    flights = flights_of(photographs)
    measured = np.unique(flights[np.nan_to_num(heights) != 0])
    for index in np.flatnonzero((heights == 0) & ~np.isin(flights, measured)).tolist():
        found[index] = replace(found[index], relative_altitude=None)
    return found


def recorded_heights(photographs: Sequence[ImageMetadata]) -> np.ndarray:
    """Heights over the take-off [n] in metres, NaN where they are not recorded."""
    return np.array([np.nan if each.relative_altitude is None else each.relative_altitude for each in photographs])


def with_take_off_heights(
    geodetic: np.ndarray, kinds: Sequence[str], photographs: Sequence[ImageMetadata]
) -> tuple[np.ndarray, list[str], list[str]]:
    """Places [n, 3] and what their altitudes are measured from, with heights over the take-off for flights that have no
    altitude at all, or exactly 0 alone (a default); and what to say of that.

    Where other flights have altitudes, both count from the sea by photographs that record both: all are taken to have
    taken off at one height. Where none does, those of most positions count.
    """
    known = np.isfinite(geodetic[:, :2]).all(axis=1)
    heights = recorded_heights(photographs)
    altitudes = np.where(known, without_zero_altitudes(geodetic, known)[:, 2], np.nan)
    found, kinds, own = geodetic.copy(), list(kinds), np.isfinite(altitudes)
    used = known & ~own & np.isfinite(heights)
    if used.any():
        used &= _of_flights_without(altitudes, known, photographs)
    if not used.any():
        return geodetic, kinds, []
    take_offs = (altitudes - heights)[own & np.isfinite(heights)]
    if not len(take_offs):
        if 2 * used.sum() < known.sum():
            return geodetic, kinds, []
        found[own, 2] = np.nan
    take_off = float(np.median(take_offs)) if len(take_offs) else 0.0
    found[used, 2] = heights[used] + take_off
    kind = OVER_KNOWN_TAKE_OFF if len(take_offs) else OVER_TAKE_OFF
    said = "EXIF has no altitudes, or exactly 0 (a default); heights over the take-off are used."
    if own.any():
        said = f"{used.sum()} positions have no altitudes, or exactly 0 (a default); heights over the take-off are used"
        said += (
            f", which is taken to be as high as that of the others ({two_digits(take_off)} m)."
            if len(take_offs)
            else f", and not the altitudes of the other {own.sum()}: nothing tells how high the take-off is."
        )
    return found, [kind if used[k] else each for k, each in enumerate(kinds)], [said]


def _of_flights_without(altitudes: np.ndarray, known: np.ndarray, photographs: Sequence[ImageMetadata]) -> np.ndarray:
    """Which of the `known` positions [n] bool are of flights none of which has one of the altitudes [n]."""
    members = np.flatnonzero(known)
    flights = flights_of([photographs[k] for k in members.tolist()])
    found = np.zeros(len(known), bool)
    found[members] = ~np.isin(flights, flights[np.isfinite(altitudes[members])])
    return found
