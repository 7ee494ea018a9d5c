"""Points of a glTF file with its buffers beside it, as OPF projects have them: places, colors, and what shows them."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from vdgs.captures.formats.json_poses import read_capture_json
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.formats.source_capture import safe_name
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
#: glTF has y up; OPF's coordinates z.
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
#: The extension by which OPF says which camera shows which point.
_MATCHES = "OPF_mesh_primitive_matches"


@dataclass(frozen=True, eq=False)
class GltfPoints:
    """Points [n, 3] float64 and colors [n, 3] uint8; of each camera, by its number, the indices of the points that it
    shows [m], and where [m, 2] in pixels."""

    points: np.ndarray
    colors: np.ndarray
    shown: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


def join_points(clouds: list[GltfPoints]) -> GltfPoints:
    """All points of several files."""
    shown: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    first = 0
    for cloud in clouds:
        for camera, (numbers, pixels) in cloud.shown.items():
            shown.setdefault(camera, []).append((numbers + first, pixels))
        first += len(cloud.points)
    return GltfPoints(
        np.concatenate([np.zeros((0, 3)), *(cloud.points for cloud in clouds)]),
        np.concatenate([np.zeros((0, 3), np.uint8), *(cloud.colors for cloud in clouds)]),
        {
            camera: (np.concatenate([each for each, _ in parts]), np.concatenate([each for _, each in parts]))
            for camera, parts in shown.items()
        },
    )


def read_gltf_points(file: Path) -> GltfPoints:
    """The points of all nodes. Raises `CaptureError` for damaged files and buffers that are missing."""
    content = read_capture_json(file)
    found = []
    try:
        for node in content.get("nodes", []):
            if "mesh" not in node:
                continue
            matrix = np.reshape(node.get("matrix", np.eye(4)), (4, 4)).astype(np.float64).T
            for primitive in content["meshes"][node["mesh"]]["primitives"]:
                attributes = primitive["attributes"]
                points = _accessor(content, attributes["POSITION"], file).astype(np.float64)
                places = (points @ matrix[:3, :3].T + matrix[:3, 3]) @ _Z_UP.T
                colors = _colors(content, attributes.get("COLOR_0"), len(points), file)
                found.append(GltfPoints(places, colors, _shown(content, primitive, len(points), file)))
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise CaptureError(f"{file}: is no point cloud of OPF ({error!r}). Export the project again.") from None
    return join_points(found)


def _shown(
    content: JsonObject, primitive: JsonObject, count: int, file: Path
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """What each camera shows. Of a point the extension has a range in the list of sightings: its beginning in five
    bytes, its length in three."""
    matches = (primitive.get("extensions") or {}).get(_MATCHES)
    if matches is None or "imagePoints" not in matches:
        return {}
    ranges = _accessor(content, matches["pointIndexRanges"], file).astype(np.int64)
    cameras = _accessor(content, matches["cameraIds"], file)[:, 0].astype(np.int64)
    pixels = _accessor(content, matches["imagePoints"]["pixelCoordinates"], file).astype(np.float64)
    lengths, starts = ranges[:, 1] >> 8, ranges[:, 0] + ((ranges[:, 1] & 255) << 32)
    if len(ranges) != count or lengths.sum() > len(cameras) or pixels.shape != (len(cameras), 2):
        raise ValueError(f"{_MATCHES} is not of its points")
    before = np.cumsum(lengths) - lengths
    at = np.arange(lengths.sum()) + np.repeat(starts - before, lengths)
    points, cameras, pixels = np.repeat(np.arange(count), lengths), cameras[at], pixels[at]
    order = np.argsort(cameras, kind="stable")
    edges = np.searchsorted(cameras[order], np.arange(len(matches["cameraUids"]) + 1))
    parts = [order[first:last] for first, last in pairwise(edges)]
    return {
        uid if isinstance(uid, int) else int(str(uid), 0): (points[part], pixels[part])
        for uid, part in zip(matches["cameraUids"], parts, strict=True)
    }


def _colors(content: JsonObject, number: int | None, count: int, file: Path) -> np.ndarray:
    if number is None:
        return np.full((count, 3), GRAY, np.uint8)
    colors = _accessor(content, number, file)[:, :3]
    most = 1.0 if colors.dtype.kind == "f" else float(np.iinfo(colors.dtype).max)
    levels = colors.astype(np.float64) * (255 / most)
    return np.nan_to_num(levels, nan=GRAY).round().clip(0, 255).astype(np.uint8)


def _accessor(content: JsonObject, number: int, file: Path) -> np.ndarray:
    """The rows of an accessor [n, width]."""
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    name = safe_name(unquote(content["buffers"][view["buffer"]]["uri"]), file, "buffer")
    kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], int(accessor["count"])
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    stride = int(view.get("byteStride", 0)) or kind.itemsize * width
    buffer = file.parent / name
    need = start + (stride * (count - 1) + kind.itemsize * width if count else 0)
    try:
        size = buffer.stat().st_size
        if start < 0 or count < 0 or stride < kind.itemsize * width or size < need:
            raise CaptureError(f"{buffer}: has {size} bytes where {file.name} needs {need}. Copy or export it again.")
        with buffer.open("rb") as stream:
            stream.seek(start)
            raw = stream.read(need - start)
    except OSError as error:
        raise CaptureError(f"{buffer}: cannot be read ({error.strerror or error}). Copy the whole project.") from error
    return (
        np.ndarray((count, width), kind, raw, strides=(stride, kind.itemsize)) if count else np.zeros((0, width), kind)
    )
