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


def _serpentine(half: float, lines: int, count: int, hole: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """`count` places at equal steps along back-and-forth lines over a square, and the flying direction.

    Places within `hole` of the centre (as a square) are left out of the count. Returns [count, 2], [count].
    """
    fine = np.linspace(-half, half, 600)
    rows = np.linspace(-half, half, lines) if lines > 1 else np.zeros(1)
    path = np.concatenate(
        [
            np.stack([fine if k % 2 == 0 else fine[::-1], np.full_like(fine, row)], 1)
            for k, row in enumerate(rows)
        ]
    )
    eastward = np.repeat(np.where(np.arange(len(rows)) % 2 == 0, 1.0, -1.0), len(fine))
    kept = np.flatnonzero(np.abs(path).max(1) > hole)
    chosen = kept[np.round((np.arange(count) + 0.5) / count * len(kept) - 0.5).astype(int)]
    return path[chosen], np.where(eastward[chosen] > 0, np.pi / 2, -np.pi / 2)


def _grid(half: float, count: int, hole: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A lawn-mower grid that looks straight down: places [n, 2], tilts [n], headings [n]."""
    place, heading = _serpentine(half, max(1, round(np.sqrt(max(count, 1) * 0.9))), count, hole)
    return place, np.zeros(count), heading


def _obliques(half: float, count: int, phase: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An orbit on two radii that looks inwards, 28 to 45 degrees from straight down."""
    turn = phase + 2 * np.pi * np.arange(count) / max(count, 1)
    radius = half * np.where(np.arange(count) % 2 == 0, 0.62, 1.0)
    place = np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1)
    tilt = np.radians(np.where(np.arange(count) % 3 == 0, 42, 31))
    return place, tilt, np.arctan2(-place[:, 0], -place[:, 1])


def _mission(options: ResolvedOptions, phase: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, tilts and headings of the whole flight, in the order in which the pictures are taken."""
    half, count = options.extent_m / 2, options.images
    oblique = round(0.27 * count)
    if options.flight == "even":
        parts = [_grid(half, count - oblique), _obliques(half, oblique, phase)]
    else:
        outskirts = round(0.27 * count)
        centre = count - oblique - outskirts
        parts = [
            _grid(0.48 * half, centre),
            _grid(1.05 * half, outskirts, hole=0.55 * half),
            _obliques(half, oblique, phase),
        ]
    place, tilt, heading = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return place, tilt, heading


def fly(options: ResolvedOptions, terrain: Terrain) -> list[Camera]:
    """The cameras of the flight, jittered as wind and GPS would have it."""
    rng = np.random.default_rng([options.seed, 2])
    place, tilt, heading = _mission(options, float(rng.uniform(0, 6.28)))
    altitude = float(np.clip(0.46 * options.extent_m, 36, 80))
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
