"""Coordinates on the map: exact, invertible, with the right north, and refused where nobody knows them."""

import sys
import warnings

import numpy as np
import pytest

from vdgs.cli.advice import Advice
from vdgs.cli.main import verb_arguments
from vdgs.errors import VdgsError
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_enu
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.geometry.map_projection import MapProjection

pyproj = pytest.importorskip("pyproj")

BERN = (46.95, 7.44, 560.0)


def frame(origin=BERN, axes=None, metric=True):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return GroundFrame(
        scale=2.0,
        rotation=turn,
        translation=np.array([3.0, -4, 5]),
        metric=metric,
        description="GPS",
        origin_geo=origin,
        axes_geo=axes,
    )


def scattered(count=50, reach=(900.0, 700.0, 60.0), seed=3):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * reach


SYSTEMS = [None, "enu", "source", "local", "EPSG:2056", "EPSG:25832", "epsg:4978", "EPSG:32632", "EPSG:3857"]


@pytest.mark.parametrize("crs", SYSTEMS)
def test_there_and_back_to_a_micrometre(crs):
    placement = MapProjection.of(frame(), crs)
    points = scattered()
    np.testing.assert_allclose(placement.to_ground(placement.project(points)), points, rtol=0, atol=2e-6)


@pytest.mark.parametrize("origin", [BERN, (-33.9, -70.6, 900.0), (64.1, -21.9, 20.0), (-17.0, 179.9999, 5.0)])
def test_the_default_is_the_utm_zone_as_pyproj_has_it(origin):
    placement = MapProjection.of(frame(origin))
    zone = int((origin[1] + 180) // 6) + 1
    assert placement.crs == f"EPSG:{(32600 if origin[0] > 0 else 32700) + zone}"
    assert (placement.unit, placement.meters_per_unit) == ("m", 1.0)
    points = scattered()
    latitude, longitude, height = geodetic_from_enu(points, origin).T
    x, y = pyproj.Proj(placement.crs)(longitude, latitude)
    np.testing.assert_allclose(placement.project(points), np.stack([x, y, height], axis=1), rtol=0, atol=1e-6)
    assert pyproj.CRS.from_wkt(placement.wkt).to_epsg() == int(placement.crs[5:])


@pytest.mark.parametrize("crs", ["EPSG:2100", "EPSG:5514", "EPSG:27700"])
def test_beside_its_country_a_system_keeps_its_datum_shift_and_says_so(crs):
    """As pyproj does, which takes the best operation of those that its catalogue has, wherever it is made for."""
    placement = MapProjection.of(frame(), crs)
    assert any("datum shift that is made for" in note for note in placement.notes)
    points = scattered()
    latitude, longitude, height = geodetic_from_enu(points, BERN).T
    with warnings.catch_warnings():  # of grids that are not at hand
        warnings.simplefilter("ignore", UserWarning)
        ways = pyproj.transformer.TransformerGroup("EPSG:4979", crs, always_xy=True).transformers
    near = min(
        np.abs(placement.project(points)[:, :2] - np.stack(way.transform(longitude, latitude, height)[:2], 1)).max()
        for way in ways
        if "ballpark" not in way.description.lower()
    )
    assert near < 0.01


def test_a_local_similarity_turns_by_the_meridian_convergence_and_scales_by_the_map():
    placement = MapProjection.of(frame())
    center = np.array([350.0, -200.0, 10.0])
    found = placement.similarity_at(center)
    scale, rotation = found.scale, found.rotation
    latitude, longitude, height = geodetic_from_enu(center[None], BERN)[0]
    factors = pyproj.Proj(placement.crs).get_factors(longitude, latitude)
    turned = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
    # The ground frame's north is that of its origin; meridians run together on the way to the center.
    between = (longitude - BERN[1]) * np.sin(np.radians(latitude))
    assert turned == pytest.approx(factors.meridian_convergence - between, abs=1e-4)
    assert abs(turned) > 1
    above = 1 / (1 + height / 6.385e6)  # metres up here are longer than those of the ellipsoid
    assert scale == pytest.approx(factors.meridional_scale * above, abs=2e-6)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("crs", SYSTEMS[:-1])  # Web Mercator stretches north more than east: no similarity does that
def test_a_local_similarity_keeps_to_the_map_over_a_hundred_meters(crs):
    placement = MapProjection.of(frame(), crs)
    center = np.array([600.0, 500.0, -20.0])
    near = center + scattered(reach=(50.0, 50.0, 20.0))
    found = placement.similarity_at(center).apply(near)
    off = np.abs(found - placement.project(near))
    assert off[:, :2].max() < 1e-3  # on a map of 10 cm a pixel: a hundredth of one
    assert off[:, 2].max() < 0.02


def test_a_moved_frame_keeps_its_axes_and_its_place_on_earth():
    """The same photographs about an origin 30 km away: every point lands where it did."""
    first = frame()
    shift = np.array([25_000.0, -17_000.0, 120.0])
    moved = frame(tuple(geodetic_from_enu(shift[None], BERN)[0]), axes=BERN[:2])
    points = scattered()
    for crs in ("EPSG:32632", "EPSG:4978"):
        np.testing.assert_allclose(
            MapProjection.of(moved, crs).project(points - shift),
            MapProjection.of(first, crs).project(points),
            rtol=0,
            atol=1e-5,
        )
    # enu is level at the frame's own origin, whatever its axes are.
    rising = MapProjection.of(moved, "enu").project(np.array([[0.0, 0, 0], [0, 0, 1]]))
    np.testing.assert_allclose(rising[0], 0, atol=1e-9)
    assert np.degrees(np.arccos(rising[1, 2])) == pytest.approx(np.degrees(np.hypot(25, 17) / 6378), rel=0.02)


def test_source_is_the_world_of_the_capture():
    ground, points = frame(), scattered()
    np.testing.assert_allclose(MapProjection.of(ground, "source").project(ground.to_ground(points)), points, atol=1e-9)


def test_geocentric_places_are_those_of_geodesy():
    points = scattered()
    expected = points @ enu_axes(*BERN[:2]) + ecef_from_geodetic(np.array([BERN]))
    np.testing.assert_allclose(MapProjection.of(frame(), "EPSG:4978").project(points), expected, rtol=0, atol=1e-6)


def test_feet_are_feet_up_as_across():
    ground = frame((40.7, -73.9, 10.0))
    feet, meters = MapProjection.of(ground, "EPSG:2263"), MapProjection.of(ground)
    assert feet.unit == "US survey foot"
    up = np.array([[0.0, 0, 0], [0, 0, 30]])
    rise = np.diff(feet.project(up)[:, 2])[0] * feet.meters_per_unit
    assert rise == pytest.approx(np.diff(meters.project(up)[:, 2])[0], abs=1e-6)
    assert "foot" in feet.height_reference


def test_what_a_place_outside_the_area_of_a_system_gets_is_a_note():
    assert any("outside" in note for note in MapProjection.of(frame(), "EPSG:32611").notes)
    assert MapProjection.of(frame(), "EPSG:32632").notes == ()


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", "degrees"),
        ("EPSG:999999", "not in the EPSG catalogue"),
        ("utm", "no coordinate system known here.*enu"),
        ("EPSG:", "not in the EPSG catalogue"),
        ("EPSG:32632+3855", r"heights .*EGM2008 height.*without heights, EPSG:32632"),
        ("EPSG:5703", "degrees, or heights alone"),
    ],
)
def test_systems_that_make_no_map_are_named(crs, message):
    with pytest.raises(VdgsError, match=message):
        MapProjection.of(frame(), crs)


