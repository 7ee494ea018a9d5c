"""What the runs of a table gave, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.baselines.evaluation import EVALUATION_STATUS
from experiments.baselines.gaussian_blocks.cut import GaussianCut
from experiments.baselines.gaussian_blocks.training import block_statuses
from experiments.bench.baseline_stages import baseline_folder
from experiments.bench.definitions import CLOCK, RECORD_FILE, has_block_folders, has_gaussian_blocks
from experiments.bench.measure import FRUSTA_FILE, GROUPS_FILE, final_evaluation_folder
from experiments.bench.plan import BenchPlan, PlannedRun
from vdgs.distributed.executor import TaskResult
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import read_json

#: What evaluations report, raw and after color correction.
QUALITY_KEYS = ("psnr", "ssim", "lpips_vgg", "lpips_vgg_01", "psnr_cc", "ssim_cc", "lpips_vgg_cc", "lpips_vgg_01_cc")
#: The same in neutral colors, of views that are drawn exposed as their neighbors in the flight.
REFERENCE_EXPOSURE_KEYS = ("psnr_reference_exposure", "ssim_reference_exposure")
#: Over the pixels that training cameras see: how opaque they are, PSNR by background, errors of depth; and veils.
COVERAGE_KEYS = (
    "opacity_coverage", "psnr_covered_own_background", "psnr_covered_black", "psnr_covered_white",
    "depth_error_median_expected", "depth_error_median_median", "depth_within_1_percent_expected",
    "depth_within_1_percent_median", "oversized_splats",
)  # fmt: skip

#: What a method with a training of its own notes of its blocks in COSTS_FILE beside its model.
COSTS_FILE = "costs.json"
BLOCK_COSTS = (
    "blocks", "block_seconds", "longest_block_seconds", "block_memory_bytes", "cameras_per_block", "coarse_seconds"
)  # fmt: skip
#: Of methods in blocks, seconds that another clock tells otherwise.
CLOCKED_KEYS = ("seconds", "preparation_seconds", "block_seconds", "longest_block_seconds")


@dataclass(frozen=True)
class BenchResult:
    """One method on one scene with one seed."""

    scene: str
    method: str
    seed: int
    #: done, failed, stopped or missing.
    state: str
    reason: str = ""
    #: Relative to the output folder; methods with the same settings share one.
    folder: str = ""
    #: PSNR and the like over the test views, and of each group by visibility as `psnr@0`; None where unknown.
    figures: Mapping[str, float | None] = field(default_factory=dict)
    #: By visibility, least seen first: lower, upper, pixels.
    groups: tuple[Mapping[str, Any], ...] = ()
    #: What V of the groups is (`pixel_visibility.VisibilitySource`); empty without groups.
    visibility_source: str = ""
    #: The same by V as the paper counts it, of generated scenes: figures as `psnr@frusta0`.
    frusta: tuple[Mapping[str, Any], ...] = ()
    #: Changes with everything that the result depends on, but for the version and the machine.
    key: str = ""
    #: When, on what and with which version it was trained (`provenance.py`).
    provenance: str = ""
    #: What its seconds mean (`definitions.CLOCK`).
    clock: int = CLOCK


def collect_results(
    plan: BenchPlan,
    output: Path,
    ended: Mapping[str, TaskResult],
    keys: Mapping[str, str],
    cached: Mapping[str, BenchResult],
) -> list[BenchResult]:
    """The results of every (scene, method, seed) of a plan, from its run folders, or known by the keys of runs."""
    results = []
    for (scene, method, seed), run in plan.run_of.items():
        if keys[run.name] in cached:
            results.append(replace(cached[keys[run.name]], scene=scene, method=method, seed=seed))
            continue
        end = ended.get(run.name)
        state, reason = (end.state, end.reason) if end else ("missing", "")
        result = BenchResult(scene, method, seed, state, reason, str(run.folder), key=keys[run.name])
        if state == "done":
            try:
                result = _read(output, run, result)
            except (VdgsError, KeyError, TypeError, FileNotFoundError) as error:
                result = BenchResult(
                    scene, method, seed, "failed", f"its results cannot be read: {error}", str(run.folder)
                )
        results.append(result)
    return results


def results_to_json(results: list[BenchResult]) -> list[dict[str, Any]]:
    return [asdict(result) for result in results]


def _read(output: Path, planned: PlannedRun, result: BenchResult) -> BenchResult:
    """The result with the figures that the run left."""
    run = RunFolder(output / planned.folder)
    metrics, record = read_json(final_evaluation_folder(run.path) / "metrics.json"), read_json(run.path / RECORD_FILE)
    figures: dict[str, float | None] = {
        name: metrics.get(name) for name in (*QUALITY_KEYS, *REFERENCE_EXPOSURE_KEYS, *COVERAGE_KEYS)
    }
    figures |= {"model_bytes": metrics.get("model_bytes"), "fps": metrics["fps"]}
    if planned.renders is None:
        figures |= _sizes(metrics, planned) | _costs(run, planned.stages, _stage_seconds(output, planned, record))
    bounds, measured = _groups(run.path / GROUPS_FILE, "@", figures)
    by_frusta, _ = _groups(run.path / FRUSTA_FILE, "@frusta", figures)
    figures["unseen_share"] = measured.get("unseen_share")
    source = measured["visibility_source"] if bounds else ""
    provenance, clock = record.get("provenance", ""), record.get("clock", 1)
    return without_old_seconds(replace(
        result, figures=figures, groups=bounds, visibility_source=source, frusta=by_frusta, provenance=provenance,
        clock=clock,
    ))  # fmt: skip


def without_old_seconds(result: BenchResult) -> BenchResult:
    """The result without seconds by an older clock, which do not compare with others; those of a method without blocks
    are the same by either."""
    old = dict.fromkeys(each for each in CLOCKED_KEYS if result.figures.get(each) is not None)
    if result.clock == CLOCK or result.figures.get("blocks") is None or not old:
        return result
    why = "Its seconds are left out: before 2026-11-29 blocks trained side by side, and pictures of the cut counted."
    return replace(result, figures={**result.figures, **old}, reason=f"{result.reason} {why}".strip())


def _groups(file: Path, at: str, figures: dict[str, float | None]) -> tuple[tuple[dict[str, Any], ...], dict[str, Any]]:
    """The bounds of the groups in a file, whose figures are added as `psnr` + `at` + index, and all that it holds."""
    measured: dict[str, Any] = read_json(file) if file.exists() else {"groups": [], "seen_by": ""}
    # A group without bounds holds sky, or what the reference does not show: no claim is about it.
    groups = [group for group in measured["groups"] if group["lower"] is not None]
    for index, group in enumerate(groups):
        figures |= {f"{name}{at}{index}": group[name] for name in ("psnr", "ssim", "psnr_cc", "ssim_cc")}
    return tuple({name: group[name] for name in ("lower", "upper", "pixels")} for group in groups), measured


def _sizes(metrics: Mapping[str, Any], planned: PlannedRun) -> dict[str, float | None]:
    """Anchors, where the model has them, and Gaussians: those of an explicit model, or at most as many as the anchors
    decode to (those without opacity are not drawn)."""
    anchors, explicit = metrics.get("n_anchors"), metrics.get("n_gaussians")
    decoded = None if anchors is None else anchors * planned.config.training.model.num_offsets
    return {"anchors": anchors, "gaussians": decoded if explicit is None else explicit}


def _photographs_drawn(status: StatusRecord) -> float:
    """How many photographs' worth of pixels a stage drew: fewer than its steps where these draw parts."""
    return float(status.images_drawn if status.images_drawn is not None else status.iteration or 0)


