"""Surveyed points: read with care, hold a model where they were surveyed, and measure it where they are held out."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from rich.console import Console

pytest.importorskip("embreex")
pytest.importorskip("pyproj")
import pyproj

from support.flights import ALTITUDE_M, HEIGHT, ORIGIN, WIDTH, Flight, sightings, write_photograph
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import gcp_table, is_finished, read_reconstruction, report_rows
from vdgs.captures.validation import validate_capture
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from vdgs.sfm import capture_writer, incremental_mapper
from vdgs.sfm import reconstruct as reconstructing
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.gcp_adjustment import Level, fit_surveyed, fit_to_gcps, gcp_accuracy, no_better_than_left, triangulate
from vdgs.sfm.gcp_list import (
    GcpList,
    GcpObservation,
    GroundControlPoint,
    are_along_line,
    check_gcps_near,
    read_gcp_list,
)
from vdgs.sfm.image_list import ExcludedImage, ImageList, collect_images
from vdgs.sfm.reconstruct import reconstruct
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = [pytest.mark.xdist_group("sfm"), pytest.mark.slow]

PLACES = np.array([[-8.0, -8], [9, -7], [8, 9], [-9, 8], [0, 0], [-4, 5], [5, -2]])
NAMES = ("north_west", "north_east", "gate", "barn", "well", "fence", "stone")
#: The survey is of another height system and a little beside what GPS says.
SURVEY_OFF = np.array([3.0, -2.0, 12.0])


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


@pytest.fixture(scope="module")
def flight(nine) -> Flight:
    return nine


@pytest.fixture(scope="module")
def points(flight) -> list[dict[int, np.ndarray]]:
    return sightings(flight.cameras, PLACES)


@pytest.fixture
def made(nine_begun) -> Path:
    """Placed by GPS; its features, matches and model are kept."""
    return nine_begun["made"]


def projected(enu: np.ndarray, system: str) -> np.ndarray:
    """Metres about ORIGIN to x, y of a system and the height as it is."""
    latitude, longitude, height = geodetic_from_enu(enu[None], ORIGIN)[0]
    x, y = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True).transform(longitude, latitude)
    return np.array([x, y, height])


def write_list(file: Path, flight: Flight, points, header="EPSG:32719", system=None, off=SURVEY_OFF) -> Path:
    lines = [header, "# surveyed with care", ""]
    for name, seen in zip(NAMES, points, strict=True):
        place = projected(seen[-1] + off, system or header)
        for k, pixel in seen.items():
            if k >= 0:
                words = [f"{place[0]:.9f}", f"{place[1]:.9f}", f"{place[2]:.4f}", *(f"{v:.3f}" for v in pixel)]
                lines.append(" ".join([*words, flight.names[k], name]))
    file.write_text("\n".join(lines) + "\n")
    return file


# ------------------------------------------------------------------------------------------------- reading


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
        [f"{float(x) / 1e3!r}", f"{float(y) / 1e3!r}", f"{float(z) / 0.3048!r}", *rest] for x, y, z, *rest in lines
    ]
    named = [",".join([*line[:-1], f"CHK-{line[-1]}"]) for line in units]
    file.write_text("\n".join([f"{head[0]} # of May", "x [km],y [km],z (ft),px,py,photograph,name", *named]))
    found = read_gcp_list(file, collection, ())
    assert all(point.is_check_point for point in found.points)
    assert "held out as check points" in "".join(found.notes)
    places = [np.array([point.geodetic for point in each.points]) for each in (found, sound)]
    assert places[0] == pytest.approx(places[1], abs=1e-6)


@pytest.mark.parametrize(("heading", "height"), [("z (ft)", 600), ("z", 600), ("z [m]", 182.88)])
def test_heights_of_a_system_in_feet_are_converted_once(flight, tmp_path, heading, height):
    collection, file = collect_images([flight.folder]), tmp_path / "gcp_list.txt"
    marks = [(k, name) for k in range(3) for name in flight.names[:2]]
    rows = [f"{3112000 + 100 * k},{10070000 + 50 * k**2},{height},9,9,{name},{k}" for k, name in marks]
    file.write_text("\n".join(["EPSG:2277+6360", f"x,y,{heading},px,py,photograph,name", *rows]))
    heights = [point.geodetic[2] for point in read_gcp_list(file, collection, ()).points]
    assert heights == pytest.approx([182.88] * 3, abs=1e-3)


def test_marks_that_are_left_with_one_photograph_keep_their_place():
    """Three marks in one photograph, one in another: without the worst no other place is shown."""
    model, turn = pycolmap.Reconstruction(), np.diag([1.0, -1, -1])
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=4000, height=3000, params=[3000, 3000, 2000, 1500], camera_id=1)
    )
    for k, name in enumerate("AB", 1):
        pose = pycolmap.Rigid3d(np.column_stack([turn, -turn @ [10.0 * k, 0, 50]]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=k), pose)
    marks = (("A", (2300.0, 1500.0)), ("A", (2305.0, 1505.0)), ("A", (2310.0, 1500.0)), ("B", (1700.0, 2000.0)))
    point = GroundControlPoint("P", (0, 0, 0), tuple(GcpObservation(*mark) for mark in marks), False)
    found = triangulate(model, point)
    assert found.agreeing == point.observations
    assert found.error_px == found.kept_px > 100


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


# ------------------------------------------------------------------------------------------------- placing


def test_points_that_fit_to_a_part_of_a_pixel_are_no_outliers():
    """One on a roof, off by a few centimetres, where the others agree to a millimetre and a pixel shows 11 cm."""
    rng = np.random.default_rng(2)
    surveyed = np.column_stack([rng.uniform(-40, 40, (8, 2)), rng.normal(0, 0.2, 8)])
    surveyed[3, 2] = 12.6
    seen = surveyed + rng.normal(0, 0.001, surveyed.shape)
    seen[3, 2] += 0.04
    assert not fit_to_gcps(seen / 5, surveyed)[1][3]
    found, trusted = fit_to_gcps(seen / 5, surveyed, 0.11 / 5)
    assert trusted.all()
    assert found.scale == pytest.approx(5, rel=1e-3)
    seen[3, 2] += 1
    assert fit_to_gcps(seen / 5, surveyed, 0.11 / 5)[1].tolist() == [k != 3 for k in range(8)]


@pytest.mark.parametrize(("count", "wrong"), [(5, 0), (6, 0), (7, 1), (9, 0)])
def test_the_stated_accuracy_of_few_points_holds(count, wrong):
    rng = np.random.default_rng(count)
    surveys, beyond = 100, np.zeros(3)
    for _ in range(surveys):
        surveyed = rng.uniform(-100, 100, (count, 3)) * [1, 1, 0.05]
        seen = surveyed + rng.normal(size=(count, 3)) * [0.03, 0.03, 0.06]
        seen[:wrong] += [2.0, -1.0, 1.0]
        found, trusted = fit_to_gcps(seen, surveyed)
        stated = gcp_accuracy(found.apply(seen[trusted]), surveyed[trusted], int(trusted.sum()))
        middle = surveyed[trusted].mean(axis=0)
        off = np.abs(found.apply(middle[None])[0] - middle)
        beyond += [100 * abs(found.scale - 1) > stated.scale_percent, np.hypot(*off[:2]) > stated.place_m[0],
                   off[2] > stated.place_m[1]]  # fmt: skip
    assert (beyond <= 0.1 * surveys).all()


@pytest.mark.parametrize(("count", "heights"), [(3, 0), (3, 1), (3, 2), (4, 2), (4, 4)])
def test_known_heights_that_level_nothing_make_the_stated_accuracy_no_better(count, heights):
    """Of 95 % stated, 92 to 98 hold, for north and for scale."""
    rng, within, trials = np.random.default_rng(count + heights), np.zeros(2), 600
    level = Level(up=np.array([0, 0, 1.0]), deviation_deg=1.0, gps=None, gps_up_m=None)
    for _ in range(trials):
        places = np.column_stack([rng.uniform(-100, 100, (count, 2)), rng.uniform(0, 5, count)])
        targets = places + rng.normal(0, 0.03, places.shape)
        targets[heights:, 2] = np.nan
        fit = fit_surveyed(places, targets, level)
        north = np.degrees(np.arctan2(fit.similarity.rotation[1, 0], fit.similarity.rotation[0, 0]))
        scale = 100 * (fit.similarity.scale - 1)
        within += np.abs([north, scale]) <= [fit.accuracy.north_deg, fit.accuracy.scale_percent]
    assert (within >= 0.92 * trials).all()
    assert (within <= 0.98 * trials).all()


def surveyed(made: Path, flight: Flight, tmp_path: Path, file: Path | None, *held_out: str):
    output = tmp_path / "capture"
    if not output.exists():
        shutil.copytree(made, output, symlinks=True)
    options = SfmOptions(gcp=file, check_points=held_out)
    said = console()
    facts = reconstruct(
        SfmRequest(image_folders=(flight.folder,), output=output, threads=1, options=options, keep_intermediate=True),
        said,
    )
    return facts, load_capture(output), said.file.getvalue()


def test_a_place_is_no_better_known_than_by_what_a_model_leaves_of_its_points():
    """Nine points of the model itself agree to the last bit; bent by their marks it leaves millimetres."""
    places = np.random.default_rng(0).uniform(-20, 20, (9, 3))
    stated = gcp_accuracy(places, places, 9)
    assert stated.place_m == (0.0, 0.0)
    left = np.tile([[0.003, 0.004, 0.011], [-0.003, -0.004, np.nan]], (5, 1))[:9]
    across, up = no_better_than_left(stated, left).place_m
    assert across == pytest.approx(2.306 * 0.005 / 3, rel=1e-3)  # Student's t of eight
    assert up == pytest.approx(2.776 * 0.011 / np.sqrt(5), rel=1e-3)  # of the five that have heights
    worse = replace(stated, place_m=(0.5, 0.6))
    assert no_better_than_left(worse, left) == worse
    assert no_better_than_left(replace(stated, place_m=None), left).place_m is None


def test_control_points_hold_a_model_where_they_were_surveyed(made, flight, points, tmp_path):
    """GPS is beside the survey by metres, and does not matter; points that were held out come out right."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    facts, capture, said = surveyed(made, flight, tmp_path, file, "well", "fence")
    assert "placed anew" in said
    assert [each.role for each in facts.survey] == ["control"] * 4 + ["check"] * 2 + ["control"]
    assert max(facts.gcp_rmse_m("check")) < 0.12  # a pixel shows 0.13 m
    assert max(facts.gcp_rmse_m("control")) < 0.12
    assert np.mean([each.residual_m for each in facts.photographs if each.residual_m], axis=0) == pytest.approx(
        SURVEY_OFF, abs=0.3
    )
    shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
    for view, truth in zip(capture.views, flight.cameras, strict=True):
        assert np.linalg.norm(view.camera.position + shift - truth.position - SURVEY_OFF) < 0.6
    assert "heights as in gcp_list.txt" in facts.altitude_reference
    rows = dict(report_rows(facts))
    assert rows["Control points"].startswith("5, place the model: RMSE 0.")
    assert rows["Check points"].startswith("2, held out: RMSE 0.")
    assert [row[0] for row in gcp_table(facts)] == list(NAMES)
    assert read_reconstruction(tmp_path / "capture") == facts


