"""Arrays in, arrays out: what functions for tensors need for callers with numpy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from vdgs.config.ranges import MAX_COUNT, Range
from vdgs.config.validation_rules import checked_value
from vdgs.errors import VdgsError, check_kind
from vdgs.geometry.camera import Camera, CameraModel, is_rigid_motion
from vdgs.model.decoder import Decoder

#: What is no skew but rounding, in pixels.
MAX_SKEW_PX = 1e-6
#: Tensors or arrays: what goes in comes out.
Array = TypeVar("Array", Tensor, np.ndarray)


def in_place(name: str, value: Any) -> Tensor:
    """A tensor, or an array as one that shares its memory. Raises TypeError for anything else, ValueError for an array
    that cannot be written to."""
    check_kind(name, value, Tensor, np.ndarray)
    if isinstance(value, Tensor):
        return value
    if not value.flags.writeable:
        raise ValueError(
            f"{name} is changed in place, and the array is read-only: give a copy, np.array({name}), or open a file "
            "with mmap_mode='r+'"
        )
    if not value.dtype.isnative:
        raise TypeError(f"{name} is changed in place, and its bytes are swapped: give {name}.astype(np.float32)")
    return torch.from_numpy(value)


def as_tensor(name: str, value: Any) -> Tensor:
    """A tensor, or a copy of an array as one, in the precision that it came in. Raises TypeError for anything else."""
    check_kind(name, value, Tensor, np.ndarray)
    if isinstance(value, Tensor):
        return value
    if value.dtype.kind not in "biuf":
        raise TypeError(f"{name} must hold numbers, not {value.dtype}")
    return torch.from_numpy(np.array(value, value.dtype.newbyteorder("=")))


def to_torch(name: str, value: Any) -> Tensor:
    """As `as_tensor`; arrays of float64 become float32, as numpy makes float64 unasked."""
    tensor = as_tensor(name, value)
    return tensor.float() if isinstance(value, np.ndarray) and tensor.dtype == torch.float64 else tensor


def check_finite_points(points: Tensor) -> None:
    """Raise VdgsError for places [n, 3] that are not finite numbers."""
    if wrong := int((~points.isfinite()).reshape(len(points), -1).any(1).sum()) if points.ndim else 0:
        raise VdgsError(f"points must be finite, and {wrong} of {len(points)} are not: leave them out")


def check_image_index(image_index: Any, decoders: Iterable[Decoder], num_images: int = MAX_COUNT) -> int | None:
    """The number of a training photograph. Raises VdgsError for what is none of those that a decoder knows, or of so
    many where none knows any."""
    if image_index is None:
        return None
    known = [len(each.appearance_embedding) for each in decoders if each.appearance_embedding is not None]
    return int(checked_value("image_index", image_index, Annotated[int, Range(0, min(known, default=num_images) - 1)]))


def like(given: Any, value: Any) -> Any:
    """A result in the kind that was given: arrays for arrays."""
    if not isinstance(given, np.ndarray):
        return value
    if isinstance(value, Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, dict):
        return {name: like(given, each) for name, each in value.items()}
    if isinstance(value, tuple):
        items = [like(given, each) for each in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value


def cameras_from(
    viewmats: Array, Ks: Array, width: int, height: int, *, model: CameraModel | Literal["ortho"] = "pinhole"
) -> list[Camera]:
    """Cameras from camera-from-world matrices [c, 4, 4] (OpenCV axes) and intrinsics [c, 3, 3] or [3, 3] in pixels.
    `model` is pinhole or orthographic, which gsplat calls ortho.

    Raises VdgsError for what makes no camera: a pose that is no rotation and translation, intrinsics with skew or of
    another scale, a size that is no whole number. ValueError for other shapes.
    """
    width, height = (
        checked_value(name, side, Annotated[int, Range(1, MAX_COUNT)])
        for name, side in (("width", width), ("height", height))
    )
    kind: CameraModel = checked_value("model", "orthographic" if model == "ortho" else model, CameraModel)
    given = (each.detach().cpu().numpy() if isinstance(each, Tensor) else each for each in (viewmats, Ks))
    poses, intrinsics = (np.array(each, np.float64) for each in given)
    if poses.shape[1:] != (4, 4) or intrinsics.shape not in ((3, 3), (len(poses), 3, 3)):
        remedy = ": give viewmats[None] of a single camera" if poses.shape == (4, 4) else ""
        raise ValueError(
            f"viewmats must be [c, 4, 4] and Ks [c, 3, 3], not {poses.shape} and {intrinsics.shape}{remedy}"
        )
    for index, pose in enumerate(poses):
        if not is_rigid_motion(pose):
            raise VdgsError(
                f"viewmats[{index}] is no rotation and translation of finite numbers: {pose.tolist()}. It leads from "
                "the world into the camera, and its last row is 0 0 0 1. Divide the rotation by its scale, undo a "
                "mirroring, or transpose the matrix."
            )
    _check_intrinsics(intrinsics)
    return [
        Camera(
            camera_from_world=pose, fx=K[0, 0].item(), fy=K[1, 1].item(), cx=K[0, 2].item(), cy=K[1, 2].item(),
            width=width, height=height, model=kind,
        )
        for pose, K in zip(poses, np.broadcast_to(intrinsics, (len(poses), 3, 3)), strict=True)
    ]  # fmt: skip


def _check_intrinsics(Ks: np.ndarray) -> None:
    """Raise VdgsError unless all of them [..., 3, 3] are those of a camera without skew."""
    for K in Ks.reshape(-1, 3, 3):
        plain = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0 and np.abs(K - plain).max() <= MAX_SKEW_PX):
            raise VdgsError(
                f"Ks holds {K.tolist()}, not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0. Transpose a "
                "transposed one and divide one of another scale by its last number; cameras here have no skew: bring "
                "such images to one without."
            )
