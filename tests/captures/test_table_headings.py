"""What headings and values of tables of positions mean: units, hemispheres, heights, words of several languages."""

from __future__ import annotations

import math

import pytest

from vdgs.captures.column_headings import meanings_of
from vdgs.captures.gps_tables import read_gps_table
from vdgs.captures.table_columns import number_of
from vdgs.errors import CaptureError

PLACE = (-33.5, -70.6, 500.0)
EASTING, NORTHING = 351375.7913, 6292135.2282  # of zone 19 south


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("name,lat,lon,alt,latency_sec", "a.jpg,-33.5,-70.6,500,2"),
        ("name,lat,lon,alt,lateral (min),max_dop", "a.jpg,-33.5,-70.6,500,2,3"),
        ("name,lat,lon,alt,lat_min,lat_max", "a.jpg,-33.5,-70.6,500,-34,-33"),
        ("name,easting,northing,z,lat_deg,lat_min,lat_sec", f"a.jpg,{EASTING},{NORTHING},500,-33,30,0"),
    ],
)
def test_columns_that_are_no_minutes_of_the_angles_that_are_read(tmp_path, header, row):
    system = "EPSG:32719\n" if "easting" in header else ""
    (tmp_path / "t.csv").write_text(f"{system}{header}\n{row}\n")
    assert read_gps_table(tmp_path / "t.csv").rows[0].position == pytest.approx(PLACE, abs=1e-5)


@pytest.mark.parametrize(
    ("columns", "values"),
    [
        ("海拔高度(m)", "500"), ("大地高", "500"), ("椭球高", "500"), ("相对高度,绝对高度", "60,500"),
        ("Cota (m)", "500"), ("Altitudine", "500"), ("Elevación", "500"), ("Altitude NGF (m)", "500"),
        ("Höhe über NN", "500"),
        ("Flughöhe über Grund;Höhe ü. NHN", "60;500"), ("Höhe (m ü. M.)", "500"), ("Ellipsoidische Höhe [m]", "500"),
        ("Hauteur ellipsoïdale", "500"), ("Altitud sobre el nivel del mar", "500"), ("Hauteur/sol;Altitude", "60;500"),
        ("height above sea level", "500"), ("AGL,MSL", "60,500"), ("Altitude (AGL) [m],Altitude (AMSL) [m]", "60,500"),
        ("altitude (relative),altitude (absolute)", "60,500"), ("elevation,altitude", "450,500"),
        ("altitude(m above ground),elevation(m ASL)", "60,500"), ("height (agl),height (msl)", "60,500"),
        ("geoid height,height", "30,500"), ("geoid height,ellipsoidal height", "30,500"),
        ("Altitud (pies)", "1640.41995"), ("Höhe (Fuß)", "1640.41995"), ("Altitude (pieds)", "1640.41995"),
        ("高度(英尺)", "1640.41995"), ("alt (')", "1640.41995"),
        ("alt (International Feet)", "1640.41995"), ("alt (ift)", "1640.41995"), ("elev_ift", "1640.41995"),
        ("z (intl. ft)", "1640.41995"), ("z (sft)", "1640.416667"), ("alt (US ft)", "1640.416667"),
        ("Elevation (U.S. Survey Feet)", "1640.416667"), ("alt_usft", "1640.416667"),
        ("alt", "1640.41995 pies"), ("alt", "500 m ü. NN"),
    ],
)  # fmt: skip
def test_altitudes_are_known_by_what_their_headings_mean(tmp_path, columns, values):
    separator = ";" if ";" in columns else ","
    head, row = (
        separator.join(each) for each in (("name", "lat", "lon", columns), ("a.jpg", "-33.5", "-70.6", values))
    )
    (file := tmp_path / "t.csv").write_text(f"{head}\n{row}\n", encoding="utf-8")
    read = read_gps_table(file)
    assert read.rows[0].position == pytest.approx(PLACE, abs=1e-5)
    assert not any("not read" in note or "not understood" in note for note in read.notes)


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("Altitude (AGL)", "60", "'Altitude (AGL)': over the ground"), ("geoid height", "30", "or the geoid, no alt"),
        ("Hoogte", "500", "no column is known as the altitude; not read: 'Hoogte' (500)"),
    ],
)  # fmt: skip
def test_heights_that_are_not_read_are_named(tmp_path, column, value, said):
    (file := tmp_path / "t.csv").write_text(f"name,lat,lon,yaw,{column}\na.jpg,-33.5,-70.6,90,{value}\n")
    read = read_gps_table(file)
    assert math.isnan(read.rows[0].position[2])
    assert said in " ".join(read.notes)
    assert "yaw" not in " ".join(read.notes)


