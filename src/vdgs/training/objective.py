"""What a step minimises of its picture: how far it is from its photograph, and what is asked of alpha and depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels import choose
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import exposed
from vdgs.settings.method import TrainConfig
from vdgs.training.depths import roughness
from vdgs.training.step import TrainingView
from vdgs.training.target import Target


@dataclass(frozen=True, eq=False)
class Objective:
    """The loss of a picture without the volume term, and its gradients by the picture."""

    loss: Float[Tensor, ""]
    l1: Float[Tensor, ""]
    ssim: Float[Tensor, ""]
    #: The picture as the photograph would have it: with its exposure, where there is a model of that.
    shown: Float[Tensor, "h w 3"]
    #: Gradients; None is zero.
    image: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"] | None
    depth: Float[Tensor, "h w"] | None


def compare(drawn: TrainingView, target: Target, decoder: Decoder, number: int, config: TrainConfig) -> Objective:
    """Compare a picture with its photograph, which is the training image `number` of the capture.

    The gradient of the photograph's exposure, where one is fitted, is left in the decoder's `.grad`. All gradients are
    those of the whole photograph (`Target.share`).
    """
    image = drawn.image.requires_grad_(True)
    exposure = decoder.exposure_of(number)
    shown = image if exposure is None else exposed(image, exposure)
    kernels = choose(image.device)
    photometric = kernels.photometric_loss(shown, target.image, target.mask, ssim_weight=config.loss.ssim_weight)
    loss = photometric.loss.detach()
    alpha: Tensor | None = None
    if target.ground is not None:
        clear, alpha = target.transparency(drawn.alpha, config.loss.alpha_weight)
        loss = loss + clear
    depth = None
    if drawn.depth is not None:
        wrong, depth, of_alpha = _of_depth(drawn.depth, drawn.alpha, target, config)
        loss, alpha = loss + wrong, of_alpha if alpha is None else alpha + of_alpha
    fitted = [decoder.exposure] if decoder.exposure is not None and decoder.exposure.requires_grad else []
    found = torch.autograd.grad(photometric.loss, [image, *fitted])
    for tensor, gradient in zip(fitted, found[1:], strict=True):
        tensor.grad = gradient
    if target.share != 1.0:
        for each in (*found, alpha, depth):
            if each is not None:
                each.mul_(target.share)
    return Objective(loss, photometric.l1, photometric.ssim, shown.detach(), found[0], alpha, depth)


def _of_depth(depth: Tensor, alpha: Tensor, target: Target, config: TrainConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The terms of depth, and their gradients by depth and alpha."""
    depth, alpha = depth.detach().requires_grad_(True), alpha.detach().requires_grad_(True)
    loss = depth.new_zeros(())
    if target.depths is not None:
        loss = loss + config.seldom.depth_weight * target.depths.error(depth, alpha)
    if target.seldom is not None:
        loss = loss + config.seldom.smooth_weight * roughness(depth, alpha, target.image, target.seldom)
    if not loss.requires_grad:
        return loss, torch.zeros_like(depth), torch.zeros_like(alpha)
    of_depth, of_alpha = torch.autograd.grad(loss, [depth, alpha])
    return loss.detach(), of_depth, of_alpha
