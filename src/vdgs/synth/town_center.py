"""The blocks that are not houses: the square with its church, shops and flats, the park, the works."""

from __future__ import annotations

import numpy as np

from vdgs.synth import palette, props
from vdgs.synth.buildings import church, flat_block, sawtooth_hall, solar_row
from vdgs.synth.mesh import Material
from vdgs.synth.shapes import ObjectFrame, SurfaceMaterial, frustum
from vdgs.synth.site import Plot, Site, rotate_plot
from vdgs.synth.trees import hedge, tree
from vdgs.synth.zones import LandUse

#: No tower with its mast is higher than this (m).
MAX_HEIGHT = 52.0
_STOREY = 3.1


def square(site: Site, block: Plot) -> None:
    """A paved square: church at the back, fountain and market before it, trees around."""
    rng, w, d = site.rng, block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.SQUARE)
    nave = site.level(site.frame(block, 2.0, d - 7.5), 22, 10)
    church(site.builder, nave, 0.95)
    site.footprint(nave, (-11.0, 10.5), (-5.4, 5.4))
    site.paint(block, (-w, -w + 3), (d - 14, d), LandUse.LAWN)
    site.paint(block, (w - 2.5, w), (d - 14, d), LandUse.LAWN)
    props.fountain(site.builder, site.frame(block, 0, -0.26 * d), 3.0)
    for k in range(4):
        a = -0.78 * w + k * 0.27 * w if k < 2 else 0.5 * w + (k - 2) * 0.27 * w
        for b in (-0.72 * d, -0.3 * d):
            turn = rng.uniform(-0.12, 0.12)
            props.stall(site.builder, site.frame(block, a, b, turn), rng)
    for k in range(5):
        a = (-0.9 + 0.45 * k) * w
        tree(site.builder, site.frame(block, a, -d + 1.2), rng, "round", rng.uniform(4.5, 5.5))
    for a in (-0.5 * w, 0.5 * w):
        props.bench(site.builder, site.frame(block, a, 0.05 * d))
    for a in (-0.22 * w, 0.22 * w):
        props.lamp(site.builder, site.frame(block, a, -0.6 * d))


def shops(site: Site, block: Plot) -> None:
    """Flat-roofed blocks of flats over shops around a yard, one of them tall."""
    rng = site.rng
    block = rotate_plot(block, int(rng.integers(4)))
    w, d = block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.PATIO)
    site.paint(block, (-0.45 * w, 0.6 * w), (-0.25 * d, 0.35 * d), LandUse.ASPHALT)
    split = rng.uniform(-0.15, 0.15) * w
    tall = int(rng.integers(3))
    lots = [
        (-w + 0.3, split - 0.1, -d + 0.3, -d + 10.5),
        (split + 0.1, w - 0.3, -d + 0.3, -d + 12.0),
        (-w + 0.3, -w + 9.5, -0.1 * d, d - 0.3),
        (0.1 * w, w - 0.3, d - 10.5, d - 0.3),
    ]
    for k, (a0, a1, b0, b1) in enumerate(lots):
        storeys = int(rng.integers(6, 8)) if k == tall else int(rng.integers(2, 5))
        frame = site.level(site.frame(block, (a0 + a1) / 2, (b0 + b1) / 2), a1 - a0, b1 - b0)
        wall = SurfaceMaterial(Material.OFFICE, palette.pick(rng, palette.OFFICE), float(rng.random()) * 0.9)
        roof = SurfaceMaterial(Material.FLAT_ROOF, palette.pick(rng, palette.FLAT_ROOF), float(rng.random()))
        flat_block(site.builder, frame, (a1 - a0, b1 - b0), storeys, (wall, roof), rng)
        site.footprint(frame, (-(a1 - a0) / 2, (a1 - a0) / 2), (-(b1 - b0) / 2, (b1 - b0) / 2))
    for a in np.arange(-0.35 * w, 0.5 * w, 2.7):
        site.stroke(block, [(a, 0.1 * d), (a, 0.34 * d)], 0.15, LandUse.LINE)
        if rng.random() < 0.6:
            props.car(site.builder, site.frame(block, a + 1.35, 0.22 * d, np.pi / 2), rng)
    tree(site.builder, site.frame(block, -0.1 * w, -0.12 * d), rng, "round", 5.0)


