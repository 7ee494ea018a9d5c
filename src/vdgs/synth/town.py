"""The town as a whole: which block is what, what drives on the streets, all joined into one scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from vdgs.synth import props, town_center
from vdgs.synth.mesh import Mesh, MeshBuilder
from vdgs.synth.outskirts import build_outskirts, build_periphery, edge_plots, scatter_trees
from vdgs.synth.residential import residential_block
from vdgs.synth.site import Plot, Site, street_plot
from vdgs.synth.streets import PAVEMENT, StreetPlan, make_street_plan
from vdgs.synth.terrain import Pond, Terrain
from vdgs.synth.town_center import MAX_HEIGHT, towers
from vdgs.synth.trees import tree
from vdgs.synth.zones import LandUseMap

#: A town with more streets than this each way is grand: it has towers and a lake.
_GRAND = 9
#: No building of a town without towers is higher than this (m).
_TALLEST_HOUSE = 26.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Town:
    """A finished town: its triangles, and what the ground's shader has to know."""

    mesh: Mesh
    plan: StreetPlan
    terrain: Terrain
    zones: LandUseMap
    half_extent: float
    #: Places [k, 2] (m) worth flying around, the square first; and a height (m) that no building exceeds.
    landmarks: np.ndarray
    tallest: float
    #: Where the pattern of the waves begins (m); None: the water is still.
    waves: tuple[float, float] | None = None


def build_town(seed: int, extent_m: float, pond_within: bool = False) -> Town:
    """A town of about `extent` metres a side around the origin, its pond behind an edge or in a block within; the same
    arguments give the same town."""
    rng = np.random.default_rng([seed, 1])
    plan = make_street_plan(rng, extent_m)
    land = Terrain(extent_m / 2, tuple(float(v) for v in rng.uniform(0, 6, 4)))
    zones = LandUseMap(half_size=float(np.abs(plan.p).max() * 1.3 + 85))
    site = Site(plan, land, zones, MeshBuilder(), rng)
    plots = edge_plots(site)
    pond_plot = int(rng.integers(len(plots)))
    grand = len(plan.p) > _GRAND
    pond = _pond_of_block(site, site.block(*_pond_cell(plan))) if pond_within else _pond(site, plots[pond_plot])
    ponds = [pond] + ([_lake(site, plots, pond_plot, extent_m)] if grand else [])
    site = replace(site, terrain=replace(land, ponds=tuple(ponds)))
    landmarks = _blocks(site, grand, pond_within)
    build_outskirts(site, -1 if pond_within else pond_plot)
    _traffic(site)
    scatter_trees(site, extent_m / 2 + 20, count=int(60 + extent_m / 2))
    build_periphery(replace(site, rng=np.random.default_rng([seed, 11])), extent_m / 2)
    site.terrain.add_to(site.builder)
    tallest = MAX_HEIGHT if grand else _TALLEST_HOUSE
    return Town(
        mesh=site.builder.build(), plan=plan, terrain=site.terrain, zones=zones, half_extent=extent_m / 2,
        landmarks=landmarks, tallest=tallest,
    )  # fmt: skip


def _pond(site: Site, plot: Plot) -> Pond:
    """The pond behind an edge of the town, level with the lowest ground of its shore."""
    return _water(site, plot, 14.0, (15.0, 13.0), 32)


def _pond_cell(plan: StreetPlan) -> tuple[int, int]:
    """The block beside the square that has the pond of a town with one within."""
    return plan.p_main - 1, plan.q_main + (1 if plan.q_main + 2 < len(plan.q) else -1)


def _pond_of_block(site: Site, block: Plot) -> Pond:
    """A round pond that leaves its banks (`Terrain.height`) within the block."""
    radius = (min(block.width, block.depth) / 2 - 3.5) / 1.14
    return _water(site, block, 0.0, (radius, radius), 32)


def _water(site: Site, plot: Plot, b: float, radii: tuple[float, float], samples: int, shore_ry: float = 0.0) -> Pond:
    """Water at local (0, b) of a plot, level with the lowest of `samples` points around its shore."""
    x, y = (float(v) for v in site.plan.to_world(*plot.plan(np.array(0.0), np.array(b))))
    angle = np.linspace(0, 2 * np.pi, samples)
    around = x + 1.25 * radii[0] * np.cos(angle), y + 1.25 * (shore_ry or radii[1]) * np.sin(angle)
    return Pond(x, y, *radii, float(site.terrain.height(*around).min()) - 0.35)


def _lake(site: Site, plots: list[Plot], pond_plot: int, extent: float) -> Pond:
    """A lake beyond the fields of an edge of the town, away from the main streets and from the pond."""
    plan, radius = site.plan, 0.1 * extent
    main = np.array([plan.p[plan.p_main], plan.q[plan.q_main]])

    def room(plot: Plot) -> float:
        other = np.hypot(plot.p - plots[pond_plot].p, plot.q - plots[pond_plot].q)
        along = abs((plot.p - main[0], plot.q - main[1])[plot.quarter_turns % 2])
        return float(min(other, 2 * along))

    return _water(site, max(plots, key=room), 50 + 1.15 * radius, (radius, 0.9 * radius), 64, shore_ry=radius)


