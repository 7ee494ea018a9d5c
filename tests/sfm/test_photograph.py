"""What photographs say of themselves, which are used, and what is made of their positions."""

from __future__ import annotations

import random
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.flights import FOCAL, FOCAL_MM, ORIGIN, SENSOR_MM, WIDTH, add_xmp, write_photograph
from vdgs.captures.reconstruction import CameraReport, excluded_lines
from vdgs.captures.xmp_packets import MAX_XMP_BYTES
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.sfm import georeferencing, georegistration
from vdgs.sfm.focal_decision import OF_HEIGHTS, TAGS_DISAGREE, should_fix_focal
from vdgs.sfm.focal_length import CALIBRATED_SOURCE, Lens, read_lens
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images, is_image_folder
from vdgs.sfm.image_metadata import (
    ImageMetadata,
    UnusableImage,
    attitude_from_gimbal,
    read_image_metadata,
)
from vdgs.sfm.preflight import make_preflight_report
from vdgs.sfm.reconstruction_plan import plan_reconstruction
from vdgs.sfm.reconstruction_report import _lens_warnings, _photographs, _warnings
from vdgs.sfm.up_direction import tilt_from_attitudes
from vdgs.sfm.xmp import first_number, read_xmp

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
PIX4D_PIXELS = {"Camera:PerspectiveFocalLength": "2800", "Camera:PerspectiveFocalLengthUnits": "pixel"}


def photograph(folder: Path, number: int, enu: tuple[float, float, float] | None = (0, 0, 40), **more) -> ImageMetadata:
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.roll(NOISE, number, axis=0)
    write_photograph(folder / f"p{number:02d}.jpg", pixels, number, None if enu is None else np.array(enu), **more)
    return read_image_metadata(folder / f"p{number:02d}.jpg", f"p{number:02d}.jpg")


