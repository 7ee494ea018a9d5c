"""Tables of positions as other programs write them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.flights import small_photographs
from vdgs.captures.georeference import match_rows
from vdgs.captures.gps_tables import read_gps_table
from vdgs.errors import CaptureError
from vdgs.sfm.gps_priors import read_gps_priors

PLACE = (-33.5, -70.6, 500.0)
EASTING, NORTHING = 351375.7913, 6292135.2282  # of zone 19 south

TABLES = {
    "upper case": "Name,Lat,Lon,Alt\na.jpg,-33.5,-70.6,500\n",
    "blanks": "name, lat, lon, alt\na.jpg, -33.5, -70.6, 500\n",
    "semicolons": "name;lat;lon;alt\na.jpg;-33.5;-70.6;500\n",
    "decimal commas": "name;lat;lon;alt\na.jpg;-33,5;-70,6;500,0\n",
    "tabs": "name\tlatitude\tlongitude\taltitude\na.jpg\t-33.5\t-70.6\t500\n",
    "blanks and decimal commas": "name lat lon alt\na.jpg -33,5 -70,6 500,0\n",
    "blanks and decimal commas, utm": f"EPSG:32719\na.jpg {EASTING} {NORTHING} 500,0\n".replace(".7", ",7"),
    "blanks and decimal commas, no names": "a.jpg -33,5 -70,6 500,0 5,0 10,0\n",
    "columns of blanks": "name   lat     lon   alt\na.jpg  -33.5  -70.6  500\n",
    "another order": "alt,lon,lat,File Name\n500,-70.6,-33.5,a.jpg\n",
    "odm": "EPSG:4326\na.jpg -70.6 -33.5 500\n",
    "odm, words": "WGS84\na.jpg -70.6 -33.5 500 10 20 30 0.5 1\n",
    "odm, proj": "+proj=longlat +datum=WGS84\na.jpg\t-70.6\t-33.5\t500\n",
    "odm, utm": f"WGS84 UTM 19S\na.jpg {EASTING} {NORTHING} 500\n",
    "utm with names": f"EPSG:32719\nLabel,Easting,Northing,Elevation\na.jpg,{EASTING},{NORTHING},500\n",
    "utm in a column": f"image,epsg,x,y,z\na.jpg,32719,{EASTING},{NORTHING},500\n",
    "exiftool": 'SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n./a.jpg,-33.5,-70.6,500\n',
    "exiftool, words": "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n"
    "./a.jpg,\"33 deg 30' 0.00\"\" S\",\"70 deg 36' 0.00\"\" W\",500 m Above Sea Level\n",
    "references": "file,latitude,GPSLatitudeRef,longitude,GPSLongitudeRef,altitude\na.jpg,33.5,South,70.6,W,500\n",
    "references in Chinese": "file,latitude,latitude ref,longitude,longitude ref,alt\na.jpg,33.5,南纬,70.6,西经,500\n",
    "metashape": "# Cameras (1)\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Error_(m)\na.jpg,-70.6,-33.5,500,\n# end\n",
    "metashape, system": '# CoordinateSystem: GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]]\n'
    "#Label,X/Longitude,Y/Latitude,Z/Altitude\na,-70.6,-33.5,500\n",
    "pix4d": "imagename,latitude [decimal degrees],longitude [decimal degrees],altitude [meter],accuracy horizontal "
    "[meter],accuracy vertical [meter]\na.jpg,-33.5,-70.6,500,5,10\n",
    "pix4d without names": "a.jpg,-33.5,-70.6,500,5,10\n",
    "longitude first": "a.jpg,-120.6,-33.5,500\n",
    "quotes": '"name","lat","lon","alt"\n"a.jpg","-33.5","-70.6","500"\n',
    "windows": "name,lat,lon,alt\r\n\r\na.jpg,-33.5,-70.6,500\r\n",
    "comments": "# by hand\nname,lat,lon,alt\n# the first\na.jpg,-33.5,-70.6,500\n",
    "mission planner": "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\na.jpg -33.5 -70.6 500 1 2 3 10\n",
    "header of blanks behind a sign": "# photo latitude longitude ellh\na.jpg -33.5 -70.6 500\n",
    "propeller": "image_name,lat_dd,lon_dd,ellipsoidal_height_m\na.jpg,-33.5,-70.6,500\n",
    "bentley": "Photo Name;Longitude;Latitude;Height\na.jpg;-70.6;-33.5;500\n",
    "feet": "name,lat,lon,Altitude (ft)\na.jpg,-33.5,-70.6,1640.41995\n",
    "survey feet": "name,lat,lon,alt [us survey ft]\na.jpg,-33.5,-70.6,1640.416667\n",
    "feet in rows": "name,lat,lon,alt_ft\na.jpg,-33.5,-70.6,1640.41995 ft\n",
    "pix4d, external": "imageName longitude latitude altitude omega phi kappa\na.jpg -70.6 -33.5 500 0.1 0.2 0.3\n",
    "excel": "sep=;\nname;lat;lon;alt\na.jpg;-33.5;-70.6;500\n",
    "rows without a position": "SourceFile\tGPSLatitude\tGPSLongitude\tGPSAltitude\nb.jpg\t-\t-\t-\n"
    "c.jpg\tNaN\tnan\tnan\na.jpg\t-33.5\t-70.6\t500\n",
    "over the sea": "name,lat,lon,alt\na.jpg,-33.5,-70.6,500 m AMSL\n",
    "heights over the ground": "name,lat,lon,height,altitude\na.jpg,-33.5,-70.6,50,500\n",
    "alturas": "Nombre,Latitud,Longitud,Altura,Altitud\na.jpg,-33.5,-70.6,50,500\n",
    "german": "Dateiname;Breitengrad;Längengrad (°);Höhe [m]\na.jpg;-33,5;-70,6;500,0\n",
    "spanish": "Nombre,Latitud,Longitud,Altitud\na.jpg,-33.5,-70.6,500\n",
    "chinese": "照片名称,纬度（°）,经度（°）,高度（m）,海拔（m）\na.jpg,-33.5,-70.6,50,500\n",
    "emlid": "Image name,Latitude,Longitude,Ellipsoidal height,RMS easting,RMS northing,RMS elevation\n"
    "a.jpg,-33.5,-70.6,500,0.5,0.3,1\n",
    "centimetres": "name,lat,lon,alt (cm),RMS easting (cm),RMS northing (mm),RMS elevation [m]\n"
    "a.jpg,-33.5,-70.6,50000,50,300,1\n",
    "moments without a fix": "1\t2.1\t[2]\t 0,N\t 0,E\t 0,V\t0.0,Lat\t0.0,Lon\t0.0,Ellh\t0, 0, 0\t0,Q\n"
    "1\t280.1\t[2145]\t 12,N\t 34,E\t -20,V\t-33.5,Lat\t-70.6,Lon\t500,Ellh\t0.01, 0.02, 0.03\t50,Q\n2\t280.2\n",
    "dji moments": "1\t280234.1\t[2145]\t  12,N\t 34,E\t -20,V\t-33.5,Lat\t-70.6,Lon\t500,Ellh\t"
    "0.01, 0.02, 0.03\t50,Q\n",
}  # fmt: skip


@pytest.mark.parametrize("text", TABLES.values(), ids=TABLES)
def test_tables_are_read_as_programs_write_them(tmp_path, text):
    if "UTM" in text or "EPSG" in text or "epsg" in text or "+proj" in text:
        pytest.importorskip("pyproj")
    file = tmp_path / "table.txt"
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        file.write_bytes(text.encode(encoding))
        (row,) = read_gps_table(file).rows
        expected = (PLACE[0], -120.6, 500.0) if "-120.6" in text else PLACE
        assert row.position == pytest.approx(expected, abs=2e-6)
        assert row.name.endswith(("a.jpg", "a", "1"))
        assert row.gps_std == ((0.5, 1.0) if "0.5 1\n" in text or "RMS" in text else row.gps_std)


def test_points_in_wkt_are_positions(tmp_path):
    """QGIS writes geometries so with GEOMETRY=AS_WKT."""
    for k, point in enumerate(("POINT (8.5 47.1)", "Point Z(8.5 47.1 3)", "SRID=4326;POINT(8.5 47.1)")):
        file = tmp_path / f"{k}.csv"
        rows = [f'"{point.replace("8.5", f"8.50{n}")}",DJI_{n}.JPG,500' for n in range(3)]
        file.write_text("\n".join(["WKT,photo,altitude", *rows]))
        rows = read_gps_table(file).rows
        assert [row.name for row in rows] == ["DJI_0.JPG", "DJI_1.JPG", "DJI_2.JPG"]
        assert rows[1].position == (47.1, 8.501, 500.0)


@pytest.mark.parametrize(
    ("heading", "point", "rest", "altitude"),
    [
        ("name,geom", "POINT Z (8.5 47.1 512)", "", 512), ("name,geom", "POINT (8.5 47.1 512)", "", 512),
        ("name,geom", "POINTZM(8.5 47.1 512 7)", "", 512), ("name,geom", "POINT M (8.5 47.1 7)", "", None),
        ("name,geom,alt", "POINT Z (8.5 47.1 0)", ",512", 512), ("name,geom", "POINT (8.5 47.1)", "", None),
    ],
)  # fmt: skip
def test_the_third_number_of_a_point_is_an_altitude_where_there_is_no_other(tmp_path, heading, point, rest, altitude):
    rows = [f'{k}.jpg,"{point.replace("8.5", f"8.50{k}")}"{rest}' for k in range(3)]
    (file := tmp_path / "t.csv").write_text("\n".join([heading, *rows]))
    read = read_gps_table(file).rows[0].position
    assert read == pytest.approx((47.1, 8.5, np.nan if altitude is None else altitude), nan_ok=True)


@pytest.mark.parametrize(("east", "north"), [("0.5", ""), ("", "0.5"), ("-", "0.5")])
def test_an_accuracy_without_its_other_side_or_in_degrees_is_not_believed(tmp_path, east, north):
    for unit, sides in (("m", (east, north)), ("°", ("0.5", "0.5"))):
        names = f"name,lat,lon,alt,RMS easting ({unit}),RMS northing ({unit}),RMS elevation (m)"
        (file := tmp_path / "table.csv").write_text(f"{names}\na.jpg,-33.5,-70.6,500,{','.join(sides)},1\n")
        assert read_gps_table(file).rows[0].gps_std is None


def test_columns_of_heights_are_named_in_tables_of_any_system(tmp_path):
    file = tmp_path / "table.csv"
    for columns in ("lat,lon,height,altitude", "x,y,height,altitude"):
        file.write_text(f"EPSG:4326\nname,{columns}\na.jpg,-33.5,-70.6,50,500\n"[10 * columns.startswith("lat") :])
        if columns.startswith("x"):
            pytest.importorskip("pyproj")
        assert "'altitude', not of 'height'" in "".join(read_gps_table(file).notes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("name,lat,lon,alt\n", "holds no rows"),
        ("a,b,c\n1,x,3\n", r"names the columns name,lat,lon,alt \(found: a, b, c\)"),
        ("name,x,y,z\na.jpg,351400,6292300,5\n", "'x' and 'y' but does not say of which coordinate system"),
        ("a.jpg,351400,6292300,5\n", "names neither its columns nor the coordinate system"),
        ("name,lat,lon,alt\na.jpg,1,2,high\n", "line 2: the altitude 'high' is not a number"),
        ("name,lat,lon,alt\na.jpg,one,2,3\n", "line 2: .* are not numbers"),
        ("name,lat,lon,alt\na.jpg,-70.6,233.5,1e9\n", "line 2: .* no place on Earth"),
        ("name,lat,lon,alt\na.jpg,-97.6,33.5,10\n", "line 2: .* no place on Earth"),
        (
            "name,lat_deg,lat_min,lat_sec,lon_deg,lon_min,lon_sec\na.jpg,-33,30,1.5,-70,36,2\n",
            "columns .*'lat_min', 'lat_",
        ),
        ("name;Latitude (°);Latitude (min);Lon;Longitude (min)\na.jpg;-33;30;-70;36\n", "minutes and seconds in col"),
        ("name,lat_d,lat_m,lat_s,lon_d,lon_m,lon_s\na.jpg,-33,30,1.5,-70,36,2\n", "minutes and seconds in columns"),
        ("EPSG:32719\na.jpg 1e12 1e12 5\n", "line 2: .* is no place in"),
        ("\0\1\2\3\0\0\0\0", "is not a text file.*save a spreadsheet as CSV"),
        ("EPSG:4326\n-70.6 -33.5 500 100 200 a.jpg P1\n", "control points is given as --gcp"),
        ("time,latitude,longitude,altitude\n1,-33.5,-70.6,5\n", "no column of photographs' names.*exiftool -geotag"),
        ("ID,Lat,Lon\n7,-33.5,-70.6\n", r"photographs' names \(found: ID, Lat, Lon\)\. Call the column .* `name`"),
        ("Image ID,Lat,Lon\n7,-33.5,-70.6\n", r"photographs' names \(found: Image ID, Lat, Lon\)\. Call the column"),
        ('<?xml version="1.0"?>\n<gpx><trkpt lat="1" lon="2"/></gpx>', "is a track.*exiftool -geotag"),
        ("<?xml version='1.0'?><kml><coordinates>-70.6,-33.5,500</coordinates></kml>", "is a track"),
        ("<?xml version='1.0'?><gpx>" + "<trkpt/>" * 20_000 + "</gpx>", "is a track"),
        ("name;lat;lon\n" + "a" * 200_000 + ";1;x\n", "line 2: .* are not numbers"),
        ("$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n", "is a track"),
        ("% program : RTKLIB\n%  GPST latitude(deg) longitude(deg) height(m)\n2023/05/01 10:00:00 1 2 3", "of RTKLIB"),
        ('<?xml version="1.0"?>\n<document version="1.2.0"><camera label="a"/></document>', "Metashape's XML"),
        ('<?xml version="1.0"?><BlocksExchange version="2.1"/>', "BlocksExchange"),
        ('[{\n"SourceFile": "a.jpg"}]', "is JSON"),
        ('{"type":"FeatureCollection","features":[]}', "is JSON"),
    ],
)
def test_tables_that_are_none_are_refused_with_the_line(tmp_path, text, said):
    file = tmp_path / "table.csv"
    file.write_text(text)
    with pytest.raises(CaptureError, match=said):
        read_gps_table(file)


@pytest.mark.parametrize("number", ["", "ID,7", "No,7", "fid,7"])
@pytest.mark.parametrize(
    ("column", "name"),
    [
        ("Image ID", "a"), ("PhotoID", "DJI_0001"), ("photo_filename", "a"), ("Source image", "a"), ("Foto", "0001"),
        ("影像名称", "a"), ("Beauty shot", "a.JPG"), ("what", r"D:\card\a.dng"),
    ],
)  # fmt: skip
def test_columns_of_names_are_known_by_heading_or_by_what_they_hold(tmp_path, number, column, name):
    """Numbers of rows are no names, whatever they are called."""
    heading, _, value = number.partition(",")
    rows = f"{heading},{column},Lat,Lon\n{value},{name},-33.5,-70.6\n"
    (file := tmp_path / "table.csv").write_text(rows)
    (row,) = read_gps_table(file).rows
    assert (row.name, row.position[:2]) == (name, PLACE[:2])


def test_of_several_columns_of_names_that_of_pictures_counts(tmp_path):
    file = tmp_path / "t.csv"
    for label, name in (("1", "a.jpg"), ("a", "a.jpg"), ("a.jpg", "a.jpg"), ("a", "")):
        file.write_text(f"Label,Filename,lat,lon,alt\n{label},{name},-33.5,-70.6,500\n")
        assert read_gps_table(file).rows[0].name == (name or label)


@pytest.mark.parametrize("said", ["undef", "inf", "-"])
def test_what_programs_write_of_altitudes_that_they_do_not_know_is_none(tmp_path, said):
    (file := tmp_path / "t.csv").write_text(f"name,lat,lon,alt\na.jpg,-33.5,-70.6,{said}\n")
    assert np.isnan(read_gps_table(file).rows[0].position[2])


def test_a_row_without_a_number_hides_nothing_of_the_others(tmp_path):
    """Longitude first is told by what is more than 90."""
    (file := tmp_path / "t.csv").write_text("a.jpg 149.1 -35.1 500\nb.jpg - - -\nc.jpg 149.101 -35.1 500\n")
    assert [row.position for row in read_gps_table(file).rows] == [(-35.1, 149.1, 500), (-35.1, 149.101, 500)]


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("照片名称,纬度,经度,高度\n张a.jpg,-33.5,-70.6,500\n", "gb18030"),
        ("照片名称,lat,lon,alt\n张a.jpg,-33.5,-70.6,500\n", "gbk"),
        ("Dateiname;Breitengrad;Längengrad;Höhe\nüa.jpg;-33,5;-70,6;500\n", "cp1252"),
        ("Dateiname;Breite;Laenge;Hoehe\nüa.jpg;-33,5;-70,6;500\n", "cp1252"),
        ("name,lat,lat_s,lon,lon_s,alt\nüa.jpg,-33.5,0.01,-70.6,0.02,500\n", "cp1252"),
        ("name,lat,lon,alt\nüöa.jpg,-33.5,-70.6,500\n", "cp1252"),
    ],
)
def test_tables_of_spreadsheets_that_write_no_unicode_are_read(tmp_path, text, encoding):
    (file := tmp_path / "table.csv").write_bytes(text.encode(encoding))
    (row,) = read_gps_table(file).rows
    assert (row.name[-5:], row.position) == ("a.jpg", PLACE)
    assert row.name in text


NAMES = [f"{k}.jpg" for k in range(4)]


def test_rows_of_photographs_that_are_gone_are_left_out_and_said(tmp_path):
    seen = small_photographs(tmp_path, [f"{k}.jpg" for k in range(4)])
    file = tmp_path / "gps.csv"
    rows = [f"{k}.jpg,-33.5{k},-70.6,500,0.5,1.5\n" for k in range(7)]
    file.write_text("name,lat,lon,alt,accuracy_horizontal,accuracy_vertical\n" + "".join(rows) + "9.jpg,,,\n")
    found = read_gps_priors(seen, file, (1.0, 2.0))
    assert found.gps_std[0] == pytest.approx([0.5, 0.5, 1.5])
    assert any("3 rows are of photographs that are not there; left out (4.jpg, 5.jpg, 6.jpg)" in n for n in found.notes)
    assert any("1 of 8 rows have no position" in note for note in found.notes)
    assert found.are_stated.tolist() == [True] * 4


def test_rows_that_are_there_twice_are_of_photographs_that_are_there(tmp_path):
    seen = small_photographs(tmp_path, NAMES)
    rows = "".join(f"{name},-33.5{k},-70.6,500\n" for k, name in enumerate(NAMES))
    (file := tmp_path / "gps.csv").write_text(f"name,lat,lon,alt\n{rows}{rows}")
    found = read_gps_priors(seen, file, (1.0, 2.0))
    assert not found.are_stated.any()
    assert len(found) == len(NAMES)
    assert not any("not there" in note for note in found.notes)


@pytest.mark.parametrize(
    ("north_m", "accuracy", "said"),
    [(3, "", ""), (100, "", "lie 100 m from those in the photographs"), (60, "", "lie 60 m"), (60, "80", "")],
)
def test_a_table_beside_the_positions_of_the_photographs_says_how_far(tmp_path, north_m, accuracy, said):
    taken = small_photographs(tmp_path, NAMES)
    seen = [replace(photo, lat_lon=(-33.5 - k / 1000, -70.6)) for k, photo in enumerate(taken)]
    rows = [f"{k}.jpg,{-33.5 - k / 1000 + north_m / 110_910:.9f},-70.6,500,{accuracy},{accuracy}\n" for k in range(4)]
    (file := tmp_path / "gps.csv").write_text("name,lat,lon,alt,hacc,vacc\n" + "".join(rows))
    notes = " ".join(read_gps_priors(seen, file, (1.0, 2.0)).notes)
    assert ("from those in the photographs" in notes) is bool(said)
    assert said in notes


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("{1},{0}", "exchanged"),
        ("{2},{1}", "south is north"),
        ("{0},{3}", "west is east"),
        ("{2},{3}", "south and west"),
    ],
)
def test_a_table_that_contradicts_the_photographs_is_refused_with_what_is_exchanged(tmp_path, row, said):
    file = tmp_path / "gps.csv"
    taken = small_photographs(tmp_path, NAMES)
    seen = [replace(photo, lat_lon=(-33.5 - k / 1000, -70.6)) for k, photo in enumerate(taken)]
    for written, refused in (("{0},{1}", False), (row, True)):
        lines = [written.format(-33.5 - k / 1000, -70.6, 33.5 + k / 1000, 70.6) for k in range(4)]
        file.write_text("name,lat,lon,alt\n" + "".join(f"{k}.jpg,{line},500\n" for k, line in enumerate(lines)))
        if refused:
            with pytest.raises(CaptureError, match=said):
                read_gps_priors(seen, file, (1.0, 2.0))
        else:
            assert len(read_gps_priors(seen, file, (1.0, 2.0))) == 4


def test_a_flight_across_the_antimeridian_holds_together(tmp_path):
    seen = small_photographs(tmp_path, NAMES)
    places = [(-17 - k / 10000, (179.9999 + k / 15000 + 180) % 360 - 180) for k in range(4)]
    (tmp_path / "gps.csv").write_text(
        "name,lat,lon,alt\n" + "".join(f"{k}.jpg,{lat},{lon % 360},5\n" for k, (lat, lon) in enumerate(places))
    )
    tagged = [replace(photo, lat_lon=place, altitude=5.0) for photo, place in zip(seen, places, strict=True)]
    for found in (read_gps_priors(tagged, None, (1, 2)), read_gps_priors(tagged, tmp_path / "gps.csv", (1, 2))):
        assert len(found) == 4
        assert np.ptp(found.enu, axis=0) == pytest.approx([21.3, 33.2, 0], abs=0.2)
        assert (np.diff(found.enu[:, 0]) > 0).all()
        assert abs(found.origin[1]) == pytest.approx(180, abs=1e-4)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("name,Lat(deg),Long(deg),EllHgt(m)", "-33.5,-70.6,500"),
        ("name,lat,lon,agl,alt_msl", "-33.5,-70.6,60,500"),
        ("name,lat (rad),lon (rad),Orthometric elevation", "-0.5846852994181004,-1.2322024519637,500"),
        ("name,lat,lon,alt", "33.30.00.000S,70.36.00W,500"),
        ("name,lat,lon,alt", "3330.0000 S,07036.0000 W,500"),
        ("name,lat,lat ref,lon,lon ref,alt", "3330.0000,S,07036.0000,W,500"),
        ("name,lat (rad),lon (deg),alt", '-0.5846852994181004,-70.6,"0,000,500.0"'),
        ("OBJECTID,Name,POINT_X,POINT_Y,POINT_Z", None),  # degrees without a system: a.jpg and others of one place
    ],
)
def test_more_names_and_angles_are_read(tmp_path, names, words):
    file = tmp_path / "table.csv"
    rows = [f"a.jpg,{words}"] if words else [f"{k},{'abc'[k]}.jpg,{-70.6 + k / 1e4},-33.5,500" for k in range(3)]
    file.write_text("\n".join([names, *rows]))
    table = read_gps_table(file)
    assert table.rows[0].position == pytest.approx((-33.5, -70.6, 500), abs=1e-7)
    assert ("look like longitude and latitude" in "".join(table.notes)) is (words is None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,lat,lon,alt\na.jpg,-335000811,-706001452,5", "degrees times 10,000,000"),
        ("name,lat,lon,alt\na.jpg,-3330.004868,-7036.008716,5", "ddmm.mmmm"),
        ("name,lat,lon,alt\na.jpg,33.30.00.1.2,70.3.2,5", "are not numbers"),
    ],
)
def test_angles_that_are_no_degrees_are_told(tmp_path, text, message):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(CaptureError, match=message):
        read_gps_table(tmp_path / "table.csv")


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("5130.6,N,00030.6,W", (51.51, -0.51)),
        ("5130.6,N,30.6,W", (51.51, -0.51)),  # as spreadsheets save it
        ("0030.6,S,00006.0,E", (-0.51, 0.1)),
        ("51.51,N,30.6,W", (51.51, -30.6)),
    ],
)
def test_minutes_of_places_at_greenwich_and_the_equator_are_no_degrees(tmp_path, words, place):
    (tmp_path / "t.csv").write_text(f"name,lat,lat ref,lon,lon ref\na.jpg,{words}\n")
    assert read_gps_table(tmp_path / "t.csv").rows[0].position[:2] == pytest.approx(place)


@pytest.mark.parametrize(("x", "y"), [('"351,362.43"', '"6,292,126.02"'), ("351.362,43", "6.292.126,02")])
def test_signs_between_thousands_are_read_where_they_are_clear(tmp_path, x, y):
    sign = "," if x.startswith('"') else ";"
    for end in ("", " # survey of May"):
        (tmp_path / "t.csv").write_text(
            f"EPSG:32719{end}\n" + sign.join(["name", "x", "y"]) + f"\na.jpg{sign}{x}{sign}{y}"
        )
        plain = tmp_path / "plain.csv"
        plain.write_text("EPSG:32719\nname,x,y\na.jpg,351362.43,6292126.02")
        assert read_gps_table(tmp_path / "t.csv").rows[0].position[:2] == read_gps_table(plain).rows[0].position[:2]


DEGREES = "name;lat;lon;alt\na.jpg;{};{};{}\n"
UTM = "EPSG:32632\nname;x;y;alt\na.jpg;{};{};{}\n"


@pytest.mark.parametrize(
    ("table", "altitude"),
    [
        ('name,lat,lon,alt\na.jpg,39.12345,-105.1,"1,634"\n', 1634),
        ('name,lat,lon,alt\na.jpg,39.12345,-105.1,"1,634 m Above Sea Level"\n', 1634),
        ('name,lat,lon,alt_ft\na.jpg,39.12345,-105.1,"5,361"\n', 1634.0328),
        ('name,lat,lon,alt\na.jpg,"39,12345","-105,1","1,634"\n', 1.634),
        ('name,lat,lon,alt\na.jpg,39,-105,"1,634"\n', 1634),  # commas part the words
        ('EPSG:32632\nname,x,y,z\na.jpg,"489,334","4,330,123","1,634"\n', 1634),
        (DEGREES.format("39.12345", "-105.1", "1,634"), 1634),
        (DEGREES.format("39.12345", "-105.1", "1,634\nb.jpg;39.12345;-105.1;412,5"), 1.634),  # the column counts first
        (DEGREES.format("39,12345", "-105,1", "1,634"), 1.634),
        (DEGREES.format("39,123", "-105,124", "1,634"), 1.634),  # no angle has thousands
        (DEGREES.format("39,12345", "-105,1", "1.634\nb.jpg;39,12345;-105,1;1.634,5"), 1634),
        (DEGREES.format("39,12345", "-105,1", "412.523"), 412.523),
        (UTM.format("489334", "4330123", "412,523"), 412.523),  # 412 km is no altitude
        (UTM.format("489.334", "4.330.123", "1.634"), 1634),
        (UTM.format("489 334,5", "4 330 123,7", "1,634"), 1.634),
        (UTM.format("489'334,54", "4'330'123,74", "1,634"), 1.634),
        (UTM.format("489334", "4330123", "1634,5 m\nb.jpg;489334;4330123;1,634 m"), 1634.5),
        ("a.jpg 39.12345 -105.1 1,634\n", 1634),
        ('a.jpg,39.12345,-105.1,"1,634.5 m"\n', 1634.5),
        ("a.jpg;39.12345;-105.1;1'634 m\n", 1634),
        ('EPSG:32632\na.jpg,"489.334,1","4.330.123,2","1.634,5"\n', 1634.5),
    ],
)
def test_a_comma_before_three_digits_is_what_the_table_shows(tmp_path, table, altitude):
    (tmp_path / "t.csv").write_text(table)
    assert read_gps_table(tmp_path / "t.csv").rows[0].position[2] == pytest.approx(altitude)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (UTM.format("489334", "4330123", "1,634"), "the altitude may be 1634 or 1.634,"),
        (UTM.format("489,334", "4330123", "1634"), "a coordinate may be 489334 or 489.334,"),
        (DEGREES.format("39,12345", "-105,1", "1.634"), "the altitude may be 1634 or 1.634,"),
        ("a.jpg;39,12345;-105,1;1.634\n", "the altitude may be 1634 or 1.634,"),
        ("EPSG:32632\na.jpg;489,334;4330123;1634\n", "a coordinate may be 489334 or 489.334,"),
    ],
)
def test_numbers_that_may_be_thousands_or_decimals_are_refused(tmp_path, table, said):
    (tmp_path / "t.csv").write_text(table)
    with pytest.raises(CaptureError, match=said):
        read_gps_table(tmp_path / "t.csv")


@pytest.mark.parametrize(
    "columns",
    [
        "H_ell,H_msl,sdh,sdv", "gps_altitude_hae,,hrms[m],vrms[m]", "Altitude,,std_h (m),std_v (m)",
        "Altitude,Latitude_acc_(m),Longitude_acc_(m),Altitude_acc_(m)",
    ],
)  # fmt: skip
def test_more_names_of_altitudes_and_accuracies(tmp_path, columns):
    middle = "0.02" if "acc" in columns else "455"
    (tmp_path / "t.csv").write_text(f"name,lat,lon,{columns}\na.jpg,48.1,15.2,500,{middle},0.02,0.04\n")
    (row,) = read_gps_table(tmp_path / "t.csv").rows
    assert row.position == (48.1, 15.2, 500)
    assert row.gps_std == (0.02, 0.04)


def test_rows_without_names_of_columns_have_accuracies_behind_three_angles(tmp_path):
    (tmp_path / "t.csv").write_text(
        "a.jpg,48.1,15.2,500,1.2,0.3,45,0.02,0.04\nb.jpg,48.2,15.2,500,1,0.3,45,0.02,0.04\n"
    )
    assert read_gps_table(tmp_path / "t.csv").rows[0].gps_std == (0.02, 0.04)


def test_a_row_that_lacks_a_longitude_exchanges_nothing(tmp_path):
    (tmp_path / "t.csv").write_text("a.jpg,-33.5,-120.6,500\nb.jpg,-33.5\nc.jpg,-33.5,-120.6,500\n")
    assert [row.position for row in read_gps_table(tmp_path / "t.csv").rows] == [(-33.5, -120.6, 500)] * 2


def test_moments_of_a_drone_are_matched_by_number(tmp_path):
    seen = small_photographs(tmp_path, [f"DJI_2026_{k:04d}_V.jpg" for k in range(1, 5)])
    file = tmp_path / "flight.MRK"
    line = "{}\t280234.1\t[2145]\t  12,N\t 34,E\t -20,V\t-33.5{},Lat\t-70.6,Lon\t500,Ellh\t0.01, 0.02, 0.03\t50,Q\n"
    file.write_text("".join(line.format(k, k) for k in range(1, 5)))
    found = read_gps_priors(seen, file, (1.0, 2.0))
    assert found.image_indices.tolist() == [0, 1, 2, 3]
    assert np.all(np.diff(found.enu[:, 1]) < -100)
    assert found.gps_std[0] == pytest.approx([0.02, 0.02, 0.03])


def test_moments_of_one_flight_among_several_are_refused_with_what_can_be_done(tmp_path):
    file = tmp_path / "flight.MRK"
    file.write_text("1\t280234.1\t[2145]\t  12,N\t 34,E\t -20,V\t-33.5,Lat\t-70.6,Lon\t500,Ellh\t0.01, 0.02, 0.03\n")
    names = ["a/DJI_0001.jpg", "b/DJI_0001.jpg"]
    with pytest.raises(CaptureError, match=r"for one flight\. Place the flights one by one, or give one table"):
        match_rows(names, read_gps_table(file).rows, file, numbered=True)


@pytest.mark.parametrize(
    ("system", "x", "y"),
    [
        ("EPSG:2056", 2680249.7, 1239318.9), ("EPSG:2056+5728", 2680249.7, 1239318.9), ("EPSG:32719", 351400, 6292300),
        ("EPSG:31467", 3500000, 5500000),
    ],
)  # fmt: skip
def test_x_and_y_that_only_fit_where_their_system_is_used_once_exchanged_are_refused(tmp_path, system, x, y):
    pytest.importorskip("pyproj")
    (file := tmp_path / "table.csv").write_text(f"{system}\nname;Y;X;Z\na.jpg;{x};{y};500\n")
    with pytest.raises(CaptureError, match=r"only once x and y change places\. Write x \(east\) first"):
        read_gps_table(file)
    file.write_text(f"{system}\nname;X;Y;Z\na.jpg;{x};{y};500\n")
    assert len(read_gps_table(file).rows) == 1
    file.write_text(f"{system}\nname;X;Y;Z\na.jpg;{x + 150_000};{y};500\n")  # a little beside its zone
    assert len(read_gps_table(file).rows) == 1
