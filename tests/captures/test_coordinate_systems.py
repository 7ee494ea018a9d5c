"""Coordinate systems of tables and lists: their names, their axes and units, and what their datum costs."""

from __future__ import annotations

import re

import numpy as np
import pytest

from vdgs.captures.coordinate_systems import datum_error, false_origin, geocentric_to_geodetic, to_geodetic
from vdgs.captures.gps_tables import read_gps_table
from vdgs.captures.system_names import names_a_system
from vdgs.errors import CaptureError

PLACE = (-33.5, -70.6, 500.0)
EASTING, NORTHING = 351375.7913, 6292135.2282  # of zone 19 south

# PROJ looks seconds for the ways between heights, once in each process.
pytestmark = [pytest.mark.xdist_group("coordinate_systems"), pytest.mark.slow]


@pytest.mark.parametrize(
    ("header", "code"),
    [
        ("WGS84 UTM 19H", 32719), ("UTM Zone 19 South", 32719),
        ("WGS84 UTM 19S", 32719), ("WGS 84 UTM 19 S", 32719), ("UTM zone 19S", 32719), ("EPSG 32719", 32719),
        ("32719", 32719), ("crs: epsg:32719", 32719), ("WGS 84 / UTM zone 19S", 32719), ("utm 19s", 32719),
        ("urn:ogc:def:crs:EPSG::32719", 32719),
    ],
)  # fmt: skip
def test_systems_are_known_by_all_their_names(tmp_path, header, code):
    pytest.importorskip("pyproj")
    (tmp_path / "geo.txt").write_text(f"{header}\na.jpg {EASTING} {NORTHING} 500\n")
    (row,) = read_gps_table(tmp_path / "geo.txt").rows
    assert row.position == pytest.approx(PLACE, abs=2e-6)
    change, name = to_geodetic("EPSG:2225", tmp_path / "geo.txt")
    assert "heights are taken as metres" in name
    assert change(np.array([[6_000_000.0, 2_000_000, 5]]))[0, 2] == 5
    assert "heights as they are, for 'CUST:egm96' is" in to_geodetic("EPSG:32719+CUST:egm96", tmp_path)[1]
    assert "30N" in to_geodetic("WGS84 UTM 30U", tmp_path)[1]
    assert to_geodetic("WGS84 longlat", tmp_path)[0](np.array([[7.0, 50, 5]])) == pytest.approx(np.array([[50, 7, 5]]))


@pytest.mark.parametrize(
    ("system", "names", "factors"),
    [
        ("EPSG:32719", "name,E [km],N [km],h [cm]", (1e-3, 1e-3, 100)),
        ("EPSG:32719", "name,X_ft,Y_ft,Z_ft", (1 / 0.3048,) * 3),
        ("EPSG:2225", "name,easting (ft),northing (US survey ft),z (m)", (1, 1, 1)),  # the system's own feet
    ],
)
def test_units_of_the_columns_of_x_and_y_count(tmp_path, system, names, factors):
    given = np.array([2_000_000.0, 600_000, 80]) if system == "EPSG:2225" else np.array([EASTING, NORTHING, 500.0])
    plain, named = tmp_path / "plain.csv", tmp_path / "named.csv"
    plain.write_text(f"{system}\nname,x,y,z\na.jpg,{','.join(map(repr, given.tolist()))}\n")
    named.write_text(f"{system}\n{names}\na.jpg,{','.join(map(repr, (given * factors).tolist()))}\n")
    (wanted,), (found,) = read_gps_table(plain).rows, read_gps_table(named).rows
    assert found.position == pytest.approx(wanted.position, abs=1e-9)
    for unit, said in (("m", system == "EPSG:2225"), ("ft", False)):  # whether heights are taken as metres
        named.write_text(f"{system}\nname,x,y,z ({unit})\na.jpg,{','.join(map(repr, given.tolist()))}\n")
        assert ("heights are taken as metres" in "".join(read_gps_table(named).notes)) is said
    named.write_text(f"EPSG:4326\n{names}\na.jpg,0.01,0.02,5\n")
    with pytest.raises(CaptureError, match="unit of length, but EPSG:4326 counts in degrees"):
        read_gps_table(named)


