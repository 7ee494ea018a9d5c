"""Surveyed heights under systems in feet are metres or feet: what model and GPS tell, and what is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyproj")

from vdgs.captures.coordinate_systems import HEIGHTS_IN_METERS
from vdgs.captures.reconstruction import AccuracyFacts
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.geometry.similarity import Similarity
from vdgs.sfm.gcp_list import GcpList, GroundControlPoint
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.height_units import by_shape, of_gps, with_height_unit

SURVEY_FOOT_M, ORIGIN = 1200 / 3937, (41.3, -81.75, 0.0)


def surveyed(count: int, relief_m: float, height_m: float, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-60, 60, (count, 2)), height_m + relief_m * rng.uniform(-0.5, 0.5, count)])


def list_of(places: np.ndarray, is_in_feet: bool, **more) -> GcpList:
    """Points as a list under EPSG:3734 has them, heights read as metres."""
    geodetic = geodetic_from_enu(places, ORIGIN)
    geodetic[:, 2] /= SURVEY_FOOT_M if is_in_feet else 1
    points = tuple(GroundControlPoint(str(k), tuple(each), (), False) for k, each in enumerate(geodetic.tolist()))
    system = "NAD83 / Ohio North (ftUS)" + HEIGHTS_IN_METERS
    found = GcpList(points, system, "gcp.txt", (), header="EPSG:3734", unsaid_height_unit_m=SURVEY_FOOT_M)
    return replace(found, **more)


def gps(up_m: float, off_m: float = 0.0) -> Georegistration:
    """A model in metres already, which GPS puts there to ±`up_m`, higher by `off_m`."""
    accuracy = AccuracyFacts(
        place_m=(1.0, up_m), scale_percent=1, scale_m=1, north_deg=1, level_deg=1, positions_m=(1.0, 1, 1)
    )
    return Georegistration(
        similarity=Similarity(1.0, np.eye(3), np.array([0, 0, off_m])), method="GPS", position_rows=np.arange(3),
        targets=np.zeros((3, 3)), residuals=np.zeros((3, 3)), inliers=np.ones(3, bool), accuracy=accuracy,
    )  # fmt: skip


@pytest.mark.parametrize("count", [3, 4, 6, 9])
@pytest.mark.parametrize("relief_m", [0.5, 3.0, 30.0])
def test_the_shape_of_points_never_tells_the_wrong_unit(count, relief_m):
    """One of six points and more is wrong, and the model is bent by as much as marks are wrong."""
    rng, decided, trials = np.random.default_rng(count), 0, 60
    for trial in range(trials):
        true = surveyed(count, relief_m, 300.0, rng)
        seen = true + rng.normal(0, 0.03, true.shape)
        seen[:, 2] += 0.1 * (true[:, 0] / 60) ** 2
        listed = true.copy()
        listed[: count // 6] += [3.0, -2.0, 4.0]
        feet = listed * [1, 1, SURVEY_FOOT_M]
        over = listed / [1, 1, SURVEY_FOOT_M]
        in_feet = bool(trial % 2)
        found = by_shape(seen / 7, over if in_feet else listed, listed if in_feet else feet, 0.03 / 7).in_feet
        assert found in (None, in_feet)
        decided += found is not None
    if count >= 4 and relief_m > 10:
        assert decided >= 0.9 * trials


@pytest.mark.parametrize("in_feet", [True, False])
def test_heights_are_read_in_the_unit_that_fits_the_photographs(in_feet):
    places = surveyed(6, 20.0, 290.0, np.random.default_rng(1))
    located = dict(enumerate(places / 5))
    read, note = with_height_unit(list_of(places, in_feet), located, ORIGIN, 0.01, None, "EXIF")
    assert read.enu(ORIGIN) == pytest.approx(places, abs=1e-3)
    assert ("disagree by" in note) == (note != "") == in_feet
    assert ("heights in feet" in read.crs) == in_feet


@pytest.mark.parametrize("in_feet", [True, False])
def test_heights_over_flat_ground_are_told_by_gps(in_feet):
    places = surveyed(6, 0.0, 11.0, np.random.default_rng(1))
    located = dict(enumerate(places))
    read, note = with_height_unit(list_of(places, in_feet), located, ORIGIN, 0.01, gps(2.0), "table.csv")
    assert read.enu(ORIGIN) == pytest.approx(places, abs=1e-3)
    assert ("25.1 m over those of GPS (table.csv)" in note) == (note != "") == in_feet
    assert ("EPSG:3734+6360 says feet" in note) == in_feet


def test_heights_that_nothing_tells_are_metres_and_the_note_says_how_to_say_it():
    places = surveyed(6, 0.0, 36.5, np.random.default_rng(1))
    listed, located = list_of(places, False), dict(enumerate(places))
    for by in (None, gps(3.0, 60.0), gps(60.0)):
        read, note = with_height_unit(listed, located, ORIGIN, 0.01, by, "EXIF")
        assert read is listed
        assert "25.4 m lower" in note
        assert "EPSG:3734+6360 says feet, EPSG:3734+5703 metres" in note
    by_words = replace(listed, header="+proj=utm +zone=17 +units=us-ft")
    assert "x,y,z[ft]" in with_height_unit(by_words, {}, ORIGIN, 0.01, None, "")[1]
    foot = replace(listed, header="EPSG:2223", unsaid_height_unit_m=0.3048)
    assert "EPSG:2223+8228 says feet" in with_height_unit(foot, {}, ORIGIN, 0.01, None, "")[1]
    said = replace(listed, unsaid_height_unit_m=None)
    assert with_height_unit(said, located, ORIGIN, 0.01, gps(3.0, 60.0), "EXIF") == (said, "")


@pytest.mark.parametrize("height_m", [200.0, 300.0, 480.0])
def test_a_gps_that_begins_at_zero_tells_no_feet(height_m):
    """As one does of heights over the take-off that is said to be one over the sea."""
    places = surveyed(6, 0.0, height_m, np.random.default_rng(1))
    located = dict(enumerate(places))
    read, note = with_height_unit(list_of(places, False), located, ORIGIN, 0.01, gps(5.0, -height_m), "EXIF")
    assert read.enu(ORIGIN) == pytest.approx(places, abs=1e-3)
    assert "nothing tells" in note
    read, _ = with_height_unit(list_of(places, True), located, ORIGIN, 0.01, gps(5.0, 60.0), "EXIF")
    assert read.enu(ORIGIN) == pytest.approx(places, abs=1e-3)


def test_a_bent_model_of_the_other_shape_decides_nothing_against_gps():
    """A hollow that the model shows as deep as the wrong unit has it."""
    places = surveyed(6, 0.0, 290.0, np.random.default_rng(2))
    hollow = ((places[:, :2] / 60) ** 2).sum(axis=1)
    places[:, 2] += 3 * hollow
    bent = places - np.outer(3 * (1 - SURVEY_FOOT_M) * hollow, [0, 0, 1])
    listed, located = list_of(places, False), dict(enumerate(bent))
    assert with_height_unit(listed, located, ORIGIN, 0.01, None, "EXIF")[0] is not listed
    read, note = with_height_unit(listed, located, ORIGIN, 0.01, gps(2.0), "EXIF")
    assert read is listed
    assert "nothing tells" in note


def test_control_points_that_contradict_good_positions_are_said():
    by = gps(1.0)
    placed = replace(by, residuals=np.tile([0.3, 0.2, 25.8], (3, 1)))
    assert "25.8 m higher than GPS (EXIF), which is good to ±1 m" in of_gps(placed, by, "gcp.txt", "EXIF")[0]
    assert of_gps(placed, gps(20.0), "gcp.txt", "EXIF") == ()
    assert of_gps(placed, None, "gcp.txt", "EXIF") == ()
    away = replace(by, residuals=np.tile([30.0, 0, 0], (3, 1)))
    assert "another datum" in of_gps(away, by, "gcp.txt", "EXIF")[0]
    in_plane = replace(by, residuals=np.zeros((3, 2)))
    assert of_gps(in_plane, by, "gcp.txt", "EXIF") == ()
