"""Visibility, cut and owners of a large scene, in one run.

    OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.partition [--anchors 1000000] [--cameras 1000]

The owners are looked up for places in the cores' own box and in one four times as wide, most of which lies outside
every core; a part of each is compared with the distances to all cores.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import shapely
import torch

from experiments.microbench.hardware_info import describe
from experiments.microbench.visibility import flight
from vdgs.config.method import PartitionConfig
from vdgs.kernels.cpu import extension
from vdgs.partition.blocks import Blocks
from vdgs.partition.partition_scene import partition_scene
from vdgs.visibility.visibility_counts import count_visibility

EXTENT_M = 2000.0
#: Places whose owner is compared with brute force.
COMPARED = 5_000
T = TypeVar("T")


def timed(what: str, work: Callable[[], T]) -> T:
    """What `work` returns; prints how long it took."""
    start = time.perf_counter()
    result = work()
    print(f"{what:>52} {time.perf_counter() - start:7.2f} s", flush=True)
    return result


def town(n: int) -> np.ndarray:
    """Anchors of an uneven site: half of them on the plane, half in dense quarters."""
    generator = np.random.default_rng(1)
    quarters = generator.uniform(0, EXTENT_M, (40, 2))
    flat = generator.uniform(0, EXTENT_M, (n, 2))
    flat[: n // 2] = quarters[generator.integers(0, 40, n // 2)] + generator.normal(0, EXTENT_M / 40, (n // 2, 2))
    return np.column_stack([flat, generator.uniform(0, 60, n)])


def time_lookup(blocks: Blocks, points: np.ndarray, where: str) -> None:
    """Time the owners of places and compare a part of them with brute force."""
    owner = timed(f"owners of {len(points)} points {where}, {len(blocks)} cores", lambda: blocks.owner(points))
    compared = shapely.points(points[:COMPARED])
    distance = np.stack([shapely.distance(block.core, compared) for block in blocks.items], axis=1)
    print(
        f"{'':>52} {100 * (distance.min(axis=1) > 0).mean():6.0f} % outside every core, "
        f"{(distance.argmin(axis=1) != owner[:COMPARED]).sum()} of {COMPARED} differ from brute force"
    )


def main() -> None:
    """Print one line for each step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--anchors", type=int, default=1_000_000)
    parser.add_argument("--cameras", type=int, default=1_000)
    parser.add_argument("--threads", type=int, default=extension.get_num_threads())
    arguments = parser.parse_args()
    extension.set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    print(f"{arguments.anchors} anchors, {arguments.cameras} cameras")
    positions, cameras = town(arguments.anchors), flight(arguments.cameras, EXTENT_M, 120.0, 45.0)
    views = timed("V of all anchors", lambda: count_visibility(torch.from_numpy(positions).float(), cameras)).numpy()
    generator = np.random.default_rng(2)
    for count, balanced in ((8, False), (8, True), (16, False)):
        config = PartitionConfig(blocks=count, balanced=balanced)
        title = f"cut into {count} blocks{', balanced' if balanced else ''}"
        blocks = timed(title, lambda config=config: partition_scene(positions, views, config, seed=0)[0])  # type: ignore[misc]
    corners = [len(shapely.get_coordinates(block.core)) for block in blocks.items]
    print(f"{'corners of the cores':>52} {min(corners)} to {max(corners)}")
    time_lookup(blocks, generator.uniform(0, EXTENT_M, (1_000_000, 2)), "in the box")
    time_lookup(blocks, generator.uniform(-1.5 * EXTENT_M, 2.5 * EXTENT_M, (1_000_000, 2)), "about it")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
