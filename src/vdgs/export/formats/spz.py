"""SPZ: a sixth of a PLY and less, in fixed point, compressed (Niantic's format, versions 2, 3 and 4).

Positions have 24 bits, 12 of them after the point: steps of 0.24 mm, within ±2048 m, beyond which other programs wrap
around silently; here it is an error. y is up (right, up, back). Version 3 keeps rotations finer than version 2, which
the extension of glTF asks for. Both are one gzip stream. Version 4 holds what version 3 does in a zstd frame for each
quantity, behind 32 bytes of head and a table of their sizes; few programs read it yet (Niantic's own code from 2026).
"""

from __future__ import annotations

import importlib.util
import math
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
import torch

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Y_UP, axes_beside, in_ground
from vdgs.export.formats.export_scene import (
    CHUNK_SIZE,
    ExportScene,
    logits_from_opacity,
    opacities,
    to_uint8,
    write_metadata_file,
)
from vdgs.export.formats.foreign_gaussians import warn_antialiased
from vdgs.export.formats.parallel_gzip import gzip_blocks
from vdgs.export.formats.quaternion_canonical import canonicalize_quaternions
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, num_sh_bases
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic, write_values
from vdgs.system.scratch import scratch_folder

MAGIC = 0x5053474E
HEADER_STRUCT = struct.Struct("<IIIBBBB")
#: Version 4: the same, then flags, the number of streams, where the table of their sizes begins, and twelve zeros.
HEADER_4, SIZES = struct.Struct("<IIIBBBBI12x"), struct.Struct("<QQ")
#: What is quantised deflates hardly better at higher levels of zstd (1 .. 22).
ZSTD_LEVEL = 9
#: Flags of the header: how the Gaussians are to be drawn, and that something follows them.
ANTIALIASED, HAS_EXTENSIONS = 1, 2
FRACTION_BITS = 12
#: Positions lie below this many units from the origin.
MAX_COORDINATE = 2**23 / 2**FRACTION_BITS
#: For long Niantic's reader opened no more Gaussians than this; programs that have it from then still refuse them.
MAX_READABLE_POINTS = 10_000_000
COLOR_SCALE = 0.15
#: Columns in the order of the file.
COLUMN_NAMES = ("positions", "alphas", "colors", "scales", "rotations", "harmonics")
READ_BLOCK_BYTES = 1 << 22
#: What the file loses of every scene.
ROUNDING_NOTE = "positions are rounded to 0.24 mm, colors and shapes to bytes"
#: What a byte cannot hold, and what became of it.
CLAMP_NOTES = {
    "large": "Gaussians are larger than 377 units and were cut to that",
    "thin": "Gaussians are thinner than 0.00005 units and became as thick as that, which nobody sees",
    "colors": "colors lay far outside of 0 .. 1 and were cut off",
}


