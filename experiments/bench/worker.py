"""One run of a table, in a process of its own: `python -m experiments.bench.worker JOB.json`.

Its folder is an ordinary run: the verbs `partition`, `train-blocks`, `merge`, `eval`, `render` and `report` work on it.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.bench.definitions import CLOCK, RECORD_FILE
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig
from vdgs.config.serialization import from_dict
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json, write_json

if TYPE_CHECKING:
    from vdgs.runs.run_context import RunContext


@dataclass(frozen=True)
class BenchJob:
    """What the file says."""

    capture: Path
    options: dict[str, Any]
    method: dict[str, Any]
    stages: tuple[str, ...]
    output: Path
    coarse_from: Path | None
    key: str
    lpips_weights: Path | None
    visibility_bins: int
    threads: int
    overwrite: bool = False
    renders: Path | None = None
    device: str = "cpu"

    def write(self, path: Path) -> None:
        write_json(path, {name: _plain(value) for name, value in vars(self).items()})

    @staticmethod
    def read(path: Path) -> BenchJob:
        values = read_json(path)
        for name in ("capture", "output", "coarse_from", "lpips_weights", "renders"):
            values[name] = None if values[name] is None else Path(values[name])
        return BenchJob(**values | {"stages": tuple(values["stages"])})


@dataclass(frozen=True)
class _JobContext:
    """What the stages work with."""

    job: BenchJob
    context: RunContext
    console: Any


def _coarse(at: _JobContext) -> None:
    from vdgs.config.executor_options import CheckpointOptions
    from vdgs.pipeline.train_coarse import train_coarse

    if at.job.coarse_from is not None:
        link_coarse_stage(at.job.coarse_from, at.job.output)
    train_coarse(at.context, CheckpointOptions(), at.console, at.job.device)


def _partition(at: _JobContext) -> None:
    from vdgs.pipeline.count_visibility import count_run_visibility
    from vdgs.pipeline.find_motion import find_run_motion
    from vdgs.pipeline.partition_stage import partition_run

    find_run_motion(at.context, at.console, at.job.device)
    count_run_visibility(at.context, at.console)
    partition_run(at.context, at.console, at.job.device)


def _blocks(at: _JobContext) -> None:
    from vdgs.config.executor_options import CheckpointOptions
    from vdgs.pipeline.train_block import train_block
    from vdgs.pipeline.train_blocks import train_blocks
    from vdgs.runs.open_run import load_run_blocks

    if at.job.device == "cpu":
        # One after another, each on all threads, as methods in one stage train: side by side, each on few of them, the
        # seconds of all together would be many more than those of the stage.
        train_blocks(at.context, CheckpointOptions(), 1, at.console)
        return
    # In this process: loading torch and its kernels for each block would take longer than many blocks of a table.
    for index in range(len(load_run_blocks(at.context.run))):
        train_block(at.context, index, CheckpointOptions(), at.console, at.job.device)


def _momentum(at: _JobContext) -> None:
    from experiments.baselines.momentum_gs.run import train_momentum_blocks

    train_momentum_blocks(at.context, at.console, device=at.job.device)


def _merge(at: _JobContext) -> None:
    from vdgs.pipeline.merge_blocks import merge_run_blocks

    merge_run_blocks(at.context, False, at.console)


def _evaluate(at: _JobContext) -> None:
    from vdgs.pipeline.evaluate_stage import EvaluationRequest, evaluate_stage

    evaluate_stage(
        at.context,
        EvaluationRequest(
            path=at.context.run.path,
            which="best",
            lpips_weights=at.job.lpips_weights,
            visibility_bins=at.job.visibility_bins,
            device=at.job.device,
        ),
        at.console,
    )


def _renders(at: _JobContext) -> None:
    from experiments.bench.renders import measure_renders

    assert at.job.renders is not None
    output = at.context.run.evaluation
    measure_renders(at.context.capture, at.job.renders, output, at.job.lpips_weights, at.console)


#: What a method may name as its stages, beside `baseline_stages.BASELINES`. Each does nothing, or the same again,
#: where it is done.
STAGES: dict[str, Callable[[_JobContext], None]] = {
    "coarse": _coarse, "partition": _partition, "blocks": _blocks, "merge": _merge, "evaluate": _evaluate,
    "renders": _renders, "momentum-gs": _momentum,
}  # fmt: skip


def _stage(name: str) -> Callable[[_JobContext], None]:
    """A stage of STAGES, or a method with a training of its own."""
    if name in STAGES:
        return STAGES[name]
    from experiments.bench.baseline_stages import train_baseline

    return lambda at: train_baseline(
        name, at.context.run, at.context.capture, at.job.lpips_weights, at.console, at.job.device
    )


def link_coarse_stage(source: Path, target: Path) -> None:
    """Give a run the finished coarse stage of another with the same settings; the model is linked, not copied.

    Raises VdgsError if the other run has none. The keys of both are the same because the settings are; were they not,
    the coarse stage would be trained again.
    """
    from vdgs.pipeline.dense_points import DENSE_POINTS_FILE

    if (target / "coarse" / "model.safetensors").exists():
        return
    if not (source / "coarse" / "model.safetensors").exists():
        raise VdgsError(f"{source}: the coarse stage that this run shares is not there")
    partial = target / f".coarse.{os.getpid()}"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    for name in ("key", "status.json", "log.jsonl", DENSE_POINTS_FILE):
        if (source / "coarse" / name).exists():
            shutil.copy2(source / "coarse" / name, partial / name)
    model = source / "coarse" / "model.safetensors"
    try:
        os.link(model, partial / model.name)
    except OSError:  # another disk, or one without links
        shutil.copy2(model, partial / model.name)
    shutil.rmtree(target / "coarse", ignore_errors=True)
    partial.rename(target / "coarse")
    shutil.copy2(source / "capture.json", target / "capture.json")


def run_job(job: BenchJob) -> None:
    """All stages of a job, noting how long each took; the record says done only at the end."""
    from rich.console import Console

    from experiments.bench.measure import measure_by_truth
    from experiments.bench.provenance import describe_provenance
    from vdgs.kernels import configure_threads

    configure_threads(job.threads)
    with _opened(job) as context:
        working = _JobContext(job, context, Console(soft_wrap=True))
        record = _record(job)
        write_json(job.output / RECORD_FILE, record)  # what an interrupted run leaves is not what it was before
        for name in job.stages:
            began, figures = time.monotonic(), context.figure_seconds
            _stage(name)(working)
            seconds = time.monotonic() - began - (context.figure_seconds - figures)
            record["seconds"][name] = record["seconds"].get(name, 0.0) + seconds
            write_json(job.output / RECORD_FILE, record)
        if job.stages != ("coarse",):  # one that several runs share is not measured
            options: CaptureOptions = from_dict(CaptureOptions, job.options, "capture")
            measure_by_truth(job.capture, options, job.output, job.key, job.visibility_bins)
        write_json(
            job.output / RECORD_FILE,
            record | {"state": "done", "provenance": describe_provenance(job.threads, job.device)},
        )


@contextmanager
def _opened(job: BenchJob) -> Iterator[RunContext]:
    """The run, driven, with its capture. Where renders are measured the folder is no run: nothing is trained there."""
    from vdgs.captures.loading import load_capture
    from vdgs.runs.create_or_resume import exclusive_run
    from vdgs.runs.run_context import RunContext
    from vdgs.runs.run_folder import RunFolder

    options: CaptureOptions = from_dict(CaptureOptions, job.options, "capture")
    if job.renders is not None:
        yield RunContext(RunFolder(job.output), load_capture(job.capture, options))
        return
    method = from_dict(MethodConfig, job.method)
    with exclusive_run(job.capture, job.output, options, method, overwrite=job.overwrite) as context:
        yield context


def _record(job: BenchJob) -> dict[str, Any]:
    """What is noted so far for the same key, so that the time of an interrupted run adds up. A run that began by an
    older clock keeps it: its blocks may be trained already."""
    file = job.output / RECORD_FILE
    before = read_json(file) if file.exists() else {"clock": CLOCK}
    seconds = before.get("seconds", {}) if before.get("key") == job.key else {}
    return {"state": "running", "key": job.key, "seconds": seconds, "clock": before.get("clock", 1)}


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def main(arguments: list[str]) -> int:
    """Exit codes as those of the command line: 0 done, 1 explained, 130 stopped."""
    from vdgs.distributed.task_process import stop_when_parent_dies
    from vdgs.system.exit_codes import exit_code_of

    stop_when_parent_dies()
    return exit_code_of("vdgs bench", lambda: run_job(BenchJob.read(Path(arguments[0]))), "The same command continues.")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
