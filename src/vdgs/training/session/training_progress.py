"""Progress bar, console lines, log.jsonl and TensorBoard of a training."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from typing import Any, TextIO

import psutil
from rich.console import Console

from vdgs.config.method import TrainConfig
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import explain_disk_errors
from vdgs.system.console import make_progress_bar
from vdgs.training import StepReport, TrainingState, downscale_at

#: Iterations between two lines of log.jsonl.
LOG_INTERVAL = 50
#: What TensorBoard shows.
TENSORBOARD_SCALARS = ("loss", "l1", "ssim", "psnr_smoothed", "anchors", "splats")


class TrainingProgress:
    """A bar on a terminal, a line now and then elsewhere, and log.jsonl always."""

    def __init__(self, console: Console, folder: StageFolder, config: TrainConfig, start: int, board: Any = None):
        self._config, self._board = config, board
        self._file = folder.log
        with explain_disk_errors(self._file):
            self._log: TextIO = self._file.open("a", encoding="utf-8")
        self._recent: deque[tuple[float, int]] = deque([(time.monotonic(), start)], maxlen=200)
        self._process = psutil.Process()
        self._bar = make_progress_bar(console, transient=False)
        self._task = self._bar.add_task("starting", total=config.iterations, completed=start)

    def __enter__(self) -> TrainingProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        if self._board is not None:
            self._board.close()
        with explain_disk_errors(self._file):
            self._log.close()

    def step(self, state: TrainingState, report: StepReport) -> None:
        """Show and log one step."""
        now = time.monotonic()
        if state.iteration % 10 == 0:
            self._recent.append((now, state.iteration))
            self._bar.update(self._task, completed=state.iteration, description=self._line(state))
        if state.iteration % LOG_INTERVAL == 0 or report.grown is not None:
            self._write(state, report)

    def speed(self) -> float:
        """Iterations per second, over the last 2000 iterations."""
        (then, first), (now, last) = self._recent[0], self._recent[-1]
        return (last - first) / (now - then) if now > then else 0.0

    def status(self, state: TrainingState) -> StatusRecord:
        """Where training stands."""
        left = self._seconds_left(state)
        return StatusRecord(
            state="running", iteration=state.iteration, iterations=self._config.iterations, anchors=len(state.anchors),
            psnr_training=None if math.isnan(state.psnr) else state.psnr, seconds=round(state.seconds, 1),
            seconds_left=None if left is None else round(left), peak_memory_bytes=state.peak_memory_bytes,
        )  # fmt: skip

    def flush(self) -> None:
        with explain_disk_errors(self._file):
            self._log.flush()

    def _line(self, state: TrainingState) -> str:
        memory = self._process.memory_info().rss / 1e9
        return (
            f"{state.iteration}/{self._config.iterations}  loss {state.loss:.4f}  PSNR {state.psnr:.2f} dB  "
            f"{len(state.anchors):,} anchors  {self.speed():.1f} it/s  {memory:.1f} GB"
        )

    def _seconds_left(self, state: TrainingState) -> float | None:
        """None before a pace is known."""
        speed = self.speed()
        return (self._config.iterations - state.iteration) / speed if speed else None

    def _write(self, state: TrainingState, report: StepReport) -> None:
        record = {
            "iteration": state.iteration, "loss": report.loss, "l1": report.l1, "ssim": report.ssim,
            "psnr_smoothed": None if math.isnan(state.psnr) else state.psnr,
            "anchors": len(state.anchors), "visible": report.visible, "splats": report.splats,
            "downscale": downscale_at(state.iteration - 1, self._config),
            "grown": report.grown, "pruned": report.pruned, "seconds": round(state.seconds, 3),
            "iterations_per_second": round(self.speed(), 3), "memory_bytes": self._process.memory_info().rss,
            **report.cycle,
        }  # fmt: skip
        with explain_disk_errors(self._file):
            self._log.write(json.dumps(record) + "\n")
        if self._board is not None:
            for name in (name for name in TENSORBOARD_SCALARS if record[name] is not None):
                self._board.add_scalar(name, record[name], state.iteration)
