"""What each anchor holds: place, feature, offsets, scales (Scaffold-GS section 3.2).

Dimensions: n anchors, k offsets per anchor, 32 features. Positions are float32 in the ground frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

#: The tensors of an anchor that training moves, in the order in which they are saved.
TRAINED_TENSORS = ("features", "offsets", "log_scales")


@dataclass(frozen=True)
class Anchors:
    """What each anchor holds. All tensors are float32 and share their first dimension."""

    positions: Float[Tensor, "n 3"]
    features: Float[Tensor, "n 32"]
    offsets: Float[Tensor, "n k 3"]
    log_scales: Float[Tensor, "n 6"]
    #: The largest pixel, in units of the ground frame, in which each anchor is drawn (`model.levels`); None: in any.
    max_pixels: Float[Tensor, " n"] | None = None
    #: What the opacities of the k Gaussians are multiplied with where a scene fades out at its edge (`fade_factors`);
    #: None: nothing. In memory only: no model has it in its file.
    opacity_factors: Float[Tensor, "n k"] | None = None

    def __len__(self) -> int:
        return self.positions.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        optional = {name: getattr(self, name) for name in ("max_pixels", "opacity_factors")}
        return {name: getattr(self, name) for name in ("positions", *TRAINED_TENSORS)} | {
            name: tensor for name, tensor in optional.items() if tensor is not None
        }

    def with_all_levels(self) -> Anchors:
        """The anchors of which every view draws all levels; themselves where they have none."""
        return self if self.max_pixels is None else replace(self, max_pixels=None)

    def to(self, device: torch.device) -> Anchors:
        """The same anchors on a device; themselves where they are on it."""
        return Anchors(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def select(self, rows: Tensor) -> Anchors:
        """The anchors of the given rows (indices or mask)."""
        return Anchors(**{name: tensor[rows] for name, tensor in self.tensors().items()})

    def concat(self, more: Anchors) -> Anchors:
        """These anchors followed by others."""
        return Anchors(**{name: torch.cat([a, more.tensors()[name]]) for name, a in self.tensors().items()})
