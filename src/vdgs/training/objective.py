"""What a step minimises of its picture: how far it is from its photograph."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.kernels import get_backend
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import apply_exposure
from vdgs.training.target import TrainingTarget
from vdgs.training.training_step import RenderedTrainingView


@dataclass(frozen=True, eq=False, kw_only=True)
class LossGradients:
    """The loss of a picture without the volume term, and its gradient by the picture."""

    loss: Float[Tensor, ""]
    l1: Float[Tensor, ""]
    ssim: Float[Tensor, ""]
    #: The picture as the photograph would have it: with its exposure, where there is a model of that.
    shown: Float[Tensor, "h w 3"]
    #: The gradient.
    image: Float[Tensor, "h w 3"]


def compute_loss(
    rendered: RenderedTrainingView, target: TrainingTarget, decoder: Decoder, image_index: int, config: TrainConfig
) -> LossGradients:
    """Compare a picture with its photograph, which is the training image `number` of the capture.

    The gradient of the photograph's exposure, where one is fitted, is left in the decoder's `.grad`. All gradients are
    those of the whole photograph (`Target.share`).
    """
    image = rendered.image.requires_grad_(True)
    exposure = decoder.exposure_for_image(image_index)
    shown = image if exposure is None else apply_exposure(image, exposure)
    kernels = get_backend(image.device)
    photometric = kernels.photometric_loss(shown, target.image, target.mask, ssim_weight=config.loss.ssim_lambda)
    loss = photometric.loss.detach()
    fitted = [decoder.exposure] if decoder.exposure is not None and decoder.exposure.requires_grad else []
    found = torch.autograd.grad(photometric.loss, [image, *fitted])
    for tensor, gradient in zip(fitted, found[1:], strict=True):
        tensor.grad = gradient
    if target.valid_fraction != 1.0:
        for each in found:
            each.mul_(target.valid_fraction)
    return LossGradients(loss=loss, l1=photometric.l1, ssim=photometric.ssim, shown=shown.detach(), image=found[0])
