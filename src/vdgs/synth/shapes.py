"""Simple solids in the local frame of a thing that stands somewhere and faces somewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.synth.mesh import Material, MeshBuilder


@dataclass(frozen=True)
class ObjectFrame:
    """Where a thing stands (m) and where it faces: local x to its right, y to its back, z up."""

    x: float
    y: float
    z: float
    angle: float

    def to_world(self, local: np.ndarray) -> np.ndarray:
        """Local points [..., 3] to the world."""
        local = np.asarray(local, np.float64)
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        x, y = local[..., 0], local[..., 1]
        return np.stack([self.x + cos * x - sin * y, self.y + sin * x + cos * y, self.z + local[..., 2]], -1)

    def child(self, x: float, y: float, z: float = 0.0, turn: float = 0.0) -> ObjectFrame:
        """The frame of a thing that stands at local (x, y, z), turned by `turn` radians."""
        px, py, pz = self.to_world(np.array([x, y, z]))
        return ObjectFrame(float(px), float(py), float(pz), self.angle + turn)


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in a frame, in metres."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    z1: float

    def corners(self, inset_x: float = 0.0, inset_y: float = 0.0) -> np.ndarray:
        """Bottom ring then top ring, each anticlockwise from the front left, [8, 3]; the top may be inset."""
        ring = [(self.x0, self.y0), (self.x1, self.y0), (self.x1, self.y1), (self.x0, self.y1)]
        signs = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
        bottom = [(x, y, self.z0) for x, y in ring]
        top = [(x + sx * inset_x, y + sy * inset_y, self.z1) for (x, y), (sx, sy) in zip(ring, signs, strict=True)]
        return np.array(bottom + top)


#: Which corners make the front, right, back, left side of a box.
SIDES = np.array([(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


@dataclass(frozen=True)
class SurfaceMaterial:
    """Material, linear color and seed of a surface."""

    material: Material
    color: np.ndarray
    seed: float = 0.0


def face(builder: MeshBuilder, frame: ObjectFrame, corners: np.ndarray, skin: SurfaceMaterial) -> None:
    """One planar polygon given in local coordinates."""
    builder.polygon(frame.to_world(corners), skin.material, skin.color, skin.seed)


def box(
    builder: MeshBuilder,
    frame: ObjectFrame,
    shape: Box,
    sides: SurfaceMaterial | tuple[SurfaceMaterial, SurfaceMaterial, SurfaceMaterial, SurfaceMaterial],
    top: SurfaceMaterial | None = None,
    inset: tuple[float, float] = (0.0, 0.0),
) -> None:
    """A box without a bottom; `inset` pulls the top edges in (x, y), `top` None leaves it open."""
    corners = frame.to_world(shape.corners(*inset))
    skins = sides if isinstance(sides, tuple) else (sides,) * 4
    for ring, skin in zip(corners[SIDES], skins, strict=True):
        builder.polygon(ring, skin.material, skin.color, skin.seed)
    if top is not None:
        builder.polygon(corners[4:], top.material, top.color, top.seed)


def frustum(
    builder: MeshBuilder,
    frame: ObjectFrame,
    radii: tuple[float, float],
    heights: tuple[float, float],
    skin: SurfaceMaterial,
    cap: SurfaceMaterial | None = None,
    sides: int = 16,
) -> None:
    """A round (or many-sided) wall from radius to radius; a second radius near zero makes a cone."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False) + np.pi / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    low = np.column_stack([ring * radii[0], np.full(sides, heights[0])])
    high = np.column_stack([ring * max(radii[1], 1e-3), np.full(sides, heights[1])])
    low, high = frame.to_world(low), frame.to_world(high)
    for quad in np.stack([low, np.roll(low, -1, 0), np.roll(high, -1, 0), high], axis=1):
        builder.polygon(quad, skin.material, skin.color, skin.seed)
    if cap is not None:
        builder.polygon(high, cap.material, cap.color, cap.seed)
