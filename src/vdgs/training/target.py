"""What a step is to draw: a photograph, or the part of it that the stage wants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import TrainingSplats
from vdgs.kernels.transfer import upload
from vdgs.model.anchors import Anchors
from vdgs.training.crops import PixelBox, crop_at
from vdgs.training.training_state import TrainingImages, TrainingProblem

#: Share of the steps that draw all levels of the anchors, whatever the size of their pixels (choice).
ALL_LEVELS_SHARE = 0.5
#: The stream of random numbers from which the noise of opacities is drawn.
OPACITY_STREAM = 78


def mean_image_color(
    images: TrainingImages, count: int, downscale: int, max_images: int = 32
) -> tuple[float, float, float]:
    """Mean color in [0, 1] of the pixels that count, over up to `max_images` evenly chosen training views."""
    total, pixels = np.zeros(3), 0
    for index in np.unique(np.linspace(0, count - 1, min(count, max_images)).astype(int)):
        image, mask = images.get(int(index), downscale)
        colors = image.numpy().reshape(-1, 3) if mask is None else image.numpy()[mask.numpy() > 0]
        total += colors.sum(0, dtype=np.float64)
        pixels += len(colors)
    red, green, blue = (float(np.float32(value)) for value in total / (255.0 * max(pixels, 1)))
    return red, green, blue


def background_at(stage: TrainingProblem, iteration: int) -> Tensor:
    """Color [3] behind the scene at this iteration (from 0): from its own to a random one of the RGB cube."""
    color, share = (
        torch.tensor(stage.background, dtype=torch.float32, device="cpu"),
        stage.config.loss.random_background,
    )
    if share:
        generator = torch.Generator().manual_seed(stage.config.seed * 1_000_033 + iteration)
        # Drawn on the CPU: the same colors for any device.
        color = torch.lerp(color, torch.rand(3, generator=generator, dtype=torch.float32, device="cpu"), share)
    return color.to(stage.device, non_blocking=True)


def opacity_factors_at(stage: TrainingProblem, iteration: int, splats: TrainingSplats) -> Float[Tensor, " m"] | None:
    """Factors of the opacities of splats at this iteration, not negative; None without noise. The numbers follow the
    order of anchors, in which a card need not write their splats."""
    deviation = stage.config.loss.opacity_noise
    if not deviation:
        return None
    count = len(splats.opacities)
    # Drawn on the CPU: the same numbers for any device.
    drawn = np.random.default_rng((stage.config.seed, OPACITY_STREAM, iteration)).standard_normal(count, np.float32)
    noise = upload(torch.from_numpy(drawn).mul_(deviation).add_(1.0).clamp_(min=0.0), stage.device)
    if splats.segments is None:
        return noise
    return torch.empty_like(noise).scatter_(0, splats.segments.order(count).long(), noise)


def levels_at(anchors: Anchors, seed: int, iteration: int) -> Anchors:
    """The anchors as this iteration (from 0) draws them: in a share of the steps without levels. Photographs from high
    above then train fine anchors too, without which these overfit the few photographs from near."""
    if anchors.max_pixels is None or np.random.default_rng((seed, 1, iteration)).random() >= ALL_LEVELS_SHARE:
        return anchors
    return anchors.with_all_levels()


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingTarget:
    """A photograph or a part of it."""

    image: UInt8[Tensor, "h w 3"]
    #: 1 where a pixel counts; None: everywhere.
    mask: UInt8[Tensor, "h w"] | None
    camera: Camera
    #: How many pixels of the whole photograph count.
    counted_pixels: int
    #: The share of the photograph's pixels that count in this part. Gradients are multiplied by it: those of a mean
    #: over the part become those of a mean over the whole picture, in which thresholds of growth are given (but for
    #: SSIM within its window of the part's border, where it sees nothing beyond).
    valid_fraction: float = 1.0


def crop_box(stage: TrainingProblem, view: int, downscale: int, iteration: int) -> PixelBox:
    """The part of a view that iteration (from 0) is to draw."""
    camera = stage.images.camera(view, downscale)
    return crop_at(stage.crops, view, iteration).pixels(camera.width, camera.height)


def make_target(stage: TrainingProblem, view: int, downscale: int, box: PixelBox) -> TrainingTarget:
    """A part of a view's photograph, on the stage's device."""
    image, mask = stage.images.get(view, downscale)
    whole, (left, top, right, bottom) = stage.images.camera(view, downscale), box
    camera, inside = crop_camera(whole, box), (slice(top, bottom), slice(left, right))
    # Counted and cut where the photograph is, before it is brought to the device.
    of_whole = count_valid_pixels(mask, whole)
    mask = None if mask is None else mask[inside]
    share = 1.0 if camera is whole else count_valid_pixels(mask, camera) / max(of_whole, 1)
    return TrainingTarget(
        image=stage.copies.part(image, inside, stage.device),
        mask=None if mask is None else upload(mask, stage.device),
        camera=camera,
        counted_pixels=of_whole,
        valid_fraction=share,
    )


def crop_camera(whole: Camera, box: PixelBox) -> Camera:
    """The camera of a part of a picture; itself for all of it."""
    return whole if box == (0, 0, whole.width, whole.height) else whole.cropped(*box)


def count_valid_pixels(mask: UInt8[Tensor, "h w"] | None, camera: Camera) -> int:
    """How many pixels of a picture count."""
    return camera.width * camera.height if mask is None else int(mask.count_nonzero())
