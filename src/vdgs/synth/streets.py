"""The street plan: a grid bent by a smooth warp, so that no street is quite straight.

Everything in the town is placed in plan coordinates (p, q), in metres, in which streets are straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PAVEMENT = 1.9
KERB_RADIUS = 2.6


@dataclass(frozen=True, eq=False)
class NearestStreet:
    """Places beside a street (m, [n] float32).

    Signed offset from its center line, distance outside its carriageway (negative: on it), half the
    carriageway's width, and whether the street has ended there ([n] bool).
    """

    offset: np.ndarray
    outside: np.ndarray
    half: np.ndarray
    ended: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class StreetPlan:
    """Streets along q at each `p`, streets along p at each `q`; half widths are of the carriageway."""

    p: np.ndarray
    q: np.ndarray
    p_half: np.ndarray
    q_half: np.ndarray
    p_main: int
    q_main: int
    angle: float
    phases: tuple[float, float]
    bend: float

    def to_plan(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World to plan coordinates."""
        cos, sin = np.float32(np.cos(self.angle)), np.float32(np.sin(self.angle))
        u, v = cos * x + sin * y, cos * y - sin * x
        a, b = np.float32(self.phases[0]), np.float32(self.phases[1])
        amplitude, rate = np.float32(self.bend), np.float32(1 / 46)
        return u + amplitude * np.sin(v * rate + a), v + amplitude * np.sin(u * rate + b)

    def to_world(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Plan to world coordinates, by fixed-point iteration of the warp."""
        p, q = np.asarray(p, np.float64), np.asarray(q, np.float64)
        u, v = p, q
        for _ in range(12):
            u, v = (p - self.bend * np.sin(v / 46 + self.phases[0]), q - self.bend * np.sin(u / 46 + self.phases[1]))
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return cos * u - sin * v, sin * u + cos * v

    def heading(self, p: float, q: float) -> float:
        """World direction (rad) of the plan's p axis at a place."""
        x, y = self.to_world(np.array([p - 2, p + 2]), np.array([q, q]))
        return float(np.arctan2(y[1] - y[0], x[1] - x[0]))

    def nearest_street(self, p: np.ndarray, q: np.ndarray) -> tuple[NearestStreet, NearestStreet]:
        """What places in the plan [n] are beside: the nearest street along q, and the nearest along p."""
        return (
            self._nearest(p, q, self.p, self.p_half, self.q, self.q_half, self.p_main),
            self._nearest(q, p, self.q, self.q_half, self.p, self.p_half, self.q_main),
        )

    @staticmethod
    def _nearest(
        across: np.ndarray,
        along: np.ndarray,
        positions: np.ndarray,
        halves: np.ndarray,
        ends: np.ndarray,
        end_halves: np.ndarray,
        main: int,
    ) -> NearestStreet:
        index = np.searchsorted((positions[1:] + positions[:-1]) / 2, across)
        offset = (across - positions.astype(np.float32)[index]).astype(np.float32)
        half = halves.astype(np.float32)[index]
        outside = np.abs(offset) - half
        # a street ends at the far edge of the last street that crosses it; main streets never do
        past = np.maximum(ends[0] - end_halves[0] - along, along - ends[-1] - end_halves[-1])
        past = np.where(index == main, 0, np.maximum(past, 0)).astype(np.float32)
        around_end = np.hypot(np.maximum(outside, 0), past)
        return NearestStreet(offset, np.where(past > 0, around_end, outside), half, past > 0)


def make_street_plan(rng: np.random.Generator, extent: float) -> StreetPlan:
    """A plan for a town of about `extent` metres: a street every 42 m or so, two main ones that go on."""
    cells = max(2, round(extent / 42))
    spacing = 42.0

    def positions() -> np.ndarray:
        steps = spacing + rng.uniform(-2.5, 2.5, cells)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return along - along[-1] / 2

    p_main, q_main = (cells + 1) // 2, cells // 2
    p_half, q_half = np.full(cells + 1, 3.5), np.full(cells + 1, 3.5)
    p_half[p_main] = q_half[q_main] = 4.5
    return StreetPlan(
        p=positions(),
        q=positions(),
        p_half=p_half,
        q_half=q_half,
        p_main=p_main,
        q_main=q_main,
        angle=float(rng.uniform(0.2, 0.45)),
        phases=(float(rng.uniform(0, 6)), float(rng.uniform(0, 6))),
        bend=3.6,
    )
