"""A bench of one tiny capture, in this process."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from captures_support import tiny_scene, write_colmap
from vdgs.bench.bench import BenchSettings, run_bench
from vdgs.bench.plan import Choices
from vdgs.bench.processes import Ended, Task
from vdgs.bench.results import Result
from vdgs.bench.worker import Job, work


def run_here(tasks: Sequence[Task], _at_once: int, _tell: Callable[..., None]) -> dict[str, Ended]:
    """As `run_tasks`, but in this process: starting others would take most of the time."""
    for task in tasks:
        work(Job.read(task.file))
    return {task.name: Ended(task.name, "done") for task in tasks}


def write_data(folder: Path) -> None:
    """What --data may name: the tiny scene as copr."""
    write_colmap(folder / "copr", tiny_scene())
    (folder / "copr" / "images").rename(folder / "copr" / "images_4")  # what the bench reads of it


def benched(
    data: Path, output: Path, *methods: str, total: int = 40, redo: bool = False, renders: tuple[str, ...] = ()
) -> dict[str, Result]:
    """Table I of that scene with these methods, one seed."""
    choices = Choices(
        seeds=1, scenes=("copr",), methods=methods, iterations_total=total, max_anchors=300, renders=renders
    )
    asked = BenchSettings("table1", output, choices, data, redo=redo)
    return {each.method: each for each in run_bench(asked, Console(file=io.StringIO()))}