@pytest.mark.parametrize(
    ("system", "metres"),
    [("EPSG:2263", 1200 / 3937), ("EPSG:2277+6360", 1200 / 3937), ("+proj=utm +zone=19 +south +units=km", 1000)],
)
@pytest.mark.parametrize("heading", ["x ({}),y ({})", "Easting_{},Northing_{}", "E [{}],N [{}]"])
def test_columns_that_say_metres_are_metres_under_any_system(tmp_path, system, metres, heading):
    own = np.array([EASTING, NORTHING]) / 1000 if metres == 1000 else np.array([1_000_000.0, 200_000])
    read = []
    for names, given in (("x,y", own), (heading.format("m", "m"), own * metres)):
        x, y = map(repr, given.tolist())
        (tmp_path / "t.csv").write_text(f"{system}\nname,{names},z (m)\na.jpg,{x},{y},80\n")
        read.append(read_gps_table(tmp_path / "t.csv"))
    places = [table.rows[0].position for table in read]
    assert places[1] == pytest.approx(places[0], abs=1e-9)
    assert not any("feet" in note for note in read[1].notes)


@pytest.mark.parametrize(
    ("system", "place", "is_metres", "said"),
    [
        (
            "EPSG:2263",
            (990000, 190000),
            False,
            "in the unit of EPSG:2263 .*foot.*: as metres, .* 509 km outside of the",
        ),
        ("EPSG:2263", (301752, 57912), True, ""),
        ("EPSG:2263", (3e7, 3e7), True, "as metres, as their headings say, and not in the unit of EPSG:2263"),
        ("EPSG:6350", (1000, 1500), True, ""),  # metres of its own
        ("+proj=utm +zone=19 +south +units=us-ft", (350000, 6290000), True, "and not in the unit of .*foot"),
    ],
)
def test_the_place_tells_feet_from_metres_where_headings_say_metres_of_any_system(
    tmp_path, system, place, is_metres, said
):
    """Programs write [m] behind x and y, be they in feet."""
    read, factor = [], 1 if system == "EPSG:6350" or not is_metres else 3937 / 1200
    for names, given in (("x,y", np.multiply(place, factor)), ("X[m],Y[m]", np.array(place))):
        x, y = map(repr, given.tolist())
        (tmp_path / "t.csv").write_text(f"{system}\nname,{names},Z[m]\na.jpg,{x},{y},80\n")
        read.append(read_gps_table(tmp_path / "t.csv"))
    assert read[1].rows[0].position == pytest.approx(read[0].rows[0].position, abs=1e-9)
    notes = [note for note in read[1].notes if "headings" in note]
    assert len(notes) == bool(said)
    assert re.search(said, "".join(notes))


def test_metres_of_a_law_are_those_of_the_system_and_of_degrees_none(tmp_path):
    for system, place in (("EPSG:29371", "100000,-2500000"), ("EPSG:4258", "11.5,48.1")):  # German legal metres
        places = []
        for names in ("x,y", "x [m],y [m]"):
            (tmp_path / "t.csv").write_text(f"{system}\nname,{names},z\na.jpg,{place},80\n")
            places.append(read_gps_table(tmp_path / "t.csv").rows[0].position)
        assert places[0] == places[1]


@pytest.mark.parametrize("system", ["EPSG:5555", "EPSG:25832+5783", "EPSG:25832+5621", "EPSG:3067+3900"])
def test_heights_above_a_geoid_that_proj_has_no_grid_of_at_all_are_told(tmp_path, system):
    _, name = to_geodetic(system, tmp_path)
    assert name.endswith("heights as they are, for PROJ lacks the grid of their geoid")


@pytest.mark.parametrize(
    ("system", "x", "y", "said"),
    [
        ("Amersfoort / RD New", 686104, 5330412, "lie 4,4.. km outside of the area that Amersfoort / RD New is made"),
        ("EPSG:2053", -9998, -2889000, "km outside of .* the right signs"),
        ("EPSG:2053", 9998, 2889000, ""),
        ("EPSG:25832", 950000, 5400000, ""),  # one zone for a country
        ("EPSG:25833", 970000, 7800000, ""),
        ("EPSG:3857", 1200000, 6000000, ""),
    ],
)
def test_places_far_outside_of_their_system_are_told(tmp_path, system, x, y, said):
    (tmp_path / "geo.txt").write_text(f"{system}\na.jpg {x} {y} 500\nb.jpg {x + 30} {y} 500\n")
    notes = " ".join(read_gps_table(tmp_path / "geo.txt").notes)
    assert bool(re.search("outside of", notes)) is bool(said)
    assert re.search(said, notes)
    assert "may be off by 50 m" not in notes