@pytest.mark.parametrize(
    ("crs", "origin", "message"),
    [
        ("EPSG:5513", (50.1, 14.4, 300.0), r"south and west; .*its twin to the east and north, EPSG:5514"),
        ("EPSG:2065", (50.1, 14.4, 300.0), r"its twin to the east and north, EPSG:5221"),
        ("EPSG:5513+5705", (50.1, 14.4, 300.0), r"EPSG:5513\+5705.*EPSG:5514"),
        ("EPSG:2048", (-33.9, 18.4, 20.0), r"west and south; .*such as EPSG:32734"),
        ("EPSG:3145", (62.0, -6.8, 20.0), r"north and west; .*such as EPSG:32629"),
    ],
)
def test_systems_that_count_to_the_west_are_named_with_one_that_does_not(crs, origin, message):
    with pytest.raises(VdgsError, match=message):
        MapProjection.of(frame(origin), crs)


@pytest.mark.parametrize(
    ("crs", "origin"),
    [
        ("EPSG:5514", (50.1, 14.4, 300.0)),
        ("EPSG:31467", (48.1, 9.4, 300.0)),  # northing first in the catalogue
        (None, (86.0, 19.0, 10.0)),  # UPS, whose axes both lead south
        (None, (-86.0, 19.0, 10.0)),
        ("EPSG:3031", (-77.8, 166.7, 10.0)),
    ],
)
def test_systems_to_the_east_and_north_are_no_mirror(crs, origin):
    placement = MapProjection.of(frame(origin), crs)
    corner = placement.project(np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]]))
    assert np.linalg.det(corner[1:] - corner[0]) > 0
    assert np.linalg.det(placement.similarity_at(np.zeros(3)).rotation) > 0


