"""Around the town: a last row of houses, then pitch, farm, orchard, woods, fields and lone trees."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vdgs.synth import palette, props
from vdgs.synth.buildings import STOREY_HEIGHT, barn, gables, pitched_roof
from vdgs.synth.mesh import Material
from vdgs.synth.residential import terrace
from vdgs.synth.shapes import Box, ObjectFrame, SurfaceMaterial, box
from vdgs.synth.site import Plot, Site
from vdgs.synth.streets import PAVEMENT
from vdgs.synth.terrain import Pond
from vdgs.synth.trees import tree
from vdgs.synth.zones import LandUse

_ROW = 17.0
_FIELD = 40.0
_HAMLETS, _WOODS = 12, 18
#: From here (m beyond the half extent) to so many half extents, at most so many metres.
_MARGIN, _REACH, _FARTHEST = 130.0, 5.0, 1300.0


def edge_plots(site: Site) -> list[Plot]:
    """One plot outside every block that lies on the edge of the town, its front to the last street."""
    plan, plots = site.plan, []
    for cuts, halves, ends, end_halves, along_p in (
        (plan.p, plan.p_half, plan.q, plan.q_half, True),
        (plan.q, plan.q_half, plan.p, plan.p_half, False),
    ):
        low, high = ends[0] - end_halves[0] - PAVEMENT, ends[-1] + end_halves[-1] + PAVEMENT
        for i in range(len(cuts) - 1):
            start, end = cuts[i] + halves[i] + PAVEMENT, cuts[i + 1] - halves[i + 1] - PAVEMENT
            middle = (start + end) / 2
            for across, turns in ((low - _ROW / 2, 2 if along_p else 1), (high + _ROW / 2, 0 if along_p else 3)):
                p, q = (middle, across) if along_p else (across, middle)
                plots.append(Plot(p, q, end - start, _ROW, turns))
    return plots


def _crop(zone: LandUse) -> Callable[[Site, Plot], None]:
    """A field of one crop."""
    return lambda site, plot: site.paint_all(plot, zone)


_wheat, _lavender, _greens = _crop(LandUse.WHEAT), _crop(LandUse.LAVENDER), _crop(LandUse.GREENS)


def build_outskirts(site: Site, pond_plot: int) -> None:
    """Houses or open land along the last streets, and fields behind them."""
    features = [_pitch, _farm, _orchard, _woods, _lavender, _bales]
    order = site.rng.permutation(len(features))
    for k, plot in enumerate(edge_plots(site)):
        behind = plot.part(0, (_ROW + _FIELD) / 2, plot.width + 8, _FIELD)
        if k == pond_plot:
            _shore(site, plot)
        elif k % 3 == 1 or site.rng.random() < 0.3:
            whole = plot.part(0, _FIELD / 2, plot.width, _ROW + _FIELD)
            features[order[k % len(features)]](site, whole)
        else:
            terrace(site, plot, occupied=0.85)
            (_woods, _orchard, _wheat, _greens, _lavender)[int(site.rng.integers(5))](site, behind)


def _pitch(site: Site, plot: Plot) -> None:
    """A football pitch with its lines, goals and floodlights' shadows of trees along it."""
    site.paint_all(plot, LandUse.MEADOW)
    w, d, start = min(plot.width / 2 - 1, 15.0), 22.0, -plot.depth / 2 + 4
    middle = start + d
    site.paint(plot, (-w - 1, w + 1), (start - 1, start + 2 * d + 1), LandUse.PITCH)

    def lines(points: list[tuple[float, float]], closed: bool = False) -> None:
        site.stroke(plot, [(a, middle + b) for a, b in points], 0.2, LandUse.LINE, closed)

    lines([(-w, -d), (w, -d), (w, d), (-w, d)], closed=True)
    lines([(-w, 0), (w, 0)])
    circle = np.linspace(0, 2 * np.pi, 40)
    lines([(4 * np.cos(t), 4 * np.sin(t)) for t in circle])
    for end in (-1, 1):
        lines([(-7, end * d), (-7, end * (d - 6)), (7, end * (d - 6)), (7, end * d)])
        lines([(-3, end * d), (-3, end * (d - 2.4)), (3, end * (d - 2.4)), (3, end * d)])
    _line_of_trees(site, plot, -plot.width / 2 + 0.5, "poplar")


