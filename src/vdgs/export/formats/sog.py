"""SOG, PlayCanvas' files: the numbers of a scene as lossless WebP images in one zip, a twelfth of a PLY and less.

Version 2. Positions have 16 bits after a logarithm: fine near the origin, coarse far from it. Sizes and colors are
indices into 256 values each, spherical harmonics into a palette of whole sets. Gaussians stand in Morton order:
neighbors are alike, so the images are small. The frame is that of `.splat`, y down.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from PIL import Image

from vdgs.export.formats.axes import Y_DOWN
from vdgs.export.formats.codebooks import SAMPLE_ROWS, VectorCodebook, fit_codebook, learn_codebook, quantize
from vdgs.export.formats.export_scene import (
    CHUNK_SIZE,
    ExportMetadata,
    ExportScene,
    opacities,
    smallest_three,
    to_uint8,
    write_metadata_file,
)
from vdgs.export.formats.gaussian_store import GaussianStore, write_store
from vdgs.kernels import get_backend
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic, write_bytes, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.scratch import scratch_folder

#: Sets of spherical harmonics at most. The format would take 65536; their gain is small and their search long.
MAX_SH_CENTROIDS = 4096
#: Sets in a row of their image.
CENTROIDS_PER_ROW = 64
#: Positions are whole numbers up to this.
MAX_UINT16 = 65535
#: What the file loses of every scene, beside positions.
CODEBOOK_NOTE = "sizes and colors take 256 values each, opacities and rotations are rounded to bytes"


def write_sog(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the bundled kind, atomically, and the scene's facts beside it. Returns what was lost. Raises VdgsError."""
    coarsest, axes = 0.0, scene.axes or Y_DOWN

    def write(temporary: Path) -> None:
        nonlocal coarsest
        with scratch_folder(path) as folder:
            store = write_store(scene, folder / "rows", axes)
            images = _Images(store, fit_palette(store))
            order = get_backend(torch.device("cpu")).morton_order(torch.from_numpy(store.means)).numpy()
            coarsest = images.max_step()
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as bundle:
                for name, picture in images.encode(order).items():
                    bundle.writestr(f"{name}.webp", _webp(picture))
                bundle.writestr("meta.json", json.dumps(images.meta(scene.metadata), allow_nan=False))

    write_atomic(path, write)
    write_metadata_file(path, scene.metadata, axes)
    notes = [
        f"positions are rounded, farthest from the origin to {100 * coarsest:.1f} cm (if units are metres)",
        CODEBOOK_NOTE,
    ]
    if scene.degree:
        notes.append(f"changing colors are taken from a palette of at most {MAX_SH_CENTROIDS}")
    return tuple(notes)


def fit_palette(scene: GaussianStore) -> VectorCodebook | None:
    """The sets of changing colors of a scene; None where colors do not change."""
    sample = scene.sample(SAMPLE_ROWS)
    return VectorCodebook(sample.shN.numpy().reshape(len(sample), -1), MAX_SH_CENTROIDS) if sample.sh_degree else None


def write_sog_folder(folder: Path, store: GaussianStore, palette: VectorCodebook | None, facts: ExportMetadata) -> None:
    """Write the unbundled kind, the Gaussians in their order, along the format's axes already: images, then JSON."""
    images = _Images(store, palette)
    for name, picture in images.encode(np.arange(images.count)).items():
        write_bytes(folder / f"{name}.webp", _webp(picture))
    write_json(folder / "meta.json", images.meta(facts))


