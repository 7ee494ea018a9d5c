"""Triangles that know what they are made of."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class Material(IntEnum):
    """What a triangle is made of; each has its shader in `facades`, `ground` or `nature`."""

    GROUND = 0
    PLASTER = 1
    WINDOWS = 2
    DOOR = 3
    OFFICE = 4
    TILES = 5
    SLATE = 6
    FLAT_ROOF = 7
    STONE = 8
    BRICK = 9
    TIMBER = 10
    PAINT = 11
    GLASS = 12
    AWNING = 13
    FOLIAGE = 14
    BARK = 15
    WATER = 16
    SOLAR = 17
    DARK = 18


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """A triangle soup with per-corner texture coordinates and normals (float32 unless said).

    vertices [v, 3] m; faces [f, 3] int32; material [f] uint8; colour [f, 3] linear albedo;
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


def srgb(code: str) -> np.ndarray:
    """A colour as people write it ("#c8a27a") to linear light, [3] float32."""
    value = np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length one."""
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


@dataclass(frozen=True)
class _Skins:
    """Materials, colours and seeds of many polygons or parts."""

    material: list[int]
    color: list[np.ndarray]
    seed: list[float]

    def add(self, material: Material, color: np.ndarray, seed: float) -> None:
        self.material.append(int(material))
        self.color.append(color)
        self.seed.append(seed)

    def repeated(self, counts: int | np.ndarray) -> dict[str, np.ndarray]:
        """One row per triangle, where polygon k has counts[k] of them."""
        return {
            "material": np.repeat(np.array(self.material, np.uint8), counts),
            "color": np.repeat(np.array(self.color, np.float32), counts, axis=0),
            "seed": np.repeat(np.array(self.seed, np.float32), counts),
        }


class MeshBuilder:
    """Collects polygons and ready-made parts, then joins them into one `Mesh`.

    Polygons are only noted when they are added and turned into triangles all at once: a town has tens
    of thousands of them.
    """

    def __init__(self) -> None:
        self._polygons: dict[int, tuple[list[np.ndarray], _Skins]] = {}
        self._parts: list[dict[str, np.ndarray]] = []
        self._part_skins = _Skins([], [], [])

    def polygon(self, corners: np.ndarray, material: Material, color: np.ndarray, seed: float = 0.0) -> None:
        """A planar convex polygon [k, 3], anticlockwise from outside.

        Its texture runs from the lowest coordinates, u along the first edge and v across it, in metres.
        """
        rings, skins = self._polygons.setdefault(len(corners), ([], _Skins([], [], [])))
        rings.append(corners)
        skins.add(material, color, seed)

    def part(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        material: Material,
        color: np.ndarray,
        seed: float,
        *,
        uv: np.ndarray,
        panel: np.ndarray,
        normals: np.ndarray,
    ) -> None:
        """A ready-made piece of one material.

        vertices [v, 3], faces [f, 3], uv [f, 3, 2], panel [2] or [f, 2], normals [f, 3, 3].
        """
        self._parts.append(
            {
                "vertices": np.asarray(vertices, np.float32),
                "faces": np.asarray(faces, np.int32),
                "uv": np.asarray(uv, np.float32),
                "panel": np.broadcast_to(np.asarray(panel, np.float32), (len(faces), 2)),
                "normals": np.asarray(normals, np.float32),
            }
        )
        self._part_skins.add(material, color, seed)

    def build(self) -> Mesh:
        """Everything collected so far as one mesh."""
        pieces = [_triangulated(np.array(rings), skins) for rings, skins in self._polygons.values()]
        if self._parts:
            joined = _joined(self._parts)
            pieces.append(joined | self._part_skins.repeated(np.array([len(p["faces"]) for p in self._parts])))
        return Mesh(**_joined(pieces))


def _triangulated(corners: np.ndarray, skins: _Skins) -> dict[str, np.ndarray]:
    """Polygons of equally many corners [n, k, 3] as fans of triangles (Newell's method for their normals)."""
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
        **skins.repeated(triangles),
    }


def _joined(pieces: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Pieces one after the other, the corners of their faces renumbered."""
    first = np.cumsum([0, *(len(piece["vertices"]) for piece in pieces)], dtype=np.int32)
    moved = [piece | {"faces": piece["faces"] + start} for piece, start in zip(pieces, first, strict=False)]
    return {name: np.ascontiguousarray(np.concatenate([p[name] for p in moved])) for name in moved[0]}
