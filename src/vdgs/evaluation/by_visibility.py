"""Quality by visibility: the claim is about poorly seen places, so it is measured there.

V is the number of training cameras that see a point (section IV-B); rendered per pixel it is a map [h, w], NaN where
the model shows nothing, rounded to whole cameras. Pixels of all test views are pooled in a histogram and cut into
quantiles of V.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from vdgs.evaluation.metrics import psnr_from_mse

#: Equal shares of pixels (or views) reported by default: quintiles.
DEFAULT_BINS = 5
#: Sign, exponent and 11 bits of mantissa of a float32 remain: counts up to 4096 stay exact, fractions
#: to 1 in 2,000, and no range need be known beforehand. The bits of non-negative floats sort as numbers.
_DROPPED_BITS = 12
NUM_KEYS = 1 << (31 - _DROPPED_BITS)

VisibilityBin = dict[str, float | int | None]


class VisibilityHistogram:
    """Sums of named pixel values by visibility; `add` each test view, then read `bins`.

    Names that begin with `squared_error` are reported as `psnr...`; the others as their mean.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._counts = np.zeros(NUM_KEYS, np.int64)
        self._sums = {name: np.zeros(NUM_KEYS) for name in names}
        self._empty_count = 0
        self._empty_sums = dict.fromkeys(names, 0.0)

    def add(
        self,
        visibility: Float[np.ndarray, "h w"],
        values: Mapping[str, Float[np.ndarray, "h w"]],
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Count one view: V >= 0 or NaN, and a value per pixel under each name. O(pixels).

        V counts cameras: a mean over the anchors that a pixel shows is rounded to whole ones, halves to the even one.
        """
        kept = np.ones(visibility.shape, bool) if mask is None else mask
        empty = kept & np.isnan(visibility)
        seen = kept & ~empty
        keys = histogram_keys(np.rint(visibility[seen]))
        self._counts += np.bincount(keys, minlength=NUM_KEYS)
        self._empty_count += int(empty.sum())
        for name, total in self._sums.items():
            total += np.bincount(keys, weights=values[name][seen], minlength=NUM_KEYS)
            self._empty_sums[name] += float(values[name][empty].sum())

    def merge(self, other: VisibilityHistogram) -> None:
        """Add another's sums. Merged view by view, in their order, sums have the bits of one histogram of all views."""
        keys = np.flatnonzero(other._counts)
        self._counts[keys] += other._counts[keys]
        self._empty_count += other._empty_count
        for name, total in self._sums.items():
            total[keys] += other._sums[name][keys]
            self._empty_sums[name] += other._empty_sums[name]

    @property
    def names(self) -> list[str]:
        return [*self._sums]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The counts that are not zero, for files."""
        keys = np.flatnonzero(self._counts)
        return {
            "names": np.array(self.names, np.str_), "keys": keys, "counts": self._counts[keys],
            "sums": np.stack([total[keys] for total in self._sums.values()]),
            "empty_count": np.array(self._empty_count), "empty_sums": np.array([*self._empty_sums.values()]),
        }  # fmt: skip

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> VisibilityHistogram:
        """The inverse of `to_arrays`."""
        found = cls([str(name) for name in arrays["names"]])
        found._counts[arrays["keys"]] = arrays["counts"]
        found._empty_count = int(arrays["empty_count"])
        for name, sums, empty in zip(found.names, arrays["sums"], arrays["empty_sums"], strict=True):
            found._sums[name][arrays["keys"]] = sums
            found._empty_sums[name] = float(empty)
        return found

    def bins(self, n_bins: int = DEFAULT_BINS) -> list[VisibilityBin]:
        """Quantile bins, least visible first: lower and upper V (whole, inclusive), pixels, a figure per name.

        Equal values of V are never split, so bins may differ in size and fewer than `n_bins` may come
        back. Pixels where the model shows nothing, if any, lead as a bin without bounds (both None).
        """
        result: list[VisibilityBin] = []
        if self._empty_count:
            result.append(self._bin(None, None, self._empty_count, self._empty_sums))
        keys = np.flatnonzero(self._counts)
        for group in quantile_groups(self._counts[keys], n_bins):
            chosen = keys[group]
            sums = {name: float(total[chosen].sum()) for name, total in self._sums.items()}
            lower, upper = histogram_values(chosen[[0, -1]])
            result.append(self._bin(float(lower), float(upper), int(self._counts[chosen].sum()), sums))
        return result

    def bins_at(self, edges: Sequence[float]) -> list[VisibilityBin]:
        """As `bins`, cut at given values; a bin holds its lower edge, and the last one is open (upper: None)."""
        keys, found = np.flatnonzero(self._counts), []
        place = np.searchsorted(np.asarray(edges), histogram_values(keys), side="right")
        for index, (lower, upper) in enumerate(zip((0.0, *edges), (*edges, None), strict=True)):
            chosen = keys[place == index]
            if len(chosen):
                sums = {name: float(total[chosen].sum()) for name, total in self._sums.items()}
                found.append(self._bin(lower, upper, int(self._counts[chosen].sum()), sums))
        return found

    @staticmethod
    def _bin(lower: float | None, upper: float | None, pixels: int, sums: Mapping[str, float]) -> VisibilityBin:
        figures: VisibilityBin = {"lower": lower, "upper": upper, "pixels": pixels}
        for name, total in sums.items():
            is_error = name.startswith("squared_error")
            key = name.replace("squared_error", "psnr", 1)
            figures[key] = psnr_from_mse(total / pixels) if is_error else total / pixels
        return figures


def view_bins(
    visibility: Sequence[float], figures: Sequence[Mapping[str, float | None]], n_bins: int = DEFAULT_BINS
) -> list[VisibilityBin]:
    """Quantile bins of whole test views by the mean V of what each sees, and their mean figures.

    Each figure is the mean over the views of the bin that have it (None where none has). Views without
    a finite visibility are left out.
    """
    visible = np.asarray(visibility, dtype=np.float64)
    order = [int(i) for i in np.argsort(visible, kind="stable") if np.isfinite(visible[i])]
    values, counts = np.unique(visible[order], return_counts=True)
    ends = np.concatenate([[0], np.cumsum(counts)])
    result: list[VisibilityBin] = []
    for group in quantile_groups(counts, n_bins):
        members = order[ends[group[0]] : ends[group[-1] + 1]]
        bounds = {"lower": float(values[group[0]]), "upper": float(values[group[-1]]), "views": len(members)}
        means = {name: mean_or_none([figures[i][name] for i in members]) for name in figures[members[0]]}
        result.append({**bounds, **means})
    return result


def format_bounds(lower: float, upper: float) -> str:
    """The least and the greatest V of a bin for people: `3 to 5`, or `4`."""
    return " to ".join(dict.fromkeys(f"{end:,.0f}" for end in (lower, upper)))


def mean_or_none(values: Sequence[float | None]) -> float | None:
    """Mean of the figures that are there (neither None nor NaN); None where none is."""
    known = [value for value in values if value is not None and not np.isnan(value)]
    return float(np.mean(known)) if known else None


def quantile_groups(counts: np.ndarray, n_bins: int) -> list[np.ndarray]:
    """Consecutive indices of ascending classes of `counts` members [n], cut into about equal shares.

    A class belongs to the share that holds its middle member; shares that hold none are left out.
    """
    if not len(counts):
        return []
    middle = np.cumsum(counts) - counts / 2.0
    share = np.minimum((middle / counts.sum() * n_bins).astype(np.int64), n_bins - 1)
    return [np.flatnonzero(share == each) for each in np.unique(share)]


def histogram_keys(values: np.ndarray) -> np.ndarray:
    """The bin of each non-negative number (infinity too) in a histogram of NUM_KEYS bins, in ascending order."""
    # Adding zero turns a negative zero, whose bits would be a huge key, into a positive one.
    positive = np.maximum(values, 0.0).astype(np.float32) + np.float32(0.0)
    return (positive.view(np.uint32) >> _DROPPED_BITS).astype(np.int64)


def histogram_values(keys: np.ndarray) -> np.ndarray:
    """The least number, float32, of each bin."""
    return (keys.astype(np.uint32) << _DROPPED_BITS).view(np.float32)
