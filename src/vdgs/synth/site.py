"""The building site: where everything of the town is put together, in plan coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.synth.mesh import MeshBuilder
from vdgs.synth.shapes import ObjectFrame
from vdgs.synth.streets import PAVEMENT, StreetPlan
from vdgs.synth.terrain import Terrain
from vdgs.synth.zones import LandUse, LandUseMap


@dataclass(frozen=True)
class Plot:
    """A rectangle of the plan, and how local (a, b) in metres from its middle lie in it.

    `turns` quarter turns bring local a (along the front) and b (towards the back) into p and q.
    """

    p: float
    q: float
    width: float
    depth: float
    quarter_turns: int = 0

    def plan(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local places to the plan."""
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.quarter_turns % 4]
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return self.p + cos * a - sin * b, self.q + sin * a + cos * b

    def part(self, a: float, b: float, width: float, depth: float) -> Plot:
        """A smaller plot around local (a, b), facing the same way."""
        p, q = self.plan(np.array(a), np.array(b))
        return Plot(float(p), float(q), width, depth, self.quarter_turns)


@dataclass(frozen=True, eq=False)
class Site:
    """Everything that is filled in while the town goes up."""

    plan: StreetPlan
    terrain: Terrain
    zones: LandUseMap
    builder: MeshBuilder
    rng: np.random.Generator

    def frame(self, plot: Plot, a: float = 0.0, b: float = 0.0, turn: float = 0.0) -> ObjectFrame:
        """A thing on the ground at local (a, b) of a plot, facing the plot's front."""
        p, q = plot.plan(np.array(a), np.array(b))
        x, y = self.plan.to_world(p, q)
        angle = self.plan.heading(float(p), float(q)) + plot.quarter_turns * np.pi / 2 + turn
        return ObjectFrame(float(x), float(y), float(self.terrain.height(x, y)), angle)

    def level(self, frame: ObjectFrame, width: float, depth: float) -> ObjectFrame:
        """The frame lifted so that no corner of a footprint lies below the ground."""
        grid = [(sx * width / 2, sy * depth / 2, 0) for sx in (-1, 0, 1) for sy in (-1, 0, 1)]
        corners = frame.to_world(np.array(grid))
        top = float(self.terrain.height(corners[:, 0], corners[:, 1]).max())
        return ObjectFrame(frame.x, frame.y, top + 0.1, frame.angle)

    def ring(self, plot: Plot, a: tuple[float, float], b: tuple[float, float]) -> np.ndarray:
        """The world outline of a local rectangle, bent as the plan is bent, [k, 2]."""
        t = np.linspace(0, 1, 8, endpoint=False)
        ones = np.ones_like(t)
        along = np.concatenate([a[0] + (a[1] - a[0]) * t, a[1] * ones, a[1] + (a[0] - a[1]) * t, a[0] * ones])
        across = np.concatenate([b[0] * ones, b[0] + (b[1] - b[0]) * t, b[1] * ones, b[1] + (b[0] - b[1]) * t])
        return np.stack(self.plan.to_world(*plot.plan(along, across)), axis=1)

    def paint(self, plot: Plot, a: tuple[float, float], b: tuple[float, float], zone: LandUse) -> None:
        """Cover a local rectangle of a plot."""
        self.zones.paint(self.ring(plot, a, b), zone)

    def paint_all(self, plot: Plot, zone: LandUse) -> None:
        """Cover a whole plot."""
        w, d = plot.width / 2, plot.depth / 2
        self.paint(plot, (-w, w), (-d, d), zone)

    def footprint(self, frame: ObjectFrame, x: tuple[float, float], y: tuple[float, float]) -> None:
        """Mark what a building covers, so that light is not baked inside it."""
        corners = frame.to_world(np.array([(x[0], y[0], 0), (x[1], y[0], 0), (x[1], y[1], 0), (x[0], y[1], 0)]))
        self.zones.paint(corners[:, :2], LandUse.BUILDING)

    def stroke(
        self, plot: Plot, points: list[tuple[float, float]], width: float, zone: LandUse, closed: bool = False
    ) -> None:
        """Draw a local polyline."""
        local = np.array(points, np.float64)
        world = np.stack(self.plan.to_world(*plot.plan(local[:, 0], local[:, 1])), axis=1)
        self.zones.stroke(world, width, zone, closed)

    def disc(self, plot: Plot, a: float, b: float, radius: float, zone: LandUse) -> None:
        """Cover a disc."""
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        world = self.plan.to_world(*plot.plan(a + radius * np.cos(angle), b + radius * np.sin(angle)))
        self.zones.paint(np.stack(world, axis=1), zone)

    def block(self, i: int, j: int) -> Plot:
        """The block between streets i, i + 1 (along q) and j, j + 1 (along p), inside its pavements."""
        plan = self.plan
        p0 = plan.p[i] + plan.p_half[i] + PAVEMENT
        p1 = plan.p[i + 1] - plan.p_half[i + 1] - PAVEMENT
        q0 = plan.q[j] + plan.q_half[j] + PAVEMENT
        q1 = plan.q[j + 1] - plan.q_half[j + 1] - PAVEMENT
        return Plot((p0 + p1) / 2, (q0 + q1) / 2, p1 - p0, q1 - q0)


def street_plot(position: float, across: float, along: float, *, along_q: bool, backwards: bool) -> Plot:
    """A place of a street at `position` of the plan, facing along the street."""
    p, q = (position + across, along) if along_q else (along, position - across)
    return Plot(p, q, 1, 1, (1 if along_q else 0) + (2 if backwards else 0))


def rotate_plot(plot: Plot, turns: int) -> Plot:
    """The same rectangle seen from another side: its front is where local b is least."""
    swap = turns % 2 == 1
    width, depth = (plot.depth, plot.width) if swap else (plot.width, plot.depth)
    return Plot(plot.p, plot.q, width, depth, plot.quarter_turns + turns)
