"""The scene of 3DGS: explicit Gaussians, each with its own shape, opacity and spherical harmonics.

Dimensions: n Gaussians of the model, r = (degree + 1)² - 1 further coefficients of colour. Float32, ground frame.
Source: Kerbl, Kopanas, Leimkühler and Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
2023 (3DGS below); its equations 5 and 6 are in `kernels.project`, 2 and 3 in `kernels.rasterise`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.comparators.gaussians.spherical_harmonics import MAX_DEGREE, dc_of_colours, function_count, view_colours
from vdgs.errors import VdgsError
from vdgs.kernels import choose
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.types import Raster, Splats
from vdgs.storage.files import write_atomically
from vdgs.storage.tensors import checksum, read_tensors, write_tensors

FORMAT = "vdgs-gaussians-1"
#: Beyond so many standard deviations not even an opaque Gaussian reaches the least alpha that is drawn.
REACH = math.sqrt(-2 * math.log(ALPHA_MIN))
#: The smallest first size, as a share of the median one: coincident points would have none.
LEAST_SPACING = 1e-3


@dataclass(frozen=True)
class Gaussians:
    """What training moves of each Gaussian. Tensors share their first dimension."""

    means: Float[Tensor, "n 3"]
    #: Logarithms of the standard deviations along the Gaussian's own axes.
    log_scales: Float[Tensor, "n 3"]
    #: Rotations, wxyz, of any length but zero.
    quaternions: Float[Tensor, "n 4"]
    #: Opacities before the sigmoid.
    logits: Float[Tensor, " n"]
    #: Spherical harmonics: coefficients of the constant function, and of the others.
    dc: Float[Tensor, "n 3"]
    rest: Float[Tensor, "n r 3"]

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def select(self, rows: Tensor) -> Gaussians:
        """The Gaussians of the given rows (indices or mask)."""
        return Gaussians(**{name: tensor[rows] for name, tensor in self.tensors().items()})

    def extended(self, more: Gaussians) -> Gaussians:
        """These Gaussians followed by others."""
        return Gaussians(**{name: torch.cat([t, more.tensors()[name]]) for name, t in self.tensors().items()})

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics that there is room for."""
        return math.isqrt(self.rest.shape[1] + 1) - 1


def initial_gaussians(
    points: Float[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"], opacity: float, degree: int
) -> Gaussians:
    """A round Gaussian at each sparse point, as wide as its mean distance to the three nearest others (3DGS section
    5.1), in its colour. Raises VdgsError with fewer than two points."""
    n = len(points)
    if n < 2:
        raise VdgsError(f"The capture has {n} sparse point(s); at least 2 are needed. Run the reconstruction again.")
    distances, _ = cKDTree(points).query(points, k=min(4, n), workers=1)
    spacing = distances[:, 1:].mean(axis=1)
    least = LEAST_SPACING * float(np.median(spacing)) or LEAST_SPACING
    log_scales = torch.from_numpy(np.log(np.maximum(spacing, least)).astype(np.float32))
    return Gaussians(
        means=torch.from_numpy(points.astype(np.float32)),
        log_scales=log_scales[:, None].repeat(1, 3),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        dc=dc_of_colours(torch.from_numpy(colours.astype(np.float32) / 255.0)),
        rest=torch.zeros(n, function_count(degree) - 1, 3),
    )


@torch.no_grad()
def visible_rows(gaussians: Gaussians, camera: Camera) -> Int64[Tensor, " v"]:
    """Rows of the Gaussians in front of the camera whose extent touches the image, ascending."""
    kernels = choose(gaussians.means.device)
    seen = kernels.project(gaussians.means, gaussians.log_scales.exp(), gaussians.quaternions, camera)
    a, b, c = seen.conics.unbind(-1)
    # The inverse of the conic [[a, b], [b, c]] is the covariance, its diagonal the variances along x and y.
    variances = torch.stack([c, a], -1) / (a * c - b * b)[:, None]
    reach = REACH * variances.sqrt()
    low, high = seen.means_px + reach, seen.means_px - reach
    inside = (low > 0).all(-1) & (high[:, 0] < camera.width) & (high[:, 1] < camera.height)
    # A needle whose determinant is lost to rounding has no extent that could be compared: it is drawn.
    return (seen.valid & (inside | ~torch.isfinite(reach).all(-1))).nonzero()[:, 0]


def draw_gaussians(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, "3"], degree: int, depth: bool = False
) -> tuple[Raster, Float[Tensor, "n 2"]]:
    """The picture, and the centres in pixels that it was drawn from (growth asks for their gradient).

    Differentiable in all tensors of `gaussians`.
    """
    kernels = choose(gaussians.means.device)
    projected = kernels.project(gaussians.means, gaussians.log_scales.exp(), gaussians.quaternions, camera)
    if camera.model == "pinhole":
        centre = torch.from_numpy(camera.position.astype(np.float32)).to(gaussians.means)
        directions = torch.nn.functional.normalize(gaussians.means - centre, dim=-1)
    else:
        directions = torch.from_numpy(camera.forward.astype(np.float32)).to(gaussians.means).expand(len(gaussians), 3)
    splats = Splats(
        projected.means_px, projected.conics, projected.depths,
        view_colours(gaussians.dc, gaussians.rest, directions, degree),
        torch.where(projected.valid, gaussians.logits.sigmoid(), 0.0),
    )  # fmt: skip
    raster = kernels.rasterise(splats, background, camera.width, camera.height, depth=depth)
    return raster, projected.means_px


