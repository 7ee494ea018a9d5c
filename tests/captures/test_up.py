"""Up of worlds that nobody has told, from made-up flights, walls, streets and orbits, turned in any way."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from vdgs.captures.up_axis import estimate_up, up_by_views

#: Of each way to take photographs: camera centers [n, 3], rotations [n, 3, 3] and points [m, 3], z up.
Scene = tuple[np.ndarray, np.ndarray, np.ndarray]


def held(yaw: float, pitch: float) -> np.ndarray:
    """camera_from_world [3, 3] of a camera without roll: yaw clockwise from +y, pitch above the horizon (degrees)."""
    y, p = np.radians([yaw, pitch])
    forward = np.array([np.sin(y) * np.cos(p), np.cos(y) * np.cos(p), np.sin(p)])
    right = np.array([np.cos(y), -np.sin(y), 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def cameras(
    centers: np.ndarray, yaw: float | Sequence[float], pitch: float, spread: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras at these places, each turned by normal `spread` (degrees) about its own right, down and forward: pitch,
    yaw and roll of one held level; pitch, roll and heading of one that looks down."""
    off = np.radians(np.random.default_rng(4).normal(0, 1, (len(centers), 3)) * spread)
    yaws = np.broadcast_to(yaw, len(centers))
    return centers, np.stack([cv2.Rodrigues(turn)[0] @ held(y, pitch) for y, turn in zip(yaws, off, strict=True)])


def box(*sides: tuple[float, float], count: int = 600) -> np.ndarray:
    low, high = np.array(sides).T
    return np.random.default_rng(7).uniform(low, high, (count, 3))


def along(length: float, count: int = 24, height: float = 1.7) -> np.ndarray:
    generator = np.random.default_rng(2)
    places = np.column_stack([np.zeros(count), np.linspace(0, length, count), np.full(count, height)])
    return places + generator.normal(0, 0.05, places.shape)


def street(yaw: float | Sequence[float], spread: tuple[float, float, float]) -> Scene:
    """Between two rows of houses 12 high and a road: most points lie above the cameras."""
    houses = [box((side - 0.3, side + 0.3), (-5, 65), (0, 12)) for side in (-5.0, 5.0)]
    road = box((-5, 5), (-5, 65), (-0.1, 0.1), count=200)
    return *cameras(along(60), yaw, 3.0, spread), np.concatenate([*houses, road])


def wall(spread: tuple[float, float, float], pitch: float = 4.0, yaw: float | Sequence[float] = 0.0) -> Scene:
    """A facade 40 wide and 15 high, 10 in front of cameras that walk along it."""
    turned = along(40)[:, [1, 0, 2]]
    return *cameras(turned, yaw, pitch, spread), box((0, 40), (9.7, 10.3), (0, 15))


def orbit(pitch: float, height: float = 2.0) -> Scene:
    """About a tower 40 high, 15 away from it."""
    angles = np.linspace(0, 360, 24, endpoint=False)
    places = np.column_stack([15 * np.sin(np.radians(angles)), 15 * np.cos(np.radians(angles)), np.full(24, height)])
    return *cameras(places, angles + 180, pitch, (3, 3, 2)), box((-3, 3), (-3, 3), (0, 40))


def flight(headings: Sequence[float], pitch: float, spread: tuple[float, float, float], slope: float = 0.0) -> Scene:
    """Strips at 50 over ground that rises to the east by `slope` degrees, as does the flight."""
    across, forth = (each.ravel() for each in np.meshgrid(np.arange(5) * 20.0, np.arange(9) * 12.0, indexing="ij"))
    rise = np.tan(np.radians(slope))
    places = np.column_stack([across, forth, 50 + rise * across])
    ground = box((-20, 100), (-20, 120), (-2, 2))
    ground[:, 2] += rise * ground[:, 0]
    return *cameras(places, np.resize(np.repeat(headings, 9), 45), pitch, spread), ground


