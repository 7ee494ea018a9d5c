"""The flight: a mission's photographs as cameras, jittered as wind and GPS would have it."""

from __future__ import annotations

import numpy as np

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.synth.flight_plans import FLIGHT_PLANS, FlightArea, altitude_for_overlap
from vdgs.synth.options import ResolvedOptions
from vdgs.synth.town import Town

#: Focal length over image width: a lens of about 61 degrees across.
FOCAL_FACTOR = 0.85
#: No drone of ours flies higher (m).
_MAX_ALTITUDE = 400.0


def pose_from_angles(position: np.ndarray, tilt: float, heading: float, roll: float) -> np.ndarray:
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


def make_camera(rigid: np.ndarray, options: ResolvedOptions) -> Camera:
    """The drone's camera at a pose."""
    focal = FOCAL_FACTOR * options.width
    return Camera(
        camera_from_world=rigid, fx=focal, fy=focal, cx=options.width / 2, cy=options.height / 2, width=options.width,
        height=options.height,
    )  # fmt: skip


def flight_altitude(options: ResolvedOptions, tallest: float) -> float:
    """Height above ground (m) of photographs that look straight down; clear of what is `tallest` (m).

    Raises VdgsError where the overlap asked for needs a height at which no drone can fly.
    """
    if options.overlap is None:
        return float(np.clip(0.5 * options.extent_m, 36, 95))
    altitude = altitude_for_overlap(options.extent_m, options.images, options.overlap, FOCAL_FACTOR)
    lowest = 1.4 * tallest
    if not lowest <= altitude <= _MAX_ALTITUDE:
        raise VdgsError(
            f"--overlap {options.overlap:g} with {options.images} photographs over {options.extent_m:g} m needs an "
            f"altitude of {altitude:.0f} m; it must lie between {lowest:.0f} and {_MAX_ALTITUDE:.0f}. "
            "Change --overlap, --images or --extent-m."
        )
    return altitude


def make_flight_cameras(options: ResolvedOptions, town: Town) -> list[Camera]:
    """The cameras of the flight, in the order in which the pictures are taken."""
    rng = np.random.default_rng([options.seed, 2])
    altitude = flight_altitude(options, town.tallest)
    half, phase = options.extent_m / 2, float(rng.uniform(0, 6.28))
    mission = FLIGHT_PLANS[options.flight](
        FlightArea(
            half=half, altitude=altitude, count=options.images, phase=phase, plan=town.plan, landmarks=town.landmarks
        )
    )
    cameras = []
    for (x, y), lean, turn, climb in zip(
        mission.position_xy, mission.tilt, mission.heading, mission.altitude_factor, strict=True
    ):
        x, y = x + rng.normal(0, 0.012 * options.extent_m), y + rng.normal(0, 0.012 * options.extent_m)
        ground = float(town.terrain.height_without_ponds(x, y))
        height = ground + altitude * (1 + rng.normal(0, 0.025)) * climb
        lean = lean + np.radians(rng.normal(0, 2.0))
        turn = turn + np.radians(rng.normal(0, 4.0))
        rigid = pose_from_angles(np.array([x, y, height]), lean, turn, np.radians(rng.normal(0, 1.5)))
        cameras.append(make_camera(rigid, options))
    return cameras
