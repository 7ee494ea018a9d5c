"""One shard of a job, done by this process (`run_shard` is its entry point)."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from vdgs.config.serialization import from_dict
from vdgs.distributed.sharded_job import REQUEST, ShardedJob
from vdgs.errors import Interrupted, RunError, Stopped, VdgsError
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import read_json
from vdgs.system.memory.process_memory import peak_memory_bytes
from vdgs.system.stop_signals import check_stop_requested

#: What does a shard, by the word that stands in the request: nothing that a file names is called but these.
WORKERS = {
    "block": "vdgs.pipeline.train_block:train_shard",
    "scores": "vdgs.pipeline.partition_stage:score_shard",
    "views": "vdgs.pipeline.evaluate_stage:measure_shard",
    "tiles": "vdgs.rendering.ortho.tile_shards:draw_shard",
    "baking": "vdgs.export.bake_shard:bake_shard",
}
#: Seconds between two notes of how far a shard is.
STATUS_SECONDS = 1.0

Request = TypeVar("Request")
#: Computes items, in their order; for each, what writes the result into its file.
Results = Generator[Callable[[Path], None], None, None]


@dataclass(frozen=True)
class Shard:
    """A shard that this process is to do, and what it is given for that."""

    folder: Path
    """Of the job."""
    index: int
    device: str
    image_gb: float
    """Memory for photographs."""
    console: Console

    def request(self, kind: type[Request]) -> Request:
        """What is asked for. Raises RunError where that is missing or damaged."""
        file = self.folder / REQUEST
        try:
            return from_dict(kind, read_json(file)["request"], "")  # type: ignore[no-any-return]
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{file}: is damaged ({error}). Run the command that sends out the shards again.") from error

    def do(self, job: ShardedJob, results: Callable[[Sequence[int]], Results]) -> None:
        """Do the items that are left of this shard; nothing if it is done. `results` computes those that it is given.

        Raises RunError where the run has changed, so that its job is another now, and for a shard that there is not.
        """
        if job.folder != self.folder:
            raise RunError(
                f"{self.folder}: is for another model, other settings or another vdgs than are there now. Run the "
                "command that sent out the shard again."
            )
        if not 0 <= self.index < len(job.spans):
            raise RunError(f"{self.folder}: there is no shard {self.index}; they are 0 to {len(job.spans) - 1}.")
        folder, span = job.shard(self.index), job.spans[self.index]
        if job.is_done(self.index):
            self.console.print(f"{folder.path}: already done; nothing to do", highlight=False)
            return
        left = [item for item in span if not job.file(item).exists()]
        done = len(span) - len(left)
        with shard_session(folder, done, len(span)) as tell, closing(results(left)) as writers:
            for item in left:
                check_stop_requested()
                next(writers)(job.file(item))
                done += 1
                tell(done)


def run_shard(shard: Shard) -> None:
    """Let its worker do a shard. Raises RunError where nothing says what to do, and what the worker raises."""
    file = shard.folder / REQUEST
    written = read_json(file)
    worker = WORKERS.get(str(written.get("worker"))) if isinstance(written, dict) else None
    if worker is None:
        raise RunError(f"{file}: names no worker of this vdgs ({', '.join(WORKERS)}). Is it of another version?")
    module, _, name = worker.partition(":")
    getattr(importlib.import_module(module), name)(shard)


@contextmanager
def shard_session(folder: StageFolder, done: int, total: int) -> Iterator[Callable[[int], None]]:
    """Hold the folder of a shard and note there how far it is: to be told how many of its items are done.

    Raises Stopped after Ctrl-C or SIGTERM, and whatever is raised within; both are noted.
    """
    began, noted = time.monotonic(), 0.0
    before = done

    def status(state: str, why: str | None = None) -> StatusRecord:
        taken = time.monotonic() - began
        left = round((total - done) * taken / (done - before)) if done > before else None
        return StatusRecord(
            state=state, reason=why, iteration=done, iterations=total, seconds=taken, seconds_left=left,
            peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip

    def tell(now: int) -> None:
        nonlocal done, noted
        done = now
        if time.monotonic() - noted > STATUS_SECONDS:
            noted = time.monotonic()
            folder.set_status(status("running"))

    with folder.locked():
        tell(done)
        try:
            yield tell
        except (KeyboardInterrupt, Interrupted) as error:
            folder.set_status(status("stopped"))
            raise Stopped(
                f"Stopped after {done} of {total}; what is done is saved. The same command continues."
            ) from error
        except VdgsError as error:
            folder.set_status(status("failed", str(error)))
            raise
        folder.set_status(status("done"))
