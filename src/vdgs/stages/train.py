"""All blocks of a run, several at once, each in a process of its own."""

from __future__ import annotations

import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.executors.blocks import BlockCommand, default_jobs, run_blocks
from vdgs.executors.local import LocalExecutor
from vdgs.kernels import threads as threads_available
from vdgs.memory.estimate import Need, estimate, in_gb
from vdgs.memory.process import available_bytes
from vdgs.runs.cut import blocks_of
from vdgs.runs.folder import RunFolder, StageFolder
from vdgs.runs.status import Status
from vdgs.settings.method import block_limit
from vdgs.settings.watching import WatchOptions

#: Share of a block's anchors that one photograph may see, for the estimate before a block is opened (choice).
SEEN = 0.5


def train_blocks(path: Path, options: WatchOptions, jobs: int, console: Console, device: str = "cpu") -> None:
    """Train, or continue, all blocks of a run that are not finished.

    `jobs` processes at once, each on `device`; 0 takes as many as cores and memory allow. Raises RunError if a block
    failed (the others are trained first), Stopped after Ctrl-C or SIGTERM (every block saved).
    """
    options.check()
    if jobs < 0:
        raise VdgsError(f"--jobs is {jobs}; it must be at least 1, or 0 for what cores and memory allow")
    run = RunFolder(path)
    with run.locked(shared=True):
        blocks, key = blocks_of(run), run.keys().blocks
        _remove_beyond(run, len(blocks), console)
        left = [index for index in range(len(blocks)) if not run.block(index).is_done(key)]
        if not left:
            console.print(f"{path}/blocks: all {len(blocks)} trained; nothing to do", highlight=False)
            return
        free = available_bytes()
        each = _block_bytes(run)
        at_once, threads = default_jobs(len(left), threads_available(), free, each)
        if jobs:
            at_once, threads = min(jobs, len(left)), max(1, threads_available() // min(jobs, len(left)))
        budget = options.image_memory_gb or free / 4e9
        console.print(
            f"{len(left)} of {len(blocks)} blocks to train, {at_once} at once with {threads} thread(s) each; by "
            f"estimate a block takes at most {in_gb(each)} beside its photographs, of {in_gb(free)} free",
            highlight=False,
        )
        if at_once * each > free:
            console.print(
                f"[yellow]warning[/] {at_once} at once may run out of memory. What helps: less --jobs, more --blocks, "
                "--block.growth.max-anchors",
                highlight=False,
            )
        _note_discarded(run, left, key, console)
        began = time.monotonic()
        for index in left:
            _mark_queued(run.block(index), key)
        commands = [_command(run, index, threads, budget / at_once, options, device) for index in left]
        outcomes = run_blocks(commands, LocalExecutor(at_once), console)
    if any(outcome.state == "stopped" for outcome in outcomes):
        raise Stopped("Stopped; every block that was training is saved. The same command continues.")
    failed = [outcome for outcome in outcomes if outcome.state != "done"]
    if failed:
        raise RunError(
            f"{path}: {len(failed)} of {len(blocks)} blocks failed:\n  "
            + "\n  ".join(f"{outcome.name}: {outcome.why}" for outcome in failed)
            + f"\nTheir output is in {path}/blocks/NN/output.log. The same command tries them again."
        )
    console.print(f"blocks trained in {(time.monotonic() - began) / 60:.1f} min", highlight=False)


def _command(
    run: RunFolder, index: int, threads: int, image_gb: float, options: WatchOptions, device: str
) -> BlockCommand:  # fmt: skip
    command = [
        sys.executable, "-m", "vdgs.cli", "train", str(run.path), "--block", str(index), "--threads", str(threads),
        "--image-memory-gb", f"{image_gb:.3f}", "--save-every", str(options.save_every), "--device", device,
    ]  # fmt: skip
    if options.tensorboard:
        command.append("--tensorboard")
    return BlockCommand(index, run.block(index), command)


def _note_discarded(run: RunFolder, left: list[int], key: str, console: Console) -> None:
    """Say which blocks were trained for another cut or with other settings: what they hold is about to go."""
    old = [index for index in left if run.block(index).holds_work() and run.block(index).key() != key]
    if old:
        console.print(
            f"[yellow]note[/] trained for another cut or with other settings, and trained again: block"
            f"{'s' if len(old) > 1 else ''} {', '.join(map(str, old))}",
            highlight=False,
        )


def _mark_queued(folder: StageFolder, key: str) -> None:
    """Let a block say that it waits for its turn, and hold no work of other settings.

    Not if another process trains it already: its status is then its own.
    """
    with suppress(RunError), folder.locked():
        folder.discard_unless(key)
        if not folder.is_done(key):
            folder.set_status(Status("queued"))


def _remove_beyond(run: RunFolder, count: int, console: Console) -> None:
    """Delete blocks of an earlier cut into more of them."""
    for folder in run.block_folders():
        if int(folder.path.name) >= count:
            console.print(f"[yellow]note[/] {folder.path} is of an earlier cut and is deleted", highlight=False)
            shutil.rmtree(folder.path)


def _block_bytes(run: RunFolder) -> int:
    """Memory by estimate that the largest block needs for the program, its anchors once they have grown, and those
    around it. Photographs have a budget of their own."""
    method, anchors = run.method(), [each.anchors_core for each in run.partition_record().blocks]
    limit = block_limit(method.block, max(anchors), sum(anchors))
    need = Need(
        anchors=max(anchors), max_anchors=limit, offsets=method.training.anchors.offsets,
        seen=SEEN, pixels=0, images_bytes=0, surroundings=sum(anchors) - max(anchors),
    )  # fmt: skip
    return estimate(need).total
