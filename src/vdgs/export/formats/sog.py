"""SOG, PlayCanvas' files: the numbers of a scene as lossless WebP images in one zip, a twelfth of a PLY and less.

Version 2. Positions have 16 bits after a logarithm: fine near the origin, coarse far from it. Sizes and colours are
indices into 256 values each, spherical harmonics into a palette of whole sets. Gaussians stand in Morton order:
neighbours are alike, so the images are small. The frame is that of `.splat`, y down.
"""

from __future__ import annotations

import io
import json
import math
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from vdgs.export.formats.codebooks import SAMPLE, Palette, codebook, nearest_entries
from vdgs.export.formats.export_scene import ROWS, Y_DOWN, Facts, Scene, bytes_of, opacities, write_beside
from vdgs.export.formats.gaussian_store import Spooled, spooled
from vdgs.kernels import choose
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomically
from vdgs.system.documents import JsonObject

#: Sets of spherical harmonics at most. The format would take 65536; their gain is small and their search long.
MOST_SETS = 4096
#: Sets in a row of their image.
SETS_IN_ROW = 64
#: Positions are whole numbers up to this.
LAST = 65535


def write_sog(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write the bundled kind, atomically, and the scene's facts beside it. Returns what was lost. Raises VdgsError."""
    coarsest = 0.0

    def write(temporary: Path) -> None:
        nonlocal coarsest
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
            images = _Images(spooled(scene, Path(folder) / "rows", Y_DOWN))
            coarsest = images.coarsest()
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as bundle:
                for name, picture in images.filled().items():
                    bundle.writestr(f"{name}.webp", _webp(picture))
                bundle.writestr("meta.json", json.dumps(images.meta(scene.facts), allow_nan=False))

    write_atomically(path, write)
    write_beside(path, scene.facts, {"axes": "x west, y down, z south"})
    notes = [f"positions are rounded, farthest from the origin to {100 * coarsest:.1f} cm (if units are metres)"]
    if scene.degree:
        notes.append(f"changing colours are taken from a palette of at most {MOST_SETS}")
    return tuple(notes)


class _Images:
    """The images of a bundle and what its JSON says of them."""

    def __init__(self, scene: Spooled) -> None:
        self.scene = scene
        sample = scene.sample(SAMPLE)
        self.count, self.degree = len(scene.means), sample.degree
        self.low, self.high = _logarithm(scene.means.min(0)), _logarithm(scene.means.max(0))
        self.scales = codebook(sample.log_scales.numpy().ravel())
        self.colours = codebook(sample.dc.numpy().ravel())
        self.palette: Palette | None = None
        if self.degree:
            self.palette = Palette(sample.rest.numpy().reshape(len(sample), -1), MOST_SETS)
            self.harmonics = codebook(self.palette.rows.ravel())

    def coarsest(self) -> float:
        """The largest step between neighbouring positions, in units of the scene."""
        step = (self.high - self.low) / LAST
        return float((step * np.exp(np.maximum(np.abs(self.low), np.abs(self.high)))).max())

    def filled(self) -> dict[str, np.ndarray]:
        """Every image by its name: uint8 [h, w, 4]."""
        width = 4 * math.ceil(math.sqrt(self.count) / 4)
        height = 4 * math.ceil(self.count / width / 4)
        names = ("means_l", "means_u", "quats", "scales", "sh0", *(["shN_labels"] if self.palette else []))
        flat = {name: np.full((width * height, 4), 255, np.uint8) for name in names}
        order = choose(torch.device("cpu")).morton_order(torch.from_numpy(self.scene.means)).numpy()
        for start in range(0, self.count, ROWS):
            piece = self.scene.rows(order[start : start + ROWS])
            for name, values in self._pixels(piece).items():
                flat[name][start : start + len(piece), : values.shape[1]] = values
        images = {name: pixels.reshape(height, width, 4) for name, pixels in flat.items()}
        if self.palette:
            images["shN_centroids"] = self._centroids()
        return images

    def _pixels(self, piece: Gaussians) -> dict[str, np.ndarray]:
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        places = np.rint((_logarithm(piece.means.numpy()) - self.low) / span * LAST)
        whole = np.clip(places, 0, LAST).astype(np.uint16)
        shown = nearest_entries(piece.dc.numpy(), self.colours)
        pixels = {
            "means_l": (whole & 255).astype(np.uint8), "means_u": (whole >> 8).astype(np.uint8),
            "quats": _packed(piece.quaternions.numpy()),
            "scales": nearest_entries(piece.log_scales.numpy(), self.scales),
            "sh0": np.concatenate([shown, bytes_of(opacities(piece))[:, None]], 1),
        }  # fmt: skip
        if self.palette:
            labels = self.palette.nearest(piece.rest.numpy().reshape(len(piece), -1))
            pixels["shN_labels"] = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1).astype(np.uint8)
        return pixels

    def _centroids(self) -> np.ndarray:
        """The palette: each set a run of pixels, one for each coefficient."""
        assert self.palette is not None
        sets = len(self.palette.rows)
        coded = nearest_entries(self.palette.rows, self.harmonics).reshape(sets, -1, 3)
        image = np.full((math.ceil(sets / SETS_IN_ROW) * SETS_IN_ROW, coded.shape[1], 4), 255, np.uint8)
        image[:sets, :, :3] = coded
        return image.reshape(-1, SETS_IN_ROW * coded.shape[1], 4)

    def meta(self, facts: Facts) -> JsonObject:
        """What the JSON of the bundle says."""
        meta: JsonObject = {
            "version": 2, "asset": {"generator": facts.program, "extras": facts.known()}, "count": self.count,
            "antialias": False,
            "means": {"mins": self.low.tolist(), "maxs": self.high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
            "scales": {"codebook": self.scales.tolist(), "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
            "sh0": {"codebook": self.colours.tolist(), "files": ["sh0.webp"]},
        }  # fmt: skip
        if self.palette:
            meta["shN"] = {
                "count": len(self.palette.rows), "bands": self.degree, "codebook": self.harmonics.tolist(),
                "files": ["shN_centroids.webp", "shN_labels.webp"],
            }  # fmt: skip
        return meta


def _logarithm(places: np.ndarray) -> np.ndarray:
    wide = places.astype(np.float64)
    return np.sign(wide) * np.log1p(np.abs(wide))


def _packed(quaternions: np.ndarray) -> np.ndarray:
    """The three smaller of w, x, y, z in a byte each, and which is largest: 252 and up."""
    rows = np.arange(len(quaternions))
    largest = np.abs(quaternions).argmax(1)
    signed = np.where(quaternions[rows, largest][:, None] < 0, -quaternions, quaternions)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    small = bytes_of(np.take_along_axis(signed, others, 1) * (math.sqrt(2) / 2) + 0.5)
    return np.concatenate([small, (252 + largest[:, None]).astype(np.uint8)], 1)


def _webp(picture: np.ndarray) -> bytes:
    """Lossless, with the colours of transparent pixels too."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "WEBP", lossless=True, exact=True, quality=50, method=2)
    return file.getvalue()
