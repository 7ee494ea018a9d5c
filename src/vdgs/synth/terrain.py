"""The lie of the land: gentle under the town, hills beyond it, a hollow for every pond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.synth.mesh import Material, MeshBuilder

#: How far the land goes on beyond the town, as a multiple of its half extent.
_REACH = 40.0


@dataclass(frozen=True)
class Pond:
    """An elliptic pond: center and half axes (m), level of its water (m)."""

    x: float
    y: float
    rx: float
    ry: float
    level: float

    def distance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Roughly how far outside its wobbly shore a place is, in metres (negative: in the water)."""
        dx, dy = (x - self.x) / self.rx, (y - self.y) / self.ry
        wobble = 0.09 * np.sin(3 * np.arctan2(dy, dx) + self.x) + 0.05 * np.sin(5 * np.arctan2(dy, dx) + self.y)
        return (np.hypot(dx, dy) - 1 - wobble) * min(self.rx, self.ry)


@dataclass(frozen=True)
class Terrain:
    """A smooth height field over the plane."""

    half_extent: float
    phases: tuple[float, ...]
    ponds: tuple[Pond, ...] = ()

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height of the ground in metres at world x, y [n]."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        z = self.height_without_ponds(x, y)
        for pond in self.ponds:
            away = pond.distance(x, y)
            bank = np.clip((away + 1.5) / 5.0, 0, 1)
            bank = bank * bank * (3 - 2 * bank)
            z = bank * z + (1 - bank) * (pond.level - 0.9)
        return z

    def height_without_ponds(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The height before any pond was dug."""
        a, b, c, d = self.phases
        gentle = 0.9 * np.sin(x / 41 + a) * np.cos(y / 53 + b) + 0.7 * np.sin(y / 37 + c)
        away = np.hypot(x, y) / self.half_extent
        rise = np.clip((away - 1.8) / 6.0, 0, 1)
        rise = rise * rise * (3 - 2 * rise)
        span = 2.2 * self.half_extent
        hills = np.sin(x / span + d) * np.cos(y / span + a) + 0.5 * np.sin((x + y) / (0.6 * span) + b) + 0.6
        return gentle + rise * 14.0 * hills

    def add_to(self, builder: MeshBuilder) -> None:
        """The ground as a grid: 1.6 m under the town (2 m where that is wide), ever coarser towards the horizon."""
        reach, step = (1.5, 1.6) if len(self.ponds) < 2 else (1.9, 2.0)  # a lake lies further out than the town
        inner = np.arange(0, reach * self.half_extent, step)
        outer = inner[-1] * np.geomspace(1, _REACH / reach, 60)[1:]
        axis = np.concatenate([-outer[::-1], -inner[:0:-1], inner, outer])
        x, y = np.meshgrid(axis, axis)
        z = self.height(x, y)
        step = 0.4
        slope_x = (self.height(x - step, y) - self.height(x + step, y)) / (2 * step)
        slope_y = (self.height(x, y - step) - self.height(x, y + step)) / (2 * step)
        normal = np.stack([slope_x, slope_y, np.ones_like(x)], -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        side = len(axis)
        corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
        far = corner + side + 1
        faces = np.concatenate([np.stack([corner, corner + 1, far], 1), np.stack([corner, far, corner + side], 1)])
        vertices = np.stack([x, y, z], -1).reshape(-1, 3)
        builder.part(
            vertices, faces, Material.GROUND, np.zeros(3), 0.0,
            uv=vertices[faces][..., :2], panel=np.zeros(2), normals=normal.reshape(-1, 3)[faces],
        )  # fmt: skip
        for pond in self.ponds:
            _add_water(builder, pond)


def _add_water(builder: MeshBuilder, pond: Pond) -> None:
    """A flat sheet at the pond's level; the ground around it hides its rim."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    x, y = pond.x + 1.4 * pond.rx * np.cos(angle), pond.y + 1.4 * pond.ry * np.sin(angle)
    ring = np.stack([x, y, np.full(24, pond.level)], 1)
    builder.polygon(ring, Material.WATER, np.array([0.05, 0.13, 0.15]))
