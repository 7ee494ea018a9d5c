"""A similarity from camera centers to positions, from a start: it, what positions are good for and which are outliers
settle together; and how far all of it may be off. float64 throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri, fdtri, stdtrit

from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT, LEAST_M
from vdgs.captures.position_weights import agreed, as_many, of_alike, typical
from vdgs.captures.up_axis import OtherUp
from vdgs.geometry.similarity import Similarity, rotation_about

#: From so many on, east and north have a standard deviation each; of fewer they share one.
ENOUGH_FOR_AXES = 20
#: A position so many standard deviations off is left out.
LEFT_OUT_SIGMAS = 4.0
#: Standard deviations in metres, across and up, that few positions are taken to have beside what they show.
USUAL_M = (1.0, 2.0)
#: Altitudes that drift, or that say nothing, must explain the flight better by so much (log likelihood; choice).
DRIFT_COSTS, UNUSED_COSTS = 4.0, 8.0
#: Altitudes of a receiver drift through a flight by so many metres, hardly ever by many times more (Cauchy; choice).
DRIFT_M = 10.0
#: They may drift unseen by as much (one standard deviation), or by so many times what positions differ by across where
#: that is less: of a better receiver.
UNSEEN_DRIFT_ACROSS = 20.0
#: Where the receiver states its accuracy, so many times more; it is believed up to so many times what it states.
STATED_TIMES, BELIEVED = 5.0, 3.0
#: Altitudes of a receiver that states no accuracy may step once in a flight, as with another battery, by so many metres
#: (one standard deviation; choice), or so many times what positions differ by across where that is less: of a better
#: receiver.
UNSEEN_STEP_M, UNSEEN_STEP_ACROSS = 1.75, 4.0
#: The weight of altitudes that are not used: their mean alone counts.
UNUSED_TIMES = 1e5
#: Residuals that follow each other alike count as if there were fewer of them, by this factor at most.
MOST_ALIKE = 0.95
#: Positions wander where residuals differ by so many times more between photographs farther apart; of so many (choice).
CHANCE, ENOUGH_TO_WANDER = 1.3, 15
#: Rounds in which standard deviations and outliers settle, and steps of Gauss and Newton in each.
ROUNDS, STEPS = 6, 6
#: A step that changes nothing by more ends its round (radians, metres, the logarithm of the scale).
CONVERGED = 1e-6
#: A fit is worse than nothing where scale (share), scale by what wanders alone, or north (degrees) may be farther off
#: (95 %; choice).
WORST_SCALE, WORST_WANDERING, WORST_NORTH_DEG = 0.6, 0.3, 45.0


@dataclass(frozen=True, eq=False)
class Up:
    """What is known of up without positions."""

    direction: np.ndarray
    """Unit [3], in the world of the cameras."""
    deviation_deg: float
    how: str
    sure: bool = True
    """Whether up may be taken for down by mistake: no."""
    doubt: str = ""
    """What else says that it is down, for errors: a sentence behind a blank, or empty."""
    other: OtherUp | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PositionFit:
    """A similarity to positions, and how good both are. Errors are those that 95 % stay below."""

    similarity: Similarity
    inliers: np.ndarray
    """[n] bool."""
    placed: np.ndarray
    """Where the similarity puts the cameras [n, 3]."""
    residuals: np.ndarray
    """Placed minus recorded [n, 3], metres."""
    deviations: np.ndarray
    """Standard deviations of each position east, north and up [n, 3], metres."""
    gps_std: np.ndarray
    """The same of a position as those that count [3], metres: of all where all are alike."""
    altitude: str
    """`used`, `drifts`, `unused`, or `none` where there are none."""
    drift_m: float
    """By which altitudes drift from the first photograph to the last."""
    scale_error: float
    wandering_error: float
    """The part of that which comes of positions that wander."""
    north_error_deg: float
    level_error_deg: float
    place_error_m: tuple[float, float]
    """Of the whole scene, across and up."""
    score: float
    """Negative log likelihood, to compare fits of the same positions."""

    @property
    def influences(self) -> np.ndarray:
        """Residuals of the positions that are trusted [m, 3], each as far as its position counts."""
        return np.asarray(self.residuals[self.inliers] * (self.gps_std / self.deviations[self.inliers]) ** 2)

    def why_refused(self, source: str) -> str:
        """Why the fit is worse than none, in words; empty where it is not."""
        spread = float(np.sqrt(np.var((self.placed - self.residuals)[self.inliers], axis=0).sum()))
        off = float(np.sqrt((self.gps_std[:2] ** 2).sum()))
        good = self.scale_error <= WORST_SCALE and self.wandering_error <= WORST_WANDERING
        if good and self.north_error_deg <= WORST_NORTH_DEG:
            return ""
        scale = f"{self.scale_error:.0%}" if self.scale_error < 10 else "any factor"
        return (
            f"the positions ({source}) and where the photographs were placed disagree by about {off:.3g} m over a "
            f"flight of {spread:.3g} m: scale could be off by {scale}, north by {min(180.0, self.north_error_deg):.0f}°"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """Camera centers [n, 3], positions [n, 3], when they were recorded [n] (0 to 1), and what else is known."""

    centers: np.ndarray
    targets: np.ndarray
    times: np.ndarray
    up: Up
    scale: tuple[float, float] | None = None
    """The factor from the cameras' world to metres, and its standard deviation as a share."""
    stated: np.ndarray | None = None
    """Standard deviations [n, 3] that the receiver itself states."""
    relative: np.ndarray | None = None
    """By how many times each position is said to be worse than the usual one [n, 3]; None where all are alike."""
    has_altitudes: bool = True
    """Whether the targets have heights; where not, heights are ignored and the fit is one in the plane."""
    flights: np.ndarray | None = None
    """Which positions are of one receiver and flight [n] int: drones that fly at the same time err on their own."""

    @cached_property
    def order(self) -> np.ndarray:
        """The positions as receivers recorded them [n] int, one flight after the other."""
        if self.flights is None:
            return np.argsort(self.times, kind="stable")
        _, flight = np.unique(self.flights, return_inverse=True)
        begins = np.full(flight.max(initial=0) + 1, np.inf)
        np.minimum.at(begins, flight, self.times)
        return np.lexsort((self.times, begins[flight]))

    def in_order(self, inliers: np.ndarray) -> np.ndarray:
        """The same of the positions that are trusted [n] bool, numbered among themselves."""
        return (np.cumsum(inliers) - 1)[self.order[inliers[self.order]]]


