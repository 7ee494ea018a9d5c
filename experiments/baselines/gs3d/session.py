"""Training of 3DGS, watched: shown, logged, checkpointed, stopped and continued.

The twin of `vdgs.training.session.trainer`, for another kind of state.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable

from rich.console import Console
from torch import Tensor

from experiments.baselines.gs3d.model import GaussianModel, initialize_gaussians
from experiments.baselines.gs3d.training import (
    Gs3dConfig,
    Gs3dProblem,
    Gs3dState,
    Gs3dStepReport,
    downscale_at,
    from_checkpoint,
    initial_state,
    to_checkpoint,
    train,
)
from vdgs.captures.capture import Capture
from vdgs.config.executor_options import CheckpointOptions
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.checkpoints import save_checkpoint
from vdgs.system.console import LINE_INTERVAL_SECONDS
from vdgs.training.session.training_progress import LOG_INTERVAL
from vdgs.training.session.training_session import Checkpointer, TrainingSession, restore_or_start, run_session


def resume_or_start(
    folder: StageFolder, iterations: int, start: Callable[[], Gs3dState], console: Console, device: str = "cpu"
) -> Gs3dState:
    """The state of the newest whole checkpoint, or a new one, on a device; the log ends where the state does.

    Raises RunError for a state that this version cannot read.
    """
    advice = "Choose another output folder."
    return restore_or_start(folder, iterations, start, from_checkpoint, advice, console).to(device)


def state_from_points(capture: Capture, config: Gs3dConfig, rows: Tensor | None = None) -> Gs3dState:
    """A Gaussian at each sparse point, or at those of the given rows."""
    points, colors = capture.points, capture.point_colors
    every = initialize_gaussians(points, colors, config.initial_opacity, config.degree)
    return initial_state(every if rows is None else every.select(rows))


def train_with_checkpoints(
    folder: StageFolder,
    state: Gs3dState,
    stage: Gs3dProblem,
    options: CheckpointOptions,
    console: Console,
    loop: Callable[..., bool] | None = None,
) -> None:
    """Train to the end, showing, logging and saving on the way; by another `loop` than `train`, if one is given. Raises
    what `run_session` raises."""
    journal = _TrainingLog(folder, stage, console)
    training = TrainingSession(
        folder=folder, state=state,
        to_checkpoint=lambda: to_checkpoint(state),
        status=lambda: journal.status(state),
        size=lambda: f"{len(state.gaussians):,} Gaussians",
        divergence_hint="",
        memory_hint=lambda: "Set density.max_gaussians or use smaller photographs, in another output folder.",
        is_consistent=lambda: state.is_consistent,
    )  # fmt: skip

    def run_loop(stop: Callable[[], bool]) -> bool:
        checkpointer = Checkpointer(training, options.save_every)

        def after_step(state: Gs3dState, report: Gs3dStepReport) -> None:
            checkpointer.update_timers()
            journal.step(state, report)
            checkpointer.save_if_due(training.status)

        return (loop or train)(state, stage, stop=stop, after_step=after_step)

    run_session(training, run_loop)


class _TrainingLog:
    """log.jsonl and a line now and then."""

    def __init__(self, folder: StageFolder, stage: Gs3dProblem, console: Console):
        self._folder, self._stage, self._console = folder, stage, console
        self._shown = time.monotonic()

    def step(self, state: Gs3dState, report: Gs3dStepReport) -> None:
        """Log and show one step."""
        if state.iteration % LOG_INTERVAL == 0 or report.cloned is not None:
            self._log(state, report)
        if time.monotonic() - self._shown > LINE_INTERVAL_SECONDS:
            self._shown = time.monotonic()
            self._console.print(
                f"{state.iteration}/{self._stage.end}  loss {state.loss:.4f}  PSNR {state.psnr:.2f} dB  "
                f"{len(state.gaussians):,} Gaussians",
                highlight=False,
            )

    def status(self, state: Gs3dState) -> StatusRecord:
        """Where training stands."""
        return StatusRecord(
            state="running", iteration=state.iteration, iterations=self._stage.end,
            psnr_training=_number(state.psnr), seconds=round(state.seconds, 1),
            peak_memory_bytes=state.peak_memory_bytes,
        )  # fmt: skip

    def _log(self, state: Gs3dState, report: Gs3dStepReport) -> None:
        done = state.iteration - 1
        record = {
            "iteration": state.iteration, "loss": report.loss, "l1": report.l1, "ssim": report.ssim,
            "psnr_smoothed": _number(state.psnr), "gaussians": len(state.gaussians), "visible": report.visible,
            "downscale": downscale_at(done, self._stage.config), "degree": self._stage.sh_degree_at(done),
            "cloned": report.cloned, "split": report.split, "pruned": report.pruned,
            "seconds": round(state.seconds, 3),
        }  # fmt: skip
        with self._folder.log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")


def finish_training(folder: StageFolder, state: Gs3dState, model: GaussianModel, console: Console) -> None:
    """Save the model of a run that is complete, mark it done and say so."""
    save_checkpoint(folder.checkpoints, to_checkpoint(state))
    model.save(folder.model)
    status = StatusRecord(
        state="done", iteration=state.iteration, iterations=state.iteration,
        seconds=state.seconds, psnr_training=_number(state.psnr), peak_memory_bytes=state.peak_memory_bytes,
    )  # fmt: skip
    folder.set_status(status)
    console.print(
        f"trained {state.iteration} iterations in {state.seconds:.0f} s: {len(state.gaussians):,} Gaussians, PSNR of "
        f"training views {state.psnr:.2f} dB, peak memory {state.peak_memory_bytes / 1e9:.1f} GB\n"
        f"model: {folder.model}",
        highlight=False,
    )


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
