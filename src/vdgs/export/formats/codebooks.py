"""Few values for many numbers: what SOG's images point into."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

#: Entries of a codebook of numbers.
CODEBOOK_SIZE = 256
#: So many rows are enough to learn from.
SAMPLE_ROWS = 1 << 16
LLOYD_ITERATIONS = 20


def fit_codebook(sample: Float[np.ndarray, " n"], low: float, high: float) -> Float[np.ndarray, "256"]:
    """256 ascending values with small squared distances to numbers (Lloyd's iteration on sorted numbers), learnt from a
    sample of them and from the least and the largest of all: the few that the sample lacks are not cut off."""
    numbers = np.sort(np.append(sample.astype(np.float64), [low, high]))
    # Half by rank, half by place: crowds are told apart, and what is rare is not rounded far.
    ranks = np.quantile(numbers, (np.arange(CODEBOOK_SIZE // 2) + 0.5) / (CODEBOOK_SIZE // 2))
    entries = np.sort(np.concatenate([ranks, np.linspace(numbers[0], numbers[-1], CODEBOOK_SIZE - len(ranks))]))
    sums = np.concatenate([[0.0], np.cumsum(numbers)])
    for _ in range(LLOYD_ITERATIONS):
        edges = np.concatenate([[0], np.searchsorted(numbers, (entries[1:] + entries[:-1]) / 2), [len(numbers)]])
        held = np.diff(edges)
        entries = np.where(held > 0, np.diff(sums[edges]) / np.maximum(held, 1), entries)
    return np.sort(entries).astype(np.float32)


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
