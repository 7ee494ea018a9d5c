"""The place on which the views of cameras converge: known for rings and their like, none for grids, walls and roads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from vdgs.geometry.camera import Camera
from vdgs.geometry.view_convergence import find_convergence
from vdgs.rendering.camera_paths import look_at_pose

rng = np.random.default_rng(0)
AIM = (0.0, 0.0, 17.0)


def looking_at(position, target) -> Camera:
    pose = look_at_pose(np.array(position, float), np.array(target, float))
    return Camera(camera_from_world=pose, fx=340.0, fy=340.0, cx=200.0, cy=150.0, width=400, height=300)


def along(position, direction) -> Camera:
    return looking_at(position, np.add(position, direction))


def ring(n: int, radius: float, z: float, arc_deg: float = 360.0, jitter: float = 0.0, aim=AIM) -> list[Camera]:
    angles = np.radians(arc_deg) * np.arange(n) / n
    places = [(radius * np.cos(angle), radius * np.sin(angle), z) for angle in angles]
    return [looking_at(place, np.add(aim, rng.normal(0, jitter, 3))) for place in places]


def grid(half: float, height: float, tilt_deg: float, headings: Sequence[float]) -> list[Camera]:
    """Each place of a grid in all these headings, a gimbal being 2° off."""
    cameras = []
    for x, y in np.stack(np.meshgrid(*[np.linspace(-half, half, 6)] * 2), -1).reshape(-1, 2):
        for heading in headings:
            tilt, turn = np.radians([tilt_deg, heading]) + rng.normal(0, np.radians(2), 2)
            level = np.sin(tilt) * np.array([np.sin(turn), np.cos(turn)])
            cameras.append(along((x, y, height), (*level, -np.cos(tilt))))
    return cameras


def bridge() -> list[Camera]:
    """Along both sides, each camera at the part before it, and around one end."""
    sides = [(x, y, z) for y, z in ((-34, 12), (-30, 30), (34, 12), (30, 30)) for x in np.linspace(-32, 32, 8)]
    end = [(38 * np.cos(angle), 38 * np.sin(angle), 28) for angle in np.linspace(-0.75, 0.75, 7)]
    return [looking_at(place, (0.75 * place[0], 0, 15)) for place in sides] + [
        looking_at(place, (0, 0, 15)) for place in end
    ]


def facade(toward: float) -> list[Camera]:
    """Along a wall, straight at it, or turned towards its middle."""
    return [looking_at((x, -30, z), (toward * x, 0, 12)) for x in range(-30, 31, 6) for z in (5, 15, 25)]


def outwards() -> list[Camera]:
    turns = np.arange(20) * np.pi / 10
    return [along((60 * np.cos(a), 60 * np.sin(a), 30), (np.cos(a), np.sin(a), -0.3)) for a in turns]


def two_towers() -> list[Camera]:
    return ring(20, 40, 28) + [
        along(np.add(camera.position, (150, 0, 0)), camera.forward) for camera in ring(20, 40, 28)
    ]


@pytest.mark.parametrize(
    ("cameras", "off"),
    [
        pytest.param(ring(20, 66, 28) + ring(14, 56, 62), 0.01, id="two rings"),
        pytest.param(ring(24, 64, 24, jitter=6), 4, id="held by hand"),
        pytest.param(ring(12, 60, 30, arc_deg=180), 0.01, id="half an orbit"),
        pytest.param(ring(20, 40, 17), 0.01, id="level"),
        pytest.param(ring(20, 30, 80), 0.01, id="high above"),
        pytest.param(bridge(), 3, id="bridge"),
        pytest.param(ring(60, 60, 40) + grid(60, 60, 0, [0])[::2], 0.2, id="a quarter of a survey"),
        pytest.param(ring(60, 60, 40) + [along((200 + k, 0, 40), (1, 0, -0.2)) for k in range(24)], 0.5, id="and home"),
    ],
)
def test_views_around_a_thing_converge_on_it(cameras: list[Camera], off: float):
    found = find_convergence(cameras)
    assert found is not None
    assert np.linalg.norm(found.place - AIM) < off
    away = [np.linalg.norm(camera.position - found.place) for camera in cameras]
    assert found.distance == pytest.approx(np.median(np.array(away)[found.looking]))
    assert 0.999 * found.distance * 150 / 340 <= found.radius < found.distance


@pytest.mark.parametrize(
    "cameras",
    [
        pytest.param(grid(100, 60, 0, [0, 180]), id="survey"),
        pytest.param(grid(25, 60, 0, [0, 180]), id="small survey"),
        pytest.param(grid(100, 60, 45, [0]), id="oblique, one way"),
        pytest.param(grid(100, 60, 45, [0, 180]), id="oblique, to and fro"),
        pytest.param(grid(100, 80, 45, [0, 90, 180, 270]) + grid(100, 80, 0, [0]), id="five cameras"),
        pytest.param(grid(40, 80, 45, [0, 90, 180, 270]) + grid(40, 80, 0, [0]), id="five cameras over little"),
        pytest.param(grid(24, 60, 15, [0, 90, 180, 270]), id="crossed and steep, over little"),
        pytest.param(facade(1.0), id="facade"),
        pytest.param(facade(0.3), id="facade, turned in"),
        pytest.param([along((x, 0, 46), (*rng.normal(0, 0.03, 2), -1)) for x in range(-150, 150, 12)], id="corridor"),
        pytest.param([along((x, 0, 2), (1, rng.normal(0, 0.1), 0)) for x in range(60)], id="street"),
        pytest.param(outwards(), id="outwards"),
        pytest.param(two_towers(), id="two towers"),
        pytest.param([looking_at((x, rng.normal(), 30), (0, 0, 10)) for x in range(30, 90, 5)], id="towards it"),
        pytest.param(ring(4, 60, 30), id="four cameras"),
        pytest.param([along((0, 0, 0), (1, 0, 0))] * 8, id="one place, one way"),
    ],
)
def test_views_of_no_one_place_do_not(cameras: list[Camera]):
    assert find_convergence(cameras) is None
