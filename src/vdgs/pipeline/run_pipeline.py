"""`vdgs run`: all stages in order, to the report. Finished stages are skipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape

from vdgs.config.commands import MapRequest, RunRequest
from vdgs.config.ranges import refuse
from vdgs.config.validation_rules import validate
from vdgs.distributed.backend_selection import refuse_unreachable
from vdgs.distributed.sharded_job import Wish
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.evaluate_run import evaluation_folder
from vdgs.evaluation.lpips import refuse_missing
from vdgs.pipeline.count_visibility import measure_visibility
from vdgs.pipeline.evaluate_stage import Measuring, evaluate_stage, is_measured
from vdgs.pipeline.merge_blocks import merge_run
from vdgs.pipeline.partition_stage import partition_run
from vdgs.pipeline.train_blocks import train_blocks
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.rendering.ortho.render_ortho import can_map, is_mapped, map_run
from vdgs.report import write_report
from vdgs.report.status_cli import next_step, whole_standing
from vdgs.runs.create_or_resume import driven_run
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.reconstruct import reconstruct
from vdgs.sfm.run_request import of_photographs, sfm_request
from vdgs.system.atomic_files import read_json
from vdgs.system.documents import EvaluationMetrics
from vdgs.system.stop_signals import stop_if_asked


def run_all(asked: RunRequest, console: Console, command: str | None = None) -> None:
    """Everything from a capture to a report, on a device that is chosen already (`vdgs.kernels.device_selection`).

    `command` is what asks for it, kept in the run for people who want to continue it.

    Raises what the stages raise; all that was finished before stays, and the same command continues.
    """
    refuse_unreachable(asked.where)
    refuse(asked)
    refuse_missing(asked.lpips_weights)
    asked = with_capture(asked, console)
    begun = driven_run(asked.capture, asked.output, asked.options, asked.method(), redo=asked.redo, command=command)
    with begun as context:
        _stages(context, asked, console)
    console.print(escape(f"next: {next_step(whole_standing(context.run))}"), highlight=False)


def with_capture(asked: RunRequest, console: Console) -> RunRequest:
    """The request about a capture: where it is about photographs alone, they become one in RUN/capture first.

    Raises what `reconstruct` raises, RunError where another process drives the run whose capture it would be, and
    VdgsError for settings that do not work, before the long work.
    """
    if not of_photographs(asked):
        return asked
    if problems := validate(asked.method()):
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    _title(console, "photographs")
    request = sfm_request(asked)
    reconstruct(request, console, RunFolder(asked.output).driven())
    return replace(asked, capture=request.output, photographs=(), options=replace(asked.options, gps=None))


def _stages(context: RunContext, asked: RunRequest, console: Console) -> None:
    _title(console, "coarse model")
    train_coarse(context, asked.watching, console, asked.device)
    stop_if_asked()
    measure_visibility(context, console)
    _measure(context, "coarse", asked, console)
    _title(console, "blocks")
    partition_run(context, console, asked.device, _wish(asked))
    _title(console, "block training")
    try:
        train_blocks(context, asked.watching, asked.jobs, console, asked.device, asked.where)
    except RunError as error:
        if not asked.incomplete:
            raise
        console.print(f"[yellow]note[/] {error}", highlight=False)
    _title(console, "merge and evaluation")
    merge_run(context, asked.incomplete, console)
    _measure(context, "merged", asked, console)
    context.release_models("coarse")
    _verdict(context.run, console)
    if asked.maps:
        _map(context, asked, console)
    stop_if_asked()
    console.print(f"report: {write_report(context.run)}", highlight=False)


def _map(context: RunContext, asked: RunRequest, console: Console) -> None:
    """Orthophoto, surface model and visibility. What hinders a map does not spoil a run: it is said."""
    _title(console, "maps")
    run = context.run
    if not can_map():
        console.print("[yellow]note[/] no maps: they need pip install 'vdgs\\[geo]'", highlight=False)
    elif is_mapped(run):
        console.print(f"{run.path / 'maps'}: already drawn; nothing to do", highlight=False)
    else:
        try:
            map_run(context, MapRequest(run=run.path, device=asked.device), console, _wish(asked))
        except Stopped:
            raise
        except VdgsError as error:
            console.print(f"[yellow]note[/] no maps: {escape(str(error))}", highlight=False)


def _title(console: Console, name: str) -> None:
    stop_if_asked()
    console.print()
    console.rule(f"[bold]{name}", align="left", style="dim")


def _measure(context: RunContext, which: Literal["coarse", "merged"], asked: RunRequest, console: Console) -> None:
    """Evaluate a model unless that was done already, for this very model and in the same way."""
    stop_if_asked()
    run = context.run
    if is_measured(run, which, asked.lpips_weights, asked.bins):
        console.print(f"{evaluation_folder(run, which)}: already measured; nothing to do", highlight=False)
        return
    measuring = Measuring(
        path=run.path, which=which, lpips_weights=asked.lpips_weights, bins=asked.bins, device=asked.device
    )
    evaluate_stage(context, measuring, console, _wish(asked))


def _wish(asked: RunRequest) -> Wish:
    """Where shards of stages other than the blocks are done: where blocks are trained, if that is a cluster."""
    return Wish(asked.where, asked.jobs if asked.where.executor != "local" else 0, device=asked.device)


def _verdict(run: RunFolder, console: Console) -> None:
    """One line: what the blocks brought."""
    coarse, merged = (_metrics(folder) for folder in (run.coarse.path / "evaluation", run.evaluation))
    before, after = coarse.get("psnr"), merged.get("psnr")
    if before is None or after is None:
        return
    console.print(
        f"coarse {before:.2f} dB → merged {after:.2f} dB ({after - before:+.2f}); "
        f"SSIM {coarse['ssim']:.3f} → {merged['ssim']:.3f}",
        style="bold", highlight=False,
    )  # fmt: skip


def _metrics(folder: Path) -> EvaluationMetrics:
    metrics: EvaluationMetrics = read_json(folder / "metrics.json")
    return metrics
