"""Tables whose latitudes and longitudes, or x and y, are of a system that they name."""

from __future__ import annotations

import numpy as np
import pytest

from vdgs.captures.gps_tables import read_gps_table
from vdgs.captures.tables_beside import position_tables
from vdgs.errors import CaptureError

pytest.importorskip("pyproj")

DHDN_WITH_HEIGHTS = (
    '# CoordinateSystem: COMPD_CS["DHDN + heights",GEOGCS["DHDN",DATUM["D",SPHEROID["Bessel 1841",6377397.155,'
    '299.1528128],TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]],PRIMEM["Greenwich",0],UNIT["degree",'
    '0.0174532925199433]],VERT_CS["heights",VERT_DATUM["h",2005],UNIT["metre",1]]]'
)


def positions(tmp_path, text):
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    return np.array([row.position for row in read_gps_table(tmp_path / "t.csv").rows])


@pytest.mark.parametrize("system", ["EPSG:4314", "EPSG:4277", DHDN_WITH_HEIGHTS])
def test_a_missing_altitude_leaves_the_place_of_another_datum(tmp_path, system):
    text = f"{system}\nname,lat,lon,alt\na.jpg,51.1,1.5,500\nb.jpg,51.1,1.501,{{}}\nc.jpg,51.101,1.501,510\n"
    whole, part = (positions(tmp_path, text.format(altitude)) for altitude in ("505", ""))
    np.testing.assert_allclose(part[:, :2], whole[:, :2], atol=1e-7)
    assert np.abs(part[:, :2] - [[51.1, 1.5], [51.1, 1.501], [51.101, 1.501]]).max() > 1e-4
    assert np.isnan(part[1, 2])
    (beside,) = position_tables([tmp_path], ["a.jpg", "b.jpg", "c.jpg"])
    assert beside.photographs == 3


def test_earth_centred_coordinates_need_all_three(tmp_path):
    text = "EPSG:4978\nname,x,y,z\na.jpg,4300000,650000,4650000\nb.jpg,4300010,650000,\n"
    with pytest.raises(CaptureError, match="line 4: has no z"):
        positions(tmp_path, text)


@pytest.mark.parametrize(
    ("first_line", "names", "more"),
    [
        pytest.param("EPSG:4258\n", "Easting,Northing", "465000.1,5217000.2", id="and in a projected system"),
        pytest.param("EPSG:4258\n", "E,N", "0.0012,0.0021", id="and what an adjustment left"),
        pytest.param("", "epsg,x", "25832,7", id="a projected system in a column"),
    ],
)
def test_latitude_and_longitude_count_before_x_and_y_beside_them(tmp_path, first_line, names, more):
    text = f"{first_line}name,lat,lon,alt,{names}\na.jpg,47.1,8.5,500,{more}\nb.jpg,47.1,8.501,501,{more}\n"
    np.testing.assert_allclose(positions(tmp_path, text), [[47.1, 8.5, 500], [47.1, 8.501, 501]], atol=1e-6)


def test_a_column_names_the_datum_of_latitudes_and_longitudes(tmp_path):
    text = "name,lat,lon,alt,epsg\na.jpg,51.6,-1.5,100,4277\nb.jpg,51.6,-1.501,100,{}\n"
    assert positions(tmp_path, text.format(4277))[0, 0] == pytest.approx(51.60048, abs=1e-5)
    with pytest.raises(CaptureError, match="several coordinate systems"):
        positions(tmp_path, text.format(4326))


def test_codes_of_spreadsheets_are_read(tmp_path):
    rows = "name,easting,northing,alt,epsg\na.jpg,465000,5217000,500,{}\n"
    whole, real = (positions(tmp_path, rows.format(code)) for code in ("25832", "25832.0"))
    np.testing.assert_array_equal(whole, real)


def test_the_headings_of_odm_are_known(tmp_path):
    text = "EPSG:32632\nimage_name geo_x geo_y geo_z\na.jpg 500000 5200000 400\n"
    assert positions(tmp_path, text)[0] == pytest.approx([46.953529, 9.0, 400], abs=1e-5)
