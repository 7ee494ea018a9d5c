"""Places found from positions of unknown accuracy: how good they are is said, and what is mirrored is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures import reconstruction
from vdgs.captures.plane_fit import mirrored
from vdgs.captures.position_adjustment import PositionFit, Problem, Up, radius_95
from vdgs.captures.position_fit import fit_positions
from vdgs.captures.reconstruction import AccuracyFacts
from vdgs.captures.up_axis import up_by_views
from vdgs.geometry.similarity import Similarity, fit_similarity
from vdgs.sfm import georeferencing, georegistration
from vdgs.sfm.flights import untrusted_offsets
from vdgs.sfm.georeferencing import FOOT_M, Doubts
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.height_units import of_gps

pytestmark = pytest.mark.slow

#: Metres of the flight for one unit of the cameras' world.
SCALE = 13.0
HEIGHT_M = 75.0


def strips(count: int, each: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """Strips flown back and forth, heights that differ by a few metres, about the origin."""
    along = [k if strip % 2 == 0 else each - 1 - k for strip in range(count) for k in range(each)]
    across = np.repeat(np.arange(count), each)
    places = np.stack([step * np.array(along), 1.2 * step * across, HEIGHT_M + rng.normal(0, 2, len(across))], axis=1)
    return places - [*places.mean(axis=0)[:2], 0]


def own_world(places: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return places @ turn / SCALE + [1.0, -2, 3]


def problem_of(
    places: np.ndarray, recorded: np.ndarray, seed: int, up_deg: float = 2.0, stated: np.ndarray | None = None
) -> tuple[Problem, np.ndarray]:
    """Cameras in a world of their own, what is known of up (off by about `up_deg`), and the turn that was taken."""
    turn = Rotation.random(random_state=seed).as_matrix()
    askew = Rotation.from_rotvec([*np.random.default_rng(seed).normal(0, np.radians(up_deg / 1.5), 2), 0]).as_matrix()
    up = Up(turn.T @ askew @ [0.0, 0, 1], max(up_deg, 1.0), "the views")
    return Problem(
        centers=own_world(places, turn),
        targets=recorded,
        times=np.linspace(0, 1, len(places)),
        up=up,
        scale=None,
        stated=stated,
    ), turn


def tilt_deg(fit: PositionFit, turn: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((fit.similarity.rotation @ turn.T)[2, 2], -1, 1))))


def north_off_deg(fit: PositionFit, turn: np.ndarray) -> float:
    against = fit.similarity.rotation @ turn.T
    return float(np.degrees(np.arctan2(against[1, 0] - against[0, 1], against[0, 0] + against[1, 1])))


@pytest.mark.parametrize("wrong_m", [0.0, 5.0, 20.0])
@pytest.mark.parametrize(("count", "each", "step"), [(3, 4, 17.0), (6, 12, 25.0)])
def test_flights_lie_within_their_stated_accuracy(wrong_m, count, each, step):
    """Positions wrong by 0 to 20 m, heights by half as much again: nineteen of twenty within what is stated."""
    within, stated = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        places = strips(count, each, step, rng)
        recorded = places + rng.normal(0, wrong_m, places.shape) * [1, 1, 1.5]
        problem, turn = problem_of(places, recorded, seed)
        fit = fit_positions(problem)
        off = fit.placed.mean(axis=0) - places.mean(axis=0)
        within += [
            abs(fit.similarity.scale / SCALE - 1) <= fit.scale_error + 1e-9,
            abs(north_off_deg(fit, turn)) <= fit.north_error_deg + 1e-6,
            tilt_deg(fit, turn) <= fit.level_error_deg + 1e-6,
            np.hypot(off[0], off[1]) <= fit.place_error_m[0],
            abs(off[2]) <= fit.place_error_m[1],
        ]
        stated.append(fit.scale_error)
        if wrong_m <= 5 or count == 6:
            assert not fit.why_refused("EXIF")
    assert np.mean(within) >= 0.9
    spread = step * np.hypot(each, 1.2 * count) / np.sqrt(12)
    assert np.median(stated) < 0.01 + 4 * wrong_m / spread / np.sqrt(count * each)


@pytest.mark.parametrize("drift_m", [10.0, 30.0, 114.0])
@pytest.mark.parametrize("shape", ["line", "there and back"])
@pytest.mark.parametrize("wrong_m", [0.0, 3.0])
def test_altitudes_that_drift_tilt_nothing_and_are_said(drift_m, shape, wrong_m):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = strips(3, 4, 17.0, rng)
        time = np.linspace(0, 1, len(places))
        recorded = places + rng.normal(0, wrong_m, places.shape) * [1, 1, 0.3]
        recorded[:, 2] += drift_m * (time if shape == "line" else np.sin(np.pi * time))
        problem, turn = problem_of(places, recorded, seed)
        fit = fit_positions(problem)
        assert tilt_deg(fit, turn) < 6.0
        assert fit.similarity.scale == pytest.approx(SCALE, rel=1.5 * fit.scale_error + 0.01)
        assert not fit.why_refused("EXIF")
        assert abs(fit.placed.mean(axis=0)[2] - places[:, 2].mean()) <= fit.place_error_m[1]
        if drift_m >= 30:
            assert fit.altitude != "used"
            assert fit.place_error_m[1] > 0.3 * drift_m
        if shape == "line" and drift_m >= 30:
            assert fit.drift_m == pytest.approx(drift_m, rel=0.25)


@pytest.mark.parametrize("drift_m", [12.0, 30.0])
@pytest.mark.parametrize("shape", ["line", "there and back"])
def test_heights_of_a_barometer_are_as_high_above_the_sea_as_altitudes_tell(drift_m, shape):
    """Heights over the take-off give the shape; how high the take-off lies is known no better than altitudes drift."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = strips(5, 5, 11.0, rng)
        time = np.linspace(0, 1, len(places))
        recorded = places + rng.normal(0, 1.0, places.shape)
        recorded[:, 2] += drift_m * (time if shape == "line" else np.sin(np.pi * time))
        taken = [SimpleNamespace(relative_altitude=height) for height in places[:, 2] + rng.normal(0, 0.3, len(places))]
        fit, barometer, _ = georegistration._best_fit(problem_of(places, recorded, seed)[0], taken)
        off = abs(fit.placed.mean(axis=0)[2] - places[:, 2].mean())
        assert barometer
        assert off <= fit.place_error_m[1] < 2 * drift_m
        assert off > 0.3 * drift_m


