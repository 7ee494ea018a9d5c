"""The images of a COLMAP model as a camera path: a flight along photographs that were registered, in order of names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from vdgs.captures.capture_order import natural_key
from vdgs.captures.formats.colmap import read_colmap
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera

_FILES = ("images.txt", "images.bin", "cameras.txt", "cameras.bin")


def is_colmap(path: Path) -> bool:
    """Whether a camera path is asked for by the folder of a model, or by one of its files."""
    return path.is_dir() or path.name.lower() in _FILES


def read_colmap_path(path: Path, default: Camera) -> list[Camera]:
    """The cameras of a model in its own world, DJI_2 before DJI_10, all of the size of the first; lenses are drawn
    without their distortion. What is no matter of lens and pose is the default's. Raises VdgsError naming the file."""
    folder = path if path.is_dir() else path.parent
    views = sorted(read_colmap(folder).views, key=lambda view: natural_key(view.name))
    if not views:
        raise VdgsError(f"{folder}: holds no images, and a camera path needs at least one.")
    first, cameras = views[0].intrinsics, list[Camera]()
    for view in views:
        lens = view.intrinsics
        (fx, fy), (cx, cy) = lens.focal, lens.principal_point
        camera = replace(default, camera_from_world=view.camera_from_world, fx=fx, fy=fy, cx=cx, cy=cy,
                         width=lens.width, height=lens.height)  # fmt: skip
        same = (lens.width, lens.height) == (first.width, first.height)
        cameras.append(camera if same else camera.reshaped(first.width, first.height))
    return cameras
