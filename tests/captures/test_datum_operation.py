"""Surveyed points that come in a system, and maps that go out in it, pass through one and the same operation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vdgs.captures.coordinate_systems import datum_error, geocentric_to_geodetic, to_geodetic
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.crs import open_crs
from vdgs.geometry.datum_operation import operation_at

pyproj = pytest.importorskip("pyproj")

FILE = Path("gcp_list.txt")
SCATTER = np.random.default_rng(5).uniform(-1, 1, (20, 3)) * [0.005, 0.005, 40.0]

#: Systems between whose datums PROJ knows several operations, one or none; and a place where each is used.
SYSTEMS = [
    ("EPSG:7375", 20.5, 57.0), ("EPSG:5514", 49.4, 17.3), ("EPSG:5514", 48.7, 19.5), ("EPSG:3912", 46.0, 14.5),
    ("EPSG:8678", 45.0, 16.0), ("EPSG:29850", 4.5, 114.5), ("EPSG:20256", -33.87, 151.2), ("EPSG:5667", 50.9, 11.5),
    ("EPSG:5668", 51.0, 13.7), ("EPSG:2435", 39.9, 114.4), ("EPSG:4547", 39.9, 114.4), ("EPSG:2040", 6.5, -5.0),
    ("EPSG:27700", 51.5, -0.12), ("EPSG:31467", 48.8, 9.2), ("EPSG:2056", 46.95, 7.45), ("EPSG:27572", 48.85, 2.35),
    ("EPSG:2263", 40.7, -74.0), ("EPSG:26715", 44.0, -93.0), ("EPSG:30169", 35.68, 139.76), ("EPSG:3460", -17.8, 178.0),
    ("EPSG:32601", 52.0, -179.99), ("EPSG:4978", 48.1, 11.5), ("EPSG:31467", 46.95, 7.44),
]  # fmt: skip


@pytest.mark.parametrize(("code", "latitude", "longitude"), SYSTEMS)
def test_surveyed_points_have_their_own_coordinates_in_a_map_of_their_system(code, latitude, longitude):
    places = np.array([latitude, longitude, 100.0]) + SCATTER
    drawn = open_crs(code, (latitude, longitude, 100.0))
    surveyed = drawn.from_geodetic(places)
    given = surveyed / [1, 1, 1 if code == "EPSG:4978" else 1 / drawn.meters_per_unit]  # heights are metres in lists
    back = drawn.from_geodetic(to_geodetic(code, FILE)[0](given))
    np.testing.assert_allclose(back, surveyed, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("code", "latitude", "longitude"), [each for each in SYSTEMS if each[0] != "EPSG:4978"])
def test_what_a_list_states_of_its_datum_is_of_the_operation_of_the_map(code, latitude, longitude):
    place = np.array([[latitude, longitude, 100.0]])
    error_m, said = datum_error(code, place)
    notes = " ".join(open_crs(code, (latitude, longitude, 100.0)).notes)
    assert ("is made for" in said) == ("datum shift that is made for" in notes)
    assert ("taken as of WGS 84" in said) == ("hundreds of metres" in notes)
    if "good to" in said:
        assert error_m == operation_at(pyproj.CRS(code), latitude, longitude).accuracy_m


def test_a_shift_by_way_of_a_third_datum_is_found():
    """PROJ knows none between PD/83 (Thuringia) and WGS 84 but a grid's, and one to ETRS89."""
    found = operation_at(pyproj.CRS("EPSG:5667"), 50.9, 11.5)
    assert not found.is_ballpark
    assert not found.made_for
    moved = pyproj.Transformer.from_crs("EPSG:5667", "EPSG:4745", always_xy=True).transform(
        *found.from_geodetic(np.array([[50.9, 11.5, 0.0]]))[0, :2]
    )
    assert np.abs(np.subtract(moved, (11.5, 50.9))).max() > 5e-4


def test_a_system_far_from_where_it_is_used_has_the_nearest_operation():
    """PROJ refuses to list those of ETRS89 about a place in the Atlantic."""
    found = operation_at(pyproj.CRS("EPSG:4258"), 30.0, -40.0)
    assert found.made_for.startswith("Europe")
    assert found.from_geodetic(np.array([[30.0, -40.0, 5.0]]))[0] == pytest.approx([-40, 30, 5], abs=1e-4)