def park(site: Site, block: Plot) -> None:
    """Lawns, winding paths, a bandstand, a playground and large trees."""
    rng, w, d = site.rng, block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.LAWN)
    t = np.linspace(-1, 1, 30)
    for curve in ([(w * s, 0.45 * d * np.sin(2.4 * s)) for s in t], [(0.4 * w * np.cos(2.2 * s), d * s) for s in t]):
        site.stroke(block, curve, 1.8, LandUse.PATH)
    angle = np.linspace(0, 2 * np.pi, 40)
    site.stroke(block, [(0.2 * w + 5.4 * np.cos(k), 5.4 * np.sin(k)) for k in angle], 1.8, LandUse.PATH)
    site.disc(block, 0.2 * w, 0, 4.5, LandUse.FLOWERS)
    props.bandstand(site.builder, site.frame(block, 0.2 * w, 0))
    site.disc(block, -0.6 * w, 0.6 * d, 4.6, LandUse.SAND)
    props.playground(site.builder, site.frame(block, -0.55 * w, 0.6 * d, 0.4))
    for a, b in ((0.75, -0.2), (-0.35, -0.65), (0.6, 0.75)):
        site.disc(block, a * w, b * d, 1.3, LandUse.FLOWERS)
    kept = [(0.2 * w, 0.0, 7.0), (-0.6 * w, 0.6 * d, 6.5)]
    for _ in range(26):
        a, b = rng.uniform(-0.93, 0.93, 2) * (w, d)
        if any(np.hypot(a - x, b - y) < r for x, y, r in kept):
            continue
        kept.append((a, b, 4.2))
        tree(site.builder, site.frame(block, a, b), rng, str(rng.choice(["round", "round", "round", "conifer"])))
    for b in (-d + 0.5, d - 0.5):
        for a in (-0.55 * w, 0.5 * w):
            hedge(site.builder, site.frame(block, a, b), 0.7 * w, 1.0)


def pond_park(site: Site, block: Plot) -> None:
    """A lawn about the pond of the block, with trees in its corners and benches."""
    w, d = block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.LAWN)
    for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        tree(site.builder, site.frame(block, a * (w - 2), b * (d - 2)), site.rng, "round", 4.5)
    for b in (-1, 1):
        props.bench(site.builder, site.frame(block, 0, b * (d - 1)))


def works(site: Site, block: Plot) -> None:
    """A saw-tooth hall, a supermarket with solar panels, and their car park."""
    rng = site.rng
    block = rotate_plot(block, int(rng.integers(4)))
    w, d = block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.ASPHALT)
    hall = site.level(site.frame(block, -w + 8.2, d - 8.5), 14, 15)
    sawtooth_hall(site.builder, hall, (14, 15), palette.pick(rng, [palette.BRICK, palette.OFFICE[4]]))
    site.footprint(hall, (-7, 7), (-7.5, 7.5))
    market = site.level(site.frame(block, w - 7.5, d - 7.5), 13, 13)
    wall = SurfaceMaterial(Material.PLASTER, palette.pick(rng, palette.OFFICE), 0.2)
    roof = SurfaceMaterial(Material.FLAT_ROOF, palette.FLAT_ROOF[1], float(rng.random()))
    flat_block(site.builder, market, (13, 13), 1, (wall, roof), rng)
    solar_row(site.builder, market, -5.5, 5.5, 3.6, 3.7)
    site.footprint(market, (-6.5, 6.5), (-6.5, 6.5))
    for b in (-0.75 * d, -0.22 * d):
        for a in np.arange(-0.85 * w, 0.86 * w, 2.6):
            site.stroke(block, [(a, b - 2.4), (a, b + 2.4)], 0.15, LandUse.LINE)
            if rng.random() < 0.55:
                turn = np.pi / 2 * rng.choice([-1, 1])
                props.car(site.builder, site.frame(block, a + 1.3, b, turn), rng)
    for a in (-w + 0.8, w - 0.8):
        tree(site.builder, site.frame(block, a, -0.5 * d), rng, "round", 4.6)