@dataclass(frozen=True, eq=False)
class _State:
    """What Gauss and Newton change: the similarity about the middle of the cameras, and the drift."""

    scale: float
    rotation: np.ndarray
    middle: np.ndarray
    drift: float


def settle(problem: Problem, start: Similarity, model: str) -> PositionFit:
    count = len(problem.centers)
    middle = problem.centers.mean(axis=0)
    state = _State(start.scale, start.rotation, start.apply(middle[None])[0], 0.0)
    inliers, times = np.ones(count, bool), problem.times - problem.times.mean()
    if model == "drifts":  # the start has it in the residuals
        state = replace(state, drift=slope(times, -_residuals(problem, state, middle, times)[:, 2]))
    weights, leverages = np.ones((count, 3)), np.zeros((count, 3))
    for _ in range(ROUNDS):
        residuals = _residuals(problem, state, middle, times)
        if problem.relative is not None:
            weights = agreed(problem.relative, residuals, leverages)
        whole = residuals / weights
        inliers = _trusted(whole, _deviations(whole[inliers], model, problem.stated, True), model)
        deviations = _deviations(whole[inliers], model, problem.stated) * weights
        alike = alike_factors((whole / weights)[inliers], problem.in_order(inliers))
        state, normal, gains, leverages[inliers] = _step(
            problem, state, middle, times, inliers, deviations[inliers] * alike, model
        )
    residuals = _residuals(problem, state, middle, times)
    deviations = _deviations((residuals / weights)[inliers], model, problem.stated) * weights
    used = deviations[inliers]
    gps_std = typical(used) if problem.relative is not None else used[0]
    translation = state.middle - state.scale * state.rotation @ middle
    similarity = Similarity(state.scale, state.rotation, translation)
    placed = similarity.apply(problem.centers)
    order = problem.in_order(inliers)
    if model == "used" and problem.stated is None:
        unseen_m = min(DRIFT_M, UNSEEN_DRIFT_ACROSS * float(gps_std[:2].mean()))
        normal = _with_unseen_drift(normal, gains, times[inliers], unseen_m)
    wandering = _wandering((residuals / weights)[inliers], order, gains * weights[inliers])
    scale, north, level, place = _errors(normal, wandering, used, gps_std, state.drift, model, _said(problem, inliers))
    level = _with_unseen_step(level, problem, state, gains[:, order], gps_std)
    return PositionFit(
        similarity=similarity, inliers=inliers, residuals=placed - problem.targets, placed=placed,
        deviations=deviations, gps_std=gps_std, altitude=model if problem.has_altitudes else "none",
        drift_m=state.drift if model == "drifts" else 0.0,
        scale_error=scale, wandering_error=2 * math.sqrt(wandering[0]), north_error_deg=north,
        level_error_deg=level, place_error_m=place,
        score=_score(problem, state, inliers, deviations, model),
    )  # fmt: skip


