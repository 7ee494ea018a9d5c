"""Buildings: houses with pitched roofs, flat-roofed blocks, a church, a barn.

Every building stands in its own `ObjectFrame`: front at negative y, floor at z = 0, foundations below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.synth import palette
from vdgs.synth.mesh import Material, MeshBuilder
from vdgs.synth.shapes import Box, ObjectFrame, SurfaceMaterial, box, face, frustum

STOREY_HEIGHT = 2.7
_FOUNDATION = 2.0


@dataclass(frozen=True, kw_only=True)
class HouseStyle:
    """What makes one house unlike the next (metres; `pitch` is rise over run)."""

    width: float
    depth: float
    storeys: int
    pitch: float
    hipped: bool
    walls: np.ndarray
    roof: SurfaceMaterial
    seed: float

    @property
    def eaves(self) -> float:
        return self.storeys * STOREY_HEIGHT + 0.3


def foundation(builder: MeshBuilder, frame: ObjectFrame, shape: Box) -> None:
    """A stone plinth that carries a building down into sloping ground."""
    plinth = Box(
        x0=shape.x0 - 0.06, x1=shape.x1 + 0.06, y0=shape.y0 - 0.06, y1=shape.y1 + 0.06, z0=-_FOUNDATION, z1=0.12
    )
    stone = SurfaceMaterial(Material.STONE, palette.STONE * 0.75)
    box(builder, frame, plinth, stone, stone)


def pitched_roof(
    builder: MeshBuilder, frame: ObjectFrame, shape: Box, pitch: float, roof: SurfaceMaterial, hip: float = 0.0
) -> float:
    """A roof whose ridge runs along x over a box, with eaves, fascias and a ridge cap; returns its rise.

    `hip` shortens the ridge at both ends by that part of half the depth: 0 gives gables, 1 a hipped roof.
    """
    out, z = 0.45, shape.z1
    half = (shape.y1 - shape.y0) / 2
    middle, rise = (shape.y0 + shape.y1) / 2, half * pitch
    x0, x1, y0, y1 = shape.x0 - out, shape.x1 + out, shape.y0 - out, shape.y1 + out
    low, top = z - out * pitch, z + rise
    r0, r1 = x0 + hip * (half + out), x1 - hip * (half + out)
    ridge = [(r0, middle, top), (r1, middle, top)]
    eaves = [(x0, y0, low), (x1, y0, low), (x1, y1, low), (x0, y1, low)]
    face(builder, frame, np.array([eaves[0], eaves[1], ridge[1], ridge[0]]), roof)
    face(builder, frame, np.array([eaves[2], eaves[3], ridge[0], ridge[1]]), roof)
    if hip > 0:
        face(builder, frame, np.array([eaves[1], eaves[2], ridge[1]]), roof)
        face(builder, frame, np.array([eaves[3], eaves[0], ridge[0]]), roof)
    trim = SurfaceMaterial(Material.PAINT, palette.TRIM * 0.8)
    for k in range(4):
        a, b = np.array(eaves[k]), np.array(eaves[(k + 1) % 4])
        if hip == 0 and k % 2:  # the verge climbs to the ridge and down again
            peak = np.array([a[0], middle, top])
            edges = [(a, peak), (peak, b)]
        else:
            edges = [(a, b)]
        for start, end in edges:
            down = np.array([0, 0, -0.22])
            face(builder, frame, np.array([start + down, end + down, end, start]), trim)
    cap = Box(x0=r0, x1=r1, y0=middle - 0.16, y1=middle + 0.16, z0=top - 0.12, z1=top + 0.09)
    box(builder, frame, cap, *(SurfaceMaterial(Material.PAINT, roof.color * 0.8),) * 2)
    return rise


def gables(builder: MeshBuilder, frame: ObjectFrame, shape: Box, pitch: float, skin: SurfaceMaterial) -> None:
    """The triangles that close a gabled roof over a box."""
    middle, top = (shape.y0 + shape.y1) / 2, shape.z1 + (shape.y1 - shape.y0) / 2 * pitch
    for x, (a, b) in ((shape.x0, (shape.y1, shape.y0)), (shape.x1, (shape.y0, shape.y1))):
        corners = np.array([(x, a, shape.z1), (x, b, shape.z1), (x, middle, top)])
        face(builder, frame, corners, skin)


def house(builder: MeshBuilder, frame: ObjectFrame, style: HouseStyle, rng: np.random.Generator) -> None:
    """A house with windows and a door, its roof, a chimney, and now and then a wing or dormers."""
    w, d = style.width / 2, style.depth / 2
    body = Box(x0=-w, x1=w, y0=-d, y1=d, z0=0, z1=style.eaves)
    windows = SurfaceMaterial(Material.WINDOWS, style.walls, style.seed)
    plaster = SurfaceMaterial(Material.PLASTER, style.walls, style.seed)
    front = SurfaceMaterial(Material.DOOR, style.walls, style.seed)
    foundation(builder, frame, body)
    box(builder, frame, body, (front, windows, windows, windows))
    if not style.hipped:
        gables(builder, frame, body, style.pitch, plaster)
    rise = pitched_roof(builder, frame, body, style.pitch, style.roof, hip=0.9 if style.hipped else 0.0)
    _chimney(builder, frame, rng.uniform(-0.55, 0.55) * w, rng.choice([-1, 1]) * 0.3 * d, style.eaves, rise)
    if style.hipped:
        return
    if style.width > 9 and rng.random() < 0.75:
        _wing(builder, frame, style, rng)
    elif rng.random() < 0.6:
        _dormers(builder, frame, style, plaster)


def _chimney(builder: MeshBuilder, frame: ObjectFrame, x: float, y: float, eaves: float, rise: float) -> None:
    brick = SurfaceMaterial(Material.BRICK, palette.BRICK)
    top = eaves + rise + 0.8
    box(builder, frame, Box(x0=x - 0.4, x1=x + 0.4, y0=y - 0.3, y1=y + 0.3, z0=eaves, z1=top), brick, brick)
    pot = SurfaceMaterial(Material.PAINT, palette.BRICK * 0.7)
    dark = SurfaceMaterial(Material.DARK, palette.DARK)
    for dx in (-0.18, 0.18):
        pots = Box(x0=x + dx - 0.12, x1=x + dx + 0.12, y0=y - 0.12, y1=y + 0.12, z0=top, z1=top + 0.35)
        box(builder, frame, pots, pot, dark)


def _wing(builder: MeshBuilder, frame: ObjectFrame, style: HouseStyle, rng: np.random.Generator) -> None:
    """A wing that comes forward from one half of the house, under a roof of its own."""
    side = rng.choice([-1.0, 1.0])
    span, reach = 0.4 * style.width, 1.7
    turned = frame.child(side * (style.width / 2 - span / 2 - 0.3), -style.depth / 4, turn=-np.pi / 2)
    body = Box(x0=-style.depth / 4, x1=style.depth / 4 + reach, y0=-span / 2, y1=span / 2, z0=0, z1=style.eaves - 0.35)
    skin = SurfaceMaterial(Material.WINDOWS, style.walls, style.seed)
    foundation(builder, turned, body)
    box(builder, turned, body, skin)
    gables(builder, turned, body, style.pitch, SurfaceMaterial(Material.PLASTER, style.walls, style.seed))
    pitched_roof(builder, turned, body, style.pitch, style.roof)


def _dormers(builder: MeshBuilder, frame: ObjectFrame, style: HouseStyle, plaster: SurfaceMaterial) -> None:
    """Two small gabled windows on the front slope."""
    run = 0.55 * style.depth / 2
    z = style.eaves + (style.depth / 2 - run) * style.pitch - 0.1
    for x in (-0.24 * style.width, 0.24 * style.width):
        turned = frame.child(x, -run, z, turn=-np.pi / 2)
        body = Box(x0=-1.6, x1=0.15, y0=-0.7, y1=0.7, z0=0, z1=1.05)
        glass = SurfaceMaterial(Material.GLASS, palette.DARK, style.seed)
        box(builder, turned, body, (plaster, glass, plaster, plaster))
        gables(builder, turned, body, 0.7, plaster)
        pitched_roof(builder, turned, body, 0.7, style.roof)


def flat_block(
    builder: MeshBuilder,
    frame: ObjectFrame,
    size: tuple[float, float],
    storeys: int,
    skins: tuple[SurfaceMaterial, SurfaceMaterial],
    rng: np.random.Generator,
) -> None:
    """A town block with shops below and a flat roof with parapet, stair hut, plant and skylights."""
    wall, roof = skins
    w, d, height = size[0] / 2, size[1] / 2, storeys * 3.1 + 0.6
    body = Box(x0=-w, x1=w, y0=-d, y1=d, z0=0, z1=height)
    foundation(builder, frame, body)
    box(builder, frame, body, wall, roof)
    parapet(builder, frame, body, SurfaceMaterial(Material.PAINT, wall.color * 0.85))
    metal, dark = SurfaceMaterial(Material.PAINT, palette.METAL), SurfaceMaterial(Material.DARK, palette.DARK)
    hx, hy = rng.uniform(-0.5, 0.5) * w, rng.uniform(-0.1, 0.5) * d
    hut = Box(x0=hx - 1.5, x1=hx + 1.5, y0=hy - 1.3, y1=hy + 1.3, z0=height, z1=height + 2.4)
    box(builder, frame, hut, SurfaceMaterial(Material.PLASTER, wall.color, wall.seed), metal)
    sunny = rng.random() < 0.45
    if sunny:
        solar_row(builder, frame, -0.8 * w, 0.8 * w, -0.7 * d, height)
    for _ in range(max(2, int(size[0] * size[1] / 45))):
        x, y = rng.uniform(-0.8, 0.8) * w, rng.uniform(-0.8, 0.8) * d
        if (abs(x - hx) < 2.6 and abs(y - hy) < 2.4) or (sunny and abs(y + 0.7 * d) < 1.9):
            continue
        if rng.random() < 0.5:
            unit = Box(x0=x - 0.8, x1=x + 0.8, y0=y - 0.6, y1=y + 0.6, z0=height, z1=height + 1.0)
            box(builder, frame, unit, metal, SurfaceMaterial(Material.PAINT, palette.METAL * 0.8))
            frustum(builder, frame.child(x, y), (0.45, 0.45), (height + 1.0, height + 1.08), dark, dark, 10)
        else:
            light = Box(x0=x - 0.7, x1=x + 0.7, y0=y - 0.7, y1=y + 0.7, z0=height, z1=height + 0.45)
            skin = SurfaceMaterial(Material.PAINT, palette.TRIM)
            box(builder, frame, light, skin, SurfaceMaterial(Material.GLASS, palette.DARK), inset=(0.15, 0.15))


def parapet(builder: MeshBuilder, frame: ObjectFrame, shape: Box, skin: SurfaceMaterial) -> None:
    """A low wall around a flat roof."""
    t, z0, z1 = 0.3, shape.z1 - 0.1, shape.z1 + 0.7
    for part in (
        Box(x0=shape.x0, x1=shape.x1, y0=shape.y0, y1=shape.y0 + t, z0=z0, z1=z1),
        Box(x0=shape.x0, x1=shape.x1, y0=shape.y1 - t, y1=shape.y1, z0=z0, z1=z1),
        Box(x0=shape.x0, x1=shape.x0 + t, y0=shape.y0 + t, y1=shape.y1 - t, z0=z0, z1=z1),
        Box(x0=shape.x1 - t, x1=shape.x1, y0=shape.y0 + t, y1=shape.y1 - t, z0=z0, z1=z1),
    ):
        box(builder, frame, part, skin, skin)


def solar_row(builder: MeshBuilder, frame: ObjectFrame, x0: float, x1: float, y: float, z: float) -> None:
    """A row of tilted solar panels."""
    skin = SurfaceMaterial(Material.SOLAR, palette.DARK)
    panel = np.array(
        [(x0, y - 0.9, z + 0.25), (x1, y - 0.9, z + 0.25), (x1, y + 0.9, z + 0.95), (x0, y + 0.9, z + 0.95)]
    )
    face(builder, frame, panel, skin)
    back = np.array([(x1, y + 0.9, z), (x0, y + 0.9, z), (x0, y + 0.9, z + 0.95), (x1, y + 0.9, z + 0.95)])
    face(builder, frame, back, SurfaceMaterial(Material.PAINT, palette.METAL))


def church(builder: MeshBuilder, frame: ObjectFrame, scale: float) -> None:
    """A nave with apse and a square tower with a copper spire, its long side along x."""
    s = scale
    stone = SurfaceMaterial(Material.STONE, palette.PALE_STONE, 0.3)
    slate = SurfaceMaterial(Material.SLATE, palette.SLATE[0], 0.3)
    nave = Box(x0=-7 * s, x1=8 * s, y0=-4 * s, y1=4 * s, z0=0, z1=7 * s)
    foundation(builder, frame, nave)
    walls = SurfaceMaterial(Material.OFFICE, palette.PALE_STONE, 0.97)
    box(builder, frame, nave, walls)
    gables(builder, frame, nave, 1.05, stone)
    pitched_roof(builder, frame, nave, 1.05, slate)
    frustum(builder, frame.child(8 * s, 0), (3.2 * s, 3.2 * s), (-2, 5 * s), stone, None, 14)
    frustum(builder, frame.child(8 * s, 0), (3.5 * s, 0), (5 * s, 7.4 * s), slate, None, 14)
    for y in (-5.6 * s, 5.6 * s):  # side aisles under lean-to roofs
        aisle = Box(x0=-5 * s, x1=6 * s, y0=min(y, 0.6 * y), y1=max(y, 0.6 * y), z0=0, z1=3.4 * s)
        foundation(builder, frame, aisle)
        box(builder, frame, aisle, stone)
        edge = [(-5.3 * s, y * 1.05, 3.3 * s), (6.3 * s, y * 1.05, 3.3 * s)]
        wall = [(6.3 * s, 0.7 * y, 5.2 * s), (-5.3 * s, 0.7 * y, 5.2 * s)]
        face(builder, frame, np.array(edge + wall if y < 0 else edge[::-1] + wall[::-1]), slate)
    _tower(builder, frame.child(-9 * s, 0), s, stone)


def _tower(builder: MeshBuilder, frame: ObjectFrame, s: float, stone: SurfaceMaterial) -> None:
    r, height = 2.7 * s, 15 * s
    shaft = Box(x0=-r, x1=r, y0=-r, y1=r, z0=0, z1=height)
    foundation(builder, frame, shaft)
    box(builder, frame, shaft, SurfaceMaterial(Material.OFFICE, palette.PALE_STONE * 0.95, 0.97), stone)
    for z in (0.5 * height, height - 0.2):
        band = Box(x0=-r - 0.25, x1=r + 0.25, y0=-r - 0.25, y1=r + 0.25, z0=z, z1=z + 0.5)
        box(builder, frame, band, stone, stone)
    spire = Box(x0=-r, x1=r, y0=-r, y1=r, z0=height + 0.3, z1=height + 9.5 * s)
    box(builder, frame, spire, SurfaceMaterial(Material.TILES, palette.COPPER, 0.2), None, inset=(r - 0.02, r - 0.02))
    gold = SurfaceMaterial(Material.PAINT, palette.GOLD)
    top = height + 9.5 * s
    box(builder, frame, Box(x0=-0.12, x1=0.12, y0=-0.12, y1=0.12, z0=top, z1=top + 1.8), gold, gold)
    box(builder, frame, Box(x0=-0.6, x1=0.6, y0=-0.12, y1=0.12, z0=top + 0.9, z1=top + 1.2), gold, gold)


def barn(builder: MeshBuilder, frame: ObjectFrame) -> None:
    """A red barn with white trim and a silo."""
    body = Box(x0=-8, x1=8, y0=-4.5, y1=4.5, z0=0, z1=4.6)
    red = SurfaceMaterial(Material.TIMBER, palette.BARN_RED)
    foundation(builder, frame, body)
    box(builder, frame, body, red)
    gables(builder, frame, body, 0.75, red)
    pitched_roof(builder, frame, body, 0.75, SurfaceMaterial(Material.SLATE, palette.METAL * 0.7))
    for x in (-3.0, 3.0):
        door = np.array([(x - 1.6, -4.56, 0), (x + 1.6, -4.56, 0), (x + 1.6, -4.56, 3.2), (x - 1.6, -4.56, 3.2)])
        face(builder, frame, door, SurfaceMaterial(Material.PAINT, palette.TRIM))
    silo = frame.child(11.5, 1.5)
    steel = SurfaceMaterial(Material.PAINT, palette.METAL)
    frustum(builder, silo, (2.1, 2.1), (-2, 9), steel, None, 18)
    frustum(builder, silo, (2.1, 0), (9, 10.4), SurfaceMaterial(Material.PAINT, palette.METAL * 0.8), None, 18)


def sawtooth_hall(builder: MeshBuilder, frame: ObjectFrame, size: tuple[float, float], color: np.ndarray) -> None:
    """A workshop with a saw-tooth roof: glazed steps to the back, sheets to the front."""
    w, d, height = size[0] / 2, size[1] / 2, 5.0
    body = Box(x0=-w, x1=w, y0=-d, y1=d, z0=0, z1=height)
    wall = SurfaceMaterial(Material.BRICK, color)
    foundation(builder, frame, body)
    box(builder, frame, body, wall)
    teeth = max(2, round(size[1] / 4.5))
    step = size[1] / teeth
    for k in range(teeth):
        y0, y1, top = -d + k * step, -d + (k + 1) * step, height + 1.9
        sheet = np.array([(-w, y0, height), (w, y0, height), (w, y1, top), (-w, y1, top)])
        face(builder, frame, sheet, SurfaceMaterial(Material.SLATE, palette.METAL * 0.8))
        glazing = np.array([(w, y1, height), (-w, y1, height), (-w, y1, top), (w, y1, top)])
        face(builder, frame, glazing, SurfaceMaterial(Material.GLASS, palette.DARK))
        for x, ends in ((-w, (y1, y0)), (w, (y0, y1))):
            side = [(x, ends[0], height), (x, ends[1], height), (x, y1, top)]
            face(builder, frame, np.array(side), wall)
