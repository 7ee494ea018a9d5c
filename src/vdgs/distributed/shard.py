"""One shard of a job, done by this process (`python -m vdgs.distributed.run_shard`)."""

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

#: The workers that a request may name: nothing else that a file names is called.
WORKERS = {
    "block": "vdgs.pipeline.train_block:train_shard",
    "scores": "vdgs.pipeline.partition_stage:score_shard",
    "views": "vdgs.pipeline.evaluate_stage:measure_shard",
    "tiles": "vdgs.rendering.ortho.tile_shards:draw_shard",
    "baking": "vdgs.export.bake_shard:bake_shard",
}
#: Seconds between two updates of the status of a shard.
STATUS_SECONDS = 1.0

Request = TypeVar("Request")
#: Computes items, in their order; for each, what writes the result into its file.
Results = Generator[Callable[[Path], None], None, None]


@dataclass(frozen=True)
class Shard:
    """A shard that this process is to do, and its resources."""

    folder: Path
    """Of the job."""
    index: int
    device: str
    image_gb: float
    """Memory for images."""
    console: Console

    def request(self, kind: type[Request]) -> Request:
        """The request of the job. Raises RunError where it is missing or damaged."""
        file = self.folder / REQUEST
        try:
            return from_dict(kind, read_json(file)["request"], "")  # type: ignore[no-any-return]
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{file}: is damaged ({error}). Run the command that sends out the shards again.") from error

    def do(self, job: ShardedJob, results: Callable[[Sequence[int]], Results]) -> None:
        """Do the items that are left of this shard; nothing if it is done. `results` computes the items it is given.

        Raises RunError where the run has changed, so that its job is another now, and for an index out of range.
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
        with shard_session(folder, done, len(span)) as on_progress, closing(results(left)) as writers:
            for count, item in enumerate(left, done + 1):
                check_stop_requested()
                next(writers)(job.file(item))
                on_progress(count)


def run_shard(shard: Shard) -> None:
    """Let its worker do a shard. Raises RunError where the request names none, and what the worker raises."""
    file = shard.folder / REQUEST
    request = read_json(file)
    worker = WORKERS.get(str(request.get("worker"))) if isinstance(request, dict) else None
    if worker is None:
        raise RunError(f"{file}: names no worker of this vdgs ({', '.join(WORKERS)}). Is it of another version?")
    module, _, name = worker.partition(":")
    getattr(importlib.import_module(module), name)(shard)


@contextmanager
def shard_session(folder: StageFolder, done: int, total: int) -> Iterator[Callable[[int], None]]:
    """Lock the folder of a shard and keep its status file there; yields a function that takes the number of items done.

    Raises Stopped after Ctrl-C or SIGTERM, and whatever is raised within; both are written to the status file.
    """
    start, done_before, last_update = time.monotonic(), done, 0.0

    def set_status(state: str, reason: str | None = None) -> None:
        seconds = time.monotonic() - start
        left = round((total - done) * seconds / (done - done_before)) if done > done_before else None
        status = StatusRecord(
            state=state, reason=reason, iteration=done, iterations=total, seconds=seconds, seconds_left=left,
            peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        folder.set_status(status)

    def on_progress(now: int) -> None:
        nonlocal done, last_update
        done = now
        if time.monotonic() - last_update > STATUS_SECONDS:
            last_update = time.monotonic()
            set_status("running")

    with folder.locked():
        on_progress(done)
        try:
            yield on_progress
        except (KeyboardInterrupt, Interrupted) as error:
            set_status("stopped")
            raise Stopped(
                f"Stopped after {done} of {total}; what is done is saved. The same command continues."
            ) from error
        except VdgsError as error:
            set_status("failed", str(error))
            raise
        set_status("done")
