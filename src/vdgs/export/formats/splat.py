"""`.splat`: 32 bytes a Gaussian, as viewers on the web stream them. Colors no longer change with the direction.

Position and standard deviations as float32, color and opacity as RGBA, rotation wxyz in four bytes; y down.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Y_DOWN, axes_beside, in_ground
from vdgs.export.formats.export_scene import (
    CHUNK_SIZE,
    ExportScene,
    base_colors,
    gaussian_scales,
    logits_from_opacity,
    opacities,
    to_uint8,
    write_metadata_file,
)
from vdgs.kernels.spherical_harmonics import rgb_to_sh
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic, write_values

SPLAT_DTYPE = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
#: What the file loses of every scene.
ROUNDING_NOTE = "colors, opacities and rotations are rounded to bytes"


def write_splat(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the scene, atomically, and its facts beside it. Returns what was lost. Raises VdgsError."""
    clipped, axes = 0, scene.axes or Y_DOWN

    def write(temporary: Path) -> None:
        nonlocal clipped
        with temporary.open("wb") as file:
            for piece in scene.pieces(axes):
                rows = np.empty(len(piece), SPLAT_DTYPE)
                shown = base_colors(piece)
                clipped += int(((shown < 0) | (shown > 1)).any(1).sum())
                rows["mean"], rows["scale"] = piece.means.numpy(), gaussian_scales(piece)
                rows["rgba"] = to_uint8(np.concatenate([shown, opacities(piece)[:, None]], 1))
                rows["rotation"] = np.clip(np.rint(piece.quaternions.numpy() * 128 + 128), 0, 255).astype(np.uint8)
                write_values(file, rows)

    write_atomic(path, write)
    write_metadata_file(path, scene.metadata, axes)
    lost = [ROUNDING_NOTE]
    if scene.degree:
        lost.append("colors no longer change with the viewing direction")
    if clipped:
        lost.append(f"{clipped} of {scene.count} colors lay outside of 0 .. 1 and were cut off")
    return tuple(lost)


def read_splat_chunks(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a file, in the ground frame, at most `CHUNK_SIZE` at a time. Raises VdgsError if it is missing
    or damaged."""
    try:
        rows = np.fromfile(path, np.uint8)
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if not len(rows) or len(rows) % SPLAT_DTYPE.itemsize:
        raise VdgsError(f"{path}: holds {len(rows)} bytes, which are no whole Gaussians of 32. Write it again.")
    whole = rows.view(SPLAT_DTYPE)
    pieces = (_gaussians(whole[first : first + CHUNK_SIZE]) for first in range(0, len(whole), CHUNK_SIZE))
    yield from in_ground(pieces, axes_beside(path, Y_DOWN))


def _gaussians(table: np.ndarray) -> Gaussians:
    rgba = table["rgba"].astype(np.float32) / 255
    return Gaussians(
        means=torch.from_numpy(table["mean"].copy()),
        log_scales=torch.from_numpy(table["scale"].copy()).log(),
        quaternions=torch.from_numpy((table["rotation"].astype(np.float32) - 128) / 128),
        opacity_logits=logits_from_opacity(rgba[:, 3]),
        sh0=rgb_to_sh(torch.from_numpy(rgba[:, :3])),
        shN=torch.zeros(len(table), 0, 3, dtype=torch.float32, device="cpu"),
    )
