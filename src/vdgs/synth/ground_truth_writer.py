"""Writes the truth about a capture; `truth` says what is where."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path

import numpy as np

from vdgs.captures.ground_truth import pack_depth
from vdgs.geometry.camera import Camera
from vdgs.synth.flight_stats import FlightStats
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.synthetic_points import SparseCloud
from vdgs.synth.true_visibility import view_ground_truth
from vdgs.system.atomic_files import write_json


def write_flight(folder: Path, flight: str, found: FlightStats) -> None:
    """`flight.json`."""
    write_json(folder / "flight.json", {"flight": flight, **asdict(found)})


def write_cameras(folder: Path, names: list[str], cameras: list[Camera], gains: np.ndarray) -> None:
    """`cameras.npz`: true poses [n, 4, 4] and linear gains of the channels [n, 3]."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = np.stack([camera.camera_from_world for camera in cameras])
    np.savez_compressed(folder / "cameras.npz", names=np.array(names), camera_from_world=poses, gains=gains)


def write_points(folder: Path, cloud: SparseCloud) -> None:
    """`points.npz`: row k belongs to the point with id k + 1, column k to the image with id k + 1."""
    np.savez_compressed(
        folder / "points.npz", places=cloud.true_points, visibility=cloud.visibility, outliers=cloud.outliers
    )


def write_views(
    folder: Path,
    tracer: RayTracer,
    named: list[tuple[str, Camera]],
    training: int,
    pool: Executor,
    done: Callable[[int], None],
) -> None:
    """Depth of all photographs, and true visibility of those after the first `training` (which count as seeing)."""
    for kind in ("views", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    seeing = [camera for _, camera in named[:training]]

    def write(index: int) -> None:
        name, camera = named[index]
        depth, views = view_ground_truth(tracer, camera, [] if index < training else seeing)
        packed, bounds = pack_depth(depth)
        file = f"{Path(name).stem}.npz"
        if index < training:
            np.savez_compressed(folder / "depth" / file, depth=packed, depth_bounds=bounds)
        else:
            np.savez_compressed(folder / "views" / file, depth=packed, depth_bounds=bounds, visibility=views)

    for count, _ in enumerate(pool.map(write, range(len(named))), start=1):
        done(count)
