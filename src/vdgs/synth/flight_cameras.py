"""The flight: a mission's photographs as cameras, jittered as wind and GPS would have it."""

from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.synth.flight_plans import FLIGHT_PLANS, FlightArea, altitude_for_overlap
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.synth_options import ResolvedOptions
from vdgs.synth.terrain import Terrain
from vdgs.synth.town import Town
from vdgs.synth.true_visibility import view_ground_truth

#: Focal length over image width: a lens of about 61 degrees across.
FOCAL_FACTOR = 0.85
#: No drone of ours flies higher (m).
_MAX_ALTITUDE = 400.0
#: Share of a picture's surface that at least one, and at least two, training photographs must truly see (choice): where
#: nothing was seen there is nothing to measure.
_MIN_SEEN_ONCE, _MIN_SEEN_TWICE = 0.9, 0.75
#: How many poses are tried for a part before the best of them is taken.
_MAX_TRIES = 10
#: Tilts up to this (rad) are as good as any; where a part lies far off, the least tilt that reaches it is taken.
_EASY_TILT = np.radians(45)
_MAX_TILT = np.radians(62)
#: Tilt of every second test photograph of a flight that shows the horizon (rad).
_HORIZON_TILT = np.radians(79)


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
    altitude = altitude_for_overlap(options.extent_m, options.num_images, options.overlap, FOCAL_FACTOR)
    lowest = 1.4 * tallest
    if not lowest <= altitude <= _MAX_ALTITUDE:
        raise VdgsError(
            f"--overlap {options.overlap:g} with {options.num_images} photographs over {options.extent_m:g} m needs an "
            f"altitude of {altitude:.0f} m; it must lie between {lowest:.0f} and {_MAX_ALTITUDE:.0f}. "
            "Change --overlap, --num-images or --extent-m."
        )
    return altitude


def make_flight_cameras(options: ResolvedOptions, town: Town) -> list[Camera]:
    """The cameras of the flight, in the order in which the pictures are taken."""
    rng = np.random.default_rng([options.seed, 2])
    altitude = flight_altitude(options, town.tallest)
    half, phase = options.extent_m / 2, float(rng.uniform(0, 6.28))
    mission = FLIGHT_PLANS[options.flight](
        FlightArea(
            half=half,
            altitude=altitude,
            count=options.num_images,
            phase=phase,
            plan=town.plan,
            landmarks=town.landmarks,
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


def make_test_cameras(
    tracer: RayTracer,
    terrain: Terrain,
    training: list[Camera],
    visible_points: np.ndarray,
    count: int,
    options: ResolvedOptions,
    rng: np.random.Generator,
) -> list[Camera]:
    """`count` cameras that look at places all over `seen` [n, 3] (m): what the training cameras truly see."""
    if count == 0:
        return []
    _, part = kmeans2(visible_points[:, :2], min(count, len(visible_points)), minit="++", seed=rng)
    cameras = [
        _aim_camera(
            tracer,
            terrain,
            training,
            _central_point(visible_points[part == k] if (part == k).any() else visible_points),
            options,
            rng,
        )
        for k in range(count)
    ]
    if options.flight == "horizon":
        cameras[1::2] = [_raised(camera, options) for camera in cameras[1::2]]
    return cameras


def _raised(camera: Camera, options: ResolvedOptions) -> Camera:
    """A camera at the same place with the same heading that shows the horizon."""
    x, y, _ = camera.forward
    return make_camera(pose_from_angles(camera.position, _HORIZON_TILT, float(np.arctan2(x, y)), 0.0), options)


def _central_point(points: np.ndarray) -> np.ndarray:
    """The place nearest to the middle of some places [n, 3]."""
    away = np.linalg.norm(points[:, :2] - points[:, :2].mean(0), axis=1)
    return points[away.argmin()]


def _aim_camera(
    tracer: RayTracer,
    terrain: Terrain,
    training: list[Camera],
    target: np.ndarray,
    options: ResolvedOptions,
    rng: np.random.Generator,
) -> Camera:
    """A camera that looks at a place from where the drone has been, and of which training saw nearly everything."""
    best, best_share = None, -1.0
    for _ in range(_MAX_TRIES):
        camera = _pose(terrain, training, target, options, rng)
        depth, views = view_ground_truth(tracer, camera, training, step=max(1, options.width // 24))
        surface = np.isfinite(depth)
        once, twice = (views[surface] >= 1).mean(), (views[surface] >= 2).mean()
        if once >= _MIN_SEEN_ONCE and twice >= _MIN_SEEN_TWICE:
            return camera
        if once + twice > best_share:
            best, best_share = camera, once + twice
    assert best is not None
    return best


def _pose(
    terrain: Terrain, training: list[Camera], target: np.ndarray, options: ResolvedOptions, rng: np.random.Generator
) -> Camera:
    """One guess: from beside some training camera, at about its height, aimed somewhere about the target."""
    positions = np.stack([camera.position for camera in training])
    height = positions[:, 2] - target[2]
    spread = 0.25 * float(np.median(height))
    moved = positions + rng.normal(0, 1, positions.shape) * [spread, spread, 0.05 * spread]
    across = target[:2] - moved[:, :2] + rng.normal(0, 0.3 * spread, (len(moved), 2))
    tilt = np.arctan2(np.linalg.norm(across, axis=1), moved[:, 2] - target[2])
    easy = np.flatnonzero(tilt < _EASY_TILT)
    chosen = int(rng.choice(easy)) if len(easy) else int(tilt.argmin())
    x, y, _ = moved[chosen]
    climb = positions[chosen, 2] - float(terrain.height_without_ponds(*positions[chosen, :2]))
    position = np.array([x, y, float(terrain.height_without_ponds(x, y)) + climb * (1 + rng.normal(0, 0.02))])
    heading = np.arctan2(across[chosen, 0], across[chosen, 1])
    lean = min(float(tilt[chosen]), _MAX_TILT)
    return make_camera(pose_from_angles(position, lean, heading, np.radians(rng.normal(0, 1.5))), options)
