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
from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT, fit_plane, in_plane
from vdgs.captures.position_adjustment import PositionFit, Problem, alike_factors, settle, tilt_of
from vdgs.geometry.similarity import Similarity, fit_similarity_robust, is_collinear, rotation_to_z

#: Positions in the plane must explain the flight better by so much (log likelihood; choice) to tell up otherwise than
#: attitudes or views do; up is then held to so many degrees. 95 % of errors in two directions lie within so many
#: standard deviations of one.
TILT_COSTS, HELD_DEG, BOTH_WITHIN = 8.0, 1e-3, 2.45


def fit_positions(problem: Problem) -> PositionFit:
    """The likeliest similarity of cameras that are not mirrored; needs three positions. Altitudes that are heights over
    the ground count as none."""
    starts = [_upright_start(problem)]
    if problem.has_altitudes and problem.up.sure and len(problem.centers) >= ENOUGH_TO_DOUBT:
        plane = _settle_in_plane(replace(problem, has_altitudes=False))
        if are_over_ground(problem.targets[:, 2], plane.placed, problem.up.deviation_deg):
            return plane
    if problem.has_altitudes and not is_collinear(problem.centers):
        starts.append(fit_similarity_robust(problem.centers, problem.targets, 100)[0])
    models = ["used"] if problem.has_altitudes else []
    if problem.has_altitudes and len(problem.centers) >= ENOUGH_TO_DOUBT:
        models.append("drifts")
    found = [settle(problem, start, model) for start in starts for model in models]
    plane = _settle_in_plane(problem)
    best = min([plane, *found], key=lambda fit: fit.score)
    if best.altitude == "used" and _says_less_than_views(best, problem):
        best = min((fit for fit in [plane, *found] if fit.altitude != "used"), key=lambda fit: fit.score)
    if best.altitude == "drifts" and _says_less_than_views(best, problem):
        return _level_as_known(best, plane)
    return best


def _level_as_known(drifting: PositionFit, plane: PositionFit) -> PositionFit:
    """The fit in the plane with what altitudes that drift say of themselves and of how high the scene lies."""
    return replace(
        plane, altitude=drifting.altitude, drift_m=drifting.drift_m, score=drifting.score, gps_std=drifting.gps_std,
        place_error_m=(plane.place_error_m[0], drifting.place_error_m[1]),
    )  # fmt: skip


def _says_less_than_views(fit: PositionFit, problem: Problem) -> bool:
    """Whether altitudes tell up less well than it is known without positions."""
    places = fit.placed[fit.inliers, :2]
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1]
    alike = alike_factors(fit.residuals[fit.inliers], problem.in_order(fit.inliers))[2]
    tilt = np.degrees(np.arctan2(fit.gps_std[2] * alike, max(float(spread), 1e-9)))
    return bool(tilt > problem.up.deviation_deg and fit.gps_std[2] > 2 * fit.gps_std[:2].max())


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
    """The fit without altitudes: up as it is known without positions, unless these plainly say otherwise.

    Positions in the plane show a tilt by the flight that it shortens, by 1 - cos(tilt), which chance does to any flight
    (0.1 % are 2.6 degrees), and which is the same for a tilt to the other side. Level is no better than it was known.
    """
    up = problem.up
    held = settle(replace(problem, up=replace(up, deviation_deg=HELD_DEG)), _upright_start(problem), "unused")
    free = [settle(problem, start, "unused") for start in _tilted_starts(problem, held.inliers)]
    best, other = sorted(free, key=lambda fit: fit.score)
    known_deg = BOTH_WITHIN * up.deviation_deg
    if _explains_more(best, held, problem):
        apart_deg = _tilt_deg(other, best.similarity.rotation[2])
        if apart_deg <= known_deg or _explains_more(best, other, problem):
            return replace(best, level_error_deg=max(best.level_error_deg, known_deg))
        known_deg = max(known_deg, _tilt_deg(best, up.direction))  # it is tilted, to whichever side
    scale, north_deg = _moved_by_tilts(held, known_deg)
    return replace(
        held,
        level_error_deg=max(held.level_error_deg, known_deg),
        scale_error=math.hypot(held.scale_error, min(scale, 2 * held.scale_error)),
        north_error_deg=math.hypot(held.north_error_deg, min(north_deg, 2 * held.north_error_deg)),
    )


def _tilt_deg(fit: PositionFit, up: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(tilt_of(fit.similarity.rotation @ up))))


def _explains_more(one: PositionFit, other: PositionFit, problem: Problem) -> bool:
    """Whether a fit plainly explains positions across better than another: residuals that follow each other alike count
    as if there were fewer of them. Altitudes, which neither uses, are left out."""
    alike = float(alike_factors(one.residuals[one.inliers], problem.in_order(one.inliers))[:2].max())
    up = len(one.inliers) * float(np.log(other.gps_std[2] / one.gps_std[2]))
    return other.score - one.score - up > TILT_COSTS * alike**2


def _tilted_starts(problem: Problem, inliers: np.ndarray) -> list[Similarity]:
    """The two similarities, tilted to one side and to the other, that shorten a flight in one plane as positions do."""
    centers, targets = problem.centers[inliers], problem.targets[inliers]
    middle = centers.mean(axis=0)
    along = np.linalg.svd(centers - middle, full_matrices=False)[2][:2]
    flat = np.linalg.lstsq((centers - middle) @ along.T, (targets - targets.mean(axis=0))[:, :2], rcond=None)[0].T
    left, sizes, right = np.linalg.svd(flat)
    scale = max(float(sizes[0]), 1e-300)
    cosine = min(1.0, float(sizes[1]) / scale)
    across, sine, starts = right @ along, math.sqrt(1 - cosine**2), []
    for side in (-sine, sine):
        rows = left @ np.stack([across[0], cosine * across[1] + side * np.cross(*along)])
        rotation = np.stack([*rows, np.cross(*rows)])
        starts.append(Similarity(scale, rotation, targets.mean(axis=0) - scale * rotation @ middle))
    return starts


def _moved_by_tilts(held: PositionFit, tilt_deg: float) -> tuple[float, float]:
    """By which share scale changes at most, and by how many degrees north, where up is tilted by so much to any side.
    More than twice what is left open of them would show."""
    away = held.placed[held.inliers]
    away = away - away.mean(axis=0)
    angle, moved = np.radians(min(tilt_deg, 89.0)), []
    for side in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        tilted = away @ Rotation.from_rotvec(angle * np.array([np.cos(side), np.sin(side), 0.0])).as_matrix().T
        factor = np.vdot(in_plane(tilted), in_plane(away)) / max(float(np.abs(in_plane(tilted) ** 2).sum()), 1e-300)
        moved.append([abs(math.log(max(abs(factor), 1e-9))), abs(float(np.degrees(np.angle(factor))))])
    scale, north_deg = np.max(moved, axis=0)
    return math.expm1(min(50.0, scale)), float(north_deg)
