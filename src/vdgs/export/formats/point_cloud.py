"""The centers of the Gaussians as a point cloud: PLY in local coordinates, LAS and LAZ in those of the map.

What is faint is written too: opacity goes along (LAS: as intensity, 0 .. 65535), so that programs can filter by it.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Z_UP
from vdgs.export.formats.export_scene import (
    ExportMetadata,
    ExportScene,
    base_colors,
    metadata_path,
    opacities,
    to_uint8,
    write_metadata_file,
)
from vdgs.export.formats.gaussian_ply import write_vertices
from vdgs.geometry.ground_frame import UNKNOWN_UNIT
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic

if TYPE_CHECKING:
    import laspy

POINT_DTYPE = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("opacity", "<f4")])
#: LAS keeps whole numbers of this, where the unit of the coordinates is known.
LAS_SCALE = 0.001
#: The whole numbers are below this.
LAS_RANGE = 2**31
#: Coordinates of a known unit lie below this, from the origin.
MAX_LAS_COORDINATE = LAS_RANGE * LAS_SCALE
#: Those of an unknown unit below so many times what nearly all of the scene reaches: steps stay fine beside it.
LAS_REACH_IN_EXTENTS = 2000.0
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


def check_las(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where packages are missing that LAS and LAZ need, or positions are known not to fit."""
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
    if scene.bounds is not None:
        _check_reach(path, np.array(scene.bounds), _las_scale(scene))


def _las_scale(scene: ExportScene) -> float:
    """Whole numbers in the file count this, in units of the coordinates: a power of ten."""
    if scene.metadata.unit != UNKNOWN_UNIT or scene.bounds is None:
        return LAS_SCALE
    reach = float(np.abs(scene.bounds).max()) or 1.0
    return float(10.0 ** math.ceil(math.log10(reach / (0.99 * LAS_RANGE))))


def _check_reach(path: Path, positions: np.ndarray, scale: float) -> None:
    """Raise VdgsError where local positions are beyond what whole numbers of `scale` reach."""
    far = float(np.abs(positions).max())
    if far >= 0.999 * LAS_RANGE * scale:
        raise VdgsError(
            f"{path}: a Gaussian lies {far:.4g} units from the origin; LAS reaches {LAS_RANGE * scale:.4g} in steps of "
            f"{scale:g}. Leave it out (--bbox), or write .points.ply."
        )


def write_laz(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write a LAS 1.4 or, by the ending, LAZ file at origin + local coordinates, atomically, with the CRS as WKT; where
    there is none, the place of the origin stands in a `FILE.json` beside it; one of an earlier export goes.

    Returns what was lost. Raises VdgsError.
    """
    check_las(path, scene)
    import laspy

    compressed, scale = path.suffix.lower() == ".laz", _las_scale(scene)
    header = _las_header(path, scene.metadata, scale)

    def write(temporary: Path) -> None:
        with _lazrs_errors_as_oserror(compressed), temporary.open("wb") as file, laspy.open(
            file, mode="w", header=header, do_compress=compressed, closefd=False
        ) as writer:  # fmt: skip
            origin = np.array(scene.metadata.origin)
            for piece in scene.pieces():
                _check_reach(path, piece.means.numpy(), scale)
                writer.write_points(_las_points(piece.means.double().numpy() + origin, to_uint8(base_colors(piece)),
                                                opacities(piece), header))  # fmt: skip

    write_atomic(path, write)
    of_system: tuple[str, ...] = ()
    if scene.metadata.crs:
        metadata_path(path).unlink(missing_ok=True)
        of_system = _las_wkt(_crs(path, scene.metadata.crs))[1]
    else:
        write_metadata_file(path, scene.metadata, Z_UP)
    rounding = f"coordinates are rounded to {scale:g} {scene.metadata.unit}"
    return (*of_system, *LOSS_NOTES, rounding, *_index_notes(path))


def _index_notes(path: Path) -> tuple[str, ...]:
    """That a cloud lies beside a file which QGIS has made of an earlier one and draws in its place."""
    index = path.with_name(f"{path.stem}.copc.laz")
    if not index.is_file():
        return ()
    return (f"{index.name} beside it is of an earlier file, and QGIS shows that one. If QGIS made it, remove it",)


@contextmanager
def _lazrs_errors_as_oserror(compressed: bool) -> Iterator[None]:
    """OSError for what lazrs raises of its own where the disk refuses a block of points."""
    if not compressed:
        yield
        return
    import lazrs

    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(str(error)) from error


def _las_header(path: Path, metadata: ExportMetadata, scale: float) -> laspy.LasHeader:
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, scale)
    header.offsets = np.array(metadata.origin)
    header.generating_software = metadata.program[:32]
    header.global_encoding.wkt = True  # LAS 1.4 asks for it of point formats from 6 on, with a system or without
    if metadata.crs:
        header.vlrs.append(WktCoordinateSystemVlr(_las_wkt(_crs(path, metadata.crs))[0]))
    return header


def _las_wkt(crs: Any) -> tuple[str, tuple[str, ...]]:
    """A system as record 2112 of LAS 1.4 holds it, WKT 1 (OGC 01-009), and what is lost: WKT 2 where that has no words
    for the system.

    GDAL's WKT 1 names no axes for systems to the north and east: x is east then, as in the points.
    """
    import pyproj

    try:
        return crs.to_wkt("WKT1_GDAL"), ()
    except pyproj.exceptions.CRSError:
        return crs.to_wkt(), (
            f"{crs.name} stands in the file as WKT 2, for WKT 1 cannot say it: programs that read only what LAS 1.4 "
            "asks for find no coordinate system",
        )


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
