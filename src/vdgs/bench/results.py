"""What the runs of a table gave, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vdgs.bench.measure import GROUPS_FILE, evaluated
from vdgs.bench.plan import Plan, PlannedRun
from vdgs.bench.processes import Ended
from vdgs.bench.worker import RECORD
from vdgs.errors import VdgsError
from vdgs.files import read_json
from vdgs.run import RunFolder

#: What evaluations report, raw and after colour correction.
QUALITY = ("psnr", "ssim", "lpips_vgg", "lpips_vgg_01", "psnr_cc", "ssim_cc", "lpips_vgg_cc", "lpips_vgg_01_cc")


@dataclass(frozen=True)
class Result:
    """One method on one scene with one seed."""

    scene: str
    method: str
    seed: int
    #: done, failed, stopped or missing.
    state: str
    why: str = ""
    #: Relative to the output folder; methods with the same settings share one.
    folder: str = ""
    #: PSNR and the like over the test views, and of each group by visibility as `psnr@0`; None where unknown.
    figures: Mapping[str, float | None] = field(default_factory=dict)
    #: By visibility, least seen first: lower, upper, pixels.
    groups: tuple[Mapping[str, Any], ...] = ()


def gather(plan: Plan, output: Path, ended: Mapping[str, Ended]) -> list[Result]:
    """The results of every (scene, method, seed) of a plan, from its run folders."""
    results = []
    for (scene, method, seed), run in plan.answers.items():
        end = ended.get(run.name)
        state, why = (end.state, end.why) if end else ("missing", "")
        result = Result(scene, method, seed, state, why, str(run.folder))
        if state == "done":
            try:
                figures, groups = _read(output, run)
                result = Result(scene, method, seed, state, why, str(run.folder), figures, groups)
            except (VdgsError, KeyError, TypeError, FileNotFoundError) as error:
                result = Result(scene, method, seed, "failed", f"its results cannot be read: {error}", str(run.folder))
        results.append(result)
    return results


def as_json(results: list[Result]) -> list[dict[str, Any]]:
    return [asdict(result) for result in results]


def _read(output: Path, planned: PlannedRun) -> tuple[dict[str, float | None], tuple[dict[str, Any], ...]]:
    run = RunFolder(output / planned.folder)
    metrics, record = read_json(evaluated(run.path) / "metrics.json"), read_json(run.path / RECORD)
    figures: dict[str, float | None] = {name: metrics.get(name) for name in QUALITY}
    figures |= {"anchors": metrics.get("n_anchors"), "model_bytes": metrics.get("model_bytes"), "fps": metrics["fps"]}
    figures |= _costs(run, "blocks" in planned.stages, record.get("seconds", {}))
    # A group without bounds holds the pixels where the reference shows nothing: no claim is about them.
    groups = [group for group in read_json(run.path / GROUPS_FILE)["groups"] if group["lower"] is not None]
    for index, group in enumerate(groups):
        figures |= {f"{name}@{index}": group[name] for name in ("psnr", "ssim", "psnr_cc", "ssim_cc")}
    bounds = [{name: group[name] for name in ("lower", "upper", "pixels")} for group in groups]
    return figures, tuple(bounds)


def _costs(run: RunFolder, blocks: bool, stages: Mapping[str, float]) -> dict[str, float | None]:
    """Iterations, seconds, memory and cameras. The shared coarse stage counts in full for each run that takes it."""
    coarse = run.coarse.status()
    trained = [folder.status() for folder in run.block_folders()] if blocks else []
    rows = run.partition_facts().get("blocks", []) if blocks else []
    seconds = [float(each.get("seconds") or 0) for each in trained]
    peaks = [each.get("peak_memory_bytes") or 0 for each in [coarse, *trained]]
    return {
        "iterations": coarse.get("iteration", 0) + sum(each.get("iteration", 0) for each in trained),
        "coarse_seconds": coarse.get("seconds"),
        "block_seconds": sum(seconds) if blocks else None,
        "longest_block_seconds": max(seconds, default=None),
        "seconds": float(coarse.get("seconds") or 0) + sum(seconds),
        "partition_seconds": stages.get("partition"),
        "peak_memory_bytes": max(peaks),
        "block_memory_bytes": max(peaks[1:], default=None),
        "blocks": len(trained) if blocks else None,
        "coarse_anchors": coarse.get("anchors"),
        "cameras_per_block": sum(row["cameras"] for row in rows) / len(rows) if rows else None,
    }
