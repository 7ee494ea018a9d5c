"""COLMAP's binary models, written whole: COLMAP itself does not notice that a disk is full."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from vdgs.captures.formats.colmap_binary import read_images_binary, read_points3D_binary
from vdgs.errors import CaptureError
from vdgs.system.atomic_files import explain_disk_errors

if TYPE_CHECKING:
    from vdgs.system.lazy_pycolmap import pycolmap


def write_model_files(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Create a folder and write a model to it. Raises VdgsError where the disk does not hold the whole model."""
    with explain_disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            model.write(folder)
        except (RuntimeError, ValueError) as error:
            raise OSError(" ".join(str(error).split())) from error
        check_whole_model(folder)
        for file in folder.iterdir():
            with file.open("rb") as handle:
                os.fsync(handle.fileno())


def check_whole_model(folder: Path) -> None:
    """Raise OSError where a file of a model is shorter than its own counts say."""
    try:
        for _ in read_images_binary(folder / "images.bin"):
            pass
        read_points3D_binary(folder / "points3D.bin")
    except CaptureError as error:
        raise OSError("COLMAP could write a part only") from error
    for name in ("rigs", "cameras", "frames"):  # written before the others, which need more room
        if not (folder / f"{name}.bin").stat().st_size:
            raise OSError(f"COLMAP could not write {name}.bin")
