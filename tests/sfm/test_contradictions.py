"""Positions and photographs that contradict each other: one is believed only where it is clear which, and errors are
as large as what nothing decides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures.gps_altitudes import wrong_reading, wrong_unit
from vdgs.captures.position_adjustment import PositionFit, Problem, Up, settle
from vdgs.captures.position_fit import fit_positions
from vdgs.captures.position_lines import checked_on_a_line
from vdgs.captures.up_axis import VIEWS_DEG, up_by_views
from vdgs.sfm.flights import altitude_offsets
from vdgs.sfm.georegistration import accuracy_of
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import attitude_from_gimbal, likeliest_attitude, read_attitudes
from vdgs.sfm.recorded_headings import checked_by_headings

pytestmark = pytest.mark.slow

NADIR = np.diag([1.0, -1, -1])


def fit_of(places: np.ndarray, recorded: np.ndarray, up: Up) -> PositionFit:
    """The fit of cameras at `places` [n, 3], one after the other; their world is the true one."""
    return fit_positions(Problem(centers=places, targets=recorded, times=np.linspace(0, 1, len(places)), up=up))


def tilt_deg(fit: PositionFit) -> float:
    return float(np.degrees(np.arccos(np.clip(fit.similarity.rotation[2, 2], -1, 1))))


def facade(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Cameras [20, 3] in four columns up and down, 20 m before a wall in the north, held level, and rotations."""
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
    direction, deviation, sure, _ = up_by_views(places, rotations, points)
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
    up, deviation, *_ = up_by_views(places, there_and_back, ground)
    assert np.degrees(np.arccos(up[2])) < deviation <= 3
    up, deviation, *_ = up_by_views(places, one_way, ground)
    assert deviation > 5


