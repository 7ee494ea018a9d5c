"""A bench of one tiny capture, in this process."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.plan import PlanOptions
from experiments.bench.results import BenchResult
from experiments.bench.worker import BenchJob, run_job
from support.captures import tiny_scene, write_colmap
from support.commands import small_figures, threads_as_before
from vdgs.distributed.executor import Task, TaskListener, TaskResult


@dataclass(frozen=True)
class InThisProcess:
    """An executor without processes: starting them would take most of the time."""

    max_concurrent: int

    def run(self, tasks: Sequence[Task], _listener: TaskListener) -> list[TaskResult]:
        with threads_as_before(), small_figures():
            for task in tasks:
                run_job(replace(BenchJob.read(Path(task.command[-1])), threads=1))
        return [TaskResult(name=task.name, state="done") for task in tasks]


def write_data(folder: Path) -> None:
    """What --data may name: the tiny scene as copr."""
    write_colmap(folder / "copr", tiny_scene())
    (folder / "copr" / "images").rename(folder / "copr" / "images_4")  # what the bench reads of it


def benched(
    data: Path, output: Path, *methods: str, total: int = 40, overwrite: bool = False, renders: tuple[str, ...] = ()
) -> dict[str, BenchResult]:
    """Table I of that scene with these methods, one seed."""
    options = PlanOptions(
        seeds=1, scenes=("copr",), methods=methods, total_iterations=total, max_anchors=300, renders=renders
    )
    settings = BenchSettings("table1", output, options, data, overwrite=overwrite)
    return {each.method: each for each in run_bench(settings, Console(file=io.StringIO()))}
