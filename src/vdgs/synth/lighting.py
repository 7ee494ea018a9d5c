"""Sun, sky, and how much of the sky every bit of ground can see."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np

from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.terrain import Terrain
from vdgs.synth.zones import LandUse, LandUseMap

SUN = np.array([-0.52, -0.44, 0.78], np.float32)
SUN = SUN / np.linalg.norm(SUN)
SUN_COLOR = np.array([2.75, 2.45, 1.98], np.float32)
SKY_COLOR = np.array([0.46, 0.62, 0.92], np.float32)
BOUNCE_COLOR = np.array([0.26, 0.24, 0.17], np.float32)
HORIZON_COLOR = np.array([0.80, 0.88, 0.98], np.float32)

#: Side of a cell (m), twice that on maps larger than `_LARGE` (m from the middle).
_CELL, _LARGE = 0.5, 300.0
_RAYS = 32
#: Points in a row of a lookup, and points whose rays are cast at a time.
_ROW = 16384
_AT_ONCE = 1 << 15


@dataclass(frozen=True, eq=False)
class SkyMap:
    """Share of the sky that the ground sees, on a raster around the origin; 1 outside it."""

    openness: np.ndarray
    half_size: float
    cell: float
    #: Whether clouds are in the sky, and what is far fades into the color of the horizon.
    is_cloudy: bool = False

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Openness at world points by bilinear interpolation, [n] float32."""
        u = ((x + self.half_size) / self.cell - 0.5).astype(np.float32)
        v = ((y + self.half_size) / self.cell - 0.5).astype(np.float32)
        # cv2.remap takes no side over 32767: fold the list into rows
        padded = -len(u) % _ROW
        u, v = (np.pad(c, (0, padded)).reshape(-1, _ROW) for c in (u, v))
        mapped = cv2.remap(self.openness, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)
        return mapped.ravel()[: mapped.size - padded]


def make_sky_map(tracer: RayTracer, terrain: Terrain, zones: LandUseMap, half_size: float, pool: Executor) -> SkyMap:
    """Cast cosine-distributed rays from the ground; what lies inside buildings is filled from around."""
    cell = _CELL if half_size < _LARGE else 2 * _CELL
    side = int(np.ceil(2 * half_size / cell))
    axis = (np.arange(side) + 0.5) * cell - half_size
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))

    def free(start: int) -> np.ndarray:
        part = slice(start, start + _AT_ONCE)
        return _openness(tracer, terrain, x[part], y[part], np.arange(len(x))[part])

    openness = np.concatenate(list(pool.map(free, range(0, len(x), _AT_ONCE)))).reshape(side, side)
    open_air = (zones.sample(x, y) != LandUse.BUILDING).reshape(side, side).astype(np.float32)
    blur = 0.55 / cell
    blurred = cv2.GaussianBlur(openness * open_air, (0, 0), blur)
    weight = cv2.GaussianBlur(open_air, (0, 0), blur)
    filled = np.where(weight > 0.02, blurred / np.maximum(weight, 0.02), 0.6).astype(np.float32)
    return SkyMap(filled, half_size, cell)


def _openness(tracer: RayTracer, terrain: Terrain, x: np.ndarray, y: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Share of the rays from the ground at x, y [n] that meet nothing within 30 m; `index` turns their pattern."""
    origins = np.stack([x, y, terrain.height(x, y) + 0.15], 1).astype(np.float32)
    free = np.zeros(len(x), np.float32)
    golden = np.pi * (3 - 5**0.5)
    turn = 2 * np.pi * ((index * 0.7548776662) % 1)
    for k in range(_RAYS):
        radius, angle = np.sqrt((k + 0.5) / _RAYS), k * golden + turn
        directions = np.stack(
            [radius * np.cos(angle), radius * np.sin(angle), np.full(len(x), np.sqrt(1 - radius**2))], 1
        )
        free += ~tracer.occluded(origins, directions.astype(np.float32), np.full(len(x), 30.0))
    return free / _RAYS


def sky_color(directions: np.ndarray) -> np.ndarray:
    """Radiance of the clear sky along unit directions, [n, 3]."""
    up = np.clip(directions[:, 2:3], 0, 1) ** np.float32(0.6)
    return HORIZON_COLOR + (SKY_COLOR * 0.75 - HORIZON_COLOR) * up


#: Distance (m) at which 1/e of the light of a surface comes through the haze.
_HAZE_DISTANCE = np.float32(2500.0)


def cloudy_sky_color(directions: np.ndarray) -> np.ndarray:
    """Radiance of a sky with clouds along unit directions, [n, 3]: waves on a plane overhead, which haze hides at the
    horizon."""
    up = np.maximum(directions[:, 2], 0)
    across = directions[:, :2] / (up + np.float32(0.08))[:, None]
    density = np.zeros_like(up)
    for octave in range(4):
        turn, scale = 2.4 * octave, 1.1 * 1.9**octave
        x = scale * (np.cos(turn) * across[:, 0] - np.sin(turn) * across[:, 1])
        y = scale * (np.sin(turn) * across[:, 0] + np.cos(turn) * across[:, 1])
        density += (np.sin(x + 1.3 * np.sin(y)) * np.cos(y + octave) / 1.6**octave).astype(np.float32)
    share = np.clip((density - 0.25) / 0.9, 0, 1) * np.clip(up / 0.12, 0, 1)
    return sky_color(directions) * (1 - share)[:, None] + share[:, None] * np.float32(1.15)


def add_haze(light: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Light [n, 3] from surfaces at distances [n] (m), after the haze between."""
    clear = np.exp(-distance / _HAZE_DISTANCE)[:, None]
    return light * clear + HORIZON_COLOR * (1 - clear)


def tone_map(radiance: np.ndarray) -> np.ndarray:
    """Linear radiance to display values in [0, 1]: a soft shoulder, then the sRGB curve (choice)."""
    x = np.maximum(radiance, 0) * np.float32(0.58)
    x = x * (x * 0.32 + 1) / (1 + x * 0.86)
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-6), 1 / 2.4) - 0.055)
