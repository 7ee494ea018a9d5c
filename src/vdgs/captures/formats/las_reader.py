"""Point clouds from LAS and LAZ files, as programs write their dense ones: places and colors, thinned evenly."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from vdgs.captures.formats.ply_reader import GRAY, has_sixteen_bits
from vdgs.errors import CaptureError

#: A cloud of more points is thinned: the scene begins with fewer.
MAX_POINTS = 500_000
_CHUNK = 1_000_000


def can_read_las() -> bool:
    return find_spec("laspy") is not None


def find_las(folders: Iterable[Path]) -> Path | None:
    """The only LAS or LAZ file of the first of these folders that has just one."""
    listed = ([file for file in sorted(folder.glob("*.[lL][aA][sSzZ]")) if file.is_file()] for folder in folders)
    return next((files[0] for files in listed if len(files) == 1), None)


def las_system(file: Path) -> str | None:
    """The coordinate system that the header of a LAS or LAZ file names, as WKT; None where it names none that is
    known."""
    import laspy

    try:
        with laspy.open(file) as reader:
            system = reader.header.parse_crs()
    except Exception:  # laspy, its decoders and pyproj raise of many kinds; `read_las_points` says which of the file
        return None
    return None if system is None else str(system.to_wkt())


def read_las_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float64, at most about `MAX_POINTS`, and colors [n, 3] uint8, mid-gray where the file has none.
    Raises `CaptureError` for what is no such file, or is cut off."""
    import laspy

    places, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint16)]
    try:
        with laspy.open(file) as reader:
            step, before = -(-reader.header.point_count // MAX_POINTS), 0
            has_colors = "red" in reader.header.point_format.dimension_names
            for chunk in reader.chunk_iterator(_CHUNK):
                kept = slice(-before % max(1, step), None, max(1, step))
                places.append(np.column_stack([np.asarray(axis)[kept] for axis in (chunk.x, chunk.y, chunk.z)]))
                if has_colors:
                    colors.append(np.column_stack([chunk[name][kept] for name in ("red", "green", "blue")]))
                before += len(chunk)
            whole = before == reader.header.point_count
    except Exception as error:  # laspy and its decoders raise of many kinds
        raise CaptureError(f"{file}: is no point cloud that can be read ({error}). Copy or export it again.") from None
    if not whole:
        raise CaptureError(f"{file}: ends after {before} points. Copy or export it again.")
    points, rgb = np.concatenate(places), np.concatenate(colors)
    if not len(rgb):
        return points, np.full((len(points), 3), GRAY, np.uint8)
    return points, (rgb >> 8 if has_sixteen_bits(rgb) else rgb.clip(max=255)).astype(np.uint8)
