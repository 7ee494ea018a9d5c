"""The PLY of 3DGS: every number as it was trained, in the layout of INRIA's program that all others read.

Coordinates are those of the ground frame, z up, unless others are asked for. Header comments say where they stand: all
of them short lines, for some readers have room for 1024 characters and do not check (RPly, in Open3D and older
CloudCompare). The whole coordinate reference system stands beside the PLY, in FILE.prj.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Z_UP, Axes, axes_named
from vdgs.export.formats.export_scene import CHUNK_SIZE, ExportMetadata, ExportScene
from vdgs.export.formats.foreign_gaussians import fused_filter, warn_antialiased
from vdgs.export.formats.ply_header import PlyElement, PlyHeader, read_ply_header
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, num_sh_bases
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic, write_text, write_values
from vdgs.system.quoting import header_line

#: What Brush says of Gaussians that are to be drawn anti-aliased.
MIP_COMMENT = "SplatRenderMode: mip"
#: Characters of a fact in a comment.
LONGEST_COMMENT = 200
SCALE_NAMES = tuple(f"scale_{axis}" for axis in range(3))
ROTATION_NAMES = tuple(f"rot_{part}" for part in range(4))
DC_NAMES = tuple(f"f_dc_{channel}" for channel in range(3))


def property_names(degree: int) -> tuple[str, ...]:
    """Names of the numbers of one Gaussian, in the order of the file."""
    rest = tuple(f"f_rest_{index}" for index in range(3 * (num_sh_bases(degree) - 1)))
    return ("x", "y", "z", "nx", "ny", "nz", *DC_NAMES, *rest, "opacity", *SCALE_NAMES, *ROTATION_NAMES)


def header_comments(scene: ExportScene, axes: Axes) -> list[str]:
    """Header lines that say where local coordinates stand, one fact each, as JSON, none of them long."""
    known = {**scene.metadata.to_dict(), "axes": axes.words(scene.metadata.has_compass)}
    if scene.metadata.crs is not None:
        known["crs"] = short_name(scene.metadata.crs)
    lines = [f"comment {name} {header_line(value if isinstance(value, str) else json.dumps(value))[:LONGEST_COMMENT]}"
             for name, value in known.items()]  # fmt: skip
    return [*lines, f"comment {MIP_COMMENT}"] if scene.antialiased else lines


def short_name(crs: str) -> str:
    """A coordinate reference system in a few words: its code where its WKT ends in one, else its name."""
    code = re.search(r'(?:ID|AUTHORITY)\["(\w+)",\s*"?(\w+)"?\]\s*\]\s*$', crs)
    name = re.match(r'\s*\w+\["([^"]*)"', crs)
    if code is not None:
        return f"{code[1]}:{code[2]}"
    return name[1] if name is not None else crs


def beside_ply(path: Path) -> Path:
    """Where the whole coordinate reference system of a PLY stands: FILE.prj."""
    return path.with_name(path.name + ".prj")


def write_crs_beside(path: Path, facts: ExportMetadata) -> None:
    """Write FILE.prj where there is a system; one of an earlier export that has none now goes."""
    if facts.crs is not None:
        write_text(beside_ply(path), facts.crs.rstrip() + "\n")
    else:
        beside_ply(path).unlink(missing_ok=True)


def reads_as_written_beside(file: Path) -> bool:
    """Whether a FILE.prj is such as `write_crs_beside` writes: to the letter what pyproj says of a system, on one line.
    It names no program, and is left where people delete a PLY."""
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError:
        return False
    try:
        text = file.read_text("utf-8")
        return text == CRS.from_wkt(text).to_wkt() + "\n"
    except (CRSError, OSError, UnicodeDecodeError):
        return False


def write_ply(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the scene, atomically; loses nothing. Raises VdgsError."""
    names = property_names(scene.degree)
    write_vertices(path, scene, [f"float {name}" for name in names], lambda piece: _rows(piece, len(names)))
    return ()


def write_vertices(
    path: Path, scene: ExportScene, properties: Sequence[str], rows_of: Callable[[Gaussians], np.ndarray]
) -> None:
    """A PLY of one row for each Gaussian, and its coordinate system beside it."""
    axes = scene.axes or Z_UP
    lines = [
        "ply", "format binary_little_endian 1.0", *header_comments(scene, axes),
        f"element vertex {scene.count}", *(f"property {each}" for each in properties), "end_header", "",
    ]  # fmt: skip

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.write("\n".join(lines).encode("ascii"))
            for piece in scene.pieces(axes):
                write_values(file, rows_of(piece))

    write_atomic(path, write)
    write_crs_beside(path, scene.metadata)


