"""A job of many items, split into shards that processes do side by side: on this machine, on a Ray cluster or by SLURM.

    OUTPUT/shards/KEY/request.json   the worker that does the shards (`shard.WORKERS`), and its request
    OUTPUT/shards/KEY/NN/            of shard NN: status.json, output.log, a file for each of its items once it is done,
                                     each whole or absent; what is there is not done again
    OUTPUT/shards/KEY/slurm/         as in a run folder, where jobs of SLURM do the work

KEY is a digest of what the results depend on: items of another model or other settings are never gathered, nor found
by another driver. All of it is removed once the items are gathered (`job_folders`).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.serialization import to_dict
from vdgs.distributed.backend_selection import select_backend
from vdgs.distributed.executor import TaskResult
from vdgs.distributed.job_folders import SHARDS, clear, empty, remove
from vdgs.distributed.job_labels import JobLabels
from vdgs.distributed.node_check import NodeRequirements, code_digest
from vdgs.distributed.resource_allocation import Allocation, MachineResources, ShardWorkload
from vdgs.distributed.scheduler import stop_message
from vdgs.distributed.shard_runner import ShardCommand, run_shards
from vdgs.errors import RunError, Stopped
from vdgs.kernels import get_num_threads
from vdgs.kernels.device_selection import AnyCard, cards_left_out, cards_of
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.system.child_python import python_command
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.process_memory import available_memory_bytes

#: The file in the folder of a job with the request of its shards.
REQUEST = "request.json"
#: Fields of requests that change no result: every shard gets its own.
EXECUTION_FIELDS = ("device", "threads")

Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class ExecutionOptions:
    """Where shards are done, and how many at once."""

    executor_options: ExecutorOptions
    jobs: int = 0
    """Shards at once; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for images; 0: by the memory that there is. On a cluster: of one shard."""
    device: str = "cpu"

    @property
    def is_distributed(self) -> bool:
        """Whether work goes out even if one process could do it: to a cluster, or to several processes at once."""
        return self.executor_options.executor != "local" or self.jobs > 1


@dataclass(frozen=True)
class ShardNeeds:
    """What a shard needs of a machine."""

    memory_bytes: int
    """Memory of the largest by estimate, beside its images."""
    requirements: Callable[[], NodeRequirements]
    """What machines must see; called where other machines do the work."""
    images_bytes: int = 0
    """All images of a shard, decoded; 0 where it caches none."""


def split_ranges(items: int, min_items: int, max_items: int, shards: int) -> tuple[range, ...]:
    """Items from 0, split into spans of about equal length: so many `shards` as long as no span is shorter than
    `min_items` or longer than `max_items`. Nothing but the number of items decides: any driver splits the same."""
    each = min(max_items, max(min_items, -(-items // shards)))
    count = max(1, -(-items // each))
    return tuple(range(*ends) for ends in itertools.pairwise(items * index // count for index in range(count + 1)))


@dataclass(frozen=True, kw_only=True)
class ShardedJob:
    """Items that are numbered from 0, the shards that they are done in, and the request of these.

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
    def create(
        worker: str, request: Any, output: Path, kind: JobLabels, depends_on: Any, spans: Sequence[range],
        suffix: str = ".npz",
    ) -> ShardedJob:  # fmt: skip
        """The job for a folder whose results depend on these plain values, its spans and the code that does it."""
        content = json.dumps([code_digest(), depends_on, [[span.start, span.stop] for span in spans]])
        folder = Path(os.path.abspath(output)) / SHARDS / hashlib.sha256(content.encode()).hexdigest()[:12]
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
        """The file of an item that is done."""
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
    def exclusive(self) -> Iterator[None]:
        """Be the one driver of this job, once what other jobs for the folder have left is removed; without an error
        this one is removed too at the end. Raises as `clear`, and RunError where another driver is at work."""
        clear(self.output, self.key)
        with lock_folder(self.folder):
            yield
            empty(self.folder)
        remove(self.folder)  # once its lock is closed

    def run(self, needs: ShardNeeds, execution: ExecutionOptions, console: Console) -> None:
        """Do the shards that are left. Raises what `send` raises."""
        if pending := self.pending:
            self.send(pending, len(self.spans), needs, execution, console)

    def send(
        self, shards: Sequence[int], total: int, needs: ShardNeeds, execution: ExecutionOptions, console: Console,
        on_ready: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Do these shards of a `total`. `on_ready` is called once machines are known to be fit, before anything starts;
        by default it marks the shards as queued.

        Raises RunError if a shard failed (the others are done first), Stopped after Ctrl-C or SIGTERM (each saved, but
        for those that a second Ctrl-C kills), and VdgsError where a machine of a cluster cannot do the work, before
        anything starts.
        """
        kind = self.kind
        workload = ShardWorkload(
            shards=len(shards), shard_bytes=needs.memory_bytes, jobs=execution.jobs, image_gb=execution.image_gb,
            kind=kind, images_bytes=needs.images_bytes,
        )  # fmt: skip
        cards = cards_of(execution.device) if execution.executor_options.executor == "local" else {}
        machine = MachineResources(get_num_threads(), available_memory_bytes(), tuple(cards.values()))
        with select_backend(execution.executor_options, workload, machine, needs.requirements) as backend:
            line = f"{len(shards)} of {total} {kind.plural} to {kind.verb}, {backend.description}"
            for text in (line, *backend.notes, *(cards_left_out(execution.device) if cards else ())):
                console.print(text, highlight=False)
            request = {name: value for name, value in to_dict(self.request).items() if name not in EXECUTION_FIELDS}
            write_json(self.folder / REQUEST, {"worker": self.worker, "request": request})
            (on_ready or self.mark_queued)()
            commands = self._commands(shards, backend.allocation, tuple(cards), execution.device)
            results = run_shards(commands, backend.executor, console)
        self._raise_unless_done(results, total)

    def gather(self, load: Callable[[Path], Loaded]) -> Iterator[Loaded]:
        """All items loaded, in their order, one at a time: sums have the bits of one process."""
        return (load(self.file(item)) for span in self.spans for item in span)

    def mark_queued(self) -> None:
        """Set the status of the shards that are left to queued, but for those that are at work."""
        for index in self.pending:
            folder = self.shard(index)
            with suppress(RunError), folder.locked():
                if not self.is_done(index):
                    folder.set_status(StatusRecord(state="queued"))

    def _commands(
        self, shards: Sequence[int], share: Allocation, cards: Sequence[str], device: str
    ) -> list[ShardCommand]:
        """The shards, on the cards in turn; on the device where there are none."""
        device = "cuda" if isinstance(device, AnyCard) else device  # other machines number theirs otherwise
        places = [(card, replace(share.resources, device=card)) for card in cards] or [(device, share.resources)]
        return [
            ShardCommand(index, self.shard(index), self._command(index, share, place), resources, self.kind)
            for index, (place, resources) in zip(shards, itertools.cycle(places), strict=False)
        ]

    def _command(self, index: int, allocation: Allocation, device: str) -> list[str]:
        # A GPU that a shard is given is not this machine's.
        device = "auto" if allocation.resources.gpus and device == "cpu" else device
        return python_command(
            "vdgs.distributed.run_shard", self.folder, index, "--threads", allocation.resources.cpus,
            "--image-cache-gb", f"{allocation.image_gb:.3f}", "--device", device,
        )  # fmt: skip

    def _raise_unless_done(self, results: Sequence[TaskResult], total: int) -> None:
        kind = self.kind
        if any(result.state == "stopped" for result in results):
            raise Stopped(stop_message(results, f"every {kind.singular} that was {kind.activity}"))
        if failed := [f"{result.name}: {result.reason}" for result in results if result.state != "done"]:
            raise RunError(
                f"{self.folder}: {len(failed)} of {total} {kind.plural} failed:\n  "
                + "\n  ".join(failed)
                + f"\nTheir output is in {self.folder}/NN/output.log. The same command tries them again."
            )
