"""What Momentum-GS adds to the loss of a block: consistency with a teacher, and more weight where a block lags.

Source: Fan, Liu, Wang, Zhou and Lu, "Momentum-GS: Momentum Gaussian Self-Distillation for High-Quality Large Scene
Reconstruction", 2024; "program": the authors' published program says what the paper leaves open.

Dimensions: v anchors in a view, k offsets of each.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.model.anchors import Anchors
from vdgs.model.decode_world import DecodedGaussians, decode_world
from vdgs.model.decoder import Decoder
from vdgs.training.training_loop import LOSS_DECAY, exponential_mean

#: SSIM counts ten times as much as PSNR in the lag of a block (program).
SSIM_FACTOR = 10.0


@dataclass(frozen=True, kw_only=True)
class MomentumConfig:
    """Momentum-GS (Fan et al. 2024)."""

    momentum: float = 0.9
    """m: the teacher becomes m teacher + (1 - m) student before every step (section 3.2)."""
    consistency: float = 50.0
    """Weight of the consistency loss (program)."""
    weigh_blocks: bool = True
    """Whether blocks that lag behind the best one weigh more (section 3.3)."""
    sigma: float = 10.0
    """sigma of the weights of blocks (program)."""
    interval: int = 500
    """Steps of a block before the next one has its turn, where one machine trains several (program)."""


class MomentumTeacher:
    """The moving mean of the decoder that all blocks share."""

    def __init__(self, student: Decoder, config: MomentumConfig) -> None:
        self.decoder, self._config = student.copy(), config

    @torch.no_grad()
    def follow(self, student: Decoder) -> None:
        """One step towards the student."""
        m = self._config.momentum
        for name, tensor in self.decoder.tensors().items():
            tensor.mul_(m).add_(student.tensors()[name].detach(), alpha=1 - m)

    def gradients(
        self, anchors: Anchors, rows: Tensor, student: Decoder, camera: Camera, weight: float
    ) -> Mapping[str, Tensor]:
        """`weight` times the gradient of the consistency loss by the student's tensors that train; none without such
        tensors or anchors."""
        trained = {name: t for name, t in student.tensors().items() if t.requires_grad and name.split("_")[0] in _HEADS}
        factor = weight * self._config.consistency
        if not (trained and factor and len(rows)):
            return {}
        with torch.no_grad():
            target = decode_world(anchors, rows, self.decoder.weights, camera)
        loss = factor * consistency_loss(decode_world(anchors, rows, student.weights, camera), target)
        return dict(zip(trained, torch.autograd.grad(loss, list(trained.values())), strict=True))


#: The heads, as the names of their tensors begin.
_HEADS = ("opacity", "covariance", "color")


def consistency_loss(student: DecodedGaussians, teacher: DecodedGaussians) -> Tensor:
    """Mean squared differences of opacity (of all Gaussians), color, rotation and size (of those that are drawn),
    added (program). 0 where nothing is drawn."""
    mse, drawn = torch.nn.functional.mse_loss, student.opacities > 0
    loss = mse(student.opacities, teacher.opacities)
    if not bool(drawn.any()):
        return loss
    normalize = torch.nn.functional.normalize
    return (
        loss
        + mse(student.colors[drawn], teacher.colors[drawn])
        + mse(normalize(student.quaternions[drawn], dim=-1), normalize(teacher.quaternions[drawn], dim=-1))
        + mse(student.scales[drawn], teacher.scales[drawn])
    )


class BlockWeights:
    """How much the loss of each block counts: w = 2 - exp(-((P - p)² + (10 S - 10 s)²) / (2 sigma²)) for a block of
    PSNR p and SSIM s, where P and S are the largest of all blocks. From 1 for the best to 2."""

    def __init__(self, count: int, config: MomentumConfig) -> None:
        self._config = config
        #: Of training views, smoothed; NaN before the first.
        self.psnr, self.ssim = [math.nan] * count, [math.nan] * count

    def update(self, index: int, psnr: float, ssim: float) -> None:
        """After a step of a block: its PSNR, which is smoothed already, and the SSIM of the view."""
        self.psnr[index], self.ssim[index] = psnr, exponential_mean(self.ssim[index], ssim, LOSS_DECAY)

    def weight(self, index: int) -> float:
        """1 until every block has been measured."""
        values = [*self.psnr, *self.ssim]
        if not self._config.weigh_blocks or any(math.isnan(value) for value in values):
            return 1.0
        behind = max(self.psnr) - self.psnr[index], SSIM_FACTOR * (max(self.ssim) - self.ssim[index])
        return 2.0 - math.exp(-(behind[0] ** 2 + behind[1] ** 2) / (2 * self._config.sigma**2))


@dataclass(frozen=True)
class BlockGuidance:
    """`LossGuidance` of one block."""

    index: int
    teacher: MomentumTeacher
    weights: BlockWeights

    def weight(self) -> float:
        return self.weights.weight(self.index)

    def decoder_gradients(
        self, anchors: Anchors, rows: Tensor, decoder: Decoder, camera: Camera
    ) -> Mapping[str, Tensor]:
        return self.teacher.gradients(anchors, rows, decoder, camera, self.weight())