def flight(folder: Path, count: int = 6) -> list[ImageMetadata]:
    return [photograph(folder, k, (10.0 * (k % 3), 12.0 * (k // 3), 40.0 + k % 2)) for k in range(count)]


def positions_of(photographs):
    return read_gps_priors(photographs, None, (1.0, 2.0))


# --------------------------------------------------------------------------------------------------- reading


def test_a_photograph_says_where_it_was_taken_and_through_what(tmp_path):
    seen = photograph(tmp_path, 1, (30.0, -20.0, 41.5))
    truth = geodetic_from_enu(np.array([[30.0, -20.0, 41.5]]), ORIGIN)[0]
    assert seen.lat_lon == pytest.approx(truth[:2], abs=1e-8)  # south and west
    assert seen.altitude == pytest.approx(truth[2], abs=1e-3)
    assert (seen.width, seen.height, seen.relative_altitude) == (160, 120, 41.5)
    assert seen.lens is not None
    assert seen.lens.focal == pytest.approx(FOCAL_MM / SENSOR_MM)  # though EXIF's sizes are those of the original
    assert pytest.approx(FOCAL / WIDTH) == seen.lens.focal
    assert seen.attitude is not None
    assert seen.attitude.tilt_deg == pytest.approx(0, abs=1e-6)


def test_altitudes_below_the_sea_are_below_it(tmp_path):
    assert photograph(tmp_path, 1, (0, 0, -620.0)).altitude == pytest.approx(-120, abs=1e-3)


def test_orientation_swaps_the_sides_and_what_the_drone_says_of_them(tmp_path):
    turned = photograph(tmp_path, 1, orientation=6)
    assert (turned.width, turned.height, turned.attitude) == (120, 160, None)
    upright = photograph(tmp_path / "upright", 1)
    assert turned.lens == upright.lens  # of the longer side


def test_rtk_says_how_accurate_it_is(tmp_path):
    pix4d = (
        'Camera:GPSXYAccuracy="0.02" Camera:GPSZAccuracy="0.04" Camera:VertCS="ellipsoidal" Camera:ModelType="fisheye"'
    )
    seen = [photograph(tmp_path, k, (9.0 * k, 0, 40), xmp=pix4d) for k in range(3)]
    assert positions_of(seen).gps_std[0] == pytest.approx([0.02, 0.02, 0.04])
    assert (seen[0].altitude_type, seen[0].camera_model) == ("ellipsoidal as recorded", "OPENCV_FISHEYE")
    xmp = 'drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015" drone-dji:RtkStdHgt="0.03"'
    seen = [photograph(tmp_path, k, (9.0 * k, 0, 40), xmp=xmp) for k in range(3)]
    assert positions_of(seen).gps_std[0] == pytest.approx([0.012, 0.015, 0.03])
    assert positions_of([replace(each, gps_std=None) for each in seen]).gps_std[0] == pytest.approx([1, 1, 2])
    for flag, std in ((50, [0.012, 0.015, 0.03]), (16, [1, 1, 2]), (0, [1, 1, 2])):
        seen = [photograph(tmp_path, k, (9.0 * k, 0, 40), xmp=f'{xmp} drone-dji:RtkFlag="{flag}"') for k in range(3)]
        assert positions_of(seen).gps_std[0] == pytest.approx(std)


def test_exif_says_how_accurate_a_phone_is_where_rtk_does_not(tmp_path):
    seen = [photograph(tmp_path, k, (9.0 * k, 0, 40), error_m=4.5) for k in range(3)]
    assert [each.gps_error_m for each in seen] == [4.5] * 3
    assert positions_of(seen).gps_std[0] == pytest.approx([4.5, 4.5, 9])
    better = [replace(each, gps_std=(0.02, 0.02, 0.04)) for each in seen]
    assert positions_of(better).gps_std[0] == pytest.approx([0.02, 0.02, 0.04])
    table = tmp_path / "gps.csv"
    table.write_text("name,lat,lon,alt\n" + "".join(f"p{k:02d},10.{k:04d},20,5\n" for k in range(3)))
    assert read_gps_priors(seen, table, (1.0, 2.0)).gps_std[0] == pytest.approx([1, 1, 2])
    for nothing in (0.0, 99_999.0):
        assert photograph(tmp_path, 5, (0, 0, 40), error_m=nothing).gps_error_m is None


@pytest.mark.parametrize("cut", [0, 10, 200, 3000, -2000])
def test_what_is_cut_off_is_named_and_nothing_else_is_raised(tmp_path, cut):
    photograph(tmp_path, 1)
    file = tmp_path / "p01.jpg"
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(UnusableImage, match="copy it again"):
        read_image_metadata(file, file.name)


def test_damaged_heads_are_read_or_refused(tmp_path):
    photograph(tmp_path, 1)
    whole, draw = (tmp_path / "p01.jpg").read_bytes(), random.Random(1)
    read = 0
    for _ in range(150):
        damaged = bytearray(whole)
        for _ in range(20):
            damaged[draw.randrange(800)] = draw.randrange(256)
        (tmp_path / "damaged.jpg").write_bytes(damaged)
        with suppress(UnusableImage):  # no other error comes
            read_image_metadata(tmp_path / "damaged.jpg", "damaged.jpg")
            read += 1
    assert 0 < read < 150


# ------------------------------------------------------------------------------------------------------- xmp


@given(st.binary(max_size=400))
def test_any_bytes_are_xmp_without_surprises(packet):
    assert isinstance(read_xmp(packet), dict)


def test_xmp_is_read_as_attributes_and_as_elements_and_expands_nothing():
    bomb = b'<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;">]><a:x y:Alt="&c;" y:Height=\'+39.80\'/>'
    bomb += b"<z:Roll>-2.5</z:Roll>"
    values = read_xmp(bomb)
    assert values["y:Alt"] == "&c;"
    assert (first_number(values, "y:Height"), first_number(values, "z:Roll"), first_number(values, "y:Alt")) == (
        39.8,
        -2.5,
        None,
    )
    assert read_xmp(b" " * MAX_XMP_BYTES + b' y:Height="1"') == {}
    assert first_number({"a:b": "nan", "a:c": "inf"}, "a:b", "a:c") is None


def test_an_enormous_packet_is_no_trouble(tmp_path):
    photograph(tmp_path, 1, None)
    add_xmp(tmp_path / "p01.jpg", b'y:A="1" ' * 8000)
    assert read_image_metadata(tmp_path / "p01.jpg", "p01.jpg").lat_lon is None


# ------------------------------------------------------------------------------------------------------ lens


@pytest.mark.parametrize(
    ("tags", "details", "xmp", "focal"),
    [
        pytest.param({0x0110: "FC300S\0\0"}, {0x920A: 3.61, 0xA405: 20}, {}, 0.585, id="a known sensor"),
        pytest.param({}, {0x920A: 4.3, 0xA20E: 16393.4, 0xA210: 2, 0xA002: 4000}, {}, 0.694, id="EXIF's sensor"),
        pytest.param({}, {0xA405: 20}, {}, 0.578, id="a 35 mm equivalent, of 4 x 3"),
        pytest.param(
            {}, {0xA405: 20, 0xA002: 4000}, {"drone-dji:DewarpData": "2020-01-01;2800.0,2801,1,2,0,0,0,0,0"}, 0.7,
            id="calibrated by the maker",
        ),
        pytest.param(
            {}, {0xA002: 4000}, {"Camera:FisheyeAffineMatrix": "4398.2,0,0,4398.2"}, 0.7, id="Pix4D's fisheye"
        ),
        pytest.param(
            {}, {}, {"Camera:PerspectiveFocalLength": "4.2", "Camera:PrincipalPoint": "3.0,2.2"}, 0.7, id="Pix4D"
        ),
        pytest.param({}, {0xA002: 4000}, PIX4D_PIXELS, 0.7, id="Pix4D in pixels"),
        pytest.param({}, {0x920A: float("nan"), 0xA405: 0}, {"drone-dji:DewarpData": "x;"}, None, id="nothing"),
    ],
)  # fmt: skip
def test_the_focal_length_is_the_best_that_is_known(tags, details, xmp, focal):
    for width, height in ((1600, 900), (900, 1600), (800, 450)):
        lens = read_lens(tags, details, xmp, width, height)
        assert (lens and lens.focal) == (focal and pytest.approx(focal, abs=1e-3))


@pytest.mark.parametrize(("width", "height"), [(5472, 3648), (4864, 3648), (5472, 3078), (3648, 4864), (2432, 1824)])
def test_a_sensor_of_the_table_is_used_as_far_as_the_shape_of_the_picture_needs_it(width, height):
    """The Phantom 4 Pro: 5472 x 3648 pixels on 13.2 mm, of which 4 x 3 takes 4864 and 16 x 9 all."""
    lens = read_lens({0x0110: "FC6310"}, {0x920A: 8.8}, {}, width, height)
    shrunk = 2 if max(width, height) == 2432 else 1
    assert shrunk * lens.focal * max(width, height) == pytest.approx(8.8 / 13.2 * 5472, rel=2e-3)


# ------------------------------------------------------------------------------------------------- positions


def turn(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    return np.asarray(pycolmap.Rotation3d(np.radians(degrees) * np.array(axis)).matrix())


@pytest.mark.parametrize(("tilt", "askew", "headings", "said"), [
    (0.0, 6.0, (0, 90, 180, 270), 0.0),  # a camera that hangs askew makes no tilted model
    (4.0, 6.0, (0, 90, 180, 270), 4.0),
    (4.0, 0.0, (10, 190), 4.0),
    (4.0, 0.0, (30,), 4.0),  # flown in one direction all is taken for a tilt
])  # fmt: skip
def test_a_tilted_model_is_told_from_a_camera_that_hangs_askew(tmp_path, tilt, askew, headings, said):
    """Recorded attitudes do not know how the camera hangs; the model does, and may lie askew itself."""
    model, photographs = pycolmap.Reconstruction(), []
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[100, 100, 80, 60], camera_id=1)
    )
    for k, heading in enumerate(headings * (6 // len(headings) + 1)):
        photo = replace(photograph(tmp_path, k), attitude=attitude_from_gimbal(heading, -90 + k % 3, 0))
        photographs.append(photo)
        truth = turn((0, 1, 0), askew) @ photo.attitude.camera_from_enu
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(truth @ turn((1, 0, 0), tilt)), np.zeros(3))
        model.add_image_with_trivial_frame(pycolmap.Image(name=photo.name, camera_id=1, image_id=k + 1), pose)
    assert tilt_from_attitudes(model, photographs) == pytest.approx(said, abs=0.25)


def test_positions_that_cannot_be_are_left_out_and_named(tmp_path):
    seen = flight(tmp_path)
    seen[1] = replace(seen[1], lat_lon=(0.0, 0.0))
    seen[2] = replace(seen[2], lat_lon=(ORIGIN[0] + 1, ORIGIN[1]))
    seen[3] = replace(seen[3], altitude=None)
    found = positions_of(seen)
    assert found.image_indices.tolist() == [0, 4, 5]
    for name, said in (("p01", "0, 0"), ("p02", "far from all others"), ("p03", "no altitude")):
        assert any(name in note and said in note for note in found.notes), found.notes


def test_a_road_and_another_site_are_no_strays_but_a_place_where_a_receiver_stuck_is(tmp_path):
    """A block of 300 m, and from it 6 km of road or a site 5 km off; or a dozen photographs that all say one place."""
    one = replace(photograph(tmp_path, 0), altitude=500.0)
    block = np.array([[30.0 * (k % 10), 30.0 * (k // 10), 0] for k in range(100)])
    road = np.array([[300 + 80.0 * k, 0, 0] for k in range(75)])
    for more, used, apart in (
        (road, 175, []),
        (block[:40] + np.array([5000, 0, 0]), 140, ["the 140 positions lie in 2 places, 5.28 km across (100 in the"]),
        (np.full((12, 3), [5000.0, 0, 0]), 100, []),
    ):
        places = geodetic_from_enu(np.concatenate([block, more]), ORIGIN)
        seen = [replace(one, name=f"{k:03}.jpg", lat_lon=tuple(place[:2])) for k, place in enumerate(places)]
        found = positions_of(seen)
        assert len(found) == used
        assert [note.partition(" largest")[0] for note in found.notes if "places" in note] == apart


def test_positions_at_one_place_say_nothing(tmp_path):
    found = positions_of([photograph(tmp_path, k) for k in range(4)])
    assert not found.usable
    assert any("within 2 m" in note for note in found.notes)


def test_a_table_of_positions_wins(tmp_path):
    seen = flight(tmp_path)
    table = tmp_path / "gps.csv"
    table.write_text("name,lat,lon,alt\n" + "".join(f"p{k:02d},10.{k:04d},20,5\n" for k in range(4)))
    found = read_gps_priors(seen, table, (0.5, 0.7))
    assert (len(found), found.source, found.origin[1]) == (4, "gps.csv", 20)
    assert found.gps_std[0] == pytest.approx([0.5, 0.5, 0.7])


@pytest.mark.parametrize(
    ("options", "std", "stated"),
    [(SfmOptions(gps_std_m=(0.5, 0.7)), [0.5, 0.5, 0.7], True), (SfmOptions(), [1.0, 1.0, 2.0], False)],
)
def test_the_accuracy_that_is_asked_for_is_that_of_a_table_and_counts_as_stated(
    tmp_path, monkeypatch, options, std, stated
):
    (tmp_path / "card").mkdir()
    flight(tmp_path / "card")
    table, asked = tmp_path / "gps.csv", list[bool]()
    table.write_text("name,lat,lon,alt\n" + "".join(f"p{k:02d},10.{k:04d},20,5\n" for k in range(4)))
    plan = plan_reconstruction(
        SfmRequest(image_folders=(tmp_path / "card",), gps=table, output=tmp_path / "out", options=options)
    )
    np.testing.assert_allclose(plan.gps_priors.gps_std, [std] * 4)
    monkeypatch.setattr(georegistration, "georegister", lambda *given: asked.append(given[-1]))
    georeferencing._by_positions(None, plan)
    assert asked == [stated]


def test_a_long_corridor_has_no_outliers(tmp_path):
    seen = [photograph(tmp_path, k, (500.0 * k, 3.0 * k, 40.0)) for k in range(20)]
    assert len(positions_of(seen)) == 20


# ---------------------------------------------------------------------------------------------- collections


def test_what_is_not_used_is_named_with_its_reason(tmp_path):
    flight(tmp_path)
    (tmp_path / "notes.txt").write_text("a flight")
    (tmp_path / "copy.jpg").write_bytes((tmp_path / "p03.jpg").read_bytes())
    (tmp_path / "p04.png").write_bytes((tmp_path / "p04.jpg").read_bytes() + b"\0")
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "p02.jpg").read_bytes()[:4000])
    found = collect_images([tmp_path])
    reasons = {each.name: each.reason for each in found.excluded}
    assert "cut off" in reasons["cut.jpg"]
    assert "copy of p03.jpg" in reasons["copy.jpg"]
    assert "another ending" in reasons["p04.png"]
    assert (len(found.images), found.other_files) == (6, 1)


def test_what_is_left_out_is_called_by_its_own_name(tmp_path):
    """By that of the capture nobody finds the file; in the report of the finished capture neither."""
    flight(tmp_path)
    (tmp_path / "p00 again.jpg").write_bytes((tmp_path / "p00.jpg").read_bytes())
    found = collect_images([tmp_path])
    assert [each.line for each in found.excluded] == ["p00 again.jpg: is a copy of p00.jpg"]
    assert any("p00_again.jpg is 'p00 again.jpg'" in note for note in found.notes)
    photographs = _photographs(found, positions_of(found.images), None, ())
    assert excluded_lines(SimpleNamespace(photographs=photographs)) == [each.line for each in found.excluded]


@pytest.mark.parametrize(("tilt", "said"), [(2.0, True), (50.0, True), (88.0, False), (None, False)])
def test_the_height_over_the_median_point_is_compared_where_views_show_the_ground(tilt, said):
    """Of a facade that point is a wall's."""
    found = _warnings((), True, height=0.3, recorded=12.5, turned=1.0, tilt=tilt)
    assert bool(found) == said


@pytest.mark.parametrize(("height", "said"), [(9.0, True), (98.0, True), (15.0, False)])
def test_heights_by_control_points_that_differ_as_feet_do_are_asked_about(height, said):
    """Over a roof they may be right."""
    [note] = _warnings((), (True, ""), height, recorded=30.0, turned=None, tilt=5.0, surveyed="gcp.txt")
    assert ("gcp.txt: Are they in feet" in note) == said
    assert "feet" not in _warnings((), (True, ""), height, recorded=30.0, turned=None, tilt=5.0)[0]
    assert not _warnings((), (True, ""), height, recorded=30.0, turned=None, tilt=88.0, surveyed="gcp.txt")


@pytest.mark.parametrize(
    ("why", "recorded", "said", "held"),
    [
        ("", None, "if heights look wrong, hold it", True), ("", 45.3, "the tag seems to be wrong", False),
        ("", 38.5, "if heights look wrong, hold it", True), (TAGS_DISAGREE, None, "contradict each other", True),
        (TAGS_DISAGREE, 45.3, "the tag seems to be wrong", False),
    ],
)  # fmt: skip
def test_a_fitted_focal_length_that_the_flying_height_confirms_is_not_to_be_held(why, recorded, said, held):
    camera = CameraReport(
        name="DJI", photographs=12, width=400, height=300, focal_before_px=290.0, focal_source="EXIF",
        focal_after_px=339.0, radial_distortion=0.0,
    )  # fmt: skip
    note, *_ = _warnings([camera], (False, why), 45.1, recorded, None, 1.2)
    assert said in note
    assert ("--focal fixed" in note) is held


@pytest.mark.parametrize("recorded", [70.0, None])
def test_views_that_look_up_from_under_the_median_point_are_always_named(recorded):
    [found] = _warnings((), (True, ""), height=-250.0, recorded=recorded, turned=None, tilt=179.8)
    assert "250.0 m under the median point and look up (180° from straight down)" in found
    assert ("70.0 m over its take-off" in found) == (recorded is not None)
    assert not _warnings((), (True, ""), height=-3.0, recorded=5.0, turned=None, tilt=95.0)  # a facade


@pytest.mark.parametrize(
    ("lower", "others", "said"),
    [
        pytest.param(12.0, 0.6, "12.4 m lower", id="a wrong tag"),
        pytest.param(-12.0, 0.6, "11.6 m higher", id="the other way"),
        pytest.param(0.3, 0.6, "", id="a lens that zooms"),
        pytest.param(12.0, 1.0, "", id="one focal length"),
    ],
)
def test_a_focal_length_of_few_that_moves_them_is_named(tmp_path, lower, others, said):
    seen = [photograph(tmp_path, k, focal_mm=8.5 * (others if k < 2 else 1)) for k in range(8)]
    off = {photo.name: -lower * (k < 2) + 0.1 * k for k, photo in enumerate(seen)}
    words = f"the 2 photographs with a focal length of 82 px come out {said} than their positions say"
    assert [words in each for each in _lens_warnings(seen, off, 40.0)] == ([True] if said else [])


def test_photographs_of_one_name_are_told_apart_by_moment_and_place(tmp_path):
    """Names with other endings, and in other cases: both are used where both were taken."""
    flight(tmp_path)
    for name, other in (("p01.jpeg", "p02.jpg"), ("p03.png", "p03.jpg")):
        (tmp_path / name).write_bytes((tmp_path / other).read_bytes() + b"\0")
    for name, other in (("P05.jpg", "p04.jpg"), ("P00.jpg", "p00.jpg")):
        (tmp_path / name).write_bytes((tmp_path / other).read_bytes() + b"\0\0")
    if len(list(tmp_path.iterdir())) < 10:
        pytest.skip("this file system tells no cases apart")
    found = collect_images([tmp_path])
    reasons = {each.name: each.reason for each in found.excluded}
    assert sorted(reasons) == ["p00.jpg", "p03.png"]
    assert "name of p03.jpg with another ending" in reasons["p03.png"]
    assert "P00.jpg but for upper and lower case" in reasons["p00.jpg"]
    assert "rename" in reasons["p00.jpg"]
    assert {"p01.jpg", "p01.jpeg", "p05.jpg", "P05.jpg"} <= {photo.name for photo in found.images}


def test_links_to_what_is_not_there_are_said(tmp_path):
    flight(tmp_path / "disk", 5)
    links = tmp_path / "links"
    links.mkdir()
    for number, file in enumerate(sorted((tmp_path / "disk").iterdir())):
        (links / file.name).symlink_to(file if number < 3 else tmp_path / "unmounted" / file.name)
    (links / "DCIM").symlink_to(tmp_path / "unmounted/DCIM")
    (links / ".#p00.jpg").symlink_to("me@here.1234")  # an editor's lock
    found = collect_images([links])
    assert len(found.images) == 3
    (note,) = (note for note in found.notes if "not there" in note)
    assert note.startswith("left out 3 links to files that are not there (first DCIM, to")
    (links / "p00.jpg").unlink()
    with pytest.raises(CaptureError, match=r"2 photographs that can be used;[^$]*left out 3 links"):
        collect_images([links])
    for name in ("p01.jpg", "p02.jpg"):
        (links / name).unlink()
    assert is_image_folder(links)
    with pytest.raises(CaptureError, match=r"holds no photographs .*left out 3 links to files that are not there"):
        collect_images([links])


def test_folders_are_told_apart(tmp_path):
    for name, north in (("a/card", 0.0), ("b/card", 30.0)):
        for k in range(2):
            photograph(tmp_path / name, k, (10.0 * k, north, 40.0))
    found = collect_images([tmp_path / "a/card", tmp_path / "b/card"])
    assert [photo.name for photo in found.images] == [f"card_{n}/p0{k}.jpg" for n in (1, 2) for k in (0, 1)]


@pytest.mark.parametrize(
    ("fill", "said"),
    [
        (lambda folder: None, "no such folder"),
        (lambda folder: folder.mkdir(), "holds no photographs"),
        (lambda folder: photograph(folder, 1), "1 photograph that can be used; a scene needs 3"),
    ],
    ids=["missing", "empty", "one"],
)
def test_too_few_photographs_are_refused_with_words(tmp_path, fill, said):
    fill(tmp_path / "card")
    with pytest.raises(CaptureError, match=said):
        collect_images([tmp_path / "card"])


def test_outputs_among_photographs_are_refused(tmp_path):
    flight(tmp_path / "card")
    for output in ("card", "card/out"):
        with pytest.raises(VdgsError, match="among the photographs"):
            plan_reconstruction(SfmRequest(image_folders=(tmp_path / "card",), output=tmp_path / output))
    assert is_image_folder(tmp_path / "card")
    (tmp_path / "card/sparse").mkdir()
    assert not is_image_folder(tmp_path / "card")  # a capture that lacks something is told so


@pytest.mark.parametrize("output", ["full", "full/thesis.txt"])
def test_a_look_refuses_the_outputs_that_the_work_refuses(tmp_path, output):
    flight(tmp_path / "card")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("three years")
    with pytest.raises(VdgsError, match=r"holds other things|is a file"):
        plan_reconstruction(SfmRequest(image_folders=(tmp_path / "card",), output=tmp_path / output))


# -------------------------------------------------------------------------------------------- look and plan


def test_the_look_says_what_the_flight_is(tmp_path):
    seen = flight(tmp_path, 9)
    found = make_preflight_report(collect_images([tmp_path]), positions_of(seen))
    assert found.height_m == pytest.approx(40, abs=1)
    assert found.gsd_m == pytest.approx(found.height_m / (0.85 * 160))
    assert found.forward_overlap == pytest.approx(1 - 10 / (found.height_m / 0.85 * 0.75), abs=0.02)
    assert found.spread_m == pytest.approx((20, 24), abs=0.1)
    assert found.oblique == 0
    assert found.days == ["2026-06-01"]


def test_positions_of_few_photographs_tell_no_overlap(tmp_path):
    seen = flight(tmp_path, 9)
    some = [replace(photo, lat_lon=photo.lat_lon if k % 3 == 0 else None) for k, photo in enumerate(seen)]
    found = make_preflight_report(collect_images([tmp_path]), positions_of(some))
    assert found.positions == 3
    assert found.forward_overlap is found.views_per_point is None
    assert not any("overlap" in each or "is seen by" in each for each in found.warnings)


def test_other_days_and_small_files_are_remarked(tmp_path):
    seen = flight(tmp_path)
    kept = collect_images([tmp_path])
    other = replace(seen[0], datetime="2026:08:01 10:00:00", file_bytes=100)
    found = make_preflight_report(replace(kept, images=(other, *kept.images[1:])), positions_of(seen))
    assert any("taken on 2 days" in each for each in found.warnings)
    assert any("p00.jpg" in each and "smaller files" in each for each in found.warnings)


def test_the_focal_length_is_held_where_the_flight_cannot_tell_it(tmp_path):
    seen = flight(tmp_path)
    oblique = [replace(photo, attitude=attitude_from_gimbal(0, -50, 0)) for photo in seen]
    heights = [replace(photo, relative_altitude=30.0 + 20 * k) for k, photo in enumerate(seen)]
    unknown = [replace(photo, lens=None) for photo in seen]
    where = positions_of(seen)
    held = [should_fix_focal(each, where, SfmOptions())[0] for each in (seen, oblique, heights, unknown)]
    assert held == [True, False, True, False]  # parallel views tell it from no number of heights
    assert should_fix_focal(heights, where, SfmOptions())[1] == OF_HEIGHTS
    no_angles = [replace(photo, attitude=None) for photo in heights]
    assert not should_fix_focal(no_angles, where, SfmOptions())[0]
    strips = flight(tmp_path, 12)
    north_m = np.array([photo.lat_lon[0] for photo in strips]) * 111_000
    slope = [
        replace(photo, relative_altitude=40.0 + abs(m - north_m[0])) for photo, m in zip(strips, north_m, strict=True)
    ]
    assert np.ptp(north_m) > 30
    assert should_fix_focal(slope, where, SfmOptions())[1].startswith("one height over a slope")
    ascent = [
        replace(photo, relative_altitude=10.0 + 5 * k, lat_lon=(seen[0].lat_lon[0] + 1e-6 * k, seen[0].lat_lon[1]))
        for k, photo in enumerate(strips)
    ]
    assert should_fix_focal(ascent, where, SfmOptions()) == (True, OF_HEIGHTS)  # no slope is so steep
    assert should_fix_focal(oblique, where, SfmOptions(focal="fixed"))[0]


def circle(radius: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    return radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


def strips(count: int, each: int) -> np.ndarray:
    return np.array([(12.0 * k, 25.0 * strip, 60.0) for strip in range(count) for k in range(each)])


@pytest.mark.parametrize(
    ("places", "wrong_m", "held"),
    [
        pytest.param(strips(5, 8), 1.0, True, id="a survey"),
        pytest.param(strips(2, 20), 0.5, True, id="there and back"),
        pytest.param(strips(3, 3), 0.5, True, id="nine photographs"),
        pytest.param(strips(5, 8) + np.outer(np.arange(40) // 20, [0, 0, 48]), 1.0, True, id="another datum"),
        pytest.param(
            np.vstack([strips(5, 8), circle(9.0) + np.array([3e4, 0, 79])]), 1.0, True, id="a survey and another site"
        ),
        pytest.param(
            np.vstack([circle(30.0), strips(2, 8) + np.array([3e4, 0, 0])]), 0.5, False, id="a house and another site"
        ),
        pytest.param(strips(5, 8) * [400, 400, 40], 1.0, True, id="from high up, kilometres from one to the next"),
        pytest.param(strips(1, 20), 0.5, True, id="a line"),
        pytest.param(strips(1, 20) * [1, 1, 0] + np.outer(np.arange(20), [0, 0, 3]), 0.5, True, id="a climbing line"),
        pytest.param(strips(1, 20) / 10, 0.5, False, id="a row of steps"),
        pytest.param(circle(30.0), 0.5, False, id="around a house"),
        pytest.param(circle(30.0) * [1, 0.3, 1], 0.5, False, id="around a long house"),
        pytest.param(circle(1.5), 2.0, False, id="around a statue"),
        pytest.param(strips(5, 8)[:, [0, 2, 1]], 1.0, False, id="a facade"),
        pytest.param(strips(5, 8) * [1, 1, 0] + np.outer(np.arange(40) % 4, [0, 0, 15]), 1.0, False, id="heights"),
        pytest.param(None, 0.0, False, id="no positions"),
    ],
)
def test_without_attitudes_the_focal_length_is_held_where_positions_are_those_of_a_survey(
    tmp_path, places, wrong_m, held
):
    """Older drones and cameras on wings record nothing but positions; phones and hands record no more."""
    silent = replace(photograph(tmp_path, 0), attitude=None, relative_altitude=None)
    silent = replace(silent, lat_lon=None) if places is None else silent
    photographs = [silent] * (10 if places is None else len(places))
    where = positions_of(photographs)
    if places is not None:
        flights = (places[:, 2] // 40).astype(int) if np.ptp(places[:, 2]) == 48 else 0 * where.flights
        where = replace(where, flights=flights)
        enu = places + np.random.default_rng(3).normal(0, wrong_m, places.shape)
        where = replace(where, image_indices=np.arange(len(enu)), enu=enu, gps_std=np.tile([1.0, 1, 2], (len(enu), 1)))
    assert should_fix_focal(photographs, where, SfmOptions())[0] is held
    calibrated = [replace(photo, lens=Lens(0.7, CALIBRATED_SOURCE)) for photo in photographs]
    assert should_fix_focal(calibrated, where, SfmOptions())[0]