def test_a_datum_counts_in_the_place_as_far_as_its_positions_are_used():
    places = strips(6, 6, 20.0, np.random.default_rng(0))
    recorded = places + np.random.default_rng(1).normal(0, 1.0, places.shape)
    recorded[7] += [250, 0, 0]  # of a datum that PROJ does not know
    fit = fit_positions(problem_of(places, recorded, 0)[0])
    assert not fit.inliers[7]
    used = np.flatnonzero(fit.inliers)
    for errors, share in (
        (300.0 * (np.arange(36) == 7), 0), (300.0 * (np.arange(36) == used[3]), 1 / len(used)), (np.full(36, 300.0), 1),
    ):  # fmt: skip
        positions = GpsPriors(
            image_indices=np.arange(36), enu=recorded, gps_std=np.ones((36, 3)), origin=(0.0, 0.0, 0.0),
            altitude_reference="", source="EXIF", notes=(), datum_errors_m=errors,
        )  # fmt: skip
        across, _ = georegistration._place_error(fit, None, positions, np.arange(36))
        assert across == pytest.approx(np.hypot(fit.place_error_m[0], 300 * share))


@pytest.mark.parametrize("datum_m", [0.0, 20.0, 48.0])
@pytest.mark.parametrize("flown", ["beside each other", "over each other"])
def test_altitudes_of_flights_that_differ_by_a_datum_tilt_nothing_and_are_said(datum_m, flown):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        places = strips(6, 6, 20.0, rng)
        flights = np.arange(36) // 18 if flown == "beside each other" else np.arange(36) // 6 % 2
        recorded = places + rng.normal(0, 1.0, places.shape)
        recorded[:, 2] += datum_m * flights
        problem, turn = problem_of(places, recorded, seed)
        positions = GpsPriors(
            image_indices=np.arange(36), enu=recorded, gps_std=np.ones((36, 3)), origin=(0.0, 0.0, 0.0),
            altitude_reference="", source="EXIF", notes=(), flights=flights,
        )  # fmt: skip
        levelled, offsets = georegistration._without_offsets(problem, positions, np.arange(36))
        fit = fit_positions(levelled)
        assert fit.altitude == "used"
        assert tilt_deg(fit, turn) <= fit.level_error_deg
        if not datum_m:
            assert offsets is None
            continue
        assert abs(offsets.different[0]) == pytest.approx(datum_m, abs=2.0)
        across, up = georegistration._place_error(fit, offsets, positions, np.arange(36))
        assert (across, up >= datum_m - 2) == (fit.place_error_m[0], True)
        # A flight with RTK beside one without says what is right.
        stated = np.where(flights == flights[~offsets.reference][0], 3.0, 0.02)
        one = replace(positions, gps_std=np.repeat(stated[:, None], 3, axis=1))
        assert georegistration._place_error(fit, offsets, one, np.arange(36)) == fit.place_error_m
        rounded = replace(one, altitude_step_m=10.0)
        assert georegistration._place_error(fit, None, rounded, np.arange(36))[1] == pytest.approx(
            np.hypot(fit.place_error_m[1], 10)
        )
        assert f"{offsets.different[0]:+.0f} m (18 photographs)" in georegistration._of_offsets(offsets, fit)[0]


