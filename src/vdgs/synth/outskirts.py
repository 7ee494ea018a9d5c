"""Around the town: a last row of houses, then pitch, farm, orchard, woods, fields and lone trees."""

from __future__ import annotations

import numpy as np

from vdgs.synth import props
from vdgs.synth.buildings import barn
from vdgs.synth.residential import terrace
from vdgs.synth.site import Plot, Site
from vdgs.synth.streets import PAVEMENT
from vdgs.synth.trees import tree
from vdgs.synth.zones import LandUse

_ROW = 17.0
_FIELD = 40.0


def edge_plots(site: Site) -> list[Plot]:
    """One plot outside every block that lies on the edge of the town, its front to the last street."""
    plan, plots = site.plan, []
    for i in range(len(plan.p) - 1):
        p0, p1 = plan.p[i] + plan.p_half[i] + PAVEMENT, plan.p[i + 1] - plan.p_half[i + 1] - PAVEMENT
        middle, width = (p0 + p1) / 2, p1 - p0
        south = plan.q[0] - plan.q_half[0] - PAVEMENT
        north = plan.q[-1] + plan.q_half[-1] + PAVEMENT
        plots.append(Plot(middle, south - _ROW / 2, width, _ROW, 2))
        plots.append(Plot(middle, north + _ROW / 2, width, _ROW, 0))
    for j in range(len(plan.q) - 1):
        q0, q1 = plan.q[j] + plan.q_half[j] + PAVEMENT, plan.q[j + 1] - plan.q_half[j + 1] - PAVEMENT
        middle, width = (q0 + q1) / 2, q1 - q0
        west = plan.p[0] - plan.p_half[0] - PAVEMENT
        east = plan.p[-1] + plan.p_half[-1] + PAVEMENT
        plots.append(Plot(west - _ROW / 2, middle, width, _ROW, 1))
        plots.append(Plot(east + _ROW / 2, middle, width, _ROW, 3))
    return plots


def build_outskirts(site: Site, pond_plot: int) -> None:
    """Houses or open land along the last streets, and fields behind them."""
    features = [_pitch, _farm, _orchard, _woods, _lavender, _bales]
    order = site.rng.permutation(len(features))
    for k, plot in enumerate(edge_plots(site)):
        behind = plot.part(0, (_ROW + _FIELD) / 2, plot.width + 8, _FIELD)
        if k == pond_plot:
            _shore(site, plot)
            continue
        if k % 3 == 1 or site.rng.random() < 0.3:
            whole = plot.part(0, _FIELD / 2, plot.width, _ROW + _FIELD)
            features[order[k % len(features)]](site, whole)
            continue
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


def _lavender(site: Site, plot: Plot) -> None:
    site.paint_all(plot, LandUse.LAVENDER)


def _wheat(site: Site, plot: Plot) -> None:
    site.paint_all(plot, LandUse.WHEAT)


def _greens(site: Site, plot: Plot) -> None:
    site.paint_all(plot, LandUse.GREENS)


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
        if pond.distance(np.array(x), np.array(y)) < 1.0 or on_street(site, x, y):
            continue
        p, q = site.plan.to_plan(np.array([x]), np.array([y]))
        from_here = site.frame(Plot(float(p[0]), float(q[0]), 1, 1))
        tree(site.builder, from_here, rng, str(rng.choice(["round", "bush", "bush", "poplar"])))


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
            here = np.array([a]), np.array([b])
            wet = any(pond.distance(*here)[0] < 2 for pond in site.terrain.ponds)
            if wet or site.zones.sample(*here)[0] != LandUse.OPEN or on_street(site, a, b):
                continue
            p, q = site.plan.to_plan(*here)
            tree(site.builder, site.frame(Plot(float(p[0]), float(q[0]), 1, 1)), rng, kind, detail=2)
