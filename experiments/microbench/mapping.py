"""What poses cost: COLMAP's incremental mapper by how often it adjusts all poses, and what the global mapper adds.

    vdgs sfm PHOTOGRAPHS --output CAPTURE --keep-intermediate
    python -m experiments.microbench.mapping CAPTURE [--ratios 1.1 1.4] [--fit-focal]

Features and pairs are taken from CAPTURE/work, which stays as it is. One thread, processor seconds.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
from pathlib import Path

from rich.console import Console

from experiments.microbench.hardware_info import describe
from vdgs.captures.reconstruction import WORK_FOLDER
from vdgs.sfm import global_mapper, incremental_mapper
from vdgs.sfm.workspace import Workspace, silence_colmap

CONSOLE = Console(quiet=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--ratios", type=float, nargs="+", default=[1.1, incremental_mapper.GLOBAL_ADJUSTMENT_RATIO])
    parser.add_argument("--fit-focal", action="store_true")
    asked = parser.parse_args()
    silence_colmap()
    print(describe())
    print("\n| | processor s | photographs of each model | points, seen by | reprojection error px |")
    print("|---|---|---|---|---|")
    for ratio in asked.ratios:
        with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
            measure(Workspace(asked.capture / WORK_FOLDER), Workspace(Path(folder)), ratio, not asked.fit_focal)


def measure(source: Workspace, workspace: Workspace, ratio: float, fix_focal: bool) -> None:
    """Print a row of the incremental mapper, and one of all at once where that leaves photographs out."""
    shutil.copy(source.database, workspace.database)
    workspace.images.symlink_to(source.images.resolve())
    with workspace.open_database() as database:
        count = database.num_images()
    incremental_mapper.GLOBAL_ADJUSTMENT_RATIO = ratio
    before = processor_seconds()
    incremental_mapper.run_mapper(workspace, count, fix_focal, 1, CONSOLE)
    print_row(f"all poses adjusted at growth by {ratio:g}", processor_seconds() - before, workspace)
    if global_mapper.leaves_photographs_out(workspace):
        incremental_mapper.set_models_aside(workspace)
        before = processor_seconds()
        global_mapper.place_left_out(workspace, count, fix_focal, 1, CONSOLE)
        print_row("then all photographs at once", processor_seconds() - before, workspace)


def processor_seconds() -> float:
    """Of this process and of those that it waited for."""
    used = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def print_row(name: str, seconds: float, workspace: Workspace) -> None:
    models = incremental_mapper.read_models(workspace)
    sizes, first = ", ".join(str(model.num_reg_images()) for model in models), models[0]
    points = f"{first.num_points3D():,}, {first.compute_mean_track_length():.2f}"
    error = first.compute_mean_reprojection_error()
    print(f"| {name} | {seconds:.0f} | {sizes} | {points} | {error:.3f} |", flush=True)


if __name__ == "__main__":
    main()
