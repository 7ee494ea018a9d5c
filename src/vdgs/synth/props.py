"""What stands about in a town: cars, market stalls, a fountain, lamps, benches, swings, bales of straw."""

from __future__ import annotations

import numpy as np

from vdgs.synth import palette
from vdgs.synth.mesh import Material, MeshBuilder
from vdgs.synth.shapes import Box, ObjectFrame, SurfaceMaterial, box, face, frustum

_DARK = SurfaceMaterial(Material.DARK, palette.DARK)
_METAL = SurfaceMaterial(Material.PAINT, palette.METAL)
_WOOD = SurfaceMaterial(Material.TIMBER, palette.TIMBER)


def car(builder: MeshBuilder, frame: ObjectFrame, rng: np.random.Generator) -> None:
    """A parked or driving car, its nose towards local +x, its wheels on z = 0."""
    paint = SurfaceMaterial(Material.PAINT, palette.pick(rng, palette.CAR), 0.9)
    glass = SurfaceMaterial(Material.GLASS, palette.DARK, float(rng.random()))
    long, wide = rng.uniform(2.0, 2.3), rng.uniform(0.86, 0.94)
    box(builder, frame, Box(x0=-long, x1=long, y0=-wide, y1=wide, z0=0.28, z1=0.82), paint, paint, inset=(0.12, 0.1))
    back, front = (-long + 0.15, 0.35 * long) if rng.random() < 0.4 else (-0.62 * long, 0.4 * long)
    cabin = Box(x0=back, x1=front, y0=-wide + 0.12, y1=wide - 0.12, z0=0.8, z1=1.42)
    box(builder, frame, cabin, glass, paint, inset=(0.42, 0.14))
    for x in (-0.62 * long, 0.62 * long):
        for y in (-wide + 0.06, wide - 0.06):
            box(builder, frame, Box(x0=x - 0.32, x1=x + 0.32, y0=y - 0.1, y1=y + 0.1, z0=0, z1=0.62), _DARK, _DARK)
    lamp = SurfaceMaterial(Material.PAINT, palette.TRIM * 1.1)
    tail = SurfaceMaterial(Material.PAINT, palette.CAR[0])
    for x, skin in ((long - 0.06, lamp), (-long + 0.06, tail)):
        for y in (-0.6 * wide, 0.6 * wide):
            box(builder, frame, Box(x0=x - 0.06, x1=x + 0.06, y0=y - 0.17, y1=y + 0.17, z0=0.55, z1=0.7), skin, skin)


def bus(builder: MeshBuilder, frame: ObjectFrame, rng: np.random.Generator) -> None:
    """A bus, its nose towards local +x."""
    color = palette.pick(rng, palette.CAR[:6])
    paint, roof = SurfaceMaterial(Material.PAINT, color, 0.9), SurfaceMaterial(Material.PAINT, palette.TRIM)
    glass = SurfaceMaterial(Material.GLASS, palette.DARK, 0.5)
    box(builder, frame, Box(x0=-5, x1=5, y0=-1.2, y1=1.2, z0=0.35, z1=1.5), paint)
    box(builder, frame, Box(x0=-5, x1=5, y0=-1.2, y1=1.2, z0=1.5, z1=2.5), glass)
    box(builder, frame, Box(x0=-5, x1=5, y0=-1.2, y1=1.2, z0=2.5, z1=3.0), paint, roof)
    for x in (-2.5, 1.8):
        box(builder, frame, Box(x0=x - 0.9, x1=x + 0.9, y0=-0.7, y1=0.7, z0=3.0, z1=3.25), _METAL, _METAL)
    for x in (-3.4, 3.4):
        box(builder, frame, Box(x0=x - 0.5, x1=x + 0.5, y0=-1.15, y1=1.15, z0=0, z1=0.9), _DARK)


