"""What a table's readers must know beside its numbers, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.bench.claim_check import ClaimCheck
from experiments.bench.definitions import BenchMethod, growth_decisions, has_block_folders
from experiments.bench.paper_numbers import PAPER_CONTRADICTIONS, PAPER_EFFICIENCY, PAPER_NUMBERS
from experiments.bench.plan import BenchPlan
from experiments.bench.result_tables import VISIBILITY_SOURCE_NOTES, all_group_bounds
from experiments.bench.results import BenchResult
from experiments.bench.table_writers import escape_markdown as plain
from vdgs.config.method import block_train_config
from vdgs.partition.strategies import STRATEGIES


def make_notes(
    plan: BenchPlan, results: Sequence[BenchResult], claims: Sequence[ClaimCheck], figure: bool
) -> list[str]:
    """Claims, figure, fairness, failures, sources, scenes, and the paper's contradictions."""
    parts = []
    if claims:
        parts.append(_list("Claims", map(str, claims)))
    if figure:
        parts.append("![PSNR by visibility](groups.png)")
    parts.append(_fairness(plan))
    parts.append(_list("Groups by visibility", _groups(plan, results)))
    missing = [each for each in results if each.state != "done" or each.reason]
    failures = [f"{each.method} on {each.scene}, seed {each.seed}: {each.state}. {each.reason}" for each in missing]
    parts.append(_list("Missing", [*failures, *_not_rendered(plan)]))
    parts.append(_list("Where the figures are from", _provenance_notes(results)))
    parts.append(_list("Methods", map(_method, plan.methods)))
    parts.append(_list("Scenes", [f"{scene.title}: {scene.note}" for scene in plan.scenes if scene.note]))
    if plan.table.name in PAPER_NUMBERS:
        parts.append(_list("The paper's own numbers", PAPER_CONTRADICTIONS))
    if plan.table.overview or plan.table.name == "efficiency":
        parts.append(_list("Quoted from the paper", PAPER_EFFICIENCY))
    return [part for part in parts if part]


_CROP_NOTE = (
    "Where blocks draw only the part of each photograph that shows them (--block.crop fixed-pixels), their share of "
    "the total counts photographs, whatever their size: they make more iterations, of smaller pictures (and so decide "
    "more often about growth). The columns have both; in rows where these are the same, blocks draw whole photographs."
)


def _not_rendered(plan: BenchPlan) -> list[str]:
    """For which scenes and seeds another program left no renders, while it did for others."""
    return [
        f"{method.title} on {scene.title}: no renders for seed {', '.join(map(str, seeds))}."
        for method in plan.methods
        if method.renders is not None
        for scene in plan.scenes
        if (seeds := [seed for seed in plan.seeds if (scene.name, method.name, seed) not in plan.run_of])
    ]


def _fairness(plan: BenchPlan) -> str:
    notes = [
        "Same photographs, sparse points, split and total of iterations for all methods of a scene, but for rows of "
        "which it is notes below that they get less or more; where a cut gives fewer blocks than asked for, a method "
        "gets fewer iterations, as its row says.",
        "A coarse stage that several methods share is trained once; its time counts for each of them. Training time is "
        "all that leads from photographs to the model, measuring aside: starts and their stereo, V, the cut, the "
        "assignment, the steps of all blocks, one after another and each on all threads, merging; pictures for people "
        "are left out. (Before 2026-11-28 it was the steps alone; before 2026-11-29 blocks trained side by side, and "
        "pictures of the cut counted.) It depends on how many runs went at once (--jobs).",
        "LPIPS is VGG with input in [-1, 1]; a dash means that no weights were given (--lpips-weights).",
    ]
    if any(run.config.block.crop == "fixed-pixels" for run in plan.runs if has_block_folders(run.stages)):
        notes.append(_CROP_NOTE)
    notes += [
        f"{scene.title}: {budget.coarse:,} coarse iterations and {budget.blocks} × {budget.per_block:,} for blocks, "
        f"{budget.total:,} in all."
        for scene in plan.scenes
        for budget in [plan.budgets[scene.name]]
    ]
    if plan.step_factors:
        notes = [
            "At equal time: each method with its iterations times the factor that fills, by what its steps and the "
            f"rest took in the table at equal iterations beside this one, the time of `{plan.table.ours}`. "
            + "; ".join(f"{method} on {scene}: {factor:g}" for scene, method, factor in plan.step_factors),
            *notes[1:],
        ]
    decided = {
        f"{method} on {scene}": growth_decisions(block_train_config(run.config, 1))
        for (scene, method, _), run in plan.run_of.items()
        if has_block_folders(run.stages)
    }
    if decided:
        rows = "; ".join(f"{name}: {count}" for name, count in decided.items())
        notes.append(f"How often each block of anchors decides about growth (few times say little of it): {rows}.")
    if plan.max_anchors:
        notes.append(_limit(plan))
    external = [method.title for method in plan.methods if method.renders is not None]
    if external:
        notes.append(f"None of this is known of {', '.join(external)}: rendered by another program.")
    return _list("What each method got", notes)


def _limit(plan: BenchPlan) -> str:
    """--max-anchors, for methods with anchors and for 3DGS."""
    per_anchor = plan.runs[0].config.training.model.num_offsets
    return (
        f"At most {plan.max_anchors:,} anchors for a whole scene, or as many as it starts with (a block may grow to "
        "its share, in proportion to the coarse anchors it owns; nothing is removed to keep to it); for 3DGS "
        f"{per_anchor} Gaussians for each of them, {plan.max_anchors * per_anchor:,}, as many as they decode to."
    )


def _groups(plan: BenchPlan, results: Sequence[BenchResult]) -> list[str]:
    """What V of each scene is, and the V of each group."""
    notes = ["The same pixels for all methods and seeds; equal V is never split, so groups may differ in size."]
    for scene in plan.scenes:
        result = next((each for each in results if each.scene == scene.name and each.groups), None)
        if result is not None:
            notes.append(
                f"{scene.title}: {VISIBILITY_SOURCE_NOTES[result.visibility_source]}. {all_group_bounds(result)}"
            )
    return notes if len(notes) > 1 else []


def _provenance_notes(results: Sequence[BenchResult]) -> list[str]:
    """When and on what which runs were trained: of several machines only figures of the same one compare in seconds."""
    runs: dict[str, dict[int, list[str]]] = {}
    for each in results:
        if each.provenance:
            runs.setdefault(each.provenance, {}).setdefault(each.seed, []).append(f"{each.method} on {each.scene}")
    if len(runs) == 1:
        return [f"{next(iter(runs))}: all."]
    return [
        f"{provenance}: " + "; ".join(f"seed {seed}: {', '.join(names)}" for seed, names in seeds.items()) + "."
        for provenance, seeds in runs.items()
    ]


def _method(method: BenchMethod) -> str:
    omissions = list(method.omissions)
    strategy = STRATEGIES.get(method.name)
    if strategy is not None:
        omissions = [*strategy.omissions, *omissions]
    text = f"{method.title} (`{method.name}`)" if not method.citation else f"{method.title} ({method.citation})"
    if method.differs:
        text += f": {method.differs}"
    if method.less:
        text += f". Gets less: {method.less}"
    if method.more:
        text += f". Gets more: {method.more}"
    return text + (f". Left out: {'; '.join(omissions)}" if omissions else "")


def _list(title: str, lines: object) -> str:
    items = [f"- {plain(str(line))}" for line in lines]  # type: ignore[attr-defined]
    return "\n".join([f"## {title}", "", *items]) if items else ""