def test_brackets_of_headings_that_are_not_understood_are_named(tmp_path):
    (file := tmp_path / "t.csv").write_text("name,lat (m),lon [deg],alt (klafter)\na.jpg,-33.5,-70.6,500\n")
    notes = " ".join(read_gps_table(file).notes)
    assert "'lat (m)' is not understood; read as degrees" in notes
    assert "'alt (klafter)' is not understood; read as metres" in notes
    assert "'lon [deg]'" not in notes


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("lat,N/S,lon,E/W", "33.5,S,70.6,W"), ("lat,Hemisphere,lon,hemisphere", "33.5,s,70.6,w"),
        ("Latitude (S),Longitude (W)", "33.5,70.6"), ("Lat [°S],Lon [°W]", "33.5,70.6"),
        ("Lat (°N),Lon (°E)", "-33.5,-70.6"), ("lat,yes,lon", "-33.5,N,-70.6"), ("Lat [°N],Lon [°W]", "33.5 S,70.6"),
        ("lat [gon],lon [gon]", f"{-33.5 / 0.9},{-70.6 / 0.9}"), ("Latitud;Longitud", "33,5 S;70,60000 O"),
        ("Breite;Länge", "33°30'0,00\" S;289,40000° O"), ("Latitude;Hauteur/sol;Longitude", "33,50 S;60,0;70°36' O"),
        ("lat (DMS),lon (DMS)", "-33 30 0,-70 36 0"), ("Lat (ddmm.mmm),NS,Lon (dddmm.mmm),EW", "3330.000,S,7036.000,W"),
    ],
)  # fmt: skip
def test_hemispheres_and_units_of_angles_are_read_wherever_they_are_said(tmp_path, head, row):
    separator = ";" if ";" in head else ","
    rows = f"name{separator}{head}\na.jpg{separator}{row}\n"
    (file := tmp_path / "t.csv").write_text(rows, encoding="utf-8")
    latitude, longitude, _ = read_gps_table(file).rows[0].position
    assert (latitude, longitude % 360) == pytest.approx((-33.5, 289.4), abs=1e-6)


@pytest.mark.parametrize(
    ("head", "row", "said"),
    [
        ("lat (DDMMSS.ss),lon (DDMMSS.ss)", "-33.30,-70.36", "in one number"),
        ("lat,lon", "33.5 S,70.6 O", "O is west"),
        ("lat,N/S,lon,E/W", "-33.5,N,70.6,W", "latitude -33.5 N: its sign says S, its side N"),
        ("lat,N/S,lon,E/W", "-33.5,S,-7036.0000,E", "longitude -7036.0000 E: its sign says W"),
        ("lat,lon", "-33.5 S,-70.6 E", "longitude -70.6 E: its sign says W"),
    ],
)
def test_angles_that_may_mean_two_things_are_refused(tmp_path, head, row, said):
    (file := tmp_path / "t.csv").write_text(f"name,{head}\na.jpg,{row}\n")
    with pytest.raises(CaptureError, match=f"line 2: .*{said}.* Write"):
        read_gps_table(file)


@pytest.mark.parametrize("side", ["Юг", "Etelä", "E", "1"])
def test_words_that_are_no_sides_are_refused(tmp_path, side):
    (file := tmp_path / "t.csv").write_text(
        f"name,latitude,latitude ref,longitude,longitude ref\na.jpg,33.5,{side},70.6,W\n", encoding="utf-8"
    )
    with pytest.raises(CaptureError, match=f"line 2: '{side}' is no side of a latitude. Write N or S instead"):
        read_gps_table(file)


SIDES = {
    "S": "s S. south Sud süd SÜD sur Sul South_latitude", "W": "w W. west ovest Oeste ouest Oeste_long.",
    "N": "n N. North nord norte Nord_Breite", "E": "e E. east est Ost OST este Ost_Länge",
}  # fmt: skip


