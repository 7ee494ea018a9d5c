"""PlayCanvas' compressed PLY: 16 bytes a Gaussian, and a byte for each coefficient of colors that change.

Chunks of 256 neighbors (in Morton order) have bounds as float32; within them a Gaussian has positions and logarithms
of sizes in 11, 10 and 11 bits, the three smaller parts of its rotation in 10 bits each, color and opacity in 8. The
coefficients of spherical harmonics are bytes between -4 and 4. The frame is that of `.sog`, y down.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt32

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Y_DOWN, Axes, axes_named
from vdgs.export.formats.export_scene import (
    CHUNK_SIZE,
    OTHER_PARTS,
    ExportScene,
    base_colors,
    logits_from_opacity,
    opacities,
    smallest_three,
)
from vdgs.export.formats.foreign_gaussians import warn_antialiased
from vdgs.export.formats.gaussian_ply import draws_antialiased, header_comments, write_crs_beside
from vdgs.export.formats.gaussian_store import write_store
from vdgs.export.formats.ply_header import PlyHeader, read_ply_header
from vdgs.kernels import get_backend
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, num_sh_bases, rgb_to_sh
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic
from vdgs.system.scratch import scratch_folder

CHUNK = 256
#: What the float32 of a chunk are: lowest and highest position, logarithm of the size, color.
BOUNDS = tuple(
    f"{end}_{what}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for what in names
)
#: Those that every file has; older ones have none of colors.
EDGES = BOUNDS[:12]
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
#: Coefficients of changing colors in all three channels, by their degree.
HARMONICS = tuple(3 * (num_sh_bases(degree) - 1) for degree in range(MAX_SH_DEGREE + 1))
#: Readers take no larger or smaller logarithm of a size.
LARGEST_LOG = 20.0
#: Coefficients of spherical harmonics lie between minus and plus half of this.
SPAN = 8.0
LOST = (
    "positions and sizes are rounded to 1/2047 of what their chunk of 256 neighbors spans (along the second axis to "
    "1/1023), colors to bytes"
)
LOST_CHANGES = (
    f"coefficients of changing colors are rounded to {SPAN / 256:.3f}, up or down so that neighbors keep their mean"
)


def write_compressed_ply(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the scene, atomically. Returns what was lost. Raises VdgsError."""
    axes, count = scene.axes or Y_DOWN, scene.count
    coefficients = 3 * (num_sh_bases(scene.degree) - 1)
    header = _header(scene, axes, coefficients)
    chunks = -(-count // CHUNK)
    vertices = len(header) + chunks * 4 * len(BOUNDS)
    harmonics = vertices + count * 4 * len(PACKED)

    def write(temporary: Path) -> None:
        with scratch_folder(path) as folder:
            held = write_store(scene, folder / "rows", axes)
            order = get_backend(torch.device("cpu")).morton_order(torch.from_numpy(held.means)).numpy()
            rounding = _HarmonicRounding(coefficients)
            with temporary.open("wb") as file:
                file.write(header)
                for first in range(0, count, CHUNK_SIZE):  # whole chunks: CHUNK_SIZE is a multiple of CHUNK
                    piece = held.rows(order[first : first + CHUNK_SIZE])
                    bounds, packed = _packed(piece)
                    _put(file, len(header) + first // CHUNK * 4 * len(BOUNDS), bounds)
                    _put(file, vertices + first * 4 * len(PACKED), packed)
                    _put(file, harmonics + first * coefficients, rounding.to_bytes(piece))

    write_atomic(path, write)
    write_crs_beside(path, scene.metadata)
    return (LOST, LOST_CHANGES) if coefficients else (LOST,)


def _header(scene: ExportScene, axes: Axes, coefficients: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *header_comments(scene, axes)]
    lines += [f"element chunk {-(-scene.count // CHUNK)}", *(f"property float {name}" for name in BOUNDS)]
    lines += [f"element vertex {scene.count}", *(f"property uint {name}" for name in PACKED)]
    if coefficients:
        lines += [f"element sh {scene.count}", *(f"property uchar f_rest_{i}" for i in range(coefficients))]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _put(file: IO[bytes], place: int, values: np.ndarray) -> None:
    file.seek(place)
    file.write(values.tobytes())


def _packed(piece: Gaussians) -> tuple[Float[np.ndarray, "c 18"], UInt32[np.ndarray, "n 4"]]:
    """The bounds of the chunks, and the four words of each Gaussian."""
    logs = piece.log_scales.numpy().clip(-LARGEST_LOG, LARGEST_LOG)
    bounds, units = [], []
    for values in (piece.means.numpy(), logs, base_colors(piece)):
        low, high, unit = _within_chunks(values)
        bounds += [low, high]
        units.append(unit)
    words = np.empty((len(piece), 4), "<u4")
    words[:, 0], words[:, 2] = _join(units[0], (11, 10, 11)), _join(units[1], (11, 10, 11))
    words[:, 1] = _rotation(piece.quaternions.numpy())
    words[:, 3] = _join(np.concatenate([units[2], opacities(piece)[:, None]], 1), (8, 8, 8, 8))
    return np.concatenate(bounds, 1).astype("<f4"), words


def _within_chunks(values: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest of each chunk [c, 3], and where between them each value lies, 0 .. 1."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = np.minimum.reduceat(values, starts, 0), np.maximum.reduceat(values, starts, 0)
    chunk = np.arange(len(values)) // CHUNK
    span = (high - low).astype(np.float64)
    return low, high, (values - low[chunk]) / np.where(span > 0, span, 1.0)[chunk]


def _join(units: np.ndarray, widths: tuple[int, ...]) -> UInt32[np.ndarray, " n"]:
    """Columns of 0 .. 1, each in so many bits, the first in the highest."""
    word = np.zeros(len(units), np.uint32)
    for column, width in enumerate(widths):
        most = (1 << width) - 1
        word = (word << np.uint32(width)) | np.clip(np.rint(units[:, column] * most), 0, most).astype(np.uint32)
    return word


def _rotation(quaternions: Float[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Which of w, x, y, z is largest, then the others in their order, 10 bits each."""
    largest, others = smallest_three(quaternions)
    small = others * np.sqrt(0.5) + 0.5
    return (largest.astype(np.uint32) << np.uint32(30)) | _join(small, (10, 10, 10))


class _HarmonicRounding:
    """Bytes for the coefficients of changing colors, channel by channel, as in a plain PLY.

    A byte stands for the middle of a step of 1/32: there is none for zero, and most coefficients are smaller than the
    least that there is, 1/64. The nearest byte would turn each into that, and what neighbors have in common would grow
    many times. So a Gaussian takes over what the one before it in the file, a neighbor in Morton order, was rounded
    too far: sums along the file are right within a step.
    """

    def __init__(self, coefficients: int) -> None:
        # Each begins at another place within a step, in no order, so that at any Gaussian about half are rounded up.
        self._over = (np.random.default_rng(0).permutation(coefficients) + 0.5) / max(coefficients, 1)

    def to_bytes(self, piece: Gaussians) -> UInt8[np.ndarray, "n c"]:
        """The bytes of the next Gaussians of the file."""
        wanted = piece.shN.numpy().transpose(0, 2, 1).reshape(len(piece), -1).astype(np.float64)
        steps = np.clip((wanted / SPAN + 0.5) * 256 - 0.5, 0, 255)
        sums = self._over + np.cumsum(steps, 0)
        whole = np.floor(np.concatenate([self._over[None], sums]))
        self._over = sums[-1] - whole[-1]
        return np.clip(np.diff(whole, axis=0), 0, 255).astype(np.uint8)


def is_compressed(header: PlyHeader) -> bool:
    """Whether a header is one of these."""
    return any(set(PACKED) <= set(element.layout.names or ()) for element in header.elements)


def compressed_ply_pieces(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a file, in the ground frame, at most `CHUNK_SIZE` at a time. Raises VdgsError for another or a
    damaged one."""
    header = read_ply_header(path)
    chunks, vertices = _rows_of(header, "chunk", EDGES), _rows_of(header, "vertex", PACKED)
    coefficients = _coefficients(header)
    harmonics = _rows_of(header, "sh", coefficients) if coefficients else None
    count = len(vertices)
    if count < 1 or len(chunks) != -(-count // CHUNK) or (harmonics is not None and len(harmonics) != count):
        raise VdgsError(
            f"{path}: its {len(chunks)} chunks are not those of {count} Gaussians. It is damaged; write it again."
        )
    if draws_antialiased(header):
        warn_antialiased(path)
    axes = axes_named(header.comment("axes "), Y_DOWN)
    bounds = _bounds(chunks)
    for first in range(0, count, CHUNK_SIZE):
        rows = slice(first, first + CHUNK_SIZE)
        chunk = np.arange(first, min(first + CHUNK_SIZE, count)) // CHUNK
        words = np.stack([vertices[name][rows] for name in PACKED], 1).astype(np.uint32)
        coded = np.zeros((len(words), 0), np.uint8)
        if harmonics is not None:
            coded = np.stack([harmonics[name][rows] for name in coefficients], 1)
        yield axes.to_ground(_unpacked(bounds[chunk], words, coded.reshape(len(words), 3, -1)))


def _coefficients(header: PlyHeader) -> tuple[str, ...]:
    """Names of the coefficients of changing colors, a byte each. Raises VdgsError for a number of no degree."""
    found = header.find("sh")
    kinds = [kind[0] for kind in (found[0].layout.fields or {}).values()] if found is not None else []
    if any(kind != np.uint8 for kind in kinds) or len(kinds) not in HARMONICS:
        raise VdgsError(
            f"{header.path}: its element 'sh' has {len(kinds)} properties, not {HARMONICS[1:]} bytes. Write it again."
        )
    return tuple(f"f_rest_{i}" for i in range(len(kinds)))


def _rows_of(header: PlyHeader, name: str, needs: Sequence[str]) -> np.ndarray:
    """The rows of an element, left on the disk. Raises VdgsError where it is not there, or not all of it."""
    path, found = header.path, header.find(name)
    missing = [each for each in needs if found is None or each not in (found[0].layout.names or ())]
    if found is None or missing or header.form == "ascii":
        what = f"{name} has no {missing[0]}" if missing else "it is text"
        raise VdgsError(f"{path}: is no compressed PLY of PlayCanvas ({what}). Write it again, or as a plain PLY.")
    element, start = found
    if path.stat().st_size < start + element.count * element.layout.itemsize:
        raise VdgsError(f"{path}: holds fewer Gaussians than it announces. It is truncated; write it again.")
    return np.memmap(path, element.layout, "r", start, element.count) if element.count else np.empty(0, element.layout)


def _bounds(chunks: np.ndarray) -> Float[np.ndarray, "c 6 3"]:
    """What `BOUNDS` names. Older files have none of the colors, which are then between 0 and 1."""
    held = chunks.dtype.names or ()
    columns = [chunks[name] if name in held else np.full(len(chunks), float(name.startswith("max"))) for name in BOUNDS]
    return np.stack(columns, 1).astype(np.float32).reshape(len(chunks), 6, 3)


def _unpacked(bounds: np.ndarray, words: np.ndarray, harmonics: np.ndarray) -> Gaussians:
    def between(units: np.ndarray, low: int) -> torch.Tensor:
        values = bounds[:, low] + units * (bounds[:, low + 1] - bounds[:, low])
        return torch.from_numpy(values.astype(np.float32))

    shown = _part(words[:, 3], (8, 8, 8, 8))
    rest = (harmonics.transpose(0, 2, 1).astype(np.float32) + np.float32(0.5)) / 256 - np.float32(0.5)
    return Gaussians(
        means=between(_part(words[:, 0], (11, 10, 11)), 0), log_scales=between(_part(words[:, 2], (11, 10, 11)), 2),
        quaternions=_quaternions(words[:, 1]), opacity_logits=logits_from_opacity(shown[:, 3]),
        sh0=rgb_to_sh(between(shown[:, :3], 4)), shN=torch.from_numpy(np.ascontiguousarray(rest * SPAN)),
    )  # fmt: skip


def _part(words: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    """The inverse of `_join`."""
    shifts = np.cumsum([0, *widths[:0:-1]])[::-1]
    pairs = zip(shifts, widths, strict=True)
    return np.stack([(words >> np.uint32(shift)) % (1 << width) / ((1 << width) - 1) for shift, width in pairs], 1)


def _quaternions(words: np.ndarray) -> torch.Tensor:
    small = (_part(words, (10, 10, 10)) - 0.5) * np.sqrt(2)
    largest = words >> np.uint32(30)
    found = np.empty((len(words), 4))
    np.put_along_axis(found, OTHER_PARTS[largest], small, 1)
    found[np.arange(len(words)), largest] = np.sqrt(np.maximum(0, 1 - (small**2).sum(1)))
    return torch.from_numpy(found.astype(np.float32))
