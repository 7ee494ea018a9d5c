"""Lists of control points as people and programs write them: read, or refused with the line and the remedy."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from PIL import Image, ImageOps

pytest.importorskip("embreex")
pytest.importorskip("pyproj")

from support.flights import ORIGIN, Flight, sightings, write_photograph
from support.gcp_files import NAMES, PLACES, SURVEY_OFF, projected, write_list
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.sfm.gcp_adjustment import triangulate
from vdgs.sfm.gcp_lines import parse_line, read_rows
from vdgs.sfm.gcp_list import (
    GcpList,
    GcpObservation,
    GroundControlPoint,
    are_along_line,
    check_gcps_near,
    read_gcp_list,
)
from vdgs.sfm.image_list import ExcludedImage, ImageList, collect_images
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = [pytest.mark.xdist_group("sfm"), pytest.mark.slow]


@pytest.fixture(scope="module")
def flight(nine) -> Flight:
    return nine


@pytest.fixture(scope="module")
def points(flight) -> list[dict[int, np.ndarray]]:
    return sightings(flight.cameras, PLACES)


@pytest.mark.parametrize(
    ("header", "system"),
    [
        ("EPSG:32719", None),
        ("WGS84 UTM 19S", "EPSG:32719"),
        ("+proj=utm +zone=19 +south +datum=WGS84 +units=m +no_defs", None),
        ("EPSG:4326", None),
        ("WGS84", "EPSG:4326"),
    ],
)
def test_all_ways_to_name_a_system_lead_to_the_same_places(flight, points, tmp_path, header, system):
    control = read_gcp_list(
        write_list(tmp_path / "gcp_list.txt", flight, points, header, system), collect_images([flight.folder]), ()
    )
    assert [point.name for point in control.points] == list(NAMES)
    truth = np.array([seen[-1] + SURVEY_OFF for seen in points])
    assert np.abs(control.enu(ORIGIN) - truth).max() < 0.001
    assert control.has_control_points
    for point, seen in zip(control.points, points, strict=True):
        for sighting in point.observations:
            number = flight.names.index(sighting.image)
            assert sighting.pixel == pytest.approx(seen[number], abs=0.001)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_those_of_the_file_before_it_is_turned(tmp_path, orientation):
    pixels = np.zeros((120, 160, 3), np.uint8)
    pixels[30, 100] = 255
    (tmp_path / "card").mkdir()
    for k in range(3):
        write_photograph(tmp_path / "card" / f"p{k}.jpg", pixels, k, None, orientation)
    photo = collect_images([tmp_path / "card"]).images[0]
    with Image.open(photo.path) as image:
        upright = np.array(ImageOps.exif_transpose(image).convert("L"))
    row, column = np.unravel_index(int(upright.argmax()), upright.shape)
    assert photo.to_upright_pixel((100.5, 30.5)) == pytest.approx((column + 0.5, row + 0.5))
    assert (photo.stored_size, (photo.height, photo.width)) == ((160, 120), upright.shape)


LINE = "{x:.3f} {y:.3f} {z:.3f} 100 80 {photograph} {name}"


def listed(flight: Flight, *changes: dict[str, object], header: str = "EPSG:32719") -> str:
    """A sound list of three points in two photographs each, its lines changed one after the other."""
    lines = []
    for name, x, y in (("a", -9, -9), ("b", 9, -9), ("c", 0, 9)):
        place = projected(np.array([x, y, 0.0]), "EPSG:32719")
        for photograph in flight.names[:2]:
            lines.append({"x": place[0], "y": place[1], "z": place[2], "photograph": photograph, "name": name})
    for line, change in zip(lines, changes, strict=False):
        line.update(change)
    return "\n".join([header, *(str(line.get("text", LINE.format(**line))) for line in lines)])


def test_lists_that_a_spreadsheet_wrote_are_read(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    file.write_text(plain := listed(flight))
    sound = read_gcp_list(file, collection, ())
    head, *lines = (line.split() for line in plain.splitlines())
    columns = ["geo_x", "geo_y", "geo_z", "im_x", "im_y", "image_name", "gcp_name"]
    dots = (".JPG", "#JPG"), (".", ","), ("#JPG", ".JPG")
    ways = (
        ("utf-16", [f"{head[0]},,,,,,", *(",".join(line) for line in [columns, *lines])]),
        (
            "cp1252",
            [f'"{head[0]}"', *(reduce(lambda text, two: text.replace(*two), dots, ";".join(line)) for line in lines)],
        ),
    )
    for encoding, rows in ways:
        file.write_bytes("\r\n".join(rows).encode(encoding))
        assert read_gcp_list(file, collection, ()).points == sound.points
    units = [
        [f"{float(x) / 1e3!r}", f"{float(y) / 1e-2!r}", f"{float(z) / 0.3048!r}", *rest] for x, y, z, *rest in lines
    ]
    named = [",".join([*line[:-1], f"CHK-{line[-1]}"]) for line in units]
    file.write_text("\n".join([f"{head[0]} # of May", "x [km],y [cm],z (ft),px,py,photograph,name", *named]))
    found = read_gcp_list(file, collection, ())
    assert all(point.is_check_point for point in found.points)
    assert "held out as check points" in "".join(found.notes)
    places = [np.array([point.geodetic for point in each.points]) for each in (found, sound)]
    assert places[0] == pytest.approx(places[1], abs=1e-6)


def test_a_system_in_a_comment_and_decimal_commas_between_blanks_are_read(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    file.write_text(plain := listed(flight))
    sound = read_gcp_list(file, collection, ())
    head, *lines = plain.splitlines()
    commas = [" ".join([*" ".join(line.split()[:5]).replace(".", ",").split(), *line.split()[5:]]) for line in lines]
    for rows in (["# of May", f"#{head}", *lines], ["# EPSG:4326", head, *lines], [head, *commas]):
        file.write_text("\n".join(rows))
        assert read_gcp_list(file, collection, ()).points == sound.points


@pytest.mark.parametrize(
    ("row", "place"),
    [
        ("489334.12 4330123.10 1,634 2000 1500 a.jpg p", (489334.12, 4330123.1, 1634)),
        ("489,334.12\t4,330,123.10\t1,634\t2000\t1500\ta.jpg\tp", (489334.12, 4330123.1, 1634)),
        ('"489,334","4,330,123","1,634","2,000",1500,a.jpg,p', (489334, 4330123, 1634)),
        ("489,334 4,330,123 1,634 2000 1500 a.jpg p", (489334, 4330123, 1634)),
        ("489334,12 4330123,10 1,634 2000 1500 a.jpg p", (489334.12, 4330123.1, 1.634)),
        ("489,334.1 4,330,123.1 1,634.1 2,000.5 1,500.5 a.jpg p", (489334.1, 4330123.1, 1634.1)),
        ("489334;4330123;412,523;2000;1500;a.jpg;p", (489334, 4330123, 412.523)),
        ("489334;4330123;1,634;2000;1500;a.jpg;p", None),
        ("489334,12;4330123,10;1.634;2000;1500;a.jpg;p", None),
    ],
)
def test_a_comma_before_three_digits_is_what_the_list_shows(tmp_path, row, place):
    (file := tmp_path / "gcp_list.txt").write_text(f"EPSG:32613\n{row}\n")
    (found,) = read_rows(file)[1]
    if place is None:
        with pytest.raises(CaptureError, match=r"line 2: a number may be 1634 or 1\.634, and nothing"):
            parse_line(found, file, 1.0)
    else:
        assert parse_line(found, file, 1.0).place == place


SITE = (
    "# Site North / targets",
    "# 2024",
    "# EPSG:32718 before",
    "# WGS84 positions of the drone were not used",
    "# of / b",
)


@pytest.mark.parametrize("remark", SITE)
@pytest.mark.parametrize("system", ["CRS: EPSG:4258", "ETRS89"])
def test_a_comment_never_stands_in_for_a_line_that_names_a_system(flight, tmp_path, remark, system):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    marks = [(k, name) for k in range(3) for name in flight.names[:2]]
    rows = [f"{9 + k / 1e3} {47 + k**2 / 1e3} 30 9 9 {name} {k}" for k, name in marks]
    file.write_text("\n".join([remark, system, *rows]))
    found = read_gcp_list(file, collection, ())
    assert found.crs == "ETRS89"
    assert found.points[0].geodetic[:2] == pytest.approx((47, 9), abs=1e-5)
    file.write_text("\n".join([remark, "Some old datum", *rows]))
    with pytest.raises(CaptureError, match="'Some old datum' names none"):
        read_gcp_list(file, collection, ())


def test_of_comments_above_the_points_those_that_define_a_system_count(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    file.write_text(plain := listed(flight))
    sound = read_gcp_list(file, collection, ())
    _, *lines = plain.splitlines()
    import pyproj

    wkt = pyproj.CRS("EPSG:32719").to_wkt("WKT1_GDAL", pretty=True).splitlines()
    names = ("EPSG:32719",), ("WGS 84 / UTM zone 19S",), ("WGS84 UTM 19S # of May",), tuple(wkt)
    remarks = "Site North / targets", "2024", "WGS84 positions of the drone were not used", "a / b"
    for name in names:
        for heading in ((), ("geo_x geo_y geo_z im_x im_y image_name",)):
            above = [f"# {text}" for text in (*remarks, *name, *remarks)]
            file.write_text("\n".join([*above, *heading, *lines]))
            assert read_gcp_list(file, collection, ()).points == sound.points
    file.write_text("\n".join([*(f"# {text}" for text in remarks), *lines]))
    with pytest.raises(CaptureError, match=f"'{lines[0][:30]}.*' names none"):
        read_gcp_list(file, collection, ())


def test_points_without_a_name_take_none_of_another(flight, tmp_path):
    text = listed(flight, *({"name": name} for name in ("", "", "Point~1", "Point~1", "", "")))
    (file := tmp_path / "gcp_list.txt").write_text(text.replace(" ", "\t").replace("~", " "))
    collection = collect_images([flight.folder])
    points = read_gcp_list(file, collection, ("all",)).points
    assert [point.name for point in points] == ["point 4", "Point 1", "point 3"]


def test_metres_under_a_system_in_feet_are_metres(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    marks, found = [(k, name) for k in range(3) for name in flight.names[:2]], []
    for unit, metres in (("ft", 1.0), ("m", 1200 / 3937)):
        places = [((1e6 + 100 * k) * metres, (2e5 + 50 * k**2) * metres) for k, _ in marks]
        rows = [f"{x!r},{y!r},30,9,9,{name},{k}" for (x, y), (k, name) in zip(places, marks, strict=True)]
        file.write_text("\n".join(["EPSG:2263", f"x ({unit}),y ({unit}),z (m),px,py,photograph,name", *rows]))
        found.append(read_gcp_list(file, collection, ("all",)))
    one, other = (np.array([point.geodetic for point in each.points]) for each in found)
    assert other == pytest.approx(one, abs=1e-9)
    assert "feet" not in found[1].crs


def test_feet_whose_headings_say_metres_are_told_by_their_place(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    marks, found = [(k, name) for k in range(3) for name in flight.names[:2]], []
    for heading in ("x,y", "X[m],Y[m]"):
        rows = [f"{990000 + 100 * k},{190000 + 50 * k**2},30,9,9,{name},{k}" for k, name in marks]
        file.write_text("\n".join(["EPSG:2263", f"{heading},Z[m],px,py,photograph,name", *rows]))
        found.append(read_gcp_list(file, collection, ()))
    assert found[0].points == found[1].points
    assert not any("headings" in note for note in found[0].notes)
    assert any("as metres, as their headings say, they would lie 510 km outside" in note for note in found[1].notes)
    assert "heights are taken as metres" in found[1].crs


@pytest.mark.parametrize(("heading", "height"), [("z (ft)", 600), ("z", 600), ("z [m]", 182.88)])
def test_heights_of_a_system_in_feet_are_converted_once(flight, tmp_path, heading, height):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    marks = [(k, name) for k in range(3) for name in flight.names[:2]]
    rows = [f"{3112000 + 100 * k},{10070000 + 50 * k**2},{height},9,9,{name},{k}" for k, name in marks]
    file.write_text("\n".join(["EPSG:2277+6360", f"x,y,{heading},px,py,photograph,name", *rows]))
    heights = [point.geodetic[2] for point in read_gcp_list(file, collection, ()).points]
    assert heights == pytest.approx([182.88] * 3, abs=1e-3)


def looking_down(*names: str) -> pycolmap.Reconstruction:
    """A model of photographs straight down from 50 m, 10 m apart along a line, the first 10 m east of the origin."""
    model, turn = pycolmap.Reconstruction(), np.diag([1.0, -1, -1])
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=4000, height=3000, params=[3000, 3000, 2000, 1500], camera_id=1)
    )
    for k, name in enumerate(names, 1):
        pose = pycolmap.Rigid3d(np.column_stack([turn, -turn @ [10.0 * k, 0, 50]]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=k), pose)
    return model


def test_marks_that_are_left_with_one_photograph_keep_their_place():
    """Three marks in one photograph, one in another: without the worst no other place is shown."""
    marks = (("A", (2300.0, 1500.0)), ("A", (2305.0, 1505.0)), ("A", (2310.0, 1500.0)), ("B", (1700.0, 2000.0)))
    point = GroundControlPoint("P", (0, 0, 0), tuple(GcpObservation(*mark) for mark in marks), False)
    found = triangulate(looking_down(*"AB"), point)
    assert found.agreeing == point.observations
    assert found.error_px == found.kept_px > 100


def test_a_mark_some_pixels_off_moves_a_point_less_than_by_its_share():
    """One of six, 7 pixels across the line: too near to be left out, too far to count as the others do."""
    model, off_px = looking_down(*"ABCDEF"), 7.0
    marks = [GcpObservation(name, (2000.0 + 3000 * (35 - 10 * k) / 50, 1500.0)) for k, name in enumerate("ABCDEF", 1)]
    marks[2] = replace(marks[2], pixel=(marks[2].pixel[0], 1500 + off_px))
    found = triangulate(model, GroundControlPoint("P", (0, 0, 0), tuple(marks), False))
    assert len(found.agreeing) == 6
    assert np.linalg.norm(found.position - [35, 0, 0]) * 3000 / 50 < 0.5 * off_px / 6


def test_heights_that_are_not_known_are_told_from_zeros(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    rows = [line.split() for line in listed(flight).splitlines()]
    for z, said in (("0", "exactly 0"), ("-9999", "without a height (a, b, c)"), ("NaN", "without a height (a, b, c)")):
        file.write_text("\n".join(" ".join([*row[:2], z, *row[3:]] if row[1:] else row) for row in rows))
        found = read_gcp_list(file, collection, ())
        assert said in "".join(found.notes)
        assert found.has_heights is (z == "0")


def test_heights_of_some_points_make_no_plane_of_a_line():
    line, nan = np.array([[10.0 * k, 5.0 * k, 0.0] for k in range(5)]), np.nan
    assert are_along_line(line)
    assert are_along_line(np.column_stack([line[:, :2], [0, 30, nan, nan, nan]]))
    assert not are_along_line(np.column_stack([line[:, :2], [0, 30, 0, nan, nan]]))  # a wall
    assert not are_along_line(np.array([[0, 0, nan], [10, 0, nan], [0, 10, nan]]))


BAD = {
    "nothing": ("", "is empty"),
    "no system": (None, "must name the coordinate system"),
    "XML": (
        "<?xml version='1.0'?>\n<document version='2.1'><markers/></document>",
        "is XML, .* --gcp takes ODM's list",
    ),
    "no such system": ({"header": "EPSG:999999"}, "must name the coordinate system"),
    "a word for a number": ([{"text": "1 2 three 4 5 DJI_0001.JPG"}], "line 2: .* is not `x y z px py photograph"),
    "columns in another order": ([{"text": "lat lon alt px py photo"}], "line 2: .* another order than `x y z px py"),
    "too few words": ([{"text": "a 1 2 3"}], "line 2: .* is not `x y z px py photograph.* points alone"),
    "not finite": ([{"text": "nan 2 3 4 5 DJI_0001.JPG"}], "line 2: numbers must be finite"),
    "unknown photograph": ([{"photograph": "DJI_0999.JPG"}], r"1 photographs that are not there; .*DJI_0999\.JPG"),
    "outside": ([{"text": "1 2 3 321 5 DJI_0001.JPG"}], "line 2: pixel 321, 5 is outside .* 320 x 240"),
    "below": (
        [{"text": "1 2 3 5 241 DJI_0001.JPG"}],
        "line 2: pixel 5, 241 is outside .* 320 x 240.*exchanged, or was",
    ),
    "two places": ([{}, {"x": 5.0}], "line 3: the point a has another place in line 2"),
    "too few points": ([{"name": "c"}] * 4, "another place"),
    "no place on Earth": ([{"x": 1e12}, {"x": 1e12}], "line 2: .* is no place in"),
    "height of the Moon": ([{"z": 4e8}, {"z": 4e8}], "line 2: .* is no place in"),
}


@pytest.mark.parametrize(("what", "said"), BAD.values(), ids=BAD)
def test_bad_lists_are_refused_with_the_line_and_the_remedy(flight, tmp_path, what, said):
    file = tmp_path / "gcp_list.txt"
    if what is None:
        file.write_text("\n".join(listed(flight).splitlines()[1:]))
    elif isinstance(what, dict):
        file.write_text(listed(flight, **what))
    else:
        file.write_text(what if isinstance(what, str) else listed(flight, *what))
    with pytest.raises(CaptureError, match=said) as refused:
        read_gcp_list(file, collect_images([flight.folder]), ())
    assert str(file) in str(refused.value)


def test_files_that_are_no_lists_are_refused(flight, tmp_path):
    collection = collect_images([flight.folder])
    with pytest.raises(CaptureError, match="cannot be read"):
        read_gcp_list(tmp_path / "none.txt", collection, ())
    with pytest.raises(CaptureError, match="not a text file"):
        read_gcp_list(flight.folder / flight.names[0], collection, ())
    for kind, text in (
        (
            "is XML, as Metashape writes markers, or KML or LandXML points",
            '<?xml version="1.0"?>\n<document version="1.5.0">\n</document>\n',
        ),
        (
            "without their marks in photographs",
            "#Label,X,Y,Z\nP1,306231.5,4545350.1,233.6,0.005\nP2,306185.2,4545327.8,234,0.005\n",
        ),
        ("without their marks in photographs", "1,5000.1,6000.2,100.3,CP\n2,5010.1,6010.2,100.3,CP\n"),
        (
            "without their marks in photographs",
            "Name,Longitude,Latitude,Ellipsoidal height,CS name\nP1,11.5,48.1,520.3,WGS84\nP2,11.6,48.1,520,WGS84\n",
        ),
        (r"\(GSI\), of points without their marks in photographs", "*110001+00000000000000P1 81..00+00000000306231\n"),
        ("marks without the coordinates of their points", "DJI_0001.JPG,gcp1,1234.5,567.8\n"),
        ("JSON", '{"type": "FeatureCollection", "features": []}\n'),
    ):
        (tmp_path / "other.txt").write_text(text)
        with pytest.raises(CaptureError, match=rf"{kind}\. --gcp takes ODM's list: .* `x y z px py photograph name`"):
            read_gcp_list(tmp_path / "other.txt", collection, ())
    (tmp_path / "two.txt").write_text("\n".join(listed(flight).splitlines()[:5]))
    with pytest.raises(CaptureError, match=r"2 points .* and 3 are needed.*--check-points all"):
        read_gcp_list(tmp_path / "two.txt", collection, ())
    assert len(read_gcp_list(tmp_path / "two.txt", collection, ("all",)).points) == 2
    (tmp_path / "sound.txt").write_text(listed(flight))
    with pytest.raises(CaptureError, match=r"--check-points gate: .* has a, b, c"):
        read_gcp_list(tmp_path / "sound.txt", collection, ("gate",))
    with pytest.raises(VdgsError, match="give it with --gcp"):
        plan_reconstruction(
            SfmRequest(image_folders=(flight.folder,), output=tmp_path / "out", options=SfmOptions(check_points=("a",)))
        )


def test_two_marks_of_a_point_in_a_photograph_are_refused(flight, tmp_path):
    first = listed(flight).splitlines()[1].split()
    for pixel, is_refused in (("100.2 80.1", False), ("140 80", True)):
        again = " ".join([*first[:3], pixel, *first[5:]])
        (tmp_path / "list.txt").write_text(f"{listed(flight)}\n{again}")
        if is_refused:
            with pytest.raises(CaptureError, match=r"line 8: the point a has another mark in .* in line 2\. Delete"):
                read_gcp_list(tmp_path / "list.txt", collect_images([flight.folder]), ())
        else:
            read_gcp_list(tmp_path / "list.txt", collect_images([flight.folder]), ())


def test_check_points_are_known_in_other_letters_where_that_leaves_one(flight, tmp_path):
    collection, file = collect_images([flight.folder]), tmp_path / "list.txt"
    file.write_text(listed(flight))
    held_out = read_gcp_list(file, collection, ("A", "b", "C")).points
    assert all(point.is_check_point for point in held_out)
    assert all(point.is_check_point for point in read_gcp_list(file, collection, ("ALL",)).points)
    file.write_text(listed(flight, {}, {}, {"name": "A"}, {"name": "A"}))
    assert [point.is_check_point for point in read_gcp_list(file, collection, ("A", "a", "c")).points] == [True] * 3
    file.write_text(listed(flight, *[{"name": "aX"}] * 2, *[{"name": "Ax"}] * 2))
    with pytest.raises(CaptureError, match="--check-points ax: "):
        read_gcp_list(file, collection, ("ax",))


def test_points_along_a_line_and_in_another_zone_are_refused(flight, tmp_path):
    collection = collect_images([flight.folder])
    row = [{"x": 300_000.0 + k // 2, "y": 6_290_000.0 + k // 2, "z": 1.0} for k in range(6)]
    (tmp_path / "row.txt").write_text(listed(flight, *row))
    with pytest.raises(CaptureError, match="along one line"):
        read_gcp_list(tmp_path / "row.txt", collection, ())
    (tmp_path / "zone.txt").write_text(listed(flight, header="EPSG:32718"))
    with pytest.raises(CaptureError, match=r"km from the photographs.*UTM zone 18S"):
        plan_reconstruction(
            SfmRequest(
                image_folders=(flight.folder,), output=tmp_path / "out", options=SfmOptions(gcp=tmp_path / "zone.txt")
            )
        )
    check_gcps_near(
        read_gcp_list(tmp_path / "zone.txt", collection, ()), np.zeros((0, 3)), ORIGIN, tmp_path / "zone.txt"
    )


def test_names_may_be_of_folders_without_endings_in_other_letters_and_with_blanks(flight, tmp_path):
    photographs = collect_images([flight.folder]).images
    collection = ImageList(
        (flight.folder,),
        (replace(photographs[0], name="one/DJI_0001.JPG"), replace(photographs[1], name="two/DJI_0001.JPG"),
         replace(photographs[2], name="the_mill.JPG")),
        (ExcludedImage("cut.jpg", "it is cut off"),), 0,
    )  # fmt: skip

    def read(*photographs: str) -> GcpList:
        lines = [line.split() for line in listed(flight).splitlines()[1:]]
        written = ["\t".join([*line[:5], *photographs[k % 2 : k % 2 + 1], line[6]]) for k, line in enumerate(lines)]
        (tmp_path / "list.txt").write_text("\n".join(["EPSG:32719", *written]))
        return read_gcp_list(tmp_path / "list.txt", collection, ())

    control = read("Two\\dji_0001.jpg", "The Mill")
    assert [each.image for each in control.points[0].observations] == ["two/DJI_0001.JPG", "the_mill.JPG"]
    with pytest.raises(CaptureError, match=r"may be one/DJI_0001\.JPG or two/DJI_0001\.JPG: write the folder"):
        read("DJI_0001.JPG", "the mill.jpg")
    with pytest.raises(CaptureError, match="only one photograph shows a, b, c"):
        read("cut.jpg", "the_mill.jpg")  # what was left out shows nothing
