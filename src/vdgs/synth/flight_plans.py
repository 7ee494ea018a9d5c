"""Missions: where a drone takes its images, and where it looks, before wind and GPS disturb it.

Each mission sees the town unevenly in its own way; `imbalance` measures how. A *climb* is a height above ground as a
share of the flight's altitude.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vdgs.synth.streets import StreetPlan

#: A photograph's height over its width.
_ASPECT = 0.75
#: Altitude factor of oblique photographs: they are taken lower than those that look straight down.
_OBLIQUE_FACTOR = 0.86
#: That of the upper part of a flight of two heights.
_HIGH_FACTOR = 4.0
#: An area is wide if half its side is more than so many altitudes.
_WIDE = 2.0
_GOLDEN = np.pi * (3 - 5**0.5)


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """Position [n, 2] m; tilt from straight down and heading clockwise from north [n] rad; altitude_factor [n]: height
    above ground over the altitude of the flight."""

    position_xy: np.ndarray
    tilt: np.ndarray
    heading: np.ndarray
    altitude_factor: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightArea:
    """What a mission is planned over: half the side of the square to cover and the altitude (m), how many photographs,
    an angle to begin at (rad), the streets, and the landmarks [k, 2] m, the chief one first."""

    half: float
    altitude: float
    count: int
    phase: float
    plan: StreetPlan
    landmarks: np.ndarray


def _down(position: np.ndarray, heading: np.ndarray) -> FlightPlan:
    """Photographs that look straight down."""
    return FlightPlan(position, np.zeros(len(position)), heading, np.ones(len(position)))


def _joined(parts: list[FlightPlan]) -> FlightPlan:
    """One mission after the other."""
    return FlightPlan(
        *(np.concatenate(values) for values in zip(*(vars(part).values() for part in parts), strict=True))
    )


def _spaced(path: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` places at equal steps along the legs [l, 2, 2] of a path, and the headings of their legs."""
    lengths = np.linalg.norm(path[:, 1] - path[:, 0], axis=1)
    ends = np.cumsum(lengths)
    travelled = (np.arange(count) + 0.5) / max(count, 1) * ends[-1]
    leg = np.minimum(np.searchsorted(ends, travelled), len(path) - 1)
    share = ((travelled - ends[leg] + lengths[leg]) / lengths[leg])[:, None]
    ahead = path[leg, 1] - path[leg, 0]
    return path[leg, 0] + share * ahead, np.arctan2(ahead[:, 0], ahead[:, 1])


def _grid(half: float, count: int) -> FlightPlan:
    """A lawn-mower grid that looks straight down."""
    lines = max(2, round(np.sqrt(count * 0.9)))
    rows = np.linspace(-half, half, lines)
    ends = half * np.where(np.arange(lines) % 2 == 0, 1, -1)
    path = np.stack([np.stack([-ends, rows], 1), np.stack([ends, rows], 1)], 1)
    return _down(*_spaced(path, count))


def _circuits(inner: float, outer: float, spacing: float, count: int) -> FlightPlan:
    """Square circuits around the town that look straight down, `spacing` apart, the last one at `outer`."""
    circuits = max(1, round((outer - inner) / spacing))
    radii = outer - (outer - inner) / circuits * np.arange(circuits)[::-1]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], 1)
    return _down(*_spaced((radii[:, None, None, None] * sides).reshape(-1, 2, 2), count))


def _obliques(half: float, count: int, phase: float) -> FlightPlan:
    """An orbit on two radii that looks inwards, 28 to 45 degrees from straight down."""
    turn = phase + 2 * np.pi * np.arange(count) / max(count, 1)
    radius = half * np.where(np.arange(count) % 2 == 0, 0.58, 0.9)
    position = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    tilt = np.radians(np.where(np.arange(count) % 3 == 0, 42, 31))
    return FlightPlan(position, tilt, np.arctan2(-position[:, 0], -position[:, 1]), np.full(count, _OBLIQUE_FACTOR))


def _even(over: FlightArea) -> FlightPlan:
    oblique = round(0.27 * over.count)
    return _joined([_grid(0.8 * over.half, over.count - oblique), _obliques(over.half, oblique, over.phase)])


def _uneven(over: FlightArea) -> FlightPlan:
    """Dense over the center, sparse circuits around it, obliques; over a wide area the center is a small part of it."""
    wide = over.half > _WIDE * over.altitude
    center, outer, spacing, orbit = (0.25, 0.8, 1.0, 0.5) if wide else (0.4, 0.78, 0.75, 1.0)
    oblique, outskirts = (round(share * over.count) for share in ((0.2, 0.22) if wide else (0.27, 0.36)))
    return _joined(
        [
            _grid(center * over.half, over.count - oblique - outskirts),
            _circuits(center * over.half, outer * over.half, spacing * over.altitude, outskirts),
            _obliques(orbit * over.half, oblique, over.phase),
        ]
    )


