"""Which altitudes of positions are believed: not those of exactly 0, which programs write that know none, not heights
over the ground, and not those in feet that are said to be metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vdgs.captures.table_columns import FOOT_M
from vdgs.errors import CaptureError

#: An altitude of exactly 0 among others that are farther from it (metres) is a default (choice).
FAR_FROM_ZERO_M = 30.0
#: Differences of altitudes are the same but for their unit where they differ by less than this share (choice).
SAME_RELIEF = 0.1
#: Cameras whose heights differ by more than this (metres) tell altitudes in feet from those in metres.
LEAST_RELIEF_M = 2.5

#: Altitudes are heights over the ground where they spread by less than this share of what the photographs' heights do,
#: and lie across those by so many times what up may be off by, and so many degrees (choice).
ALIKE_SHARE, ACROSS_SIGMAS, ACROSS_DEG = 0.25, 3.0, 6.0
#: Directions in which places spread by less than this share of how far they spread at most do not count (choice).
SPREAD_ACROSS = 0.1


def with_altitudes(altitudes: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Which of the `known` positions [n] bool are used, and whether their altitudes [n] are: the positions with an
    altitude; where most positions have none, all positions, in the plane alone."""
    finite = known & np.isfinite(altitudes)
    enough = finite.sum() >= min(3, known.sum()) and 2 * finite.sum() >= known.sum()
    return (finite, True) if enough else (known, False)


def without_zero_altitudes(geodetic: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Positions [n, 3] without altitudes of exactly 0 (NaN in their place), where other altitudes of the `known`
    positions [n] bool are far from 0 or all are 0."""
    zero, others = geodetic[:, 2] == 0, known & (np.nan_to_num(geodetic[:, 2]) != 0)
    if not zero.any() or (others.any() and abs(np.median(geodetic[others, 2])) < FAR_FROM_ZERO_M):
        return geodetic
    return np.where(zero[:, None] & [False, False, True], np.nan, geodetic)


def are_over_ground(altitudes: np.ndarray, placed: np.ndarray, tilt_deg: float) -> bool:
    """Whether altitudes [n], nearly one for all, are heights over the ground, which a flight along a slope keeps: by
    places [n, 3] that do not depend on altitudes, whose up may be off by `tilt_deg` (one standard deviation)."""
    plane, missing = placed[:, :2] - placed[:, :2].mean(axis=0), placed[:, 2] - altitudes
    # Across a line nothing tells a slope.
    slope = np.linalg.lstsq(plane, missing - missing.mean(), rcond=SPREAD_ACROSS)[0]
    across = np.degrees(np.arctan(np.linalg.norm(slope)))
    alike = np.std(altitudes) < ALIKE_SHARE * np.std(placed[:, 2])
    return bool(alike and across > max(ACROSS_DEG, ACROSS_SIGMAS * tilt_deg))


def wrong_unit(altitudes: np.ndarray, heights: np.ndarray) -> str:
    """The unit of altitudes [n] that are taken for another: feet where they differ as `heights` [n] in feet do, over
    any zero, metres the other way around; empty where neither holds, or heights do not differ enough to tell."""
    for factor, unit in ((1 / FOOT_M, "feet"), (FOOT_M, "metres")):
        if _differ_times(factor, altitudes, heights):
            return unit
    return ""


def wrong_reading(altitudes: np.ndarray, heights: np.ndarray) -> tuple[str, float]:
    """What altitudes [n] that do not differ as `heights` [n] do are, in words, and how far that puts them off, in
    metres; empty and 0 where nothing is known that they are."""
    for factor, what in ((1 / FOOT_M, "in feet"), (-1.0, "of the wrong sign")):
        if _differ_times(factor, altitudes, heights):
            return what, float(abs(np.median(altitudes) * (1 - 1 / factor)))
    return "", 0.0


def _differ_times(factor: float, altitudes: np.ndarray, heights: np.ndarray) -> bool:
    """Whether altitudes [n] differ so many times as much as heights [n], whose differences are large enough to tell."""
    altitudes, heights = altitudes - np.median(altitudes), heights - np.median(heights)
    size = float(np.median(np.abs(heights)))
    off = float(np.median(np.abs(altitudes / factor - heights)))
    return np.ptp(heights) >= LEAST_RELIEF_M and size > 0 and off < SAME_RELIEF * size


def refuse_unit(unit: str, whose: str, file: Path) -> None:
    """Raise CaptureError if a table's altitudes are in another `unit` than it says, as `whose` tell."""
    if unit:
        other = "metres" if unit == "feet" else "feet"
        raise CaptureError(
            f"{file}: its altitudes are in {unit} and are taken for {other}, as {whose} tell. Convert them, or name "
            "their unit in the heading (alt_ft, alt_m)."
        )
