"""Training under the eyes of a person: shown, logged, saved, stopped and continued. The same for every stage."""

from __future__ import annotations

import math
import re
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
from rich.console import Console

from vdgs.anchors import AnchorModel
from vdgs.checkpoints import discard_after, load_newest, save_state
from vdgs.errors import RunError, TrainingDiverged, VdgsError
from vdgs.memory import is_out_of_memory, peak_memory_bytes, return_unused
from vdgs.run import StageFolder
from vdgs.run_options import WatchOptions
from vdgs.stages.memory_notes import after_failure, announce, kind_of, need_of
from vdgs.stages.progress import TrainingProgress
from vdgs.tensor_files import size_and_checksum
from vdgs.training import Stage, StepReport, TrainingState, from_saved, to_saved, train

#: What to do about a diverging loss, in the coarse stage and in a block.
AFTER_DIVERGENCE = {
    "coarse": "Lower --rates.* or raise --growth.threshold in a new --output, and look at the photographs with "
    "`vdgs inspect`.",
    "block": "Lower --block.offset-rate and --block.feature-rate or raise --block.growth.threshold (with --redo).",
}
#: As what missing memory arrives, among others (`is_out_of_memory`): from Python and C++, torch, the system, OpenCV.
MEMORY_ERRORS = (MemoryError, RuntimeError, OSError, cv2.error)
#: Seconds between two notes of the progress in status.json.
STATUS_SECONDS = 2.0


class Stopped(VdgsError):
    """Training was asked to stop; its state is saved."""

    stopped = True


def continue_or_start(
    folder: StageFolder, stage: Stage, start: Callable[[], TrainingState], console: Console
) -> TrainingState:
    """The newest whole state in the folder, or a new one; the log ends where the state does.

    Raises RunError for a state that this version cannot read or that is beyond the last iteration.
    """
    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    saved, complaints = load_newest(folder.checkpoints)
    for complaint in complaints:
        console.print(f"[yellow]note[/] {complaint}")
    if saved is None:
        if complaints:
            console.print("[yellow]note[/] no saved state is whole: starting again from the first iteration")
        state = start()
    else:
        try:
            state = from_saved(saved, stage)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(
                f"{folder.checkpoints}: holds a state of another version ({error}). Start a new --output."
            ) from error
        if state.iteration > stage.config.iterations:
            raise RunError(
                f"{folder.checkpoints}: is at iteration {state.iteration}, beyond {stage.config.iterations}."
            )
        discard_after(folder.checkpoints, state.iteration)
        console.print(f"continuing at iteration {state.iteration}")
    folder.cut_log(state.iteration)
    return state


def train_watched(
    folder: StageFolder, state: TrainingState, stage: Stage, options: WatchOptions, console: Console
) -> None:
    """Train to the end of the stage, showing, logging and saving on the way.

    Says first how much memory it will take. Raises Stopped after Ctrl-C or SIGTERM (state saved), TrainingDiverged and
    VdgsError (out of memory, a photograph that is gone, a full disk), each with what is kept.
    """
    kind, need = kind_of(stage), need_of(state, stage)
    announce(need, kind, console)
    try:
        with stop_requests() as stop:
            folder.set_status("running", iteration=state.iteration, iterations=stage.config.iterations)
            complete = _loop(folder, state, stage, options, console, stop)
    except TrainingDiverged as error:
        folder.set_status("failed", iteration=state.iteration, why=str(error))
        raise TrainingDiverged(f"{error} {_kept(folder)} {AFTER_DIVERGENCE[kind]}") from error
    except MEMORY_ERRORS as error:
        if not is_out_of_memory(error):
            raise
        traceback.clear_frames(error.__traceback__)  # they hold the pictures and splats of the step that failed
        kept = _rescue(folder, state)
        folder.set_status("failed", iteration=state.iteration, why="out of memory")
        raise VdgsError(
            f"{folder.path}: out of memory with {len(state.anchors):,} anchors{_wanted(error)}. {kept} "
            + after_failure(need, state, stage)
        ) from error
    except VdgsError as error:  # a photograph that is gone, a full disk: every step so far is whole
        folder.set_status("failed", iteration=state.iteration, why=str(error))
        save_state(folder.checkpoints, to_saved(state))
        raise
    if not complete:
        save_state(folder.checkpoints, to_saved(state))
        folder.set_status("stopped", iteration=state.iteration, iterations=stage.config.iterations)
        raise Stopped(f"Stopped at iteration {state.iteration}; saved. The same command continues.")