@pytest.mark.parametrize("then", ["the old command", "the new command"])
def test_photographs_of_another_lens_are_written_all_or_none(made, flight, points, tmp_path, monkeypatch, then):
    """Control points tell another lens; stopped among the photographs, the capture is not finished."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    surveyed(made, flight, tmp_path, None)
    monkeypatch.setattr(reconstructing, "LENS_PX", 0.0)
    before, write, output = written(tmp_path / "capture"), capture_writer.write_images, tmp_path / "capture"

    def stopped(folder, work, names, *rest):
        write(folder, work, {number: members[:4] for number, members in names.items()}, *rest)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(capture_writer, "write_images", stopped)
        with pytest.raises(KeyboardInterrupt):
            surveyed(made, flight, tmp_path, file)
    assert not is_finished(output)
    assert not (output / "sparse").exists()
    assert len(written(output)) < len(before)
    _, capture, said = surveyed(made, flight, tmp_path, file if then == "the new command" else None)
    assert "placed anew" in said
    assert validate_capture(capture).problems == ()
    assert (written(output) == before) is (then == "the old command")
    assert "nothing to do" in surveyed(made, flight, tmp_path, file if then == "the new command" else None)[2]
    assert (output / "work" / "database.db").is_file()  # asked to keep


def written(capture: Path) -> dict[str, bytes]:
    return {str(file.relative_to(capture)): file.read_bytes() for file in capture.glob("images*/*")}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", (3000.0, 2000, 1500, -0.05)),
        ("OPENCV", (3000.0, 3010, 2000, 1500, -0.05, 0.01, 0.001, -0.001)),
        ("OPENCV_FISHEYE", (1500.0, 1500, 2000, 1500, 0.01, -0.002, 0.001, 0.0005)),
    ],
)
def test_every_term_of_a_lens_moves_photographs(model, params):
    lens = Intrinsics(model, params, 4000, 3000)
    assert capture_writer.lens_shift_px({1: lens}, {1: lens}) == 0
    assert capture_writer.lens_shift_px({}, {1: lens}) == np.inf
    for k in range(len(params)):
        other = replace(lens, params=(*params[:k], params[k] + (0.01 if params[k] < 1 else 5), *params[k + 1 :]))
        assert capture_writer.lens_shift_px({1: lens}, {1: other}) > reconstructing.LENS_PX
        slight = replace(lens, params=(*params[:k], params[k] * (1 + 1e-8), *params[k + 1 :]))
        assert capture_writer.lens_shift_px({1: lens}, {1: slight}) < reconstructing.LENS_PX


def test_a_national_datum_counts_in_the_place_of_control_points(made, flight, points, tmp_path):
    """Chile's PSAD56 leads to WGS 84 by a shift that is good to 17 m."""
    stated = {}
    for system in ("EPSG:32719", "EPSG:24879"):
        (tmp_path / system).mkdir()
        listed = write_list(tmp_path / system / "gcp_list.txt", flight, points, system)
        facts, _, said = surveyed(made, flight, tmp_path / system, listed)
        stated[system] = facts.accuracy.place_m[0]
        assert ("converted from PSAD56 to WGS 84, good to 17 m" in said) is (system == "EPSG:24879")
    assert stated["EPSG:24879"] == pytest.approx(np.hypot(stated["EPSG:32719"], 17), abs=0.1)
    assert stated["EPSG:32719"] < 1


