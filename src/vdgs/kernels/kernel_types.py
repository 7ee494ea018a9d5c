"""What goes into the operations and what comes out of them.

Names as in `vdgs.kernels`: v visible anchors, k offsets per anchor, m splats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from vdgs.kernels.splat_segments import SplatMask, SplatSegments

#: Whether all numbers were finite: a bool, or a tensor that holds one on a GPU (reading it would wait for the GPU).
IsFinite = bool | Bool[Tensor, ""]

#: The anchor and offset of each of m splats: see `TrainingSplats`.
SplatSources = Int32[Tensor, "m"] | SplatMask

#: Numbers in an anchor's feature, and units in the hidden layer of every head.
FEATURE_SIZE = 32
HIDDEN_SIZE = 32


@dataclass(frozen=True, eq=False)
class MlpWeights:
    """One MLP `w2 · relu(w1 · x + b1) + b2`, laid out as `torch.nn.Linear` does.

    `input` is 35 (feature, viewing direction) or 36 (and the distance to the camera).
    """

    w1: Float[Tensor, "32 input"]
    b1: Float[Tensor, "32"]
    w2: Float[Tensor, "output 32"]
    b2: Float[Tensor, "output"]

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The four tensors in the order of the fields."""
        return self.w1, self.b1, self.w2, self.b2

    def forward(self, inputs: Float[Tensor, "v 36"]) -> Float[Tensor, "v output"]:
        """Outputs for features, directions and distances (ignored by a first layer of width 35). Raises ValueError if
        the first layer is neither 35 nor 36 wide."""
        width = self.w1.shape[1]
        if width not in (FEATURE_SIZE + 3, FEATURE_SIZE + 4):
            raise ValueError(f"a head's first layer must be 35 or 36 wide, not {width}")
        hidden = torch.relu(torch.nn.functional.linear(inputs[:, :width], self.w1, self.b1))
        return torch.nn.functional.linear(hidden, self.w2, self.b2)


@dataclass(frozen=True, eq=False)
class DecoderWeights:
    """The three heads of the decoder: opacity (k outputs), covariance (7k), color (3k).

    An appearance embedding e of the image enters as a changed first bias of the color head,
    `b1 + w_e · e`, made by the caller: it is the same for every anchor of a view.
    """

    opacity: MlpWeights
    covariance: MlpWeights
    color: MlpWeights

    def tensors(self) -> tuple[Tensor, ...]:
        """The twelve tensors, head by head."""
        return (*self.opacity.tensors(), *self.covariance.tensors(), *self.color.tensors())

    @staticmethod
    def from_tensors(tensors: tuple[Tensor, ...]) -> DecoderWeights:
        """The inverse of `tensors`."""
        return DecoderWeights(*(MlpWeights(*tensors[i : i + 4]) for i in (0, 4, 8)))

    def map(self, change: Callable[[Tensor], Tensor]) -> DecoderWeights:
        """The same weights with `change` applied to each tensor."""
        return DecoderWeights.from_tensors(tuple(change(t) for t in self.tensors()))

    @staticmethod
    def random(k: int, with_distance: bool, generator: torch.Generator) -> DecoderWeights:
        """Weights drawn as `torch.nn.Linear` draws them: uniform within 1/sqrt(inputs)."""

        def head(outputs: int) -> MlpWeights:
            inputs = FEATURE_SIZE + 3 + int(with_distance)
            layers = ((HIDDEN_SIZE, inputs), (outputs, HIDDEN_SIZE))
            shapes = [(shape, columns**-0.5) for rows, columns in layers for shape in ((rows, columns), (rows,))]
            drawn = (
                (torch.rand(shape, generator=generator, dtype=torch.float32, device="cpu"), bound)
                for shape, bound in shapes
            )
            return MlpWeights(*((2 * each - 1) * bound for each, bound in drawn))

        return DecoderWeights(head(k), head(7 * k), head(3 * k))


