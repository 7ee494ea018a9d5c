"""`vdgs run`: all stages in order, to the report. Finished stages are skipped."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console

from vdgs.errors import RunError, VdgsError
from vdgs.evaluation.of_run import evaluate_run
from vdgs.evaluation.saving import write_json
from vdgs.files import read_json
from vdgs.memory import forget_peak, peak_memory_bytes
from vdgs.report import write_report
from vdgs.run import RunFolder
from vdgs.stages.coarse import begin_run, train_coarse
from vdgs.stages.evaluate import evaluate_stage
from vdgs.stages.merge import merge_run
from vdgs.stages.partition import measure_visibility, partition_run
from vdgs.stages.train import train_blocks
from vdgs.verbs import RunArguments


def run_all(asked: RunArguments, console: Console) -> None:
    """Everything from a capture to a report.

    Raises what the stages raise; all that was finished before stays, and the same command continues.
    """
    asked.watching.check()
    run, capture = begin_run(asked.capture, asked.output, asked.options, asked.method(), redo=asked.redo)
    _title(console, "coarse model")
    train_coarse(run, capture, asked.watching, console)
    measured = {"lpips_weights": str(asked.lpips_weights), "bins": asked.bins}
    _measure(run, "coarse", run.keys().coarse, measured, asked, console)
    _title(console, "visibility and blocks")
    measure_visibility(run, console)
    partition_run(run, console)
    _title(console, "block training")
    try:
        train_blocks(run.path, asked.watching, asked.jobs, console)
    except RunError as error:
        if not asked.incomplete:
            raise
        console.print(f"[yellow]note[/] {error}", highlight=False)
    _title(console, "merge and evaluation")
    merge_run(run.path, asked.incomplete, console)
    merged = run.merged.status()
    _measure(run, "merged", f"{merged['key']} {merged['blocks_trained']}", measured, asked, console)
    _verdict(run, console)
    console.print(f"report: {write_report(run)}", highlight=False)


def _title(console: Console, name: str) -> None:
    console.print()
    console.rule(f"[bold]{name}", align="left", style="dim")


def _measure(
    run: RunFolder, which: Any, key: str, settings: dict[str, Any], asked: RunArguments, console: Console
) -> None:  # fmt: skip
    """Evaluate a model unless that was done already, for it and in the same way."""
    output = run.evaluation if which == "merged" else run.coarse.path / "evaluation"
    record, wanted = output / "status.json", {"key": key, **settings}
    with suppress(VdgsError):
        if {name: read_json(record).get(name) for name in wanted} == wanted:
            console.print(f"{output}: already measured; nothing to do", highlight=False)
            return
    forget_peak()
    began = time.monotonic()
    if which == "merged":
        evaluate_stage(run.path, which, asked.lpips_weights, asked.bins, console)
    else:
        evaluate_run(run.path, asked.lpips_weights, asked.bins, console, which)
    write_json(record, wanted | {"seconds": time.monotonic() - began, "peak_memory_bytes": peak_memory_bytes()})


def _verdict(run: RunFolder, console: Console) -> None:
    """One line: what the blocks brought."""
    coarse, merged = (_metrics(folder) for folder in (run.coarse.path / "evaluation", run.evaluation))
    if coarse.get("psnr") is None or merged.get("psnr") is None:
        return
    console.print(
        f"coarse {coarse['psnr']:.2f} dB → merged {merged['psnr']:.2f} dB "
        f"({merged['psnr'] - coarse['psnr']:+.2f}); SSIM {coarse['ssim']:.3f} → {merged['ssim']:.3f}",
        style="bold", highlight=False,
    )  # fmt: skip


def _metrics(folder: Path) -> dict[str, Any]:
    return read_json(folder / "metrics.json")