def person(builder: MeshBuilder, frame: ObjectFrame, rng: np.random.Generator) -> None:
    """Somebody who walks towards local +x."""
    coat = SurfaceMaterial(Material.PAINT, palette.pick(rng, palette.CAR))
    box(builder, frame, Box(x0=-0.14, x1=0.14, y0=-0.2, y1=0.2, z0=0, z1=0.85), _DARK, _DARK)
    box(builder, frame, Box(x0=-0.16, x1=0.16, y0=-0.26, y1=0.26, z0=0.8, z1=1.5), coat, coat, inset=(0.04, 0.06))
    head = SurfaceMaterial(Material.PAINT, palette.pick(rng, palette.OFFICE))
    box(builder, frame, Box(x0=-0.11, x1=0.11, y0=-0.09, y1=0.09, z0=1.5, z1=1.76), head, head)


def stall(builder: MeshBuilder, frame: ObjectFrame, rng: np.random.Generator) -> None:
    """A market stall under a striped awning, with crates of fruit."""
    stripes = SurfaceMaterial(Material.AWNING, palette.pick(rng, palette.AWNING))
    for x in (-1.4, 1.4):
        for y in (-1.0, 1.0):
            box(builder, frame, Box(x0=x - 0.05, x1=x + 0.05, y0=y - 0.05, y1=y + 0.05, z0=0, z1=2.3), _WOOD)
    left, right = (-1.7, 1.7)
    for y, order in ((-1.4, 1), (1.4, -1)):
        corners = np.array([(left, y, 2.15), (right, y, 2.15), (right, 0, 2.85), (left, 0, 2.85)])
        if order < 0:
            corners = corners[[1, 0, 3, 2]]
        face(builder, frame, corners, stripes)
    table = SurfaceMaterial(Material.PAINT, palette.pick(rng, palette.AWNING) * 0.8)
    box(builder, frame, Box(x0=-1.3, x1=1.3, y0=-1.7, y1=-0.6, z0=0, z1=0.9), _WOOD, table)


def fountain(builder: MeshBuilder, frame: ObjectFrame, radius: float = 3.0) -> None:
    """A round basin with a column in the middle."""
    stone = SurfaceMaterial(Material.STONE, palette.PALE_STONE)
    water = SurfaceMaterial(Material.WATER, np.array([0.10, 0.30, 0.36]))
    frustum(builder, frame, (radius, radius), (-0.5, 0.6), stone, stone, 24)
    frustum(builder, frame, (radius - 0.4, radius - 0.4), (0.55, 0.62), water, water, 24)
    frustum(builder, frame, (0.5, 0.35), (0.5, 2.0), stone, None, 12)
    frustum(builder, frame, (0.4, 1.3), (1.7, 2.1), stone, water, 16)
    frustum(builder, frame, (0.25, 0.1), (2.0, 3.3), stone, stone, 8)


