"""The first look: the whole scene, from where the flight supports it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from support.flown_captures import camera, capture_of, facade, nadir, plane
from vdgs.captures.capture import Capture
from vdgs.captures.first_view import FOV_DEG, DefaultView, default_view
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import look_at_pose

pytestmark = pytest.mark.slow


def oblique() -> Capture:
    """From the north-west alone, looking down by 45 degrees to the south-east."""
    places = [(x, y, 50.0) for x in np.arange(-100, 21, 20) for y in np.arange(-20, 101, 20)]
    return capture_of([camera(place, 45.0, 135.0) for place in places], plane(60, 60))


def upside_down() -> Capture:
    """A flight whose up axis was estimated the wrong way round: the cameras are under the ground and look up."""
    flipped = np.diag([1.0, -1.0, -1.0, 1.0])
    flight = nadir()
    cameras = [
        Camera(
            camera_from_world=view.camera.camera_from_world @ flipped, fx=300.0, fy=300.0, cx=200.0, cy=150.0,
            width=400, height=300,
        )
        for view in flight.views
    ]  # fmt: skip
    return capture_of(cameras, flight.points @ flipped[:3, :3])


def shown(look: DefaultView, points: np.ndarray, aspect: float = 1.0) -> np.ndarray:
    """Which points a canvas shows."""
    height = 600
    focal = 0.5 * height / math.tan(math.radians(FOV_DEG / 2))
    width = round(aspect * height)
    pose = look_at_pose(look.position, look.target)
    canvas = Camera(camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)
    return canvas.in_frustum(points)


FLIGHTS = {
    "nadir": nadir(), "oblique": oblique(), "corridor": nadir(10.0, 300.0), "facade": facade(),
    "upside down": upside_down(),
}  # fmt: skip


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_whole_scene_is_in_the_picture_and_fills_it(name):
    capture = FLIGHTS[name]
    look = default_view(capture)
    assert shown(look, capture.points).mean() > 0.97
    nearer = DefaultView(look.target + 0.6 * (look.position - look.target), look.target)
    assert shown(nearer, capture.points).mean() < 0.97


@pytest.mark.parametrize("name", FLIGHTS)
def test_cameras_looked_from_near_that_direction(name):
    """At the points, the nearest camera that sees them is within 25 degrees, on average."""
    capture = FLIGHTS[name]
    look, angles = default_view(capture), []
    for point in capture.points[::9]:
        ray = (look.position - point) / np.linalg.norm(look.position - point)
        seen = [view.camera for view in capture.views if view.camera.in_frustum(point[None])[0]]
        toward = np.array([each.position - point for each in seen]).reshape(-1, 3)
        if len(toward):
            cosine = (toward / np.linalg.norm(toward, axis=1, keepdims=True) @ ray).max()
            angles.append(math.degrees(math.acos(min(cosine, 1.0))))
    assert np.mean(angles) < 25.0


def elevation_deg(look: DefaultView) -> float:
    away = look.position - look.target
    return math.degrees(math.asin(away[2] / np.linalg.norm(away)))


def test_a_flight_straight_down_is_seen_from_the_south_steeply_but_not_from_straight_above():
    look = default_view(nadir())
    assert 45 <= elevation_deg(look) <= 75
    away = (look.position - look.target)[:2]
    assert away @ (0, -1) / np.linalg.norm(away) > 0.6  # north is up, but for the diagonal


def test_a_flight_from_one_side_is_seen_from_there():
    look = default_view(oblique())
    away = (look.position - look.target)[:2]
    assert away @ (-1, 1) / math.sqrt(2) / np.linalg.norm(away) > 0.6
    assert 35 <= elevation_deg(look) <= 60


def test_a_wall_is_seen_from_its_face_not_from_behind_and_not_from_below_the_ground():
    look = default_view(facade())
    assert look.position[1] > 10
    assert look.position[2] > 0
    assert elevation_deg(look) < 35


def test_nobody_stands_below_the_ground_but_where_the_cameras_do():
    for name, capture in FLIGHTS.items():
        look = default_view(capture)
        below = look.position[2] < np.quantile(capture.points[:, 2], 0.02)
        assert below == (name == "upside down")


def test_what_lies_far_behind_the_scene_does_not_count():
    capture = facade()
    hills = np.column_stack([np.linspace(-4000, 4000, 60), np.full(60, -5000.0), np.full(60, 300.0)])
    behind = capture_of([view.camera for view in capture.views], np.concatenate([capture.points, hills]))
    one, other = default_view(capture), default_view(behind)
    assert np.linalg.norm(one.position - other.position) < 0.1 * np.linalg.norm(one.position - one.target)


def test_what_fewer_than_three_cameras_see_does_not_widen_the_picture():
    capture, beyond = nadir(), np.column_stack([np.linspace(290, 310, 90), np.linspace(-20, 20, 90), np.zeros(90)])
    views = [*(view.camera for view in capture.views), *(camera((x, 0, 50), 0, 0) for x in (295, 305))]
    look = default_view(capture_of(views, np.concatenate([capture.points, beyond])))
    assert shown(look, capture.points).mean() > 0.97
    assert not shown(look, beyond).any()


def test_there_is_a_look_without_points_that_two_photographs_show():
    look = default_view(capture_of([camera((0, 0, 50), 0, 0), camera((500, 0, 50), 0, 0)], np.zeros((1, 3))))
    assert np.isfinite(look.position).all()
    assert np.linalg.norm(look.position - look.target) > 1


def test_where_views_converge_the_first_look_is_at_that_and_not_at_all_ground_behind_it():
    rng = np.random.default_rng(3)
    tower = rng.uniform((-5, -5, 0), (5, 5, 41), (600, 3))
    angles = np.arange(24) * np.pi / 12
    poses = [look_at_pose(np.array([66 * np.cos(a), 66 * np.sin(a), 40]), np.array([0.0, 0.0, 17.0])) for a in angles]
    ring = [replace(camera((0, 0, 0), 0, 0), camera_from_world=pose) for pose in poses]
    flown = capture_of(ring, np.concatenate([plane(150, 150), tower]))
    look, whole = default_view(flown), default_view(flown, whole=True)
    assert shown(look, tower).all()
    near, far = (np.linalg.norm(each.position - (0, 0, 17)) for each in (look, whole))
    assert near < 100
    assert far > 200
    assert shown(whole, flown.points).mean() > 0.95