@pytest.mark.parametrize("wrong_m", [0.0, 3.0])
@pytest.mark.parametrize("count", [6, 12])
def test_positions_without_altitudes_tell_scale_and_north(wrong_m, count):
    """Of all photographs, or of every other one."""
    rng = np.random.default_rng(4)
    places = strips(3, 4, 17.0, rng)[:: 12 // count]
    recorded = (places + rng.normal(0, wrong_m, places.shape)) * [1, 1, 0]
    problem, turn = problem_of(places, recorded, 4)
    fit = fit_positions(replace(problem, has_altitudes=False))
    assert fit.altitude == "none"
    assert fit.why_refused("EXIF") == ""
    assert abs(fit.similarity.scale / SCALE - 1) <= fit.scale_error < 0.3
    assert abs(north_off_deg(fit, turn)) <= fit.north_error_deg < 15
    assert tilt_deg(fit, turn) <= fit.level_error_deg


@pytest.mark.parametrize("altitudes", ["none", "useless"])
@pytest.mark.parametrize(("count", "each"), [(2, 10), (6, 10)])
def test_chance_in_the_plane_does_not_tilt_what_attitudes_or_views_level(altitudes, count, each):
    """A tilt of 3 degrees shortens a flight by 0.1 %, as errors of positions do: level stays as it was known, or is
    nearer where that was far off."""
    within = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        places = strips(count, each, 20.0, rng)
        recorded = places + rng.normal(0, 0.8, places.shape)
        if altitudes == "useless":
            recorded[:, 2] += 80 * np.sin(np.pi * np.linspace(0, 1, len(places)))
        problem, turn = problem_of(places, recorded, seed, 3.0)
        known = float(np.degrees(np.arccos((turn @ problem.up.direction)[2])))
        fit = fit_positions(replace(problem, has_altitudes=altitudes != "none"))
        assert fit.altitude == ("none" if altitudes == "none" else "drifts")
        assert known - 2.0 < tilt_deg(fit, turn) < known + 0.1
        assert known > 2 * 3.0 or tilt_deg(fit, turn) == pytest.approx(known, abs=0.1)
        within.append(tilt_deg(fit, turn) <= fit.level_error_deg)
        within.append(abs(fit.similarity.scale / SCALE - 1) <= fit.scale_error)
    assert np.mean(within) >= 0.8


def test_many_positions_in_the_plane_contradict_attitudes_or_views_that_are_far_off():
    """Up told 12 degrees off shortens a level flight by 2 %; where up is told along a slope, the slope may fall to
    either side, and level is stated no better than that."""
    rng = np.random.default_rng(1)
    places = strips(12, 20, 20.0, rng)
    off = Up(np.array([np.sin(np.radians(12)), 0, np.cos(np.radians(12))]), 3.0, "the views")
    times = np.linspace(0, 1, len(places))
    problem = Problem(
        centers=places / SCALE, targets=places + rng.normal(0, 0.8, places.shape), times=times, up=off,
        has_altitudes=False,
    )  # fmt: skip
    assert tilt_deg(fit_positions(problem), np.eye(3)) < 4
    slope = places * [1, 1, 0] + np.outer(np.tan(np.radians(15)) * places[:, 0], [0, 0, 1])
    normal = Up(np.array([-np.sin(np.radians(15)), 0, np.cos(np.radians(15))]), 3.0, "the views")
    fit = fit_positions(replace(problem, centers=slope / SCALE, targets=slope + rng.normal(0, 0.8, slope.shape)))
    assert tilt_deg(fit, np.eye(3)) <= fit.level_error_deg
    along = replace(problem, centers=slope / SCALE, targets=slope + rng.normal(0, 0.8, slope.shape), up=normal)
    fit = fit_positions(along)
    assert 13 < tilt_deg(fit, np.eye(3)) <= fit.level_error_deg + 1


@pytest.mark.parametrize("count", [3, 4, 5])
def test_few_positions_are_not_judged_as_strictly_as_many(count):
    """An exact fit of three says little: their errors are as large as few make them, and altitudes do not tilt them."""
    corners = np.array([[0.0, 0, 75], [60, 5, 77], [55, 50, 74], [2, 48, 76], [30, 25, 75]])[:count]
    recorded = corners + np.random.default_rng(3).normal(0, 3, corners.shape)
    problem, turn = problem_of(corners, recorded, 3)
    fit = fit_positions(problem)
    assert not fit.why_refused("EXIF")
    assert abs(fit.similarity.scale / SCALE - 1) < fit.scale_error
    assert fit.scale_error > 0.02
    drifting = recorded + np.outer(np.linspace(0, 1, count), [0, 0, 40])
    problem, turn = problem_of(corners, drifting, 3)
    assert tilt_deg(fit_positions(problem), turn) < 6


def test_positions_worse_than_nothing_are_refused_in_words_that_agree_with_each_other():
    rng = np.random.default_rng(2)
    places = strips(3, 4, 0.4, rng) * [1, 1, 0.01]
    problem, _ = problem_of(places, places + rng.normal(0, 2.0, places.shape), 2)
    said = fit_positions(problem).why_refused("EXIF")
    assert "disagree by about" in said
    assert "over a flight of" in said
    assert " agree" not in said.replace("disagree", "")


@pytest.mark.parametrize(("radius", "believed"), [(1.5, 0.1), (10.0, 0.8), (20.0, 1.0)])
def test_positions_that_wander_as_a_phone_does_tell_no_scale_of_a_small_orbit(radius, believed):
    """Errors that follow each other look like a smaller or larger orbit: they count for more than random ones."""
    taken, within = [], []
    for seed in range(12):
        rng, angle = np.random.default_rng(seed), np.linspace(0, 2 * np.pi, 30, endpoint=False)
        places = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(30, 1.5)], axis=1)
        walk = np.cumsum(rng.normal(0, 1, places.shape), axis=0)
        walk -= walk.mean(axis=0)
        walk *= rng.uniform(1, 2.5) / np.sqrt((walk[:, :2] ** 2).sum(axis=1).mean())
        problem, _ = problem_of(places, places + walk, seed, 4.0)
        fit = fit_positions(problem)
        taken.append(not fit.why_refused("EXIF"))
        within += [abs(fit.similarity.scale / SCALE - 1) <= fit.scale_error] if taken[-1] else []
    assert np.mean(taken) <= believed if believed < 0.5 else np.mean(taken) >= believed
    assert (radius == 1.5 and not within) or np.mean(within) >= 0.75


