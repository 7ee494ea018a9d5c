"""Files of Gaussians read by another program than ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from vdgs.export.formats import registry
from vdgs.model.gaussians import Gaussians


def independent(path: Path) -> Gaussians:
    """Read by gaussforge, whose SPZ is Niantic's own code, in the coordinates of the file."""
    gaussforge = pytest.importorskip("gaussforge")
    answer = gaussforge.GaussForge().read(path.read_bytes(), path.suffix[1:])
    if "error" in answer:  # it cannot hand over scenes without spherical harmonics, but converts them
        other = path.with_name("converted.ply")
        other.write_bytes(gaussforge.GaussForge().convert(path.read_bytes(), path.suffix[1:], "ply")["data"])
        return registry.read_gaussians(other)
    data, n = answer["data"], answer["data"]["numPoints"]

    def tensor(name: str, *shape: int) -> torch.Tensor:
        return torch.from_numpy(np.frombuffer(data[name], np.float32).reshape(shape).copy())

    rest = tensor("sh", n, -1, 3) if data["sh"] else torch.zeros(n, 0, 3)
    return Gaussians(
        means=tensor("positions", n, 3), log_scales=tensor("scales", n, 3), quaternions=tensor("rotations", n, 4),
        opacity_logits=tensor("alphas", n), sh0=tensor("colors", n, 3), shN=rest,
    )  # fmt: skip
