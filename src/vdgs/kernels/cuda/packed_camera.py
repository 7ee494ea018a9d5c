"""A camera as kernels are given it."""

from __future__ import annotations

import ctypes

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import FRUSTUM_MARGIN


class PackedCamera(ctypes.Structure):
    """`Camera` of gaussian_math.h, field by field."""

    _fields_ = (
        *((name, 3 * ctypes.c_float) for name in ("right", "down", "forward", "center")),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "width", "height", "near", "limit_x", "limit_y")),
        ("orthographic", ctypes.c_bool),
    )  # fmt: skip

    @staticmethod
    def of(camera: Camera) -> PackedCamera:
        """As `unpack_camera` of gaussian_math.h makes it of the same numbers."""
        numbers = [float(each) for each in camera.packed]
        axes, translation = [numbers[:3], numbers[3:6], numbers[6:9]], numbers[9:12]
        center = [-sum(axis[i] * shift for axis, shift in zip(axes, translation, strict=True)) for i in range(3)]
        fx, fy, cx, cy, width, height, orthographic, near, whole_width, whole_height = numbers[12:]
        limits = (FRUSTUM_MARGIN * 0.5 * side / focal for side, focal in ((whole_width, fx), (whole_height, fy)))
        vectors = (tuple(vector) for vector in (*axes, center))
        return PackedCamera(*vectors, fx, fy, cx, cy, width, height, near, *limits, bool(orthographic))