@dataclass(frozen=True, eq=False)
class ProjectedGaussians:
    """Gaussians on the image plane. Where `valid` is false, every number is zero."""

    means_px: Float[Tensor, "m 2"]
    #: Inverse of the dilated 2D covariance as (xx, xy, yy), in 1/px².
    conics: Float[Tensor, "m 3"]
    #: z in the camera, in world units.
    depths: Float[Tensor, "m"]
    valid: Bool[Tensor, "m"]


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians on the image plane, ready to be rasterized."""

    #: Centers in pixels; the center of the first pixel is (0.5, 0.5).
    means_px: Float[Tensor, "m 2"]
    #: (a, b, c) of a dx^2 + 2 b dx dy + c dy^2.
    conics: Float[Tensor, "m 3"]
    #: Along the viewing direction; equal ones are blended in the order of the rows.
    depths: Float[Tensor, "m"]
    colors: Float[Tensor, "m 3"]
    opacities: Float[Tensor, "m"]

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All that a rasterizer draws, in the order in which it takes them."""
        return self.means_px, self.conics, self.colors, self.opacities, self.depths


class MergedGaussians(NamedTuple):
    """Gaussians that stand for others, their members (`vdgs.model.gaussians.NodeGaussians`). All but the means may be
    in half precision."""

    means: Float[Tensor, "m 3"]
    log_scales: Float[Tensor, "m 3"]
    quaternions: Float[Tensor, "m 4"]
    opacity_logits: Float[Tensor, " m"]
    sh0: Float[Tensor, "m 3"]
    shN: Float[Tensor, "m r 3"]
    covers: Float[Tensor, " m"]
    log_weight_mean: Float[Tensor, " m"]
    log_weight_std: Float[Tensor, " m"]
    sh0_log_weight_cov: Float[Tensor, "m 3"]
    #: What opacities, those of the members too, are multiplied with; None: nothing.
    opacity_factors: Float[Tensor, " m"] | None = None


#: The tensors of `Splats` in the order of its fields.
SPLAT_TENSORS = ("means_px", "conics", "depths", "colors", "opacities")


@dataclass(frozen=True, eq=False, kw_only=True)
class AnchorSplats(Splats):
    """What an anchor model looks like from one camera."""

    #: Products of the three scales (world units cubed), which the loss keeps small.
    volumes: Float[Tensor, "m"]
    #: (Index among the visible anchors)·k + offset, ascending.
    source: Int32[Tensor, "m"]


@dataclass(frozen=True, eq=False, kw_only=True)
class OrderedSplats(Splats):
    """Splats that need not stand in the order in which equal depths are blended."""

    #: That order; None: the order of the rows. gsplat does not look at it.
    segments: SplatSegments | None

    def concat(self, others: OrderedSplats) -> OrderedSplats:
        """These splats followed by others, in the order of each."""
        m, n, device = len(self.depths), len(others.depths), self.depths.device
        both = {name: torch.cat([getattr(self, name), getattr(others, name)]) for name in SPLAT_TENSORS}
        return OrderedSplats(**both, segments=SplatSegments.concat(self.segments, m, others.segments, n, device))


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingSplats(OrderedSplats):
    """What a training step needs of an anchor model as one camera sees it."""

    #: As in `AnchorSplats`; a GPU may only know which offsets show.
    source: SplatSources
    #: Mean volume of the splats; NaN if there are none.
    volume: Float[Tensor, ""]

    @staticmethod
    def of(splats: AnchorSplats) -> TrainingSplats:
        """The same splats."""
        named = {name: getattr(splats, name) for name in SPLAT_TENSORS}
        return TrainingSplats(**named, segments=None, source=splats.source, volume=splats.volumes.mean())