def _tower_blocks(cells: list[tuple[int, int]], middle: tuple[int, int]) -> list[tuple[int, int]]:
    """Three blocks around the middle one, a few blocks off, each another way."""
    away = max(1, max(abs(i - middle[0]) for i, _ in cells) // 2)
    wanted = [(middle[0] + away * np.cos(t), middle[1] + away * np.sin(t)) for t in (0.6, 2.7, 4.8)]
    return [min(cells, key=lambda cell: np.hypot(cell[0] - a, cell[1] - b)) for a, b in wanted]


def _landmarks(site: Site, blocks: list[tuple[int, int]]) -> np.ndarray:
    """The middles of the blocks worth flying around, filled up to three with corners of the town, [k, 2]."""
    plots = [site.block(i, j) for i, j in blocks]
    middles = np.array([(plot.p, plot.q) for plot in plots])
    corners = 0.7 * np.array([(site.plan.p[k], site.plan.q[k]) for k in (-1, 0)])
    middles = np.concatenate([middles, corners[: max(0, 3 - len(middles))]])
    return np.stack(site.plan.to_world(*middles.T), 1)


def _blocks(site: Site, grand: bool, pond_within: bool) -> np.ndarray:
    """The square in the middle, shops around it, houses further out, a park and works among them, and in a grand town
    towers and further squares; returns the landmarks [k, 2]."""
    rows, columns = len(site.plan.q) - 1, len(site.plan.p) - 1
    i0, j0 = site.plan.p_main - 1, site.plan.q_main
    cells = [(i, j) for i in range(columns) for j in range(rows) if (i, j) != (i0, j0)]
    away = {cell: max(abs(cell[0] - i0), abs(cell[1] - j0)) for cell in cells}
    site.rng.shuffle(cells)
    cells.sort(key=lambda cell: away[cell])
    town_center.square(site, site.block(i0, j0))
    if pond_within:
        cells.remove(_pond_cell(site.plan))
        town_center.pond_park(site, site.block(*_pond_cell(site.plan)))
    high = _tower_blocks(cells, (i0, j0)) if grand else []
    for cell in high:
        towers(site, site.block(*cell))
    cells = [cell for cell in cells if cell not in high]
    special = [town_center.shops, town_center.park, town_center.shops, town_center.works, town_center.lawn_flats]
    for k, (i, j) in enumerate(cells):
        block = site.block(i, j)
        near = away[(i, j)] <= max(1, columns // 4)
        chance = site.rng.random()
        if near and k % 2 == 0:
            special[(k // 2) % len(special)](site, block)
        elif not near and chance < 0.22:
            (town_center.park, town_center.works, town_center.lawn_flats)[int(chance / 0.22 * 3)](site, block)
        else:
            residential_block(site, block)
    return _landmarks(site, [(i0, j0), *high])


def _traffic(site: Site) -> None:
    """Cars that drive on the right and cars parked at the kerb, street trees and lamps on the pavements."""
    plan = site.plan
    for streets, halves, others, along_q in ((plan.p, plan.p_half, plan.q, True), (plan.q, plan.q_half, plan.p, False)):
        for position, half in zip(streets, halves, strict=True):
            for start, end in pairwise(others):
                _stretch(site, position, half, (start + 13, end - 13), along_q)


def _stretch(site: Site, position: float, half: float, span: tuple[float, float], along_q: bool) -> None:
    """One street between two crossings."""
    rng = site.rng

    def at(across: float, along: float, turn: bool) -> Plot:
        return street_plot(position, across, along, along_q=along_q, backwards=turn)

    for direction in (-1, 1):
        passing = np.inf
        if rng.random() < (0.75 if half > 4 else 0.4):
            passing = rng.uniform(*span)
            lane = at(direction * 0.3 * half, passing, direction < 0)
            (props.bus if rng.random() < 0.12 else props.car)(site.builder, site.frame(lane), rng)
        for along in np.arange(span[0], span[1], 5.6):
            if rng.random() < (0.32 if half > 4 else 0.25) and abs(along - passing) > 8:
                kerb = at(direction * (half - 1.02), along, direction < 0)
                props.car(site.builder, site.frame(kerb, turn=rng.normal(0, 0.02)), rng)
        for along in np.arange(span[0] + 1, span[1], 8.5):
            verge = at(direction * (half + 0.55 * PAVEMENT), along, direction > 0)
            if half > 4 and rng.random() < 0.75:
                tree(site.builder, site.frame(verge), rng, "round", rng.uniform(4.4, 5.6))
        lamp = at(direction * (half + 0.3), rng.uniform(*span), direction < 0)
        props.lamp(site.builder, site.frame(lamp))
