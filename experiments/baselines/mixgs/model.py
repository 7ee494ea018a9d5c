"""The scene of MixGS: explicit Gaussians, and for each in view a second one, decoded by a small network from its place,
its size and rotation, and the camera's pose (its sections 3.2 and 3.3).

Dimensions: n Gaussians, v of them in view, l levels of hash tables with t entries of f features.
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
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from experiments.baselines.mixgs.settings import MixConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.spherical_harmonics import eval_sh_colors
from vdgs.model.gaussians import Gaussians, visible_gaussian_rows
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, write_tensors

FILE_FORMAT = "vdgs-mixgs-1"
#: Of the hash of a grid corner, one for each axis (Teschner et al. 2003).
PRIMES = (1, 2_654_435_761, 805_459_861)
#: Inputs of the decoder beside the features of the place: translation of the pose, scales, rotation.
POSE_INPUTS = 10
#: Outputs of each head.
HEADS = {"color": 3, "rotation": 4, "scale": 3, "opacity": 1}


@dataclass(frozen=True, kw_only=True)
class MixScene:
    """What is fixed while the network trains: the box of the hash grid, and the unit of decoded scales."""

    low: tuple[float, float, float]
    size: float
    scale_unit: float
    resolutions: tuple[float, ...]
    min_scale: float


def mix_scene(gaussians: Gaussians, config: MixConfig) -> MixScene:
    """The cube about the Gaussians, and their median size."""
    low, high = gaussians.means.min(dim=0).values, gaussians.means.max(dim=0).values
    first, last = config.resolutions
    growth = (last / first) ** (1 / max(config.num_levels - 1, 1))
    return MixScene(
        low=(float(low[0]), float(low[1]), float(low[2])), size=max(float((high - low).max()), 1e-6),
        scale_unit=float(gaussians.log_scales.exp().median()), min_scale=config.min_scale,
        resolutions=tuple(math.floor(first * growth**level) for level in range(config.num_levels)),
    )  # fmt: skip


def initial_network(num_gaussians: int, config: MixConfig) -> dict[str, Tensor]:
    """Tables with almost no features, linear layers as torch.nn.Linear, from the seed."""
    generator = torch.Generator().manual_seed(config.coarse.seed)
    entries = 2 ** min(max(math.ceil(math.log2(max(num_gaussians, 2))), 10), 22)
    tables = (torch.rand(config.num_levels * entries, config.level_size, generator=generator) * 2 - 1) * 1e-4
    width, tensors = config.width, {"table": tables}
    layers = {"place": (width, config.num_levels * config.level_size), "pose": (width, POSE_INPUTS),
              "hidden": (width, width), **{name: (outputs, width) for name, outputs in HEADS.items()}}  # fmt: skip
    for name, (rows, columns) in layers.items():
        bound = columns**-0.5
        tensors[f"{name}.w"] = (torch.rand(rows, columns, generator=generator) * 2 - 1) * bound
        tensors[f"{name}.b"] = (torch.rand(rows, generator=generator) * 2 - 1) * bound
    return tensors


def encode_places(places: Float[Tensor, "v 3"], table: Float[Tensor, "lt f"], scene: MixScene) -> Float[Tensor, "v lf"]:
    """Features of places: of each level those of the eight corners about it, interpolated (its eq. 3)."""
    resolutions = places.new_tensor(scene.resolutions)
    inside = ((places - places.new_tensor(scene.low)) / scene.size).clamp(0, 1)
    at = inside[:, None, :] * resolutions[:, None]
    base = at.floor()
    share = (at - base)[:, :, None, :]
    corners = torch.tensor([[i >> axis & 1 for axis in range(3)] for i in range(8)]).to(places.device)
    weights = torch.where(corners.bool(), share, 1 - share).prod(dim=3)
    rows = _hash_rows(base.long()[:, :, None, :] + corners, len(table) // len(resolutions))
    firsts = torch.arange(0, rows.numel(), rows.shape[2], device=rows.device)
    summed = functional.embedding_bag(
        rows.flatten(), table, firsts, per_sample_weights=weights.flatten(), mode="sum"
    )  # fmt: skip
    return summed.reshape(len(places), -1)


def _hash_rows(corners: Int64[Tensor, "v l 8 3"], entries: int) -> Int64[Tensor, "v l 8"]:
    """The row of the joint table for each corner of each level; `entries` is a power of two."""
    x, y, z = (corners[..., axis] * prime for axis, prime in enumerate(PRIMES))
    first = torch.arange(corners.shape[1], device=corners.device)[:, None] * entries
    return ((x ^ y ^ z) & (entries - 1)) + first


def decode_details(
    seen: Gaussians, offsets: Float[Tensor, "v 3"], network: Mapping[str, Tensor], scene: MixScene, camera: Camera
) -> tuple[Gaussians, Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    """A Gaussian beside each one in view, its color and its opacity. Gradients go to offsets and network alone."""

    def linear(name: str, x: Tensor) -> Tensor:
        return functional.linear(x, network[f"{name}.w"], network[f"{name}.b"])

    means, scales = seen.means.detach(), seen.log_scales.detach().exp()
    rotations = functional.normalize(seen.quaternions.detach(), dim=-1)
    pose = torch.from_numpy(camera.camera_from_world[:3, 3].astype(np.float32)).to(means) / scene.size
    about = torch.cat([pose.expand(len(means), 3), scales / scene.scale_unit, rotations], dim=1)
    place = linear("place", encode_places(means, network["table"], scene))
    hidden = linear("hidden", place * (2 * linear("pose", about).relu().sigmoid() - 1)).relu()
    decoded = replace(
        seen, means=means + offsets, quaternions=functional.normalize(rotations + linear("rotation", hidden), dim=-1),
        log_scales=(scene.scale_unit * linear("scale", hidden).clamp(min=scene.min_scale)).log(),
    )  # fmt: skip
    return decoded, linear("color", hidden).sigmoid(), linear("opacity", hidden)[:, 0].sigmoid()


def render_mixed(
    seen: Gaussians, offsets: Float[Tensor, "v 3"], network: Mapping[str, Tensor], scene: MixScene, camera: Camera,
    background: Float[Tensor, "3"], depth: bool = False,
) -> Raster:  # fmt: skip
    """Coarse and decoded Gaussians in one picture (its eq. 8); `seen` are the coarse ones in view."""
    details, colors, opacities = decode_details(seen, offsets, network, scene, camera)
    kernels = get_backend(seen.means.device)
    projected = kernels.project(
        torch.cat([details.means, seen.means]), torch.cat([details.log_scales, seen.log_scales]).exp(),
        torch.cat([details.quaternions, seen.quaternions]), camera,
    )  # fmt: skip
    center = torch.from_numpy(camera.position.astype(np.float32)).to(seen.means)
    directions = functional.normalize(seen.means - center, dim=-1)
    own = eval_sh_colors(seen.sh0, seen.shN, directions, seen.sh_degree)
    shown = torch.cat([opacities, seen.opacity_logits.sigmoid()])
    splats = Splats(
        projected.means_px, projected.conics, projected.depths, torch.cat([colors, own]),
        torch.where(projected.valid, shown, 0.0),
    )  # fmt: skip
    return kernels.rasterize(splats, background, camera.width, camera.height, depth=depth)


@dataclass(frozen=True, kw_only=True)
class MixModel:
    """A trained scene."""

    gaussians: Gaussians
    offsets: Float[Tensor, "n 3"]
    network: Mapping[str, Tensor]
    scene: MixScene
    background: tuple[float, float, float]
    metadata: Mapping[str, Any]

    def to(self, device: str) -> MixModel:
        """The same model on a device."""
        network = {name: tensor.to(device) for name, tensor in self.network.items()}
        return replace(self, gaussians=self.gaussians.to(device), offsets=self.offsets.to(device), network=network)

    @torch.no_grad()
    def render(self, camera: Camera, *, depth: bool = False) -> Raster:
        """One view: image [h, w, 3] (not clamped), alpha [h, w], depth [h, w] or None."""
        rows = visible_gaussian_rows(self.gaussians, camera)
        behind = self.offsets.new_tensor(self.background)
        return render_mixed(
            self.gaussians.select(rows), self.offsets[rows], self.network, self.scene, camera, behind, depth
        )

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically."""
        tensors = {f"gaussians.{name}": tensor for name, tensor in self.gaussians.tensors().items()}
        tensors |= {f"network.{name}": tensor.detach() for name, tensor in self.network.items()}
        tensors["offsets"] = self.offsets
        values = {"scene": vars(self.scene), "background": self.background, "metadata": dict(self.metadata)}
        write_atomic(path, lambda temporary: write_tensors(temporary, tensors, {FILE_FORMAT: json.dumps(values)}))

    @staticmethod
    def load(path: Path) -> MixModel:
        """Read a model. Raises VdgsError if the file is missing, damaged or of another kind."""
        tensors, header = read_tensors(path)

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}

        try:
            values = json.loads(header[FILE_FORMAT])
            scene: dict[str, Any] = {
                name: tuple(v) if isinstance(v, list) else v for name, v in values["scene"].items()
            }
            red, green, blue = (float(value) for value in values["background"])
            return MixModel(
                gaussians=Gaussians(**part("gaussians.")), offsets=tensors["offsets"], network=part("network."),
                scene=MixScene(**scene), background=(red, green, blue), metadata=values["metadata"],
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise VdgsError(f"{path}: is damaged or no model of MixGS ({error}). Delete it and train again.") from error