def test_control_points_without_heights_count_in_the_plane(made, flight, points, tmp_path):
    """Of some points; of all, whose model then lies as high as GPS says, upright by the attitudes."""
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    text = file.read_text()
    rows = [line.split() for line in text.splitlines()[3:]]
    for flat in (NAMES[4:], NAMES):
        words = [[*row[:2], "nan" if row[6] in flat else row[2], *row[3:]] for row in rows]
        file.write_text("\n".join(["EPSG:32719", *(" ".join(each) for each in words)]))
        facts, capture, said = surveyed(made, flight, tmp_path, file, "well")
        off = {each.name: each.residual_m for each in facts.survey}
        assert [len(off[name]) for name in NAMES] == [2 if name in flat else 3 for name in NAMES]
        assert np.abs([value[:2] for value in off.values()]).max() < 0.3
        assert "points without a height (" in said
        assert dict(report_rows(facts))["Check points"].endswith("m north")
        shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
        heights = [view.camera.position[2] + shift[2] for view in capture.views]
        up = np.median(np.subtract(heights, [camera.position[2] for camera in flight.cameras]))
        if flat == NAMES:
            assert up == pytest.approx(0, abs=3)  # GPS, straight down from one height
            assert "heights are by GPS" in said
            assert len(facts.accuracy.place_m) == 2
        else:
            assert up == pytest.approx(SURVEY_OFF[2], abs=0.5)
            assert "too few control points" not in said


