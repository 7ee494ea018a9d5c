"""Mean and spread over seeds, and which of several are best."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Literal

Mark = Literal["", "best", "second"]


@dataclass(frozen=True)
class Summary:
    """Mean over `count` seeds; `spread` is their sample standard deviation, None for fewer than two."""

    mean: float
    spread: float | None
    count: int


def summarize(values: Iterable[float | None]) -> Summary | None:
    """None where no value is known. Unknown values (None, NaN) are left out."""
    known = [value for value in values if value is not None and not math.isnan(value)]
    if not known:
        return None
    return Summary(fmean(known), stdev(known) if len(known) > 1 else None, len(known))


def rank_marks(values: Sequence[float | None], digits: int, higher_is_better: bool = True) -> list[Mark]:
    """Best and second best of a column, as rounded to the digits that are shown; equals share a mark.

    A column with fewer than two known values has none.
    """
    shown = [None if value is None else round(value, digits) for value in values]
    ranked = sorted({value for value in shown if value is not None}, reverse=higher_is_better)
    if sum(value is not None for value in shown) < 2:
        return [""] * len(values)
    names: dict[float, Mark] = dict(zip(ranked, ("best", "second"), strict=False))  # type: ignore[arg-type]
    return ["" if value is None else names.get(value, "") for value in shown]


@dataclass(frozen=True)
class SeedDifference:
    """Of two methods over the seeds that both have: mean, the larger of their spreads (None: one seed), and the
    difference of each seed. Methods that share a coarse stage differ by far less than seeds do, so that a difference
    below the spread can still have the same sign in all of them."""

    mean: float
    spread: float | None
    by_seed: tuple[float, ...]

    @property
    def exceeds_spread(self) -> bool | None:
        """Above zero by more than the spread; None where one seed says nothing about it."""
        return None if self.spread is None else self.mean > self.spread


def paired_difference(ours: Mapping[int, float | None], theirs: Mapping[int, float | None]) -> SeedDifference | None:
    """Ours - theirs, by seed. None without a common seed."""
    pairs = [
        (value, other)
        for seed, value in ours.items()
        if value is not None and (other := theirs.get(seed)) is not None
    ]  # fmt: skip
    mine, others = (summarize(pair[side] for pair in pairs) for side in (0, 1))
    if mine is None or others is None:
        return None
    spreads = [each.spread for each in (mine, others) if each.spread is not None]
    by_seed = tuple(value - other for value, other in pairs)
    return SeedDifference(mine.mean - others.mean, max(spreads, default=None), by_seed)
