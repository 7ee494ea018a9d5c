"""Few values for many numbers: what SOG's images point into."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

#: Entries of a codebook of numbers.
CODEBOOK_SIZE = 256
#: So many rows are enough to learn from.
SAMPLE_ROWS = 1 << 16
LLOYD_ITERATIONS = 20


def learn_codebook(
    sample: Float[np.ndarray, "m *shape"], parts: Iterable[Float[np.ndarray, "n *shape"]]
) -> Float[np.ndarray, "256"]:
    """256 ascending values for numbers of which a sample is at hand, and all in parts: those that the codebook of the
    sample would round farther than any of the sample are learnt from too."""
    entries = fit_codebook(sample.ravel())
    worst = _rounding(sample.ravel(), entries).max()
    missed = [part.ravel()[_rounding(part.ravel(), entries) > worst] for part in parts]
    return fit_codebook(np.concatenate([sample.ravel(), *missed])) if any(map(len, missed)) else entries


def fit_codebook(numbers: Float[np.ndarray, " n"]) -> Float[np.ndarray, "256"]:
    """256 ascending values with small squared distances to numbers (Lloyd's iteration on sorted numbers). An entry that
    no number is next to halves the cell with the largest error: voids before the few that are far away hold none."""
    numbers = np.sort(numbers.astype(np.float64))
    # Half by rank, half by place: crowds are told apart, and what is rare is not rounded far. A void is two steps.
    ranks = np.quantile(numbers, (np.arange(CODEBOOK_SIZE // 2) + 0.5) / (CODEBOOK_SIZE // 2))
    gaps = np.minimum(np.diff(numbers), 2 * (ranks[-1] - ranks[0]) / len(ranks))
    along = np.concatenate([[0.0], np.cumsum(gaps)])
    places = np.interp(np.linspace(0.0, along[-1], CODEBOOK_SIZE - len(ranks)), along, numbers)
    entries = np.sort(np.concatenate([ranks, places]))
    sums = np.concatenate([[0.0], np.cumsum(numbers)])
    for _ in range(LLOYD_ITERATIONS):
        edges = np.concatenate([[0], np.searchsorted(numbers, (entries[1:] + entries[:-1]) / 2), [len(numbers)]])
        held = np.diff(edges)
        entries = np.where(held > 0, np.diff(sums[edges]) / np.maximum(held, 1), entries)
        cells = np.repeat(np.arange(CODEBOOK_SIZE), held)
        errors = np.bincount(cells, (numbers - entries[cells]) ** 2, CODEBOOK_SIZE)
        idle = np.flatnonzero(held == 0)
        split = np.argsort(-errors, kind="stable")[: min(len(idle), np.count_nonzero(errors))]
        half = np.sqrt(errors[split] / held[split])
        entries[idle[: len(split)]] = entries[split] + half
        entries[split] -= half
        entries.sort()
    return entries.astype(np.float32)


def _rounding(numbers: Float[np.ndarray, " n"], entries: Float[np.ndarray, "256"]) -> Float[np.ndarray, " n"]:
    distances: np.ndarray = np.abs(numbers - entries[quantize(numbers, entries)])
    return distances


def quantize(values: Float[np.ndarray, "*shape"], entries: Float[np.ndarray, "256"]) -> np.ndarray:
    """The index of the entry next to each number, uint8 of the same shape."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values).astype(np.uint8)


class VectorCodebook:
    """Rows that stand for all rows: k-means, seeded, learnt from a sample."""

    def __init__(self, sample: Float[np.ndarray, "n d"], max_count: int) -> None:
        from sklearn.cluster import MiniBatchKMeans  # slow to load, and few formats have palettes

        count = min(max_count, max(1, len(np.unique(sample, axis=0))))
        means = MiniBatchKMeans(count, batch_size=8192, n_init=1, max_iter=10, random_state=0, init="random",
                                reassignment_ratio=0.0)  # fmt: skip
        self.rows: np.ndarray = means.fit(sample).cluster_centers_.astype(np.float32)

    def nearest(self, rows: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
        """The palette's row next to each row."""
        squares = (self.rows**2).sum(1) / 2
        step = max(1, (1 << 25) // len(self.rows))
        parts = [(squares - rows[i : i + step] @ self.rows.T).argmin(1) for i in range(0, len(rows), step)]
        return np.concatenate(parts)
