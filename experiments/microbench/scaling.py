"""Time and memory of every stage that grows with a scene, and the exponent with which each grows.

    python -m experiments.microbench.scaling measure RESULTS \\
      [--stages cut ...] [--anchors 100000 1000000] [--photographs 100 1000]
    python -m experiments.microbench.scaling table RESULTS

Every case runs in a process of its own, one after the other, and is a line of the file RESULTS. Cases that the file
has are not measured again: the same command continues after a stop; to measure a stage anew, delete its lines. Seconds
are of the wall clock, with those of the processors beside them: on a machine that does other things too, believe those.
Memory is what the process takes at most, its libraries and its input included, and beside it what the input took.

The exponent of growth is log(t2 / t1) / log(n2 / n1) over the last two sizes: 1 is in proportion to the input.
Stages of anchors: visibility, cut, owners, rows (records of the blocks), figures, assignment (of SCORED cameras), save,
load, merge (opened, merged and saved), start (bounds of sizes and ground of the pictures, before a step can be made).
Stages of photographs: open, metadata (fingerprint and validation), inspect, plan (vdgs run --dry-run).
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads disturb the others

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from experiments.microbench import synthetic_scene
from experiments.microbench.hardware_info import describe
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.blocks import Blocks
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory

#: Blocks of a cut, of an assignment and of a merge; cameras that an assignment scores.
BLOCKS, SCORED = 16, 30
ANCHORS, PHOTOGRAPHS = (100_000, 1_000_000, 10_000_000), (100, 1000, 10_000)
Work = Callable[[], object]


@dataclass(frozen=True)
class Case:
    """A stage at a size; of photographs alone, `anchors` is 0."""

    stage: str
    anchors: int
    photographs: int


@dataclass(frozen=True)
class Measured:
    """What a case took."""

    stage: str
    anchors: int
    photographs: int
    seconds: float
    processor_seconds: float
    input_bytes: int
    peak_bytes: int
    load: float
    """Of the machine, over the minute before."""


# ----------------------------------------------------------------------------------------------- stages


def _visibility(case: Case, folder: Path) -> Work:
    from vdgs.visibility.visibility_counts import count_visibility

    extent = synthetic_scene.extent_for(case.photographs)
    positions, cameras = (
        torch.from_numpy(synthetic_scene.random_positions(case.anchors, extent)),
        synthetic_scene.flight(case.photographs),
    )
    return lambda: count_visibility(positions, cameras)


def _positions_and_visibility(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Anchors and how many photographs hold each."""
    from vdgs.visibility.visibility_counts import count_visibility

    positions = synthetic_scene.random_positions(case.anchors, synthetic_scene.extent_for(case.photographs))
    return positions, count_visibility(torch.from_numpy(positions), synthetic_scene.flight(case.photographs)).numpy()


def _cut(case: Case, folder: Path) -> Work:
    from vdgs.config.method import PartitionConfig
    from vdgs.partition.partition_scene import partition_scene

    positions, views = _positions_and_visibility(case)
    return lambda: partition_scene(positions, views, PartitionConfig(blocks=BLOCKS), seed=0)


def _owners(case: Case, folder: Path) -> Work:
    from vdgs.partition.blocks import xy_positions

    blocks, positions, _ = _cut_site(case)
    return lambda: blocks.owner(xy_positions(positions))