@pytest.mark.parametrize(("side", "word"), [(side, word) for side, words in SIDES.items() for word in words.split()])
def test_words_of_several_languages_say_the_side(tmp_path, side, word):
    """In columns of their own, found by their headings or by these words, and behind the angle."""
    south, west = (word.replace("_", " "), "W") if side in "NS" else ("S", word.replace("_", " "))
    row = f"a.jpg,33.5,{south},70.6,{west},500"
    tables = [f"name,latitude,latitude ref,longitude,longitude ref,alt\n{row}"]
    if "_" not in word:
        tables.append(f"name,latitude,a,longitude,b,alt\n{row}")
    if word.isalpha():
        tables.append(f"name,lat,lon,alt\na.jpg,33.5 {south},{west} 70.6,500")
    for table in tables:
        (tmp_path / "t.csv").write_text(table, encoding="utf-8")
        place = (33.5 if side == "N" else -33.5, 70.6 if side == "E" else -70.6, 500)
        assert read_gps_table(tmp_path / "t.csv").rows[0].position == pytest.approx(place, abs=1e-9)


@pytest.mark.parametrize("units", [",deg,deg,ft", "[-],[°],[°],[ft]", "-,°,°,pies"])
def test_a_row_of_units_below_the_headings_counts(tmp_path, units):
    (file := tmp_path / "t.csv").write_text(f"name,lat,lon,alt\n{units}\na.jpg,-33.5,-70.6,1640.41995\n")
    read = read_gps_table(file)
    assert [row.position for row in read.rows] == [pytest.approx(PLACE, abs=1e-5)]
    assert not read.notes


@pytest.mark.parametrize(
    ("across", "upwards"),
    [
        ("Accuracy Horz [m]", "Accuracy Vert [m]"), ("hz accuracy", "vert. accuracy"), ("水平精度", "高程精度"),
        ("horizontal RMS", "vertical RMS (m)"), ("GPS accuracy horizontal", "altitude accuracy"),
        ("Genauigkeit Lage", "Genauigkeit Höhe"), ("std_xy", "std_up"), ("GPSHPositioningError", "sigma_z"),
        ("std_xy", "RtkStdHgt"), ("std_xy", "ht std"),
    ],
)  # fmt: skip
def test_accuracies_are_known_by_the_words_of_their_headings(tmp_path, across, upwards):
    """One of them alone is not read, and a note names it; accelerations and residuals are none."""
    table = "name,lat,lon,alt,accX,X_error,yaw accuracy,{}\na.jpg,-33.5,-70.6,500,9,8,7,{}\n"
    (file := tmp_path / "t.csv").write_text(table.format(f"{across},{upwards}", "0.5,1.0"), encoding="utf-8")
    read = read_gps_table(file)
    assert (read.rows[0].gps_std, read.notes) == ((0.5, 1.0), ())
    for alone, missing in ((across, "add accuracy_vertical"), (upwards, "add accuracy_horizontal")):
        file.write_text(table.format(alone, "0.5"), encoding="utf-8")
        read = read_gps_table(file)
        assert read.rows[0].gps_std is None
        assert len(read.notes) == 1
        assert f"{alone!r}: not read" in read.notes[0]
        assert missing in read.notes[0]
    file.write_text(table.format("accuracy", "0.5"), encoding="utf-8")
    assert "'accuracy': not read" in read_gps_table(file).notes[0]


@pytest.mark.parametrize("number", ["350\u00a0000,12", "350\u202f000,12", "350 000,12", "350'000.12", "350.000,12"])
def test_signs_between_thousands_are_those_of_any_country(number):
    assert number_of(number) == 350000.12


@pytest.mark.parametrize("said", ["1", "3", "Below Sea Level", "Negative Sea Level (sea-level ref)"])
def test_altitudes_below_the_sea_are_negative_as_exiftool_says_it(tmp_path, said):
    file = tmp_path / "dead sea.csv"
    rows = "".join(f"{k}.jpg,31.5,35.5,{400 + k},{said}\n" for k in range(3))
    file.write_text("SourceFile,GPSLatitude,GPSLongitude,GPSAltitude,GPSAltitudeRef\n" + rows)
    assert [row.position[2] for row in read_gps_table(file).rows] == [-400, -401, -402]


def test_headings_of_any_letters_are_read_in_no_time():
    """Ways to part letters into words grow with every letter, and are not all tried."""
    assert meanings_of("m" * 3000 + "q") is None
    assert meanings_of("m" * 3000) is not None