class _Images:
    """The images of a bundle and what its JSON says of them."""

    def __init__(self, scene: GaussianStore, palette: VectorCodebook | None) -> None:
        self.scene, self.palette = scene, palette
        sample = scene.sample(SAMPLE_ROWS)
        self.count, self.degree = len(scene.means), sample.sh_degree
        self.low, self.high = _signed_log(scene.means.min(0)), _signed_log(scene.means.max(0))
        self.scales = learn_codebook(sample.log_scales.numpy(), scene.values("log_scales"))
        self.colors = learn_codebook(sample.sh0.numpy(), scene.values("sh0"))
        if self.palette:
            self.harmonics = fit_codebook(self.palette.rows.ravel())

    def max_step(self) -> float:
        """The largest step between neighboring positions, in units of the scene."""
        step = (self.high - self.low) / MAX_UINT16
        return float((step * np.exp(np.maximum(np.abs(self.low), np.abs(self.high)))).max())

    def encode(self, order: Int[np.ndarray, " n"]) -> dict[str, np.ndarray]:
        """Every image by its name, of the Gaussians in an order: uint8 [h, w, 4]."""
        width = 4 * math.ceil(math.sqrt(self.count) / 4)
        height = 4 * math.ceil(self.count / width / 4)
        names = ("means_l", "means_u", "quats", "scales", "sh0", *(["shN_labels"] if self.palette else []))
        flat = {name: np.full((width * height, 4), 255, np.uint8) for name in names}
        for start in range(0, self.count, CHUNK_SIZE):
            piece = self.scene.rows(order[start : start + CHUNK_SIZE])
            for name, values in self._pixels(piece).items():
                flat[name][start : start + len(piece), : values.shape[1]] = values
        images = {name: pixels.reshape(height, width, 4) for name, pixels in flat.items()}
        if self.palette:
            images["shN_centroids"] = self._centroids()
        return images

    def _pixels(self, piece: Gaussians) -> dict[str, np.ndarray]:
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        places = np.rint((_signed_log(piece.means.numpy()) - self.low) / span * MAX_UINT16)
        whole = np.clip(places, 0, MAX_UINT16).astype(np.uint16)
        shown = quantize(piece.sh0.numpy(), self.colors)
        pixels = {
            "means_l": (whole & 255).astype(np.uint8), "means_u": (whole >> 8).astype(np.uint8),
            "quats": _packed(piece.quaternions.numpy()),
            "scales": quantize(piece.log_scales.numpy(), self.scales),
            "sh0": np.concatenate([shown, to_uint8(opacities(piece))[:, None]], 1),
        }  # fmt: skip
        if self.palette:
            labels = self.palette.nearest(piece.shN.numpy().reshape(len(piece), -1))
            pixels["shN_labels"] = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1).astype(np.uint8)
        return pixels

    def _centroids(self) -> np.ndarray:
        """The palette: each set a run of pixels, one for each coefficient."""
        assert self.palette is not None
        sets = len(self.palette.rows)
        coded = quantize(self.palette.rows, self.harmonics).reshape(sets, -1, 3)
        image = np.full((math.ceil(sets / CENTROIDS_PER_ROW) * CENTROIDS_PER_ROW, coded.shape[1], 4), 255, np.uint8)
        image[:sets, :, :3] = coded
        return image.reshape(-1, CENTROIDS_PER_ROW * coded.shape[1], 4)

    def meta(self, facts: ExportMetadata) -> JsonObject:
        """What the JSON of the bundle says."""
        meta: JsonObject = {
            "version": 2, "asset": {"generator": facts.program, "extras": facts.to_dict()}, "count": self.count,
            "antialias": False,
            "means": {"mins": self.low.tolist(), "maxs": self.high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
            "scales": {"codebook": self.scales.tolist(), "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
            "sh0": {"codebook": self.colors.tolist(), "files": ["sh0.webp"]},
        }  # fmt: skip
        if self.palette:
            meta["shN"] = {
                "count": len(self.palette.rows), "bands": self.degree, "codebook": self.harmonics.tolist(),
                "files": ["shN_centroids.webp", "shN_labels.webp"],
            }  # fmt: skip
        return meta


def _signed_log(positions: np.ndarray) -> np.ndarray:
    wide = positions.astype(np.float64)
    return np.sign(wide) * np.log1p(np.abs(wide))


def _packed(quaternions: np.ndarray) -> np.ndarray:
    """The three smaller of w, x, y, z in a byte each, and which is largest: 252 and up."""
    largest, others = smallest_three(quaternions)
    small = to_uint8(others * (math.sqrt(2) / 2) + 0.5)
    return np.concatenate([small, (252 + largest[:, None]).astype(np.uint8)], 1)


def _webp(picture: np.ndarray) -> bytes:
    """Lossless, with the colors of transparent pixels too."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "WEBP", lossless=True, exact=True, quality=50, method=2)
    return file.getvalue()