@pytest.mark.parametrize("words", ["600", "600 ft", "182.88 m"])
@pytest.mark.parametrize("heading", ["z", "z [ft]", "z (m)"])
@pytest.mark.parametrize(
    "system",
    ["EPSG:2277+6360\nname,x,y,{z}\na.jpg,3112000,10070000", "EPSG:4269+6360\nname,lat,lon,{z}\na.jpg,30.2,-97.7"],
)
def test_heights_of_a_system_in_feet_are_converted_once(tmp_path, system, heading, words):
    """NAVD88 in feet: whatever says the unit of a height, a word, its heading or the system."""
    if heading == "z (m)" and words == "600":
        words = "182.88"
    (tmp_path / "t.csv").write_text(system.format(z=heading.replace("z", "alt")) + f",{words}\n")
    ((*_, height),) = (row.position for row in read_gps_table(tmp_path / "t.csv").rows)
    assert height == pytest.approx(182.88, abs=1e-3)


def test_degrees_under_a_system_in_metres_are_refused(tmp_path):
    rows = [
        f"{name} {PLACE[0] + k / 9000:.8f} {PLACE[1]:.8f} 500"
        for k, name in enumerate(["0.jpg", "1.jpg", "2.jpg", "3.jpg"])
    ]
    (tmp_path / "geo.txt").write_text("\n".join(["EPSG:32719", *rows]))
    with pytest.raises(CaptureError, match=r"look like degrees, but WGS 84 .* counts in metres"):
        read_gps_table(tmp_path / "geo.txt")


@pytest.mark.parametrize(("more", "is_said"), [("", True), (" +towgs84=-288,175,-376", False)])
def test_an_ellipsoid_without_a_datum_is_said_to_be_none(tmp_path, more, is_said):
    system = f"+proj=utm +zone=19 +south +ellps=intl{more} +units=m +no_defs"
    assert ("no datum: taken as WGS 84" in to_geodetic(system, tmp_path)[1]) == is_said


@pytest.mark.parametrize(
    ("words", "code"),
    [
        *((words, "EPSG:32719") for words in (
            "EPSG=32719", "EPSG-32719", "EPSG32719", "SRID=32719", "https://epsg.io/32719", "projection: EPSG:32719",
            "EPSG: 32719 - WGS 84 / UTM zone 19S", "WGS 84 / UTM zone 19S (EPSG::32719)", "UTM19S", "UTM 19 S",
            "http://www.opengis.net/gml/srs/epsg.xml#32719", "WGS_1984_UTM_Zone_19S", "EPSG:32719,EPSG:5773",
        )),
        ("SIRGAS2000 UTM 19S", "EPSG:31979"), ("SWEREF99 TM", "EPSG:3006"), ("LV95", "EPSG:2056"),
        ("ETRS89 UTM 33N", "EPSG:25833"), ("British National Grid", "EPSG:27700"), ("PRETTY", "EPSG:25833"),
        ("NAD83(2011) / California zone 3 (ftUS)", "EPSG:6420"),
    ],
)  # fmt: skip
def test_words_for_systems_that_programs_and_people_write(tmp_path, words, code):
    pyproj = pytest.importorskip("pyproj")
    crs = pyproj.CRS(code)
    near = {"EPSG:32719": (-33.5, -70.6), "EPSG:31979": (-33.5, -70.6), "EPSG:3006": (59, 15), "EPSG:2056": (47, 8)}
    latitude, longitude = near.get(code, {"EPSG:27700": (52, -1), "EPSG:6420": (37.5, -121)}.get(code, (48.1, 15.2)))
    x, y, _ = pyproj.Transformer.from_crs("EPSG:4979", crs, always_xy=True).transform(longitude, latitude, 500)
    words = crs.to_wkt(pretty=True) if words == "PRETTY" else words
    (tmp_path / "geo.txt").write_text(f"{words}\na.jpg {x} {y} 500\nb.jpg {x + 30} {y} 500\n")
    (first, _) = read_gps_table(tmp_path / "geo.txt").rows
    assert first.position[:2] == pytest.approx((latitude, longitude), abs=1e-7)


@pytest.mark.parametrize("words", ["RD New", "NAD83(2011) (ftUS)", "UTM 33", "WGS84 UTM Zone 33", "Lambert 93"])
def test_words_that_name_no_one_system_ask_for_a_code(tmp_path, words):
    (tmp_path / "geo.txt").write_text(f"{words}\na.jpg 500000 5300000 500\nb.jpg 500030 5300000 500\n")
    with pytest.raises(CaptureError, match="EPSG:32"):
        read_gps_table(tmp_path / "geo.txt")


