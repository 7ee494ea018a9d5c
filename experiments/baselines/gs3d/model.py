"""The scene of 3DGS: explicit Gaussians, each with its own shape, opacity and spherical harmonics.

Dimensions: n Gaussians of the model, r = (degree + 1)² - 1 further coefficients of color. Float32, ground frame.
Source: Kerbl, Kopanas, Leimkühler and Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
2023 (3DGS below); its equations 5 and 6 are in `kernels.project`, 2 and 3 in `kernels.rasterize`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, num_sh_bases, rgb_to_sh
from vdgs.model.gaussians import Gaussians, project_splats, render_gaussians, visible_gaussian_rows
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, tensors_crc32, write_tensors

FILE_FORMAT = "vdgs-gaussians-1"
#: The smallest first size, as a share of the median one: coincident points would have none.
MIN_SPACING = 1e-3


def initialize_gaussians(
    points: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"], opacity: float, degree: int
) -> Gaussians:
    """A round Gaussian at each sparse point, as wide as its mean distance to the three nearest others (3DGS section
    5.1), in its color. Raises VdgsError with fewer than two points."""
    n = len(points)
    if n < 2:
        raise VdgsError(f"The capture has {n} sparse point(s); at least 2 are needed. Run the reconstruction again.")
    distances, _ = cKDTree(points).query(points, k=min(4, n), workers=1)
    spacing = distances[:, 1:].mean(axis=1)
    least = MIN_SPACING * float(np.median(spacing)) or MIN_SPACING
    log_scales = torch.from_numpy(np.log(np.maximum(spacing, least)).astype(np.float32))
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        log_scales=log_scales[:, None].repeat(1, 3),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh0=rgb_to_sh(torch.from_numpy(colors.astype(np.float32) / 255.0)),
        shN=torch.zeros(n, num_sh_bases(degree) - 1, 3),
    )


@dataclass(frozen=True)
class GaussianModel:
    """A trained scene of explicit Gaussians."""

    gaussians: Gaussians
    #: Color drawn where nothing is, RGB in [0, 1].
    background: tuple[float, float, float]
    #: JSON values that travel with the file: ground frame, capture, version.
    metadata: Mapping[str, Any]

    def to(self, device: str) -> GaussianModel:
        """The same model on a device."""
        return replace(self, gaussians=self.gaussians.to(device))

    @torch.no_grad()
    def render(self, camera: Camera, *, depth: bool = False) -> Raster:
        """One view: image [h, w, 3] (not clamped), alpha [h, w], depth [h, w] or None."""
        seen = self.gaussians.select(visible_gaussian_rows(self.gaussians, camera))
        behind = seen.means.new_tensor(self.background)
        return render_gaussians(seen, camera, behind, seen.sh_degree, depth)[0]

    def splats(self, camera: Camera) -> Splats:
        """What a view is drawn from."""
        seen = self.gaussians.select(visible_gaussian_rows(self.gaussians, camera))
        return project_splats(seen, camera, seen.sh_degree)

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically."""
        tensors = self.gaussians.tensors()
        values = {"background": self.background, "metadata": dict(self.metadata), "crc32": tensors_crc32(tensors)}
        header = {FILE_FORMAT: json.dumps(values)}
        write_atomic(path, lambda temporary: write_tensors(temporary, tensors, header))

    @staticmethod
    def load(path: Path) -> GaussianModel:
        """Read a model. Raises VdgsError if the file is missing, damaged or not a model of Gaussians."""
        tensors, header = read_tensors(path)
        if FILE_FORMAT not in header:
            raise VdgsError(f"{path}: is not a vdgs model of explicit Gaussians (its header has no {FILE_FORMAT!r})")
        try:
            values = json.loads(header[FILE_FORMAT])
            if values["crc32"] != tensors_crc32(tensors):
                raise ValueError("its checksum does not agree")
            gaussians = Gaussians(**tensors)
            _check(gaussians)
            red, green, blue = (float(value) for value in values["background"])
            return GaussianModel(gaussians, (red, green, blue), values["metadata"])
        except (KeyError, ValueError, TypeError) as error:
            raise VdgsError(
                f"{path}: is damaged or incomplete ({error}). Delete it and train again: it is rebuilt from the last "
                "checkpoint."
            ) from error


def _check(gaussians: Gaussians) -> None:
    """Raise ValueError unless shapes and types agree with each other and all numbers are finite."""
    n = len(gaussians)
    counts = [num_sh_bases(degree) - 1 for degree in range(MAX_SH_DEGREE + 1)]
    rest = gaussians.shN.shape[1] if gaussians.shN.ndim == 3 else -1
    if rest not in counts:
        raise ValueError(f"{rest} further coefficients of color belong to no degree")
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "opacity_logits": (n,), "sh0": (n, 3),
              "shN": (n, rest, 3)}  # fmt: skip
    for name, tensor in gaussians.tensors().items():
        if tuple(tensor.shape) != shapes[name] or tensor.dtype != torch.float32:
            raise ValueError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, not float32 {shapes[name]}")
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} holds numbers that are not finite")
