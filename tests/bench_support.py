"""A bench of one tiny capture, in this process."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from captures_support import tiny_scene, write_colmap
from cli_support import vdgs
from native_choice import on_threads
from vdgs.bench.bench import BenchSettings, run_bench
from vdgs.bench.plan import Choices
from vdgs.bench.processes import Ended, Task
from vdgs.bench.results import Result
from vdgs.bench.worker import Job, work
from vdgs.executors.jobs import Outcome


def run_here(tasks: Sequence[Task], _at_once: int, _tell: Callable[..., None]) -> dict[str, Ended]:
    """As `run_tasks`, but in this process: starting others would take most of the time."""
    before = torch.get_num_threads()
    with on_threads(1):
        for task in tasks:
            work(replace(Job.read(task.file), threads=1))
    torch.set_num_threads(before)
    return {task.name: Ended(task.name, "done") for task in tasks}


def forked_blocks(jobs: Sequence[Any], **_how: object) -> list[Outcome]:
    """As `run_jobs`, one after the other: `python -m vdgs.cli ...` without what importing takes."""
    for job in jobs:
        done = vdgs(*job.command[3:])
        assert done.returncode == 0, done.stderr
    return [Outcome(job.index, "done", 1, "") for job in jobs]


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
