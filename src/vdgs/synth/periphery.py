"""The land beyond the fields, in little detail: hamlets, woods, the shores of a lake."""

from __future__ import annotations

import numpy as np

from vdgs.synth import palette
from vdgs.synth.buildings import STOREY_HEIGHT, barn, gables, pitched_roof
from vdgs.synth.mesh import Material
from vdgs.synth.outskirts import on_street
from vdgs.synth.shapes import Box, ObjectFrame, SurfaceMaterial, box
from vdgs.synth.site import Site
from vdgs.synth.terrain import Pond
from vdgs.synth.trees import tree
from vdgs.synth.zones import LandUse

_HAMLETS, _WOODS = 12, 18
#: From here (m beyond the half extent) to so many half extents, at most so many metres.
_MARGIN, _REACH, _FARTHEST = 130.0, 5.0, 1300.0


def build_periphery(site: Site, half_extent: float) -> None:
    """Hamlets and woods between the fields and the hills. Draws from the site's own generator."""
    nearest = half_extent + _MARGIN
    farthest = min(max(_REACH * half_extent, nearest + 150), _FARTHEST)
    for k in range(_HAMLETS + _WOODS):
        share = (k * 0.618034) % 1
        radius = np.sqrt(nearest**2 + share * (farthest**2 - nearest**2))
        angle = 2.399963 * k + site.rng.uniform(-0.3, 0.3)
        (_hamlet if k < _HAMLETS else _wood)(site, radius * np.cos(angle), radius * np.sin(angle))
    for pond in site.terrain.ponds[1:]:
        _shore(site, pond)


def _free(site: Site, x: float, y: float) -> bool:
    here = np.array([x]), np.array([y])
    wet = any(pond.distance(*here)[0] < 4 for pond in site.terrain.ponds)
    return not wet and site.zones.sample(*here)[0] == LandUse.OPEN and not on_street(site, x, y)


def _stand(site: Site, x: float, y: float, angle: float = 0.0) -> ObjectFrame:
    return ObjectFrame(x, y, float(site.terrain.height(np.array(x), np.array(y))), angle)


def _hamlet(site: Site, x: float, y: float) -> None:
    """Houses about a lane, a barn, trees in the gardens."""
    rng = site.rng
    lane = rng.uniform(0, np.pi)
    count = int(rng.integers(5, 11))
    for k in range(count):
        along, side = (k // 2 - count / 4) * rng.uniform(13, 17), 9.0 if k % 2 else -9.0
        a = x + along * np.cos(lane) - side * np.sin(lane)
        b = y + along * np.sin(lane) + side * np.cos(lane)
        if not _free(site, a, b):
            continue
        frame = _stand(site, a, b, lane + rng.normal(0, 0.12))
        if k == count - 1:
            barn(site.builder, frame)
        else:
            _plain_house(site, frame)
        for _ in range(2):
            c, e = a + rng.normal(0, 9), b + rng.normal(0, 9)
            if np.hypot(c - a, e - b) > 7 and _free(site, c, e):
                tree(site.builder, _stand(site, c, e), rng, str(rng.choice(["round", "bush"])), detail=1)


def _plain_house(site: Site, frame: ObjectFrame) -> None:
    """Walls with windows under a gabled roof, and nothing else."""
    rng = site.rng
    w, d, storeys = rng.uniform(4.0, 6.5), rng.uniform(3.4, 4.2), int(rng.integers(1, 3))
    body = Box(x0=-w, x1=w, y0=-d, y1=d, z0=-1.5, z1=storeys * STOREY_HEIGHT + 0.3)
    color, seed, pitch = palette.pick(rng, palette.PLASTER), float(rng.random()), rng.uniform(0.65, 0.95)
    roof = SurfaceMaterial(Material.TILES, palette.pick(rng, palette.ROOF_TILES), seed)
    box(site.builder, frame, body, SurfaceMaterial(Material.WINDOWS, color, seed))
    gables(site.builder, frame, body, pitch, SurfaceMaterial(Material.PLASTER, color, seed))
    pitched_roof(site.builder, frame, body, pitch, roof)


def _wood(site: Site, x: float, y: float) -> None:
    """A stand of trees, dense in the middle."""
    rng = site.rng
    kind = str(rng.choice(["round", "conifer"]))
    size = rng.uniform(8, 17)
    for _ in range(int(rng.integers(18, 40))):
        a, b = x + rng.normal(0, size), y + rng.normal(0, size)
        if _free(site, a, b):
            tree(site.builder, _stand(site, a, b), rng, kind, detail=1)


def _shore(site: Site, lake: Pond) -> None:
    """Bushes and trees in clumps around a lake."""
    rng = site.rng
    for angle in np.arange(0, 2 * np.pi, 0.08):
        if np.sin(5 * angle + lake.x) < -0.2:
            continue
        away = rng.uniform(3.0, 12.0)
        x, y = lake.x + (lake.rx + away) * np.cos(angle), lake.y + (lake.ry + away) * np.sin(angle)
        if _free(site, x, y):
            tree(site.builder, _stand(site, x, y), rng, str(rng.choice(["round", "bush", "poplar"])), detail=1)
