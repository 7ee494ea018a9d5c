"""Training that is logged, checkpointed, stopped and continued, for every kind of state."""

from __future__ import annotations

import re
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import cv2
from rich.console import Console

from vdgs.errors import RunError, Stopped, TrainingDiverged, VdgsError
from vdgs.kernels.idle_memory import trim_heap
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.checkpoints import Checkpoint, delete_checkpoints_after, load_latest_checkpoint, save_checkpoint
from vdgs.system.memory.memory_errors import is_out_of_memory
from vdgs.system.memory.process_memory import peak_memory_bytes
from vdgs.system.stop_signals import catch_stop_signals

#: As what missing memory arrives, among others (`is_out_of_memory`): from Python and C++, torch, the system, OpenCV.
MEMORY_ERRORS = (MemoryError, RuntimeError, OSError, cv2.error)
#: Seconds between two notes of the progress in status.json.
STATUS_SECONDS = 2.0


class ResumableState(Protocol):
    """The part of a training state that a session needs."""

    iteration: int
    seconds: float
    peak_memory_bytes: int


S = TypeVar("S", bound=ResumableState)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingSession:
    """A training with the functions that save it and report on it."""

    folder: StageFolder
    state: ResumableState
    #: The whole state as it is saved.
    to_checkpoint: Callable[[], Checkpoint]
    #: Where training stands.
    status: Callable[[], StatusRecord]
    #: How large the model is, in words ("12,000 anchors").
    size: Callable[[], str]
    #: What a person may do about a loss that diverges, and about missing memory.
    divergence_hint: str
    memory_hint: Callable[[], str]
    #: Whether every step of the state is whole, so that it may be saved though a step was broken off.
    is_consistent: Callable[[], bool]

    def save(self) -> None:
        save_checkpoint(self.folder.checkpoints, self.to_checkpoint())


def restore_or_start(
    folder: StageFolder,
    iterations: int,
    start: Callable[[], S],
    restore: Callable[[Checkpoint], S],
    advice: str,
    console: Console,
) -> S:
    """The state of the newest whole checkpoint, or a new one; the log ends where the state does.

    Raises RunError, with `advice`, for a state that this version cannot read, and for one beyond the last iteration.
    """
    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    saved, complaints = load_latest_checkpoint(folder.checkpoints)
    for complaint in complaints:
        console.print(f"[yellow]note[/] {complaint}")
    if saved is None:
        if complaints:
            console.print("[yellow]note[/] no checkpoint is whole: starting again from the first iteration")
        state = start()
    else:
        try:
            state = restore(saved)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"{folder.checkpoints}: holds a state of another version ({error}). {advice}") from error
        if state.iteration > iterations:
            raise RunError(f"{folder.checkpoints}: is at iteration {state.iteration}, beyond {iterations}.")
        delete_checkpoints_after(folder.checkpoints, state.iteration)
        console.print(f"continuing at iteration {state.iteration}")
    folder.truncate_log(state.iteration)
    return state


def run_session(training: TrainingSession, loop: Callable[[Callable[[], bool]], bool]) -> None:
    """Run `loop(stop)`, which trains until complete (True) or asked to stop, and note in status.json how it ends.

    Raises Stopped after Ctrl-C or SIGTERM (state saved), TrainingDiverged and VdgsError (out of memory, a photograph
    that is gone, a full disk), each with what is kept.
    """
    folder, state = training.folder, training.state
    try:
        with catch_stop_signals(second_interrupts=True) as requests:
            folder.set_status(training.status())
            complete = loop(lambda: bool(requests))
    except TrainingDiverged as error:
        folder.set_status(StatusRecord(state="failed", iteration=state.iteration, reason=str(error)))
        raise TrainingDiverged(f"{error} {_last_checkpoint(folder)} {training.divergence_hint}".rstrip()) from error
    except MEMORY_ERRORS as error:
        if not is_out_of_memory(error):
            raise
        traceback.clear_frames(error.__traceback__)  # they hold the pictures and splats of the step that failed
        kept = _rescue(training)
        folder.set_status(StatusRecord(state="failed", iteration=state.iteration, reason="out of memory"))
        raise VdgsError(
            f"{folder.path}: out of memory with {training.size()}{_requested_bytes(error)}. {kept} "
            f"{training.memory_hint()}"
        ) from error
    except VdgsError as error:  # a photograph that is gone, a full disk: every step so far is whole
        folder.set_status(StatusRecord(state="failed", iteration=state.iteration, reason=str(error)))
        training.save()
        raise
    if not complete:
        training.save()
        folder.set_status(replace(training.status(), state="stopped"))
        raise Stopped(f"Stopped at iteration {state.iteration}; saved. The same command continues.")


class Checkpointer:
    """After every step: time and peak memory of the state (across interruptions), checkpoints, status.json."""

    def __init__(self, training: TrainingSession, save_every: int):
        self._training, self._save_every = training, save_every
        self._last = self._noted = time.monotonic()

    def update_timers(self) -> None:
        """Add the time since the last step to the state's account."""
        now, state = time.monotonic(), self._training.state
        state.seconds += now - self._last
        state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
        self._last = now

    def save_if_due(self, status: Callable[[], StatusRecord], flush_log: Callable[[], None] | None = None) -> None:
        """Save the state and write the `status`, each where it is time.

        The log is flushed before the checkpoint is written: a run that continues there must not miss lines of it.
        """
        training = self._training
        if training.state.iteration % self._save_every == 0:
            if flush_log is not None:
                flush_log()
            trim_heap()
            training.save()
        if time.monotonic() - self._noted > STATUS_SECONDS:
            self._noted = time.monotonic()
            training.folder.set_status(status())


def _last_checkpoint(folder: StageFolder) -> str:
    saved, _ = load_latest_checkpoint(folder.checkpoints)
    if saved is None:
        return "There is no checkpoint yet."
    return f"The checkpoint of iteration {saved.iteration} is kept in {folder.checkpoints}."


def _rescue(training: TrainingSession) -> str:
    """Save the state after memory ran out, if every step of it is whole and there is room; what is kept then."""
    trim_heap()
    folder = training.folder
    if training.is_consistent():
        try:
            training.save()
        except (VdgsError, *MEMORY_ERRORS):
            pass  # what was saved before is still there
        else:
            return f"The checkpoint of iteration {training.state.iteration} is saved in {folder.checkpoints}."
    try:
        return _last_checkpoint(folder)
    except MEMORY_ERRORS:
        return f"Earlier checkpoints are kept in {folder.checkpoints}."


def _requested_bytes(error: BaseException) -> str:
    """How much could not be allocated, where the error names it."""
    size = re.search(r"allocate ([\d.]+) (bytes|[KMG]iB)", str(error))
    return f" ({size.group(1)} {size.group(2)} more could not be had)" if size else ""
