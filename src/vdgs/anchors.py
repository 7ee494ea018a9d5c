"""The anchor model: points that carry features, from which Gaussians are decoded per view.

Dimensions: n anchors, k offsets per anchor, 32 features. Positions are float32 in the ground frame.
Equations: Scaffold-GS eqs. 3-8; VDGS section III-B.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from safetensors import SafetensorError, safe_open
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.config import AnchorConfig
from vdgs.decoder import Decoder
from vdgs.errors import VdgsError
from vdgs.files import write_atomically
from vdgs.gaps import gap_points
from vdgs.kernels.decode_types import FEATURE_SIZE
from vdgs.tensor_files import checksum, write_tensors

FORMAT = "vdgs-anchors-1"
#: Of a model whose blocks have decoders of their own: a reader that knows of one decoder must not take it.
FORMAT_OF_PARTS = "vdgs-anchors-2"
#: An outlier is known by its distance to this neighbour: small clusters of false matches are outliers too.
OUTLIER_NEIGHBOUR = 4

#: What to do about a model that cannot be used.
REBUILD = "Delete it and run the command that trained it again: it is rebuilt from the last saved state."

#: The tensors of an anchor that training moves, in the order in which they are saved.
TRAINED = ("features", "offsets", "log_scales")


@dataclass(frozen=True)
class Anchors:
    """What each anchor holds. All tensors are float32 and share their first dimension."""

    positions: Float[Tensor, "n 3"]
    features: Float[Tensor, "n 32"]
    offsets: Float[Tensor, "n k 3"]
    log_scales: Float[Tensor, "n 6"]

    def __len__(self) -> int:
        return self.positions.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in ("positions", *TRAINED)}

    def select(self, rows: Tensor) -> Anchors:
        """The anchors of the given rows (indices or mask)."""
        return Anchors(**{name: tensor[rows] for name, tensor in self.tensors().items()})

    def extended(self, more: Anchors) -> Anchors:
        """These anchors followed by others."""
        return Anchors(**{name: torch.cat([a, more.tensors()[name]]) for name, a in self.tensors().items()})


@dataclass(frozen=True)
class Part:
    """So many anchors of a model, one after another, and the decoder that they share."""

    count: int
    decoder: Decoder


@dataclass(frozen=True)
class AnchorModel:
    """A scene: anchors, what decodes them, and what is needed to use them again."""

    anchors: Anchors
    #: That of all anchors, or of the coarse stage where blocks have their own (`parts`).
    decoder: Decoder
    #: Edge of the voxel grid on which the anchors started, in units of the ground frame.
    voxel: float
    #: Colour drawn where nothing is, RGB in [0, 1].
    background: tuple[float, float, float]
    #: JSON-able facts that travel with the file: ground frame, capture, version.
    facts: Mapping[str, Any]
    #: A merged scene whose blocks trained decoders of their own: all anchors, block by block. Else empty.
    parts: tuple[Part, ...] = ()

    def spans(self) -> list[tuple[int, int, Decoder]]:
        """Which rows of the anchors each decoder decodes: first, one past the last, decoder; ascending."""
        bounds = np.cumsum([0, *(part.count for part in self.parts)]).tolist()
        spans = [(a, b, part.decoder) for (a, b), part in zip(pairwise(bounds), self.parts, strict=True)]
        return spans or [(0, len(self.anchors), self.decoder)]

    def save(self, path: Path) -> None:
        """Write one safetensors file, atomically."""
        tensors = {f"anchors.{k}": v for k, v in self.anchors.tensors().items()}
        for prefix, decoder in self._decoders():
            tensors |= {prefix + name: tensor for name, tensor in decoder.tensors().items()}
        facts: dict[str, Any] = {
            "voxel": self.voxel, "background": self.background, "facts": dict(self.facts), "crc32": checksum(tensors),
        }  # fmt: skip
        if self.parts:
            facts["parts"] = [part.count for part in self.parts]
        # A single key: several would be written in an order that varies.
        header = {FORMAT_OF_PARTS if self.parts else FORMAT: json.dumps(facts)}
        write_atomically(path, lambda temporary: write_tensors(temporary, tensors, header))

    @staticmethod
    def load(path: Path) -> AnchorModel:
        """Read a model. Raises VdgsError if the file is missing, damaged or not an anchor model."""
        tensors, header = read_tensors(path)
        found = next((name for name in (FORMAT, FORMAT_OF_PARTS) if name in header), None)
        if found is None:
            raise VdgsError(f"{path}: is not a vdgs anchor model (its header has no {FORMAT!r})")
        try:
            anchors = Anchors(**{n: tensors[f"anchors.{n}"] for n in ("positions", *TRAINED)})
            known = json.loads(header[found])
            decoder = _decoder_of(tensors, "decoder.")
            counts = known["parts"] if found == FORMAT_OF_PARTS else []
            parts = tuple(Part(int(n), _decoder_of(tensors, f"part.{i}.")) for i, n in enumerate(counts))
            if known["crc32"] != checksum(tensors):
                raise ValueError("its checksum does not agree")
            red, green, blue = (float(value) for value in known["background"])
            model = AnchorModel(anchors, decoder, float(known["voxel"]), (red, green, blue), known["facts"], parts)
            model.check()
        except (KeyError, ValueError, TypeError) as error:
            raise VdgsError(f"{path}: is damaged or incomplete ({error}). {REBUILD}") from error
        return model

    def check(self) -> None:
        """Raise ValueError unless shapes and types agree with each other and all numbers are finite."""
        n, k = len(self.anchors), self.anchors.offsets.shape[1] if self.anchors.offsets.ndim == 3 else 0
        shapes = {
            "positions": (n, 3),
            "features": (n, FEATURE_SIZE),
            "offsets": (n, k, 3),
            "log_scales": (n, 6),
        }
        for name, shape in shapes.items():
            tensor = getattr(self.anchors, name)
            if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
                raise ValueError(f"{name} is {tensor.dtype} {tuple(tensor.shape)}, not float32 {shape}")
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{name} holds numbers that are not finite")
        for _, decoder in self._decoders():
            decoder.check(k)
        if self.parts and sum(part.count for part in self.parts) != n:
            raise ValueError(f"its parts hold {sum(part.count for part in self.parts)} anchors, not {n}")

    def _decoders(self) -> list[tuple[str, Decoder]]:
        """Every decoder with what the names of its tensors begin with in a file."""
        return [("decoder.", self.decoder)] + [(f"part.{i}.", part.decoder) for i, part in enumerate(self.parts)]


def _decoder_of(tensors: Mapping[str, Tensor], prefix: str) -> Decoder:
    return Decoder.from_tensors({n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)})


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """All tensors and the header of a safetensors file; VdgsError if it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except FileNotFoundError as error:
        raise VdgsError(f"{path}: is not there. Train first, or point to the right run.") from error
    except (OSError, SafetensorError, ValueError) as error:
        raise VdgsError(f"{path}: cannot be read ({error}). {REBUILD}") from error


