"""A trained scene with levels: an anchor model, and beside it the level and bias of each anchor."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from experiments.baselines.octree_gs.levels import Octree
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import SPLAT_TENSORS, Raster, Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import cull_anchors, decode_anchors, rasterize_splats
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, write_tensors

FILE_FORMAT = "vdgs-octree-1"
LEVELS_FILE = "levels.safetensors"


@dataclass(frozen=True)
class OctreeModel:
    """Anchors of several decoders, each in one octree: blocks have octrees of their own."""

    anchors: AnchorModel
    levels: Int32[Tensor, " n"]
    bias: Float[Tensor, " n"]
    #: The octree of each range of `anchors.decoder_ranges`.
    octrees: tuple[Octree, ...]

    @property
    def background(self) -> tuple[float, float, float]:
        return self.anchors.background

    def to(self, device: str) -> OctreeModel:
        """The same model on a device."""
        anchors = self.anchors.to(torch.device(device))
        return replace(self, anchors=anchors, levels=self.levels.to(device), bias=self.bias.to(device))

    def rows(self, camera: Camera, level: int | None = None) -> Int64[Tensor, " v"]:
        """The anchors that a view shows, ascending; none finer than `level`."""
        rows = cull_anchors(self.anchors.anchors, camera)
        parts = []
        for octree, (first, last, _) in zip(self.octrees, self.anchors.decoder_ranges(), strict=True):
            own = rows[(rows >= first) & (rows < last)]
            num_open = octree.num_levels if level is None else min(level + 1, octree.num_levels)
            shown = octree.shown(
                self.anchors.anchors.positions[own], self.levels[own], self.bias[own], camera, num_open
            )
            parts.append(own[shown])
        return torch.cat(parts)

    @torch.no_grad()
    def render(self, camera: Camera, *, depth: bool = False, level: int | None = None) -> Raster:
        """One view: image [h, w, 3] (not clamped), alpha [h, w], depth [h, w] or None."""
        rows, ranges = self.rows(camera, level), self.anchors.decoder_ranges()
        bounds = torch.searchsorted(rows, rows.new_tensor([first for first, _, _ in ranges] + [len(self.levels)]))
        parts = [
            decode_anchors(self.anchors.anchors, rows[first:last], decoder.weights_for_image(None), camera)
            for (first, last), (_, _, decoder) in zip(pairwise(bounds.tolist()), ranges, strict=True)
        ]
        splats = Splats(*(torch.cat([getattr(part, name) for part in parts]) for name in SPLAT_TENSORS))
        return rasterize_splats(splats, camera, self.bias.new_tensor(self.background), depth)

    def save(self, folder: Path) -> None:
        """Write the levels, then the anchor model, whose file is the sign that all is there."""
        header = {FILE_FORMAT: json.dumps([asdict(octree) for octree in self.octrees])}
        tensors = {"levels": self.levels, "bias": self.bias}
        write_atomic(folder / LEVELS_FILE, lambda path: write_tensors(path, tensors, header))
        self.anchors.save(folder / "model.safetensors")

    @staticmethod
    def load(folder: Path) -> OctreeModel:
        """Read a model. Raises VdgsError for a file that is missing, damaged or of another model."""
        anchors = AnchorModel.load(folder / "model.safetensors")
        tensors, header = read_tensors(folder / LEVELS_FILE)
        try:
            octrees = tuple(Octree(**each) for each in json.loads(header[FILE_FORMAT]))
            levels, bias = tensors["levels"], tensors["bias"]
            if not len(levels) == len(bias) == len(anchors.anchors) or len(octrees) != len(anchors.decoder_ranges()):
                raise ValueError("its levels are not those of the anchors beside it")
        except (KeyError, TypeError, ValueError) as error:
            raise VdgsError(
                f"{folder / LEVELS_FILE}: is damaged ({error}). Delete {folder} and train again."
            ) from error
        return OctreeModel(anchors, levels, bias, octrees)
