"""Writes a COLMAP model: cameras, poses, points and their tracks."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from vdgs.geometry.camera import Camera
from vdgs.synth.synthetic_points import SparseCloud, observations_by_image


def write_model(folder: Path, cameras: list[Camera], names: list[str], cloud: SparseCloud) -> None:
    """Write `cameras.bin`, `images.bin`, `points3D.bin` (and COLMAP's rigs and frames) to a new folder.

    All images share one pinhole camera. Point k of the cloud gets the id k + 1, image k the id k + 1.
    """
    model = pycolmap.Reconstruction()
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
    place_in_image = np.empty(len(cloud.observed_image), np.int64)
    of_image = observations_by_image(cloud.observed_image, len(cameras))
    for k, (camera, name, at) in enumerate(zip(cameras, names, of_image, strict=True)):
        place_in_image[at] = np.arange(len(at))
        pose = camera.camera_from_world
        image = pycolmap.Image(name=name, keypoints=cloud.observed_px[at], camera_id=1, image_id=k + 1)
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        model.add_image_with_trivial_frame(image, rigid)
    ends = np.searchsorted(cloud.observed_point, np.arange(len(cloud.points) + 1))
    for k, (start, end) in enumerate(pairwise(ends)):
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(cloud.observed_image[m]) + 1, int(place_in_image[m])) for m in range(start, end)]
        )
        point_id = model.add_point3D(cloud.points[k], track, cloud.colors[k])
        model.point3D(point_id).error = float(cloud.errors[k])
    folder.mkdir(parents=True)
    model.write(folder)