@pytest.mark.parametrize(
    ("crs", "origin"),
    [
        ("EPSG:32632", BERN), ("EPSG:2056", BERN), ("EPSG:31467", (48.1, 9.4, 300.0)), ("EPSG:3857", BERN),
        ("EPSG:3995", (46.8, -92.0, 200.0)), (None, (-85.0, 170.0, 10.0)), (None, (86.0, 19.0, 10.0)),
        ("EPSG:3031", (-77.8, 166.7, 10.0)), ("EPSG:27700", (51.5, -0.1, 30.0)),
    ],
)  # fmt: skip
def test_north_and_lengths_are_those_of_the_projection(crs, origin):
    """The meridian convergence counts from north to grid north: north lies the other way."""
    ground = frame(origin)
    placement, middle = MapProjection.of(ground, crs), np.array([300.0, -200.0, 0.0])
    latitude, longitude, height = geodetic_from_enu(middle[None], origin)[0]
    factors = pyproj.Proj(placement.crs).get_factors(longitude, latitude)
    off = (placement.true_north(ground, middle) + factors.meridian_convergence + 180) % 360 - 180
    assert abs(off) < 0.01
    areal = np.sqrt(factors.areal_scale) * (1 - height / 6.37e6)
    assert placement.stretch_at(middle) == pytest.approx(areal, rel=3e-4)  # of the system's own ellipsoid


def test_north_by_other_axes():
    ground, place = frame(), np.zeros(3)
    for crs, north_deg in (("enu", 0), ("local", 0), ("source", 90)):  # the capture's own x is north
        assert MapProjection.of(ground, crs).true_north(ground, place) == pytest.approx(north_deg)
    nowhere = frame(None)
    assert MapProjection.of(nowhere, "source").true_north(nowhere, place) is None
    assert MapProjection.of(nowhere, "source").stretch_at(place) == pytest.approx(1.0)
    unknown = frame(None, metric=False)
    assert MapProjection.of(unknown, "source").stretch_at(place) == 1.0


@pytest.mark.parametrize("metric", [True, False])
def test_without_a_georeference_there_is_the_ground_frame_and_the_source(metric):
    ground = frame(None, metric=metric)
    local = MapProjection.of(ground)
    assert (local.crs, local.unit, local.wkt) == ("local", "m" if metric else "units", None)
    np.testing.assert_array_equal(local.project(scattered()), scattered())
    assert MapProjection.of(ground, "source").crs == "source"
    for crs in ("enu", "EPSG:32632"):
        with pytest.raises(VdgsError, match=r"not georeferenced.*--crs local.*vdgs run CAPTURE --gps") as raised:
            MapProjection.of(ground, crs)
        said = str(raised.value)
        assert Advice("ortho", verb_arguments).fit(said) == said  # no verb has to say whose options these are


def test_without_pyproj_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(VdgsError, match=r"pip install 'vdgs\[geo\]'"):
        MapProjection.of(frame(), "EPSG:32632")
    assert MapProjection.of(frame(), "enu").unit == "m"
