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
    as the table's own method. Rounded to two digits; a method that failed gets none.

    Growth makes later iterations dearer, so that the times of a table at equal time differ somewhat: it shows them.
    Raises VdgsError for a scene where the method that sets the time has none.
    """
    factors = []
    for scene in plan.scenes:
        seconds = {
            method.name: summarize(
                each.figures.get("seconds") for each in results
                if (each.scene, each.method) == (scene.name, method.name)
            )
            for method in plan.methods
        }  # fmt: skip
        ours = seconds.get(plan.table.ours)
        if ours is None:
            raise VdgsError(
                f"{scene.name}: --equal time takes the time of `{plan.table.ours}` for all, which has none here. "
                f"Name it among --methods, and see why it failed."
            )
        for name, taken in seconds.items():
            if taken is not None and taken.mean > 0:
                factor = min(max(ours.mean / taken.mean, 1 / MAX_FACTOR), MAX_FACTOR)
                factors.append((scene.name, name, float(f"{factor:.2g}")))
    return tuple(factors)
