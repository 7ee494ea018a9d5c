"""A similarity from camera centers to positions whose accuracy nobody knows: both are estimated together.

Positions of ordinary receivers are off by metres across and by tens of metres in altitude, which drifts through a
flight. The fit therefore weighs east, north and up by what each is found to be good for, takes what the photographs
themselves say about up as one more observation, and compares three models of the altitudes: good, drifting with time,
and of no use. float64 throughout.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from vdgs.captures.gps_altitudes import are_over_ground
from vdgs.captures.likely_tilts import Likely, Moments, likely_tilts
from vdgs.captures.plane_fit import ACROSS_TIMES, ENOUGH_TO_DOUBT, fit_plane, in_plane
from vdgs.captures.position_adjustment import USUAL_M, PositionFit, Problem, alike_factors, settle, slope
from vdgs.captures.position_weights import ALIKE_TIMES
from vdgs.geometry.similarity import Similarity, fit_similarity_robust, is_collinear, rotation_to_z

#: Up is held to so many degrees. 95 % of errors in two directions lie within so many standard deviations of one.
HELD_DEG, BOTH_WITHIN = 1e-3, 2.45
#: Positions of a flight at about one height tell up where it would be off by so many times more without them: heights
#: differ by less than this share of how far cameras spread (choice).
TELL_BETTER, ONE_HEIGHT = 1.5, 0.15
#: Models are stretched by up to 2 % one way (rolling shutters, lenses): to positions that are good to centimetres that
#: is a tilt of 11 degrees, which three of these standard deviations contain (choice).
STRETCHED_DEG = 4.5
#: Positions lie along one line where they spread across it by less than this share of how far along it (choice), or as
#: errors do.
ONE_LINE = 0.05
#: No altitudes drift by more in a flight, in metres (choice): a fit with more is one of positions that do not spread.
DRIFT_LIMIT_M = 300.0
#: The other way that photographs may have been taken must explain positions better by so much (log likelihood; choice).
OTHER_COSTS = 4.0
#: And its up must be that of the fit by this cosine (choice).
OTHER_COSINE = 0.7
#: How up is found where it does.
OTHER_VIEW = "the views and the positions"


def with_likelier_up(problem: Problem) -> tuple[Problem, str]:
    """The problem with that of two ups which the positions fit better; and, where neither is better by more than
    `OTHER_COSTS`, what is in doubt. Up by views is known better once they rule the other out."""
    other = problem.up.other
    if other is None:
        return problem, ""
    turned = replace(problem, up=replace(problem.up, direction=other.direction, how=OTHER_VIEW, sure=False))
    fit, usual = fit_positions(turned), fit_positions(problem)
    if (fit.altitude == "none") != (usual.altitude == "none"):  # likelihoods of different things
        return problem, ""
    if abs(fit.score - usual.score) <= OTHER_COSTS:
        return problem, f"{other.doubt}, for the positions do not tell"
    is_upright = fit.similarity.rotation[2] @ other.direction > OTHER_COSINE  # else neither is up: are they mirrored?
    if fit.score < usual.score:
        return (turned if is_upright else problem), ""
    known_deg = other.ruled_out_deg or problem.up.deviation_deg
    return replace(problem, up=replace(problem.up, deviation_deg=min(problem.up.deviation_deg, known_deg))), ""


def fit_positions(problem: Problem) -> PositionFit:
    """The likeliest similarity of cameras that are not mirrored; needs three positions. Altitudes that are heights over
    the ground count as none."""
    starts = _upright_starts(problem)
    if problem.has_altitudes and problem.up.sure and len(problem.centers) >= ENOUGH_TO_DOUBT:
        plane = _settle_in_plane(replace(problem, has_altitudes=False))
        by_plane_deg = max(STRETCHED_DEG, plane.level_error_deg / BOTH_WITHIN)
        tilt_deg = min(problem.up.deviation_deg, by_plane_deg)  # views of one way tell it worse
        if are_over_ground(problem.targets[:, 2], plane.placed, tilt_deg):
            return plane
    if problem.has_altitudes and not is_collinear(problem.centers):
        starts.append(fit_similarity_robust(problem.centers, problem.targets, 100)[0])
    models = ["used"] if problem.has_altitudes else []
    if problem.has_altitudes and len(problem.centers) >= ENOUGH_TO_DOUBT:
        models.append("drifts")
    found = [settle(problem, start, model) for start in starts for model in models]
    found = [fit for fit in found if abs(fit.drift_m) <= DRIFT_LIMIT_M]
    likely = min(found, key=lambda fit: fit.score, default=None)
    if likely is not None and likely.altitude == "drifts":  # by which those that do not drift find the way, too
        found.append(settle(problem, likely.similarity, "used"))
    plane = _settle_in_plane(problem)
    best = min([plane, *found], key=lambda fit: fit.score)
    if best.altitude == "used" and _says_less_than_views(best, problem):
        best = min((fit for fit in [plane, *found] if fit.altitude != "used"), key=lambda fit: fit.score)
    if best.altitude == "drifts" and _says_less_than_views(best, problem):
        return _level_as_known(best, plane, problem)
    return best


def _level_as_known(drifting: PositionFit, plane: PositionFit, problem: Problem) -> PositionFit:
    """The fit in the plane with what altitudes that drift say of themselves and of how high the scene lies. They drift
    by what they change against the heights of this fit: the other one may have taken most of that for a tilt."""
    trusted = drifting.inliers
    off = (problem.targets - plane.placed)[trusted, 2]
    drift_m = slope(problem.times[trusted], off)
    more_m = max(0.0, abs(drift_m) - abs(drifting.drift_m))
    return replace(
        plane, altitude=drifting.altitude, drift_m=drift_m, score=drifting.score,
        deviations=drifting.deviations, gps_std=drifting.gps_std,
        place_error_m=(plane.place_error_m[0], drifting.place_error_m[1] + more_m / 2),
    )  # fmt: skip


def _says_less_than_views(fit: PositionFit, problem: Problem) -> bool:
    """Whether altitudes tell up less well than it is known without positions. Across one line no altitudes tell it:
    there those that do not drift say what they can along it."""
    weights = fit.gps_std[2] / fit.deviations[fit.inliers, 2:]
    places = fit.placed[fit.inliers, :2]
    middle = (places * weights**2).sum(axis=0) / (weights**2).sum()
    along, across = np.linalg.svd((places - middle) * weights, compute_uv=False)
    noise = float(fit.gps_std[:2].mean()) * math.sqrt(len(places))
    is_line = across <= max(ONE_LINE * along, ACROSS_TIMES * noise)
    spread = along if is_line and fit.altitude == "used" else across
    alike = alike_factors(fit.influences, problem.in_order(fit.inliers))[2]
    tilt = np.degrees(np.arctan2(fit.gps_std[2] * alike, max(float(spread), 1e-9)))
    return bool(tilt > problem.up.deviation_deg and fit.gps_std[2] > 2 * fit.gps_std[:2].max())


def _upright_starts(problem: Problem) -> list[Similarity]:
    """Of all positions alike, and of those alone that are said to be the best: among many bad ones they hardly count at
    first."""
    starts = [_upright_start(problem)]
    if problem.relative is not None and len(problem.centers) > ENOUGH_TO_DOUBT:
        worst = problem.relative.max(axis=1)
        best = worst <= ALIKE_TIMES * np.sort(worst)[ENOUGH_TO_DOUBT - 1]
        starts.append(_upright_start(replace(problem, centers=problem.centers[best], targets=problem.targets[best])))
    return starts


def _upright_start(problem: Problem) -> Similarity:
    """Up as it is known without positions, the rest from the plane; scale from space where the plane shows little."""
    level = rotation_to_z(problem.up.direction)
    turned = problem.centers @ level.T
    factor, shift = fit_plane(in_plane(turned), in_plane(problem.targets))
    scale, angle = abs(factor), float(np.angle(factor))
    if scale < 1e-9:
        scale = _extent(problem.targets) / max(_extent(problem.centers), 1e-300)
    rotation = Rotation.from_rotvec([0, 0, angle]).as_matrix() @ level
    up = float(np.median(problem.targets[:, 2] - scale * turned[:, 2]))
    return Similarity(scale, rotation, np.array([shift.real, shift.imag, up]))


def _extent(places: np.ndarray) -> float:
    return float(np.sqrt(np.var(places, axis=0).sum()))


# ------------------------------------------------------------------------------------------------ in the plane


def _settle_in_plane(problem: Problem) -> PositionFit:
    """The fit without altitudes: up as it is known without positions, unless these tell it better.

    A flight in one plane shows a tilt by the share that it is shortened by, which chance does to any flight (0.1 % are
    2.6 degrees), and shows it to either side alike: no fit with its least squares tells that. Up is weighed by all its
    likely directions, and what they leave open of scale and north is part of the errors.
    """
    up, level = problem.up, rotation_to_z(problem.up.direction)
    starts = _upright_starts(problem)
    for is_likeliest in (False, True):  # what a start far off leaves is alike, and says nothing of the positions
        free = min((settle(problem, start, "unused") for start in starts), key=lambda fit: fit.score)
        weights = (free.gps_std[:2].mean() / free.deviations[free.inliers, :2].mean(axis=1)) ** 2
        moments = Moments.of((problem.centers @ level.T)[free.inliers], problem.targets[free.inliers], weights)
        likely = likely_tilts(moments, *_worth(free, problem, is_likeliest), up.deviation_deg, problem.scale)
        starts = _upright_starts(replace(problem, up=replace(up, direction=level.T @ likely.likeliest)))
    chosen, level_deg = _chosen(likely, moments, BOTH_WITHIN * up.deviation_deg)
    held = replace(up, direction=level.T @ chosen, deviation_deg=HELD_DEG)
    levelled = replace(problem, up=held)
    fit = min((settle(levelled, start, "unused") for start in _upright_starts(levelled)), key=lambda each: each.score)
    scale, north_deg = _moved_by_tilts(likely, moments, rotation_to_z(chosen))
    moved_deg = float(np.degrees(np.arccos(min(1.0, chosen[2]))))
    return replace(
        fit,
        level_error_deg=max(fit.level_error_deg, level_deg),
        scale_error=math.hypot(fit.scale_error, scale),
        north_error_deg=math.hypot(fit.north_error_deg, north_deg),
        score=fit.score + 0.5 * (moved_deg / up.deviation_deg) ** 2,
    )


def _worth(fit: PositionFit, problem: Problem, is_likeliest: bool) -> tuple[float, float]:
    """As how many independent positions those that are trusted count, fewer where residuals of the likeliest fit follow
    each other alike; and by how much positions are usually off, in metres."""
    alike = float(alike_factors(fit.influences, problem.in_order(fit.inliers))[:2].max())
    alike = alike if is_likeliest else 1.0
    usual = USUAL_M[0] if problem.stated is None else float(np.median(problem.stated[:, :2]))
    return int(fit.inliers.sum()) / alike**2, usual


def _chosen(likely: Likely, moments: Moments, known_deg: float) -> tuple[np.ndarray, float]:
    """Up, where z is up as it is known without positions, and its error in degrees."""
    told = np.array([0.0, 0.0, 1.0])
    radius, best = min(
        ((likely.radius_deg(up), up) for up in (likely.middle, likely.likeliest)),
        key=lambda each: each[0],
    )
    is_flat = best @ moments.spread @ best < ONE_HEIGHT**2 * np.trace(moments.spread)
    if likely.radius_deg(told) <= (TELL_BETTER if is_flat else 1.0) * radius:
        return told, max(known_deg, likely.radius_deg(told))
    return best, radius


def _moved_by_tilts(likely: Likely, moments: Moments, level: np.ndarray) -> tuple[float, float]:
    """By which share scale is off at most for up that is off, and by how many degrees north (95 %)."""
    moments, ups = moments.turned(level), likely.ups @ level.T
    factor = moments.fitted(ups)[0] / moments.fitted(np.array([[0.0, 0.0, 1.0]]))[0]
    scale = likely.farther_end(np.log(np.maximum(np.abs(factor), 1e-300)))
    return math.expm1(min(50.0, scale)), likely.farther_end(np.degrees(np.angle(factor)))
