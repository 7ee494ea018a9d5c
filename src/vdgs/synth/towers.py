"""Tower blocks on a plaza: what a drone flies around, and what hides the streets behind it."""

from __future__ import annotations

import numpy as np

from vdgs.synth import palette, props
from vdgs.synth.buildings import flat_block
from vdgs.synth.mesh import Material
from vdgs.synth.shapes import ObjectFrame, SurfaceMaterial, frustum
from vdgs.synth.site import Plot, Site, rotate_plot
from vdgs.synth.trees import tree
from vdgs.synth.zones import LandUse

#: No tower with its mast is higher than this (m).
MAX_HEIGHT = 52.0
_STOREY = 3.1


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