def _said(problem: Problem, inliers: np.ndarray) -> np.ndarray | None:
    """The deviation [3] that receivers state of the positions that count; None where they state none."""
    if problem.stated is None:
        return None
    return typical(problem.stated[inliers]) if problem.relative is not None else of_alike(problem.stated)


def _residuals(problem: Problem, state: _State, middle: np.ndarray, times: np.ndarray) -> np.ndarray:
    off = state.scale * (problem.centers - middle) @ state.rotation.T + state.middle - problem.targets
    off[:, 2] += state.drift * times
    if not problem.has_altitudes:
        off[:, 2] = 0.0
    return off


def slope(times: np.ndarray, values: np.ndarray) -> float:
    """Of a line through values [n] by the median of slopes (Theil and Sen)."""
    thin = slice(None, None, 1 + len(times) // 500)
    times, values = times[thin], values[thin]
    one, other = np.triu_indices(len(times), 1)
    apart = times[other] - times[one]
    far = np.abs(apart) > 0.05
    return float(np.median((values[other] - values[one])[far] / apart[far])) if far.any() else 0.0


def _deviations(residuals: np.ndarray, model: str, stated: np.ndarray | None, robustly: bool = False) -> np.ndarray:
    """Standard deviations [3]: of many as they are, or robustly; of few joined with what positions usually are."""
    count, unknowns = len(residuals), np.array([2.0, 2.0, {"used": 3.0, "drifts": 4.0, "unused": 1.0}[model]])
    free = np.maximum(count - unknowns, 0.5)
    if count >= ENOUGH_TO_DOUBT:
        squares = (residuals**2).mean(axis=0)
        if robustly:
            squares = (1.4826 * np.median(np.abs(residuals - np.median(residuals, axis=0)), axis=0)) ** 2
        squares = squares * count / free
        if count < ENOUGH_FOR_AXES:
            squares[:2] = squares[:2].mean()
        found = np.sqrt(squares)
    else:
        usual = np.array([USUAL_M[0], USUAL_M[0], USUAL_M[1]]) if stated is None else of_alike(stated)
        plane = (residuals[:, :2] ** 2).sum() / 2
        sums = np.array([plane, plane, (residuals[:, 2] ** 2).sum()])
        found = np.sqrt((sums + usual**2) / (np.maximum(count - unknowns, 0) + 1))
    return np.maximum(found, LEAST_M)


def _trusted(residuals: np.ndarray, gps_std: np.ndarray, model: str) -> np.ndarray:
    if len(residuals) < ENOUGH_TO_DOUBT:
        return np.ones(len(residuals), bool)
    off = np.abs(residuals) / gps_std
    axes = off[:, :2] if model == "unused" else off
    trusted = (axes <= LEFT_OUT_SIGMAS).all(axis=1)
    return trusted if trusted.sum() >= max(3, len(residuals) / 2) else np.ones(len(residuals), bool)


def alike_factors(residuals: np.ndarray, order: np.ndarray) -> np.ndarray:
    """By how much more residuals that follow each other, in this order, alike leave open than as many independent ones,
    [3]."""
    if len(residuals) < 2 * ENOUGH_TO_DOUBT:
        return np.ones(3)
    ordered = residuals[order] - residuals.mean(axis=0)
    power = np.maximum((ordered**2).sum(axis=0), 1e-12)
    alike = np.clip((ordered[1:] * ordered[:-1]).sum(axis=0) / power, 0.0, MOST_ALIKE)
    return np.sqrt((1 + alike) / (1 - alike))


def _step(
    problem: Problem,
    state: _State,
    middle: np.ndarray,
    times: np.ndarray,
    inliers: np.ndarray,
    deviations: np.ndarray,
    model: str,
) -> tuple[_State, np.ndarray, np.ndarray, np.ndarray]:
    """Some steps of Gauss and Newton; the normal matrix [8, 8] of log scale, rotation, place and drift; by how much
    each of these changes with each residual [8, m, 3]; and by how much the fit follows each position [m, 3]."""
    sigma = deviations * np.array([1.0, 1.0, UNUSED_TIMES if model == "unused" else 1.0])
    away, spread = problem.centers[inliers] - middle, np.deg2rad(problem.up.deviation_deg)
    for _ in range(STEPS):
        turned = state.scale * away @ state.rotation.T
        jacobian = np.zeros((len(away), 3, 8))
        jacobian[:, :, 0] = turned
        jacobian[:, 0, 2], jacobian[:, 0, 3] = turned[:, 2], -turned[:, 1]
        jacobian[:, 1, 1], jacobian[:, 1, 3] = -turned[:, 2], turned[:, 0]
        jacobian[:, 2, 1], jacobian[:, 2, 2] = turned[:, 1], -turned[:, 0]
        jacobian[:, :, 4:7] = np.eye(3)
        jacobian[:, 2, 7] = times[inliers] if model == "drifts" else 0.0
        weighed = (jacobian / sigma[:, :, None]).reshape(-1, 8)
        off = (_residuals(problem, state, middle, times)[inliers] / sigma).ravel()
        rows, values = [weighed], [off]
        up = state.rotation @ problem.up.direction
        level = np.zeros((2, 8))
        level[0, 2], level[0, 3], level[1, 1], level[1, 3] = up[2], -up[1], -up[2], up[0]
        rows.append(level / spread)
        values.append(tilt_of(up) / spread)
        if problem.scale is not None:
            known = np.zeros((1, 8))
            known[0, 0] = 1.0
            rows.append(known / problem.scale[1])
            values.append(np.array([math.log(state.scale / problem.scale[0]) / problem.scale[1]]))
        drift = np.zeros((1, 8))
        drift[0, 7] = math.sqrt(2 / (DRIFT_M**2 + state.drift**2))  # the weight of `_drift_cost`
        rows.append(drift)
        values.append(drift[0, 7:] * state.drift)
        stacked = np.concatenate(rows)
        normal = stacked.T @ stacked
        change = -np.linalg.lstsq(stacked, np.concatenate(values), rcond=None)[0]
        change[:4] *= min(1.0, 0.5 / max(float(np.abs(change[:4]).max()), 1e-300))
        state = _State(
            state.scale * math.exp(change[0]),
            rotation_about(change[1:4]) @ state.rotation,
            state.middle + change[4:7],
            state.drift + change[7],
        )
        if np.abs(change).max() < CONVERGED:
            break
    covariance = np.linalg.pinv(normal, hermitian=True)
    gains = (covariance @ (jacobian / sigma[:, :, None] ** 2).reshape(-1, 8).T).reshape(8, -1, 3)
    return state, normal, gains, np.einsum("kma,mak->ma", gains, jacobian)


def tilt_of(up: np.ndarray) -> np.ndarray:
    """How far up lies beside the z axis, [2] in radians: the whole angle, however large."""
    across = float(np.hypot(up[0], up[1]))
    angle = math.atan2(across, float(up[2]))
    return up[:2] * (angle / across if across > 1e-12 else 1.0)


def _wandering(residuals: np.ndarray, order: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Variances [8] that come of positions which wander, as those of receivers do: a walk of random steps, as large as
    residuals differ more between photographs that are farther apart in their order."""
    count = len(residuals)
    if count < ENOUGH_TO_WANDER:
        return np.zeros(8)
    apart, ordered = max(2, count // 8), residuals[order]
    one, more = (0.5 * ((ordered[lag:] - ordered[:-lag]) ** 2).mean(axis=0) for lag in (1, apart))
    one[:2], more[:2] = one[:2].mean(), more[:2].mean()
    steps = np.maximum(0.0, 2 * (more - CHANCE * one) / (apart - 1))
    later = np.cumsum(gains[:, order[::-1]], axis=1)  # a step moves all that come after it
    return (later**2 * steps).sum(axis=(1, 2))


def _errors(
    normal: np.ndarray,
    wandering: np.ndarray,
    deviations: np.ndarray,
    gps_std: np.ndarray,
    drift: float,
    model: str,
    said: np.ndarray | None,
) -> tuple[float, float, float, tuple[float, float]]:
    """What 95 % stay below, from the normal matrix: of scale, of north and level in degrees, of place across and up. A
    receiver may be off for a whole flight by as much as it is off from photograph to photograph."""
    is_few, across_and_up = len(deviations) < ENOUGH_TO_DOUBT, as_many(deviations)
    count, count_up = float(across_and_up[:2].min()), float(across_and_up[2])
    covariance = np.linalg.pinv(normal, hermitian=True)
    values = np.linalg.eigvalsh(normal[:7, :7])
    open_ = values[0] <= 1e-12 * values[-1]
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0) + wandering) * float(
        stdtrit(max(2 * count - 4, 0) + (2 if is_few else 0), 0.975)
    )
    if open_:
        errors[:4] = np.where(errors[:4] > 0, errors[:4], math.pi)
    common, is_found = gps_std, True
    if said is not None:
        common, is_found = np.where(gps_std > BELIEVED * said, gps_std, said), bool((gps_std > BELIEVED * said).any())
    usual = 2 if is_few else 0  # what positions usually are counts, too
    free = np.array([2 * count - 4, count_up - {"used": 3, "drifts": 4, "unused": 1}[model]]) + usual
    free = np.maximum(free, 1) if is_found else np.full(2, np.inf)
    across = radius_95(np.maximum(np.diag(covariance)[4:6], 0.0) + wandering[4:6] + common[:2] ** 2, free[0])
    times = radius_95(np.ones(1), free[1])
    mean_up = times / math.sqrt((1 / deviations[:, 2] ** 2).sum()) if model == "unused" else float(errors[6])
    # What is level decides how much of the altitudes is drift.
    drift_error = float(errors[7]) if model == "drifts" else 0.0
    up = math.hypot(mean_up, times * float(common[2]) + (abs(drift) + drift_error) / 2)
    level = float(np.degrees(np.hypot(*errors[1:3])))
    return float(math.expm1(min(50.0, errors[0]))), float(np.degrees(errors[3])), level, (across, up)


def radius_95(variances: np.ndarray, free: float) -> float:
    """The distance that 95 % stay below, of errors along one axis or two with these variances, which were found with so
    many degrees of freedom: Student's t for one, of two as many axes as they are worth (Satterthwaite)."""
    axes = float(variances.sum() ** 2 / (variances**2).sum())
    times = fdtri(axes, free, 0.95) if math.isfinite(free) else chdtri(axes, 0.05) / axes
    return math.sqrt(float(variances.sum()) * float(times))


def _with_unseen_drift(normal: np.ndarray, gains: np.ndarray, times: np.ndarray, unseen_m: float) -> np.ndarray:
    """The normal matrix [8, 8] of altitudes that count as they are, with a drift of `unseen_m` (one standard deviation)
    as far as they would not show it: along one line a drift and a tilt look the same. `gains` [8, m, 3], `times` [m].
    """
    counted = np.einsum("ij,jm->im", normal, gains[:, :, 2])  # what each altitude adds for each unknown
    found = normal.copy()
    found[7, :7] = found[:7, 7] = counted[:7] @ times
    found[7, 7] = counted[6] @ times**2 + 1 / unseen_m**2
    return found


def _with_unseen_step(
    level_deg: float, problem: Problem, state: _State, gains: np.ndarray, gps_std: np.ndarray
) -> float:
    """The error of level with a step in the altitudes that nothing shows: it tilts strips beside each other alike, by
    `gains` [8, m, 3] in the order of time. No worse than what is known of up without positions leaves."""
    if problem.stated is not None or gains.shape[1] < ENOUGH_TO_DOUBT:
        return level_deg
    after = np.cumsum(gains[1:3, ::-1, 2], axis=1)
    step_m = min(UNSEEN_STEP_M, UNSEEN_STEP_ACROSS * float(gps_std[:2].mean()))
    step = 2 * float(step_m * np.linalg.norm(after, axis=0).max())
    most = float(np.degrees(np.linalg.norm(tilt_of(state.rotation @ problem.up.direction))))
    most = most + 2 * problem.up.deviation_deg if problem.up.sure else 180.0
    return max(level_deg, min(math.hypot(level_deg, float(np.degrees(step))), most))


def _drift_cost(drift_m: float) -> float:
    """Of a drift, as negative log likelihood: heavy tails, for some receivers drift by a hundred metres."""
    return math.log1p((drift_m / DRIFT_M) ** 2)


def _score(problem: Problem, state: _State, inliers: np.ndarray, deviations: np.ndarray, model: str) -> float:
    """Negative log likelihood; positions that are left out cost what their limit would."""
    left_out = int((~inliers).sum())
    tilt = float(np.degrees(np.linalg.norm(tilt_of(state.rotation @ problem.up.direction))))
    known = 0.0
    if problem.scale is not None:
        known = 0.5 * (math.log(state.scale / problem.scale[0]) / problem.scale[1]) ** 2
    costs = {"used": 0.0, "drifts": DRIFT_COSTS, "unused": UNUSED_COSTS}[model]
    costs *= 1 if problem.stated is None else STATED_TIMES
    costs += _drift_cost(state.drift)
    return float(
        np.log(deviations).sum()
        + 0.5 * LEFT_OUT_SIGMAS**2 * left_out
        + 0.5 * (tilt / problem.up.deviation_deg) ** 2
        + known
        + costs
    )
