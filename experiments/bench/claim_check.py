"""What the numbers say about the claim: better where few cameras look, not worse elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.bench.plan import BenchPlan
from experiments.bench.result_tables import group_bounds
from experiments.bench.results import BenchResult
from experiments.bench.statistics import SeedDifference, paired_difference, summarize

#: dB by which the full method may fall behind where many cameras look, and on even flights.
TOLERANCE_DB = 0.1


@dataclass(frozen=True)
class ClaimCheck:
    """A question about a scene, its answer (None: cannot be said), and the numbers."""

    scene: str
    question: str
    answer: bool | None
    numbers: str

    def __str__(self) -> str:
        word = {True: "yes", False: "NO", None: "not known"}[self.answer]
        return f"{self.scene}: {self.question}: {word} ({self.numbers})"


def check_claims(plan: BenchPlan, results: Sequence[BenchResult]) -> list[ClaimCheck]:
    """For each scene with the full method: uneven ones by group, even ones against the best."""
    claims = []
    ours = plan.table.ours
    external = {method.name for method in plan.methods if method.renders is not None}
    titles = {
        method.name: method.title + " (by another program)" * (method.name in external) for method in plan.methods
    }
    for scene in plan.scenes:
        in_scene = [result for result in results if result.scene == scene.name]
        fair = [
            method.name for method in plan.methods
            if method.name != ours and not method.more and _has_answer(plan, scene.name, method.name)
        ]  # fmt: skip
        others = [name for name in fair if not _same_runs(plan, scene.name, ours, name)]
        if ours not in titles or not others:
            continue
        if scene.uneven:
            claims += [claim for other in others for claim in _uneven(scene.title, in_scene, ours, other, titles)]
        else:
            # The best of those that had the same means.
            equal = [name for name in fair if name not in external]
            claims.append(_even(scene.title, in_scene, ours, {name: titles[name] for name in (ours, *equal)}))
    return claims


def _has_answer(plan: BenchPlan, scene: str, method: str) -> bool:
    """Another program may have left no renders of a scene."""
    return any((scene, method, seed) in plan.run_of for seed in plan.seeds)


def _same_runs(plan: BenchPlan, scene: str, ours: str, other: str) -> bool:
    """Two rows of a sweep may have the same settings: nothing is to be compared."""
    return all(plan.run_of.get((scene, ours, s)) == plan.run_of.get((scene, other, s)) for s in plan.seeds)


def _uneven(
    scene: str, results: Sequence[BenchResult], ours: str, other: str, titles: dict[str, str]
) -> list[ClaimCheck]:
    bounds = next((result.groups for result in results if result.groups), ())
    groups = len(bounds)
    least = _difference(results, ours, other, "psnr@0")
    best = _difference(results, ours, other, f"psnr@{groups - 1}")
    name = f"{titles[ours]} against {titles[other]}"
    if groups == 0 or least is None or best is None:
        return [ClaimCheck(scene, name, None, "no common results")]
    more, fine = least.exceeds_spread, best.mean >= -TOLERANCE_DB
    poorly, well = (f"(V {group_bounds(bounds[end])})" for end in (0, -1))
    return [
        ClaimCheck(scene, f"{name}, better where least seen {poorly} by more than the spread", more, _numbers(least)),
        ClaimCheck(scene, f"{name}, at most {TOLERANCE_DB} dB below where best seen {well}", fine, _numbers(best)),
    ]


def _even(scene: str, results: Sequence[BenchResult], ours: str, titles: dict[str, str]) -> ClaimCheck:
    means = {name: summarize(_by_seed(results, name, "psnr").values()) for name in titles}
    measured = {name: each.mean for name, each in means.items() if each is not None}
    question = f"{titles[ours]} within {TOLERANCE_DB} dB of the best (even coverage)"
    if ours not in measured or len(measured) < 2:
        return ClaimCheck(scene, question, None, "no results to compare")
    best = max(measured, key=lambda name: measured[name])
    behind = measured[best] - measured[ours]
    return ClaimCheck(
        scene, question, behind <= TOLERANCE_DB, f"{measured[ours]:.2f} dB, best {titles[best]} {measured[best]:.2f} dB"
    )


def _difference(results: Sequence[BenchResult], ours: str, other: str, key: str) -> SeedDifference | None:
    return paired_difference(_by_seed(results, ours, key), _by_seed(results, other, key))


def _by_seed(results: Sequence[BenchResult], method: str, key: str) -> dict[int, float | None]:
    return {result.seed: result.figures.get(key) for result in results if result.method == method}


def _numbers(each: SeedDifference) -> str:
    if each.spread is None:
        return f"{each.mean:+.2f} dB, one seed, spread unknown"
    seeds = ", ".join(f"{one:+.2f}" for one in each.by_seed)
    return f"{each.mean:+.2f} dB, spread {each.spread:.2f}, {len(each.by_seed)} seeds: {seeds}"
