"""What the numbers say about the claim: better where few cameras look, not worse elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from experiments.bench.grids import bounds_of
from experiments.bench.plan import Plan
from experiments.bench.results import Result
from experiments.bench.statistics import Difference, difference, summarise

#: dB by which the full method may fall behind where many cameras look, and on even flights.
ALLOWED_DB = 0.1


@dataclass(frozen=True)
class Line:
    """A question about a scene, its answer (None: cannot be said), and the numbers."""

    scene: str
    question: str
    answer: bool | None
    numbers: str

    def __str__(self) -> str:
        word = {True: "yes", False: "NO", None: "not known"}[self.answer]
        return f"{self.scene}: {self.question}: {word} ({self.numbers})"


def verdict(plan: Plan, results: Sequence[Result]) -> list[Line]:
    """For each scene with the full method: uneven ones by group, even ones against the best."""
    lines = []
    ours = plan.table.ours
    foreign = {method.name for method in plan.methods if method.renders is not None}
    titles = {method.name: method.title + " (by another program)" * (method.name in foreign) for method in plan.methods}
    for scene in plan.scenes:
        mine = [result for result in results if result.scene == scene.name]
        fair = [
            method.name for method in plan.methods
            if method.name != ours and not method.more and _has_answer(plan, scene.name, method.name)
        ]  # fmt: skip
        others = [name for name in fair if not _same_runs(plan, scene.name, ours, name)]
        if ours not in titles or not others:
            continue
        if scene.uneven:
            lines += [line for other in others for line in _uneven(scene.title, mine, ours, other, titles)]
        else:
            # The best of those that had the same means.
            equal = [name for name in fair if name not in foreign]
            lines.append(_even(scene.title, mine, ours, {name: titles[name] for name in (ours, *equal)}))
    return lines


def _has_answer(plan: Plan, scene: str, method: str) -> bool:
    """Another program may have left no renders of a scene."""
    return any((scene, method, seed) in plan.answers for seed in plan.seeds)


def _same_runs(plan: Plan, scene: str, ours: str, other: str) -> bool:
    """Two rows of a sweep may have the same settings: nothing is to be compared."""
    return all(plan.answers.get((scene, ours, s)) == plan.answers.get((scene, other, s)) for s in plan.seeds)


def _uneven(scene: str, results: Sequence[Result], ours: str, other: str, titles: dict[str, str]) -> list[Line]:
    bounds = next((result.groups for result in results if result.groups), ())
    groups = len(bounds)
    least = _difference(results, ours, other, "psnr@0")
    best = _difference(results, ours, other, f"psnr@{groups - 1}")
    name = f"{titles[ours]} against {titles[other]}"
    if groups == 0 or least is None or best is None:
        return [Line(scene, name, None, "no common results")]
    more, fine = least.beyond_spread, best.mean >= -ALLOWED_DB
    poorly, well = (f"(V {bounds_of(bounds[end])})" for end in (0, -1))
    return [
        Line(scene, f"{name}, better where least seen {poorly} by more than the spread", more, _numbers(least)),
        Line(scene, f"{name}, at most {ALLOWED_DB} dB below where best seen {well}", fine, _numbers(best)),
    ]


def _even(scene: str, results: Sequence[Result], ours: str, titles: dict[str, str]) -> Line:
    means = {name: summarise(_by_seed(results, name, "psnr").values()) for name in titles}
    known = {name: each.mean for name, each in means.items() if each is not None}
    question = f"{titles[ours]} within {ALLOWED_DB} dB of the best (even coverage)"
    if ours not in known or len(known) < 2:
        return Line(scene, question, None, "no results to compare")
    best = max(known, key=lambda name: known[name])
    behind = known[best] - known[ours]
    return Line(
        scene, question, behind <= ALLOWED_DB, f"{known[ours]:.2f} dB, best {titles[best]} {known[best]:.2f} dB"
    )


def _difference(results: Sequence[Result], ours: str, other: str, key: str) -> Difference | None:
    return difference(_by_seed(results, ours, key), _by_seed(results, other, key))


def _by_seed(results: Sequence[Result], method: str, key: str) -> dict[int, float | None]:
    return {result.seed: result.figures.get(key) for result in results if result.method == method}


def _numbers(each: Difference) -> str:
    if each.spread is None:
        return f"{each.mean:+.2f} dB, one seed, spread unknown"
    seeds = ", ".join(f"{one:+.2f}" for one in each.by_seed)
    return f"{each.mean:+.2f} dB, spread {each.spread:.2f}, {len(each.by_seed)} seeds: {seeds}"
