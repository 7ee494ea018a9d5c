"""Which photographs are matched with which: near ones, the next in order, and those that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import cKDTree
    from sklearn.cluster import MiniBatchKMeans

#: Of those nearest in the plane, so many must be farther above or below than beside to be a facade's (choice).
FACADE_SHARE = 0.75
#: Cameras that look less than this apart show the same (degrees); SIFT follows no farther.
MAX_VIEW_ANGLE_DEG = 30.0
#: A place is shared by those nearer than this share of how far the nearest reach, and only by so many (choice).
SHARED_RADIUS_SHARE, MIN_SHARED = 0.1, 4
#: Where places are shared, so many times more are asked for; what is asked for is sought among so many times more
#: nearest ones (choice).
SHARED_NEIGHBOR_FACTOR, SEARCH_FACTOR = 3, 5
#: With positions: so many that follow in order of time too, where a position is wrong.
SEQUENTIAL_OVERLAP_WITH_GPS = 2
#: Without: so many that follow, and at distances that double, up to so many more.
SEQUENTIAL_OVERLAP, QUADRATIC_OVERLAP = 6, 6
#: Photographs that look alike, asked for each.
NUM_RETRIEVED = 12
#: Words of the vocabulary of looks, and descriptors that it is made of.
VOCABULARY_SIZE, VOCABULARY_SAMPLE = 48, 40_000


def spatial_pairs(
    positions: np.ndarray, num_neighbors: int, directions: np.ndarray | None = None
) -> set[tuple[int, int]]:
    """Pairs of those nearest to each other in the plane, and of others where those show little of the same.

    places [n, 3] in metres, NaN where unknown; views [n, 3], unit vectors of where the cameras look, NaN where unknown.
    More are asked for, the nearest first, where most of those nearest in the plane are farther above or below than
    beside (a facade: then the nearest in space), where most of them look another way (then those that look the same
    way), and where several that may look the same way share a place (then `SHARED_NEIGHBOR_FACTOR` as many).
    """
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if len(known) < 2:
        return set()
    spots, plane = positions[known], cKDTree(positions[known, :2])
    away, first = _nearest(plane, spots[:, :2], num_neighbors)
    chosen = _pairs(np.arange(len(known)), first, np.ones(first.shape, bool))
    radius = away[:, -1]
    upright = np.quantile(np.abs(spots[first, 2] - spots[:, None, 2]), 1 - FACADE_SHARE, axis=1) > radius
    away, wider = _nearest(plane, spots[:, :2], SEARCH_FACTOR * num_neighbors)
    if upright.any():
        away[upright], wider[upright] = _nearest(cKDTree(spots), spots[upright], SEARCH_FACTOR * num_neighbors)
        radius[upright] = away[upright, first.shape[1] - 1]
    looks = np.full(spots.shape, np.nan) if directions is None else directions[known]
    same_way = ~(
        np.einsum("nki,ni->nk", looks[wider], looks) < np.cos(np.radians(MAX_VIEW_ANGLE_DEG))
    )  # unknown: the same
    turned = same_way[:, : first.shape[1]].mean(axis=1) < 0.5
    apart = np.linalg.norm(spots[wider] - spots[:, None], axis=2)
    sharing = (same_way & (apart <= SHARED_RADIUS_SHARE * radius[:, None])).sum(axis=1)  # itself too
    shared = np.median(sharing[first], axis=1) >= MIN_SHARED
    more = np.flatnonzero(upright | turned | shared)
    asked = num_neighbors * np.where(shared, SHARED_NEIGHBOR_FACTOR, 1) + 1
    taken = same_way & (np.cumsum(same_way, axis=1) <= asked[:, None])
    chosen |= _pairs(more, wider[more], taken[more])
    return {_pair(int(known[i]), int(known[j])) for i, j in chosen if i != j}


def _nearest(tree: cKDTree, at: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances and numbers of so many nearest besides itself, the nearest first, [m, count + 1] or all there are."""
    away, found = tree.query(at, k=range(1, min(count + 1, tree.n) + 1))
    return away, found


def _pairs(rows: np.ndarray, found: np.ndarray, taken: np.ndarray) -> set[tuple[int, int]]:
    """Pairs of `rows` [m] with those `found` for each [m, k] that are `taken` [m, k]."""
    row, column = np.nonzero(taken)
    return set(zip(rows[row].tolist(), found[row, column].tolist(), strict=True))


def sequential_pairs(order: Sequence[int], overlap: int, quadratic_overlap: int = 0) -> set[tuple[int, int]]:
    """Pairs of each with those that follow it in order, and with those at distances that double."""
    steps = {*range(1, overlap + 1), *(overlap * 2**k for k in range(1, quadratic_overlap + 1))}
    return {_pair(order[i], order[i + step]) for step in steps for i in range(len(order) - step)}


def exhaustive_pairs(count: int) -> set[tuple[int, int]]:
    return set(combinations(range(count), 2))


def retrieval_pairs(descriptors: Sequence[np.ndarray], queries: Sequence[int]) -> set[tuple[int, int]]:
    """Pairs of the photographs `asking` with those whose features look most alike; descriptors [m, 128] of each.

    Features are counted by their nearest word and summed as differences from it (VLAD, Jégou et al. 2010).
    """
    from sklearn.cluster import MiniBatchKMeans  # here: the look before the work does without these seconds

    usable = [i for i, each in enumerate(descriptors) if len(each)]
    if len(usable) < 2:
        return set()
    rng = np.random.default_rng(0)
    share = max(1, VOCABULARY_SAMPLE // len(usable))
    drawn = [descriptors[i][rng.permutation(len(descriptors[i]))[:share]] for i in usable]
    sample = np.concatenate(drawn).astype(np.float32)
    words = MiniBatchKMeans(min(VOCABULARY_SIZE, len(sample)), random_state=0, n_init=1).fit(sample)
    looks = np.stack([_vlad_descriptor(part.astype(np.float32), words) for part in drawn])
    likeness = looks @ looks.T
    np.fill_diagonal(likeness, -np.inf)
    pairs = set()
    for i in queries:
        if i in usable:
            row = likeness[usable.index(i)]
            pairs |= {
                _pair(i, usable[int(j)]) for j in np.argsort(-row, kind="stable")[: min(NUM_RETRIEVED, len(usable) - 1)]
            }
    return pairs


def _vlad_descriptor(features: np.ndarray, words: MiniBatchKMeans) -> np.ndarray:
    centers, nearest = words.cluster_centers_, words.predict(features)
    sums = np.zeros_like(centers, dtype=np.float64)
    np.add.at(sums, nearest, features - centers[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _pair(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