def check_range(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where it is known beforehand that positions do not fit, or a package is missing."""
    if scene.spz_version == 4 and importlib.util.find_spec("zstandard") is None:
        raise VdgsError(f"{path}: version 4 needs zstandard, not installed. Install it: pip install zstandard")
    if scene.bounds is not None and (far := float(np.abs(np.array(scene.bounds)).max())) >= MAX_COORDINATE:
        raise _too_far(path, far)


def write_spz(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the scene, atomically, and its facts beside it. Returns what was lost. Raises VdgsError.

    The file holds one quantity after the other: they wait in temporary files beside it, so memory stays small.
    """
    check_range(path, scene)
    cut, axes, version = dict.fromkeys(CLAMP_NOTES, 0), scene.axes or Y_UP, scene.spz_version

    def write(temporary: Path) -> None:
        with scratch_folder(path) as folder:
            spools = {name: (folder / name).open("w+b") for name in COLUMN_NAMES}
            try:
                for piece in scene.pieces(axes):
                    far = float(piece.means.abs().max())
                    if far >= MAX_COORDINATE - 1 / 2**FRACTION_BITS:
                        raise _too_far(path, far)
                    for name, count in _count_clamped(piece).items():
                        cut[name] += count
                    for name, column in zip(COLUMN_NAMES, encode_columns(piece, version), strict=True):
                        write_values(spools[name], column)
                with temporary.open("wb") as file:
                    if version == 4:
                        _write_streams(file, scene, spools)
                        return
                    head = encode_header(scene.count, scene.degree, version, flags=_flags(scene))
                    for part in gzip_blocks(_stream(head, spools)):
                        file.write(part)
            finally:
                for spool in spools.values():
                    spool.close()

    write_atomic(path, write)
    write_metadata_file(path, scene.metadata, axes)
    notes = [
        ROUNDING_NOTE,
        *(f"{cut[name]} of {scene.count} {what}" for name, what in CLAMP_NOTES.items() if cut[name]),
    ]
    if scene.count > MAX_READABLE_POINTS:
        notes.append(
            f"holds {scene.count:,} Gaussians, and many programs open no SPZ of more than {MAX_READABLE_POINTS:,}. For "
            f"those, write fewer (--max-gaussians {MAX_READABLE_POINTS}) or tileset.json"
        )
    return tuple(notes)


def encode_header(count: int, degree: int, version: int, fraction: int = FRACTION_BITS, flags: int = 0) -> bytes:
    """The head of a file whose positions have `fraction` bits after the point."""
    return HEADER_STRUCT.pack(MAGIC, version, count, degree, fraction, flags, 0)


def _flags(scene: ExportScene) -> int:
    return ANTIALIASED if scene.antialiased else 0


def encode_columns(piece: Gaussians, version: int, fraction: int = FRACTION_BITS) -> tuple[np.ndarray, ...]:
    """The bytes of Gaussians whose y is up, a uint8 array [n, bytes] for each of `COLUMN_NAMES`."""
    n = len(piece)
    if version < 3:
        piece = canonicalize_quaternions(piece)
    fixed = np.rint(piece.means.double().numpy() * 2**fraction).astype("<i4")
    positions = np.ascontiguousarray(fixed).view(np.uint8).reshape(n, 3, 4)[:, :, :3].reshape(n, 9)
    colors = to_uint8(piece.sh0.numpy() * COLOR_SCALE + 0.5)
    scales = np.clip(np.rint((piece.log_scales.numpy() + 10) * 16), 0, 255).astype(np.uint8)
    rotations = (_pack_quaternions_v3 if version >= 3 else _pack_quaternions_v2)(piece.quaternions.numpy())
    return positions, to_uint8(opacities(piece)[:, None]), colors, scales, rotations, _harmonics(piece.shN.numpy())


def encode_spz(gaussians: Gaussians, version: int) -> bytes:
    """A whole file, gzipped, of Gaussians in memory whose y is up.

    Where they reach farther than 2048 units, positions have fewer bits after the point; the file says how many.
    """
    reach = float(gaussians.means.abs().max()) + 1 / 2**FRACTION_BITS
    fraction = max(0, min(FRACTION_BITS, math.floor(math.log2(2**23 / reach))))
    parts = [encode_header(len(gaussians), gaussians.sh_degree, version, fraction)]
    parts += [column.tobytes() for column in encode_columns(gaussians, version, fraction)]
    return b"".join(gzip_blocks(parts))


def _write_streams(file: IO[bytes], scene: ExportScene, spools: Mapping[str, IO[bytes]]) -> None:
    """Version 4: head, sizes of the streams before and after compression, streams. What is empty is no stream."""
    import zstandard

    filled = [spool for spool in spools.values() if spool.seek(0, 2)]
    head = HEADER_4.pack(MAGIC, 4, scene.count, scene.degree, FRACTION_BITS, _flags(scene), len(filled), HEADER_4.size)
    file.write(head + bytes(SIZES.size * len(filled)))
    sizes = b""
    for spool in filled:
        whole = spool.tell()
        spool.seek(0)
        _, packed = zstandard.ZstdCompressor(level=ZSTD_LEVEL).copy_stream(spool, file, size=whole)
        sizes += SIZES.pack(packed, whole)
    file.seek(HEADER_4.size)
    file.write(sizes)


def _stream(first: bytes, columns: Mapping[str, IO[bytes]]) -> Iterator[bytes]:
    yield first
    for spool in columns.values():
        spool.seek(0)
        while piece := spool.read(READ_BLOCK_BYTES):
            yield piece


def _count_clamped(piece: Gaussians) -> dict[str, int]:
    """How many Gaussians have sizes or colors that bytes cannot hold, as in `CLAMP_NOTES`."""
    scales = (piece.log_scales + 10) * 16
    shown = piece.sh0 * COLOR_SCALE + 0.5
    return {
        "large": int((scales > 255.5).any(1).sum()),
        "thin": int((scales < -0.5).any(1).sum()),
        "colors": int(((shown < -0.002) | (shown > 1.002)).any(1).sum()),
    }


def _harmonics(rest: np.ndarray) -> np.ndarray:
    n, r, _ = rest.shape
    # All eight bits: Niantic's writer keeps five of the first band and four of the others, for smaller files, and takes
    # nearly all change with the direction away from scenes whose coefficients are small (docs/export.md). The middle of
    # the bytes, 128, is a value of its own: what is zero stays zero.
    coded = np.rint(rest * np.float32(128)) + 128
    return np.clip(coded, 0, 255).astype(np.uint8).reshape(n, 3 * r)


def _pack_quaternions_v2(quaternions: np.ndarray) -> np.ndarray:
    """Version 2: x, y, z of the rotation with w >= 0."""
    signed = np.where(quaternions[:, :1] < 0, -quaternions, quaternions)[:, 1:]
    return np.clip(np.rint(signed * 127.5 + 127.5), 0, 255).astype(np.uint8)


def _pack_quaternions_v3(quaternions: np.ndarray) -> np.ndarray:
    """Version 3: which of x, y, z, w is largest, and sign and size of the others in 1 + 9 bits each."""
    q = quaternions[:, [1, 2, 3, 0]]
    rows = np.arange(len(q))
    largest = np.abs(q).argmax(1)
    negate = q[rows, largest] < 0
    packed = largest.astype(np.uint32)
    for part in range(4):
        size = np.minimum(np.rint(np.abs(q[:, part]) * np.sqrt(2) * 511), 511).astype(np.uint32)
        added = (packed << np.uint32(10)) | (((q[:, part] < 0) ^ negate).astype(np.uint32) << np.uint32(9)) | size
        packed = np.where(largest == part, packed, added)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def read_spz_chunks(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a file of version 2, 3 or 4, in the ground frame, at most `CHUNK_SIZE` at a time, but all of its
    bytes in memory, 64 for each. Raises VdgsError if it is damaged or another."""
    try:
        packed = path.read_bytes()
        data = _of_streams(packed, path) if packed[:4] == struct.pack("<I", MAGIC) else zlib.decompress(packed, 31)
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except zlib.error as error:
        raise VdgsError(f"{path}: is no SPZ of versions 2 to 4, or damaged ({error}). Write it again.") from None
    yield from in_ground(decode_spz(data, path), axes_beside(path, Y_UP))


def _of_streams(packed: bytes, path: Path) -> bytes:
    """A file of version 4 as one of version 3, inflated. Raises VdgsError if it is damaged or another."""
    import zstandard

    try:
        _, version, count, degree, fraction, flags, streams, table = HEADER_4.unpack_from(packed)
        if version != 4:
            raise ValueError(f"its version is {version}")
        parts = [HEADER_STRUCT.pack(MAGIC, 3, count, degree, fraction, flags, 0)]
        start = table + streams * SIZES.size
        for index in range(streams):
            size, whole = SIZES.unpack_from(packed, table + index * SIZES.size)
            parts.append(zstandard.ZstdDecompressor().decompress(packed[start : start + size], whole))
            start += size
    except (struct.error, ValueError, zstandard.ZstdError) as error:
        raise VdgsError(f"{path}: is no SPZ of versions 2 to 4, or damaged ({error}). Write it again.") from None
    return b"".join(parts)


def decode_spz(data: bytes, path: Path) -> Iterator[Gaussians]:
    """Gaussians, y up, of an inflated file; `path` is for what is said of a damaged one (VdgsError)."""
    if (
        len(data) < HEADER_STRUCT.size
        or (fields := HEADER_STRUCT.unpack_from(data))[0] != MAGIC
        or fields[1] not in (2, 3)
    ):
        raise VdgsError(f"{path}: is no SPZ of versions 2 to 4.")
    _, version, n, degree, fraction, flags, _ = fields
    if degree > MAX_SH_DEGREE:
        raise VdgsError(
            f"{path}: has spherical harmonics of degree {degree}, and vdgs reads those up to {MAX_SH_DEGREE}. Write it "
            "with fewer."
        )
    rest = num_sh_bases(degree) - 1
    widths = (9, 1, 3, 3, 4 if version == 3 else 3, 3 * rest)
    whole = HEADER_STRUCT.size + n * sum(widths)
    if len(data) < whole or (len(data) > whole and not flags & HAS_EXTENSIONS):  # extensions follow the Gaussians
        raise VdgsError(f"{path}: is shorter or longer than its {n} Gaussians. It is damaged; write it again.")
    if flags & ANTIALIASED:
        warn_antialiased(path)
    parts, start = [], HEADER_STRUCT.size
    for width in widths:
        parts.append(np.frombuffer(data, np.uint8, n * width, start).reshape(n, width))
        start += n * width
    for first in range(0, max(n, 1), CHUNK_SIZE):
        yield _gaussians([part[first : first + CHUNK_SIZE] for part in parts], version, fraction)


def _gaussians(parts: Sequence[np.ndarray], version: int, fraction: int) -> Gaussians:
    positions, alphas, colors, scales, rotations, harmonics = parts
    n = len(positions)
    whole = np.zeros((n, 3, 4), np.uint8)
    whole[:, :, 1:] = positions.reshape(n, 3, 3)  # in the upper three bytes, so that the shift back carries the sign
    means = (whole.view("<i4")[:, :, 0] >> 8) / 2.0**fraction
    quaternions = (_quaternions_v3 if version == 3 else _quaternions_v2)(rotations)
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        log_scales=torch.from_numpy(scales / np.float32(16) - 10),
        quaternions=torch.from_numpy(quaternions.astype(np.float32)),
        opacity_logits=logits_from_opacity(alphas[:, 0] / np.float32(255)),
        sh0=torch.from_numpy((colors / np.float32(255) - np.float32(0.5)) / np.float32(COLOR_SCALE)),
        shN=torch.from_numpy((harmonics.reshape(n, harmonics.shape[1] // 3, 3).astype(np.float32) - 128) / 128),
    )


def _quaternions_v2(coded: np.ndarray) -> np.ndarray:
    xyz = coded / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], 1)


def _quaternions_v3(coded: np.ndarray) -> np.ndarray:
    packed = np.ascontiguousarray(coded).view("<u4")[:, 0]
    largest = packed >> np.uint32(30)
    q = np.zeros((len(packed), 4))
    for part in range(3, -1, -1):
        here = largest != part
        size = (packed & np.uint32(511)) / 511 / np.sqrt(2)
        q[:, part] = np.where(here, np.where(packed & np.uint32(512), -size, size), 0)
        packed = np.where(here, packed >> np.uint32(10), packed)
    q[np.arange(len(q)), largest] = np.sqrt(np.maximum(0, 1 - (q**2).sum(1)))
    return q[:, [3, 0, 1, 2]]


def _too_far(path: Path, far: float) -> VdgsError:
    return VdgsError(
        f"{path}: a Gaussian lies {far:.0f} m from the origin, and SPZ holds positions only within "
        f"{MAX_COORDINATE:.0f} m. "
        "Write a part of the scene or move its origin into its middle; or choose tileset.json, .glb or .ply, which "
        "hold any extent."
    )