def test_stated_accuracy_wins_over_what_views_say_of_up():
    """A receiver with RTK over a slope of 10 degrees that a drone follows: its heights are right, the views are not."""
    rng = np.random.default_rng(1)
    places = strips(5, 8, 20.0, rng)
    places[:, 2] += np.tan(np.radians(10)) * places[:, 0]
    problem, turn = problem_of(places, places + rng.normal(0, 0.02, places.shape), 1, 4.0, np.full(places.shape, 0.02))
    fit = fit_positions(problem)
    assert fit.altitude == "used"
    assert tilt_deg(fit, turn) < 0.1
    assert fit.place_error_m[0] < 0.1


def test_small_drifts_of_a_receiver_with_rtk_are_said_with_their_digits():
    """Altitudes that sink by 18 cm where all else is good to 1 cm: a drift, and not one of "-0 m"."""
    rng = np.random.default_rng(2)
    places = strips(4, 8, 20.0, rng)
    recorded = places + rng.normal(0, 0.01, places.shape)
    recorded[:, 2] -= 0.18 * np.linspace(0, 1, len(places))
    fit = fit_positions(problem_of(places, recorded, 2)[0])
    assert fit.altitude == "drifts"
    (note,) = georegistration._of_altitudes(fit, barometer=False)
    drift, good = map(float, re.search(r"drift by ([+-][\d.]+) m .* good to ±([\d.]+) m", note).groups())
    assert drift == pytest.approx(fit.drift_m, rel=0.05)
    assert good == pytest.approx(fit.place_error_m[1], rel=0.05)
    accuracy = georegistration.accuracy_of(fit, SimpleNamespace(has_altitudes=True))
    assert f"altitudes drift by {drift} m" in dict(reconstruction._accuracy_rows(accuracy))["Positions are good to"]