def automatic_voxel(points: np.ndarray) -> float:
    """Median distance of the points [n, 3] to their nearest other point (choice; upstream forgets the root).

    Coincident points are counted once. Raises VdgsError with fewer than two distinct points.
    """
    distinct = np.unique(points, axis=0)
    if len(distinct) < 2:
        raise VdgsError(
            f"The capture has {len(distinct)} distinct sparse point(s); at least 2 are needed to place anchors. "
            "Run the structure-from-motion again, or give --anchors.voxel."
        )
    distances, _ = cKDTree(distinct).query(distinct, k=2, workers=1)
    return float(np.median(distances[:, 1]))


def inliers(points: np.ndarray, factor: float) -> np.ndarray:
    """Which points [n, 3] have their fourth nearest neighbour within `factor` times the median such distance."""
    if factor <= 0 or len(points) <= OUTLIER_NEIGHBOUR:
        return np.ones(len(points), bool)
    distances, _ = cKDTree(points).query(points, k=[OUTLIER_NEIGHBOUR + 1], workers=1)
    limit = factor * np.median(distances)
    return distances[:, 0] <= limit if limit > 0 else np.ones(len(points), bool)


def initial_anchors(
    points: np.ndarray, colours: np.ndarray, cameras: Sequence[Camera], config: AnchorConfig
) -> tuple[Anchors, float]:
    """Anchors on the voxel grid of the sparse points [n, 3], and the voxel used.

    Points are rounded to the grid and made unique (Scaffold-GS eq. 3); so are those that fill gaps seen by the
    training cameras. Log-scales start at the logarithm of the mean distance to the three nearest other anchors,
    offsets at 0, features at 0 or at the colours. Raises VdgsError with fewer than two distinct points.
    """
    voxel = config.voxel if config.voxel > 0 else automatic_voxel(points)
    kept = inliers(points, config.outlier_distance)
    points, colours = points[kept], colours[kept]
    if config.fill_gaps:
        gaps = gap_points(points, cameras, voxel)
        nearest = cKDTree(points).query(gaps, workers=1)[1] if len(gaps) else np.zeros(0, np.int64)
        points, colours = np.concatenate([points, gaps]), np.concatenate([colours, colours[nearest]])
    cells, owner = np.unique(np.round(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    positions = cells * voxel
    n = len(positions)
    if n > 1:
        distances, _ = cKDTree(positions).query(positions, k=min(4, n), workers=1)
        spacing = np.clip(distances[:, 1:].mean(axis=1), 0.5 * voxel, None)
    else:
        spacing = np.full(n, voxel)
    features = np.zeros((n, FEATURE_SIZE))
    if config.colour_start:
        features[:, :3] = _mean_colours(colours, owner.reshape(-1), n) * 2.0 - 1.0
    as_tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
    anchors = Anchors(
        positions=as_tensor(positions),
        features=as_tensor(features),
        offsets=torch.zeros(n, config.offsets, 3),
        log_scales=as_tensor(np.repeat(np.log(spacing)[:, None], 6, axis=1)),
    )
    return anchors, voxel


def _mean_colours(colours: np.ndarray, owner: Int64[np.ndarray, " n"], count: int) -> np.ndarray:
    """Mean colour in [0, 1] of the points that share a cell, [count, 3]."""
    sums = np.stack([np.bincount(owner, colours[:, c] / 255.0, count) for c in range(3)], axis=1)
    return sums / np.bincount(owner, minlength=count)[:, None]
