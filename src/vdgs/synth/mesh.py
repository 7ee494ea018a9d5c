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


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle soup with per-corner texture coordinates and normals (float32 unless said).

    vertices [v, 3] m; faces [f, 3] int32; material [f] uint8; colour [f, 3] linear albedo;
    seed [f] in [0, 1); uv [f, 3, 2] m; panel [f, 2]: extent of the polygon's uv, m; normals [f, 3, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray
    material: np.ndarray
    colour: np.ndarray
    seed: np.ndarray
    uv: np.ndarray
    panel: np.ndarray
    normals: np.ndarray


def srgb(code: str) -> np.ndarray:
    """A colour as people write it ("#c8a27a") to linear light, [3] float32."""
    value = np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _newell(corners: np.ndarray) -> np.ndarray:
    """Unit normal of a planar polygon [k, 3], by Newell's method."""
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners, following).sum(0)
    return normal / (np.linalg.norm(normal) + 1e-12)


class MeshBuilder:
    """Collects polygons and ready-made parts, then joins them into one `Mesh`."""

    def __init__(self) -> None:
        self._parts: list[dict[str, np.ndarray]] = []

    def polygon(self, corners: np.ndarray, material: Material, colour: np.ndarray, seed: float = 0.0) -> None:
        """A planar convex polygon [k, 3], anticlockwise from outside.

        Its texture runs from the lowest coordinates, u along the first edge and v across it, in metres.
        """
        corners = np.asarray(corners, np.float64)
        normal = _newell(corners)
        along = corners[1] - corners[0]
        along /= np.linalg.norm(along)
        local = (corners - corners[0]) @ np.stack([along, np.cross(normal, along)], axis=1)
        local -= local.min(0)
        fan = np.arange(1, len(corners) - 1)
        faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
        count = len(faces)
        self.part(
            corners, faces, material, colour, seed,
            uv=local[faces], panel=local.max(0), normals=np.broadcast_to(normal, (count, 3, 3)),
        )  # fmt: skip

    def part(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        material: Material,
        colour: np.ndarray,
        seed: float,
        *,
        uv: np.ndarray,
        panel: np.ndarray,
        normals: np.ndarray,
    ) -> None:
        """A ready-made piece: vertices [v, 3], faces [f, 3], one material, uv [f, 3, 2], normals [f, 3, 3]."""
        count = len(faces)
        self._parts.append(
            {
                "vertices": np.asarray(vertices, np.float32),
                "faces": np.asarray(faces, np.int32),
                "material": np.full(count, int(material), np.uint8),
                "colour": np.broadcast_to(np.asarray(colour, np.float32), (count, 3)),
                "seed": np.full(count, seed, np.float32),
                "uv": np.asarray(uv, np.float32),
                "panel": np.broadcast_to(np.asarray(panel, np.float32), (count, 2)),
                "normals": np.asarray(normals, np.float32),
            }
        )

    def build(self) -> Mesh:
        """Everything collected so far as one mesh."""
        first = np.cumsum([0, *(len(part["vertices"]) for part in self._parts)])
        faces = [part["faces"] + start for part, start in zip(self._parts, first, strict=False)]
        joined = {
            name: np.ascontiguousarray(np.concatenate([part[name] for part in self._parts]))
            for name in self._parts[0]
            if name != "faces"
        }
        return Mesh(faces=np.concatenate(faces).astype(np.int32), **joined)