@pytest.mark.parametrize("spreads", [(1.0,), (1.0, 1.0), (1.0, 3.0), (1.0, 0.1)])
@pytest.mark.parametrize("free", [4, 12, math.inf])
def test_stated_distances_hold_95_percent_of_errors_whose_size_is_found(spreads, free):
    rng, trials = np.random.default_rng(0), 4000
    errors = rng.normal(size=(trials, len(spreads))) * spreads
    found = np.sqrt(rng.chisquare(free, trials) / free) if math.isfinite(free) else np.ones(trials)
    stated = [radius_95(np.square(size * np.array(spreads)), free) for size in found]
    assert 0.93 < (np.linalg.norm(errors, axis=1) <= stated).mean() < 0.97


def test_receivers_of_two_drones_that_fly_at_the_same_time_wander_each_on_its_own():
    """Walks that differ are seen however the clock deals their photographs out."""
    rng = np.random.default_rng(1)
    places = np.concatenate([strips(4, 8, 20.0, rng) + beside for beside in ([0, 0, 0], [0, 15, 0])])
    wander = np.concatenate([np.cumsum(rng.normal(0, 0.4, (32, 3)), axis=0) for _ in range(2)])
    after, _ = problem_of(places, places + wander, 1)
    flights = np.repeat([4, 2], 32)
    dealt = replace(after, times=np.concatenate([np.arange(32), np.arange(32) + 0.5]) / 32, flights=flights)
    one, other = fit_positions(after), fit_positions(dealt)
    assert other.scale_error == pytest.approx(one.scale_error, rel=0.05)
    assert other.scale_error > 1.5 * fit_positions(replace(dealt, flights=None)).scale_error
    shuffled = rng.permutation(64)
    assert (
        replace(dealt, flights=flights[shuffled], times=dealt.times[shuffled]).order.tolist()
        == np.argsort(shuffled).tolist()
    )


