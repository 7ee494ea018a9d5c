"""How the merged Gaussians of a level-of-detail tree are drawn: as their members would be, without aliasing."""

from __future__ import annotations

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import MergedGaussians, Splats
from vdgs.model.gaussians import NodeGaussians


def merged_splats(gaussians: NodeGaussians, camera: Camera) -> Splats:
    """The splats of merged Gaussians in a view (`kernels.torch_ref.merged_splats`)."""
    columns = (getattr(gaussians, name) for name in MergedGaussians._fields)
    return get_backend(gaussians.means.device).merged_splats(MergedGaussians(*columns), camera)