def of_two_heights(scene: Scene) -> Scene:
    """Every third camera from seven times as high."""
    centers, rotations, points = scene
    return np.where(np.arange(len(centers))[:, None] % 3 == 0, [1, 1, 7], 1) * centers, rotations, points


def off_by(scene: Scene, turn: np.ndarray) -> tuple[float, list[str]]:
    """Degrees between up as found and as it is, where the world is turned; and the warnings."""
    centers, rotations, points = scene
    warnings: list[str] = []
    up, how = estimate_up(centers @ turn.T, rotations @ turn.T, points @ turn.T, warnings)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert how
    return float(np.degrees(np.arccos(np.clip(up @ turn[:, 2], -1, 1)))), warnings


def turns() -> list[np.ndarray]:
    generator = np.random.default_rng(11)
    found = [np.eye(3), np.diag([1.0, -1.0, -1.0])]
    for _ in range(3):
        q, r = np.linalg.qr(generator.normal(size=(3, 3)))
        q = q * np.sign(np.diag(r))
        found.append(q if np.linalg.det(q) > 0 else -q)
    return found


@pytest.mark.parametrize(("scene", "within"), [
    pytest.param(wall((8, 25, 2)), 3, id="wall"),
    pytest.param(wall((3, 1, 2), 20.0, [-20, -5, 5, 20] * 6), 3, id="tall wall"),
    pytest.param(street([0.0, 90.0, 180.0, 270.0] * 6, (5, 10, 2)), 3, id="street all ways"),
    pytest.param(street(0.0, (5, 15, 2)), 5, id="street ahead"), pytest.param(orbit(0.0), 3, id="orbit"),
    pytest.param(orbit(15.0), 3, id="orbit from below"),
    pytest.param(orbit(-15.0, height=30.0), 3, id="orbit from above"),
])  # fmt: skip
def test_cameras_that_are_held_level_say_what_is_up(scene, within):
    for turn in turns():
        angle, warnings = off_by(scene, turn)
        assert angle < within
        assert warnings == []


def test_a_hand_held_walk_before_a_wall_and_its_ground_may_be_level():
    """Least variance lies between both. A strip of a plane that rolls has the same geometry: it stays a doubt."""
    walk = np.column_stack([np.linspace(-9, 9, 16), np.full(16, -7.0), np.full(16, 1.6)])
    yaws = -1.2 * walk[:, 0] + 8 * np.sin(walk[:, 0])
    points = np.concatenate([box((-20, 20), (-0.1, 0.1), (0, 9)), box((-20, 20), (-20, 0), (-0.1, 0.1), count=100)])
    for turn in turns():
        centers, rotations = cameras(walk, yaws, -2.0, (2, 0, 1))
        found = up_by_views(centers @ turn.T, rotations @ turn.T, points @ turn.T)
        assert found.other is not None
        assert np.degrees(np.arccos(found.other.direction @ turn[:, 2])) < 3
        assert not found.sure


@pytest.mark.parametrize("headings", [[0.0], [0.0, 180.0]])
def test_planes_that_roll_look_down(headings):
    centers, rotations, points = flight(headings, -90.0, (3, 5, 1))
    for turn in turns():
        angle, _ = off_by((centers, rotations, points), turn)
        assert angle < 12


@pytest.mark.parametrize("yaw", [0.0, [90.0, 270.0] * 12], ids=["ahead", "both sides"])
def test_a_street_seen_one_way_has_an_up_that_is_off_by_the_pitch_and_says_so(yaw):
    """Houses stand close, so that across is the flat axis, along which nobody holds the bottom of a camera."""
    centers, rotations, points = street(yaw, (1, 1, 1))
    narrow = np.array([0.2, 1.0, 1.0])
    for turn in turns():
        angle, warnings = off_by((centers * narrow, rotations, points * narrow), turn)
        assert angle < 5
        assert all("--up" in each for each in warnings)
        assert len(warnings) == 1


