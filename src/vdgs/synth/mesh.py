"""Triangles that know what they are made of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property

import numpy as np

#: What a triangle is made of; each has its shader in `facades` or `ground_texture`.
Material = IntEnum(
    "Material",
    "GROUND PLASTER WINDOWS DOOR OFFICE TILES SLATE FLAT_ROOF STONE BRICK TIMBER PAINT "
    "GLASS AWNING FOLIAGE BARK WATER SOLAR DARK",
    start=0,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """A triangle soup with per-corner texture coordinates and normals (float32 unless said).

    vertices [v, 3] m; faces [f, 3] int32; material [f] uint8; color [f, 3] linear albedo;
    seed [f] in [0, 1); uv [f, 3, 2] m; panel [f, 2]: extent of the polygon's uv, m; normals [f, 3, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    color: np.ndarray
    seed: np.ndarray
    uv: np.ndarray
    panel: np.ndarray
    normals: np.ndarray

    @cached_property
    def face_normals(self) -> np.ndarray:
        """Unit normals of the triangles by their corners, [f, 3]; 0 where a triangle has no area."""
        corners = self.vertices[self.faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + np.float32(1e-20))


def srgb(code: str) -> np.ndarray:
    """A color as people write it ("#c8a27a") to linear light, [3] float32."""
    value = np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length one."""
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


#: Material, color and seed of a polygon or part.
_Skin = tuple[Material, np.ndarray, float]


def join_meshes(first: Mesh, second: Mesh) -> Mesh:
    """Both as one; the triangles of the first keep their numbers."""
    return Mesh(**_join([{each.name: getattr(mesh, each.name) for each in fields(mesh)} for mesh in (first, second)]))


class MeshBuilder:
    """Collects polygons and ready-made parts, then joins them into one `Mesh`.

    Polygons become triangles all at once in `build`: a town has tens of thousands of them.
    """

    def __init__(self) -> None:
        self._polygons: dict[int, list[tuple[np.ndarray, _Skin]]] = defaultdict(list)
        self._parts: list[tuple[dict[str, np.ndarray], _Skin]] = []

    def polygon(self, corners: np.ndarray, material: Material, color: np.ndarray, seed: float = 0.0) -> None:
        """A planar convex polygon [k, 3], anticlockwise from outside.

        Its texture runs from the lowest coordinates, u along the first edge and v across it, in metres.
        """
        self._polygons[len(corners)].append((corners, (material, color, seed)))

    def part(
        self, vertices: np.ndarray, faces: np.ndarray, material: Material, color: np.ndarray, seed: float, *,
        uv: np.ndarray, panel: np.ndarray, normals: np.ndarray,
    ) -> None:  # fmt: skip
        """Triangles: vertices [v, 3], faces [f, 3], uv [f, 3, 2], panel [2] or [f, 2], normals [f, 3, 3]."""
        arrays = {"vertices": vertices, "uv": uv, "panel": np.broadcast_to(panel, (len(faces), 2)), "normals": normals}
        arrays = {name: np.asarray(value, np.float32) for name, value in arrays.items()}
        self._parts.append((arrays | {"faces": np.asarray(faces, np.int32)}, (material, color, seed)))

    def build(self) -> Mesh:
        """Everything collected so far as one mesh."""
        meshes = [_triangulate(*zip(*polygons, strict=True)) for polygons in self._polygons.values()]
        if self._parts:
            parts, skins = zip(*self._parts, strict=True)
            meshes.append(_join(parts) | _repeat_skins(skins, np.array([len(part["faces"]) for part in parts])))
        return Mesh(**_join(meshes))


def _repeat_skins(skins: Sequence[_Skin], counts: int | np.ndarray) -> dict[str, np.ndarray]:
    """One row per triangle, where polygon or part k has counts[k] triangles."""
    material, color, seed = zip(*skins, strict=True)
    return {
        "material": np.repeat(np.array(material, np.uint8), counts),
        "color": np.repeat(np.array(color, np.float32), counts, axis=0),
        "seed": np.repeat(np.array(seed, np.float32), counts),
    }


def _triangulate(polygons: Sequence[np.ndarray], skins: Sequence[_Skin]) -> dict[str, np.ndarray]:
    """Polygons of equally many corners [n, k, 3] as fans of triangles (Newell's method for their normals)."""
    corners = np.array(polygons)
    count, sides = corners.shape[:2]
    normal = _unit(np.cross(corners, np.roll(corners, -1, axis=1)).sum(1))
    along = _unit(corners[:, 1] - corners[:, 0])
    axes = np.stack([along, np.cross(normal, along)], axis=2)
    local = (corners - corners[:, :1]) @ axes
    local -= local.min(1, keepdims=True)
    step = np.arange(1, sides - 1)
    fan = np.stack([np.zeros_like(step), step, step + 1], axis=1)
    faces = (fan[None] + (np.arange(count) * sides)[:, None, None]).reshape(-1, 3)
    triangles = sides - 2
    return {
        "vertices": corners.reshape(-1, 3).astype(np.float32),
        "faces": faces.astype(np.int32),
        "uv": local[:, fan].reshape(-1, 3, 2).astype(np.float32),
        "panel": np.repeat(local.max(1), triangles, axis=0).astype(np.float32),
        "normals": np.repeat(np.repeat(normal, triangles, axis=0)[:, None], 3, axis=1).astype(np.float32),
        **_repeat_skins(skins, triangles),
    }


def _join(meshes: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Meshes one after the other, the corners of their faces renumbered."""
    first = np.cumsum([0, *(len(mesh["vertices"]) for mesh in meshes)], dtype=np.int32)
    moved = [mesh | {"faces": mesh["faces"] + start} for mesh, start in zip(meshes, first, strict=False)]
    return {name: np.ascontiguousarray(np.concatenate([mesh[name] for mesh in moved])) for name in moved[0]}
