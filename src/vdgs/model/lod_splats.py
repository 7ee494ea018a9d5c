"""How the merged Gaussians of a level-of-detail tree are drawn: as their members would be, without aliasing."""

from __future__ import annotations

from collections.abc import Sequence

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import MergedGaussians, Splats
from vdgs.model.gaussians import NodeGaussians


def merged_splats(nodes: Sequence[NodeGaussians], camera: Camera) -> Splats:
    """The splats of the merged Gaussians of some nodes in a view, node after node, at least one node
    (`kernels.torch_ref.merged_splats`)."""
    parts = [MergedGaussians(*(getattr(node, name) for name in MergedGaussians._fields)) for node in nodes]
    return get_backend(nodes[0].means.device).merged_splats(parts, camera)
