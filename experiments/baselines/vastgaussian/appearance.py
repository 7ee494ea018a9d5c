"""Decoupled appearance modelling of VastGaussian (its section 4.2): a small network maps what is rendered to the
appearance of each photograph while a block trains, and is thrown away afterwards.

The rendered picture is shrunk 32 times, an embedding of the photograph is added to every pixel as 64 channels, a
convolution makes 256 channels of them, four blocks of pixel shuffle, convolution and ReLU double the size and halve the
channels, and after resizing to the picture two convolutions give a map by which the picture is multiplied. L1 compares
the product with the photograph, SSIM the picture itself: its structure must be right without the map.

The paper leaves open what follows the last convolution and how the network begins: here 2 sigmoid(x), and zeros in the
last convolution, so that the map is 1 at first and training begins as that of 3DGS (choice).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState, PhotometricLoss

#: By how much the picture is shrunk, and channels of an embedding.
SHRINK, EMBEDDING_SIZE = 32, 64
#: Channels of the first convolution and after each of the blocks that double the size.
FIRST_CHANNELS, BLOCK_CHANNELS = 256, (128, 64, 32, 16)
#: Of embeddings and network (section 5).
LEARNING_RATE = 1e-3


def initial_appearance(views: int, seed: int) -> dict[str, Tensor]:
    """Embeddings and network before the first step, with their moments: what `Gs3dState.extra` holds."""
    generator = torch.Generator().manual_seed(seed)
    shapes = [(FIRST_CHANNELS, 3 + EMBEDDING_SIZE)]
    for channels in BLOCK_CHANNELS:
        shapes.append((channels, shapes[-1][0] // 4))  # four pixels share the channels of one
    shapes += [(BLOCK_CHANNELS[-1], BLOCK_CHANNELS[-1]), (3, BLOCK_CHANNELS[-1])]
    tensors = {"embedding": torch.zeros(views, EMBEDDING_SIZE)}
    for index, (outputs, inputs) in enumerate(shapes):
        bound = 0.0 if index == len(shapes) - 1 else (9 * inputs) ** -0.5
        for name, shape in (("w", (outputs, inputs, 3, 3)), ("b", (outputs,))):
            tensors[f"{name}{index}"] = (2 * torch.rand(shape, generator=generator) - 1) * bound
    zeros = {f"{moment}.{name}": torch.zeros_like(t) for moment in ("first", "second") for name, t in tensors.items()}
    return {f"weight.{name}": tensor for name, tensor in tensors.items()} | zeros


@dataclass(frozen=True)
class AppearanceLoss:
    """(1 - lambda) L1(map * picture) + lambda (1 - SSIM(picture)): `ImageLoss` of a block."""

    ssim_weight: float
    rate: float = LEARNING_RATE

    def __call__(
        self, image: Tensor, target: Tensor, mask: Tensor | None, view: int, extra: Mapping[str, Tensor]
    ) -> PhotometricLoss:
        kernels = get_backend(image.device)
        adapted = (image * appearance_map(image, view, extra)).contiguous()
        color = kernels.photometric_loss(adapted, target, mask, ssim_weight=0.0)
        structure = kernels.photometric_loss(image, target, mask, ssim_weight=1.0)
        loss = (1 - self.ssim_weight) * color.loss + self.ssim_weight * structure.loss
        return PhotometricLoss(loss, color.l1, structure.ssim)

    def trained(self, extra: Mapping[str, Tensor]) -> list[Tensor]:
        return [tensor for name, tensor in extra.items() if name.startswith("weight.")]

    def move(self, extra: Mapping[str, Tensor], gradients: Sequence[Tensor], step: int) -> None:
        names = [name.removeprefix("weight.") for name in extra if name.startswith("weight.")]
        for name, gradient in zip(names, gradients, strict=True):
            state = AdamState(
                extra[f"weight.{name}"].detach(), extra[f"first.{name}"], extra[f"second.{name}"], self.rate
            )
            get_backend(gradient.device).adam_rows(state, None, gradient, step)


def appearance_map(image: Float[Tensor, "h w 3"], view: int, extra: Mapping[str, Tensor]) -> Float[Tensor, "h w 3"]:
    """What the picture is multiplied by to look like the photograph of a training view."""
    picture, size = image.permute(2, 0, 1)[None], tuple(image.shape[:2])
    small = functional.interpolate(
        picture, tuple(max(1, side // SHRINK) for side in size), mode="bilinear", align_corners=False
    )
    embedding = extra["weight.embedding"][view][None, :, None, None].expand(-1, -1, *small.shape[2:])
    x = functional.relu(_convolved(torch.cat([small, embedding], 1), extra, 0))
    for index in range(1, 1 + len(BLOCK_CHANNELS)):
        x = functional.relu(_convolved(functional.pixel_shuffle(x, 2), extra, index))
    x = functional.interpolate(x, size, mode="bilinear", align_corners=False)
    x = functional.relu(_convolved(x, extra, len(BLOCK_CHANNELS) + 1))
    return 2 * _convolved(x, extra, len(BLOCK_CHANNELS) + 2)[0].permute(1, 2, 0).sigmoid()


def _convolved(x: Tensor, extra: Mapping[str, Tensor], index: int) -> Tensor:
    return functional.conv2d(x, extra[f"weight.w{index}"], extra[f"weight.b{index}"], padding=1)
