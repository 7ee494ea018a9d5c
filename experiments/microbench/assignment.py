"""How fast cameras are scored for blocks: cameras a second in each mode.

    python -m experiments.microbench.assignment [--threads 2] [--visible 20000] [--blocks 8] [--cameras 40]
    python -m experiments.microbench.assignment --run RUN           the training views of a trained run instead

The generated scene is a strip of bumpy ground, one block after the other along it, anchors one voxel apart, Gaussians
about as large as their spacing. Every view holds about `--visible` anchors of about two blocks, as drone photographs
do. The modes take turns, so that a busy machine slows all alike: believe the ratios.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads disturb the others

import argparse
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import shapely
import torch

from experiments.microbench.hardware_info import describe
from experiments.microbench.timing import medians_ms
from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import cpu as kernels
from vdgs.kernels.cpu.extension import get_num_threads, set_num_threads
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.partition.assignment.score_matrix import compute_score_matrix
from vdgs.partition.blocks import Block, Blocks

MODES = get_args(get_type_hints(AssignmentConfig)["mode"])
SIZE, ALTITUDE = (1200, 800), 20.0
#: Length of the strip that a block takes, in pictures.
BLOCK_LENGTH = 0.75


def strip(visible: int, blocks: int, cameras: int) -> tuple[AnchorModel, list[Camera]]:
    """Ground as wide as a picture and so long that every block takes its share of it, seen from above."""
    rng, g = np.random.default_rng(0), torch.Generator().manual_seed(0)
    focal = 1.2 * SIZE[0]
    width, height = (side / focal * ALTITUDE for side in SIZE)
    length = blocks * BLOCK_LENGTH * width
    n = round(visible * length / width)
    ground = np.column_stack([rng.uniform(0, length, n), rng.uniform(0, height, n), rng.normal(0, 0.2, n)])
    spacing = float(np.sqrt(width * height / visible))
    anchors = Anchors(
        positions=torch.from_numpy(ground.astype(np.float32)),
        features=0.5 * torch.randn(n, 32, generator=g),
        offsets=0.5 * torch.randn(n, 10, 3, generator=g),
        log_scales=torch.full((n, 6), float(np.log(spacing))),
    )
    views = []
    for x in rng.uniform(width / 2, length - width / 2, cameras):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ [x, height / 2, ALTITUDE]
        views.append(
            Camera(
                camera_from_world=pose,
                fx=focal,
                fy=focal,
                cx=SIZE[0] / 2,
                cy=SIZE[1] / 2,
                width=SIZE[0],
                height=SIZE[1],
            )
        )
    return AnchorModel(
        anchors=anchors,
        decoder=Decoder.init_random(10, False, 0, 1, g),
        voxel_size=spacing,
        background=(0.5, 0.5, 0.5),
    ), views


def strip_blocks(model: AnchorModel, count: int) -> Blocks:
    """Blocks side by side along x, with about equally many anchors, widened as by --partition.expansion 0.4."""
    points = model.anchors.positions[:, :2].double().numpy()
    edges = np.quantile(points[:, 0], np.linspace(0, 1, count + 1))
    low, high = points[:, 1].min(), points[:, 1].max()
    cores = [shapely.box(a, low, b, high) for a, b in pairwise(edges)]
    return Blocks(tuple(Block(core, core.buffer(0.4 * np.sqrt(core.area / np.pi))) for core in cores))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="a trained run whose training views are scored")
    parser.add_argument("--threads", type=int, default=get_num_threads())
    parser.add_argument("--visible", type=int, default=20_000, help="anchors in a view")
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    if arguments.run:
        from vdgs.runs.open_run import open_run

        run = open_run(arguments.run)
        model, cameras = run.model, [view.camera for view in run.capture.train_views]
    else:
        model, cameras = strip(arguments.visible, arguments.blocks, arguments.cameras)
    blocks = strip_blocks(model, arguments.blocks)
    seen = [int((kernels.count_visibility(model.anchors.positions, [camera]) > 0).sum()) for camera in cameras]
    print(
        f"{len(cameras)} cameras, {len(blocks)} blocks, {len(model.anchors):,} anchors, "
        f"{np.mean(seen):,.0f} in a view, {arguments.threads} thread(s)"
    )
    work: dict[str, Callable[[], object]] = {
        mode: partial(compute_score_matrix, model, blocks, cameras, AssignmentConfig(mode=mode)) for mode in MODES
    }
    times = medians_ms(work, arguments.repeats)
    for mode, ms in times.items():
        rate = 1e3 * len(cameras) / ms
        print(f"{mode:<14} {rate:8.1f} cameras/s   {times['coverage'] / ms:6.2f} x coverage", flush=True)


if __name__ == "__main__":
    main()
