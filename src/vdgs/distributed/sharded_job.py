"""A job of many items, cut into shards that processes do side by side: on this machine, on a Ray cluster or by SLURM.

    OUTPUT/shards/KEY/request.json   which worker does the shards (`shard.WORKERS`), and what is asked of it
    OUTPUT/shards/KEY/NN/            of shard NN: status.json, output.log, a file for each of its items once it is done,
                                     each whole or absent; what is there is not done again
    OUTPUT/shards/KEY/slurm/         as in a run folder, where jobs of SLURM do the work

KEY tells what the results depend on: what was begun for another model or with other settings is never gathered, nor
found by a driver that wants something else. All of it is removed once the items are gathered (`job_folders`).
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.serialization import to_dict
from vdgs.distributed.backend_selection import MachineResources, select_backend
from vdgs.distributed.executor import TaskResult
from vdgs.distributed.job_folders import SHARDS, clear, remove
from vdgs.distributed.job_labels import JobLabels
from vdgs.distributed.node_check import NodeRequirements, code_digest
from vdgs.distributed.resource_allocation import Allocation, ShardWorkload
from vdgs.distributed.shard_runner import Shard, run_shards
from vdgs.errors import RunError, Stopped
from vdgs.kernels import get_num_threads as threads_available
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.process_memory import available_memory_bytes

#: The file in the folder of a job that says what is asked of its shards.
REQUEST = "request.json"
#: Fields of requests that every shard is given anew: they change no result.
GIVEN = ("device", "threads")

Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class ExecutionOptions:
    """What a person asks of the place where shards are done."""

    executor_options: ExecutorOptions
    jobs: int = 0
    """Shards at once; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for photographs; 0: by the memory that there is. On a cluster: of one shard."""
    device: str = "cpu"

    @property
    def is_distributed(self) -> bool:
        """Whether work goes out even if one process could do it: to a cluster, or to several processes at once."""
        return self.executor_options.executor != "local" or self.jobs > 1


@dataclass(frozen=True)
class ShardNeeds:
    """What a shard needs of a machine."""

    memory_bytes: int
    """Memory of the largest by estimate, beside its photographs."""
    question: Callable[[], NodeRequirements]
    """What machines must see; asked of other machines only."""
    photographs_bytes: int = 0
    """What all photographs of a shard take at most, decoded; 0 where it keeps none."""


def split_ranges(items: int, min_items: int, max_items: int, shards: int) -> tuple[range, ...]:
    """Items from 0, cut into spans of about equal length: so many `shards` as long as none is shorter than `least` or
    longer than `most`. Nothing but the number of items decides, so that any driver cuts the same."""
    each = min(max_items, max(min_items, -(-items // shards)))
    count = max(1, -(-items // each))
    ends = [items * place // count for place in range(count + 1)]
    return tuple(range(begin, end) for begin, end in pairwise(ends))


@dataclass(frozen=True, kw_only=True)
class ShardedJob:
    """Items that are numbered from 0, the shards that they are done in, and what is asked of these.

    The driver makes it to run the shards and to gather the items; each shard makes the same of the request.
    """

    worker: str
    """One of `shard.WORKERS`."""
    request: Any
    """A dataclass of plain values, tuples, paths and such dataclasses."""
    folder: Path
    kind: JobLabels
    spans: tuple[range, ...]
    """The items of each shard."""
    suffix: str = ".npz"
    """How the names of the items' files end."""

    @staticmethod
    def of(
        worker: str, request: Any, output: Path, kind: JobLabels, depends_on: Any, spans: Sequence[range],
        suffix: str = ".npz",
    ) -> ShardedJob:  # fmt: skip
        """The job for a folder whose results depend on these plain values, its spans and the code that does it."""
        told = json.dumps([code_digest(), depends_on, [[span.start, span.stop] for span in spans]])
        folder = Path(os.path.abspath(output)) / SHARDS / hashlib.sha256(told.encode()).hexdigest()[:12]
        return ShardedJob(worker=worker, request=request, folder=folder, kind=kind, spans=tuple(spans), suffix=suffix)

    @property
    def key(self) -> str:
        return self.folder.name

    @property
    def output(self) -> Path:
        """The folder that the job is for."""
        return self.folder.parents[1]

    def shard(self, index: int) -> StageFolder:
        return StageFolder(self.folder / f"{index:02d}")

    def file(self, item: int, suffix: str = "") -> Path:
        """What an item leaves."""
        index = next(index for index, span in enumerate(self.spans) if item in span)
        return self.shard(index).path / f"{item:06d}{suffix or self.suffix}"

    def is_done(self, index: int) -> bool:
        return self.shard(index).status().state == "done"

    @property
    def pending(self) -> list[int]:
        """The shards that are not done."""
        return [index for index in range(len(self.spans)) if not self.is_done(index)]

    @property
    def peak_memory_bytes(self) -> int:
        """The most that a shard took."""
        return max(self.shard(index).status().peak_memory_bytes or 0 for index in range(len(self.spans)))

    @contextmanager
    def held(self) -> Iterator[None]:
        """Be the one driver of this job, once what other jobs for the folder have left is removed. What this one leaves
        is removed at the end, if it is a good one. Raises as `clear`, and RunError where another driver is at work."""
        clear(self.output, self.key)
        with lock_folder(self.folder):
            yield
            remove(self.folder)

    def run(self, needs: ShardNeeds, wish: ExecutionOptions, console: Console) -> None:
        """Do the shards that are left. Raises what `send` raises."""
        if left := self.pending:
            self.send(left, len(self.spans), needs, wish, console)

    def send(
        self, left: Sequence[int], of: int, needs: ShardNeeds, wish: ExecutionOptions, console: Console,
        ready: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Do these shards; `ready` is called once machines are known to be fit, before anything starts: without it
        shards say that they wait.

        Raises RunError if a shard failed (the others are done first), Stopped after Ctrl-C or SIGTERM (each saved), and
        VdgsError where a machine of a cluster cannot do the work, before anything starts.
        """
        kind = self.kind
        work = ShardWorkload(
            pieces=len(left), shard_bytes=needs.memory_bytes, jobs=wish.jobs, image_gb=wish.image_gb, kind=kind,
            images_bytes=needs.photographs_bytes,
        )  # fmt: skip
        machine = MachineResources(threads_available(), available_memory_bytes())
        with select_backend(wish.executor_options, work, machine, needs.question) as chosen:
            line = f"{len(left)} of {of} {kind.plural} to {kind.verb}, {chosen.description}"
            console.print(line, highlight=False)
            for note in chosen.notes:
                console.print(note, highlight=False)
            request = {name: value for name, value in to_dict(self.request).items() if name not in GIVEN}
            write_json(self.folder / REQUEST, {"worker": self.worker, "request": request})
            (ready or self.mark_queued)()
            share = chosen.share
            pieces = [
                Shard(index, self.shard(index), self._command(index, share, wish.device), share.resources, kind)
                for index in left
            ]
            outcomes = run_shards(pieces, chosen.executor, console)
        self._raise_unless_done(outcomes, of)

    def gather(self, load: Callable[[Path], Loaded]) -> Iterator[Loaded]:
        """What all items came to, in their order, read one at a time: sums have the bits of one process."""
        return (load(self.file(item)) for span in self.spans for item in span)

    def mark_queued(self) -> None:
        """Let the shards that are left say that they wait, but for those that are at work."""
        for index in self.pending:
            folder = self.shard(index)
            with suppress(RunError), folder.locked():
                if not self.is_done(index):
                    folder.set_status(StatusRecord(state="queued"))

    def _command(self, index: int, share: Allocation, device: str) -> list[str]:
        # A GPU that a shard is given is not this machine's.
        device = "auto" if share.resources.gpus and device == "cpu" else device
        return [
            sys.executable, "-m", "vdgs.distributed.run_shard", str(self.folder), str(index), "--threads",
            str(share.resources.cpus), "--image-cache-gb", f"{share.image_gb:.3f}", "--device", device,
        ]  # fmt: skip

    def _raise_unless_done(self, outcomes: Sequence[TaskResult], of: int) -> None:
        kind = self.kind
        if any(outcome.state == "stopped" for outcome in outcomes):
            raise Stopped(
                f"Stopped; every {kind.singular} that was {kind.activity} is saved. The same command continues."
            )
        failed = [outcome for outcome in outcomes if outcome.state != "done"]
        if failed:
            raise RunError(
                f"{self.folder}: {len(failed)} of {of} {kind.plural} failed:\n  "
                + "\n  ".join(f"{outcome.name}: {outcome.reason}" for outcome in failed)
                + f"\nTheir output is in {self.folder}/NN/output.log. The same command tries them again."
            )