def test_positions_that_are_another_flights_are_left_out():
    rng = np.random.default_rng(7)
    places = strips(4, 8, 20.0, rng)
    recorded = places + rng.normal(0, 1, places.shape)
    recorded[[3, 17, 20]] += [150.0, -90, 30]
    problem, _ = problem_of(places, recorded, 7)
    fit = fit_positions(problem)
    assert not fit.inliers[[3, 17, 20]].any()
    assert fit.inliers.sum() >= 27
    assert fit.similarity.scale == pytest.approx(SCALE, rel=0.02)


def test_a_flight_far_from_where_its_photographs_were_put_is_said_and_has_no_datum():
    """Places that look alike taken for one: 12 of one flight and 9 of another, 400 m away and 20 m higher."""
    rng = np.random.default_rng(3)
    places = strips(3, 7, 14.0, rng)
    recorded = places + rng.normal(0, 0.05, places.shape)
    flights = np.arange(21) // 12
    recorded[12:] += [400.0, 50, 20]
    problem, _ = problem_of(places, recorded, 3)
    positions = GpsPriors(
        image_indices=np.arange(21), enu=recorded, gps_std=np.ones((21, 3)), origin=(0.0, 0.0, 0.0),
        altitude_reference="", source="EXIF", notes=(), flights=flights,
    )  # fmt: skip
    far = HEIGHT_M / SCALE
    levelled, offsets = georegistration._without_offsets(problem, positions, np.arange(21), far)
    assert offsets is None
    fit = fit_positions(levelled)
    elsewhere = georegistration._elsewhere(fit, far)
    assert (elsewhere == (flights == 1)).all()
    assert untrusted_offsets(-fit.residuals[:, 2], fit.inliers | elsewhere, flights) is None
    (note,) = georegistration._of_elsewhere(fit, elsewhere, HEIGHT_M)
    assert re.search(r"9 of 21 positions lie about 40\d m", note)
    assert "5.4 times as far as the cameras see" in note
    sound = fit_positions(problem_of(places, places + rng.normal(0, 2, places.shape), 3)[0])
    assert georegistration._of_elsewhere(sound, georegistration._elsewhere(sound, far), HEIGHT_M) == []


def test_altitudes_of_a_flight_that_is_not_trusted_are_said():
    """They drift, and count from elsewhere: no datum explains them, and what they say otherwise is no secret."""
    flights, trusted = np.repeat([0, 1, 2], [20, 10, 2]), np.arange(32) < 20
    off = np.where(trusted, 0.02, np.linspace(-44, -33, 32))
    offsets = untrusted_offsets(off, trusted, flights)
    assert offsets is not None
    assert offsets.different == [pytest.approx(np.median(off[20:30]))]
    assert (offsets.reference == trusted).all()
    assert untrusted_offsets(off, trusted | (np.arange(32) == 22), flights) is None  # one that is trusted says enough
    nearer = untrusted_offsets(off / 10, trusted, flights)  # as all of another height are where a model is stretched
    assert nearer is not None
    assert nearer.different == [pytest.approx(np.median(off[20:30]) / 10)]
    noisy = np.where(trusted, np.linspace(-3, 3, 32), off / 10)
    assert untrusted_offsets(noisy, trusted, flights) is None  # no more than trusted ones differ by


