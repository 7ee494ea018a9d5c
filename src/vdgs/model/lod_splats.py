"""How the merged Gaussians of a level-of-detail tree are drawn: as their members would be, without aliasing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import MergedGaussians, Splats
from vdgs.model.gaussians import NodeGaussians


class FadedNode(NamedTuple):
    """The merged Gaussians of a node, and what their opacities are multiplied with; None: nothing."""

    gaussians: NodeGaussians
    factors: Float[Tensor, " n"] | None = None

    def to(self, device: torch.device) -> FadedNode:
        """The same node on a device; the same tensors where they are on it."""
        return FadedNode(self.gaussians.to(device), None if self.factors is None else self.factors.to(device))

    def part(self) -> MergedGaussians:
        """What the kernels draw."""
        columns = {name: getattr(self.gaussians, name) for name in MergedGaussians._fields[:-1]}
        return MergedGaussians(**columns, opacity_factors=self.factors)


def merged_splats(nodes: Sequence[FadedNode], camera: Camera, before: Splats | None = None) -> Splats:
    """The splats of the merged Gaussians of some nodes, at least one, in a view, node after node, behind those that
    come `before` (`kernels.torch_ref.merged_splats`)."""
    kernels = get_backend(nodes[0].gaussians.means.device)
    return kernels.merged_splats([node.part() for node in nodes], camera, before)
