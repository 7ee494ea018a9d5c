"""What Ray costs over processes of this machine: the blocks of one run, trained by both, and whether they are the same.

    OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.executors RUN [--jobs 2] [--rounds 1]

RUN is cut into blocks and not trained yet, or trained: copies are trained, in a folder beside it that is deleted. The
start of Ray is measured apart, with nothing to do. Rounds take turns (local, Ray, Ray, local, ...).
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.microbench.hardware_info import describe
from vdgs.distributed.ray_executor import connect
from vdgs.runs.run_folder import RunFolder

ENGINES = ("local", "ray")


def copy(run: Path, to: Path) -> Path:
    """A copy of a run whose blocks are not trained."""
    leave = shutil.ignore_patterns(".lock", ".run", "blocks", "merged", "evaluation", "maps", "capture")
    return Path(shutil.copytree(run, to, ignore=leave))


def train(run: Path, engine: str, jobs: int) -> float:
    """Seconds that the blocks of a run take, from the command to its end."""
    command = [sys.executable, "-m", "vdgs", "train-blocks", str(run), "--jobs", str(jobs), "--executor", engine]
    began = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def start_of_ray() -> float:
    """Seconds that a Ray of this machine takes to start and to end, with nothing to do."""
    began = time.perf_counter()
    with connect(None):
        pass
    return time.perf_counter() - began


def models(run: Path) -> list[bytes]:
    return [folder.model.read_bytes() for folder in RunFolder(run).block_folders()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--jobs", type=int, default=2, help="blocks at once")
    parser.add_argument("--rounds", type=int, default=1)
    args = parser.parse_args()
    print(describe())
    print(f"{'start and end of Ray':>24} {start_of_ray():7.1f} s", flush=True)
    seconds: dict[str, list[float]] = {engine: [] for engine in ENGINES}
    with tempfile.TemporaryDirectory(dir=args.run.resolve().parent) as folder:
        trained = []
        for number in range(args.rounds):
            for engine in ENGINES if number % 2 == 0 else ENGINES[::-1]:
                run = copy(args.run, Path(folder) / f"{engine}{number}")
                seconds[engine].append(train(run, engine, args.jobs))
                print(f"{engine:>24} {seconds[engine][-1]:7.1f} s", flush=True)
                trained.append(models(run))
    local, ray = (statistics.median(seconds[engine]) for engine in ENGINES)
    print(f"{len(trained[0])} blocks, {args.jobs} at once: Ray takes {100 * (ray / local - 1):+.1f} % with its start")
    print("models are the same" if all(each == trained[0] for each in trained) else "MODELS DIFFER")


if __name__ == "__main__":
    main()