def test_a_wall_seen_straight_on_cannot_be_told_from_a_flight_and_says_so():
    for turn in turns():
        angle, warnings = off_by(wall((1, 1, 1)), turn)
        assert angle == pytest.approx(90, abs=10)  # the wall's normal
        (warning,) = warnings
        assert "level at a wall. Taken for down; if that is wrong, --up" in warning


@pytest.mark.parametrize("scene", [
    pytest.param(flight([0, 180], -90, (1, 1, 2)), id="back and forth"),
    pytest.param(flight([0, 90], -90, (1, 1, 3)), id="crossing"),
    pytest.param(flight([0, 180], -60, (1, 3, 1)), id="oblique"),
    pytest.param(flight([0], -90, (1, 0.5, 4)), id="one heading"),
    pytest.param(flight([0], -90, (4, 3, 20)), id="one heading in wind"),
    pytest.param(flight([0], -60, (1, 2, 1)), id="one heading oblique"),
    pytest.param(flight([0, 90, 180, 270], -30, (2, 5, 1)), id="low"),
    pytest.param(of_two_heights(flight([0, 90, 180], -80, (2, 2, 5))), id="two heights"),
])  # fmt: skip
def test_flights_have_their_up_against_the_view(scene):
    for turn in turns():
        angle, warnings = off_by(scene, turn)
        assert angle < 3
        assert warnings == []


def at_one_height(scene: Scene) -> Scene:
    """All cameras as high as the highest."""
    centers, rotations, points = scene
    return np.column_stack([centers[:, :2], np.full(len(centers), centers[:, 2].max())]), rotations, points


@pytest.mark.parametrize("scene", [
    pytest.param(flight([0, 180], -90, (1, 1, 2), slope=10), id="back and forth"),
    pytest.param(flight([0, 180, 180], -80, (1, 1, 2), slope=20), id="tilted, more of them back"),
    pytest.param(flight([0, 90], -85, (1, 1, 3), slope=30), id="crossing"),
    pytest.param(flight([0, 90, 180, 270], -65, (1, 1, 1), slope=20), id="oblique"),
    pytest.param(at_one_height(flight([0, 180], -90, (1, 1, 2), slope=20)), id="level flight"),
])  # fmt: skip
def test_flights_over_slopes_have_the_axis_up_that_their_cameras_turn_about(scene):
    for turn in turns():
        angle, warnings = off_by(scene, turn)
        assert angle < 1
        assert warnings == []


@pytest.mark.parametrize("seed", [24, 51, 74])
def test_a_few_photographs_from_an_unsteady_hand_do_not_lean_a_flight_over_flat_ground(seed):
    """Five may hang alike by chance about another axis."""
    generator = np.random.default_rng(seed)
    centers, rotations, points = flight([0, 180], -90, (0, 0, 0))
    some = generator.permutation(len(centers))[:5]
    off = np.radians(generator.normal(0, 5, (5, 3)))
    rotations = np.stack([cv2.Rodrigues(turn)[0] @ each for turn, each in zip(off, rotations[some], strict=True)])
    assert off_by((centers[some], rotations, points), np.eye(3))[0] < 2


@pytest.mark.parametrize("pitch", [-70, -45, -5])
def test_photographs_that_look_one_way_do_not_lean_a_flight_over_flat_ground(pitch):
    """A third of them, beside others that look straight down: these do not hang alike."""
    centers, rotations, points = flight([0, 180], -90, (1, 1, 2))
    aside = cameras(centers[::3], 30.0, pitch, (1, 1, 2))
    both = np.concatenate([centers, aside[0] + [0, 0, 1]]), np.concatenate([rotations, aside[1]]), points
    for turn in turns():
        assert off_by(both, turn)[0] < 1


@pytest.mark.parametrize("slope", [0.0, 20.0])
def test_flights_of_one_heading_that_never_yaw_are_as_flat_as_their_ground(slope):
    for turn in turns():
        angle, warnings = off_by(flight([0], -90, (0.5, 1, 0.2), slope), turn)
        assert angle == pytest.approx(slope, abs=2)
        assert ["Taken for down" in each for each in warnings] == [True]