def test_of_equal_operations_that_of_the_country_counts():
    """Boxes of Croatia and of Slovakia hold Ljubljana and Olomouc too."""
    slovenia, croatia = (operation_at(pyproj.CRS("EPSG:3912"), *place) for place in ((46.05, 14.5), (44.5, 15.6)))
    place = np.array([[46.05, 14.5, 0.0]])
    expected = pyproj.Transformer.from_pipeline("urn:ogc:def:coordinateOperation:EPSG::3917")  # Slovenia's
    datum = pyproj.Transformer.from_crs("EPSG:3912", "EPSG:3906")
    own = datum.transform(*slovenia.from_geodetic(place)[0, :2])
    assert expected.transform(*own) == pytest.approx(place[0, :2], abs=1e-6)
    assert np.abs(slovenia.from_geodetic(place) - croatia.from_geodetic(place)).max() > 0.1


@pytest.mark.parametrize("code", ["EPSG:22300", "EPSG:2986"])
def test_systems_that_proj_lists_but_cannot_compute_are_said_to_be_such(code):
    place = (35.0, 9.0, 0.0) if code == "EPSG:22300" else (-66.5, 140.0, 0.0)
    name = pyproj.CRS(code).name
    try:
        pyproj.Transformer.from_crs(code, "EPSG:4326")
    except pyproj.exceptions.ProjError:
        with pytest.raises(VdgsError, match=r"cannot compute.*Give another system, such as EPSG:32"):
            open_crs(code, place)
        with pytest.raises(CaptureError, match="which PROJ cannot compute") as refused:
            to_geodetic(code, FILE)
        assert name in str(refused.value)
    else:  # a PROJ that can
        open_crs(code, place)


@pytest.mark.parametrize(("code", "place"), [("EPSG:4547", (39.9, 114.4)), ("EPSG:6634", (20.0, -156.0))])
def test_datums_of_the_shape_of_wgs_84_are_not_said_to_be_far_off(code, place):
    notes = open_crs(code, (*place, 0.0)).notes
    assert not any("hundreds" in note for note in notes)


def test_the_remedy_for_heights_that_cannot_be_had_is_another_code():
    if not operation_at(pyproj.CRS("EPSG:7415"), 52.1, 5.1).is_ballpark:
        pytest.skip("the grid of NAP is at hand")
    with pytest.raises(VdgsError, match=r"give the system without heights, EPSG:28992\."):
        open_crs("EPSG:7415", (52.1, 5.1, 0.0))


@pytest.mark.parametrize("code", ["EPSG:3912", "EPSG:25832", "EPSG:2056"])
def test_earth_centred_metres_of_a_datum_come_by_the_same_operation(code):
    """As Metashape writes them for a chunk in that system."""
    latitude, longitude = (46.0, 14.5) if code == "EPSG:3912" else (47.0, 8.0)
    drawn = open_crs(code, (latitude, longitude, 100.0))
    surveyed = drawn.from_geodetic(np.array([latitude, longitude, 100.0]) + SCATTER)
    datum = pyproj.CRS(pyproj.CRS(code).to_wkt("WKT1_GDAL")).datum
    earth = pyproj.crs.GeocentricCRS(datum=datum)
    centred = np.stack(pyproj.Transformer.from_crs(code, earth, always_xy=True).transform(*surveyed.T), axis=1)
    back = drawn.from_geodetic(geocentric_to_geodetic(pyproj.CRS(code).to_wkt("WKT1_GDAL"), FILE)(centred))
    np.testing.assert_allclose(back[:, :2], surveyed[:, :2], rtol=0, atol=2e-3)


def test_degrees_from_another_meridian_of_one_datum_are_as_good():
    """A conversion without a datum's shift, though longitudes differ by more than two degrees."""
    system = "+proj=utm +zone=31 +datum=WGS84 +pm=paris"
    assert datum_error(system, np.array([[48.8, 2.4, 100.0]])) == (0.0, "")
