"""The coarse stage: one global anchor model from a whole capture, resumable at every moment."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from rich.console import Console

from vdgs import __version__
from vdgs.anchors import AnchorModel, initial_anchors
from vdgs.captures.capture import Capture
from vdgs.captures.checks import check_images
from vdgs.captures.facts import capture_facts, refuse_another_capture
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.options import CaptureOptions
from vdgs.checkpoints import discard_after, load_newest, save_state
from vdgs.config import TrainConfig, to_dict, validate, with_iterations
from vdgs.decoder import Decoder
from vdgs.errors import RunError, TrainingDiverged, VdgsError
from vdgs.files import read_json, write_json
from vdgs.progress import TrainingProgress, peak_memory_bytes
from vdgs.run import RunFolder, StageFolder
from vdgs.run_options import CoarseOptions
from vdgs.training import (
    Stage,
    StepReport,
    TrainingState,
    from_saved,
    mean_colour,
    start_state,
    to_saved,
    train,
)

AFTER_DIVERGENCE = (
    "Lower --rates.* or raise --growth.threshold in a new --output, and look at the photographs with `vdgs inspect`."
)
SAVE_MEMORY = (
    "Three settings help, in a new --output: smaller photographs (--images images_4, or --downscale 2), fewer anchors "
    "(--growth.max-anchors), less memory for photographs (--image-memory-gb, also when this run is continued)."
)


class Stopped(VdgsError):
    """Training was asked to stop; its state is saved."""

    stopped = True


def train_coarse(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    config: TrainConfig,
    options: CoarseOptions,
    console: Console,
) -> RunFolder:
    """Train, or continue, the coarse model of a capture. Returns the run.

    Raises CaptureError for a capture that cannot be used, RunError for other settings than the run's, Stopped
    after Ctrl-C or SIGTERM (state saved), TrainingDiverged (last good state kept).
    """
    problems = validate(config)
    if options.save_every < 1 or options.image_memory_gb < 0:
        problems.append("save-every must be at least 1 and image-memory-gb must not be negative")
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    capture = load_capture(capture_path, capture_options)
    config = with_iterations(config, len(capture.train_views))
    run = RunFolder(output)
    with run.locked():
        if run.capture_file.exists():
            refuse_another_capture(run.capture_file, read_json(run.capture_file), capture)
        run.begin(run_settings(capture_path, capture_options, config))
        if run.coarse.is_done():
            console.print(f"{run.coarse.model}: already trained; nothing to do")
            return run
        for warning in capture.warnings:
            console.print(f"[yellow]note[/] {warning}")
        check_images(capture)
        _note_without_growth(config, console)
        write_json(run.capture_file, capture_facts(capture))
        _train(run, capture, config, options, console)
    return run


def run_settings(capture_path: Path, capture_options: CaptureOptions, config: TrainConfig) -> dict[str, Any]:
    """What config.yaml holds: everything that the result depends on."""
    plain = to_dict(capture_options)
    absolute = {name: str(value.resolve()) for name, value in vars(capture_options).items() if isinstance(value, Path)}
    capture = {"path": str(capture_path.resolve())} | plain | absolute
    return {"capture": capture, "training": to_dict(config)}


def _note_without_growth(config: TrainConfig, console: Console) -> None:
    if config.growth.levels and config.growth.until * config.iterations < config.growth.start:
        console.print(
            f"[yellow]note[/] no anchor will grow: growth starts at iteration {config.growth.start} and ends at "
            f"{config.growth.until * config.iterations:.0f}. Give more --iterations or a smaller --growth.start.",
            highlight=False,
        )


def camera_height(capture: Capture) -> float:
    """Median height of the training cameras above the median sparse point; at least a thousandth of their spread."""
    centres = np.array([view.camera.position for view in capture.train_views])
    height = float(np.median(centres[:, 2]) - np.median(capture.points[:, 2]))
    return max(height, 1e-3 * float(np.ptp(capture.points, axis=0).max()), 1e-9)


def _train(run: RunFolder, capture: Capture, config: TrainConfig, options: CoarseOptions, console: Console) -> None:
    folder, views = run.coarse, capture.train_views
    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    state, voxel = _continue_or_start(run, capture, config, console)
    budget = int(options.image_memory_gb * 1e9) or psutil.virtual_memory().available // 4
    factors = tuple(sorted({factor for _, factor in config.resolutions}))
    with ImageCache(views, budget, downscales=factors) as images:
        background = (0.0, 0.0, 0.0)
        if config.loss.background != "black":
            background = mean_colour(images, len(views), factors[-1])
        stage = Stage(config, images, len(views), voxel, camera_height(capture), background)
        _announce(capture, state, config, budget, console)
        folder.set_status("running", iteration=state.iteration)
        try:
            complete = _watched(run, state, stage, options, console)
        except TrainingDiverged as error:
            folder.set_status("failed", iteration=state.iteration, why=str(error))
            raise TrainingDiverged(f"{error} {_kept(folder)} {AFTER_DIVERGENCE}") from error
        except (MemoryError, RuntimeError) as error:
            if not _is_out_of_memory(error):
                raise
            folder.set_status("failed", iteration=state.iteration, why="out of memory")
            raise VdgsError(
                f"{run.path}: out of memory with {len(state.anchors):,} anchors. {_kept(folder)} {SAVE_MEMORY}"
            ) from error
        except VdgsError as error:  # a photograph that is gone, a full disk: every step so far is whole
            folder.set_status("failed", iteration=state.iteration, why=str(error))
            save_state(folder.checkpoints, to_saved(state))
            raise
    if not complete:
        save_state(folder.checkpoints, to_saved(state))
        folder.set_status("stopped", iteration=state.iteration)
        raise Stopped(f"Stopped at iteration {state.iteration}; saved. The same command continues.")
    _finish(run, capture, state, stage, console)


def _watched(run: RunFolder, state: TrainingState, stage: Stage, options: CoarseOptions, console: Console) -> bool:
    """Train until complete (True) or asked to stop, showing, logging and saving on the way."""
    folder, clock = run.coarse, _Clock(state)
    board = _board(run, options, state.iteration)
    with (
        _stop_requests() as stop,
        TrainingProgress(console, folder, stage.config, state.iteration, board) as progress,
    ):

        def after_step(state: TrainingState, report: StepReport) -> None:
            clock.tick()
            progress.step(state, report)
            if state.iteration % options.save_every == 0:
                save_state(folder.checkpoints, to_saved(state))
                progress.flush()

        return train(state, stage, stop=stop, after_step=after_step)


def _kept(folder: StageFolder) -> str:
    kept, _ = load_newest(folder.checkpoints)
    return (
        f"The state of iteration {kept.iteration} is kept in {folder.checkpoints}."
        if kept
        else "No state was saved yet."
    )


def _is_out_of_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or "not enough memory" in str(error) or "bad_alloc" in str(error)


def _continue_or_start(
    run: RunFolder, capture: Capture, config: TrainConfig, console: Console
) -> tuple[TrainingState, float]:
    """The newest whole state of the run, or a new one; and the voxel (recomputed: it follows from the capture)."""
    anchors, voxel = initial_anchors(
        capture.points, capture.point_colours, [view.camera for view in capture.train_views], config.anchors
    )
    saved, complaints = load_newest(run.coarse.checkpoints)
    for complaint in complaints:
        console.print(f"[yellow]note[/] {complaint}")
    if saved is not None:
        try:
            state = from_saved(saved)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(
                f"{run.coarse.checkpoints}: holds a state of another version ({error}). Start a new --output."
            ) from error
        if state.iteration > config.iterations:
            raise RunError(f"{run.coarse.checkpoints}: is at iteration {state.iteration}, beyond {config.iterations}.")
        discard_after(run.coarse.checkpoints, state.iteration)
        console.print(f"continuing at iteration {state.iteration}")
    else:
        if complaints:
            console.print("[yellow]note[/] no saved state is whole: starting again from the first iteration")
        generator = torch.Generator().manual_seed(config.seed)
        state = start_state(
            anchors,
            Decoder.initial(
                config.anchors.offsets, config.anchors.distance, config.anchors.appearance,
                len(capture.train_views), generator,
            ),
        )  # fmt: skip
    run.coarse.cut_log(state.iteration)
    return state, voxel


def _finish(run: RunFolder, capture: Capture, state: TrainingState, stage: Stage, console: Console) -> None:
    facts = {"capture": capture_facts(capture), "version": __version__, "iterations": state.iteration}
    model = AnchorModel(state.anchors, state.decoder, stage.voxel, stage.background, facts)
    save_state(run.coarse.checkpoints, to_saved(state))
    model.save(run.coarse.model)
    run.coarse.set_status(
        "done", iteration=state.iteration, anchors=len(state.anchors), seconds=state.seconds,
        psnr_training=None if math.isnan(state.psnr) else state.psnr, peak_memory_bytes=state.peak_memory_bytes,
    )  # fmt: skip
    minutes, seconds = divmod(round(state.seconds), 60)
    console.print(
        f"trained {state.iteration} iterations in {minutes} min {seconds} s: {len(state.anchors):,} anchors, "
        f"PSNR of training views {state.psnr:.2f} dB, peak memory {state.peak_memory_bytes / 1e9:.1f} GB\n"
        f"model: {run.coarse.model}\nnext:  vdgs eval {run.path}",
        highlight=False,
    )


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
def _stop_requests() -> Iterator[Any]:
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


def _board(run: RunFolder, options: CoarseOptions, iteration: int) -> Any:
    if not options.tensorboard:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise VdgsError('TensorBoard is not installed: pip install "vdgs[tensorboard]"') from error
    return SummaryWriter(str(run.coarse.path / "tensorboard"), purge_step=iteration)


def _announce(capture: Capture, state: TrainingState, config: TrainConfig, budget: int, console: Console) -> None:
    camera = capture.train_views[0].camera
    pixels = sum(view.camera.width * view.camera.height for view in capture.train_views)
    console.print(
        f"{capture.root} ({capture.images}): {len(capture.train_views)} training and {len(capture.test_views)} test "
        f"views of {camera.width}x{camera.height}, {len(capture.points):,} points, {len(state.anchors):,} anchors, "
        f"{config.iterations:,} iterations\n"
        f"memory: images {min(budget, 3 * pixels * 4 // 3) / 1e9:.2f} GB (at most {budget / 1e9:.1f}), "
        "about 1 kB an anchor, 4 kB while it is in view",
        highlight=False,
    )