def finish(folder: StageFolder, state: TrainingState, model: AnchorModel, console: Console) -> None:
    """Save the model of a stage that is complete, mark it done and say so."""
    save_state(folder.checkpoints, to_saved(state))
    model.save(folder.model)
    folder.set_status(
        "done", iteration=state.iteration, iterations=state.iteration, anchors=len(state.anchors),
        model=identity(folder.model),
        seconds=state.seconds, psnr_training=None if math.isnan(state.psnr) else state.psnr,
        peak_memory_bytes=state.peak_memory_bytes,
    )  # fmt: skip
    minutes, seconds = divmod(round(state.seconds), 60)
    console.print(
        f"trained {state.iteration} iterations in {minutes} min {seconds} s: {len(state.anchors):,} anchors, "
        f"PSNR of training views {state.psnr:.2f} dB, peak memory {state.peak_memory_bytes / 1e9:.1f} GB\n"
        f"model: {folder.model}",
        highlight=False,
    )


def identity(model: Path) -> str:
    """What tells this model file from any other."""
    size, checksum = size_and_checksum(model)
    return f"{size}-{checksum:08x}"


def _loop(
    folder: StageFolder, state: TrainingState, stage: Stage, options: WatchOptions, console: Console,
    stop: Callable[[], bool],
) -> bool:  # fmt: skip
    """Train until complete (True) or asked to stop."""
    clock, board = _Clock(state), _board(folder, options, state.iteration)
    noted = time.monotonic()
    with TrainingProgress(console, folder, stage.config, state.iteration, board) as progress:

        def after_step(state: TrainingState, report: StepReport) -> None:
            nonlocal noted
            clock.tick()
            progress.step(state, report)
            if state.iteration % options.save_every == 0:
                progress.flush()  # before the state: a run that continues there must not miss lines of its log
                return_unused()
                save_state(folder.checkpoints, to_saved(state))
            if time.monotonic() - noted > STATUS_SECONDS:
                noted = time.monotonic()
                folder.set_status("running", **progress.facts(state))

        return train(state, stage, stop=stop, after_step=after_step)


def _kept(folder: StageFolder) -> str:
    kept, _ = load_newest(folder.checkpoints)
    if kept is None:
        return "No state was saved yet."
    return f"The state of iteration {kept.iteration} is kept in {folder.checkpoints}."


def _rescue(folder: StageFolder, state: TrainingState) -> str:
    """Save the state after memory ran out, if every step of it is whole and there is room; what is kept then."""
    return_unused()
    if state.whole:
        try:
            save_state(folder.checkpoints, to_saved(state))
        except (VdgsError, *MEMORY_ERRORS):
            pass  # what was saved before is still there
        else:
            return f"The state of iteration {state.iteration} is saved in {folder.checkpoints}."
    try:
        return _kept(folder)
    except MEMORY_ERRORS:
        return f"States that were saved before are kept in {folder.checkpoints}."


def _wanted(error: BaseException) -> str:
    """How much was asked for in vain, where the error says so."""
    asked = re.search(r"allocate ([\d.]+) (bytes|[KMG]iB)", str(error))
    return f" ({asked.group(1)} {asked.group(2)} more could not be had)" if asked else ""


class _Clock:
    """Keeps the state's account of time and memory, across interruptions."""

    def __init__(self, state: TrainingState):
        self._state, self._last = state, time.monotonic()

    def tick(self) -> None:
        now = time.monotonic()
        self._state.seconds += now - self._last
        self._state.peak_memory_bytes = max(self._state.peak_memory_bytes, peak_memory_bytes())
        self._last = now


@contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM ask to stop after the current step; a second Ctrl-C interrupts at once."""
    asked: list[int] = []

    def ask(signum: int, _frame: object) -> None:
        if asked and signum == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(signum)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _board(folder: StageFolder, options: WatchOptions, iteration: int) -> Any:
    if not options.tensorboard:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise VdgsError('TensorBoard is not installed: pip install "vdgs[tensorboard]"') from error
    return SummaryWriter(str(folder.path / "tensorboard"), purge_step=iteration)
