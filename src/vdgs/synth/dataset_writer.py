"""Writes the truth about a capture; `truth` says what is where."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np

from vdgs.captures.formats.colmap_writing import write_model_files
from vdgs.captures.ground_truth import pack_depth
from vdgs.geometry.camera import Camera
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.synthetic_points import SparseCloud, observations_by_image
from vdgs.synth.true_visibility import FlightStats, view_ground_truth
from vdgs.system.atomic_files import write_json
from vdgs.system.lazy_pycolmap import pycolmap


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
    *,
    off_path: bool = False,
) -> None:
    """Depth of all photographs, and true visibility of those after the first `training` (which count as seeing).
    `off_path`: of these alone."""
    for kind in ("views",) if off_path else ("views", "depth"):
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

    for count, _ in enumerate(pool.map(write, range(training if off_path else 0, len(named))), start=1):
        done(count)


def write_model(folder: Path, cameras: list[Camera], names: list[str], cloud: SparseCloud) -> None:
    """Write `cameras.bin`, `images.bin`, `points3D.bin` (and COLMAP's rigs and frames) to a new folder.

    All images share one pinhole camera. Point k of the cloud gets the id k + 1, image k the id k + 1.
    """
    model = pycolmap.Reconstruction()
    place_in_image = np.empty(len(cloud.observed_image), np.int64)
    of_image = observations_by_image(cloud.observed_image, len(cameras))
    for at in of_image:
        place_in_image[at] = np.arange(len(at))
    _add_images(model, cameras, names, [cloud.observed_px[at] for at in of_image])
    ends = np.searchsorted(cloud.observed_point, np.arange(len(cloud.points) + 1))
    for k, (start, end) in enumerate(pairwise(ends)):
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(cloud.observed_image[m]) + 1, int(place_in_image[m])) for m in range(start, end)]
        )
        point_id = model.add_point3D(cloud.points[k], track, cloud.colors[k])
        model.point3D(point_id).error = float(cloud.errors[k])
    write_model_files(model, folder)


def write_poses(folder: Path, cameras: list[Camera], names: list[str]) -> None:
    """As `write_model`, without points."""
    model = pycolmap.Reconstruction()
    _add_images(model, cameras, names, [np.empty((0, 2))] * len(names))
    write_model_files(model, folder)


def _add_images(
    model: pycolmap.Reconstruction, cameras: list[Camera], names: list[str], keypoints: list[np.ndarray]
) -> None:
    first = cameras[0]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE",
            width=first.width,
            height=first.height,
            params=[first.fx, first.fy, first.cx, first.cy],
            camera_id=1,
        )
    )
    for k, (camera, name, pixels) in enumerate(zip(cameras, names, keypoints, strict=True)):
        pose = camera.camera_from_world
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3]))
