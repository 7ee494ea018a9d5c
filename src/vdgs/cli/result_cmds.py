"""Verbs that show what a run came to: `status_command`, `eval_command`, `report_command`, `render_command`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from vdgs.cli.common import make_console, parse_arguments, select_device
from vdgs.config.commands import BIN_COUNT_RANGE, ModelName, RenderRequest
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.ranges import WORKER_COUNT
from vdgs.kernels import configure_threads


@dataclass(frozen=True)
class StatusArguments:
    """Say how far a run is, stage by stage and block by block, and what to type next.

    Stages are done, running, queued, stopped (they continue), failed (with the reason), missing, stale (made with other
    settings, for another cut or from another model) or unknown (no record says it). Exit code 0: all is done and in
    date; 3: not so.
    """

    run: Positional[Path]
    """Run folder."""
    json: bool = False
    """Print JSON instead of lines."""


def status_command(arguments: list[str]) -> int:
    asked = parse_arguments(StatusArguments, arguments, "vdgs status")
    from vdgs.report.status_cli import EXIT_INCOMPLETE, print_status, status_json
    from vdgs.runs.run_folder import RunFolder

    if not asked.json:
        return print_status(RunFolder(asked.run), make_console())
    import json

    facts = status_json(RunFolder(asked.run))
    print(json.dumps(facts, indent=1, ensure_ascii=False))
    return 0 if facts["complete"] else EXIT_INCOMPLETE


@dataclass(frozen=True, kw_only=True)
class EvalArguments:
    """Render the test views of a run, or its training views, and measure them: metrics.json, per_view.json, pictures, a
    table."""

    run: Positional[Path]
    """Run folder."""
    model: ModelName = "best"
    """Which model; `best` is the merged one where there is one."""
    views: Literal["test", "training"] = "test"
    """Which views. `training` goes into evaluation_training: a model that is much better there than on test views
    overfits. Blocks and seams are measured on test views only."""
    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    visibility_bins: Annotated[int, BIN_COUNT_RANGE] = 4
    """Number of visibility quantiles by which metrics are reported."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards of the views measured at once, each in a process of its own; 0: on this machine one process measures all,
    a cluster as many as it has room for."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels; 0 for all cores."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on it."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def eval_command(arguments: list[str]) -> None:
    asked = parse_arguments(EvalArguments, arguments, "vdgs eval")
    from vdgs.distributed.sharded_job import ExecutionOptions
    from vdgs.pipeline.evaluate_stage import EvaluationRequest, evaluate_stage
    from vdgs.runs.run_context import RunContext

    device, console = select_device(asked.device), make_console(asked.quiet)
    measuring = EvaluationRequest(
        path=asked.run,
        which=asked.model,
        lpips_weights=asked.lpips_weights,
        visibility_bins=asked.visibility_bins,
        views=asked.views,
        device=device,
    )
    configure_threads(asked.threads)
    context = RunContext.from_path(asked.run, asked.capture)
    asked.executor_options.check()
    evaluate_stage(context, measuring, console, ExecutionOptions(asked.executor_options, asked.jobs, device=device))


@dataclass(frozen=True)
class ReportArguments:
    """Write RUN/report.html: one file with the figures, metrics, pictures and settings of a run."""

    run: Positional[Path]
    """Run folder."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""


def report_command(arguments: list[str]) -> None:
    asked = parse_arguments(ReportArguments, arguments, "vdgs report")
    from vdgs.report import write_report
    from vdgs.runs.run_folder import RunFolder

    make_console(asked.quiet).print(f"report: {write_report(RunFolder(asked.run))}", highlight=False)


@dataclass(frozen=True, kw_only=True)
class RenderArguments(RenderRequest):
    """Render a run: its test views, its training views, or a camera path; as PNG files or a video."""

    run: Positional[Path]
    """Run folder."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""


def render_command(arguments: list[str]) -> None:
    asked = parse_arguments(RenderArguments, arguments, "vdgs render")
    from vdgs.rendering.render_run import render_run

    device = select_device(asked.device)
    configure_threads(asked.threads)
    render_run(replace(asked, device=device), make_console(asked.quiet))
