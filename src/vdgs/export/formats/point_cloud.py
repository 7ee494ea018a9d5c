"""The centers of the Gaussians as a point cloud: PLY in local coordinates, LAS and LAZ in those of the map.

What is faint is written too: opacity goes along (LAS: as intensity, 0 .. 65535), so that programs can filter by it.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Z_UP
from vdgs.export.formats.export_scene import (
    ExportMetadata,
    ExportScene,
    base_colors,
    opacities,
    to_uint8,
    write_metadata_file,
)
from vdgs.export.formats.gaussian_ply import write_vertices
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic

if TYPE_CHECKING:
    import laspy

POINT_DTYPE = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("opacity", "<f4")])
#: LAS keeps whole numbers of this, in units of the coordinates.
LAS_SCALE = 0.001
LOSS_NOTES = ("sizes, rotations and changing colors are left out: these are points",)


def write_points(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write x, y, z (ground frame, or along the axes that are asked for), red, green, blue and opacity as PLY,
    atomically. Returns what was lost."""
    names = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue", "float opacity"]

    def rows_of(piece: Gaussians) -> np.ndarray:
        rows = np.empty(len(piece), POINT_DTYPE)
        rows["xyz"], rows["rgb"], rows["opacity"] = piece.means, to_uint8(base_colors(piece)), opacities(piece)
        return rows

    write_vertices(path, scene, names, rows_of)
    return LOSS_NOTES


def check_las_dependencies(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where packages are missing that LAS and LAZ need."""
    needed = [
        "laspy",
        *(["lazrs"] if path.suffix.lower() == ".laz" else []),
        *(["pyproj"] if scene.metadata.crs else []),
    ]
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        raise VdgsError(f"{path}: needs {' and '.join(missing)}, not installed. Install with: pip install 'vdgs[geo]'")
    if scene.metadata.crs:
        _crs(path, scene.metadata.crs)


def write_laz(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write a LAS 1.4 or, by the ending, LAZ file at origin + local coordinates, atomically, with the CRS as WKT; where
    there is none, the place of the origin stands in a `FILE.json` beside it.

    Returns what was lost. Raises VdgsError.
    """
    check_las_dependencies(path, scene)
    import laspy

    compressed = path.suffix.lower() == ".laz"
    header = _las_header(path, scene.metadata)

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file, laspy.open(
            file, mode="w", header=header, do_compress=compressed, closefd=False
        ) as writer:  # fmt: skip
            origin = np.array(scene.metadata.origin)
            for piece in scene.pieces():
                writer.write_points(_las_points(piece.means.double().numpy() + origin, to_uint8(base_colors(piece)),
                                                opacities(piece), header))  # fmt: skip

    write_atomic(path, write)
    if not scene.metadata.crs:
        write_metadata_file(path, scene.metadata, Z_UP)
    return LOSS_NOTES


def _las_header(path: Path, metadata: ExportMetadata) -> laspy.LasHeader:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, LAS_SCALE)
    header.offsets = np.floor(np.array(metadata.origin))
    header.generating_software = metadata.program[:32]
    if metadata.crs:
        header.add_crs(_crs(path, metadata.crs))
    return header


def _las_points(
    positions: np.ndarray, rgb: np.ndarray, opacity: np.ndarray, header: laspy.LasHeader
) -> laspy.ScaleAwarePointRecord:
    import laspy

    points = laspy.ScaleAwarePointRecord.zeros(len(positions), header=header)
    points.x, points.y, points.z = positions.T
    points.red, points.green, points.blue = rgb.T.astype(np.uint16) * 257
    points.intensity = np.rint(opacity * 65535).astype(np.uint16)
    points.return_number[:] = 1
    points.number_of_returns[:] = 1
    return points


def _crs(path: Path, name: str) -> Any:
    import pyproj

    try:
        return pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError as error:
        raise VdgsError(f"{path}: the coordinate reference system {name!r} is not understood ({error}).") from None