def test_check_points_measure_a_model_that_gps_placed(made, flight, points, tmp_path):
    file = write_list(tmp_path / "gcp_list.txt", flight, points)
    facts, capture, _ = surveyed(made, flight, tmp_path, file, "all")
    assert facts.gcp_rmse_m("control") is None
    across, up = np.array(facts.gcp_rmse_m("check")[:2]), facts.gcp_rmse_m("check")[2]
    assert across == pytest.approx(np.abs(SURVEY_OFF[:2]), abs=0.3)
    assert up == pytest.approx(SURVEY_OFF[2], abs=2.5)  # straight down from one height, nothing else tells the depth
    assert max(facts.residual_rms_m) < 0.3  # it lies where GPS says
    known = load_capture(made)
    for view, before in zip(capture.views, known.views, strict=True):
        assert np.allclose(view.camera.camera_from_world, before.camera.camera_from_world, atol=1e-6)


def test_a_point_that_does_not_fit_and_marks_that_are_wrong_are_named(made, flight, points, tmp_path):
    moved = [dict(seen) for seen in points]
    moved[2][-1] = moved[2][-1] + [0, 6.0, 0]
    first = next(k for k in moved[0] if k >= 0)
    moved[0][first] = np.clip(moved[0][first] + [60, 0], 0, [WIDTH, HEIGHT])
    facts, _, said = surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, moved))
    assert "the control point gate does not fit the others" in said
    assert "the surveyed point north_west is marked" in said
    assert max(facts.gcp_rmse_m("control")) < 0.4
    off = {each.name: each.residual_m for each in facts.survey}["gate"]
    assert off == pytest.approx((0, -6, 0), abs=0.6)
    assert pytest.approx(facts.height_m, abs=4) == ALTITUDE_M


