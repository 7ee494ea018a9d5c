"""Photographs that all look one way: walls, ceilings, slopes and lines that look alike, which positions may tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.errors import CaptureError
from vdgs.sfm.georeferencing import _upright
from vdgs.sfm.georegistration import AlignmentFailure, Georegistration, georegister
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import attitude_from_gimbal
from vdgs.sfm.up_direction import up_of

pytestmark = pytest.mark.slow

#: The model's world is turned from east, north, up.
TURN = Rotation.random(random_state=3).as_matrix()


def taken_from(
    places: np.ndarray, points: np.ndarray, angles: tuple[float, float], wrong_m: float = 0.0, recorded: bool = False,
    seed: int = 0, heights: np.ndarray | None = None,
) -> tuple[SimpleNamespace, list[SimpleNamespace], GpsPriors]:  # fmt: skip
    """A model of cameras at places [n, 3] with one yaw and pitch (degrees), its photographs, and their positions, which
    are wrong by so much. `heights` [n] stand in for the altitudes."""
    rng, count = np.random.default_rng(seed), len(places)
    images, photographs = {}, []
    for k, place in enumerate(places):
        pose = attitude_from_gimbal(angles[0] + rng.normal(0, 0.5), angles[1] + rng.normal(0, 0.5), 0.0).camera_from_enu
        images[k] = SimpleNamespace(
            name=str(k), has_pose=True, points2D=(), projection_center=lambda place=place: TURN @ place,
            cam_from_world=lambda pose=pose @ TURN.T: SimpleNamespace(rotation=SimpleNamespace(matrix=lambda: pose)),
        )  # fmt: skip
        attitude = attitude_from_gimbal(*angles, 0.0) if recorded else None
        photographs.append(
            SimpleNamespace(name=str(k), attitude=attitude, face="", datetime="", subsecond=None, gps_std=None,
                            relative_altitude=None)
        )  # fmt: skip
    enu = places + rng.normal(0, 1, places.shape) * wrong_m * [1, 1, 1.5]
    enu[:, 2] = enu[:, 2] if heights is None else heights
    positions = GpsPriors(
        enu=enu, gps_std=np.tile([1.0, 1, 2], (count, 1)), image_indices=np.arange(count), origin=(47.3, 8.5, 500.0),
        altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    model = SimpleNamespace(
        images=images, points3D={k: SimpleNamespace(xyz=TURN @ point) for k, point in enumerate(points)}
    )
    return model, photographs, positions


def wall(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-30, -0.3, 0], [30, 0.3, 40], (400, 3))


def before_a_wall() -> np.ndarray:
    """Up and down, 18 m before it."""
    across, up = np.meshgrid(np.linspace(-12, 12, 5), np.linspace(10, 28, 4), indexing="ij")
    return np.stack([across.ravel(), np.full(20, -18.0), up.ravel()], axis=1)


def up_off_deg(placed: Georegistration) -> float:
    """How far up of a placed model is from what it is."""
    return float(np.degrees(np.arccos(np.clip((placed.similarity.rotation @ TURN)[2, 2], -1, 1))))


@pytest.mark.parametrize("seed", range(4))
def test_positions_tell_a_flight_before_a_wall_from_one_over_ground(seed):
    model, photographs, positions = taken_from(before_a_wall(), wall(), (0.0, 0.0), wrong_m=0.5, seed=seed)
    assert not up_of(model, photographs)[0].sure
    placed = georegister(model, photographs, positions)
    assert isinstance(placed, Georegistration)
    assert up_off_deg(placed) < 6
    assert placed.similarity.scale == pytest.approx(1, abs=0.1)
    assert not any("look the same way" in note for note in placed.notes)


def test_where_positions_cannot_tell_it_is_said_and_counts_as_an_error_of_up():
    """A single row before a wall is congruent with one over ground."""
    row = np.stack([np.linspace(-14, 14, 12), np.full(12, -18.0), np.full(12, 15.0)], axis=1)
    model, photographs, positions = taken_from(row, wall(), (0.0, 0.0), wrong_m=0.5)
    placed = georegister(model, photographs, positions)
    assert isinstance(placed, Georegistration)
    assert placed.accuracy is not None
    assert placed.accuracy.level_deg >= 90
    assert any("level at a wall. Taken for down, for the positions do not tell" in note for note in placed.notes)
    told = georegister(*taken_from(row, wall(), (0.0, 0.0), wrong_m=0.5, recorded=True))
    assert isinstance(told, Georegistration)
    assert up_off_deg(told) < 5
    assert told.accuracy is not None
    assert told.accuracy.level_deg < 20


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("slope_deg", [35.0, 48.0, 60.0])
def test_flights_straight_over_a_slope_with_the_top_of_photographs_uphill_are_not_mirrored(slope_deg, recorded):
    """By their upper sides they look up at a ceiling."""
    rise = np.tan(np.radians(slope_deg))
    across, along = (each.ravel() for each in np.meshgrid(np.arange(5) * 12.0, np.arange(5) * 12.0, indexing="ij"))
    ground = np.random.default_rng(1).uniform([-20, -20, 0], [70, 70, 1], (400, 3))
    ground[:, 2] += rise * ground[:, 1]
    places = np.stack([across, along, rise * along + 40], axis=1)
    placed = georegister(*taken_from(places, ground, (0.0, -90.0), wrong_m=0.5, recorded=recorded))
    assert isinstance(placed, Georegistration)
    assert up_off_deg(placed) < 5
    assert placed.similarity.scale == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("pitch_deg", [35.0, 60.0, 85.0])
def test_cameras_that_look_up_under_a_bridge_are_not_mirrored(pitch_deg):
    """They look like cameras straight over a slope; recorded attitudes tell."""
    places = np.array([[x, y, 2.0 + 0.1 * x] for y in (-3.0, 0.0, 3.0) for x in np.arange(-9.0, 10, 3)])
    deck = np.random.default_rng(2).uniform([-30, -8, 8.9], [30, 8, 9.1], (400, 3))
    placed = georegister(*taken_from(places, deck, (90.0, pitch_deg), wrong_m=0.1, recorded=True))
    assert isinstance(placed, Georegistration)
    assert up_off_deg(placed) < 6


def test_positions_that_do_not_spread_are_no_scale():
    """Straight up along a tower, with one altitude recorded: any drift of it would explain any scale."""
    rise = np.stack([np.full(13, 22.0), np.full(13, 3.0), np.arange(4.0, 30, 2)], axis=1)
    model, photographs, positions = taken_from(rise, wall(), (262.0, 0.0), wrong_m=0.5, heights=np.full(13, 20.0))
    assert isinstance(georegister(model, photographs, positions), AlignmentFailure)


@pytest.mark.parametrize(("seed", "turn_deg"), [(27, 30.0), (33, 0.0)])
def test_positions_along_a_line_are_not_called_exchanged_by_chance(seed, turn_deg):
    """A line is its own mirror image, and exchanged axes stretch the errors across it: of 160 made-up rows these two
    fit far better with latitude and longitude exchanged."""
    line = np.stack([np.linspace(-14, 14, 12), np.full(12, -18.0), np.full(12, 15.0)], axis=1)
    model, photographs, positions = taken_from(line, wall(), (0.0, 0.0), wrong_m=1.0, recorded=True, seed=seed)
    turned = positions.enu @ Rotation.from_rotvec([0, 0, turn_deg], degrees=True).as_matrix().T
    assert isinstance(georegister(model, photographs, replace(positions, enu=turned)), Georegistration)


@pytest.mark.parametrize("recorded", [False, True])
def test_recorded_attitudes_tell_up_where_no_positions_place_a_model(recorded):
    model, photographs, _ = taken_from(before_a_wall(), wall(), (0.0, 0.0), recorded=recorded)
    turns = []
    model.transform = turns.append
    placed = _upright(model, photographs, AlignmentFailure("no positions that can be used", ""))
    assert placed.up == ("the recorded attitudes" if recorded else "")
    assert len(turns) == recorded
    for turn in turns:
        assert turn.rotation.matrix() @ TURN @ [0, 0, 1] == pytest.approx([0, 0, 1], abs=0.02)


def test_mirrored_positions_of_a_wall_are_refused_all_the_same():
    model, photographs, positions = taken_from(before_a_wall() + np.outer(np.arange(20) % 4, [0, 4.0, 0]), wall(),
                                               (0.0, 0.0), wrong_m=0.1, recorded=True)  # fmt: skip
    with pytest.raises(CaptureError, match="fit the photographs only once"):
        georegister(model, photographs, replace(positions, enu=positions.enu * [-1, 1, 1]))


def test_views_that_positions_tell_from_a_wall_say_up_as_well_as_views_that_look_down():
    """Along one strip errors of positions tell little of the roll about it: the views do, once they are of no wall."""
    line = np.stack([np.linspace(-150, 150, 24), 0.3 * np.sin(np.arange(24)), np.full(24, 46.0)], axis=1)
    ground = np.random.default_rng(2).uniform([-170, -25, -2], [170, 25, 2], (400, 3))
    for seed in range(6):
        placed = georegister(*taken_from(line, ground, (90.0, -90.0), wrong_m=0.5, seed=seed))
        assert isinstance(placed, Georegistration)
        assert placed.accuracy is not None
        assert up_off_deg(placed) < min(6.0, placed.accuracy.level_deg)
        assert placed.accuracy.level_deg < 20


def test_altitudes_of_a_table_in_feet_are_refused_and_those_of_exif_are_named():
    """As the cameras tell, whatever the views say of level."""
    x, y = np.meshgrid(np.arange(4) * 18.0, np.arange(5) * 16.0)
    up = np.where(np.arange(20) % 7 < 5, 42.0, 45.0) + np.random.default_rng(0).normal(0, 0.4, 20)
    places = np.column_stack([x.ravel(), y.ravel(), up])
    ground = np.random.default_rng(1).uniform([-30, -30, -0.2], [90, 90, 0.2], (400, 3))
    for heights, is_feet in ((up, False), (up / 0.3048, True)):
        model, photographs, positions = taken_from(places, ground, (0.0, -90.0), wrong_m=0.1, heights=heights)
        placed = georegister(model, photographs, positions)
        assert isinstance(placed, Georegistration)
        assert placed.accuracy is not None
        assert any("in feet" in note for note in placed.notes) is is_feet
        assert (placed.accuracy.place_m[1] > 300) is is_feet
        table = replace(positions, table=Path("gps.csv"), source="gps.csv")
        if is_feet:
            with pytest.raises(CaptureError, match=r"gps\.csv: its altitudes are in feet .* as the cameras tell"):
                georegister(model, photographs, table)
        assert isinstance(georegister(model, photographs, table, anyway=is_feet), Georegistration)
