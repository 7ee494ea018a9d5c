"""Positions and photographs that contradict each other: one is believed only where it is clear which, and errors are
as large as what nothing decides."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures.position_fit import PositionFit, Problem, Up, fit_positions
from vdgs.captures.up_axis import up_by_views

pytestmark = pytest.mark.slow

NADIR = np.diag([1.0, -1, -1])


def fit_of(places: np.ndarray, recorded: np.ndarray, up: Up) -> PositionFit:
    """The fit of cameras at `places` [n, 3], one after the other; their world is the true one."""
    return fit_positions(Problem(centers=places, targets=recorded, times=np.linspace(0, 1, len(places)), up=up))


def tilt_deg(fit: PositionFit) -> float:
    return float(np.degrees(np.arccos(np.clip(fit.similarity.rotation[2, 2], -1, 1))))


def facade(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Cameras [20, 3] in four columns up and down, 20 m before a wall north of them, held level, and their rotations."""
    heights = [5.0, 9, 13, 17, 21]
    places = np.array([[6 * c - 9, -20, z] for c in range(4) for z in heights[:: 1 if c % 2 == 0 else -1]])
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rotations = [level @ Rotation.from_euler("xyz", rng.normal(0, 1, 3), degrees=True).as_matrix() for _ in places]
    return places + rng.normal(0, 0.3, places.shape), np.array(rotations)


@pytest.mark.parametrize("ground", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_a_facade_stands_where_its_positions_have_it(ground, seed):
    """Whatever share of the points is of the ground before it: none of it may be taken for a flight that looks down."""
    rng = np.random.default_rng(seed)
    places, rotations = facade(rng)
    points = rng.uniform([-15, -0.3, 0], [15, 0.3, 22], (600, 3))
    flat = rng.random(600) < ground
    points[flat] = rng.uniform([-15, -12, -0.2], [15, 0, 0.2], (int(flat.sum()), 3))
    direction, deviation, sure = up_by_views(places, rotations, points)
    assert not sure or direction[2] > 0.9
    fit = fit_of(places, places + rng.normal(0, 1, places.shape) * [0.5, 0.5, 0.8], Up(direction, deviation, "", sure))
    assert tilt_deg(fit) < 5
    assert not fit.why_refused("EXIF")
    assert abs(fit.similarity.scale - 1) < max(0.05, fit.scale_error)


def test_a_slope_is_told_from_a_look_aside_by_cameras_that_turn():
    """Terrain and flight tilted alike: cameras that fly back and forth hang as they hang, and look down on average."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(5) * 12.0, np.arange(4) * 14.0)
    places = np.stack([x.ravel(), y.ravel(), 45 + 0.4 * y.ravel()], axis=1)
    ground = rng.uniform([-20, -20, 0], [70, 60, 1], (500, 3))
    ground[:, 2] += 0.4 * ground[:, 1]
    lean = Rotation.from_euler("x", 5, degrees=True).as_matrix()
    there_and_back, one_way = (
        np.array([lean @ NADIR @ Rotation.from_euler("z", turn * (k // 5 % 2), degrees=True).as_matrix()
                  for k in range(20)])
        for turn in (180.0, 0.0)
    )  # fmt: skip
    up, deviation, _ = up_by_views(places, there_and_back, ground)
    assert np.degrees(np.arccos(up[2])) < deviation <= 3
    up, deviation, _ = up_by_views(places, one_way, ground)
    assert 5 < deviation


def along_a_slope(climb_deg: float = 22.0) -> np.ndarray:
    """Four strips of five photographs that keep their height over a hillside."""
    x, y = np.meshgrid(np.arange(5) * 12.0, np.arange(4) * 14.0)
    return np.stack([x.ravel(), y.ravel(), 500 + np.tan(np.radians(climb_deg)) * y.ravel()], axis=1)


def views(off_deg: float, deviation_deg: float = 3.0) -> Up:
    """Up that is off by an angle, to the north."""
    off = np.radians(off_deg)
    return Up(np.array([0, np.sin(off), np.cos(off)]), deviation_deg, "the views")


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_heights_over_the_ground_are_not_taken_for_altitudes(noise, seed):
    rng = np.random.default_rng(seed)
    places = along_a_slope()
    recorded = places + rng.normal(0, 0.5, places.shape)
    recorded[:, 2] = 45 + rng.normal(0, noise, len(places))
    fit = fit_of(places, recorded, views(-2))
    assert fit.altitude == "none"
    assert tilt_deg(fit) < fit.level_error_deg < 10
    assert abs(fit.similarity.scale - 1) < 2 * fit.scale_error


@pytest.mark.parametrize("climb_deg", [0.0, 5.0, 22.0])
@pytest.mark.parametrize("off_deg", [-4.0, 0.0, 4.0])
def test_altitudes_of_a_receiver_are_used_along_a_slope_and_over_level_ground(climb_deg, off_deg):
    rng = np.random.default_rng(2)
    places = along_a_slope(climb_deg)
    fit = fit_of(places, places + rng.normal(0, 0.5, places.shape), views(off_deg))
    assert fit.altitude == "used"
    assert tilt_deg(fit) < 3
