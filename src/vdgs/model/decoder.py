"""The decoder of all anchors, or of those of a block: three small MLPs (Scaffold-GS eqs. 5-8), and appearance.

Each head has one hidden layer of 32 with ReLU. Inputs: the anchor's feature [32], the unit direction from the
camera to the anchor [3] and, on request, their distance. An appearance embedding enters the color head only;
because it is the same for all anchors of a view, it amounts to a shift of the head's first bias.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.kernel_types import FEATURE_SIZE, HIDDEN_SIZE, DecoderWeights, MlpWeights
from vdgs.model.envmap import check_envmap
from vdgs.model.exposure import exposure_matrix

HEADS = {"opacity": 1, "covariance": 7, "color": 3}  # outputs per offset
HEAD_TENSORS = ("w1", "b1", "w2", "b2")
#: The name of the departures of exposures among the tensors, and that of files from before 2026-11-27, in which neutral
#: is their mean.
EXPOSURE, OLD_EXPOSURE = "exposure_departures", "exposure"


@dataclass(frozen=True)
class Decoder:
    """The parameters of the three heads and, optionally, appearance and exposure of images and an environment map."""

    weights: DecoderWeights
    #: One row per training image, and its map to the color head's hidden layer; None without appearance.
    appearance_embedding: Float[Tensor, "images a"] | None = None
    appearance_weight: Float[Tensor, "32 a"] | None = None
    #: Departures of each training image's colors from neutral (`model.exposure`); None: no exposure is fitted.
    exposure: Float[Tensor, "images 3 4"] | None = None
    #: What is drawn behind all anchors (`model.envmap`); None: a plain color.
    envmap: Float[Tensor, "rows columns 3"] | None = None

    @staticmethod
    def init_random(
        num_offsets: int, view_distance: bool, appearance_dim: int, num_images: int, generator: torch.Generator
    ) -> Decoder:
        """Uniform in +-1/sqrt(inputs), as torch.nn.Linear; embeddings start at 0."""
        inputs = FEATURE_SIZE + 3 + int(view_distance)
        tensors: dict[str, Tensor] = {}
        for head, per_offset in HEADS.items():
            for layer, rows, columns in ((1, HIDDEN_SIZE, inputs), (2, num_offsets * per_offset, HIDDEN_SIZE)):
                bound = columns**-0.5
                tensors[f"{head}_w{layer}"] = _uniform((rows, columns), bound, generator)
                tensors[f"{head}_b{layer}"] = _uniform((rows,), bound, generator)
        if appearance_dim:
            tensors["appearance"] = torch.zeros(num_images, appearance_dim, dtype=torch.float32, device="cpu")
            tensors["appearance_weight"] = _uniform((HIDDEN_SIZE, appearance_dim), appearance_dim**-0.5, generator)
        return Decoder.from_tensors(tensors)

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> Decoder:
        """The inverse of `tensors`. Raises KeyError on a missing tensor."""
        weights = DecoderWeights(*(MlpWeights(*(tensors[f"{head}_{part}"] for part in HEAD_TENSORS)) for head in HEADS))
        if (around_mean := tensors.get(OLD_EXPOSURE)) is not None:
            tensors = {**tensors, EXPOSURE: around_mean - around_mean.mean(0)}
        optional = (tensors.get(name) for name in ("appearance", "appearance_weight", EXPOSURE, "envmap"))
        return Decoder(weights, *optional)

    def tensors(self) -> dict[str, Tensor]:
        named = {f"{head}_{p}": getattr(getattr(self.weights, head), p) for head in HEADS for p in HEAD_TENSORS}
        if self.appearance_embedding is not None and self.appearance_weight is not None:
            named |= {"appearance": self.appearance_embedding, "appearance_weight": self.appearance_weight}
        if self.exposure is not None:
            named[EXPOSURE] = self.exposure
        if self.envmap is not None:
            named["envmap"] = self.envmap
        return named

    def to(self, device: torch.device) -> Decoder:
        """The same numbers on a device; the same tensors where they are on it."""
        return Decoder.from_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    def copy(self) -> Decoder:
        """The same numbers in tensors of their own."""
        return Decoder.from_tensors({name: tensor.detach().clone() for name, tensor in self.tensors().items()})

    def weights_for_image(self, image: int | None) -> DecoderWeights:
        """The weights as one view sees them: with the embedding of training image `image`, or with the mean
        embedding for a view that was not trained on (choice)."""
        if self.appearance_embedding is None or self.appearance_weight is None:
            return self.weights
        embedding = self.appearance_embedding.mean(0) if image is None else self.appearance_embedding[image]
        color = self.weights.color
        return replace(self.weights, color=replace(color, b1=color.b1 + self.appearance_weight @ embedding))

    def exposure_for_image(self, image: int) -> Float[Tensor, "3 4"] | None:
        """The color model of a training image; None where none is fitted."""
        return None if self.exposure is None else exposure_matrix(self.exposure, image)

    def check(self, offsets: int) -> None:
        """Raise ValueError unless all shapes fit `offsets` Gaussians per anchor and all numbers are finite."""
        inputs = self.weights.opacity.w1.shape[-1]
        if inputs not in (FEATURE_SIZE + 3, FEATURE_SIZE + 4):
            raise ValueError(f"the decoder takes {inputs} inputs, not 35 or 36")
        for head, per_offset in HEADS.items():
            outputs = offsets * per_offset
            shapes = ((HIDDEN_SIZE, inputs), (HIDDEN_SIZE,), (outputs, HIDDEN_SIZE), (outputs,))
            for part, expected in zip(HEAD_TENSORS, shapes, strict=True):
                shape = tuple(getattr(getattr(self.weights, head), part).shape)
                if shape != expected:
                    raise ValueError(f"decoder {head}_{part} has shape {shape}, not {expected}")
        if self.envmap is not None:
            check_envmap(self.envmap)
        for name, tensor in self.tensors().items():
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"decoder {name} holds numbers that are not finite")


def _uniform(shape: tuple[int, ...], bound: float, generator: torch.Generator) -> Tensor:
    return torch.empty(shape, dtype=torch.float32, device="cpu").uniform_(-bound, bound, generator=generator)