@pytest.mark.parametrize(("spread", "held"), [(incremental_mapper.MIN_HEIGHT_SPREAD, True), (0.0, False)])
def test_a_focal_length_that_altitudes_leave_open_is_fitted_where_the_model_shows_several_heights(
    made, monkeypatch, spread, held
):
    model = pycolmap.Reconstruction(made / "mapped")
    before = [camera.params.copy() for camera in model.cameras.values()]
    monkeypatch.setattr(incremental_mapper, "MIN_HEIGHT_SPREAD", spread)  # any height is another one
    found = incremental_mapper.release_focal([model], (True, incremental_mapper.OF_FLIGHTS), 1)
    assert found[0] is held
    after = [camera.params for camera in model.cameras.values()]
    assert np.array_equal(before, after) is held
    assert incremental_mapper.release_focal([model], (False, "asked for"), 1) == (False, "asked for")


@pytest.mark.parametrize("factor", [1.0, 0.6, 1.5])
def test_a_focal_length_that_one_tag_alone_says_is_given_up_where_photographs_contradict_it(made, factor):
    model = pycolmap.Reconstruction(made / "mapped")
    for camera in model.cameras.values():
        camera.focal_length *= factor
    held = pycolmap.BundleAdjustmentOptions()
    held.print_summary, held.refine_focal_length = False, False
    pycolmap.bundle_adjustment(model, held)  # what a mapper makes of it
    group = CameraGroup(
        camera="", width=0, height=0, focal_px=model.cameras[1].focal_length, has_focal_prior=True, source="",
        images=(), is_confirmed=False,
    )  # fmt: skip
    why, groups = (True, "one height"), [group]
    assert incremental_mapper.is_contradicted(model, why, groups, 1) is (factor != 1)
    assert model.cameras[1].focal_length == group.focal_px
    for not_asked in ((False, "fitted"), (True, incremental_mapper.ASKED)):
        assert not incremental_mapper.is_contradicted(model, not_asked, groups, 1)
    assert not incremental_mapper.is_contradicted(model, why, [replace(group, is_confirmed=True)], 1)


@pytest.mark.parametrize("flip", ["exchanged", "from the lower edge", "of half the size"])
def test_marks_that_are_read_wrongly_are_refused_and_the_capture_stays(made, flight, points, tmp_path, flip):
    def wrong(pixel: np.ndarray) -> np.ndarray:
        if flip == "of half the size":
            return pixel / 2
        return pixel[::-1] if flip == "exchanged" else np.array([pixel[0], HEIGHT - pixel[1]])

    marked = [{k: p if k < 0 else wrong(p) for k, p in seen.items()} for seen in points]
    marked = [{k: p for k, p in seen.items() if k < 0 or p[1] <= HEIGHT} for seen in marked]
    with pytest.raises(
        CaptureError, match=r"px and py change places|py counts from the lower edge|photographs of another size"
    ):
        surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, marked))
    assert load_capture(tmp_path / "capture").ground.metric


def test_control_points_in_feet_or_with_x_and_y_exchanged_are_refused(made, flight, points, tmp_path):
    text = write_list(tmp_path / "gcp_list.txt", flight, points).read_text().splitlines()
    rows = [line.split() for line in text[3:]]
    feet = [[*row[:2], f"{float(row[2]) / 0.3048:.3f}", *row[3:]] for row in rows]
    (tmp_path / "feet.txt").write_text("\n".join([text[0], *(" ".join(row) for row in feet)]))
    with pytest.raises(CaptureError, match="feet"):
        surveyed(made, flight, tmp_path, tmp_path / "feet.txt")
    mirrored = [{k: (p[[1, 0, 2]] if k < 0 else p) for k, p in seen.items()} for seen in points]
    with pytest.raises(CaptureError, match=r"x \(east\) and y \(north\) exchanged"):
        surveyed(made, flight, tmp_path, write_list(tmp_path / "gcp_list.txt", flight, mirrored))
