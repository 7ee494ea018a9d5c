"""Methods at equal time: how many times the iterations of the table each may make, by what those took."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.bench.plan import BenchPlan
from experiments.bench.results import BenchResult
from experiments.bench.statistics import summarize
from vdgs.errors import VdgsError

#: No method gets more or fewer than so many times the iterations.
MAX_FACTOR = 20.0


def step_factors(plan: BenchPlan, results: Sequence[BenchResult]) -> tuple[tuple[str, str, float], ...]:
    """(scene, method, factor) for each method that trained: with so many times its iterations it takes about as long
    as the table's own method. What does not grow with them (stereo, V, cut, assignment, merging) is taken off first.
    Rounded to two digits; a method that failed gets none.

    Growth makes later iterations dearer, so that the times of a table at equal time differ somewhat: it shows them.
    Raises VdgsError for a scene where the method that sets the time has none.
    """
    factors = []
    for scene in plan.scenes:
        whole, fixed = (
            _mean_seconds(plan, results, scene.name, figure) for figure in ("seconds", "preparation_seconds")
        )
        ours = whole.get(plan.table.ours)
        if ours is None:
            raise VdgsError(
                f"{scene.name}: --equal time takes the time of `{plan.table.ours}` for all, which has none here. "
                "Name it among --methods, and see in table.md why there is none."
            )
        for name, taken in whole.items():
            before = fixed.get(name, 0.0)
            if taken > before:
                factor = min(max((ours - before) / (taken - before), 1 / MAX_FACTOR), MAX_FACTOR)
                factors.append((scene.name, name, float(f"{factor:.2g}")))
    return tuple(factors)


def _mean_seconds(plan: BenchPlan, results: Sequence[BenchResult], scene: str, figure: str) -> dict[str, float]:
    """By method, the mean over its seeds where any has this figure."""
    means = {
        method.name: summarize(
            each.figures.get(figure) for each in results if (each.scene, each.method) == (scene, method.name)
        )
        for method in plan.methods
    }
    return {name: found.mean for name, found in means.items() if found is not None}