def _cut_site(case: Case) -> tuple[Blocks, np.ndarray, np.ndarray]:
    """Blocks as the method cuts them, of some of the anchors; where all anchors are, and their V."""
    from vdgs.config.method import PartitionConfig
    from vdgs.partition.partition_scene import partition_scene

    positions, views = _positions_and_visibility(case)
    sample = slice(None, None, max(1, case.anchors // 200_000))
    return (
        partition_scene(positions[sample], views[sample], PartitionConfig(blocks=BLOCKS), seed=0)[0],
        positions,
        views,
    )


def _rows(case: Case, folder: Path) -> Work:
    from vdgs.partition.assignment.assign_cameras import Assignment, assignment_rows

    blocks, positions, views = _cut_site(case)
    reasons = np.ones((case.photographs, len(blocks)), np.int8)
    return lambda: assignment_rows(blocks, positions, views, Assignment(reasons > 0, reasons, []))


def _figures(case: Case, folder: Path) -> Work:
    from vdgs.partition.plots.block_maps import plot_anchor_visibility, plot_blocks
    from vdgs.partition.plots.block_stats import plot_block_stats
    from vdgs.partition.plots.score_heatmap import plot_scores

    blocks, positions, views = _cut_site(case)
    cameras, used = synthetic_scene.flight(case.photographs), np.ones((case.photographs, len(blocks)), bool)

    def draw() -> None:
        names = ("x (m)", "y (m)")
        plot_anchor_visibility(folder / "map.png", positions, views, cameras, names)
        plot_blocks(folder / "blocks.png", positions, views, cameras, used, [("cut", blocks)], names)
        plot_block_stats(folder / "stats.png", positions, views, blocks, used, "m", blocks)
        plot_scores(folder / "scores.png", np.random.default_rng(0).random(used.shape), used)

    return draw


def _site_model(case: Case) -> AnchorModel:
    extent = synthetic_scene.extent_for(case.photographs)
    return synthetic_scene.random_model(synthetic_scene.random_positions(case.anchors, extent), extent)


def _assignment(case: Case, folder: Path) -> Work:
    from vdgs.config.method import AssignmentConfig
    from vdgs.partition.assignment.score_matrix import compute_score_matrix

    model, blocks = (
        _site_model(case),
        synthetic_scene.strip_blocks(synthetic_scene.extent_for(case.photographs), BLOCKS),
    )
    cameras = synthetic_scene.flight(case.photographs)[:: max(1, case.photographs // SCORED)][:SCORED]
    return lambda: compute_score_matrix(model, blocks, cameras, AssignmentConfig())


def _start(case: Case, folder: Path) -> Work:
    from vdgs.model.scale_bounds import max_log_scales

    positions = torch.from_numpy(
        synthetic_scene.random_positions(case.anchors, synthetic_scene.extent_for(case.photographs))
    )
    cameras = synthetic_scene.flight(case.photographs)
    return lambda: max_log_scales(positions, cameras)


def _save(case: Case, folder: Path) -> Work:
    model = _site_model(case)
    return lambda: model.save(folder / "model.safetensors")


def _load(case: Case, folder: Path) -> Work:
    _run_in_child(lambda: _site_model(case).save(folder / "model.safetensors"))
    return lambda: AnchorModel.load(folder / "model.safetensors")


def _merge(case: Case, folder: Path) -> Work:
    from vdgs.config.method import MergeConfig
    from vdgs.partition.blocks import xy_positions
    from vdgs.partition.merging import merge_blocks

    blocks, cameras = (
        synthetic_scene.strip_blocks(synthetic_scene.extent_for(case.photographs), BLOCKS),
        synthetic_scene.flight(case.photographs),
    )
    files = [folder / f"block_{index}.safetensors" for index in range(len(blocks))]

    def write() -> None:
        whole = _site_model(case)
        owner = torch.from_numpy(blocks.owner(xy_positions(whole.anchors.positions)))
        for index, file in enumerate(files):
            AnchorModel(
                anchors=whole.anchors.select(owner == index),
                decoder=whole.decoder,
                voxel_size=whole.voxel_size,
                background=whole.background,
            ).save(file)
        whole.save(folder / "coarse.safetensors")

    _run_in_child(write)
    cameras_of_blocks = [cameras[index :: len(blocks)] for index in range(len(blocks))]

    def work() -> None:
        coarse = AnchorModel.load(folder / "coarse.safetensors")
        trained = [partial(AnchorModel.load, file) for file in files]
        merged, _ = merge_blocks(coarse, trained, blocks, cameras_of_blocks, MergeConfig())
        merged.save(folder / "merged.safetensors")

    return work


def _capture(case: Case, folder: Path) -> Path:
    _run_in_child(lambda: synthetic_scene.write_capture(folder / "capture", case.photographs))
    return folder / "capture"


def _open(case: Case, folder: Path) -> Work:
    from vdgs.captures.loading import load_capture

    path = _capture(case, folder)
    return lambda: load_capture(path)


def _metadata(case: Case, folder: Path) -> Work:
    from vdgs.captures.capture_metadata import capture_metadata
    from vdgs.captures.loading import load_capture
    from vdgs.captures.validation import require_valid

    capture = load_capture(_capture(case, folder))
    return lambda: (capture_metadata(capture), require_valid(capture))


def _command(case: Case, folder: Path, *words: str) -> Work:
    """A verb of the command line and its arguments, in this process."""
    from vdgs.cli.main import get_command

    path = _capture(case, folder)
    verb = get_command(words[0])
    return lambda: verb([word.format(capture=path, folder=folder) for word in words[1:]])


def _inspect(case: Case, folder: Path) -> Work:
    return _command(case, folder, "inspect", "{capture}", "--output", "{folder}/looked-at")


def _plan(case: Case, folder: Path) -> Work:
    return _command(case, folder, "run", "{capture}", "--output", "{folder}/run", "--dry-run")


OF_ANCHORS = {
    "visibility": _visibility, "cut": _cut, "owners": _owners, "rows": _rows, "figures": _figures,
    "assignment": _assignment, "save": _save, "load": _load, "merge": _merge, "start": _start,
}  # fmt: skip
OF_PHOTOGRAPHS = {"open": _open, "metadata": _metadata, "inspect": _inspect, "plan": _plan}
STAGES = OF_ANCHORS | OF_PHOTOGRAPHS


def _run_in_child(work: Work) -> None:
    """Do something in a child, so that its memory is not ours."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            torch.set_num_threads(1)  # threads of a process do not live on in its children, who would wait for them
            work()
            code = 0
        finally:
            os._exit(code)
    if os.waitpid(child, 0)[1] != 0:
        raise SystemExit("the input of the stage could not be made")


# -------------------------------------------------------------------------------------------- measuring


def measure_here(case: Case) -> Measured:
    """Run a case in this process."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        work = STAGES[case.stage](case, Path(folder))
        reset_peak_memory()
        before, wall, processor = peak_memory_bytes(), time.perf_counter(), time.process_time()
        work()
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
    return Measured(**asdict(case), seconds=wall, processor_seconds=processor, input_bytes=before,
                    peak_bytes=peak_memory_bytes(), load=load)  # fmt: skip


def list_cases(stages: list[str], anchors: list[int], photographs: list[int], flight: int) -> list[Case]:
    """Stages of anchors over a flight of one size, those of photographs at each size."""
    return [
        case
        for stage in stages
        for case in (
            [Case(stage, n, flight) for n in anchors]
            if stage in OF_ANCHORS
            else [Case(stage, 0, count) for count in photographs]
        )
    ]


def measure(results: Path, cases: list[Case]) -> None:
    """Add to the file what is not there yet."""
    measured = {(each.stage, each.anchors, each.photographs) for each in read(results)}
    for case in cases:
        if (case.stage, case.anchors, case.photographs) in measured:
            continue
        words = [case.stage, str(case.anchors), str(case.photographs)]
        command = [sys.executable, "-m", "experiments.microbench.scaling", "one", *words]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode != 0:
            print(f"{' '.join(words)}: failed with exit code {done.returncode}", flush=True)
            continue
        line = done.stdout.strip().splitlines()[-1]
        with results.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        print(line, flush=True)


def read(results: Path) -> list[Measured]:
    """What was measured so far."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    return [Measured(**json.loads(line)) for line in lines if line.strip()]


# ------------------------------------------------------------------------------------------------ table


def table(results: list[Measured]) -> str:
    """Markdown: a row for each stage and size, by stage and ascending."""
    rows = ["| stage | anchors | photographs | seconds | processor s | GB | of it input | exponent |", "|---" * 8 + "|"]
    for stage in STAGES:
        of_stage = sorted((e for e in results if e.stage == stage), key=lambda e: (e.photographs, e.anchors))
        before: Measured | None = None
        for each in of_stage:
            anchors = f"{each.anchors:,}" if each.anchors else ""
            rows.append(
                f"| {stage} | {anchors} | {each.photographs:,} | {each.seconds:.2f} | "
                f"{each.processor_seconds:.2f} | {each.peak_bytes / 1e9:.2f} | {each.input_bytes / 1e9:.2f} | "
                f"{_exponent(before, each)} |"
            )
            before = each
    return "\n".join(rows)


def _exponent(before: Measured | None, each: Measured) -> str:
    if before is None:
        return ""
    changed = [(a, b) for a, b in ((before.anchors, each.anchors), (before.photographs, each.photographs)) if a != b]
    if len(changed) != 1:
        return ""
    ((low, high),) = changed
    return f"{math.log(each.processor_seconds / before.processor_seconds) / math.log(high / low):.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cli = parser.add_subparsers(dest="verb", required=True)
    measuring = cli.add_parser("measure", help="measure what is not in RESULTS yet")
    measuring.add_argument("results", type=Path)
    measuring.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    measuring.add_argument("--anchors", nargs="+", type=int, default=list(ANCHORS))
    measuring.add_argument("--photographs", nargs="+", type=int, default=list(PHOTOGRAPHS))
    measuring.add_argument("--flight", type=int, default=300, help="photographs over the anchors")
    showing = cli.add_parser("table", help="print RESULTS as a table")
    showing.add_argument("results", type=Path)
    one = cli.add_parser("one", help="measure one case here and print it")
    one.add_argument("stage", choices=STAGES)
    one.add_argument("anchors", type=int)
    one.add_argument("photographs", type=int)
    args = parser.parse_args()
    if args.verb == "one":
        measured = measure_here(Case(args.stage, args.anchors, args.photographs))
        print(json.dumps(asdict(measured)), flush=True)
    elif args.verb == "measure":
        print(describe())
        measure(args.results, list_cases(args.stages, args.anchors, args.photographs, args.flight))
    else:
        print(table(read(args.results)))


if __name__ == "__main__":
    main()
