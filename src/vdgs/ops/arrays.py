"""Arrays in, arrays out: what functions for tensors need for callers with numpy."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from vdgs.config.ranges import MAX_COUNT, Range
from vdgs.config.validation_rules import checked_value
from vdgs.errors import VdgsError, check_kind
from vdgs.geometry.camera import (
    MAX_COORDINATE,
    ROUNDING_TOLERANCE,
    Camera,
    CameraModel,
    is_rigid_motion,
    nearest_rotation,
)
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
    if wrong := int((~points.isfinite()).flatten(1).any(1).sum()) if points.ndim > 1 else 0:
        raise VdgsError(f"points must be finite, and {wrong} of {len(points)} are not: leave them out")


def check_image_index(image_index: Any, decoders: Iterable[Decoder], num_images: int = MAX_COUNT) -> int | None:
    """The number of a training photograph. Raises VdgsError for what is none of those that a decoder knows, or of so
    many where none knows any."""
    if image_index is None:
        return None
    known = [len(each.appearance_embedding) for each in decoders if each.appearance_embedding is not None]
    return int(checked_value("image_index", image_index, Annotated[int, Range(0, min(known, default=num_images) - 1)]))


def without_autocast(device: torch.device | str) -> AbstractContextManager[Any]:
    """A context in which torch computes in float32 there: vdgs decides itself what is computed in what."""
    kind = torch.device(device).type
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


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
    """Cameras from camera-from-world matrices [c, 4, 4] (OpenCV axes) and intrinsics [c, 3, 3] or [3, 3].

    `model` is pinhole or orthographic, which gsplat calls ortho. cx and cy are in pixels from the upper left corner; fx
    and fy in pixels of a pinhole camera, in pixels per unit of the world of an orthographic one. Rotations that were
    rounded (to three decimals, to float16) are replaced by the nearest ones.

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
    poses = np.stack([_rigid(f"viewmats[{index}]", pose) for index, pose in enumerate(poses)]) if len(poses) else poses
    _check_intrinsics(intrinsics)
    return [
        Camera(
            camera_from_world=pose, fx=K[0, 0].item(), fy=K[1, 1].item(), cx=K[0, 2].item(), cy=K[1, 2].item(),
            width=width, height=height, model=kind,
        )
        for pose, K in zip(poses, np.broadcast_to(intrinsics, (len(poses), 3, 3)), strict=True)
    ]  # fmt: skip


def _rigid(name: str, pose: np.ndarray) -> np.ndarray:
    """A pose [4, 4] as it is, or with the nearest rotation where its own was rounded. Raises VdgsError, with the cause,
    for what is no rotation and translation."""
    if is_rigid_motion(pose):
        return pose
    rotation, finite = pose[:3, :3], np.isfinite(pose).all()
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max()) if finite else 0.0
    if not finite or np.abs(pose).max() > MAX_COORDINATE:
        why = f"it holds numbers that are not finite, or above {MAX_COORDINATE:g}"
    elif not np.allclose(pose[3], [0, 0, 0, 1]):
        why = "its last row is not 0 0 0 1: transpose a transposed matrix, divide one of another scale by its corner"
    elif off > ROUNDING_TOLERANCE:
        why = f"R times its transpose is off 1 by {off:.2g}, above {ROUNDING_TOLERANCE:g}: divide R by its scale"
    elif np.linalg.det(rotation) < 0:
        why = "it mirrors the world: undo the mirroring"
    else:
        rounded = pose.copy()
        rounded[:3, :3] = nearest_rotation(rotation)
        return rounded
    raise VdgsError(
        f"{name} is no rotation and translation ({why}): {pose.tolist()}. It leads from the world into the camera."
    )


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
