"""Blocks of houses with front and back gardens."""

from __future__ import annotations

import numpy as np

from vdgs.synth import palette, props
from vdgs.synth.buildings import HouseStyle, house
from vdgs.synth.mesh import Material
from vdgs.synth.shapes import Box, SurfaceMaterial, box
from vdgs.synth.site import Plot, Site, rotate_plot
from vdgs.synth.trees import hedge, tree
from vdgs.synth.zones import LandUse


def residential_block(site: Site, block: Plot) -> None:
    """Two rows of houses, back to back, each facing its street."""
    turns = int(site.rng.integers(2))
    block = rotate_plot(block, turns)
    half = block.depth / 2
    for row in (0, 2):
        front = rotate_plot(block, row)
        terrace(site, front.part(0, -half / 2, block.width, half))


def terrace(site: Site, row: Plot, occupied: float = 1.0) -> None:
    """A row of lots along the front of a plot; `occupied` is the share that is built upon."""
    site.paint_all(row, LandUse.LAWN)
    count = max(1, round(row.width / 11.5))
    lot_width = row.width / count
    for k in range(count):
        lot = row.part(-row.width / 2 + (k + 0.5) * lot_width, 0, lot_width, row.depth)
        if site.rng.random() < occupied:
            _lot(site, lot)
        else:
            _vacant(site, lot)


def _style(rng: np.random.Generator, lot: Plot) -> HouseStyle:
    slate = rng.random() < 0.22
    roof = SurfaceMaterial(
        Material.SLATE if slate else Material.TILES,
        palette.pick(rng, palette.SLATE if slate else palette.ROOF_TILES),
        float(rng.random()),
    )
    return HouseStyle(
        width=min(lot.width - 2.6, rng.uniform(7.8, 10.2)),
        depth=min(0.52 * lot.depth, rng.uniform(6.8, 8.2)),
        storeys=2 if rng.random() < 0.6 else 1,
        pitch=rng.uniform(0.62, 0.95),
        hipped=bool(rng.random() < 0.25),
        walls=palette.pick(rng, palette.PLASTER),
        roof=roof,
        seed=float(rng.random()),
    )


def _lot(site: Site, lot: Plot) -> None:
    """One house on its lot: path, drive, hedges, and something behind it."""
    rng, style = site.rng, _style(site.rng, lot)
    half_width, front = lot.width / 2, -lot.depth / 2
    side = rng.choice([-1.0, 1.0])
    a = side * (half_width - 0.9 - style.width / 2)
    b = front + rng.uniform(2.8, 3.8) + style.depth / 2
    frame = site.level(site.frame(lot, a, b), style.width, style.depth)
    house(site.builder, frame, style, rng)
    w, d = style.width / 2, style.depth / 2
    drive = -side * (half_width - 1.6)
    site.paint(lot, (drive - 1.35, drive + 1.35), (front - 0.3, b + 0.5), LandUse.DRIVE)
    site.paint(lot, (a - 0.6, a + 0.6), (front - 0.3, b), LandUse.PATH)
    site.paint(lot, (a - w + 0.6, a + w - 0.6), (b + d, b + d + 2.4), LandUse.PATIO)
    site.footprint(frame, (-w, w), (-d, d))
    if rng.random() < 0.6:
        spot = site.frame(lot, drive, front + rng.uniform(2.2, 4.5), turn=np.pi / 2)
        props.car(site.builder, spot, rng)
    for x0, x1 in ((-half_width, drive - 1.5), (drive + 1.5, a - 0.9), (a + 0.9, half_width)):
        if x1 - x0 > 1.2 and rng.random() < 0.75:
            hedge(site.builder, site.frame(lot, (x0 + x1) / 2, front + 0.4), x1 - x0 - 0.4, 0.9)
    hedge(site.builder, site.frame(lot, half_width, 0.15 * lot.depth, np.pi / 2), 0.65 * lot.depth)
    if rng.random() < 0.8:
        hedge(site.builder, site.frame(lot, 0, lot.depth / 2), lot.width - 1.0, 1.3)
    _garden(site, lot, b + d + 2.6)
    if rng.random() < 0.55:
        kind = str(rng.choice(["bush", "blossom", "bush"]))
        tree(site.builder, site.frame(lot, a - side * rng.uniform(1.5, 3), front + 1.6), rng, kind)


def _garden(site: Site, lot: Plot, start: float) -> None:
    """What lies behind a house, from local b = start to the end of the lot."""
    rng, end, w = site.rng, lot.depth / 2 - 0.6, lot.width / 2 - 0.9
    start = min(start, end - 1.0)
    middle, depth = (start + end) / 2, end - start
    what = rng.choice(["pool", "vegetables", "trees", "trees", "shed", "flowers"])
    if what == "pool" and depth > 3.2:
        frame = site.level(site.frame(lot, 0.8, middle), 6, 3)
        site.paint(lot, (-3.6, 5.2), (middle - 1.9, middle + 1.9), LandUse.PATIO)
        props.pool(site.builder, frame, (5.4, 2.4))
        site.footprint(frame, (-2.7, 2.7), (-1.2, 1.2))
    elif what == "vegetables":
        for k in range(3):
            site.paint(lot, (-w + 0.4, -0.2), (start + k * 1.5, start + k * 1.5 + 1.0), LandUse.SOIL)
    elif what == "shed":
        shed = site.level(site.frame(lot, w - 1.6, middle), 2.6, 2.2)
        wood = SurfaceMaterial(Material.TIMBER, palette.TIMBER)
        box(
            site.builder,
            shed,
            Box(x0=-1.3, x1=1.3, y0=-1.1, y1=1.1, z0=-1, z1=2.2),
            wood,
            SurfaceMaterial(Material.SLATE, palette.SLATE[1]),
        )
        site.footprint(shed, (-1.3, 1.3), (-1.1, 1.1))
    elif what == "flowers":
        site.disc(lot, -0.5 * w, middle, min(1.5, depth / 2), LandUse.FLOWERS)
    for _ in range(rng.integers(1, 4)):
        place = site.frame(lot, rng.choice([-1, 1]) * rng.uniform(0.55, 0.95) * w, rng.uniform(middle, end))
        kind = str(rng.choice(["round", "round", "blossom", "bush", "conifer"]))
        height = rng.uniform(4.2, 7.0) if kind in ("round", "conifer") else None
        tree(site.builder, place, rng, kind, height)


def _vacant(site: Site, lot: Plot) -> None:
    """A lot that nobody has built on: meadow and trees."""
    site.paint_all(lot, LandUse.MEADOW)
    for _ in range(3):
        a, b = site.rng.uniform(-0.4, 0.4, 2) * (lot.width, lot.depth)
        tree(site.builder, site.frame(lot, a, b), site.rng, str(site.rng.choice(["round", "bush", "poplar"])))
