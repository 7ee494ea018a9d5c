"""3DGS in training under the eyes of a person: shown, logged, saved, stopped and continued.

The twin of `vdgs.stages.watching`, for another kind of state.
"""

from __future__ import annotations

import json
import math
import time
from typing import Any

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.checkpoints import discard_after, load_newest, save_state
from vdgs.comparators.gaussian_model import GaussiansModel, initial_gaussians
from vdgs.comparators.gaussian_training import (
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
from vdgs.errors import RunError, TrainingDiverged, VdgsError
from vdgs.memory import peak_memory_bytes, return_unused
from vdgs.run import StageFolder
from vdgs.run_options import WatchOptions
from vdgs.stages.progress import LOG_INTERVAL, PLAIN_SECONDS
from vdgs.stages.watching import STATUS_SECONDS, Stopped, is_out_of_memory, stop_requests


def continue_or_start(
    folder: StageFolder, capture: Capture, config: GaussiansConfig, console: Console
) -> GaussiansState:
    """The newest whole state in the folder, or a new one; the log ends where the state does.

    Raises RunError for a state that this version cannot read.
    """
    saved, complaints = load_newest(folder.checkpoints)
    for complaint in complaints:
        console.print(f"[yellow]note[/] {complaint}")
    if saved is None:
        state = start_state(
            initial_gaussians(capture.points, capture.point_colours, config.initial_opacity, config.degree)
        )
    else:
        try:
            state = from_saved(saved)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(
                f"{folder.checkpoints}: holds a state of another version ({error}). Choose another output folder."
            ) from error
        discard_after(folder.checkpoints, state.iteration)
        console.print(f"continuing at iteration {state.iteration}")
    folder.cut_log(state.iteration)
    return state


def train_watched(
    folder: StageFolder, state: GaussiansState, stage: GaussiansStage, options: WatchOptions, console: Console
) -> None:
    """Train to the end, showing, logging and saving on the way.

    Raises Stopped after Ctrl-C or SIGTERM (state saved), TrainingDiverged and VdgsError (out of memory, a photograph
    that is gone, a full disk).
    """
    watch = _Watch(folder, state, stage, options, console)
    try:
        folder.set_status("running", **watch.facts(state))
        with stop_requests() as stop:
            complete = train(state, stage, stop=stop, after_step=watch.after_step)
    except TrainingDiverged as error:
        folder.set_status("failed", iteration=state.iteration, why=str(error))
        raise TrainingDiverged(f"{error} States saved before it are kept in {folder.checkpoints}.") from error
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        folder.set_status("failed", iteration=state.iteration, why="out of memory")
        raise VdgsError(
            f"{folder.path}: out of memory with {len(state.gaussians):,} Gaussians. Set density.max_gaussians or use "
            "smaller photographs, in another output folder."
        ) from error
    except VdgsError as error:  # a photograph that is gone, a full disk: every step so far is whole
        folder.set_status("failed", iteration=state.iteration, why=str(error))
        save_state(folder.checkpoints, to_saved(state))
        raise
    if not complete:
        save_state(folder.checkpoints, to_saved(state))
        folder.set_status("stopped", **watch.facts(state))
        raise Stopped(f"Stopped at iteration {state.iteration}; saved. The same command continues.")


class _Watch:
    """What happens after every step: time, log.jsonl, status.json, a line now and then, saved states."""

    def __init__(
        self, folder: StageFolder, state: GaussiansState, stage: GaussiansStage, options: WatchOptions, console: Console
    ):
        self._folder, self._config, self._options, self._console = folder, stage.config, options, console
        self._last = self._noted = self._shown = time.monotonic()

    def after_step(self, state: GaussiansState, report: GaussiansReport) -> None:
        now = time.monotonic()
        state.seconds, self._last = state.seconds + now - self._last, now
        state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
        if state.iteration % LOG_INTERVAL == 0 or report.cloned is not None:
            self._log(state, report)
        if state.iteration % self._options.save_every == 0:
            return_unused()
            save_state(self._folder.checkpoints, to_saved(state))
        if now - self._noted > STATUS_SECONDS:
            self._noted = now
            self._folder.set_status("running", **self.facts(state))
        if now - self._shown > PLAIN_SECONDS:
            self._shown = now
            self._console.print(
                f"{state.iteration}/{self._config.iterations}  loss {state.loss:.4f}  PSNR {state.psnr:.2f} dB  "
                f"{len(state.gaussians):,} Gaussians",
                highlight=False,
            )

    def facts(self, state: GaussiansState) -> dict[str, Any]:
        """Where training stands, for status.json."""
        return {
            "iteration": state.iteration, "iterations": self._config.iterations, "gaussians": len(state.gaussians),
            "psnr_training": _number(state.psnr), "seconds": round(state.seconds, 1),
            "peak_memory_bytes": state.peak_memory_bytes,
        }  # fmt: skip

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
    folder.set_status(
        "done", iteration=state.iteration, iterations=state.iteration, gaussians=len(state.gaussians),
        seconds=state.seconds, psnr_training=_number(state.psnr), peak_memory_bytes=state.peak_memory_bytes,
    )  # fmt: skip
    console.print(
        f"trained {state.iteration} iterations in {state.seconds:.0f} s: {len(state.gaussians):,} Gaussians, PSNR of "
        f"training views {state.psnr:.2f} dB, peak memory {state.peak_memory_bytes / 1e9:.1f} GB\n"
        f"model: {folder.model}",
        highlight=False,
    )


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