@dataclass(frozen=True)
class GaussiansModel:
    """A trained scene of explicit Gaussians."""

    gaussians: Gaussians
    #: Colour drawn where nothing is, RGB in [0, 1].
    background: tuple[float, float, float]
    #: JSON-able facts that travel with the file: ground frame, capture, version.
    facts: Mapping[str, Any]

    @torch.no_grad()
    def render(self, camera: Camera, *, depth: bool = False) -> Raster:
        """One view: image [h, w, 3] (not clamped), alpha [h, w], depth [h, w] or None."""
        seen = self.gaussians.select(visible_rows(self.gaussians, camera))
        return draw_gaussians(seen, camera, torch.tensor(self.background), seen.degree, depth)[0]

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically."""
        tensors = self.gaussians.tensors()
        facts = {"background": self.background, "facts": dict(self.facts), "crc32": checksum(tensors)}
        header = {FORMAT: json.dumps(facts)}
        write_atomically(path, lambda temporary: write_tensors(temporary, tensors, header))

    @staticmethod
    def load(path: Path) -> GaussiansModel:
        """Read a model. Raises VdgsError if the file is missing, damaged or not a model of Gaussians."""
        tensors, header = read_tensors(path)
        if FORMAT not in header:
            raise VdgsError(f"{path}: is not a vdgs model of explicit Gaussians (its header has no {FORMAT!r})")
        try:
            known = json.loads(header[FORMAT])
            if known["crc32"] != checksum(tensors):
                raise ValueError("its checksum does not agree")
            gaussians = Gaussians(**tensors)
            _check(gaussians)
            red, green, blue = (float(value) for value in known["background"])
            return GaussiansModel(gaussians, (red, green, blue), known["facts"])
        except (KeyError, ValueError, TypeError) as error:
            raise VdgsError(
                f"{path}: is damaged or incomplete ({error}). Delete it and train again: it is rebuilt from the last "
                "checkpoint."
            ) from error


def _check(gaussians: Gaussians) -> None:
    """Raise ValueError unless shapes and types agree with each other and all numbers are finite."""
    n = len(gaussians)
    counts = [function_count(degree) - 1 for degree in range(MAX_DEGREE + 1)]
    rest = gaussians.rest.shape[1] if gaussians.rest.ndim == 3 else -1
    if rest not in counts:
        raise ValueError(f"{rest} further coefficients of colour belong to no degree")
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quaternions": (n, 4), "logits": (n,), "dc": (n, 3),
              "rest": (n, rest, 3)}  # fmt: skip
    for name, tensor in gaussians.tensors().items():
        if tuple(tensor.shape) != shapes[name] or tensor.dtype != torch.float32:
            raise ValueError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, not float32 {shapes[name]}")
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} holds numbers that are not finite")
