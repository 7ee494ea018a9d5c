"""A training step without autograd between image and anchors: render a view, compute the loss, step backward.

Autograd would copy the anchors in view and hold their gradients. Here anchors are read in place, gradients of splats
reuse memory, and an anchor moves as soon as its gradient is known. The bits are those of autograd followed by Adam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import (
    AdamState,
    DecoderWeights,
    IsFinite,
    OrderedSplats,
    Raster,
    RasterPullback,
    SplatGradients,
    SplatSources,
    TrainingSplats,
)
from vdgs.model.anchors import TRAINED_TENSORS, Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import apply_exposure, apply_exposure_backward
from vdgs.training.depth_agreement import DepthAgreement
from vdgs.training.target import TrainingTarget


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedTrainingView:
    """A rendered image, and what backward needs of the m splats of the trained anchors."""

    image: Float[Tensor, "h w 3"]
    source: SplatSources
    colors: Float[Tensor, "m 3"]
    opacities: Float[Tensor, " m"]
    #: Mean volume of the splats; NaN if there are none.
    volume: Float[Tensor, ""]
    pullback: RasterPullback
    #: With depth, where it was asked for.
    raster: Raster
    #: By what opacities were multiplied, 0 where they reached their limit; None: by nothing.
    opacity_factors: Float[Tensor, " m"] | None = None
    #: What the gradients of means_px and conics of these splats may overwrite.
    scratch: tuple[Tensor, Tensor]

    @torch.no_grad()
    def backward(
        self, image: Float[Tensor, "h w 3"], volume_weight: float, agreement: DepthAgreement | None = None
    ) -> SplatGradients:
        """Gradients of a loss: `image` by the image, `volume_weight` by the mean volume, and those by alpha and depth.
        Call it once."""
        m, (alpha, depth) = len(self.source), (None, None) if agreement is None else agreement[1:]
        g = self.pullback(image, alpha, depth, out=self.scratch, count=m)
        # In float32, as autograd divides.
        opacities = g.opacities if self.opacity_factors is None else g.opacities * self.opacity_factors
        volume = float(np.float32(volume_weight) / np.float32(m)) if m else 0.0
        return SplatGradients(
            means_px=g.means_px, conics=g.conics, colors=g.colors, opacities=opacities,
            volume=volume, source=self.source, color_values=self.colors, opacity_values=self.opacities,
            depths=None if agreement is None else g.depths,
        )  # fmt: skip


def with_opacity_factors(splats: TrainingSplats, factors: Float[Tensor, " m"] | None) -> TrainingSplats:
    """The splats with their opacities multiplied, at most full: there the rasterizer's own limit holds."""
    if factors is None:
        return splats
    return replace(splats, opacities=(splats.opacities * factors).clamp_(max=1.0))


