"""Which photographs are matched with which: near ones, the next in order, and those that look alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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
#: Words of the vocabulary of looks, and descriptors that it is made of, drawn from so many photographs.
VOCABULARY_SIZE, VOCABULARY_SAMPLE, VOCABULARY_PHOTOGRAPHS = 48, 40_000, 400
#: Photographs whose likeness to all others is held in memory at once.
_LIKENESS_ROWS = 256


def spatial_pairs(
    positions: np.ndarray, num_neighbors: int, directions: np.ndarray | None = None
) -> set[tuple[int, int]]:
    """Pairs of those nearest to each other in the plane, and of others where those show little of the same.

    `positions` [n, 3] in metres, NaN where unknown; `directions` [n, 3], unit vectors of where the cameras look, NaN
    where unknown.
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


def retrieval_pairs(
    descriptors_of: Callable[[int], np.ndarray], count: int, queries: Sequence[int]
) -> set[tuple[int, int]]:
    """Pairs of the photographs `queries` with those of all `count` whose features look most alike.

    `descriptors_of` reads the descriptors [m, 128] of a photograph, of one at a time: all are too many for memory. They
    are counted by their nearest word and summed as differences from it (VLAD, Jégou et al. 2010).
    """
    words = _vocabulary(descriptors_of, count)
    looks = np.zeros((count, words.size), np.float32)
    for i in range(count) if len(words) else ():
        looks[i] = _vlad_descriptor(descriptors_of(i).astype(np.float32), words)
    known = np.flatnonzero(looks.any(axis=1))
    looks, asking = looks[known], np.flatnonzero(np.isin(known, queries))
    pairs = set()
    for start in range(0, len(asking), _LIKENESS_ROWS):
        rows = asking[start : start + _LIKENESS_ROWS]
        likeness = looks[rows] @ looks.T
        likeness[np.arange(len(rows)), rows] = -np.inf  # itself
        nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(NUM_RETRIEVED, len(known) - 1)]
        pairs |= {_pair(int(i), int(j)) for i, row in zip(known[rows], known[nearest], strict=True) for j in row}
    return pairs


def _vocabulary(descriptors_of: Callable[[int], np.ndarray], count: int) -> np.ndarray:
    """Words [k, 128] of some descriptors of some photographs, the same in every run; none where there are none."""
    from sklearn.cluster import MiniBatchKMeans  # here: the look before the work does without these seconds

    rng = np.random.default_rng(0)
    chosen = np.sort(rng.permutation(count)[:VOCABULARY_PHOTOGRAPHS])
    share = -(-VOCABULARY_SAMPLE // max(1, len(chosen)))
    drawn = [np.zeros((0, 128), np.uint8)]
    for i in chosen.tolist():
        descriptors = descriptors_of(i)
        drawn.append(descriptors[rng.permutation(len(descriptors))[:share]])
    sample = np.concatenate(drawn).astype(np.float32)
    if not len(sample):
        return sample
    words = MiniBatchKMeans(min(VOCABULARY_SIZE, len(sample)), random_state=0, n_init=1).fit(sample)
    return np.asarray(words.cluster_centers_, np.float32)


def _vlad_descriptor(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """How a photograph looks [k * 128], a unit vector; 0 without descriptors."""
    nearest = np.argmin((words**2).sum(axis=1) - 2 * descriptors @ words.T, axis=1)
    of_word = (nearest == np.arange(len(words))[:, None]).astype(np.float32)
    sums = of_word @ descriptors - of_word.sum(axis=1, keepdims=True) * words
    flat = (np.sign(sums) * np.sqrt(np.abs(sums))).ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _pair(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