def bench(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """A bench with its back towards local +y."""
    box(builder, frame, Box(x0=-0.9, x1=0.9, y0=-0.25, y1=0.25, z0=0.1, z1=0.45), _WOOD, _WOOD)
    box(builder, frame, Box(x0=-0.9, x1=0.9, y0=0.2, y1=0.3, z0=0.45, z1=0.9), _WOOD, _WOOD)


def lamp(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """A street lamp whose arm reaches towards local -y."""
    box(builder, frame, Box(x0=-0.07, x1=0.07, y0=-0.07, y1=0.07, z0=-0.3, z1=5.2), _METAL)
    box(builder, frame, Box(x0=-0.06, x1=0.06, y0=-1.3, y1=0.07, z0=5.1, z1=5.25), _METAL, _METAL)
    head = SurfaceMaterial(Material.PAINT, palette.TRIM)
    box(builder, frame, Box(x0=-0.13, x1=0.13, y0=-1.5, y1=-0.95, z0=5.05, z1=5.2), head, head)


def bandstand(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """An eight-sided pavilion."""
    stone = SurfaceMaterial(Material.STONE, palette.STONE)
    frustum(builder, frame, (3.1, 3.1), (-0.8, 0.7), stone, SurfaceMaterial(Material.TIMBER, palette.TIMBER), 8)
    for k in range(8):
        turned = ObjectFrame(frame.x, frame.y, frame.z, frame.angle + k * np.pi / 4 + np.pi / 8)
        post = Box(x0=2.7, x1=2.85, y0=-0.08, y1=0.08, z0=0.7, z1=3.2)
        box(builder, turned, post, SurfaceMaterial(Material.PAINT, palette.TRIM))
    frustum(builder, frame, (3.6, 0.3), (3.1, 4.8), SurfaceMaterial(Material.TILES, palette.COPPER, 0.4), None, 8)
    frustum(builder, frame, (0.3, 0.0), (4.8, 5.7), SurfaceMaterial(Material.PAINT, palette.GOLD), None, 8)


def playground(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """A climbing tower with a slide, and a swing."""
    red, blue = SurfaceMaterial(Material.PAINT, palette.CAR[0]), SurfaceMaterial(Material.PAINT, palette.CAR[1])
    yellow = SurfaceMaterial(Material.PAINT, palette.CAR[5])
    for x in (-0.8, 0.8):
        for y in (-0.8, 0.8):
            box(builder, frame, Box(x0=x - 0.08, x1=x + 0.08, y0=y - 0.08, y1=y + 0.08, z0=0, z1=2.6), blue)
    box(builder, frame, Box(x0=-1, x1=1, y0=-1, y1=1, z0=1.3, z1=1.45), yellow, yellow)
    box(builder, frame, Box(x0=-1.1, x1=1.1, y0=-1.1, y1=1.1, z0=2.6, z1=3.6), red, None, inset=(1.08, 1.08))
    face(builder, frame, np.array([(1, -0.4, 1.4), (3.6, -0.4, 0.2), (3.6, 0.4, 0.2), (1, 0.4, 1.4)]), yellow)
    swing = frame.child(-4.0, 0)
    box(builder, swing, Box(x0=-0.06, x1=0.06, y0=-1.8, y1=1.8, z0=2.1, z1=2.25), red, red)
    for y in (-1.8, 1.8):
        for foot in (-0.9, 0.9):
            leg = np.array([(foot, y, 0), (foot + 0.14, y, 0), (0.07, y, 2.2), (-0.07, y, 2.2)])
            face(builder, swing, leg, red)


def bale(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """A round bale of straw that lies on its side."""
    straw = SurfaceMaterial(Material.TIMBER, palette.STRAW, 0.5)
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    half = np.array([0.7, 0, 0])
    ring = np.stack([np.zeros(14), 0.75 * np.cos(angle), 0.72 + 0.75 * np.sin(angle)], 1)
    for k in range(14):
        a, b = ring[k], ring[(k + 1) % 14]
        side = np.stack([a - half, b - half, b + half, a + half])
        face(builder, frame, side[::-1], straw)
    face(builder, frame, ring + half, straw)
    face(builder, frame, (ring - half)[::-1], straw)


def pool(builder: MeshBuilder, frame: ObjectFrame, size: tuple[float, float]) -> None:
    """A swimming pool with a pale rim, its water just below the rim."""
    w, d = size[0] / 2, size[1] / 2
    rim = SurfaceMaterial(Material.STONE, palette.TRIM)
    for part in (
        Box(x0=-w - 0.4, x1=w + 0.4, y0=-d - 0.4, y1=-d, z0=-0.5, z1=0.14),
        Box(x0=-w - 0.4, x1=w + 0.4, y0=d, y1=d + 0.4, z0=-0.5, z1=0.14),
        Box(x0=-w - 0.4, x1=-w, y0=-d, y1=d, z0=-0.5, z1=0.14),
        Box(x0=w, x1=w + 0.4, y0=-d, y1=d, z0=-0.5, z1=0.14),
    ):
        box(builder, frame, part, rim, rim)
    water = np.array([(-w, -d, 0.1), (w, -d, 0.1), (w, d, 0.1), (-w, d, 0.1)])
    face(builder, frame, water, SurfaceMaterial(Material.WATER, np.array([0.10, 0.52, 0.62])))
