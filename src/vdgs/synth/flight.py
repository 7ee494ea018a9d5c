"""Where the drone flies and where it looks."""

from __future__ import annotations

import numpy as np

from vdgs.cameras import Camera
from vdgs.synth.options import ResolvedOptions
from vdgs.synth.terrain import Terrain

#: Focal length over image width: a lens of about 61 degrees across.
_FOCAL = 0.85


def look_from(position: np.ndarray, tilt: float, heading: float, roll: float) -> np.ndarray:
    """`camera_from_world` [4, 4] of a camera at `position`: tilt from straight down, heading of the top of
    the image clockwise from north, roll about the viewing direction (all in radians)."""
    sin_h, cos_h = np.sin(heading), np.cos(heading)
    ahead, right = np.array([sin_h, cos_h, 0.0]), np.array([cos_h, -sin_h, 0.0])
    forward = np.sin(tilt) * ahead - np.cos(tilt) * np.array([0, 0, 1.0])
    down = np.cross(forward, right)
    x = np.cos(roll) * right + np.sin(roll) * down
    y = np.cos(roll) * down - np.sin(roll) * right
    rigid = np.eye(4)
    rigid[:3, :3] = np.stack([x, y, forward])
    rigid[:3, 3] = -rigid[:3, :3] @ position
    return rigid


def _spaced(path: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` places at equal steps along the legs [l, 2, 2] of a path, and the headings of their legs."""
    lengths = np.linalg.norm(path[:, 1] - path[:, 0], axis=1)
    ends = np.cumsum(lengths)
    travelled = (np.arange(count) + 0.5) / max(count, 1) * ends[-1]
    leg = np.searchsorted(ends, travelled)
    share = ((travelled - ends[leg] + lengths[leg]) / lengths[leg])[:, None]
    ahead = path[leg, 1] - path[leg, 0]
    return path[leg, 0] + share * ahead, np.arctan2(ahead[:, 0], ahead[:, 1])


def _grid(half: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A lawn-mower grid that looks straight down: places [n, 2], tilts [n], headings [n]."""
    lines = max(2, round(np.sqrt(count * 0.9)))
    rows = np.linspace(-half, half, lines)
    ends = half * np.where(np.arange(lines) % 2 == 0, 1, -1)
    path = np.stack([np.stack([-ends, rows], 1), np.stack([ends, rows], 1)], 1)
    place, heading = _spaced(path, count)
    return place, np.zeros(count), heading


def _circuits(inner: float, outer: float, spacing: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Square circuits around the town that look straight down, `spacing` apart, the last one at `outer`."""
    circuits = max(1, round((outer - inner) / spacing))
    radii = outer - (outer - inner) / circuits * np.arange(circuits)[::-1]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], 1)
    place, heading = _spaced((radii[:, None, None, None] * sides).reshape(-1, 2, 2), count)
    return place, np.zeros(count), heading


def _obliques(half: float, count: int, phase: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An orbit on two radii that looks inwards, 28 to 45 degrees from straight down."""
    turn = phase + 2 * np.pi * np.arange(count) / max(count, 1)
    radius = half * np.where(np.arange(count) % 2 == 0, 0.58, 0.9)
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    tilt = np.radians(np.where(np.arange(count) % 3 == 0, 42, 31))
    return place, tilt, np.arctan2(-place[:, 0], -place[:, 1])


def _mission(options: ResolvedOptions, altitude: float, phase: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, tilts and headings of the whole flight, in the order in which the pictures are taken."""
    half, count = options.extent_m / 2, options.images
    oblique = round(0.27 * count)
    if options.flight == "even":
        parts = [_grid(0.8 * half, count - oblique), _obliques(half, oblique, phase)]
    else:
        outskirts = round(0.36 * count)
        parts = [
            _grid(0.4 * half, count - oblique - outskirts),
            _circuits(0.4 * half, 0.78 * half, 0.75 * altitude, outskirts),
            _obliques(half, oblique, phase),
        ]
    place, tilt, heading = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return place, tilt, heading


def fly(options: ResolvedOptions, terrain: Terrain) -> list[Camera]:
    """The cameras of the flight, jittered as wind and GPS would have it."""
    rng = np.random.default_rng([options.seed, 2])
    altitude = float(np.clip(0.5 * options.extent_m, 36, 95))
    place, tilt, heading = _mission(options, altitude, float(rng.uniform(0, 6.28)))
    cameras = []
    for (x, y), lean, turn in zip(place, tilt, heading, strict=True):
        x, y = x + rng.normal(0, 0.012 * options.extent_m), y + rng.normal(0, 0.012 * options.extent_m)
        ground = float(terrain.undisturbed(x, y))
        height = ground + altitude * (1 + rng.normal(0, 0.025)) * (0.86 if lean > 0.1 else 1.0)
        lean = lean + np.radians(rng.normal(0, 2.0))
        turn = turn + np.radians(rng.normal(0, 4.0))
        rigid = look_from(np.array([x, y, height]), lean, turn, np.radians(rng.normal(0, 1.5)))
        focal = _FOCAL * options.width
        cameras.append(
            Camera(rigid, focal, focal, options.width / 2, options.height / 2, options.width, options.height)
        )
    return cameras
