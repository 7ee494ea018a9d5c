"""Blocks that train in turn in one process and exchange something after every round (Momentum-GS, DOGS): shown, logged,
checkpointed, stopped and continued as one training.

    FOLDER/checkpoints/  log.jsonl  status.json
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from rich.console import Console
from torch import Tensor

from vdgs.config.executor_options import CheckpointOptions
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.checkpoints import Checkpoint
from vdgs.system.console import LINE_INTERVAL_SECONDS
from vdgs.training.session.training_session import Checkpointer, TrainingSession, run_session


class BlockState(Protocol):
    """What is asked of the state of one block."""

    iteration: int
    seconds: float
    peak_memory_bytes: int
    loss: float
    is_consistent: bool


class JointTraining(ABC):
    """The blocks of a scene, `interval` steps of each in turn until each has made `last`. All of them begin and end
    together."""

    def __init__(self, blocks: Sequence[BlockState], interval: int, last: int) -> None:
        self.blocks, self.interval, self.last = blocks, interval, last
        #: Steps of all blocks, and what they took: this is the state of a session.
        self.iteration = sum(block.iteration for block in blocks)
        self.seconds = sum(block.seconds for block in blocks)
        self.peak_memory_bytes = max((block.peak_memory_bytes for block in blocks), default=0)

    @abstractmethod
    def step(self, index: int) -> None:
        """One step of a block."""

    @abstractmethod
    def end_round(self) -> None:
        """What the blocks exchange after all of them have had their turn."""

    @abstractmethod
    def block_checkpoint(self, index: int) -> Checkpoint:
        """The whole state of a block."""

    @abstractmethod
    def shared(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What belongs to no single block, as metadata and tensors."""

    @abstractmethod
    def size(self) -> str:
        """How large all models are, in words."""

    def facts(self) -> dict[str, Any]:
        """What people may want to know of the exchange, for the log."""
        return {}

    def advance(self) -> int | None:
        """One step of the block whose turn it is; which one, or None where all are complete."""
        index = next_in_turn([block.iteration for block in self.blocks], self.interval, self.last)
        if index is None:
            return None
        self.step(index)
        self.iteration += 1
        counts = {block.iteration for block in self.blocks}
        if len(counts) == 1 and (min(counts) % self.interval == 0 or min(counts) == self.last):
            self.end_round()
        return index

    def to_checkpoint(self) -> Checkpoint:
        metadata, tensors = self.shared()
        saved = [self.block_checkpoint(index) for index in range(len(self.blocks))]
        for index, block in enumerate(saved):
            tensors |= {f"{index}.{name}": tensor for name, tensor in block.tensors.items()}
        metadata["blocks"] = [{"iteration": block.iteration, "facts": dict(block.metadata)} for block in saved]
        return Checkpoint(self.iteration, metadata, tensors)


def next_in_turn(iterations: Sequence[int], interval: int, last: int) -> int | None:
    """The block whose turn it is, from how many steps each has made: a training that continues asks nothing else."""
    begun = min(iterations, default=last)
    if begun >= last:
        return None
    end = min((begun // interval + 1) * interval, last)
    return next(index for index, done in enumerate(iterations) if done < end)


def split_checkpoint(saved: Checkpoint) -> list[Checkpoint]:
    """The states of the blocks in a state of all of them. Raises KeyError if something is missing."""
    blocks: Sequence[Mapping[str, Any]] = saved.metadata["blocks"]
    return [
        Checkpoint(
            block["iteration"], block["facts"],
            {k.removeprefix(f"{index}."): v for k, v in saved.tensors.items() if k.startswith(f"{index}.")},
        )
        for index, block in enumerate(blocks)
    ]  # fmt: skip


def train_in_turns(folder: StageFolder, training: JointTraining, options: CheckpointOptions, console: Console) -> None:
    """Train all blocks to the end, and save their last state. Raises what `run_session` raises."""
    blocks = training.blocks
    steps = training.last * len(blocks)

    def status() -> StatusRecord:
        return StatusRecord(
            state="running", iteration=training.iteration, iterations=steps, seconds=round(training.seconds, 1),
            peak_memory_bytes=training.peak_memory_bytes,
        )  # fmt: skip

    session = TrainingSession(
        folder=folder, state=training, to_checkpoint=training.to_checkpoint, status=status, size=training.size,
        divergence_hint="", memory_hint=lambda: "Fewer blocks or smaller photographs, in another output folder, help.",
        is_consistent=lambda: all(block.is_consistent for block in blocks),
    )  # fmt: skip

    def loop(stop: Callable[[], bool]) -> bool:
        checkpointer, shown = Checkpointer(session, options.save_every), time.monotonic()
        while not stop():
            before = training.seconds
            index = training.advance()
            if index is None:
                return True
            checkpointer.update_timers()
            blocks[index].seconds += training.seconds - before
            blocks[index].peak_memory_bytes = training.peak_memory_bytes
            if blocks[index].iteration % training.interval == 0:
                _log(folder, training, index)
            checkpointer.save_if_due(status)
            if time.monotonic() - shown > LINE_INTERVAL_SECONDS:
                shown = time.monotonic()
                console.print(f"{training.iteration}/{steps}  {training.size()}", highlight=False)
        return False

    run_session(session, loop)
    session.save()
    folder.set_status(replace(status(), state="done"))


def _log(folder: StageFolder, training: JointTraining, index: int) -> None:
    """The end of a block's turn."""
    record = {
        "iteration": training.iteration, "block": index, "of_block": training.blocks[index].iteration,
        "loss": training.blocks[index].loss, "seconds": round(training.seconds, 3), **training.facts(),
    }  # fmt: skip
    with folder.log.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")
