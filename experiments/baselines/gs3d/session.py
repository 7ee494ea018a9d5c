"""Training of 3DGS, watched: shown, logged, checkpointed, stopped and continued.

The twin of `vdgs.training.session.trainer`, for another kind of state.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable

from rich.console import Console

from experiments.baselines.gs3d.model import GaussiansModel, initial_gaussians
from experiments.baselines.gs3d.training import (
    GaussiansConfig,
    GaussiansReport,
    GaussiansStage,
    GaussiansState,
    degree_at,
    downscale_at,
    from_saved,
    start_state,
    to_saved,
    train,
)
from vdgs.captures.capture import Capture
from vdgs.config.checkpointing import WatchOptions
from vdgs.runs.stage_folder import StageFolder, Status
from vdgs.system.checkpoints import save_state
from vdgs.training.session.training_progress import LOG_INTERVAL, PLAIN_SECONDS
from vdgs.training.session.training_session import Keeper, Watched, restore_or_start, watch


def continue_or_start(
    folder: StageFolder, capture: Capture, config: GaussiansConfig, console: Console
) -> GaussiansState:
    """The state of the newest whole checkpoint, or a new one; the log ends where the state does.

    Raises RunError for a state that this version cannot read.
    """

    def start() -> GaussiansState:
        points, colours = capture.points, capture.point_colours
        return start_state(initial_gaussians(points, colours, config.initial_opacity, config.degree))

    return restore_or_start(folder, config.iterations, start, from_saved, "Choose another output folder.", console)


def train_watched(
    folder: StageFolder, state: GaussiansState, stage: GaussiansStage, options: WatchOptions, console: Console
) -> None:
    """Train to the end, showing, logging and saving on the way. Raises what `watch` raises."""
    journal = _Journal(folder, stage.config, console)
    training = Watched(
        folder=folder, state=state,
        to_saved=lambda: to_saved(state),
        status=lambda: journal.status(state),
        size=lambda: f"{len(state.gaussians):,} Gaussians",
        after_divergence="",
        save_memory=lambda: "Set density.max_gaussians or use smaller photographs, in another output folder.",
        whole=lambda: state.whole,
    )  # fmt: skip

    def loop(stop: Callable[[], bool]) -> bool:
        keeper = Keeper(training, options.save_every)

        def after_step(state: GaussiansState, report: GaussiansReport) -> None:
            keeper.tick()
            journal.step(state, report)
            keeper.keep(training.status)

        return train(state, stage, stop=stop, after_step=after_step)

    watch(training, loop)


class _Journal:
    """log.jsonl and a line now and then."""

    def __init__(self, folder: StageFolder, config: GaussiansConfig, console: Console):
        self._folder, self._config, self._console = folder, config, console
        self._shown = time.monotonic()

    def step(self, state: GaussiansState, report: GaussiansReport) -> None:
        """Log and show one step."""
        if state.iteration % LOG_INTERVAL == 0 or report.cloned is not None:
            self._log(state, report)
        if time.monotonic() - self._shown > PLAIN_SECONDS:
            self._shown = time.monotonic()
            self._console.print(
                f"{state.iteration}/{self._config.iterations}  loss {state.loss:.4f}  PSNR {state.psnr:.2f} dB  "
                f"{len(state.gaussians):,} Gaussians",
                highlight=False,
            )

    def status(self, state: GaussiansState) -> Status:
        """Where training stands."""
        return Status(
            state="running", iteration=state.iteration, iterations=self._config.iterations,
            psnr_training=_number(state.psnr), seconds=round(state.seconds, 1),
            peak_memory_bytes=state.peak_memory_bytes,
        )  # fmt: skip

    def _log(self, state: GaussiansState, report: GaussiansReport) -> None:
        done = state.iteration - 1
        record = {
            "iteration": state.iteration, "loss": report.loss, "l1": report.l1, "ssim": report.ssim,
            "psnr_smoothed": _number(state.psnr), "gaussians": len(state.gaussians), "visible": report.visible,
            "downscale": downscale_at(done, self._config), "degree": degree_at(done, self._config),
            "cloned": report.cloned, "split": report.split, "pruned": report.pruned,
            "seconds": round(state.seconds, 3),
        }  # fmt: skip
        with self._folder.log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")


def finish(folder: StageFolder, state: GaussiansState, model: GaussiansModel, console: Console) -> None:
    """Save the model of a run that is complete, mark it done and say so."""
    save_state(folder.checkpoints, to_saved(state))
    model.save(folder.model)
    status = Status(
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
