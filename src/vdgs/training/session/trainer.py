"""Training of anchors with progress, log, checkpoints and advice, for the coarse stage and for blocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import TrainConfig
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint, state_file
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.tensors import file_id
from vdgs.system.units import data_size
from vdgs.training import (
    StepReport,
    TrainingProblem,
    TrainingState,
    from_checkpoint,
    result_from_saved,
    to_checkpoint,
    train,
)
from vdgs.training.session.memory_advice import out_of_memory_hint, print_memory_estimate, training_workload
from vdgs.training.session.training_progress import TrainingProgress
from vdgs.training.session.training_session import Checkpointer, TrainingSession, restore_or_start, run_session


def image_cache_bytes(options: CheckpointOptions) -> int:
    """Bytes for decoded photographs."""
    return int(options.image_cache_gb * 1e9) or available_memory_bytes() // 4


#: What to do about a diverging loss, in the coarse stage and in a block.
DIVERGENCE_HINTS = {
    "coarse": "Lower --lr.* or raise --densify.grad-threshold in a new --output, and look at the photographs with "
    "`vdgs inspect`.",
    "block": "Lower --block.lr-scale-offsets, --block.lr-scale-log-scales and --block.lr-scale-features or raise "
    "--block.densify.grad-threshold (with --overwrite).",
}


@dataclass(frozen=True)
class CheckpointModel:
    """What the newest whole checkpoint of a stage has arrived at."""

    anchors: Anchors
    decoder: Decoder
    iteration: int
    file: Path


def model_from_checkpoint(folder: StageFolder, key: str) -> CheckpointModel | None:
    """The model of the newest whole checkpoint of a stage; None without one, or if it is of other settings than
    `key`."""
    saved = load_latest_checkpoint(folder.checkpoints)[0] if folder.key() == key else None
    if saved is None:
        return None
    return CheckpointModel(*result_from_saved(saved), saved.iteration, state_file(folder.checkpoints, saved.iteration))


def resume_or_start(
    folder: StageFolder, stage: TrainingProblem, start: Callable[[], TrainingState], console: Console
) -> TrainingState:
    """The state of the newest whole checkpoint, or a new one; the log ends where the state does.

    Raises RunError for a state that this version cannot read or that is beyond the last iteration.
    """
    advice, restore = "Begin another run: vdgs run CAPTURE --output RUN", lambda saved: from_checkpoint(saved, stage)
    return restore_or_start(folder, stage.config.iterations, start, restore, advice, console)


def train_with_checkpoints(
    folder: StageFolder, state: TrainingState, stage: TrainingProblem, options: CheckpointOptions, console: Console
) -> None:
    """Train to the end of the stage, showing, logging and saving on the way.

    Says first how much memory it will take. Raises what `run_session` raises.
    """
    kind, need = stage.kind, training_workload(state, stage)
    print_memory_estimate(need, kind, console)
    training = TrainingSession(
        folder=folder, state=state,
        to_checkpoint=lambda: to_checkpoint(state),
        status=lambda: StatusRecord(state="running", iteration=state.iteration, iterations=stage.config.iterations),
        size=lambda: f"{len(state.anchors):,} anchors",
        divergence_hint=DIVERGENCE_HINTS[kind],
        memory_hint=lambda: out_of_memory_hint(need, state, stage),
        is_consistent=lambda: state.is_consistent,
    )  # fmt: skip

    def loop(stop: Callable[[], bool]) -> bool:
        checkpointer, board = Checkpointer(training, options.save_every), _board(folder, options, state.iteration)
        with TrainingProgress(console, folder, stage.config, state.iteration, board) as progress:

            def after_step(state: TrainingState, report: StepReport) -> None:
                checkpointer.update_timers()
                progress.step(state, report)
                checkpointer.save_if_due(lambda: progress.status(state), progress.flush)

            return train(state, stage, stop=stop, after_step=after_step)

    run_session(training, loop)


def finish_stage(
    folder: StageFolder, state: TrainingState, model: AnchorModel, console: Console, area: float = 1.0
) -> None:
    """Save the model of a stage that is complete, mark it done and say so. `area`: mean share of a photograph that a
    step drew."""
    save_checkpoint(folder.checkpoints, to_checkpoint(state))
    model.save(folder.model)
    status = StatusRecord(
        state="done", iteration=state.iteration, iterations=state.iteration,
        images_drawn=round(area * state.iteration, 1), anchors=len(state.anchors), model_id=file_id(folder.model),
        seconds=state.seconds, psnr_training=None if math.isnan(state.psnr) else state.psnr,
        peak_memory_bytes=state.peak_memory_bytes,
    )  # fmt: skip
    folder.set_status(status)
    minutes, seconds = divmod(round(state.seconds), 60)
    console.print(
        f"trained {state.iteration} iterations in {minutes} min {seconds} s: {len(state.anchors):,} anchors, "
        f"PSNR while training {state.psnr:.2f} dB, peak memory {data_size(state.peak_memory_bytes)}\n"
        f"model: {folder.model}",
        highlight=False,
    )


def warn_without_densification(config: TrainConfig, console: Console, prefix: str = "--") -> None:
    """Print a note if growth would start after its end; `prefix` is that of the stage's options."""
    if config.densify.num_levels and config.densify.stop_fraction * config.iterations < config.densify.start:
        console.print(
            f"[yellow]note[/] no anchor will grow: growth starts at iteration {config.densify.start} and ends at "
            f"{config.densify.stop_fraction * config.iterations:.0f}. Give more {prefix}iterations or a smaller "
            f"{prefix}densify.start.",
            highlight=False,
        )


def _board(folder: StageFolder, options: CheckpointOptions, iteration: int) -> Any:
    if not options.tensorboard:
        return None
    from torch.utils.tensorboard import SummaryWriter  # of an extra: `CheckpointOptions.check`

    return SummaryWriter(str(folder.path / "tensorboard"), purge_step=iteration)
