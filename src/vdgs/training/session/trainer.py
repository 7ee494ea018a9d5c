"""Training of anchors, watched: what the coarse stage and a block show, log and advise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from vdgs.config.checkpointing import WatchOptions
from vdgs.config.method import TrainConfig
from vdgs.errors import VdgsError
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.runs.stage_folder import StageFolder, Status
from vdgs.system.checkpoints import load_newest, save_state, state_file
from vdgs.system.memory.process_memory import available_bytes
from vdgs.system.tensors import identity
from vdgs.system.units import data_size
from vdgs.training import Stage, StepReport, TrainingState, from_saved, result_from_saved, to_saved, train
from vdgs.training.session.memory_advice import after_failure, announce, need_of
from vdgs.training.session.training_progress import TrainingProgress
from vdgs.training.session.training_session import Keeper, Watched, restore_or_start, watch


def image_budget(options: WatchOptions) -> int:
    """Bytes for decoded photographs."""
    return int(options.image_memory_gb * 1e9) or available_bytes() // 4


#: What to do about a diverging loss, in the coarse stage and in a block.
AFTER_DIVERGENCE = {
    "coarse": "Lower --rates.* or raise --growth.threshold in a new --output, and look at the photographs with "
    "`vdgs inspect`.",
    "block": "Lower --block.offset-rate, --block.scale-rate and --block.feature-rate or raise "
    "--block.growth.threshold (with --redo).",
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
    saved = load_newest(folder.checkpoints)[0] if folder.key() == key else None
    if saved is None:
        return None
    return CheckpointModel(*result_from_saved(saved), saved.iteration, state_file(folder.checkpoints, saved.iteration))


def continue_or_start(
    folder: StageFolder, stage: Stage, start: Callable[[], TrainingState], console: Console
) -> TrainingState:
    """The state of the newest whole checkpoint, or a new one; the log ends where the state does.

    Raises RunError for a state that this version cannot read or that is beyond the last iteration.
    """
    return restore_or_start(
        folder, stage.config.iterations, start, lambda saved: from_saved(saved, stage), "Start a new --output.", console
    )


def train_watched(
    folder: StageFolder, state: TrainingState, stage: Stage, options: WatchOptions, console: Console
) -> None:
    """Train to the end of the stage, showing, logging and saving on the way.

    Says first how much memory it will take. Raises what `watch` raises.
    """
    kind, need = stage.kind, need_of(state, stage)
    announce(need, kind, console)
    training = Watched(
        folder=folder, state=state,
        to_saved=lambda: to_saved(state),
        status=lambda: Status(state="running", iteration=state.iteration, iterations=stage.config.iterations),
        size=lambda: f"{len(state.anchors):,} anchors",
        after_divergence=AFTER_DIVERGENCE[kind],
        save_memory=lambda: after_failure(need, state, stage),
        whole=lambda: state.whole,
    )  # fmt: skip

    def loop(stop: Callable[[], bool]) -> bool:
        keeper, board = Keeper(training, options.save_every), _board(folder, options, state.iteration)
        with TrainingProgress(console, folder, stage.config, state.iteration, board) as progress:

            def after_step(state: TrainingState, report: StepReport) -> None:
                keeper.tick()
                progress.step(state, report)
                keeper.keep(lambda: progress.status(state), progress.flush)

            return train(state, stage, stop=stop, after_step=after_step)

    watch(training, loop)


def finish(folder: StageFolder, state: TrainingState, model: AnchorModel, console: Console, area: float = 1.0) -> None:
    """Save the model of a stage that is complete, mark it done and say so. `area`: mean share of a photograph that a
    step drew."""
    save_state(folder.checkpoints, to_saved(state))
    model.save(folder.model)
    status = Status(
        state="done", iteration=state.iteration, iterations=state.iteration,
        photographs=round(area * state.iteration, 1), anchors=len(state.anchors), model=identity(folder.model),
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


def note_without_growth(config: TrainConfig, console: Console, prefix: str = "--") -> None:
    """Say so where growth would begin after it has ended; `prefix` is that of the stage's options."""
    if config.growth.levels and config.growth.until * config.iterations < config.growth.start:
        console.print(
            f"[yellow]note[/] no anchor will grow: growth starts at iteration {config.growth.start} and ends at "
            f"{config.growth.until * config.iterations:.0f}. Give more {prefix}iterations or a smaller "
            f"{prefix}growth.start.",
            highlight=False,
        )


def _board(folder: StageFolder, options: WatchOptions, iteration: int) -> Any:
    if not options.tensorboard:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise VdgsError('TensorBoard is not installed: pip install "vdgs[tensorboard]"') from error
    return SummaryWriter(str(folder.path / "tensorboard"), purge_step=iteration)