@pytest.mark.parametrize(
    ("system", "x", "y", "error_m", "said"),
    [
        ("EPSG:31467", 3500000, 5400000, 3, "converted from DHDN to WGS 84, good to 3 m"),
        ("EPSG:27700", 450000, 250000, 2, "good to 2 m"),
        ("EPSG:2434", 500000, 3400000, 50, "from Beijing 1954 to WGS 84 by a shift that is made for China"),
        ("EPSG:2327", 13500000, 4400000, 300, "are taken as of WGS 84, for PROJ knows no shift from Xian 1980"),
        ("+proj=utm +zone=33 +ellps=bessel", 500000, 5400000, 300, "no datum: taken as WGS 84"),
        ("+proj=utm +zone=33 +ellps=bessel +towgs84=598,73,418", 500000, 5400000, 0, ""),
        ("EPSG:25832", 500000, 5400000, 0, ""),
        ("EPSG:6344", 500000, 4400000, 0, ""),
        ("EPSG:4513", 38500000, 3400000, 0, ""),  # CGCS2000
        ("EPSG:32632", 500000, 5400000, 0, ""),
    ],
)
def test_what_a_national_datum_costs_is_stated(tmp_path, system, x, y, error_m, said):
    (tmp_path / "geo.txt").write_text(f"{system}\na.jpg {x} {y} 500\nb.jpg {x + 30} {y} 500\n")
    table = read_gps_table(tmp_path / "geo.txt")
    assert table.datum_error_m == pytest.approx(error_m, abs=1)
    assert any(said in note for note in table.notes) if said else not any("datum" in each for each in table.notes)
    assert sum("WGS 84" in note for note in table.notes) == bool(said)


def test_a_table_of_several_systems_is_refused_and_blank_cells_are_none(tmp_path):
    rows = ["a.jpg,500000,5700000,100,{}", "b.jpg,500100,5700000,101,EPSG:32633", "c.jpg,500100,5700100,101,EPSG:32633"]
    text = "\n".join(["Name,Easting,Northing,Elevation,CS name", *rows])
    (tmp_path / "t.csv").write_text(text.format(""))
    assert read_gps_table(tmp_path / "t.csv").rows[0].position[1] == pytest.approx(15.0, abs=0.01)
    (tmp_path / "t.csv").write_text(text.format("EPSG:32632"))
    with pytest.raises(CaptureError, match="several coordinate systems"):
        read_gps_table(tmp_path / "t.csv")


@pytest.mark.parametrize(
    ("code", "x", "y", "place"),
    [
        ("EPSG:32661", 2572730, 426438, (75, 20)), ("EPSG:32761", 2572730, 3573562, (-75, 20)),
        ("EPSG:31467", 3500000, 5500000, (49.64, 9.0)), ("EPSG:3413", 100000, -2000000, (71.67, -42.14)),
    ],
)  # fmt: skip
def test_east_comes_first_in_systems_of_all_axes(tmp_path, code, x, y, place):
    assert to_geodetic(code, tmp_path)[0](np.array([[x, y, 5.0]]))[0, :2] == pytest.approx(place, abs=0.01)


@pytest.mark.parametrize("axes", ["", ',AXIS["Lat",NORTH],AXIS["Lon",EAST]', ',AXIS["Lon",EAST],AXIS["Lat",NORTH]'])
@pytest.mark.parametrize("heights", [False, True])
@pytest.mark.parametrize("shift", ["", "TOWGS84[0,0,0,0,0,0,0],"])
def test_longitude_stays_longitude_however_a_system_is_written(tmp_path, axes, heights, shift):
    pytest.importorskip("pyproj")
    wkt = f'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563],{shift}'
    wkt += f'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]{axes}]'
    if heights:
        wkt = f'COMPD_CS["both",{wkt},VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005],UNIT["metre",1]]]'
    change, _ = to_geodetic(wkt, tmp_path)
    assert change(np.array([[-70.6, -33.5, 500]]))[0, :2] == pytest.approx((-33.5, -70.6))
    assert datum_error(wkt, np.array([[-33.5, -70.6, 500]])) == (0.0, "")


@pytest.mark.parametrize("datum", ["My datum", "Deutsches_Hauptdreiecksnetz"])
@pytest.mark.parametrize("values", ["598.1,73.7,418.2,0.202,0.045,-2.455,6.7", "598.1,73.7,418.2"])
def test_the_shift_that_a_system_gives_itself_counts_for_earth_centred_metres_too(tmp_path, datum, values):
    """As for the latitude and longitude of the same place, whether PROJ knows the datum or not."""
    wkt = f'GEOGCS["Mine",DATUM["{datum}",SPHEROID["Bessel 1841",6377397.155,299.1528128],TOWGS84[{values}]],'
    wkt += 'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328]]'
    flat, _ = to_geodetic(wkt, tmp_path)
    pyproj = pytest.importorskip("pyproj")
    to_metres = pyproj.Transformer.from_crs(
        "+proj=longlat +ellps=bessel", "+proj=geocent +ellps=bessel", always_xy=True
    )
    places = np.array(to_metres.transform([11.5], [48.1], [0.0])).T
    found = geocentric_to_geodetic(wkt, tmp_path)(places)
    assert found[0, :2] == pytest.approx(flat(np.array([[11.5, 48.1, 0.0]]))[0, :2], abs=1e-8)
    both = f'COMPD_CS["both",{wkt},VERT_CS["h",VERT_DATUM["E",2002],UNIT["metre",1]]]'
    assert geocentric_to_geodetic(both, tmp_path)(places) == pytest.approx(found)


