"""Captures without files, of flights over a plane and along a wall."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from support.captures import look_down
from vdgs.captures.capture import Capture, View
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame


def camera(place: Sequence[float], tilt: float, heading: float) -> Camera:
    pose = look_down(np.array(place, float), tilt, heading)
    return Camera(camera_from_world=pose, fx=300.0, fy=300.0, cx=200.0, cy=150.0, width=400, height=300)


def capture_of(cameras: Sequence[Camera], points: np.ndarray) -> Capture:
    views = tuple(
        View(name=f"{k}.png", camera=each, image_path=Path(f"{k}.png"), mask_path=None, split="train")
        for k, each in enumerate(cameras)
    )
    frame = GroundFrame(scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=False, description="as it is")
    return Capture(
        root=Path(), source="colmap", images="images", views=views, points=points,
        point_colors=np.zeros((len(points), 3), np.uint8), ground=frame,
    )  # fmt: skip


def plane(width: float, length: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([*rng.uniform((-width, -length), (width, length), (900, 2)).T, rng.uniform(0, 4, 900)])


def nadir(width: float = 60.0, length: float = 60.0) -> Capture:
    places = [(x, y, 50.0) for x in np.arange(-width, width + 1, 20) for y in np.arange(-length, length + 1, 20)]
    return capture_of([camera(place, 0.0, 0.0) for place in places], plane(width, length))


def facade() -> Capture:
    """A wall that faces the north, photographed level from there."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-20, 20, 900), rng.uniform(0, 0.5, 900), rng.uniform(0, 15, 900)])
    cameras = [camera((x, 18.0, z), 90.0, 180.0) for x in range(-20, 21, 5) for z in (3.0, 8.0, 12.0)]
    return capture_of(cameras, wall)
