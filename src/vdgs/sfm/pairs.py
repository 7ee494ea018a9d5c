"""Which photographs are matched with which: near ones, the next in order, and those that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sklearn.cluster import MiniBatchKMeans

#: With positions: so many that follow in order of time too, where a position is wrong.
NEXT_WITH_POSITIONS = 2
#: Without: so many that follow, and at distances that double, up to so many more.
NEXT, DOUBLINGS = 6, 6
#: Photographs that look alike, asked for each.
ALIKE = 12
#: Words of the vocabulary of looks, and descriptors that it is made of.
WORDS, SAMPLE = 48, 40_000


def near(places: np.ndarray, neighbours: int) -> set[tuple[int, int]]:
    """Pairs of those nearest to each other in the plane; places [n, 3] metres, NaN where unknown."""
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if len(known) < 2:
        return set()
    count = min(neighbours + 1, len(known))
    _, found = cKDTree(places[known, :2]).query(places[known, :2], k=count)
    return {
        _pair(int(known[i]), int(known[j]))
        for i, row in enumerate(found.reshape(len(known), -1))
        for j in row
        if i != j
    }


def in_order(order: Sequence[int], following: int, doublings: int = 0) -> set[tuple[int, int]]:
    """Pairs of each with those that follow it in order, and with those at distances that double."""
    steps = {*range(1, following + 1), *(following * 2**k for k in range(1, doublings + 1))}
    return {_pair(order[i], order[i + step]) for step in steps for i in range(len(order) - step)}


def everyone(count: int) -> set[tuple[int, int]]:
    return set(combinations(range(count), 2))


def alike(descriptors: Sequence[np.ndarray], asking: Sequence[int]) -> set[tuple[int, int]]:
    """Pairs of the photographs `asking` with those whose features look most alike; descriptors [m, 128] of each.

    Features are counted by their nearest word and summed as differences from it (VLAD, Jégou et al. 2010).
    """
    from sklearn.cluster import MiniBatchKMeans  # here: the look before the work does without these seconds

    usable = [i for i, each in enumerate(descriptors) if len(each)]
    if len(usable) < 2:
        return set()
    rng = np.random.default_rng(0)
    share = max(1, SAMPLE // len(usable))
    drawn = [descriptors[i][rng.permutation(len(descriptors[i]))[:share]] for i in usable]
    sample = np.concatenate(drawn).astype(np.float32)
    words = MiniBatchKMeans(min(WORDS, len(sample)), random_state=0, n_init=1).fit(sample)
    looks = np.stack([_look(part.astype(np.float32), words) for part in drawn])
    likeness = looks @ looks.T
    np.fill_diagonal(likeness, -np.inf)
    pairs = set()
    for i in asking:
        if i in usable:
            row = likeness[usable.index(i)]
            pairs |= {_pair(i, usable[int(j)]) for j in np.argsort(-row, kind="stable")[: min(ALIKE, len(usable) - 1)]}
    return pairs


def _look(features: np.ndarray, words: MiniBatchKMeans) -> np.ndarray:
    centres, nearest = words.cluster_centers_, words.predict(features)
    sums = np.zeros_like(centres, dtype=np.float64)
    np.add.at(sums, nearest, features - centres[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    flat = sums.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _pair(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)