@dataclass(frozen=True, eq=False, kw_only=True)
class SplatGradients:
    """Derivatives of a loss by the splats of a view, and what decoding needs to know of these."""

    means_px: Float[Tensor, "m 2"]
    conics: Float[Tensor, "m 3"]
    colors: Float[Tensor, "m 3"]
    opacities: Float[Tensor, "m"]
    #: By the volume of each: the same number for all.
    volume: float
    #: The splats themselves: see `TrainingSplats`. A card computes the values again.
    source: SplatSources
    color_values: Float[Tensor, "m 3"]
    opacity_values: Float[Tensor, "m"]
    #: By the depth of each; None is zero.
    depths: Float[Tensor, "m"] | None = None


class AdamState(NamedTuple):
    """A parameter of the anchors with its moments, shaped alike, and how fast it moves."""

    parameter: Float[Tensor, "n *rest"]
    first: Float[Tensor, "n *rest"]
    second: Float[Tensor, "n *rest"]
    learning_rate: float
    #: Up to how many times faster than that a row moves that has had few updates: after u of them by
    #: min(early, 1 / sqrt(1 - beta2^u)) (choice; at 1 this is Adam).
    lr_boost: float = 1.0


class Raster(NamedTuple):
    """A drawn picture."""

    #: Color over the background.
    image: Float[Tensor, "h w 3"]
    #: Opacity: 1 - T, where T is the share of the background that shows through.
    alpha: Float[Tensor, "h w"]
    #: Expected depth, the sum of w_i depth_i: not divided by alpha, 0 where nothing is drawn.
    #: None if it was not asked for.
    depth: Float[Tensor, "h w"] | None
    #: Depth of the splat at which the transmittance falls from at least 0.5 to below it, front to back; 0 where it
    #: stays at 0.5 or above. It jumps from splat to splat, so no gradient passes through it. None without `depth`,
    #: and from implementations that cannot tell (gsplat).
    median_depth: Float[Tensor, "h w"] | None = None


class SplatContributions(NamedTuple):
    """What each splat makes of a picture."""

    #: How many pixels: the sum of its weights over them.
    pixels: Float[Tensor, " m"]
    #: The sum of weight times what the picture lacks there.
    residual: Float[Tensor, "m 3"]


class RasterGradients(NamedTuple):
    """Derivatives of a loss by what a picture was drawn from."""

    means_px: Float[Tensor, "m 2"]
    conics: Float[Tensor, "m 3"]
    colors: Float[Tensor, "m 3"]
    opacities: Float[Tensor, "m"]
    #: None for a picture drawn without depth.
    depths: Float[Tensor, "m"] | None
    background: Float[Tensor, "3"]


@runtime_checkable
class RasterPullback(Protocol):
    """From gradients by a picture to gradients by what it was drawn from."""

    def __call__(
        self,
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None,
        count: int | None = None,
    ) -> RasterGradients:
        """Gradients by image [h,w,3], alpha [h,w] and depth [h,w]; None is zero. Call once. Returns those of the
        first `count` splats (None: all m). Those of means_px and conics are written to `out` [count,2], [count,3]."""


class PhotometricLoss(NamedTuple):
    """Scalars of one image. Only `loss` carries a gradient."""

    loss: Float[Tensor, ""]
    l1: Float[Tensor, ""]
    ssim: Float[Tensor, ""]


@dataclass
class DensificationStats:
    """What growth decides by: sums over the views since the last decision (float32; counts are exact up to 2^24)."""

    #: Norm of dL/d(mean) in NDC units, and how often the offset was drawn.
    gradient: Float[Tensor, "n k"]
    drawn: Float[Tensor, "n k"]
    #: Opacity of the anchor's Gaussians, summed over them, and how often its center was in the picture.
    opacity: Float[Tensor, "n"]
    seen: Float[Tensor, "n"]

    @staticmethod
    def zeros(n: int, k: int, device: torch.device | str = "cpu") -> DensificationStats:
        """Those of anchors that no view has shown yet."""
        shapes = (n, k), (n, k), (n,), (n,)
        return DensificationStats(*(torch.zeros(shape, dtype=torch.float32, device=device) for shape in shapes))

    def tensors(self) -> dict[str, Tensor]:
        """The four by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}