def _rows(piece: Gaussians, width: int) -> np.ndarray:
    n, rest = len(piece), piece.shN.shape[1]
    rows = np.zeros((n, width), "<f4")  # normals stay zero
    rows[:, 0:3] = piece.means.numpy()
    rows[:, 6:9] = piece.sh0.numpy()
    rows[:, 9 : 9 + 3 * rest].reshape(n, 3, rest)[:] = piece.shN.numpy().transpose(0, 2, 1)  # channel by channel
    rows[:, -8] = piece.opacity_logits.numpy()
    rows[:, -7:-4] = piece.log_scales.numpy()
    rows[:, -4:] = piece.quaternions.numpy()
    return rows


def read_ply_chunks(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a PLY file of 3DGS, binary or ASCII, properties in any order, at most `CHUNK_SIZE` at a time.

    Raises VdgsError for a file that is missing, of another kind, or shorter than it announces.
    """
    header = read_ply_header(path)
    found = header.find("vertex")
    if found is None:
        raise VdgsError(f"{path}: has no element 'vertex'; this is no PLY of 3DGS. Write it as one.")
    vertices, start = found
    names = set(vertices.layout.names or ())
    rest = sum(name.startswith("f_rest_") for name in names)
    _check_names(path, names, rest)
    held = (path.stat().st_size - start) // max(vertices.layout.itemsize, 1)
    if header.form != "ascii" and held < vertices.count:
        raise VdgsError(
            f"{path}: announces {vertices.count} Gaussians but holds {held}. It is truncated; write it again."
        )
    if draws_antialiased(header) or "filter_3D" in names:
        warn_antialiased(path)
    axes = axes_named(header.comment("axes "), Z_UP)
    for table in _tables(header, vertices, start):
        yield axes.to_ground(_gaussians(table, rest))


def draws_antialiased(header: PlyHeader) -> bool:
    """Whether a comment says so, in the words of Brush or Postshot."""
    return header.comment(MIP_COMMENT.partition(":")[0] + ":") == "mip" or header.comment("antialiased ") == "1"


def _check_names(path: Path, names: set[str], rest: int) -> None:
    """Raise VdgsError where properties are missing that a PLY of 3DGS has."""
    missing = [name for name in property_names(0) if name not in names and not name.startswith("n")]
    if missing or rest not in {3 * (num_sh_bases(degree) - 1) for degree in range(MAX_SH_DEGREE + 1)}:
        what = f"has no {missing[0]}" if missing else f"has {rest} f_rest properties"
        raise VdgsError(f"{path}: {what}; this is no PLY of 3DGS. Point clouds have other layouts.")
    gaps = [name for name in (f"f_rest_{index}" for index in range(rest)) if name not in names]
    if gaps:
        raise VdgsError(
            f"{path}: has {rest} f_rest properties, but none of the name {gaps[0]}. Number them without gaps, from 0."
        )


def _tables(header: PlyHeader, vertices: PlyElement, start: int) -> Iterator[np.ndarray]:
    """The rows of vertices, at most `CHUNK_SIZE` at a time. Raises VdgsError where there are fewer."""
    path, layout = header.path, vertices.layout
    try:
        with path.open("rb") as file:
            file.seek(header.start if header.form == "ascii" else start)
            lines = (line for line in file if line.strip()) if header.form == "ascii" else None
            if lines is not None:
                next(islice(lines, start, start), None)  # of other elements
            for first in range(0, max(vertices.count, 1), CHUNK_SIZE):
                count = min(CHUNK_SIZE, vertices.count - first)
                if lines is None:
                    yield np.frombuffer(file.read(count * layout.itemsize), layout)
                else:
                    rows = [tuple(line.split()) for line in islice(lines, count)]
                    yield np.array(rows, [(name, "f4") for name in layout.names or ()]).reshape(count)
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except ValueError as error:
        raise VdgsError(f"{path}: is damaged or truncated ({error}). Write it again.") from error


def _gaussians(table: np.ndarray, rest: int) -> Gaussians:
    def columns(*wanted: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([table[name].astype(np.float32) for name in wanted], -1))

    n = len(table)
    coefficients = (
        columns(*(f"f_rest_{i}" for i in range(rest))) if rest else torch.zeros(n, 0, dtype=torch.float32, device="cpu")
    )
    found = Gaussians(
        means=columns("x", "y", "z"), log_scales=columns(*SCALE_NAMES), quaternions=columns(*ROTATION_NAMES),
        opacity_logits=columns("opacity")[:, 0], sh0=columns(*DC_NAMES),
        shN=coefficients.reshape(n, 3, rest // 3).transpose(1, 2).contiguous(),
    )  # fmt: skip
    return fused_filter(found, columns("filter_3D")[:, 0]) if "filter_3D" in (table.dtype.names or ()) else found
