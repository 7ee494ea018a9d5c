"""What a step is to draw: a photograph, or the part of it that the stage wants, and where it must be opaque."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.kernels.moving import upload
from vdgs.model.ground import at_size
from vdgs.training.crops import Box, crop_at
from vdgs.training.depths import PixelDepths
from vdgs.training.state import Stage

#: Share of light let through below which the root is bent to a line: its slope would have no end.
NEARLY_OPAQUE = 1e-3


@dataclass(frozen=True, eq=False)
class Target:
    """A photograph or a part of it."""

    image: UInt8[Tensor, "h w 3"]
    #: 1 where a pixel counts; None: everywhere.
    mask: UInt8[Tensor, "h w"] | None
    #: Where it must be opaque (`model.ground`), among the pixels that count; None: nothing is asked of alpha.
    ground: Bool[Tensor, "h w"] | None
    camera: Camera
    #: The share of the photograph's pixels that count in this part. Gradients are multiplied by it: those of a mean
    #: over the part become those of a mean over the whole picture, in which thresholds of growth are given (but for
    #: SSIM within its window of the part's border, where it sees nothing beyond).
    share: float = 1.0
    #: How many pixels count, at least 1; None: asked of the mask.
    counted: int | None = None
    #: Pixels with the depth of sparse points, and how seldom each pixel's place is seen; None: of depth nothing is
    #: asked.
    depths: PixelDepths | None = None
    seldom: Float[Tensor, "h w"] | None = None

    def transparency(self, alpha: Float[Tensor, "h w"], weight: float) -> tuple[Tensor, Float[Tensor, "h w"]]:
        """`weight` times the sum of √(1 - alpha) over `ground`, divided by how many pixels count at all; and its
        gradient by alpha. Needs `ground`.

        The background is a colour of the place, so a model can leave ground half transparent and borrow its colour:
        photographs alone do not object. Before any other background such a scene is a ghost, and its depth is wrong.
        The root pulls hardest where little is left to do, so that a small weight makes ground opaque and hardly bends
        what is far from it (choice; reports/solid-ground.md).
        """
        assert self.ground is not None
        counted = self.counted or (alpha.numel() if self.mask is None else max(int(self.mask.count_nonzero()), 1))
        root = (1.0 - alpha).clamp(min=0.0).add(NEARLY_OPAQUE).sqrt()
        shown = self.ground.to(alpha.dtype) * (weight / counted)
        return (shown * (root - NEARLY_OPAQUE**0.5)).sum(), shown / (-2.0 * root)


def box_at(stage: Stage, view: int, downscale: int, iteration: int) -> Box:
    """The part of a view that iteration (from 0) is to draw."""
    camera = stage.images.camera(view, downscale)
    return crop_at(stage.crops, view, iteration).pixels(camera.width, camera.height)


def target_at(stage: Stage, view: int, downscale: int, box: Box) -> Target:
    """A part of a view's photograph, and what is asked of it, on the stage's device."""
    image, mask = stage.images.get(view, downscale)
    whole, (left, top, right, bottom) = stage.images.camera(view, downscale), box
    camera, inside = part_of(whole, box), (slice(top, bottom), slice(left, right))
    # Counted and cut where the photograph is, before it is brought to the device.
    of_whole = counted_in(mask, whole)
    mask = None if mask is None else mask[inside]
    counted = of_whole if camera is whole else counted_in(mask, camera)
    image = upload(image[inside], stage.device)
    mask = None if mask is None else upload(mask, stage.device)
    return Target(
        image, mask, _ground(stage, view, mask, inside, whole), camera,
        share=1.0 if camera is whole else counted / max(of_whole, 1), counted=max(counted, 1),
        depths=_depths(stage, view, mask, camera), seldom=_seldom(stage, view, inside, whole),
    )  # fmt: skip


def part_of(whole: Camera, box: Box) -> Camera:
    """The camera of a part of a picture; itself for all of it."""
    return whole if box == (0, 0, whole.width, whole.height) else whole.cropped(*box)


def counted_in(mask: UInt8[Tensor, "h w"] | None, camera: Camera) -> int:
    """How many pixels of a picture count."""
    return camera.width * camera.height if mask is None else int(mask.count_nonzero())


def _ground(
    stage: Stage, view: int, mask: Tensor | None, inside: tuple[slice, slice], whole: Camera
) -> Bool[Tensor, "h w"] | None:
    if stage.ground is None or not stage.config.loss.alpha_weight:
        return None
    ground = at_size(stage.ground[view], whole.width, whole.height)[inside]
    return ground if mask is None else ground & (mask > 0)


def _seldom(stage: Stage, view: int, inside: tuple[slice, slice], whole: Camera) -> Float[Tensor, "h w"] | None:
    """How seldom each pixel's place is seen, where depth is asked to be smooth."""
    if stage.seldom_cells is None:
        return None
    return at_size(stage.seldom_cells[view], whole.width, whole.height)[inside]


def _depths(stage: Stage, view: int, mask: Tensor | None, camera: Camera) -> PixelDepths | None:
    known = None if stage.known_depths is None else stage.known_depths[view]
    return None if known is None else known.in_picture(camera, mask)