def _stage_seconds(output: Path, planned: PlannedRun, record: Mapping[str, Any]) -> dict[str, float]:
    """By the clock, stage by stage; a coarse stage that was taken over took as long as where it was trained."""
    seconds = dict(record.get("seconds", {}))
    shared = None if planned.coarse_from is None else output / planned.coarse_from / RECORD_FILE
    if shared is not None and shared.exists():
        seconds |= {name: taken for name, taken in read_json(shared)["seconds"].items() if name == "coarse"}
    return seconds


def _whole_seconds(run: RunFolder, stages: Sequence[str], clock: Mapping[str, float], loops: Sequence[float]) -> float:
    """From the photographs to the model, without measuring it: also starts and their stereo, V, the cut, the assignment
    and merging, as `clock` has them by stage, without pictures for people. Blocks in processes of their own count by
    what they note themselves, since starting Python is no part of a method. No stage counts less than it notes itself:
    of one that was interrupted, the clock has the last part alone.

    `loops`: seconds of the coarse training and of each block, or of a method that trains in one stage.
    """
    if baseline_folder(run, tuple(stages)) is not None:
        evaluation = run.evaluation / EVALUATION_STATUS
        if not evaluation.exists():  # nobody knows how much of the clock's time was measuring
            return sum(loops)
        return max(clock.get(stages[0], 0.0) - read_json(evaluation)["seconds"], sum(loops))
    partition, merged = run.partition_record().seconds, run.merged.status().merge_seconds
    noted = {"coarse": loops[0], "partition": partition or 0.0, "merge": merged or 0.0, "momentum-gs": sum(loops[1:])}
    whole = sum(max(clock.get(name, 0.0), noted[name]) for name in stages if name in noted)
    return whole + sum(loops[1:]) * ("blocks" in stages)


def _costs(run: RunFolder, names: Sequence[str], clock: Mapping[str, float]) -> dict[str, float | None]:
    """Iterations, photographs drawn, seconds, memory and cameras of a run with the stages `names`, which took `clock`.
    The shared coarse stage counts in full for each run that takes it."""
    own = baseline_folder(run, tuple(names))
    if own is not None and has_gaussian_blocks(names):
        coarse, trained = StageFolder(own.path / "coarse").status(), block_statuses(own.path)
        cut = GaussianCut.load(own.path)
        cameras = [len(views) for views in cut.views] if cut else []
    else:
        coarse = (own or run.coarse).status()
        in_blocks = has_block_folders(names)
        trained = [folder.status() for folder in run.block_folders()] if in_blocks else []
        cameras = [row.cameras for row in run.partition_record().blocks] if in_blocks else []
    seconds = [float(each.seconds or 0) for each in trained]
    loops = [float(coarse.seconds or 0), *seconds]
    whole = _whole_seconds(run, names, clock, loops)
    peaks = [each.peak_memory_bytes or 0 for each in [coarse, *trained]]
    known = {
        "iterations": (coarse.iteration or 0) + sum(each.iteration or 0 for each in trained),
        "photographs": sum(_photographs_drawn(each) for each in [coarse, *trained]),
        "coarse_seconds": coarse.seconds,
        "block_seconds": sum(seconds) if trained else None,
        "longest_block_seconds": max(seconds, default=None),
        "seconds": whole,
        "preparation_seconds": whole - sum(loops),
        "peak_memory_bytes": max(peaks),
        "block_memory_bytes": max(peaks[1:], default=None),
        "blocks": len(trained) or None,
        "coarse_anchors": coarse.anchors,
        "cameras_per_block": sum(cameras) / len(cameras) if cameras else None,
    }
    costs = own.path / COSTS_FILE if own else None
    return known | ({name: read_json(costs).get(name) for name in BLOCK_COSTS} if costs and costs.exists() else {})