@torch.no_grad()
def render_for_training(
    splats: TrainingSplats, camera: Camera, background: Float[Tensor, "3"], frozen_splats: OrderedSplats | None = None,
    *, depth: bool = False, opacity_factors: Float[Tensor, " m"] | None = None,
) -> RenderedTrainingView:  # fmt: skip
    """Draw the splats of trained anchors with `frozen_splats`. The returned view reuses the memory of `splats`."""
    shown = with_opacity_factors(splats, opacity_factors)
    if opacity_factors is not None:  # what is limited follows its opacity no more
        opacity_factors = opacity_factors * (splats.opacities * opacity_factors <= 1.0)
    m, drawn = len(splats.source), shown if frozen_splats is None else shown.concat(frozen_splats)
    kernels = get_backend(drawn.means_px.device)
    raster, pullback = kernels.rasterize_vjp(drawn, background, camera.width, camera.height, depth=depth)
    return RenderedTrainingView(
        image=raster.image, source=splats.source, colors=splats.colors, opacities=splats.opacities,
        volume=splats.volume, pullback=pullback, raster=raster,
        opacity_factors=opacity_factors, scratch=(drawn.means_px[:m], drawn.conics[:m]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class LossGradients:
    """The loss of an image without the volume term, and its gradient by the image."""

    loss: Float[Tensor, ""]
    l1: Float[Tensor, ""]
    ssim: Float[Tensor, ""]
    #: The rendered image in the exposure of the photograph, where one is fitted.
    shown: Float[Tensor, "h w 3"]
    image: Float[Tensor, "h w 3"]


@torch.no_grad()
def compute_loss(
    rendered: RenderedTrainingView,
    target: TrainingTarget,
    decoder: Decoder,
    image_index: int,
    config: TrainConfig,
    weight: float = 1.0,
) -> LossGradients:
    """Compare an image with its photograph, training image `image_index` of the capture. The gradient of a fitted
    exposure is left in the decoder's `.grad`. Gradients are scaled to the whole photograph (`valid_fraction`) and by
    `weight`, the loss is not."""
    image, exposure = rendered.image, decoder.exposure_for_image(image_index)
    shown = image if exposure is None else apply_exposure(image, exposure)
    (loss, l1, ssim), gradient = get_backend(image.device).photometric_loss_vjp(
        shown, target.image, target.mask, ssim_weight=config.loss.ssim_lambda
    )
    scale = target.valid_fraction * weight
    if exposure is not None and decoder.exposure is not None:
        gradient, of_exposure = apply_exposure_backward(image, exposure, gradient)
        if decoder.exposure.requires_grad:
            decoder.exposure.grad = torch.zeros_like(decoder.exposure)
            decoder.exposure.grad[image_index] = of_exposure.mul_(scale)
    if scale != 1.0:
        gradient.mul_(scale)
    return LossGradients(loss=loss, l1=l1, ssim=ssim, shown=shown, image=gradient)


def backward_and_step(
    anchors: Anchors,
    rows: Int64[Tensor, " v"],
    gradients: SplatGradients,
    weights: DecoderWeights,
    camera: Camera,
    states: Sequence[AdamState],
    updates: Int32[Tensor, " n"],
    lr_mask: Callable[[Tensor], Tensor] | None = None,
) -> IsFinite:
    """Move the anchors of the given rows in place, and leave the decoder's gradients in its `.grad`.

    `weights` are the decoder's as the view saw them, `states` those of `TRAINED_TENSORS`, `updates` the count of steps
    of each anchor, `lr_mask` that of `TrainingProblem`. False: a gradient is not finite; some anchors may have moved.
    """
    slow = None if lr_mask is None else _SlowAnchors.of(anchors, rows, lr_mask)
    finite, of_weights = get_backend(anchors.positions.device).decode_backward_adam(
        anchors.positions, states, weights, camera, rows, gradients, updates
    )
    if slow is not None:
        slow.hold_back(anchors)
    made: list[tuple[Tensor, Tensor]] = []
    for tensor, gradient in zip(weights.tensors(), of_weights or [], strict=of_weights is not None):
        if tensor.is_leaf and tensor.requires_grad and tensor.grad is None:
            tensor.grad = gradient
        elif tensor.requires_grad:
            made.append((tensor, gradient))
    if made:  # a first bias that carries an appearance is made of other tensors: autograd knows of which
        tensors, given = zip(*made, strict=True)
        _Given.apply(given, *tensors).backward()
    return finite


class _Given(torch.autograd.Function):
    """A number whose gradients by tensors are given. (`torch.autograd.backward` with gradients imports sympy.)"""

    @staticmethod
    def forward(ctx: Any, gradients: Sequence[Tensor], *tensors: Tensor) -> Tensor:
        ctx.gradients = gradients
        return tensors[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[Tensor | None, ...]:
        return None, *ctx.gradients


#: Rows stepped at once: bounds the memory for zero gradients.
UNSEEN_CHUNK = 2**14


@torch.no_grad()
def step_unseen_anchors(
    anchors: Anchors,
    rows: Int64[Tensor, " v"],
    states: Sequence[AdamState],
    step: int,
    lr_mask: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Step every anchor outside `rows` with a zero gradient, in place, as dense Adam does (Scaffold-GS, 3DGS). `states`
    and `lr_mask` as in `backward_and_step`; `step` counts from 1."""
    unseen = torch.ones_like(anchors.positions[:, 0], dtype=torch.bool).index_fill_(0, rows, False)
    rest = unseen.nonzero()[:, 0]
    slow = None if lr_mask is None else _SlowAnchors.of(anchors, rest, lr_mask)
    kernels = get_backend(anchors.positions.device)
    for some in rest.split(UNSEEN_CHUNK):
        for state in states:
            kernels.adam_rows(state, some, state.parameter.new_zeros(len(some), *state.parameter.shape[1:]), step)
    if slow is not None:
        slow.hold_back(anchors)


@dataclass(frozen=True)
class _SlowAnchors:
    """The moving anchors that make less than a full step, as they were before it."""

    rows: Int64[Tensor, " s"]
    share: Float[Tensor, " s"]
    before: Anchors

    @staticmethod
    def of(anchors: Anchors, rows: Tensor, lr_mask: Callable[[Tensor], Tensor]) -> _SlowAnchors:
        share = lr_mask(anchors.positions[rows])
        slow = (share < 1).nonzero()[:, 0]
        return _SlowAnchors(rows[slow], share[slow], anchors.select(rows[slow]))

    def hold_back(self, anchors: Anchors) -> None:
        """Take back the rest of the step, in place."""
        for name in TRAINED_TENSORS:
            before, tensor = getattr(self.before, name), getattr(anchors, name)
            part = self.share.reshape(-1, *[1] * (before.ndim - 1))
            tensor[self.rows] = before + part * (tensor[self.rows] - before)