def _distant(over: FlightArea) -> FlightPlan:
    """A dense grid over the middle, and photographs that look far out: inwards across it, and away from it."""
    far = round(0.3 * over.count)
    turn = over.phase + _GOLDEN * np.arange(far)
    radius = over.half * (0.25 + 0.35 * ((np.arange(far) * 0.618) % 1))
    position = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    outwards = np.arange(far) % 3 != 0
    heading = np.arctan2(position[:, 0], position[:, 1]) + np.where(outwards, 0, np.pi)
    looking = FlightPlan(position, np.radians(np.where(outwards, 60.0, 54.0)), heading, np.full(far, _OBLIQUE_FACTOR))
    return _joined([_grid(0.3 * over.half, over.count - far), looking])


def _orbits(over: FlightArea) -> FlightPlan:
    """Two rings of photographs about each landmark, all looking at its foot."""
    centers = np.resize(np.arange(len(over.landmarks)), over.count)
    rank = np.arange(over.count) // len(over.landmarks)
    rings = np.where(rank % 2 == 0, 0.75, 1.25) * over.altitude
    turn = over.phase + centers + 2 * np.pi * rank / max(1, over.count // len(over.landmarks))
    away = np.stack([np.cos(turn), np.sin(turn)], 1)
    climb = np.where(rank % 2 == 0, 0.95, _OBLIQUE_FACTOR)
    tilt = np.arctan2(rings, climb * over.altitude)
    position = over.landmarks[centers] + rings[:, None] * away
    return FlightPlan(position, tilt, np.arctan2(-away[:, 0], -away[:, 1]), climb)


def _corridor(over: FlightArea) -> FlightPlan:
    """Three lanes along the main street and beyond its ends: straight down in the middle, aslant at the sides."""
    lane = np.arange(over.count) % 3 - 1
    q = np.linspace(-1.25, 1.25, over.count) * over.half
    p = over.plan.p[over.plan.p_main] + 0.3 * over.altitude * lane
    position = np.stack(over.plan.to_world(p, q), 1)
    ahead = np.stack(over.plan.to_world(p, q + 2.0), 1) - position
    heading = np.arctan2(ahead[:, 0], ahead[:, 1]) + np.where(lane > 0, np.pi, 0)
    tilt = np.radians(np.where(lane == 0, 0.0, 35.0))
    return FlightPlan(position, tilt, heading, np.where(lane == 0, 1.0, _OBLIQUE_FACTOR))


def _horizon(over: FlightArea) -> FlightPlan:
    """An even grid, and photographs from all over it that look nearly level, across it and away from it: the horizon
    lies 8 or 15 degrees above their middle."""
    level = round(0.4 * over.count)
    turn = over.phase + _GOLDEN * np.arange(level)
    radius = over.half * (0.2 + 0.6 * ((np.arange(level) * 0.618) % 1))
    position = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    heading = np.arctan2(position[:, 0], position[:, 1]) + np.where(np.arange(level) % 2 == 0, 0, np.pi)
    tilt = np.radians(np.where(np.arange(level) % 4 < 2, 75.0, 82.0))
    looking = FlightPlan(position, tilt, heading, np.full(level, _OBLIQUE_FACTOR))
    return _joined([_grid(0.8 * over.half, over.count - level), looking])


def _heights(over: FlightArea) -> FlightPlan:
    """An even flight, and a grid from four times as high, of a third of the photographs."""
    high = round(over.count / 3)
    above = replace(_grid(0.6 * over.half, high), altitude_factor=np.full(high, _HIGH_FACTOR))
    return _joined([_even(replace(over, count=over.count - high)), above])


#: The missions by the name of the option `--flight`.
FLIGHT_PLANS: dict[str, Callable[[FlightArea], FlightPlan]] = {
    "even": _even,
    "uneven": _uneven,
    "distant": _distant,
    "orbits": _orbits,
    "corridor": _corridor,
    "horizon": _horizon,
    "heights": _heights,
}


def altitude_for_overlap(extent: float, count: int, overlap: float, focal: float) -> float:
    """The altitude (m) at which `count` photographs, were they an even grid over `extent` metres a side, would each
    share `overlap` of their side with the next (mean of the two sides of the picture; `focal` in image widths)."""
    return float(extent / np.sqrt(count) / (1 - overlap) / (np.sqrt(_ASPECT) / focal))