def test_false_origins_are_those_of_the_systems():
    pytest.importorskip("pyproj")
    codes = {"EPSG:32719": (5e5, 1e7), "EPSG:6677": (0, 0), "EPSG:2056": (2.6e6, 1.2e6), "EPSG:2154": (7e5, 6.6e6)}
    assert {code: false_origin(code) for code in (*codes, "EPSG:4326")} == codes | {"EPSG:4326": (0, 0)}
    assert false_origin("EPSG:25832+7837") == (5e5, 0)


def test_names_of_files_are_not_looked_up_among_systems(monkeypatch):
    asked = []
    monkeypatch.setattr("vdgs.captures.system_names._is_name", lambda words: bool(asked.append(words)))
    assert not any(names_a_system(line) for line in ("test_0001.jpg", "east/DJI_0001.JPG", "IMG_1.tiff"))
    assert not asked
    names_a_system("NAD83(2011) / Conus Albers")
    assert not names_a_system("Conus Albers")
    assert asked == ["Conus Albers"]


@pytest.mark.parametrize("name", ["site1_UTM33_0001.JPG", "UTM_0001.JPG", "SRID0001.JPG", "EPSG12_1.jpg"])
def test_names_of_photographs_are_no_systems(tmp_path, name):
    (tmp_path / "t.csv").write_text(f"{name},48.1,15.2,500\nb.jpg,48.2,15.2,500\n")
    assert read_gps_table(tmp_path / "t.csv").rows[0].name == name


def test_a_column_of_zones_is_no_system(tmp_path):
    (tmp_path / "t.csv").write_text("UTM_Zone,name,lat,lon,alt\n33,a.jpg,48.1,15.2,500\n33,b.jpg,48.2,15.2,500\n")
    assert read_gps_table(tmp_path / "t.csv").rows[0].position[:2] == pytest.approx((48.1, 15.2))


def test_a_datum_over_degrees_counts(tmp_path):
    rows = "name,{}\na.jpg,{},500\nb.jpg,{},500\n"
    (tmp_path / "t.csv").write_text("EPSG:4230\n" + rows.format("lat,lon,alt", "48.1,15.2", "48.2,15.2"))
    (tmp_path / "x.csv").write_text("EPSG:4230\n" + rows.format("x,y,z", "15.2,48.1", "15.2,48.2"))
    degrees, plane = read_gps_table(tmp_path / "t.csv"), read_gps_table(tmp_path / "x.csv")
    assert degrees.rows[0].position[:2] == pytest.approx(plane.rows[0].position[:2], abs=1e-9)
    assert abs(degrees.rows[0].position[0] - 48.1) > 1e-4
    assert degrees.datum_error_m == plane.datum_error_m > 0


@pytest.mark.parametrize("head", ["EPSG:5650+7837\nname,x,y,alt", "EPSG:4230\nname,lon,lat,alt"])
def test_a_system_is_read_as_often_for_many_rows_as_for_few(tmp_path, monkeypatch, head):
    """PROJ takes tens of milliseconds for one, and flights have thousands of photographs."""
    pyproj = pytest.importorskip("pyproj")
    parsed, parse = list[str](), pyproj.CRS.from_user_input
    monkeypatch.setattr(
        pyproj.CRS, "from_user_input", lambda *system: (parsed.append(str(system[0])), parse(*system))[1]
    )
    x, y = (33_500_000, 5_600_000) if "x,y" in head else (15, 48)
    counts = []
    for count in (3, 3, 30):  # the first also finds what is kept for the others
        rows = [f"{k}.jpg,{x + k * 1e-3},{y},500" for k in range(count)]
        (tmp_path / f"{count}.csv").write_text("\n".join([head, *rows]))
        parsed.clear()
        assert len(read_gps_table(tmp_path / f"{count}.csv").rows) == count
        counts.append(len(parsed))
    assert 0 < counts[2] < counts[1] + 9  # not by the row
