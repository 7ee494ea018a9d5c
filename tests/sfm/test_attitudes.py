"""Up by recorded attitudes, of which some are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.flown_models import flown_model
from vdgs.captures.turned_views import tilt_of_views
from vdgs.sfm.attitude_tilt import tilt_of_attitudes
from vdgs.sfm.image_metadata import attitude_from_gimbal
from vdgs.sfm.up_direction import up_of

TILT = np.radians([3.0, -2.0])


def tilted(
    yaws: np.ndarray, hangs_deg: float, scatter_deg: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations of cameras in a world that is tilted by TILT, and the gravity that the drone records in them."""
    world = Rotation.from_rotvec([-TILT[1], TILT[0], 0]).as_matrix()
    hangs = Rotation.from_euler("x", hangs_deg, degrees=True).as_matrix()
    rotations, gravity = [], []
    for yaw in yaws:
        recorded = attitude_from_gimbal(yaw, -80.0, 0.0)
        noise = Rotation.from_rotvec(rng.normal(0, np.radians(scatter_deg), 3)).as_matrix()
        rotations.append(noise @ hangs @ recorded.camera_from_enu @ world)
        gravity.append(recorded.gravity)
    return np.array(rotations), np.array(gravity)


def test_the_tilt_of_views_is_that_from_straight_down():
    ways = ((0.0, -90.0), (90.0, -80.0), (200.0, -30.0))  # of a gimbal, which is level at 0
    views = [attitude_from_gimbal(yaw, pitch, 0.0).camera_from_enu for yaw, pitch in ways]
    assert tilt_of_views(np.array(views)) == pytest.approx(10)
    assert tilt_of_views(np.array(views[2:])) == pytest.approx(60)


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_all_attitudes_that_scatter_count_however_the_camera_hangs(share):
    """As by least squares of all: strips one way and the other, of which one may be rare, are no outliers."""
    rng = np.random.default_rng(0)
    yaws = np.where(np.arange(40) < 40 * share, 90.0, -90.0)
    left_out, off = 0, []
    for _ in range(20):
        rotations, gravity = tilted(yaws, 3.0, 0.3, rng)
        tilt, several, agree = tilt_of_attitudes(rotations, gravity)
        assert several
        left_out += (~agree).sum()
        off.append(tilt - TILT)
    assert left_out <= 0.01 * 20 * 40
    assert np.degrees(np.sqrt(np.square(off).mean())) < 0.1


def test_two_kinds_of_attitudes_that_are_some_degrees_apart_both_count():
    """As of a gimbal that lags there and back: neither is wrong, and the rarer one is worth as much."""
    rng = np.random.default_rng(2)
    yaws = np.full(18, 90.0)
    rotations, gravity = tilted(yaws, 0.0, 0.3, rng)
    lags = np.where(np.arange(18) < 11, 1.2, -1.2)[:, None]
    gravity = Rotation.from_euler("x", lags, degrees=True).apply(gravity)
    tilt, several, agree = tilt_of_attitudes(rotations, gravity)
    assert not several
    assert agree.all()
    assert np.degrees(np.linalg.norm(tilt - TILT)) == pytest.approx(1.2 * 4 / 18, abs=0.2)


@pytest.mark.parametrize("wrong_deg", [20.0, 45.0, 80.0])
def test_a_minority_of_wrong_attitudes_tilts_nothing(wrong_deg):
    rng = np.random.default_rng(1)
    rotations, gravity = tilted(np.where(np.arange(40) % 8 < 4, 90.0, -90.0), 2.0, 0.3, rng)
    wrong = rng.permutation(40)[:12]
    gravity[wrong] = gravity[wrong] @ Rotation.from_euler("x", wrong_deg, degrees=True).as_matrix().T
    tilt, _, agree = tilt_of_attitudes(rotations, gravity)
    assert np.flatnonzero(~agree).tolist() == sorted(wrong.tolist())
    assert np.degrees(np.linalg.norm(tilt - TILT)) < 0.3


@pytest.mark.parametrize("pitch_deg", [0.0, -45.0])
def test_altitudes_are_used_where_a_fifth_of_the_attitudes_is_wrong(pitch_deg):
    rng = np.random.default_rng(3)
    places = np.array([[20.0 * (k % 5), 20.0 * (k // 5), 80] for k in range(20)])
    model, photographs = flown_model(places, rng)
    for k in (2, 7, 11, 16):
        photographs[k].attitude = attitude_from_gimbal(90.0, pitch_deg, 0.0)
    up, notes = up_of(model, photographs)
    assert np.degrees(np.arccos(up.direction[2])) < 1
    assert notes == ["4 of 20 recorded attitudes contradict the others, and are not used."]
