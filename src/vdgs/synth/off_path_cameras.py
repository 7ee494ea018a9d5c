"""Views from where nobody flew, for measuring what a person sees who leaves the path of the flight.

Three sets: `low_oblique`, at 0.4 of the flying height, 60 degrees from straight down; `street`, at eye level along the
streets; `outside`, from beyond the flown land, towards the middle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.flight_cameras import flight_altitude, make_camera, pose_from_angles
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.synth_options import ResolvedOptions
from vdgs.synth.town import Town
from vdgs.synth.true_visibility import view_ground_truth

_LOW_SHARE, _LOW_TILT = 0.4, np.radians(60)
#: Eye level (m): that of a person who holds a camera up.
_EYE_LEVEL = 2.5
#: From how far out the views from outside look, in halves of the flown extent, and from how high, in flying heights.
_OUTSIDE = (1.2, 1.5)
_OUTSIDE_HEIGHT = (0.4, 0.7)
#: Poses tried for each view, of which the best is taken: that shows most of what three photographs truly see.
_TRIES = 8
_SEEN_BY = 3
#: Nothing may stand nearer to a camera than this (m), and no street view may look at a wall nearer than that.
_CLEARANCE, _STREET_CLEARANCE = 1.5, 10.0

OFF_PATH_SETS = ("low_oblique", "street", "outside")

_Guess = Callable[[int, np.random.Generator], np.ndarray]


def make_off_path_cameras(
    tracer: RayTracer, town: Town, training: list[Camera], visible_points: np.ndarray, count: int,
    options: ResolvedOptions,
) -> dict[str, list[Camera]]:  # fmt: skip
    """`count` cameras of each set, among places [n, 3] (m) that training truly sees."""
    altitude, half = flight_altitude(options, town.tallest), options.extent_m / 2
    x, y, z = visible_points.T
    flown = np.abs(visible_points[:, :2]).max(axis=1) < half
    on_ground = flown & (np.abs(z - town.terrain.height(x, y)) < 0.3)
    targets = visible_points[flown] if flown.any() else visible_points
    ground = visible_points[on_ground] if on_ground.any() else targets

    def low_oblique(_: int, rng: np.random.Generator) -> np.ndarray:
        target, heading = targets[rng.integers(len(targets))], rng.uniform(0, 2 * np.pi)
        back = _LOW_SHARE * altitude * np.tan(_LOW_TILT)
        place = target - back * np.array([np.sin(heading), np.cos(heading), 0.0])
        return _pose(town, place, _LOW_SHARE * altitude, _LOW_TILT, heading)

    def street(_: int, rng: np.random.Generator) -> np.ndarray:
        place = ground[rng.integers(len(ground))]
        return _pose(town, place, _EYE_LEVEL, np.radians(rng.uniform(83, 90)), rng.uniform(0, 2 * np.pi))

    def outside(index: int, rng: np.random.Generator) -> np.ndarray:
        bearing = 2 * np.pi * (index + rng.uniform(-0.3, 0.3)) / count
        away, height = half * rng.uniform(*_OUTSIDE), altitude * rng.uniform(*_OUTSIDE_HEIGHT)
        place = away * np.array([np.sin(bearing), np.cos(bearing), 0.0])
        return _pose(town, place, height, np.arctan2(away, height), bearing + np.pi)

    guesses: dict[str, tuple[_Guess, float]] = {
        "low_oblique": (low_oblique, _CLEARANCE),
        "street": (street, _STREET_CLEARANCE),
        "outside": (outside, _CLEARANCE),
    }
    return {
        name: [
            _best(tracer, training, index, *guesses[name], options, np.random.default_rng([options.seed, 11, s, index]))
            for index in range(count)
        ]
        for s, name in enumerate(OFF_PATH_SETS)
    }


def _pose(town: Town, place: np.ndarray, height: float, tilt: float, heading: float) -> np.ndarray:
    """A camera so high (m) above the ground of a place."""
    x, y = place[:2]
    at = np.array([x, y, float(town.terrain.height_without_ponds(x, y)) + height])
    return pose_from_angles(at, tilt, heading, 0.0)


def _best(
    tracer: RayTracer, training: list[Camera], index: int, guess: _Guess, clearance: float, options: ResolvedOptions,
    rng: np.random.Generator,
) -> Camera:  # fmt: skip
    """Of some guesses the camera with the largest share of pixels that enough photographs truly see."""
    cameras = [make_camera(guess(index, rng), options) for _ in range(_TRIES)]
    return max(cameras, key=lambda camera: _seen_share(tracer, training, camera, clearance, options))


def _seen_share(
    tracer: RayTracer, training: list[Camera], camera: Camera, clearance: float, options: ResolvedOptions
) -> float:
    """The share of seen pixels; below zero where something stands too near."""
    depth, views = view_ground_truth(tracer, camera, training, step=max(1, options.width // 24))
    middle = np.median(depth[:, depth.shape[1] // 3 : 2 * depth.shape[1] // 3])
    too_near = float(depth.min()) < _CLEARANCE or float(middle) < clearance
    return float((views >= _SEEN_BY).mean()) - float(too_near)