@pytest.mark.parametrize("seed", range(8))
def test_views_that_are_exactly_parallel_lean_by_nothing(seed):
    """Cameras that look one way and turn about that, back and forth over a slope: their mean is 1 but for rounding."""
    rng = np.random.default_rng(seed)
    places = along_a_slope()
    ground = rng.uniform([-20, -20, 455], [70, 60, 456], (500, 3))
    ground[:, 2] += np.tan(np.radians(22.0)) * ground[:, 1]
    lean = Rotation.from_euler("x", rng.uniform(0, 3), degrees=True).as_matrix()
    turns = [Rotation.from_euler("z", 180.0 * (k // 5 % 2) + seed, degrees=True).as_matrix() for k in range(20)]
    up, deviation, *_ = up_by_views(places, np.array([turn @ NADIR @ lean for turn in turns]), ground)
    assert up == pytest.approx(lean.T @ [0, 0, 1], abs=1e-9)
    assert deviation == pytest.approx(VIEWS_DEG)


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


@pytest.mark.parametrize("length_m", [400, 1500])
@pytest.mark.parametrize("seed", range(4))
def test_altitudes_along_a_corridor_are_used(length_m, seed):
    """Across it nothing tells a slope."""
    rng = np.random.default_rng(seed)
    places = np.stack([np.linspace(0, length_m, 60), rng.normal(0, 0.5, 60), np.full(60, 100.0)], axis=1)
    fit = fit_of(places, places + rng.normal(0, 1, places.shape) * [0.5, 0.5, 0.8], views(1.0, 1.0))
    assert fit.altitude == "used"
    assert np.abs((fit.placed - places)[:, 2]).max() < 2


@pytest.mark.parametrize("tilt", [20.0, 25.0, 30.0])
@pytest.mark.parametrize("turn_deg", [90.0, 180.0])
def test_cameras_that_turn_in_part_say_up_no_better_than_their_mean_view_leans(tilt, turn_deg):
    """As along two sides of a field, or half around a building."""
    yaws = np.repeat([0.0, turn_deg], 15) if turn_deg == 90 else np.linspace(0, turn_deg, 30)
    rotations = np.array([attitude_from_gimbal(yaw, tilt - 90, 0.0).camera_from_enu for yaw in yaws])
    heading = np.radians(yaws)
    centers = np.c_[np.cumsum(np.stack([np.sin(heading), np.cos(heading)], axis=1) * 8, axis=0), np.full(30, 60.0)]
    points = np.random.default_rng(0).uniform([-50, -50, 0], [200, 200, 3], (400, 3))
    up, deviation, *_ = up_by_views(centers, rotations, points)
    assert np.degrees(np.arccos(np.clip(up[2], -1, 1))) < 2.05 * deviation


@pytest.mark.parametrize("climb_deg", [0.0, 5.0, 22.0])
@pytest.mark.parametrize("off_deg", [-4.0, 0.0, 4.0])
def test_altitudes_of_a_receiver_are_used_along_a_slope_and_over_level_ground(climb_deg, off_deg):
    rng = np.random.default_rng(2)
    places = along_a_slope(climb_deg)
    fit = fit_of(places, places + rng.normal(0, 0.5, places.shape), views(off_deg))
    assert fit.altitude == "used"
    assert tilt_deg(fit) < 3


def checked(
    places: np.ndarray, yaws: np.ndarray, lag_m: float, compass_deg: float
) -> tuple[PositionFit, PositionFit, list[str]]:
    """The fit of positions that lag behind along the track, as it is and as headings leave it, with their notes."""
    rng = np.random.default_rng(5)
    along = np.gradient(places[:, :2], axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    fit = fit_of(places, places - np.c_[lag_m * along, 0 * along[:, 0]] + rng.normal(0, 0.4, places.shape), views(0))
    poses = [attitude_from_gimbal(yaw, -60.0, 0.0) for yaw in yaws]
    images = {
        str(k): SimpleNamespace(
            cam_from_world=lambda pose=pose: SimpleNamespace(
                rotation=SimpleNamespace(matrix=lambda: pose.camera_from_enu)
            )
        )
        for k, pose in enumerate(poses)
    }
    taken = [
        SimpleNamespace(name=str(k), attitude=attitude_from_gimbal(yaw + compass_deg + rng.normal(0, 1), -60.0, 0.0))
        for k, yaw in enumerate(yaws)
    ]
    after, notes = checked_by_headings(fit, images, taken, np.linspace(0, 1, len(places)))
    return fit, after, notes


def orbit() -> tuple[np.ndarray, np.ndarray]:
    yaws = 18.0 * np.arange(20)
    around = np.radians(yaws + 180)
    return np.stack([32 * np.sin(around), 32 * np.cos(around), 20 + 0.5 * (np.arange(20) % 3)], axis=1), yaws


def test_views_that_look_down_without_a_heading_say_nothing_of_north():
    """Of a camera that records its pitch alone, flown southwards."""
    south = attitude_from_gimbal(180.0, -90.0, 0.0).camera_from_enu
    pose = SimpleNamespace(rotation=SimpleNamespace(matrix=lambda: south))
    images = {str(k): SimpleNamespace(cam_from_world=lambda: pose) for k in range(12)}
    fit = SimpleNamespace(similarity=SimpleNamespace(rotation=np.eye(3)), north_error_deg=1.0, scale_error=0.01)
    said = {"d:GimbalPitchDegree": "-90.0"}, {"d:GimbalPitchDegree": "-90.0", "d:GimbalYawDegree": "0.0"}
    notes = []
    for xmp in said:
        attitude = likeliest_attitude(read_attitudes(xmp)[0])
        taken = [SimpleNamespace(name=name, attitude=attitude) for name in images]
        notes.append(checked_by_headings(fit, images, taken, np.linspace(0, 1, len(images)))[1])
    assert notes[0] == []
    assert "north is turned by 180" in notes[1][0]


@pytest.mark.parametrize("lag_m", [-3.0, 3.0])
def test_positions_that_lag_around_an_orbit_say_north_no_better_than_the_headings(lag_m):
    fit, after, notes = checked(*orbit(), lag_m, 0.0)
    off = abs(np.degrees(np.arctan2(*fit.similarity.rotation[[1, 0], [0, 0]])))
    assert fit.north_error_deg < off < after.north_error_deg < 2 * off
    assert abs(fit.similarity.scale - 1) < after.scale_error < 0.05
    assert "behind or ahead along the track" in notes[0]


@pytest.mark.parametrize("compass_deg", [0.0, 6.0, 15.0])
def test_a_compass_that_is_off_says_nothing_of_strips_flown_back_and_forth(compass_deg):
    x, y = np.meshgrid(np.arange(6) * 12.0, np.arange(4) * 14.0)
    x[1::2] = x[1::2, ::-1]
    places = np.stack([x.ravel(), y.ravel(), 45 + (np.arange(24) % 3)], axis=1)
    fit, after, notes = checked(places, np.repeat([90.0, 270, 90, 270], 6), 0.0, compass_deg)
    assert (after, notes) == (fit, [])


def test_headings_that_agree_leave_an_orbit_as_it_is():
    fit, after, notes = checked(*orbit(), 0.0, 1.0)
    assert (after, notes) == (fit, [])


def test_headings_the_other_way_round_ask_for_both_hemispheres():
    assert "hemispheres" in checked(*orbit(), 0.0, 180.0)[2][0]


@pytest.mark.parametrize("step_m", [-3.0, -2.0, 0.0, 2.0, 3.0])
def test_level_of_two_strips_holds_a_step_between_their_altitudes(step_m):
    x, y = np.meshgrid(np.arange(10) * 9.0, [-8.0, 8.0])
    places = np.stack([x.ravel(), y.ravel(), np.full(20, 45.0)], axis=1)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        recorded = places + rng.normal(0, 1, places.shape) * [0.5, 0.5, 0.8]
        recorded[10:, 2] += step_m
        fit = fit_of(places, recorded, views(1.0))
        assert tilt_deg(fit) < fit.level_error_deg < 20


@pytest.mark.parametrize(("factor", "said", "off"), [(3.2808, "feet", 1140.0), (-1.0, "wrong sign", 1000.0)])
def test_altitudes_in_feet_or_of_the_wrong_sign_are_named_by_what_they_differ_by(factor, said, off):
    rng = np.random.default_rng(0)
    heights = np.r_[np.full(10, 500.0), np.full(10, 517.0)] + rng.normal(0, 0.5, 20)
    what, apart = wrong_reading(factor * heights + rng.normal(0, 0.8, 20), heights - 470)
    assert said in what
    assert apart == pytest.approx(off, rel=0.05)
    assert wrong_reading(heights + np.repeat([0, 12.0], 10), heights) == ("", 0.0)
    assert wrong_reading(factor * np.full(20, 500.0), np.full(20, 30.0)) == ("", 0.0)


@pytest.mark.parametrize("drift_m", [0.0, -4.0])
def test_altitudes_in_feet_are_named_whatever_they_tilt(drift_m):
    """12 photographs at 42 m and 4 at 45 m; views are good to a degree. Those in metres are never named."""
    x, y, times = 20.0 * (np.arange(16) % 4), 20.0 * (np.arange(16) // 4), np.linspace(0, 1, 16)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = np.stack([x, y, np.repeat([42.0, 45.0], [12, 4]) + rng.normal(0, 0.4, 16)], axis=1)
        recorded = places + np.outer(drift_m * times, [0, 0, 1]) + rng.normal(0, 0.1, places.shape)
        for factor, said in ((1 / 0.3048, "feet"), (1.0, "")):
            altitudes = factor * (recorded[:, 2] + 500)
            fit = fit_of(places, np.column_stack([recorded[:, :2], altitudes - altitudes[0]]), views(1.0))
            assert wrong_unit(altitudes, fit.placed[:, 2], fit.placed[:, :2]) == said
            assert wrong_reading(altitudes, fit.placed[:, 2], fit.placed[:, :2])[0].endswith(said)


@pytest.mark.parametrize("datum_m", [-20.0, 20.0])
@pytest.mark.parametrize(("up_std", "right"), [((3.0, 0.02), 1), ((0.02, 3.0), 0), ((3.0, 3.0), 0), ((0.02, 0.02), 0)])
def test_heights_are_those_of_the_flight_with_rtk_or_else_of_the_largest(up_std, right, datum_m):
    """Whichever of the two is higher: 12 photographs, and 8 over the same places."""
    flights = np.repeat([0, 1], [12, 8])
    places = np.array([[15.0 * (k % 4), 15.0 * (k // 4 % 3), 60] for k in range(20)])
    recorded = places + np.outer(flights, [0, 0, datum_m])
    offsets = altitude_offsets(places, recorded, flights, 1.0, np.array(up_std)[flights])
    assert offsets is not None
    assert (offsets.reference == (flights == right)).all()
    assert offsets.by_position == pytest.approx(datum_m * (flights - right))


@pytest.mark.parametrize(("north", "level"), [(12.0, 3.0), (250.0, 400.0)])
def test_angles_of_the_accuracy_are_degrees_up_to_half_a_turn(north, level):
    places = np.array([[15.0 * (k % 4), 15.0 * (k // 4), 60] for k in range(12)])
    fit = replace(fit_of(places, places, views(1.0)), north_error_deg=north, level_error_deg=level)
    positions = GpsPriors(
        image_indices=np.arange(12), enu=places, gps_std=np.ones((12, 3)), origin=(0.0, 0.0, 0.0),
        altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    accuracy = accuracy_of(fit, positions)
    assert (accuracy.north_deg, accuracy.level_deg) == (min(180, north), min(180, level))


@pytest.mark.parametrize("drift_m", [0.0, 8.0, 17.0])
def test_heights_along_one_line_are_no_better_than_a_drift_that_nothing_tells(drift_m):
    rng = np.random.default_rng(1)
    places = np.stack([8.0 * np.arange(14), np.zeros(14), np.full(14, 45.0)], axis=1)
    recorded = places + rng.normal(0, 1, places.shape) * [0.5, 0.5, 0.8]
    recorded[:, 2] += np.linspace(0, drift_m, 14)
    problem = Problem(centers=places, targets=recorded, times=np.linspace(0, 1, 14), up=views(0, 6.0))
    fit, notes = checked_on_a_line(fit_positions(problem), problem)
    assert abs(float((fit.placed - places)[:, 2].mean())) < fit.place_error_m[1] < 2 + drift_m
    assert bool(notes) == (drift_m > 0)


def test_a_long_line_is_not_doubted_for_what_up_may_be_off_by():
    rng = np.random.default_rng(1)
    places = np.stack([np.linspace(0, 1500, 60), np.zeros(60), np.full(60, 100.0)], axis=1)
    recorded = places + rng.normal(0, 1, places.shape) * [0.5, 0.5, 0.8]
    tilted = Up(np.array([np.sin(np.radians(1)), 0, np.cos(np.radians(1))]), 1.0, "the views")
    problem = Problem(centers=places, targets=recorded, times=np.linspace(0, 1, 60), up=tilted)
    fit, notes = checked_on_a_line(fit_positions(problem), problem)
    assert not notes
    assert fit.place_error_m[1] < 15


def strip(seed: int, sag_m: float = 2.5, noise_m: float = 0.5) -> tuple[np.ndarray, Problem]:
    """Where one strip of 300 m was flown at one height, and it as a wrong focal length bent it; its views may be of a
    wall."""
    rng, x = np.random.default_rng(seed), np.linspace(-150, 150, 24)
    places = np.stack([x, 0.3 * np.sin(x), 46 + 0.3 * np.cos(3 * x)], axis=1)
    bent = places + np.outer(sag_m * ((x / 150) ** 2 - 0.33), [0, 0, 1])
    recorded = places + rng.normal(0, noise_m, places.shape)
    up = Up(views(rng.normal(0, 2)).direction, 20.0, "the views", sure=False)
    return places, Problem(centers=bent, targets=recorded, times=np.linspace(0, 1, 24), up=up)


def test_altitudes_along_one_strip_are_no_drift_of_dozens_of_metres():
    """Along one line a drift and a tilt look the same, and a tilt and the scale: neither follows what errors are by
    chance."""
    within = []
    for seed in range(20):
        _, problem = strip(seed)
        fit = fit_positions(problem)
        assert fit.altitude == "used"
        assert abs(np.degrees(np.arcsin(fit.similarity.rotation[2, 0]))) < 1.0
        assert abs(fit.similarity.scale - 1) < 0.015
        within += [tilt_deg(fit) <= fit.level_error_deg, abs(fit.similarity.scale - 1) <= fit.scale_error]
    assert np.mean(within) >= 0.9


def drifting_strip(seed: int, drift_m: float, deviation_deg: float, sag_m: float) -> Problem:
    """The strip with altitudes that drift along it, and up by views that are 2 degrees off."""
    _, problem = strip(seed, sag_m)
    drifting = problem.targets + np.outer(drift_m * problem.times, [0, 0, 1])
    return replace(problem, targets=drifting, up=replace(problem.up, direction=views(2.0).direction,
                                                         deviation_deg=deviation_deg))  # fmt: skip


def test_what_is_likeliest_along_a_strip_is_found_from_wherever_a_fit_begins():
    """From up by the views, which a long drift contradicts, altitudes that count as they are look like noise: they are
    compared from where they fit. No fit has them drift by a few metres and the strip climb by all the rest."""
    for seed in range(6):
        problem = drifting_strip(seed, 60.0, 6.0, 0.0)
        fit = fit_positions(problem)
        again = settle(problem, fit.similarity, "used")
        assert fit.score <= again.score + 0.1
        assert fit.altitude == "used"


def test_altitudes_drift_by_what_they_change_against_the_heights_of_the_fit():
    """Where level is as the views have it, a fit of altitudes that takes most of their drift for a climb does not say
    how far they drift."""
    for seed in range(4):
        problem = drifting_strip(seed, 40.0, 3.0, 6.0)
        fit = fit_positions(problem)
        assert fit.altitude == "drifts"
        changed = np.polyfit(problem.times, (problem.targets - fit.placed)[:, 2], 1)[0]
        assert fit.drift_m == pytest.approx(changed, abs=3)
        assert fit.place_error_m[1] > abs(changed) / 2


def test_level_of_a_grid_holds_a_drift_that_does_not_show():
    """Strips beside each other, one after the other: a drift of the altitudes tilts them."""
    along, across = np.meshgrid(np.linspace(-75, 75, 8), 25 * (np.arange(6) - 2.5))
    along[1::2] *= -1
    places = np.stack([along.ravel(), across.ravel(), np.full(48, 60.0)], axis=1)
    within = []
    for seed in range(12):
        recorded = places + np.random.default_rng(seed).normal(0, 3, places.shape) * [0.8, 0.8, 1.2]
        recorded[:, 2] += np.linspace(0, 12.0, 48)
        fit = fit_of(places, recorded, views(1.0, 20.0))
        within.append(tilt_deg(fit) <= fit.level_error_deg)
    assert np.mean(within) >= 0.9
