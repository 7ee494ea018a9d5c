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
#: So many photographs more than unknowns tell a unit beside a tilt (choice); residuals so many times the
#: usual one do not count there.
ENOUGH_TILTED, LEFT_OUT_TIMES = 8, 5.0
#: Heights must still differ by this share of the least relief without what a tilt explains (choice), and the
#: factor be that of the unit within this share; so much of the variance may be left (choices).
LEAST_TILTED, SAME_FACTOR, UNEXPLAINED = 0.5, 0.1, 0.15

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


def wrong_unit(altitudes: np.ndarray, heights: np.ndarray, across: np.ndarray | None = None) -> str:
    """The unit of altitudes [n] that are taken for another: feet where they differ as `heights` [n] in feet do, over
    any zero, metres the other way around; empty where neither holds, or heights do not differ enough to tell. Where
    heights may be tilted, as those by views are, `across` [n, 2] is where they are."""
    for factor, unit in ((1 / FOOT_M, "feet"), (FOOT_M, "metres")):
        if _differ_times(factor, altitudes, heights, across):
            return unit
    return ""


def wrong_reading(altitudes: np.ndarray, heights: np.ndarray, across: np.ndarray | None = None) -> tuple[str, float]:
    """What altitudes [n] that do not differ as `heights` [n] do are, in words, and how far that puts them off, in
    metres; empty and 0 where nothing is known that they are. `across` as in `wrong_unit`."""
    for factor, what in ((1 / FOOT_M, "in feet"), (-1.0, "of the wrong sign")):
        if _differ_times(factor, altitudes, heights, across):
            return what, float(abs(np.median(altitudes) * (1 - 1 / factor)))
    return "", 0.0


def _differ_times(factor: float, altitudes: np.ndarray, heights: np.ndarray, across: np.ndarray | None) -> bool:
    """Whether altitudes [n] differ so many times as much as heights [n], whose differences are large enough to tell:
    as they are, or but for a tilt where `across` [n, 2] says where they are."""
    altitudes, heights = altitudes - np.median(altitudes), heights - np.median(heights)
    size = float(np.median(np.abs(heights)))
    off = float(np.median(np.abs(altitudes / factor - heights)))
    if np.ptp(heights) >= LEAST_RELIEF_M and size > 0 and off < SAME_RELIEF * size:
        return True
    return across is not None and _differ_times_tilted(factor, altitudes, heights, across)


def _differ_times_tilted(factor: float, altitudes: np.ndarray, heights: np.ndarray, across: np.ndarray) -> bool:
    """Whether a line through what planes over `across` [n, 2] leave of altitudes and heights [n] has a slope
    of `factor` and explains nearly all of those altitudes. A drift with time is no unknown of its own: beside a tilt it
    would take up heights, too."""
    unknowns = np.column_stack([np.ones(len(heights)), across - across.mean(axis=0)])
    unknowns /= np.maximum(np.abs(unknowns).max(axis=0), 1e-300)
    which = np.ones(len(heights), bool)
    for _ in range(3):
        if which.sum() < unknowns.shape[1] + 1 + ENOUGH_TILTED:
            return False
        left = np.column_stack([altitudes, heights])
        left = left - unknowns @ np.linalg.lstsq(unknowns[which], left[which], rcond=1e-9)[0]
        found = float(left[which, 0] @ left[which, 1] / max(left[which, 1] @ left[which, 1], 1e-300))
        off = np.abs(left[:, 0] - found * left[:, 1])
        is_near = off <= LEFT_OUT_TIMES * np.median(off[which])
        left_over, differ = np.sum(off[which] ** 2) / max(np.sum(left[which, 0] ** 2), 1e-300), np.ptp(left[which, 1])
        if (is_near == which).all():
            break
        which = is_near
    is_factor = abs(found / factor - 1) < SAME_FACTOR
    return bool(is_factor and left_over < UNEXPLAINED and differ >= LEAST_TILTED * LEAST_RELIEF_M)


def refuse_unit(unit: str, whose: str, file: Path) -> None:
    """Raise CaptureError if a table's altitudes are in another `unit` than it says, as `whose` tell."""
    if unit:
        other = "metres" if unit == "feet" else "feet"
        raise CaptureError(
            f"{file}: its altitudes are in {unit} and are taken for {other}, as {whose} tell. Convert them, or name "
            "their unit in the heading (alt_ft, alt_m)."
        )