def lawn_flats(site: Site, block: Plot) -> None:
    """Two tall slabs of flats on a lawn, with a ball court between them."""
    rng, w, d = site.rng, block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.LAWN)
    for a in (-w + 5.5, w - 5.5):
        frame = site.level(site.frame(block, a, 1.0, np.pi / 2), 22, 9)
        wall = SurfaceMaterial(Material.OFFICE, palette.pick(rng, palette.OFFICE), float(rng.random()) * 0.9)
        roof = SurfaceMaterial(Material.FLAT_ROOF, palette.pick(rng, palette.FLAT_ROOF), float(rng.random()))
        flat_block(site.builder, frame, (22, 9), int(rng.integers(4, 6)), (wall, roof), rng)
        site.footprint(frame, (-11, 11), (-4.5, 4.5))
        site.paint(block, (a - 0.8, a + 0.8), (-d, -9), LandUse.PATH)
    site.paint(block, (-4, 4), (-6, 7), LandUse.COURT)
    site.stroke(block, [(-3.6, -5.6), (3.6, -5.6), (3.6, 6.6), (-3.6, 6.6)], 0.15, LandUse.LINE, closed=True)
    site.stroke(block, [(-3.6, 0.5), (3.6, 0.5)], 0.15, LandUse.LINE)
    for a, b in ((-0.05, -0.75), (0.1, 0.8), (-0.3, 0.85), (0.3, -0.8)):
        tree(site.builder, site.frame(block, a * w, b * d), rng, "round")


def towers(site: Site, block: Plot) -> None:
    """Two towers of unlike height on podiums, a fountain between them, trees along the plaza."""
    rng = site.rng
    block = rotate_plot(block, int(rng.integers(4)))
    w, d = block.width / 2, block.depth / 2
    site.paint_all(block, LandUse.SQUARE)
    for a, b, storeys in ((-0.42 * w, 0.38 * d, int(rng.integers(11, 13))), (0.45 * w, -0.3 * d, 8)):
        frame = site.level(site.frame(block, a, b), 15, 15)
        _tower(site, frame, storeys)
        site.footprint(frame, (-8.0, 8.0), (-7.5, 7.5))
    props.fountain(site.builder, site.frame(block, -0.4 * w, -0.5 * d), 2.6)
    for a in np.linspace(-0.92, 0.92, 6) * w:
        tree(site.builder, site.frame(block, a, d - 1.3), rng, "round", rng.uniform(4.5, 5.5))
    for a in (-0.75 * w, 0.0):
        props.bench(site.builder, site.frame(block, a, -0.72 * d))


def _tower(site: Site, frame: ObjectFrame, storeys: int) -> None:
    """A podium of two storeys, a shaft, and a smaller crown with a mast."""
    rng, builder = site.rng, site.builder
    wall = SurfaceMaterial(Material.OFFICE, palette.pick(rng, palette.OFFICE), float(rng.random()) * 0.9)
    pale = SurfaceMaterial(Material.OFFICE, palette.OFFICE[4], wall.seed)
    roof = SurfaceMaterial(Material.FLAT_ROOF, palette.pick(rng, palette.FLAT_ROOF), float(rng.random()))
    z = 0.0
    for size, floors, skin in (((16.0, 15.0), 2, pale), ((11.5, 11.0), storeys, wall), ((6.5, 6.0), 1, pale)):
        flat_block(builder, frame.child(0, 0, z), size, floors, (skin, roof), rng)
        z += floors * _STOREY + 0.6
    mast = SurfaceMaterial(Material.PAINT, palette.METAL)
    frustum(builder, frame.child(2.2, 2.0), (0.16, 0.05), (z, z + 5.0), mast, mast, 6)
