"""PSNR of methods by how many training photographs look at a place, in bands that one chooses.

    python -m experiments.reports.analyses.psnr_by_v METHOD [METHOD ...] [--views training] [--by truth] [--bands 1 4 16] [--every 4]

METHOD is a folder of a bench, runs/SCENE/METHOD, that holds a run for each seed, or a run; the scene is a generated
capture with its truth. V counts the training cameras whose frustum holds the true place at a pixel, as the paper does,
or (`--by truth`, test views only) those that see it. For each band: its share of all pixels, the median distance along
the viewing axis in camera heights, anchors that stand where so many frusta look, with blocks how many cameras of its
own block look at each, and PSNR in neutral colours: the mean over seeds, and the difference to the first method, each
seed against itself, ± its standard deviation.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from experiments.bench.seen import held_by_frusta
from experiments.microbench.machine import describe
from experiments.reports.analyses.ceiling import drawn, picture, psnr, squares

from vdgs.cameras import Camera
from vdgs.captures.heights import camera_height
from vdgs.model.visibility import visibility_of
from vdgs.partition.blocks import places_of
from vdgs.runs.open_run import blocks_of, views_of_blocks
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.synth.truth import load_truth

BANDS = (1, 4, 16, 52, 128)


def seeds_of(method: Path) -> list[Path]:
    """The runs of a method, or the run itself."""
    return sorted(each for each in method.iterdir() if each.name.isdigit()) or [method]


def name_of(method: Path) -> str:
    """The method's, and of a single run the seed, too."""
    return f"{method.parent.name}/{method.name}" if method.name.isdigit() else method.name


def spread(values: np.ndarray, sign: str = "") -> str:
    """Mean over seeds and, of several, their standard deviation."""
    deviation = f" ± {values.std(ddof=1):.2f}" if len(values) > 1 else ""
    return f"{values.mean():{sign}.2f}{deviation}"


def of_own_block(run: TrainedRun, cameras: list[Camera]) -> np.ndarray:
    """For each anchor, how many cameras of the block that owns its place hold it. Raises RunError without blocks."""
    positions = run.model.anchors.positions
    owner, counted = blocks_of(run.folder).owner(places_of(positions.numpy())), np.zeros(len(positions))
    for block, views in enumerate(views_of_blocks(run.folder, run.capture)):
        own = owner == block
        counted[own] = visibility_of(positions[torch.from_numpy(own)], [cameras[view] for view in views]).numpy()
    return counted


def main() -> None:
    """Print a line for each method and band."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("methods", type=Path, nargs="+", metavar="METHOD")
    parser.add_argument("--views", choices=("test", "training"), default="test")
    parser.add_argument("--by", choices=("frusta", "truth"), default="frusta")
    parser.add_argument("--bands", type=int, nargs="+", default=BANDS, help="the least V of each band")
    parser.add_argument("--every", type=int, default=1, help="use every so many views")
    asked = parser.parse_args()
    if asked.by == "truth" and asked.views == "training":
        parser.error("--by truth: who sees what is known for test views only")
    folders = [seeds_of(method) for method in asked.methods]
    capture = open_run(folders[0][0]).capture
    truth, scale = load_truth(capture.root), capture.ground.scale
    cameras = [view.camera for view in capture.train_views]
    views = (capture.test_views if asked.views == "test" else capture.train_views)[:: asked.every]
    seen = [truth.visibility_map(v) if asked.by == "truth" else held_by_frusta(truth, v, scale, cameras) for v in views]
    counted = np.nan_to_num(np.concatenate([each.ravel() for each in seen]))
    away = np.concatenate([scale * truth.depth_map(view).ravel() for view in views]) / camera_height(capture)
    taken = [picture(view) for view in views]
    ends = [*asked.bands, int(counted.max()) + 1]
    groups = [(counted >= low) & (counted < high) for low, high in pairwise(ends)]
    print(describe())
    print(f"{len(views)} {asked.views} views, V by {asked.by}")
    print(f"{'V':>26} " + "".join(f"{f'{low}-{high - 1}':>15}" for low, high in pairwise(ends)))
    print(f"{'pixels':>26} " + "".join(f"{group.mean():>15.1%}" for group in groups))
    print(f"{'distance':>26} " + "".join(f"{np.median(away[group]):>15.2f}" for group in groups))
    first = np.zeros(0)
    for method, runs in zip(asked.methods, folders, strict=True):
        figures, standing, trained_by = [], [], []
        for path in runs:
            run = open_run(path)
            squared = squares([drawn(run, view) for view in views], taken)
            figures.append([psnr(squared[group]) for group in groups])
            looked_at = visibility_of(run.model.anchors.positions, cameras).numpy()
            standing.append(np.histogram(looked_at, ends)[0])
            if run.name == "merged":
                summed = np.histogram(looked_at, ends, weights=of_own_block(run, cameras))[0]
                trained_by.append(summed / standing[-1])
        of_seeds = np.array(figures)
        print(f"{name_of(method):>26} " + "".join(f"{spread(each):>15}" for each in of_seeds.T))
        print(f"{'anchors':>26} " + "".join(f"{each:>15,.0f}" for each in np.mean(standing, axis=0)))
        if trained_by:
            print(f"{'cameras of own block':>26} " + "".join(f"{each:>15.1f}" for each in np.mean(trained_by, axis=0)))
        if len(first) == len(of_seeds):
            print(f"{'difference':>26} " + "".join(f"{spread(each, '+'):>15}" for each in (of_seeds - first).T))
        first = first if len(first) else of_seeds


if __name__ == "__main__":
    main()
