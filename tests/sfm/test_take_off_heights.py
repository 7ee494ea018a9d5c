"""Heights over the take-off: 0 on the ground, in the place of altitudes, and of some photographs alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pycolmap")

from vdgs.captures.position_adjustment import Problem, Up
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.sfm import georegistration
from vdgs.sfm.barometer_fit import fit_by_barometer
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.take_off_heights import OVER_KNOWN_TAKE_OFF, OVER_TAKE_OFF, without_default_heights

SITE_M = 430.0


def photo(name: str, east: float, height: float | None, altitude: float | None, camera: str = "DJI") -> ImageMetadata:
    """One that was taken so many metres east, its minute the number at the end of its name."""
    number = int(name.rsplit("_", 1)[-1])
    [(latitude, longitude, _)] = geodetic_from_enu(np.array([[east, 7.0 * (number % 5), 0.0]]), (47.0, 8.0, 0.0))
    return ImageMetadata(
        name=name, path=Path(name), width=4000, height=3000, orientation=1, camera=camera, lens=None,
        datetime=f"2026:06:01 10:{number:02d}:00", lat_lon=(latitude, longitude), altitude=altitude,
        altitude_type="EXIF", gps_std=None, gps_error_m=None, relative_altitude=height, attitude=None, file_bytes=1,
    )  # fmt: skip


def film(count: int, on_ground: int = 2, altitude: float | None = None) -> list[ImageMetadata]:
    """Frames of a film that begins on the ground and rises to 40 m."""
    heights = np.clip(4.0 * (np.arange(count) - on_ground + 1), 0, 40)
    return [photo(f"film/f_{k}", 10.0 * k, heights[k], altitude, "film") for k in range(count)]


def survey(count: int, height: float | None = 60.0) -> list[ImageMetadata]:
    return [photo(f"photos/p_{k}", 10.0 * k, height, SITE_M + 60) for k in range(count)]


def test_heights_of_0_are_those_on_the_ground_unless_a_whole_flight_has_no_other():
    frames = film(20)
    assert without_default_heights(frames) == frames
    unknown = [photo(f"others/o_{k}", 10.0 * k, 0.0, None) for k in range(4)]
    found = without_default_heights([*frames, *unknown])
    assert found[:20] == frames
    assert [each.relative_altitude for each in found[20:]] == [None] * 4


@pytest.mark.parametrize("altitude", [None, 0.0])
def test_a_film_that_begins_on_the_ground_keeps_its_heights(altitude):
    found = read_gps_priors(film(20, altitude=altitude), None, (1.5, 3.0))
    assert found.has_altitudes
    assert found.over_take_off
    assert len(found) == 20
    assert found.altitude_reference == OVER_TAKE_OFF
    assert np.ptp(found.enu[:, 2]) == pytest.approx(40, abs=0.1)


def test_heights_of_few_positions_that_are_not_used_are_not_said_to_be():
    others = [photo(f"photos/p_{k}", 10.0 * k, None, None) for k in range(30)]
    found = read_gps_priors([*film(20), *others], None, (1.5, 3.0))
    assert len(found) == 50
    assert not found.has_altitudes
    assert not any("heights over the take-off are used" in note for note in found.notes)


@pytest.mark.parametrize(("frames", "photographs"), [(20, 1), (20, 8), (8, 20)])
def test_frames_without_altitudes_beside_photographs_with_both_are_as_high_as_those_tell(frames, photographs):
    found = read_gps_priors([*film(frames), *survey(photographs)], None, (1.5, 3.0))
    assert len(found) == frames + photographs
    assert found.has_altitudes
    assert not found.over_take_off
    altitudes = found.enu[:, 2] + found.origin[2]
    assert altitudes[[0, -1]] == pytest.approx([SITE_M, SITE_M + 60], abs=0.1)
    assert found.altitude_reference == f"{OVER_KNOWN_TAKE_OFF}; EXIF"
    assert len(set(found.flights[:frames]) | set(found.flights[frames:])) == 2
    assert any("taken to be as high as that of the others (430 m)" in note for note in found.notes)


@pytest.mark.parametrize("photographs", [3, 30])
def test_altitudes_and_heights_that_nothing_joins_are_not_mixed(photographs):
    found = read_gps_priors([*film(20), *survey(photographs, None)], None, (1.5, 3.0))
    assert found.over_take_off == (photographs == 3)  # what most positions have
    assert len(found) == max(20, photographs)
    assert any("not used" in note for note in found.notes)


def flown_over(drift_m: float) -> tuple[Problem, np.ndarray]:
    """A flight over two levels whose altitudes drift, and the true heights."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(8) * 20.0, np.arange(6) * 20.0)
    time = np.linspace(0, 1, x.size)
    places = np.column_stack([x.ravel(), y.ravel(), 60 + 15.0 * (time > 0.5) + rng.normal(0, 0.3, x.size)])
    recorded = places + rng.normal(0, [1.0, 1.0, 0.5], places.shape)
    recorded[:, 2] += SITE_M - drift_m * time + 8 * np.sin(9 * time)
    up = Up(np.array([0.0, 0.0, 1.0]), 1.0, "the recorded attitudes")
    return Problem(centers=places, targets=recorded, times=time, up=up, flights=np.zeros(len(time), int)), places[:, 2]


@pytest.mark.parametrize(("missing", "on_ground"), [((), ()), ((3,), ()), (range(0, 48, 3), ()), ((), (5,))])
def test_a_barometer_counts_for_those_that_have_one(missing, on_ground):
    """A height of 0 among those of a flight is as wrong as any other."""
    problem, heights = flown_over(30.0)
    read = [None if k in missing else 0.0 if k in on_ground else height for k, height in enumerate(heights)]
    taken = [photo(f"a/p_{k}", 0.0, height, None) for k, height in enumerate(read)]
    fit, barometer, _ = georegistration._best_fit(problem, taken)
    assert barometer
    assert fit.altitude == "used"
    left_out = sorted({*missing, *on_ground})
    assert not fit.inliers[left_out].any()
    assert fit.inliers.sum() >= 45 - len(left_out)
    assert np.abs(fit.residuals[fit.inliers, 2]).max() < 0.5
    assert np.ptp(fit.placed[:, 2] - heights) < 0.5
    assert fit.residuals.shape == fit.placed.shape == fit.deviations.shape == (48, 3)


def test_a_barometer_that_most_photographs_lack_does_not_count():
    problem, heights = flown_over(30.0)
    fit, few = georegistration.fit_positions(problem), np.where(np.arange(48) % 3, np.nan, heights)
    assert fit_by_barometer(problem, fit, few) is None
    assert fit_by_barometer(problem, fit, np.full(48, np.nan)) is None
    assert fit_by_barometer(problem, fit, heights) is not None
