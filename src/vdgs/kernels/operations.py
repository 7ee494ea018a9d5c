"""The operations of every implementation, documented in `vdgs.kernels.torch_ref`, and their choice by device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from vdgs.geometry.camera import Camera
    from vdgs.kernels.kernel_types import (
        AdamState,
        AnchorSplats,
        DecoderWeights,
        DensificationStats,
        IsFinite,
        MergedGaussians,
        PhotometricLoss,
        ProjectedGaussians,
        Raster,
        RasterPullback,
        SplatContributions,
        SplatGradients,
        Splats,
        TrainingSplats,
    )
    from vdgs.kernels.splat_segments import SplatMask


class KernelBackend(Protocol):
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

    def decode_for_training(
        self,
        positions: Tensor,
        features: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
        weights: DecoderWeights,
        camera: Camera,
        rows: Tensor | None = None,
    ) -> TrainingSplats: ...

    def decode_backward_adam(
        self,
        positions: Tensor,
        moved: Sequence[AdamState],
        weights: DecoderWeights,
        camera: Camera,
        rows: Tensor,
        gradients: SplatGradients,
        updates: Tensor,
    ) -> tuple[IsFinite, tuple[Tensor, ...] | None]: ...

    def merged_splats(
        self, parts: Sequence[MergedGaussians], camera: Camera, before: Splats | None = None
    ) -> Splats: ...

    def project(self, means: Tensor, scales: Tensor, quaternions: Tensor, camera: Camera) -> ProjectedGaussians: ...

    def rasterize(
        self, splats: Splats, background: Tensor, width: int, height: int, *, depth: bool = False
    ) -> Raster: ...

    def rasterize_vjp(
        self, splats: Splats, background: Tensor, width: int, height: int, *, depth: bool = False
    ) -> tuple[Raster, RasterPullback]: ...

    def splat_contributions(
        self, splats: Splats, background: Tensor, width: int, height: int, wanted: Tensor | None = None
    ) -> SplatContributions: ...

    def photometric_loss(
        self, image: Tensor, target: Tensor, mask: Tensor | None = None, *, ssim_weight: float = 0.2
    ) -> PhotometricLoss: ...

    def photometric_loss_vjp(
        self, image: Tensor, target: Tensor, mask: Tensor | None = None, *, ssim_weight: float = 0.2
    ) -> tuple[PhotometricLoss, Tensor]: ...

    def adam_rows(
        self, state: AdamState, rows: Tensor | None, gradient: Tensor, step: int | Tensor, *, beta1: float = 0.9,
        beta2: float = 0.999, epsilon: float = 1e-15,
    ) -> IsFinite: ...  # fmt: skip

    def adam_tensors(
        self, states: Sequence[AdamState], gradients: Sequence[Tensor], step: int, *, beta1: float = 0.9,
        beta2: float = 0.999, epsilon: float = 1e-15,
    ) -> IsFinite: ...  # fmt: skip

    def add_view_statistics(
        self,
        statistics: DensificationStats,
        visible: Tensor,
        inside: Tensor,
        source: Tensor | SplatMask,
        opacities: Tensor,
        gradient_px: Tensor,
        width: int,
        height: int,
    ) -> None: ...

    def harmonic_colors(
        self, means: Tensor, coefficients: Tensor, rows: Tensor, eye: Tensor, degree: int
    ) -> Tensor: ...

    def fit_harmonics(
        self, directions: Tensor, colors: Tensor, weights: Tensor, starts: Tensor, degree: int, ridge: float
    ) -> Tensor: ...

    def mean_ellipsoids(
        self, log_scales: Tensor, quaternions: Tensor, weights: Tensor, starts: Tensor
    ) -> tuple[Tensor, Tensor]: ...

    def count_visibility(self, points: Tensor, cameras: Sequence[Camera]) -> Tensor: ...

    def mark_visible(self, points: Tensor, camera: Camera) -> Tensor: ...

    def fade_factors(self, points: Tensor, cameras: Sequence[Camera], least: int, margin: float) -> Tensor: ...

    def cell_keys(self, positions: Tensor, cell_size: float, origin: Tensor) -> Tensor: ...

    def cell_centers(self, keys: Tensor, cell_size: float, origin: Tensor) -> Tensor: ...

    def group_cells(self, keys: Tensor) -> tuple[Tensor, Tensor]: ...

    def group_max(self, values: Tensor, group: Tensor, count: int) -> Tensor: ...

    def contains(self, table: Tensor, query: Tensor) -> Tensor: ...

    def morton_order(self, positions: Tensor) -> Tensor: ...


#: The names of the operations: each implementation's `__init__` imports them under these.
OPERATION_NAMES = tuple(sorted(name for name in vars(KernelBackend) if not name.startswith("_")))

#: The implementations (modules of `vdgs.kernels`) of each operation on an NVIDIA GPU; of several the first one unless
#: another is asked for (`gpu/rasterizer.py`).
GPU_BACKENDS: dict[str, tuple[str, ...]] = dict.fromkeys(OPERATION_NAMES, ("torch_ref",)) | {
    "adam_tensors": ("cuda",),
    "add_view_statistics": ("cuda",),
    "count_visibility": ("cuda",),
    "cull": ("cuda",),
    "decode": ("cuda",),
    "decode_backward_adam": ("cuda",),
    "decode_for_training": ("cuda",),
    "mark_visible": ("cuda",),
    "photometric_loss": ("cuda",),
    "photometric_loss_vjp": ("cuda",),
    "rasterize": ("cuda", "gsplat"),
    "rasterize_vjp": ("cuda", "gsplat"),
    "splat_contributions": ("cuda",),
}


def backends_for(operation: str, device_type: str) -> tuple[str, ...]:
    """The implementations of an operation on a kind of device, the preferred one first."""
    return ("cpu",) if device_type == "cpu" else GPU_BACKENDS[operation] if device_type == "cuda" else ("torch_ref",)
