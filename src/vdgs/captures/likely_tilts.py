"""How likely each direction of up is where positions have no altitudes: by what is known of up without positions, and
by how well cameras seen along it lie as the positions do. float64 throughout.

Cameras at several heights, as along a facade, tell up at once. A flight in one plane shows a tilt by the share that it
is shortened by alone, 1 - cos(tilt), to either side alike: what is likely then has two middles, and errors found at one
of them would be far too small. All directions are therefore weighed, whichever shape they have together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vdgs.captures.plane_fit import ENOUGH_TO_DOUBT, LEAST_M, in_plane

#: Directions are weighed up to so many standard deviations of up, on cells so many along each side; the likeliest
#: quarter of them is parted into four each as long as it holds all but this share.
RANGE_SIGMAS, CELLS_ALONG, LEFT_OUT = 6.0, 64, 1e-3
MOST_PARTINGS = 24
#: Tilts beyond this (degrees) are none.
MOST_TILT_DEG = 170.0


@dataclass(frozen=True, eq=False)
class Moments:
    """What cameras [n, 3], turned so that up as it was known is z, and positions in the plane [n] have in common."""

    spread: np.ndarray
    """[3, 3]."""
    shared: np.ndarray
    """[3] complex."""
    power: float
    """Of the positions about their middle."""

    @classmethod
    def of(cls, turned: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Moments:
        """Of positions that count by weights [n], 1 where all are alike."""
        away, plane = turned - np.average(turned, 0, weights), in_plane(targets)
        plane = plane - np.average(plane, weights=weights)
        weighed = away * weights[:, None]
        return cls(weighed.T @ away, weighed.T @ plane, float((weights * np.abs(plane) ** 2).sum()))

    def turned(self, rotation: np.ndarray) -> Moments:
        return Moments(rotation @ self.spread @ rotation.T, rotation @ self.shared, self.power)

    def fitted(self, ups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scale and turn to north [m], complex, of the best similarity in the plane where up [m, 3] is turned to z the
        shortest way, and the squares that it leaves [m]."""
        x, y, z = ups.T
        low = 1 + z
        east = np.stack([1 - x * x / low, -x * y / low, -x], axis=1)
        north = np.stack([-x * y / low, 1 - y * y / low, -y], axis=1)
        seen = np.trace(self.spread) - np.einsum("mi,ij,mj->m", ups, self.spread, ups)
        factor = ((east - 1j * north) @ self.shared) / np.maximum(seen, 1e-12 * np.trace(self.spread))
        return factor, np.maximum(self.power - np.abs(factor) ** 2 * seen, 0.0)


@dataclass(frozen=True, eq=False)
class Likely:
    """Directions of up and how likely each is."""

    ups: np.ndarray
    """Unit [m, 3]."""
    weights: np.ndarray
    """[m], 1 together."""

    @property
    def middle(self) -> np.ndarray:
        mean = self.weights @ self.ups
        return mean / np.linalg.norm(mean)

    @property
    def likeliest(self) -> np.ndarray:
        return np.asarray(self.ups[int(self.weights.argmax())])

    def radius_deg(self, up: np.ndarray) -> float:
        """By how many degrees `up` is off at most (95 %)."""
        off = np.degrees(np.arctan2(np.linalg.norm(np.cross(self.ups, up), axis=1), self.ups @ up))
        return self._below(off, 0.95)

    def farther_end(self, values: np.ndarray) -> float:
        """How far the farther end of the middle 95 % of values [m] of the directions lies from 0. A level strip lies at
        the end of all to one side."""
        return max(abs(self._below(values, share)) for share in (0.025, 0.975))

    def _below(self, values: np.ndarray, share: float) -> float:
        order = np.argsort(values)
        place = int(np.searchsorted(np.cumsum(self.weights[order]), share))
        return float(values[order[min(place, len(order) - 1)]])


def likely_tilts(
    moments: Moments, count: float, usual_m: float, deviation_deg: float, scale: tuple[float, float] | None
) -> Likely:
    """Directions of up by positions that are worth `count` independent ones, whose accuracy nobody knows: that of few
    is joined with `usual_m`. `scale` is what is known of the factor to metres, and its standard deviation (share)."""
    deviation = np.radians(deviation_deg)
    half = RANGE_SIGMAS * deviation / CELLS_ALONG
    along = half * (2 * np.arange(CELLS_ALONG) + 1 - CELLS_ALONG)
    tilts = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    kept = len(tilts) // 4
    for parted in range(MOST_PARTINGS + 1):
        ups = _ups(tilts)
        logs = _log_likelihood(moments, ups, count, usual_m, scale) - 0.5 * ((tilts / deviation) ** 2).sum(axis=1)
        logs[np.linalg.norm(tilts, axis=1) > np.radians(MOST_TILT_DEG)] = -np.inf
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        best = np.argsort(-weights, kind="stable")[:kept]
        if weights[best].sum() < 1 - LEFT_OUT or parted == MOST_PARTINGS:
            break
        half /= 2
        corners = half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        tilts = (tilts[best][:, None] + corners).reshape(-1, 2)
    return Likely(ups, weights)


def _ups(tilts: npt.NDArray[np.float64]) -> np.ndarray:
    """Unit [m, 3], tilted from z by angles [m, 2] in radians."""
    angle = np.linalg.norm(tilts, axis=1)
    return np.column_stack([tilts * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def _log_likelihood(
    moments: Moments, ups: np.ndarray, count: float, usual_m: float, scale: tuple[float, float] | None
) -> np.ndarray:
    factor, squares = moments.fitted(ups)
    free, variance = max(count - 2, 0.5), squares / 2
    if count < ENOUGH_TO_DOUBT:
        free, variance = max(count - 2, 0.0) + 1, variance + usual_m**2
    variance = variance + free * LEAST_M**2
    logs = -free * np.log(variance)
    if scale is not None:
        open_ = scale[1] ** 2 + variance / free / moments.power
        logs -= 0.5 * np.log(np.maximum(np.abs(factor), 1e-300) / scale[0]) ** 2 / open_ + 0.5 * np.log(open_)
    return np.asarray(logs)
