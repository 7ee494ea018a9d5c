"""Clusters anchors by position and visibility (eq. 5), plainly or into clusters of about equal size.

Anchors come in a canonical order (`partition_scene`): results do not depend on the order of the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Int64

from vdgs.config.method import PartitionConfig
from vdgs.errors import VdgsError
from vdgs.visibility.visibility_counts import normalize_visibility

#: Centers are fitted to at most so many anchors; all others join the nearest.
MAX_FIT_SAMPLES = 300_000
#: k-means++ starts, of which the one of least inertia is kept; fewer where there are so many clusters that each costs
#: much and tells little (clusters of all starts together).
NUM_RESTARTS, MAX_RESTARTED_CLUSTERS = 8, 512

#: Anchors that are looked at first for being distinct.
MAX_COMPARED = 5_000

#: Balanced clusters: anchors fitted to (at least, and for each cluster), Lloyd rounds, sweeps over the weights.
BALANCED_MIN_SAMPLES, BALANCED_SAMPLES_PER_CLUSTER = 30_000, 4_000
#: ... and at most so many distances from them to centers.
BALANCED_MAX_DISTANCES = 100_000_000
BALANCED_ITERATIONS, BALANCED_SWEEPS = 30, 10
BALANCED_TOLERANCE = 0.01
#: Distances from features to centers that are in memory at once.
DISTANCES_PER_CHUNK = 3_200_000
#: The nearest share of the anchors decides about the axes: far outliers would turn them.
INLIER_SHARE = 0.98
NUM_ITERATIONS = 3


def clustering_features(
    points: Float[np.ndarray, "n 2"], visibility: Int64[np.ndarray, " n"], config: PartitionConfig
) -> Float[np.ndarray, "n 3"]:
    """f_i = [x̂_i, ŷ_i, λ_vis V̂_i] (eq. 5), float64; x̂ and ŷ in [0, 1], clipped at the quantiles.

    Each is in units of its own extent or, with `cluster_scale` common, both in units of the larger one.
    """
    clip_quantile, lambda_vis = config.cluster_clip, config.lambda_vis
    low, high = np.quantile(points, (clip_quantile, 1 - clip_quantile), axis=0)
    extent = np.where(high > low, high - low, 1.0)
    unit = np.clip((points - low) / extent, 0.0, 1.0)
    if config.cluster_scale == "common" and (high > low).any():
        unit *= (high - low) / (high - low).max()
    # Not 0 * V̂: without weight the visibility must leave no trace, not even -0.0.
    third = lambda_vis * normalize_visibility(visibility) if lambda_vis else np.zeros(len(points))
    return np.column_stack([unit, third])


def cluster_anchors(
    features: Float[np.ndarray, "n 3"], count: int, seed: int, balanced: bool
) -> Int64[np.ndarray, " n"]:
    """Labels 0..count-1 by k-means++ (choice; the paper does not name its clustering).

    `balanced`: sizes within a few per cent of n / count, by a power diagram (choice).
    The same seed gives the same labels, whatever the number of threads. Raises VdgsError if there are fewer distinct
    anchors than clusters.
    """
    check_distinct(count, features)
    centers = _fit(_subsample(features, MAX_FIT_SAMPLES), count, seed)
    weights = np.zeros(count)
    if balanced:
        most = min(
            max(BALANCED_MIN_SAMPLES, BALANCED_SAMPLES_PER_CLUSTER * count), max(BALANCED_MAX_DISTANCES // count, count)
        )
        sample = _subsample(features, most)
        centers, weights = _fit_balanced(sample, centers)
    return _assign_clusters(features, centers, weights)


def check_distinct(count: int, rows: Float[np.ndarray, "n d"]) -> None:
    """Raises VdgsError if fewer than `count` of the rows are distinct."""
    # Nearly always a few thousand rows show it; sorting millions would take seconds.
    if len(np.unique(_subsample(rows, MAX_COMPARED), axis=0)) >= count:
        return
    distinct = len(np.unique(rows, axis=0))
    if distinct < count:
        raise VdgsError(
            f"{count} blocks: the scene has only {distinct} distinct anchors to cut into blocks. "
            f"Ask for at most {distinct}, or for 1."
        )


def _subsample(features: np.ndarray, max_count: int) -> np.ndarray:
    return features[:: -(-len(features) // max_count)]


def _fit(features: np.ndarray, count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    # Imported here: it takes a second, which commands that do not cluster should not pay.
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    # One thread: sums of several threads differ in their last bits from run to run.
    with threadpool_limits(1):
        restarts = max(1, min(NUM_RESTARTS, MAX_RESTARTED_CLUSTERS // count))
        return KMeans(count, n_init=restarts, random_state=seed, copy_x=True).fit(features).cluster_centers_


def _fit_balanced(
    features: np.ndarray, centers: np.ndarray
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, " count"]]:
    """Lloyd's rounds in which every center takes the same number of features; centers and weights w of the diagram.

    A feature belongs to the center of least |f - c|² - w.
    """
    weights = np.zeros(len(centers))
    for _ in range(BALANCED_ITERATIONS):
        squares = _squared_distances(features, centers)
        weights = _balance(squares, weights)
        labels = (squares - weights).argmin(axis=1)
        sizes = np.bincount(labels, minlength=len(centers))
        sums = np.column_stack([np.bincount(labels, axis, len(centers)) for axis in features.T])
        moved = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centers)
        still = np.abs(moved - centers).max() < 1e-4
        centers = moved
        if still:
            break
    return centers, _balance(_squared_distances(features, centers), weights)


def _balance(squares: np.ndarray, weights: np.ndarray) -> Float[np.ndarray, " count"]:
    """Weights that give every center n / count features: exact steps, one center after the other (an auction).

    In its step a center takes the weight at which exactly its share prefers it to the best of the others.
    """
    n, count = squares.shape
    share, weights, columns = n // count, weights.copy(), np.asfortranarray(squares)
    costs = squares - weights
    labels, least = costs.argmin(axis=1), costs.min(axis=1)
    for _ in range(BALANCED_SWEEPS * count):
        sizes = np.bincount(labels, minlength=count)
        worst = int(np.abs(sizes - share).argmax())
        if abs(sizes[worst] - share) <= max(BALANCED_TOLERANCE * share, 1):
            break
        # One weight changes: all costs are looked at again only of features that prefer its center.
        own = np.flatnonzero(labels == worst)
        costs = squares[own] - weights
        costs[:, worst] = np.inf
        labels[own], least[own] = costs.argmin(axis=1), costs.min(axis=1)  # now the best of the others everywhere
        margins = np.partition(columns[:, worst] - least, [share - 1, share])
        weights[worst] = (margins[share - 1] + margins[share]) / 2
        cost = columns[:, worst] - weights[worst]
        joins = (cost < least) | ((cost == least) & (worst < labels))
        labels[joins], least[joins] = worst, cost[joins]
    return weights - weights.mean()


def _squared_distances(features: np.ndarray, centers: np.ndarray) -> Float[np.ndarray, "n count"]:
    return np.stack([((features - center) ** 2).sum(axis=1) for center in centers], axis=1)


def _assign_clusters(features: np.ndarray, centers: np.ndarray, weights: np.ndarray) -> Int64[np.ndarray, " n"]:
    """The center of least |f - c|² - w, in chunks that keep memory small."""
    chunk = max(1, DISTANCES_PER_CHUNK // len(centers))
    parts = (features[start : start + chunk] for start in range(0, len(features), chunk))
    return np.concatenate([(_squared_distances(part, centers) - weights).argmin(axis=1) for part in parts])


@dataclass(frozen=True, eq=False)
class PrincipalPlane:
    """x, y of the ground frame = center + axes @ (place in the plane); `axes` is orthonormal, columns by variance."""

    center: Float[np.ndarray, "2"]
    axes: Float[np.ndarray, "2 2"]

    def to_plane(self, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Places of the ground frame in the principal axes."""
        return (ground - self.center) @ self.axes

    def to_ground(self, shape: shapely.Polygon) -> shapely.Polygon:
        """A polygon back in the ground frame."""
        return shapely.transform(shape, lambda places: places @ self.axes.T + self.center)


def ground_plane() -> PrincipalPlane:
    """The axes of the ground frame itself."""
    return PrincipalPlane(np.zeros(2), np.eye(2))


def fit_principal_plane(ground: Float[np.ndarray, "n 2"]) -> PrincipalPlane:
    """The principal axes of places (float64), each signed so that its third moment is positive.

    Choice: the paper clusters on x, y as they are; then the cut would change with the heading of the ground frame,
    which is arbitrary without GPS. Center and axes turn, move and scale with the places. In a scene that is its own
    mirror image the signs, and so the numbers of the blocks, are decided by rounding.
    """
    center = ground.mean(axis=0)
    kept = ground
    for _ in range(NUM_ITERATIONS):
        distance = np.linalg.norm(ground - center, axis=1)
        kept = ground[distance <= np.quantile(distance, INLIER_SHARE)]
        center = kept.mean(axis=0)
    local = kept - center
    _, axes = np.linalg.eigh(local.T @ local)
    axes = axes[:, ::-1]
    skew = ((local @ axes) ** 3).sum(axis=0)
    return PrincipalPlane(center, axes * np.where(skew < 0, -1.0, 1.0))
