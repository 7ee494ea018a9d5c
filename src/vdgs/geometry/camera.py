"""Cameras: where a picture was taken from and how space falls onto its pixels.

Conventions (docs/conventions.md): OpenCV axes (+x right, +y down, +z forward), pixel centers at 0.5,
`camera_from_world` maps world points to camera points. Names: w world, c camera, px pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral, Real
from typing import Literal, cast, get_args

import numpy as np

from vdgs.errors import VdgsError, check_kind

CameraModel = Literal["pinhole", "orthographic"]

#: Coordinates are at most so large, in units of the ground frame or the capture's own.
MAX_COORDINATE = 1e9
#: Points nearer than this (in units of the ground frame) are never drawn.
NEAR_PLANE = 0.01


def camera_center(camera_from_world: np.ndarray) -> np.ndarray:
    """Where a camera is in the world, [3], by its pose [4, 4]."""
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def camera_centers(poses: np.ndarray) -> np.ndarray:
    """Where cameras are in the world, [n, 3], by their `camera_from_world` [n, 4, 4] (or their first three rows)."""
    return -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """One view: pose and intrinsics at a given image size.

    `camera_from_world` is a rigid motion [4, 4], float64. For a pinhole camera fx, fy are in pixels;
    for an orthographic one in pixels per world unit. cx, cy are in pixels from the corner of the image.
    """

    camera_from_world: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    model: CameraModel = "pinhole"
    #: Width and height of the picture that this one is a part of (`cropped`); None: it is whole.
    uncropped_size: tuple[int, int] | None = None
    #: Size in the world of a photograph's pixel; seen from nearer, Gaussians are drawn as blurred as it is. 0: nowhere.
    photograph_pixel: float = 0.0

    @cached_property
    def position(self) -> np.ndarray:
        """Camera center in the world, [3] float64."""
        return camera_center(self.camera_from_world)

    @cached_property
    def forward(self) -> np.ndarray:
        """Viewing direction in the world, unit [3] float64."""
        return self.camera_from_world[2, :3].copy()

    @cached_property
    def packed(self) -> np.ndarray:
        """What the kernels read, [23] float32: rotation (9, row-major), translation (3),
        fx, fy, cx, cy, width, height, orthographic (0 or 1), near, width and height of the whole picture,
        `photograph_pixel`."""
        return np.concatenate([self.packed_float64, self.full_size, [self.photograph_pixel]]).astype(np.float32)

    @cached_property
    def packed_float64(self) -> np.ndarray:
        """The first 20 numbers of `packed` in float64: what decides which places a frustum holds."""
        rigid = self.camera_from_world
        tail = [self.fx, self.fy, self.cx, self.cy, self.width, self.height,
                float(self.model == "orthographic"), NEAR_PLANE]  # fmt: skip
        return np.concatenate([rigid[:3, :3].ravel(), rigid[:3, 3], tail]).astype(np.float64)

    @property
    def full_size(self) -> tuple[int, int]:
        """Width and height of the whole picture."""
        return self.uncropped_size or (self.width, self.height)

    def cropped(self, left: int, top: int, right: int, bottom: int) -> Camera:
        """The part of this picture with columns `left` to `right` and rows `top` to `bottom`, both without the last.

        It draws what the whole picture shows there, but for single pixels at the edges of Gaussians (by up to 8 of 255:
        a Gaussian's bounds are rounded anew). Raises ValueError where that is no part of it."""
        if not (0 <= left < right <= self.width and 0 <= top < bottom <= self.height):
            box = f"columns {left} to {right} and rows {top} to {bottom}"
            raise ValueError(f"{box} are no part of a picture of {self.width}x{self.height}")
        cx, cy, width, height = self.cx - left, self.cy - top, right - left, bottom - top
        return replace(self, cx=cx, cy=cy, width=width, height=height, uncropped_size=self.full_size)

    def resized(self, width: int, height: int) -> Camera:
        """The same view on an image of another size. Raises ValueError for a part of a picture."""
        if self.uncropped_size is not None:
            raise ValueError("resize the whole picture, then take a part of it")
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def reshaped(self, width: int, height: int) -> Camera:
        """The same view, as high as before, on an image of another size and shape: pixels keep their shape, and the
        picture ends earlier or later at its sides. Raises ValueError for a part of a picture."""
        scale = height / self.height
        middle = width / 2 + scale * (self.cx - self.width / 2)
        return replace(self.resized(width, height), fx=self.fx * scale, cx=middle)

    def limit_size(self, max_side_px: int) -> Camera:
        """The same view at most so many pixels wide and high; never enlarged."""
        scale = min(1.0, max_side_px / max(self.width, self.height))
        return self.resized(max(1, round(scale * self.width)), max(1, round(scale * self.height)))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [n, 3] to pixels [n, 2] and depths [n] (float64; no clipping)."""
        local = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth = local[:, 2]
        divisor = depth if self.model == "pinhole" else np.ones_like(depth)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = self.fx * local[:, 0] / divisor + self.cx
            y = self.fy * local[:, 1] / divisor + self.cy
        return np.stack([x, y], axis=1), depth

    def unproject(self, depth: np.ndarray) -> np.ndarray:
        """Depth [h, w] at the pixel centers to world points [h, w, 3] (float64): the inverse of `project`."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        across = np.stack(np.meshgrid(x, y), axis=-1)
        if self.model == "pinhole":
            across = across * depth[..., None]
        local = np.concatenate([across, np.asarray(depth, np.float64)[..., None]], axis=-1)
        return (local - self.camera_from_world[:3, 3]) @ self.camera_from_world[:3, :3]

    def in_frustum(self, points: np.ndarray) -> np.ndarray:
        """Which points fall inside the frustum: z > near and projected center on the image, [n] bool."""
        return self.holds(*self.project(points))

    def holds(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Which points are in the frustum, of what `project` says of them."""
        x, y = pixels[:, 0], pixels[:, 1]
        return (depth > NEAR_PLANE) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)


#: Poses whose rotation is this far from one (R Rᵀ from 1) are taken for rounded ones: three decimals leave 0.002.
ROUNDING_TOLERANCE = 5e-3


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The orthonormal matrix [3, 3] that is nearest to one."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def is_rigid_motion(matrix: np.ndarray, tolerance: float = 1e-4) -> bool:
    """Whether a matrix [4, 4] is a rotation (R Rᵀ = 1 to `tolerance`) and a translation: finite, without a scale, not
    mirrored or transposed."""
    rotation = matrix[:3, :3]
    finite = bool(np.isfinite(matrix).all()) and np.abs(matrix).max() <= MAX_COORDINATE
    turned = finite and np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance) and np.linalg.det(rotation) > 0
    return bool(turned and np.allclose(matrix[3], [0, 0, 0, 1]))


def check_cameras(cameras: object) -> None:
    """Raise what `check_camera` raises unless it is a sequence of cameras."""
    remedy = "of a capture take [view.camera for view in capture.train_views]"
    check_kind("cameras", cameras, Sequence, remedy=remedy)
    for camera in cast("Sequence[object]", cameras):
        check_camera("each of cameras", camera, remedy)


def check_camera(name: str, camera: object, remedy: str = "") -> None:
    """Raise TypeError for what is no camera, VdgsError for one that nothing can be drawn with: `Camera` itself checks
    nothing, as thousands are made."""
    check_kind(name, camera, Camera, remedy=remedy)
    camera = cast("Camera", camera)
    pose, sides = camera.camera_from_world, (camera.width, camera.height)
    if not (isinstance(pose, np.ndarray) and pose.shape == (4, 4) and is_rigid_motion(pose)):
        raise VdgsError(
            f"{name}: camera_from_world must be a rotation and a translation, [4, 4] of numpy, not {pose} "
            "(vdgs.cameras_from takes rounded ones)"
        )
    if not all(isinstance(side, Integral) and side >= 1 for side in sides):
        raise VdgsError(f"{name}: width and height must be whole numbers of pixels, at least 1, not {sides}")
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    if not (all(isinstance(each, Real) and math.isfinite(each) for each in lens) and min(lens[:2]) > 0):
        raise VdgsError(f"{name}: fx and fy must be above 0, and cx and cy finite numbers, not {lens}")
    if camera.model not in get_args(CameraModel):
        raise VdgsError(f"{name}: model must be {' or '.join(get_args(CameraModel))}, not {camera.model!r}")
    if not (isinstance(camera.photograph_pixel, Real) and 0 <= camera.photograph_pixel < math.inf):
        raise VdgsError(
            f"{name}: photograph_pixel must be a finite number, at least 0, not {camera.photograph_pixel!r}"
        )
