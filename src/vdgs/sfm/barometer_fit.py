"""The fit of a model to positions whose heights are the barometer's, in place of altitudes that drift against them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT
from vdgs.captures.position_adjustment import PositionFit, Problem
from vdgs.captures.position_fit import fit_positions


def fit_by_barometer(problem: Problem, fit: PositionFit, heights: np.ndarray) -> PositionFit | None:
    """The fit with heights over the take-off [n] (metres, NaN where there is none); None where they drift too, explain
    the photographs no better than altitudes do, by which `fit` is, or most photographs have none.

    Photographs without one count in neither of the two fits that are compared, and are not trusted in what is found.
    """
    known = np.isfinite(heights)
    if known.sum() < min(ENOUGH_TO_DOUBT, len(known)) or 2 * known.sum() < len(known) or np.ptp(heights[known]) == 0:
        return None
    part = problem if known.all() else _of(problem, known)
    targets = part.targets.copy()
    targets[:, 2] = heights[known] + np.median(targets[:, 2] - heights[known])
    steady = fit_positions(replace(part, targets=targets, has_altitudes=True))
    if steady.altitude != "used":
        return None
    if problem.has_altitudes:
        usual = fit if part is problem else fit_positions(part)
        if steady.score >= usual.score:
            return None
        # They alone say how high the take-off is, with all of their drift.
        across, up = steady.place_error_m
        steady = replace(steady, place_error_m=(across, max(up, fit.place_error_m[1])), drift_m=fit.drift_m)
    return steady if part is problem else _of_all(steady, problem, known)


def _of(problem: Problem, which: np.ndarray) -> Problem:
    """The problem of some of the positions [n] bool."""

    def some(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[which]

    return replace(
        problem, centers=problem.centers[which], targets=problem.targets[which], times=problem.times[which],
        stated=some(problem.stated), relative=some(problem.relative), flights=some(problem.flights),
    )  # fmt: skip


def _of_all(fit: PositionFit, problem: Problem, which: np.ndarray) -> PositionFit:
    """The fit of some of the positions [n] bool as one of all, in which the others are not trusted."""
    placed = fit.similarity.apply(problem.centers)
    inliers, residuals = np.zeros(len(which), bool), placed - problem.targets
    residuals[:, 2] = 0.0  # their altitudes are not those of the barometer
    deviations = np.broadcast_to(fit.gps_std, residuals.shape).copy()
    inliers[which], residuals[which], deviations[which] = fit.inliers, fit.residuals, fit.deviations
    return replace(fit, inliers=inliers, residuals=residuals, deviations=deviations, placed=placed)
