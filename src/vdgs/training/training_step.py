"""A training step by hand: a view drawn, and the backward pass from its image to the anchors.

Autograd would hold a copy of the anchors in view and gradients beside all that they belong to. By hand, anchors are
read where they stand, gradients of splats take the place of what is no longer needed, and an anchor moves as soon as
its gradient is known. The bits are those of autograd through `decode` and `rasterize`, with Adam after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import (
    AdamState,
    DecoderWeights,
    IsFinite,
    OrderedSplats,
    RasterPullback,
    SplatGradients,
    SplatSources,
    TrainingSplats,
)
from vdgs.model.anchors import TRAINED_TENSORS, Anchors


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedTrainingView:
    """A picture for training, and what the backward pass needs of the m splats of the anchors that are trained."""

    image: Float[Tensor, "h w 3"]
    source: SplatSources
    colors: Float[Tensor, "m 3"]
    opacities: Float[Tensor, " m"]
    #: Mean volume of the splats; NaN if there are none.
    volume: Float[Tensor, ""]
    pullback: RasterPullback
    #: What the gradients of means_px and conics of these splats may overwrite.
    scratch: tuple[Tensor, Tensor]

    @torch.no_grad()
    def backward(self, image: Float[Tensor, "h w 3"], volume_weight: float) -> SplatGradients:
        """Gradients of a loss: `image` by the picture, `volume_reg` by the mean volume. Call it once."""
        m = len(self.source)
        found = self.pullback(image, None, None, out=self.scratch, count=m)
        # In float32, as autograd divides.
        volume = float(torch.tensor(volume_weight) / m) if m else 0.0
        return SplatGradients(
            means_px=found.means_px, conics=found.conics, colors=found.colors, opacities=found.opacities,
            volume=volume, source=self.source, color_values=self.colors, opacity_values=self.opacities,
        )  # fmt: skip


@torch.no_grad()
def render_for_training(
    splats: TrainingSplats, camera: Camera, background: Float[Tensor, "3"], frozen_splats: OrderedSplats | None = None
) -> RenderedTrainingView:
    """Draw the splats of trained anchors with those `around` them. The tensors of `splats` are the view's from now on:
    their memory is used again."""
    m, drawn = len(splats.source), splats if frozen_splats is None else splats.concat(frozen_splats)
    kernels = get_backend(drawn.means_px.device)
    raster, pullback = kernels.rasterize_vjp(drawn, background, camera.width, camera.height)
    return RenderedTrainingView(
        image=raster.image, source=splats.source, colors=splats.colors, opacities=splats.opacities,
        volume=splats.volume, pullback=pullback, scratch=(drawn.means_px[:m], drawn.conics[:m]),
    )  # fmt: skip


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

    `weights` are the decoder's as the view saw them, `states` those of `TRAINED_TENSORS`; `updates` counts how often
    each anchor has moved; `lr_mask` is the learning-rate mask of `training.Stage`. False: a gradient is not finite, and
    some anchors may have moved while others have not.
    """
    slow = None if lr_mask is None else _SlowAnchors.of(anchors, rows, lr_mask)
    finite, of_weights = get_backend(anchors.positions.device).decode_backward_adam(
        anchors.positions, states, weights, camera, rows, gradients, updates
    )
    if slow is not None:
        slow.hold_back(anchors)
    if of_weights is not None:
        # A first bias that carries an appearance is made of other tensors: autograd knows of which.
        _Given.apply(of_weights, *weights.tensors()).backward()
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


#: Rows that coast at a time: so many gradients of zero are held.
UNSEEN_CHUNK = 2**14


@torch.no_grad()
def step_unseen_anchors(
    anchors: Anchors,
    rows: Int64[Tensor, " v"],
    states: Sequence[AdamState],
    step: int,
    lr_mask: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Let every anchor but those of the given rows go on along its moments, in place: the step of Adam with no gradient
    that anchors make where a view does not show them and Adam is dense (Scaffold-GS, 3DGS).

    `states` and `lr_mask` as in `backward_and_step`; `step` counts from 1.
    """
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
    """Those of the anchors that move that make less than a full step, as they were before it."""

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
