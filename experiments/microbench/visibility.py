"""Counting views (V_i) of a drone flight and fading its edge: the native kernels beside their torch twins, in one run.

    OMP_WAIT_POLICY=PASSIVE python -m experiments.microbench.visibility [--points 1000000] [--cameras 1000]

Brute force runs on the first few cameras only and is scaled up; both counts of those are compared. The edge fades by
those few cameras, where fewer than two see, with both.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np
import torch

from experiments.microbench.hardware_info import describe
from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu import visibility as native
from vdgs.kernels.torch_ref import visibility as reference
from vdgs.visibility.visibility_counts import FADE_BELOW, FADE_MARGIN

BRUTE_FORCE_CAMERAS = 10
#: Name, side of the square in metres, tilt of the cameras in degrees.
FLIGHTS = [("nadir", 2000.0, 0.0), ("oblique", 2000.0, 55.0), ("all see all", 50.0, 0.0)]


def flight(count: int, extent_m: float, height_m: float, tilt_deg: float) -> list[Camera]:
    """Views over a square on a random course, tilted from the vertical in random directions."""
    generator = np.random.default_rng(0)
    cameras = []
    for _ in range(count):
        heading, tilt = generator.uniform(0, 2 * np.pi), np.deg2rad(tilt_deg)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        c, s = np.cos(tilt), np.sin(tilt)
        lean = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        rigid = np.eye(4)
        rigid[:3, :3] = lean @ np.diag([1.0, -1.0, -1.0]) @ turn
        rigid[:3, 3] = -rigid[:3, :3] @ [*generator.uniform(0, extent_m, 2), height_m]
        cameras.append(Camera(camera_from_world=rigid, fx=900.0, fy=900.0, cx=600.0, cy=400.0, width=1200, height=800))
    return cameras


def scene(n: int, extent_m: float) -> torch.Tensor:
    """Points of a city in no order: a plane with heights up to 60 m."""
    generator = np.random.default_rng(1)
    return torch.from_numpy(generator.uniform([0, 0, 0], [extent_m, extent_m, 60], (n, 3))).float()


def timed(function: Callable[..., torch.Tensor], *arguments: object) -> tuple[float, torch.Tensor]:
    """Seconds that a call takes, and what it gives."""
    start = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - start, result


def main() -> None:
    """Print one line for each kind of flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--cameras", type=int, default=1_000)
    parser.add_argument("--threads", type=int, default=extension.get_num_threads())
    arguments = parser.parse_args()
    extension.set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    print(describe())
    print(f"{arguments.points} points x {arguments.cameras} cameras")
    print(f"{'flight':>22} {'native s':>9} {'brute force s (scaled)':>23} {'mean V':>7} {'differing':>9}"
          f" {'fade ms':>8} {'torch ms':>9} {'largest difference':>18}")  # fmt: skip
    for name, extent_m, tilt_deg in FLIGHTS:
        points = scene(arguments.points, extent_m)
        cameras = flight(arguments.cameras, extent_m, 120.0, tilt_deg)
        seconds, count = timed(native.count_visibility, points, cameras)
        few = cameras[:BRUTE_FORCE_CAMERAS]
        brute_force, expected = timed(reference.count_visibility, points, few)
        brute_force *= len(cameras) / len(few)
        differing = int((native.count_visibility(points, few) != expected).sum())
        fade_seconds, factors = timed(native.fade_factors, points, few, FADE_BELOW, FADE_MARGIN)
        torch_seconds, wanted = timed(reference.fade_factors, points, few, FADE_BELOW, FADE_MARGIN)
        print(
            f"{name:>22} {seconds:9.2f} {brute_force:23.1f} {float(count.float().mean()):7.1f} {differing:9}"
            f" {1e3 * fade_seconds:8.1f} {1e3 * torch_seconds:9.1f} {float((factors - wanted).abs().max()):18.1e}"
        )
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
