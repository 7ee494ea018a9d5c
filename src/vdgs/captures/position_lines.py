"""Whether positions lie along one line, about which a scene could still turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vdgs.captures.position_adjustment import DRIFT_M, PositionFit, Problem
from vdgs.captures.position_fit import ONE_LINE
from vdgs.geometry.similarity import is_collinear
from vdgs.system.units import two_digits

#: Positions fix a turn about a line if they spread across it this many times their standard deviation.
MIN_SPREAD_SIGMAS = 3.0
#: Altitudes along a line that change so many times their error against what is known of up are worth a note (choice).
MUCH_DRIFT = 4.0
#: Altitudes of receivers hardly ever drift by more than this in a flight, in metres.
MOST_DRIFT_M = 2 * DRIFT_M


def is_nearly_collinear(points: np.ndarray, std: np.ndarray) -> bool:
    """Whether places [n, 3] leave a turn about a line open: they spread across it no more than they may be wrong
    (standard deviations [n, 3])."""
    if is_collinear(points):
        return True
    return bool(_spread(points)[1] < MIN_SPREAD_SIGMAS * np.sqrt(np.median((std**2).mean(axis=1))))


def are_along_a_line(points: np.ndarray, stated: np.ndarray, found: np.ndarray) -> bool:
    """Whether places [n, 3] of a fit are along one line by the deviations that are stated of them [n, 3], unless they
    were found to be so much better [n, 3] that the line is plainly none: receivers of phones state many metres, and err
    by the same all along."""
    if not is_nearly_collinear(points, stated):
        return False
    spread = _spread(points)
    return bool(is_nearly_collinear(points, found) or spread[1] <= ONE_LINE * spread[0])


def checked_on_a_line(fit: PositionFit, problem: Problem) -> tuple[PositionFit, list[str]]:
    """The fit of positions along one line, where nothing tells a drift of altitudes from a climb but what is known of
    up without positions: heights are no better than the two differ. A note where that is much."""
    if fit.altitude != "used" or problem.stated is not None:
        return fit, []
    apart = fit.placed[:, 2] - fit.placed @ fit.similarity.rotation @ problem.up.direction
    drift, (across, up) = float(np.ptp(apart[fit.inliers])), fit.place_error_m
    length = float(np.ptp(fit.placed[fit.inliers, :2], axis=0).max())
    is_explained = drift <= 2 * np.tan(np.radians(problem.up.deviation_deg)) * length  # by up alone
    found = replace(fit, place_error_m=(across, up + (min(drift, MOST_DRIFT_M) if is_explained else drift) / 2))
    if not problem.up.sure or drift < MUCH_DRIFT * up or (is_explained and drift > MOST_DRIFT_M):
        return found, []
    note = (
        f"along the one line of the flight the recorded altitudes change by {two_digits(drift)} m against what "
        f"{problem.up.how} say: a drift, or up is off. Heights above the sea are only good to "
        f"±{two_digits(found.place_error_m[1])} m."
    )
    return found, [note]


def _spread(points: np.ndarray) -> np.ndarray:
    """Root mean square along the main axes [3], the largest first."""
    return np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
