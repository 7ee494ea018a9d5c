"""glTF: one GLB of points that viewers with KHR_gaussian_splatting draw as Gaussians, and others as colored points.

Every number of a Gaussian is kept as float32. glTF's y is up: positions, rotations and spherical harmonics are turned
there. The second kind, `spz_glb`, holds an SPZ in their place (KHR_gaussian_splatting_compression_spz_2): what 3D Tiles
need.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import (
    ExportMetadata,
    ExportScene,
    base_colors,
    gaussian_scales,
    opacities,
)
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_atomic, write_values
from vdgs.system.documents import JsonObject

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
GL_FLOAT, GL_UNSIGNED_BYTE, GL_UNSIGNED_SHORT = 5126, 5121, 5123
#: Bytes of a number; whole ones stand for 0 to 1.
COMPONENT_BYTES = {GL_FLOAT: 4, GL_UNSIGNED_BYTE: 1, GL_UNSIGNED_SHORT: 2}
#: Lengths in a GLB are of 32 bits.
MAX_LENGTH = 2**32 - 1
#: What the JSON grows by at most once the bounds of the positions are known.
JSON_SLACK_BYTES = 256


@dataclass(frozen=True)
class VertexAttribute:
    """One attribute of all Gaussians, in one piece."""

    name: str
    accessor_type: str
    component: int
    width: int

    @property
    def bytes_per_gaussian(self) -> int:
        return self.width * COMPONENT_BYTES[self.component]

    def accessor(self, count: int) -> JsonObject:
        normalized = {} if self.component == GL_FLOAT else {"normalized": True}
        return {"componentType": self.component, "count": count, "type": self.accessor_type, **normalized}


def vertex_attributes(degree: int) -> list[VertexAttribute]:
    """The columns of the uncompressed kind."""
    bands = [(band, index) for band in range(degree + 1) for index in range(2 * band + 1)]
    return [
        VertexAttribute("POSITION", "VEC3", GL_FLOAT, 3),
        VertexAttribute("COLOR_0", "VEC4", GL_UNSIGNED_SHORT, 4),
        VertexAttribute(f"{EXTENSION}:ROTATION", "VEC4", GL_FLOAT, 4),
        VertexAttribute(f"{EXTENSION}:SCALE", "VEC3", GL_FLOAT, 3),
        VertexAttribute(f"{EXTENSION}:OPACITY", "SCALAR", GL_FLOAT, 1),
        *(VertexAttribute(f"{EXTENSION}:SH_DEGREE_{band}_COEF_{index}", "VEC3", GL_FLOAT, 3) for band, index in bands),
    ]


def gaussian_bytes(scene: ExportScene) -> int:
    """Bytes of the Gaussians in a GLB."""
    return scene.count * sum(column.bytes_per_gaussian for column in vertex_attributes(scene.degree))


def check_glb_size(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where a GLB cannot hold so many Gaussians."""
    if gaussian_bytes(scene) + (1 << 16) > MAX_LENGTH:
        raise VdgsError(
            f"{path}: {scene.count} Gaussians take {gaussian_bytes(scene) / 2**30:.1f} GiB as glTF, "
            "and a GLB holds 4 GiB. "
            "Write 3D Tiles (a file named tileset.json) or .spz, or fewer Gaussians."
        )