def test_along_a_line_up_is_what_is_known_without_positions():
    rng = np.random.default_rng(9)
    places = strips(1, 8, 20.0, rng)
    problem, turn = problem_of(places, places + rng.normal(0, 1, places.shape), 9)
    fit = fit_positions(problem)
    assert tilt_deg(fit, turn) < 5
    assert abs(north_off_deg(fit, turn)) < 3
    assert not fit.why_refused("EXIF")


def test_a_facade_gets_its_scale_from_heights_too():
    rng = np.random.default_rng(4)
    places = np.stack([np.tile([0.0, 1, 2], 8), np.zeros(24), 3.0 * np.repeat(np.arange(8), 3)], axis=1) * 3
    problem, _ = problem_of(places, places + rng.normal(0, 0.5, places.shape), 4)
    fit = fit_positions(problem)
    assert fit.altitude == "used"
    assert fit.similarity.scale == pytest.approx(SCALE, rel=0.05)


@pytest.mark.parametrize("wrong_m", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("change", ["exchanged", "latitudes", "longitudes"])
@pytest.mark.parametrize("each", [3, 4, 8])
def test_mirrored_positions_are_named_and_sound_ones_never(wrong_m, change, each):
    mirror = {"exchanged": [[0, 1, 0], [1, 0, 0], [0, 0, 1]], "latitudes": np.diag([1, -1, 1]),
              "longitudes": np.diag([-1, 1, 1])}[change]  # fmt: skip
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = strips(3, each, 17.0, rng)
        recorded = places + rng.normal(0, wrong_m, places.shape)
        for read, said in ((recorded @ np.array(mirror, float), "mirrored"), (recorded, "")):
            problem, _ = problem_of(places, read, seed)
            others = {"mirrored": read * np.array([1.0, -1, 1])}
            assert mirrored(problem.centers, read, problem.up.direction, others) == said


def test_views_that_look_down_tell_up_over_a_slope():
    rng = np.random.default_rng(0)
    places = strips(4, 6, 20.0, rng)
    slope = np.tan(np.radians(18)) * places[:, 0]
    ground = rng.uniform(-80, 80, (500, 3)) * [1, 1, 0.02]
    ground[:, 2] += np.tan(np.radians(18)) * ground[:, 0]
    rotations = np.array(
        [np.diag([1.0, -1, -1]) @ Rotation.from_euler("xyz", [*rng.normal(0, 3, 2), 180.0 * (k % 2)], True).as_matrix()
         for k in range(len(places))]
    )  # fmt: skip
    up, deviation, sure, _ = up_by_views(places + slope[:, None] * [0, 0, 1], rotations, ground)
    assert np.degrees(np.arccos(up[2])) < 6
    assert sure
    assert deviation >= 3


# ---------------------------------------------------------------------------------------------- control points


def doubts(gps: bool = True, altitude: float = 500.0) -> tuple[Doubts, np.ndarray]:
    """A model that is in metres already, placed by GPS to 3 m, its points on the ground."""
    rng = np.random.default_rng(0)
    centers = strips(3, 4, 17.0, rng)
    accuracy = AccuracyFacts(
        place_m=(6.0, 12.0), scale_percent=5, scale_m=1, north_deg=1, level_deg=1, positions_m=(3.0, 3, 5)
    )
    here = Similarity(1.0, np.eye(3), np.zeros(3))
    rows = np.arange(len(centers))
    placed = Georegistration(
        similarity=here,
        method="GPS",
        position_rows=rows,
        targets=np.zeros((len(rows), 3)),
        residuals=np.zeros_like(centers),
        inliers=np.ones(len(centers), bool),
        accuracy=accuracy,
    )
    up = Up(np.array([0.0, 0, 1]), 2.0, "the views")
    marks = np.array([[-20.0, -20, 0], [20, -20, 1], [20, 20, 0.5], [-20, 20, 0], [0, 5, 2]])
    return Doubts(
        up=up,
        centers=centers,
        by_gps=placed if gps else None,
        gps="EXIF",
        altitude=altitude,
    ), marks


def said_of(doubt: Doubts, marks: np.ndarray, targets: np.ndarray) -> str:
    return doubt(fit_similarity(marks, targets), marks, targets)


def test_sound_control_points_raise_no_doubts():
    doubt, marks = doubts()
    rng = np.random.default_rng(1)
    for _ in range(20):
        assert said_of(doubt, marks, marks + np.array([5, -4, 40]) + rng.normal(0, 0.05, marks.shape)) == ""


@pytest.mark.parametrize("gps", [True, False])
def test_control_points_with_x_and_y_exchanged_are_refused(gps):
    doubt, marks = doubts(gps)
    for count in (3, 5):
        assert "x (east) and y (north)" in said_of(doubt, marks[:count], marks[:count, [1, 0, 2]])


@pytest.mark.parametrize("feet", [FOOT_M, 1 / FOOT_M])
def test_control_points_in_feet_are_refused(feet):
    doubt, marks = doubts()
    assert "in feet" in said_of(doubt, marks, feet * marks)


def test_heights_in_feet_and_points_kilometers_off_are_refused():
    doubt, marks = doubts()
    heights = marks + np.array([0, 0, 500 / FOOT_M - 500])
    assert "Are they in feet" in said_of(doubt, marks, heights)
    assert "3.2 km from where GPS" in said_of(doubt, marks, marks + np.array([3200.0, 0, 0]))
    assert "2 km over those of GPS" in said_of(doubt, marks, marks + np.array([0, 0, 2000.0]))


@pytest.mark.parametrize("off", [40.0, 160.0])
@pytest.mark.parametrize("site", [220.0, 430.0, 900.0])
def test_heights_over_a_gps_that_begins_at_zero_are_in_feet_by_no_means(site, off):
    """A ground of about 0 is as far from heights in metres as from those in feet."""
    doubt, marks = doubts(altitude=0.0)
    assert "Are they in feet" not in said_of(doubt, marks, marks + np.array([0, 0, site]))
    in_feet = (marks[:, 2] + 500 + off) / FOOT_M - 500  # what is off by a geoid is told, by more is not
    assert ("Are they in feet" in said_of(*doubts(), np.c_[marks[:, :2], in_feet])) == (off < 60)


@pytest.mark.parametrize("off", [120.0, 430.0, 1200.0])
def test_heights_over_the_take_off_say_nothing_against_surveyed_ones(off):
    doubt, marks = doubts(altitude=0.0)
    assert doubt.by_gps is not None
    over_sea = GpsPriors(
        image_indices=np.arange(3), enu=np.zeros((3, 3)), gps_std=np.ones((3, 3)), origin=(0.0, 0.0, 60.0),
        altitude_reference="", source="EXIF", notes=(),
    )  # fmt: skip
    placed = replace(doubt.by_gps, residuals=np.full((12, 3), [0.0, 0.0, off]))
    for positions, is_told in ((over_sea, True), (replace(over_sea, over_take_off=True), False)):
        by_gps = georeferencing._at_sea(doubt.by_gps, positions)
        said = said_of(replace(doubt, by_gps=by_gps), marks, marks + np.array([0, 0, off]))
        assert bool(said) == (is_told and off > 1000)
        assert bool(of_gps(placed, by_gps, "gcp.txt", "EXIF")) == is_told
        assert "2 times" in said_of(replace(doubt, by_gps=by_gps), marks, 2 * marks)  # places count all the same


def test_points_that_fit_nothing_are_refused():
    doubt, marks = doubts()
    assert "disagree by" in said_of(
        doubt, marks, marks + np.array([[9.0, 0, 0], [-9, 4, 0], [0, 9, 0], [0, -8, 9], [5, 0, 0]])
    )
