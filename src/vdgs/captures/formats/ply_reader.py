"""Point clouds from PLY files: vertices with x, y, z and, where present, colors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.errors import CaptureError

MAX_HEADER_BYTES = 1 << 16
GRAY = 128
#: Formats of a PLY file, and the order of its bytes.
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
#: What red, green and blue are called; 3DGS has the zeroth coefficient of spherical harmonics.
HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
COLORS = (
    ("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"),
    ("color_red", "color_green", "color_blue"), ("scalar_red", "scalar_green", "scalar_blue"), HARMONICS,
)  # fmt: skip
#: The share of a cloud's colors that decides their scale: a few may be beyond it (choice).
BULK = 0.95
#: Fractions of which most are at most this run to 1: of 255 they would be black (choice).
DARK = 2.0
SH_0 = 0.28209479177387814
PLY_DTYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


@dataclass(frozen=True)
class _Header:
    format: str
    count: int
    layout: np.dtype
    size: int
    types: Mapping[str, str]
    """What kind of number each property is, `u1` to `f8`."""


def read_point_cloud(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float64 and colors [n, 3] uint8 (mid-gray where the file has none).

    Reads `ascii` and both binary formats, vertices first; floating-point colors may run from 0 to 1, those of 16 bits
    to 65535; a few that are larger are clipped. Raises `CaptureError` naming the file if it is missing, of another
    kind, or shorter than it announces.
    """
    try:
        data = file.read_bytes()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from error
    vertices, types = read_vertices(data, file)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return points, vertex_colors(vertices, types)


def read_vertices(
    data: bytes, file: Path, needs: tuple[str, ...] = ("x", "y", "z")
) -> tuple[np.ndarray, Mapping[str, str]]:
    """The vertices of a PLY as records, with the properties that it `needs`, and what kind of number each is. Raises as
    `read_point_cloud`."""
    header = _header(data, file, needs)
    return (_ascii if header.format == "ascii" else _binary)(data, header, file), header.types


def _header(data: bytes, file: Path, needs: tuple[str, ...]) -> _Header:
    listed = ", ".join(needs)
    try:
        lines, start = _header_lines(data)
        form, count, fields = _declared(lines)
        if form not in BYTE_ORDERS:
            raise _NotRead(f"is of format {form!r}")
        if count < 0 or not {*needs} <= set(fields):
            raise _NotRead(f"announces no vertices with {listed}")
    except _NotRead as fault:
        raise CaptureError(f"{file}: {fault}. A PLY point cloud with {listed} is needed.") from None
    layout = np.dtype([(name, BYTE_ORDERS[form] + kind) for name, kind in fields.items()])
    return _Header(form, count, layout, start, fields)


class _NotRead(Exception):
    """What is wrong with a header."""


def _header_lines(data: bytes) -> tuple[list[str], int]:
    """The lines of the header, and where the vertices begin."""
    end = data.find(b"\nend_header", 0, MAX_HEADER_BYTES)
    start = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise _NotRead("has no PLY header")
    return data[:end].decode("latin-1").splitlines(), start


def _declared(lines: Sequence[str]) -> tuple[str, int, dict[str, str]]:
    """The format, how many vertices there are (less than 0 where that is not said), and what kind of number each of
    their properties is."""
    form, element, count = "", "", -1
    fields: dict[str, str] = {}
    for line in lines:
        match line.split():
            case ["format", named, *_]:
                form = named
            case ["element", element, number]:
                if element != "vertex" and count < 0:
                    raise _NotRead(f"starts with the element {element!r} instead of vertices")
                if element == "vertex":
                    count = int(number) if number.isdecimal() and len(number) < 12 else -2
            case ["property", *words] if element == "vertex":
                if len(words) != 2 or words[0] not in PLY_DTYPES or words[1] in fields:
                    raise _NotRead(f"has a vertex property that is not understood ({line.strip()!r})")
                fields[words[1]] = PLY_DTYPES[words[0]]
    return form, count, fields


def _binary(data: bytes, header: _Header, file: Path) -> np.ndarray:
    if header.size + header.count * header.layout.itemsize > len(data):
        raise _too_short(header, file)
    return np.frombuffer(data, header.layout, header.count, header.size)


def _ascii(data: bytes, header: _Header, file: Path) -> np.ndarray:
    lines = data[header.size :].split(b"\n", header.count)[: header.count]
    columns = len(header.layout.names or ())
    try:
        rows = [tuple(float(word) for word in line.split()[:columns]) for line in lines]
    except ValueError as error:
        raise CaptureError(f"{file}: holds something that is no number ({error}). Export it again.") from None
    if len(rows) < header.count or any(len(row) < columns for row in rows):
        raise _too_short(header, file)
    # float64 throughout: a number out of an integer's range must not wrap around silently
    wide = np.dtype([(name, "<f8") for name in header.layout.names or ()])
    return np.array(rows, wide)


def _too_short(header: _Header, file: Path) -> CaptureError:
    return CaptureError(
        f"{file}: announces {header.count} vertices but holds fewer. The file is truncated; copy it again."
    )


def vertex_colors(vertices: np.ndarray, types: Mapping[str, str]) -> np.ndarray:
    """Colors [n, 3] uint8 of vertices as `read_vertices` gives them, of 16 bits and fractions too; mid-gray where there
    are none."""
    names = {name.lower(): name for name in vertices.dtype.names or ()}
    triple = next((triple for triple in COLORS if set(triple) <= set(names)), None)
    if triple is None:
        return np.full((len(vertices), 3), GRAY, np.uint8)
    colors = np.stack([vertices[names[name]].astype(np.float64) for name in triple], axis=1)
    if triple == HARMONICS:
        colors = 255 * (0.5 + SH_0 * np.nan_to_num(colors, posinf=2, neginf=-2))
    else:
        colors = colors * _factor(colors, types[names[triple[0]]])
    return np.clip(np.round(np.nan_to_num(colors, nan=GRAY, posinf=255, neginf=0)), 0, 255).astype(np.uint8)


def _factor(colors: np.ndarray, kind: str) -> float:
    """What brings colors to 0 to 255, by most of them: numbers with a point may run to 1, and 16 bits to 65535."""
    finite = colors[np.isfinite(colors)]
    if not len(finite):
        return 1.0
    largest, fractions = float(finite.max()), bool((finite != np.round(finite)).any())
    if "f" in kind and (0 < largest <= 1 or (fractions and _bulk(finite) <= DARK)):
        return 255.0
    return 1 / 257 if "1" not in kind and has_sixteen_bits(finite) else 1.0


def has_sixteen_bits(colors: np.ndarray) -> bool:
    """Whether colors run to 65535 and not to 255."""
    return _bulk(colors) > 255


def _bulk(colors: np.ndarray) -> float:
    """What all but a few are at most, of those that are not black: scanners write points without a color as black."""
    lit = colors[colors > 0]
    return float(np.quantile(lit, BULK)) if lit.size else 0.0
