"""Where a scene fades out, on a GPU: by torch, the cameras that see a point counted by the own kernel."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda import count_visibility
from vdgs.kernels.torch_ref import visibility as reference


def fade_factors(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], least: int, margin: float
) -> Float[Tensor, " n"]:
    """As `torch_ref.fade_factors`."""
    return reference.fade_by_counts(points, cameras, least, margin, count_visibility)