def _farm(site: Site, plot: Plot) -> None:
    """A red barn with its silo on a yard, bales, and ploughed land behind."""
    rng, d = site.rng, plot.depth / 2
    site.paint_all(plot, LandUse.MEADOW)
    site.paint(plot, (-plot.width / 2, plot.width / 2), (-d + 24, d), LandUse.PLOUGHED)
    site.paint(plot, (-14, 14), (-d + 1, -d + 17), LandUse.GRAVEL)
    site.paint(plot, (-2, 2), (-d - 1, -d + 3), LandUse.GRAVEL)
    frame = site.level(site.frame(plot, -2, -d + 12.5), 17, 10)
    barn(site.builder, frame)
    site.footprint(frame, (-8, 8), (-4.5, 4.5))
    for k in range(7):
        spot = site.frame(plot, -11 + 1.9 * (k % 4), -d + 3 + 1.8 * (k // 4), rng.uniform(-0.2, 0.2))
        props.bale(site.builder, spot)
    props.car(site.builder, site.frame(plot, 8, -d + 4.5, 0.5), rng)
    _line_of_trees(site, plot, plot.width / 2 - 1, "round")


def _orchard(site: Site, plot: Plot) -> None:
    """Rows of small fruit trees in the grass."""
    site.paint_all(plot, LandUse.MEADOW)
    kind = str(site.rng.choice(["round", "blossom"]))
    for a in np.arange(-plot.width / 2 + 3, plot.width / 2 - 2, 5.2):
        for b in np.arange(-plot.depth / 2 + 3, plot.depth / 2 - 2, 5.2):
            if site.rng.random() < 0.92:
                frame = site.frame(plot, a + site.rng.normal(0, 0.2), b + site.rng.normal(0, 0.2))
                tree(site.builder, frame, site.rng, kind, site.rng.uniform(3.0, 3.9), detail=2)


def _woods(site: Site, plot: Plot) -> None:
    """A dense stand of mixed trees."""
    site.paint_all(plot, LandUse.WOODS)
    for a in np.arange(-plot.width / 2 + 2, plot.width / 2 - 1, 4.4):
        for b in np.arange(-plot.depth / 2 + 3, plot.depth / 2 - 1, 4.4):
            if site.rng.random() < 0.85:
                da, db = site.rng.normal(0, 1.0, 2)
                kind = str(site.rng.choice(["round", "round", "conifer", "bush"]))
                tree(site.builder, site.frame(plot, a + da, b + db), site.rng, kind, detail=2)


def _bales(site: Site, plot: Plot) -> None:
    """A stubble field after the harvest."""
    site.paint_all(plot, LandUse.WHEAT)
    for a in np.arange(-plot.width / 2 + 4, plot.width / 2 - 3, 8.0):
        for b in np.arange(-plot.depth / 2 + 5, plot.depth / 2 - 3, 10.0):
            if site.rng.random() < 0.7:
                turn = site.rng.uniform(0, np.pi)
                props.bale(site.builder, site.frame(plot, a + site.rng.normal(), b + site.rng.normal(), turn))


def _shore(site: Site, plot: Plot) -> None:
    """Grass around the pond, with reeds, willows and benches."""
    whole = plot.part(0, _FIELD / 2, plot.width, _ROW + _FIELD)
    site.paint_all(whole, LandUse.MEADOW)
    site.paint(plot, (-plot.width / 2, plot.width / 2), (-_ROW / 2 + 2, -_ROW / 2 + 3.6), LandUse.PATH)
    rng, pond = site.rng, site.terrain.ponds[0]
    for angle in np.arange(0, 2 * np.pi, 0.33):
        away = rng.uniform(1.5, 7.0)
        x = pond.x + (pond.rx + away) * np.cos(angle)
        y = pond.y + (pond.ry + away) * np.sin(angle)
        if pond.distance(np.array(x), np.array(y)) >= 1.0 and not on_street(site, x, y):
            tree(site.builder, _plan_frame(site, x, y), rng, str(rng.choice(["round", "bush", "bush", "poplar"])))


def _line_of_trees(site: Site, plot: Plot, a: float, kind: str) -> None:
    for b in np.arange(-plot.depth / 2 + 3, plot.depth / 2 - 2, 6.0):
        tree(site.builder, site.frame(plot, a, b), site.rng, kind, detail=2)


def on_street(site: Site, x: float, y: float) -> bool:
    """Whether a place in the world lies on a street or its pavement."""
    p, q = site.plan.to_plan(np.array([x]), np.array([y]))
    return any(street.outside[0] < PAVEMENT + 1.5 for street in site.plan.nearest_street(p, q))


def scatter_trees(site: Site, half_extent: float, count: int) -> None:
    """Lone trees and thickets in the open land, wherever no zone has been painted."""
    rng = site.rng
    for _ in range(count):
        radius, angle = half_extent * rng.uniform(1.2, 3.2), rng.uniform(0, 2 * np.pi)
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        kind = str(rng.choice(["round", "round", "conifer", "poplar"]))
        for _ in range(int(rng.integers(1, 5))):
            a, b = x + rng.normal(0, 3.5), y + rng.normal(0, 3.5)
            if _is_free(site, a, b, shore=2):
                tree(site.builder, _plan_frame(site, a, b), rng, kind, detail=2)


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
        _lake_shore(site, pond)


def _is_free(site: Site, x: float, y: float, shore: float = 4) -> bool:
    """Whether (x, y) is open land at least `shore` metres from water."""
    here = np.array([x]), np.array([y])
    wet = any(pond.distance(*here)[0] < shore for pond in site.terrain.ponds)
    return not wet and site.zones.sample(*here)[0] == LandUse.OPEN and not on_street(site, x, y)


def _plan_frame(site: Site, x: float, y: float) -> ObjectFrame:
    """The frame at world (x, y), along the streets."""
    p, q = site.plan.to_plan(np.array([x]), np.array([y]))
    return site.frame(Plot(float(p[0]), float(q[0]), 1, 1))


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
        if not _is_free(site, a, b):
            continue
        frame = _stand(site, a, b, lane + rng.normal(0, 0.12))
        barn(site.builder, frame) if k == count - 1 else _plain_house(site, frame)
        for _ in range(2):
            c, e = a + rng.normal(0, 9), b + rng.normal(0, 9)
            if np.hypot(c - a, e - b) > 7 and _is_free(site, c, e):
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
        if _is_free(site, a, b):
            tree(site.builder, _stand(site, a, b), rng, kind, detail=1)


def _lake_shore(site: Site, lake: Pond) -> None:
    """Bushes and trees in clumps around a lake."""
    rng = site.rng
    for angle in np.arange(0, 2 * np.pi, 0.08):
        if np.sin(5 * angle + lake.x) < -0.2:
            continue
        away = rng.uniform(3.0, 12.0)
        x, y = lake.x + (lake.rx + away) * np.cos(angle), lake.y + (lake.ry + away) * np.sin(angle)
        if _is_free(site, x, y):
            tree(site.builder, _stand(site, x, y), rng, str(rng.choice(["round", "bush", "poplar"])), detail=1)
