"""Verbs that show what a run came to: `eval`, `report`, `render`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from vdgs.settings.ranges import WORKERS
from vdgs.settings.requests import BINS, ModelName, RenderRequest
from vdgs.verbs.shared import find_capture, open_console, parse, use_device, use_threads


@dataclass(frozen=True)
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
    bins: Annotated[int, BINS] = 4
    """Number of visibility quantiles by which metrics are reported."""
    threads: Annotated[int, WORKERS] = 0
    """Threads of the kernels; 0 for all cores."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on it."""


def eval(arguments: list[str]) -> None:
    asked = parse(EvalArguments, arguments, "vdgs eval")
    from vdgs.runs.folder import RunFolder
    from vdgs.stages.evaluate import evaluate_stage

    device = use_device(asked.device)
    find_capture(RunFolder(asked.run), asked.capture)
    use_threads(asked.threads)
    evaluate_stage(asked.run, asked.model, asked.lpips_weights, asked.bins, open_console(), asked.views, device)


@dataclass(frozen=True)
class ReportArguments:
    """Write RUN/report.html: one file with the figures, metrics, pictures and settings of a run."""

    run: Positional[Path]
    """Run folder."""


def report(arguments: list[str]) -> None:
    asked = parse(ReportArguments, arguments, "vdgs report")
    from vdgs.report import write_report
    from vdgs.runs.folder import RunFolder

    open_console().print(f"report: {write_report(RunFolder(asked.run))}", highlight=False)


@dataclass(frozen=True)
class RenderArguments(RenderRequest):
    """Render a run: its test views, its training views, or a camera path; as PNG files or a video."""

    run: Positional[Path]
    """Run folder."""


def render(arguments: list[str]) -> None:
    asked = parse(RenderArguments, arguments, "vdgs render")
    from vdgs.films.film import render_run

    device = use_device(asked.device)
    use_threads(asked.threads)
    render_run(replace(asked, device=device), open_console())
