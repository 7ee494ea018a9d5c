"""The typed set of operations that every implementation offers, and which of them have a CUDA kernel.

What each does is said where it is written most readably: in `vdgs.kernels.reference`. Names and dimensions as in
`vdgs.kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from vdgs.cameras import Camera
    from vdgs.kernels.types import (
        AdamState,
        AnchorSplats,
        DecoderWeights,
        Photometric,
        Projected,
        Raster,
        RasterPullback,
        SplatGradients,
        Splats,
        Statistics,
    )


class Operations(Protocol):
    """What training, drawing and measuring call. Results are on the device of the arguments."""

    def cull(self, positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor: ...

    def decode(
        self,
        positions: Tensor,
        features: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
        weights: DecoderWeights,
        camera: Camera,
        rows: Tensor | None = None,
    ) -> AnchorSplats: ...

    def decode_backward_adam(
        self,
        positions: Tensor,
        moved: Sequence[AdamState],
        weights: DecoderWeights,
        camera: Camera,
        rows: Tensor,
        gradients: SplatGradients,
        updates: Tensor,
    ) -> tuple[bool, tuple[Tensor, ...] | None]: ...

    def project(self, means: Tensor, scales: Tensor, quaternions: Tensor, camera: Camera) -> Projected: ...

    def rasterise(
        self, splats: Splats, background: Tensor, width: int, height: int, *, depth: bool = False
    ) -> Raster: ...

    def rasterise_vjp(
        self, splats: Splats, background: Tensor, width: int, height: int, *, depth: bool = False
    ) -> tuple[Raster, RasterPullback]: ...

    def photometric_loss(
        self, image: Tensor, target: Tensor, mask: Tensor | None = None, *, ssim_weight: float = 0.2
    ) -> Photometric: ...

    def adam_rows(
        self, state: AdamState, rows: Tensor | None, gradient: Tensor, step: int | Tensor, *, beta1: float = 0.9,
        beta2: float = 0.999, epsilon: float = 1e-15,
    ) -> bool: ...  # fmt: skip

    def add_view_statistics(
        self,
        statistics: Statistics,
        visible: Tensor,
        inside: Tensor,
        source: Tensor,
        opacities: Tensor,
        gradient_px: Tensor,
        width: int,
        height: int,
    ) -> None: ...

    def count_visibility(self, points: Tensor, cameras: Sequence[Camera]) -> Tensor: ...

    def mark_visible(self, points: Tensor, camera: Camera) -> Tensor: ...

    def cell_keys(self, positions: Tensor, cell_size: float, origin: Tensor) -> Tensor: ...

    def cell_centres(self, keys: Tensor, cell_size: float, origin: Tensor) -> Tensor: ...

    def group_cells(self, keys: Tensor) -> tuple[Tensor, Tensor]: ...

    def group_max(self, values: Tensor, group: Tensor, count: int) -> Tensor: ...

    def contains(self, table: Tensor, query: Tensor) -> Tensor: ...

    def morton_order(self, positions: Tensor) -> Tensor: ...


#: The names of the operations.
OPERATIONS = tuple(sorted(name for name in vars(Operations) if not name.startswith("_")))

#: Those that `vdgs.kernels.cuda` has.
CUDA_OPERATIONS = ("photometric_loss",)


def missing_on_cuda() -> tuple[str, ...]:
    """The operations without a CUDA implementation."""
    return tuple(name for name in OPERATIONS if name not in CUDA_OPERATIONS)