def write_glb(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the scene, atomically; loses nothing. Raises VdgsError."""
    check_glb_size(path, scene)
    wanted = vertex_attributes(scene.degree)
    starts = np.cumsum([0, *(column.bytes_per_gaussian * scene.count for column in wanted)]).tolist()

    def write(temporary: Path) -> None:
        low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        room = len(_json(_document(wanted, scene, starts, np.zeros(3), np.zeros(3)))) + JSON_SLACK_BYTES
        data, done = 12 + 8 + (room + 3) // 4 * 4 + 8, 0
        with temporary.open("wb") as file:
            for piece in scene.pieces(Y_UP):
                low, high = np.minimum(low, piece.means.numpy().min(0)), np.maximum(high, piece.means.numpy().max(0))
                for column, start, values in zip(wanted, starts[:-1], _values(piece), strict=True):
                    file.seek(data + start + done * column.bytes_per_gaussian)
                    write_values(file, values)
                done += len(piece)
            file.seek(0)
            described = _json(_document(wanted, scene, starts, low, high)).ljust((room + 3) // 4 * 4)
            _frame(file, described, starts[-1])

    write_atomic(path, write)
    return ()


def _values(piece: Gaussians) -> Iterator[np.ndarray]:
    """The numbers of the columns, in their order."""
    yield piece.means.numpy()
    shown = np.concatenate([_linear(base_colors(piece).clip(0, 1)), opacities(piece)[:, None]], 1)
    yield np.rint(shown * 65535).astype(np.uint16)
    yield piece.quaternions.numpy()[:, [1, 2, 3, 0]]
    yield gaussian_scales(piece)
    yield opacities(piece)
    yield piece.sh0.numpy()
    for index in range(piece.shN.shape[1]):
        yield np.ascontiguousarray(piece.shN[:, index].numpy())


def _linear(values: np.ndarray) -> np.ndarray:
    """Light of sRGB values in 0 .. 1. COLOR_0 is linear in all of glTF, whatever the space of the harmonics; it has 16
    bits, for 8 would round dark colors far."""
    light: np.ndarray = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return light


def _document(
    wanted: list[VertexAttribute], scene: ExportScene, starts: list[int], low: np.ndarray, high: np.ndarray
) -> JsonObject:
    accessors = [{"bufferView": index, **column.accessor(scene.count)} for index, column in enumerate(wanted)]
    accessors[0] |= {"min": [float(x) for x in low], "max": [float(x) for x in high]}
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": column.bytes_per_gaussian * scene.count, "target": 34962}
        for column, start in zip(wanted, starts[:-1], strict=True)
    ]
    splatting = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
                 "sortingMethod": "cameraDistance"}  # fmt: skip
    names = {column.name: index for index, column in enumerate(wanted)}
    return {
        "asset": asset_json(scene.metadata), "extensionsUsed": [EXTENSION],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": names, "extensions": {EXTENSION: splatting}}]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip


def asset_json(metadata: ExportMetadata) -> JsonObject:
    """glTF's and 3D Tiles' word on where a file comes from."""
    axes = Y_UP.words(metadata.has_compass)
    return {"version": "2.0", "generator": metadata.program, "extras": {**metadata.to_dict(), "axes": axes}}


def spz_glb(gaussians: Gaussians, spz: bytes, translation: np.ndarray, metadata: ExportMetadata) -> bytes:
    """A GLB around an SPZ of the same Gaussians (y up), moved by `translation` [3] (y up) to their place.

    The node says so by a `matrix`: CesiumJS (1.140 to 1.145) reads nothing else of the node of a splat, and stops at a
    `translation` (CesiumGS/cesium#12682). The attributes name what the SPZ yields, without data of their own. Degree 0
    and opacity are not among them: they are COLOR_0, and CesiumJS tells the degree by the number of attributes.
    """
    count = len(gaussians)
    columns = [
        VertexAttribute("POSITION", "VEC3", GL_FLOAT, 3),
        VertexAttribute("COLOR_0", "VEC4", GL_UNSIGNED_BYTE, 4),
        VertexAttribute(f"{EXTENSION}:SCALE", "VEC3", GL_FLOAT, 3),
        VertexAttribute(f"{EXTENSION}:ROTATION", "VEC4", GL_FLOAT, 4),
        *vertex_attributes(gaussians.sh_degree)[6:],
    ]
    accessors = [column.accessor(count) for column in columns]
    means = gaussians.means.numpy()
    accessors[0] |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
    splatting = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "extensions": {SPZ_EXTENSION: {"bufferView": 0}},
    }
    names = {column.name: index for index, column in enumerate(columns)}
    described = _json({
        "asset": {"version": "2.0", "generator": metadata.program},
        "extensionsUsed": [EXTENSION, SPZ_EXTENSION], "extensionsRequired": [EXTENSION, SPZ_EXTENSION],
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *(float(x) for x in translation), 1]}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": names, "extensions": {EXTENSION: splatting}}]}],
        "accessors": accessors, "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(spz)}],
        "buffers": [{"byteLength": len(spz)}],
    })  # fmt: skip
    text, data = described.ljust(-(-len(described) // 4) * 4), spz.ljust(-(-len(spz) // 4) * 4, b"\0")
    return _heads(len(text), len(data))[0] + text + _heads(len(text), len(data))[1] + data


def _json(document: JsonObject) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode("ascii")


def _frame(file: IO[bytes], described: bytes, size: int) -> None:
    """The two heads and the JSON of a GLB whose data are of a size that four divides."""
    first, second = _heads(len(described), size)
    file.write(first + described + second)


def _heads(text: int, data: int) -> tuple[bytes, bytes]:
    whole = 12 + 8 + text + 8 + data
    return struct.pack("<4sIIII", b"glTF", 2, whole, text, 0x4E4F534A), struct.pack("<II", data, 0x004E4942)
