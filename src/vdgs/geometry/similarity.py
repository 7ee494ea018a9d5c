"""Similarities, and the one between two sets of matched points: least squares and robust."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

#: Points whose second principal spread is below this share of the first lie on one line.
MAX_COLLINEAR_RATIO = 0.02
#: Of so few points a robust standard deviation is no guide, as three of them fit anything. Points are left out there
#: where chance would let any as many stand out this seldom, and where each is so many standard deviations off (choice).
FEW_POINTS, SIGNIFICANT, OUTLIER_SIGMAS = 30, 0.0005, 7.0
#: One axis has a variance of its own where chance would make one of three so much worse this seldom (choice).
WORSE_AXIS = 0.005
#: A similarity of space has so many parameters.
PARAMETERS = 7
#: Fits to triples are compared by so many residuals at once: some tens of megabytes.
MOST_RESIDUALS = 1_000_000


@dataclass(frozen=True, eq=False)
class Similarity:
    """target = scale * rotation @ source + translation, all float64."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the source in the target."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_inverse(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of the target in the source."""
        return (points - self.translation) @ self.rotation / self.scale


def is_collinear(points: np.ndarray) -> bool:
    """Whether the points [n, 3] fix no rotation: fewer than three, or all near one line."""
    if len(points) < 3:
        return True
    return bool(_are_collinear(points))


def _are_collinear(points: np.ndarray) -> np.ndarray:
    """Of many sets of three points or more [..., n, 3]: [...] bool."""
    spread = np.linalg.svd(points - points.mean(axis=-2, keepdims=True), compute_uv=False)
    return np.asarray(spread[..., 1] <= MAX_COLLINEAR_RATIO * spread[..., 0])


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Least-squares similarity of matched points [n, 3] (Umeyama 1991, eqs. 40-43)."""
    scale, rotation, translation = _fits(source, target)
    return Similarity(float(scale), rotation, translation)


def _fits(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of many sets of points [..., n, 3] at once: scales [...], rotations [..., 3, 3], translations [..., 3]."""
    source_mean, target_mean = source.mean(axis=-2), target.mean(axis=-2)
    centered_source, centered_target = source - source_mean[..., None, :], target - target_mean[..., None, :]
    left, singular, right = np.linalg.svd(centered_target.swapaxes(-1, -2) @ centered_source)
    signs = np.ones_like(singular)
    signs[..., 2] = np.where(np.linalg.det(left) * np.linalg.det(right) < 0, -1.0, 1.0)
    rotation = (left * signs[..., None, :]) @ right
    scale = np.asarray((singular * signs).sum(axis=-1) / (centered_source**2).sum(axis=(-2, -1)))
    turned = (rotation @ source_mean[..., None])[..., 0]
    return scale, rotation, target_mean - scale[..., None] * turned


def fit_similarity_robust(
    source: np.ndarray, target: np.ndarray, num_iterations: int = 500
) -> tuple[Similarity, np.ndarray]:
    """Least median of squares over triples, all of them or seeded ones, then least squares over the inliers.

    Inliers lie within 3 robust standard deviations (1.4826 * median residual) of the best triple's fit, refined twice;
    of few points all are inliers but those that stand out by an F test. Returns the similarity and the inliers [n]
    bool. The draws are seeded by a constant, so that the same capture always gets the same frame.
    """
    best = fit_similarity(source, target)
    best_median = np.median(_residuals(best, source, target))
    triples = _triples(len(source), num_iterations)
    triples = triples[~_are_collinear(source[triples])]
    at_once = max(1, MOST_RESIDUALS // len(source))
    for few in (triples[k : k + at_once] for k in range(0, len(triples), at_once)):
        scales, rotations, translations = _fits(source[few], target[few])
        placed = scales[:, None, None] * (source @ rotations.swapaxes(1, 2)) + translations[:, None]
        medians = np.median(np.linalg.norm(placed - target, axis=2), axis=1)
        k = int(medians.argmin())
        if medians[k] < best_median:
            best, best_median = Similarity(float(scales[k]), rotations[k], translations[k]), medians[k]
    # The floor keeps exact data (residuals 0) from losing points to rounding.
    floor = 1e-9 * (1 + np.abs(target).max())
    if len(source) <= FEW_POINTS:
        inliers = _without_outliers(source, target, best, floor)
        return fit_similarity(source[inliers], target[inliers]), inliers
    inliers = np.ones(len(source), bool)
    for _ in range(3):
        residuals = _residuals(best, source, target)
        inliers = residuals <= max(3 * 1.4826 * float(np.median(residuals)), floor)
        if is_collinear(source[inliers]):
            return fit_similarity(source, target), np.ones(len(source), bool)
        best = fit_similarity(source[inliers], target[inliers])
    return best, inliers


def _triples(count: int, most: int) -> np.ndarray:
    """All triples of so many points where they are not more than `most`, else so many draws: [m, 3] int."""
    if comb(count, 3) <= most:
        return np.array(list(combinations(range(count), 3)), int).reshape(-1, 3)
    generator = np.random.default_rng(0)
    return np.array([generator.choice(count, size=3, replace=False) for _ in range(most)])


@dataclass(frozen=True)
class _Left:
    """What a similarity to some points leaves of them."""

    squares: float
    """Summed over points and axes; infinite where the points fix no similarity."""
    worst: float = 0.0
    """Those along the axis that has most."""
    nearest: float = 0.0
    """How far the nearest of the other points is from it."""

    def variance(self, count: int, floor: float) -> tuple[float, float]:
        """Of the worst axis of so many points, and how many observations are free to tell it: those of all axes, unless
        that one is plainly worse than the others, as heights are where a model is bent."""
        free = 3 * count - PARAMETERS
        alone, rest = 3 * self.worst / free, 1.5 * max(self.squares - self.worst, floor**2) / free
        if 3 * fdtrc(free / 3, 2 * free / 3, alone / rest) < WORSE_AXIS:
            return max(alone, floor**2), free / 3
        return max(alone, floor**2 / free), free


def _without_outliers(source: np.ndarray, target: np.ndarray, start: Similarity, floor: float) -> np.ndarray:
    """All of few points, [n] bool, but for the fewest of them after which no more stand out by an F test.

    For each number of points those count that least trimmed squares keep, begun at `start` and at one point more.
    """
    count = len(source)
    kept = [np.ones(count, bool)]
    left = [_left(source, target, kept[0])]
    for number in range(count - 1, max(3, count // 2), -1):
        begun = (start, fit_similarity(source[kept[-1]], target[kept[-1]]))
        found = [_trimmed(source, target, each, number) for each in begun]
        facts = [_left(source, target, each) for each in found]
        best = min((0, 1), key=lambda k: facts[k].squares)
        kept.append(found[best])
        left.append(facts[best])

    def stand_out(few: int, more: int) -> bool:
        variance, free = left[more].variance(count - more, floor)
        changed = 3 * (more - few)
        ratio = (left[few].squares - left[more].squares) / changed / variance
        chance = comb(count - few, more - few) * fdtrc(changed, free, max(0.0, ratio))
        return bool(chance < SIGNIFICANT and left[more].nearest > OUTLIER_SIGMAS * np.sqrt(variance))

    numbers = range(len(kept))
    return next(kept[few] for few in numbers if not any(stand_out(few, more) for more in numbers[few + 1 :]))


def _trimmed(source: np.ndarray, target: np.ndarray, start: Similarity, number: int) -> np.ndarray:
    """So many points, [n] bool, that a similarity fits with least squares: those nearest to the fit, again and again
    (the concentration steps of least trimmed squares)."""
    kept = np.ones(len(source), bool)
    for _ in range(10):
        before, kept = kept, np.zeros(len(source), bool)
        kept[np.argsort(_residuals(start, source, target), kind="stable")[:number]] = True
        if (kept == before).all():
            break
        start = fit_similarity(source[kept], target[kept])
    return kept


def _left(source: np.ndarray, target: np.ndarray, kept: np.ndarray) -> _Left:
    if is_collinear(source[kept]):
        return _Left(float("inf"))
    off = fit_similarity(source[kept], target[kept]).apply(source) - target
    squares = np.linalg.eigvalsh(off[kept].T @ off[kept])
    others = np.linalg.norm(off[~kept], axis=1)
    return _Left(float(squares.sum()), float(squares[-1]), float(others.min(initial=np.inf)))


def _residuals(similarity: Similarity, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.norm(similarity.apply(source) - target, axis=1)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] with the least squared difference to a matrix; of a sum of rotations, their mean."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation [3, 3] that takes the unit vector `up` to z (half a turn about x for -z)."""
    x, y, z = up / np.linalg.norm(up)
    across = x * x + y * y
    if z < 0 and across < 1e-300:
        return np.diag([1.0, -1.0, -1.0])
    # 1 / (1 + z) without its cancellation near -z.
    a = 1 / (1 + z) if z >= 0 else (1 - z) / across
    return np.array([[1 - a * x * x, -a * x * y, -x], [-a * x * y, 1 - a * y * y, -y], [x, y, z]])


def geometric_median(points: np.ndarray, max_points: int = 20_000) -> np.ndarray:
    """The place [3] with the least summed distance to the points [n, 3] (Weiszfeld's iteration).

    Unlike a median per axis it turns and scales with the points, and unlike the mean a few strays do not
    move it. More than `max_points` points are thinned evenly.
    """
    sample = points[:: max(1, -(-len(points) // max_points))]
    center = np.median(sample, axis=0)
    for _ in range(200):
        distance = np.linalg.norm(sample - center, axis=1)
        weight = 1 / np.maximum(distance, 1e-12 * (distance.max() or 1.0))
        moved = weight @ sample / weight.sum()
        if np.linalg.norm(moved - center) <= 1e-12 * (distance.max() or 1.0):
            return moved
        center = moved
    return center


def sample_points(points: np.ndarray, max_points: int) -> np.ndarray:
    """At most `max_points` of the points [n, 3], drawn without replacement with a fixed seed."""
    if len(points) <= max_points:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), max_points, replace=False))]


def rotation_about(vector: np.ndarray) -> np.ndarray:
    """The rotation about a vector by its length in radians (Rodrigues), [3, 3]."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
