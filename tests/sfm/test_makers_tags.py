"""Tags as makers and programs write them: whose angles, which crop, what a structure is about."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from support.flights import write_photograph
from vdgs.captures.xmp_packets import MAX_XMP_BYTES
from vdgs.sfm.console_report import print_preflight
from vdgs.sfm.cross_checks import cross_checked
from vdgs.sfm.exif_gps import read_altitude, read_place
from vdgs.sfm.focal_length import CALIBRATED_SOURCE, EQUIVALENT, SENSOR, read_lens
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import (
    ImageMetadata,
    attitude_from_aircraft,
    attitude_from_gimbal,
    likeliest_attitude,
    read_attitudes,
    read_image_metadata,
)
from vdgs.sfm.preflight import make_preflight_report
from vdgs.sfm.xmp import read_xmp

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


def photograph(folder: Path, number: int, xmp: str, model: str = "Drone") -> ImageMetadata:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"p{number:02d}.jpg"
    place = np.array((10.0 * number, 0, 40))
    write_photograph(file, np.roll(NOISE, number, axis=0), number, place, xmp=xmp, model=model)
    return read_image_metadata(file, file.name)


def packet(attributes: str, elements: str = "") -> dict[str, str]:
    return read_xmp(f"<rdf:Description {attributes}>{elements}</rdf:Description>".encode())


def by_pix4d(yaw: float, pitch: float, roll: float) -> str:
    return f'Camera:Yaw="{yaw}" Camera:Pitch="{pitch}" Camera:Roll="{roll}"'


def angle_between(one, other) -> float:
    turn = one.camera_from_enu @ other.camera_from_enu.T
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


# --------------------------------------------------------------------------------------------------- attitudes


@pytest.mark.parametrize(
    "angles",
    [
        pytest.param((-146.946594, 13.811229, -6.93262), id="senseFly S.O.D.A., eBee X"),
        pytest.param((62.1, 13.9, 3.7), id="Delair UX11"),
        pytest.param((30.0, 0.0, 38.0), id="S.O.D.A. 3D, to the side"),
        pytest.param((120.0, 60.0, 20.0), id="oblique"),
    ],
)
def test_angles_under_pix4ds_names_are_those_of_a_body_that_looks_down(angles):
    """Pix4D's article 202558969: a rotation by yaw about down, then pitch about the wing, then roll about the nose."""
    y, p, r = np.radians(angles)
    ned_from_body = (
        np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
        @ np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
        @ np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    )
    camera_in_body = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # right, down, forward: top is the nose
    readings, said = read_attitudes(packet(by_pix4d(*angles)))
    attitude = likeliest_attitude(readings)
    assert attitude is not None
    assert said == ""
    ned = attitude.camera_from_enu @ np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert ned == pytest.approx(camera_in_body @ ned_from_body.T, abs=1e-9)
    assert attitude.tilt_deg == pytest.approx(np.degrees(np.arccos(np.cos(p) * np.cos(r))))


@pytest.mark.parametrize(
    ("pitches", "model", "gimbal"),
    [
        pytest.param((-25, -60, -10), "Drone", True, id="facades from above, some steep"),
        pytest.param((-60, -45, 8), "Drone", True, id="one looks up"),
        pytest.param((-20, -10, -25), "XL715", True, id="Autel's EVO Lite, facades alone"),
        pytest.param((-20, -10, -25), "Drone", False, id="a body, nose down"),
        pytest.param((8, 12, -4, -35, 10), "Drone", False, id="a wing, one in a gust"),
        pytest.param((45, 60, 0), "Drone", False, id="Pix4D's, oblique"),
    ],
)
def test_whose_angles_stand_under_pix4ds_names_is_one_for_a_camera(tmp_path, pitches, model, gimbal):
    seen = [photograph(tmp_path, k, by_pix4d(30 + k, pitch, 2), model) for k, pitch in enumerate(pitches)]
    read = attitude_from_gimbal if gimbal else attitude_from_aircraft
    for k, photo in enumerate(cross_checked(seen)):
        assert angle_between(photo.attitude, read(30 + k, pitches[k], 2)) < 1e-3


@pytest.mark.parametrize(
    ("attributes", "elements", "expected"),
    [
        pytest.param(
            'drone-yuneec:DroneYaw="93.94" drone-yuneec:GimbalYaw="92.68" drone-yuneec:GimbalPitch="-13.74000" '
            'drone-yuneec:GimbalRoll="0.000000"', "", attitude_from_gimbal(92.68, -13.74, 0), id="Yuneec C23, E90",
        ),
        pytest.param(
            "", "<xmp:CameraYaw>-85.58</xmp:CameraYaw><xmp:CameraPitch>-13.9</xmp:CameraPitch>"
            "<xmp:CameraRoll>0.0028</xmp:CameraRoll>", attitude_from_gimbal(-85.58, -13.9, 0.0028), id="Yuneec CGO3+",
        ),
        pytest.param(
            'sensefly:Yaw="189.428" sensefly:Pitch="12.5908" sensefly:Roll="-3.384"', "",
            attitude_from_aircraft(189.428, 12.5908, -3.384), id="senseFly thermoMAP",
        ),
    ],
)  # fmt: skip
def test_attitudes_under_rarer_names(attributes, elements, expected):
    readings, said = read_attitudes(packet(attributes, elements))
    attitude = likeliest_attitude(readings)
    assert said == ""
    assert attitude is not None
    assert angle_between(attitude, expected) < 1e-3


@pytest.mark.parametrize(
    ("attributes", "height"),
    [
        ('drone-yuneec:GPSAltitude="201.02" drone-yuneec:AboveHomeAltitude="69.84"', 69.84),
        ('FLIR:MAVRelativeAltitude="69500/1000"', 69.5),
        ('FLIR:MAVRelativeAltitude="0/1000"', 0.0),
        ('Camera:AboveGroundAltitude="69.5"', None),  # over the ground below, not over the take-off
    ],
)
def test_heights_over_the_take_off_under_rarer_names(tmp_path, attributes, height):
    assert photograph(tmp_path, 1, attributes).relative_altitude == height


# -------------------------------------------------------------------------------------------------- structures

SHOWN = (
    "<Iptc4xmpExt:{0}><rdf:Bag><rdf:li rdf:parseType='Resource'><exif:GPSLatitude>47,23.5N</exif:GPSLatitude>"
    "<exif:GPSLongitude>8,32.1E</exif:GPSLongitude><exif:GPSAltitude>9/1</exif:GPSAltitude></rdf:li></rdf:Bag>"
    "</Iptc4xmpExt:{0}>"
)


@pytest.mark.parametrize("name", ["LocationShown", "LocationCreated"])
def test_the_place_of_what_is_shown_is_not_the_cameras(name):
    inside = SHOWN.format(name)
    gps = {1: "N", 2: (47.0, 18.0, 0.0), 3: "E", 4: (8.0, 30.0, 0.0)}
    assert read_place(gps, packet("", inside)) == (pytest.approx((47.3, 8.5)), "")
    assert read_place({}, packet("", inside)) == (None, "")
    assert read_altitude({}, packet("", inside))[0] is None
    as_attributes = f"<Iptc4xmpExt:{name} exif:GPSLatitude='47,23.5N' exif:GPSLongitude='8,32.1E'/>"
    behind = "<exif:GPSLatitude>47,18N</exif:GPSLatitude><exif:GPSLongitude>8,30E</exif:GPSLongitude>"
    for structure in (inside, as_attributes):
        assert read_place({}, packet("", structure + behind))[0] == pytest.approx((47.3, 8.5))


def test_tags_of_the_files_that_a_picture_was_made_of_are_not_its_own():
    pantry = (
        "<xmpMM:Pantry><rdf:Bag><rdf:li><rdf:Description drone-dji:GimbalPitchDegree='-30' "
        "drone-dji:GimbalYawDegree='5'/></rdf:li></rdf:Bag></xmpMM:Pantry>"
    )
    assert read_attitudes(packet("", pantry)) == ({}, "")
    assert packet("", "<crs:CropTop>0</crs:CropTop><xmpMM:Pantry><a:b>") == {"crs:CropTop": "0"}  # cut off


@pytest.mark.parametrize("cut_off", ["<xmpMM:DerivedFrom stRef:filePath='D:/a/b.dng'", "<crs:Look crs:Name='a/b'/"])
def test_a_packet_that_is_cut_off_in_a_structure_has_what_is_before_it(cut_off):
    """As all are that are longer than what is looked at, wherever that ends. The second "/" from the end is not that
    of an element without content."""
    head = "<x:xmpmeta><rdf:Description drone-dji:GimbalYawDegree='1'>"
    for end in range(len(cut_off) + 1):
        assert read_xmp((head + cut_off[:end]).encode())["drone-dji:GimbalYawDegree"] == "1"


def test_many_structures_without_content_take_no_longer_than_their_bytes():
    """None has an end tag: a search for each to the end of the packet takes seconds, not hundredths of one."""
    start = time.process_time()
    assert read_xmp(b"<a:History/>" * (MAX_XMP_BYTES // 13 - 9) + b"<crs:CropTop>0</crs:CropTop>") == {
        "crs:CropTop": "0"
    }
    assert time.process_time() - start < 0.5


SKYDIO = (
    "<s:CalibratedFocalLength rdf:parseType='Resource'><s:X>3000.0</s:X><s:Y>2990.0</s:Y></s:CalibratedFocalLength>"
    "<s:CalibratedOpticalCenter rdf:parseType='Resource'><s:X>2000.0</s:X><s:Y>1500.0</s:Y></s:CalibratedOpticalCenter>"
    "<s:DewarpData>-0.01,0.002,0.0001</s:DewarpData><s:VertCS>ellipsoidal</s:VertCS>"
    "<s:AbsoluteAltitude>400.0</s:AbsoluteAltitude>"
)


@pytest.mark.parametrize("size", [(4000, 3000), (1000, 750)])
def test_skydios_calibration_is_a_structure_and_its_heights_are_over_the_ellipsoid(size):
    xmp = packet("", SKYDIO)
    lens = read_lens({}, {}, xmp, *size)
    assert lens is not None
    assert (lens.focal, lens.source, lens.doubt) == (pytest.approx(0.75), CALIBRATED_SOURCE, "")
    assert read_altitude({5: b"\0", 6: 400.0}, xmp) == (400.0, "ellipsoidal as recorded")


@pytest.mark.parametrize("factor", [1.0, 0.95, 0.92, 0.86, 0.81, 0.75, 0.5])
@pytest.mark.parametrize("rewritten", [False, True])
@pytest.mark.parametrize(
    ("model", "details", "whole", "focal_px", "center"),
    [
        pytest.param("M3E", {0x920A: 12.29, 0xA405: 24}, (5280, 3956), 3713, (2640, 1978), id="M3E"),
        pytest.param("M3E", {}, (5280, 3956), 3713, (2640, 1978), id="and no equivalent"),
        pytest.param("M3E", {0x920A: 12.29, 0xA405: 24}, (5280, 3956), 3713, (2640,), id="and no row"),
        pytest.param("FC330", {0x920A: 3.61, 0xA405: 20}, (4000, 3000), 2344, (2000,), id="P4"),
        pytest.param("FC6310", {0x920A: 8.8, 0xA405: 24}, (4864, 3648), 3666, (2432, 1824), id="P4P, 4 x 3"),
        pytest.param("FC6310", {0x920A: 8.8, 0xA405: 24}, (4864, 3648), 3666, (2736, 1824), id="of the sensor"),
    ],
)  # fmt: skip
def test_a_calibration_is_of_the_pixels_that_its_center_lies_amid(
    model, details, whole, focal_px, center, rewritten, factor
):
    """Of photographs that were shrunk by little, too, with EXIF's size rewritten or not."""
    width, height = (round(factor * side) for side in whole)
    size = dict(zip((0xA002, 0xA003), (width, height) if rewritten else whole, strict=True))
    axes = "".join(f'd:CalibratedOpticalCenter{a}="{each}" ' for a, each in zip("XY", center, strict=False))
    xmp = packet(f'd:CalibratedFocalLength="{focal_px}" {axes}')
    lens = read_lens({0x0110: model}, {**details, **size}, xmp, width, height)
    assert lens is not None
    assert lens.focal == pytest.approx(focal_px / whole[0], rel=1e-3)


@pytest.mark.parametrize(("center", "factor"), [("6.6,4.4", 1.0), ("6.6,4.4", 0.85), ("6.73,4.33", 1.0), ("0,0", 1.0)])
def test_a_density_of_pixels_yields_to_pix4ds_principal_point_where_the_photograph_was_shrunk(center, factor):
    width, height = round(5472 * factor), round(3648 * factor)
    details = {0x920A: 8.8, 0xA002: width, 0xA003: height, 0xA20E: 5472 / 13.2, 0xA210: 4}
    xmp = packet(f'Camera:PerspectiveFocalLength="8.8" Camera:PrincipalPoint="{center}"')
    lens = read_lens({}, {**details, 0x920A: 0}, xmp, width, height)
    assert lens is not None
    assert lens.focal == pytest.approx(8.8 / 13.2, rel=1e-3)


def test_heights_of_a_named_geoid():
    assert read_altitude({5: b"\0", 6: 400.0}, packet('CRSInfo:VERTCRS="EGM96"')) == (400.0, "EGM96 as recorded")


# ----------------------------------------------------------------------------------------------------- accuracy


@pytest.mark.parametrize(
    ("attributes", "std", "words"),
    [
        ('Camera:GPSXYAccuracy="0.025" Camera:GPSZAccuracy="0.04"', 0.025, "3 say how accurate they are (RTK)"),
        ('Camera:GPSXYAccuracy="5.0" Camera:GPSZAccuracy="10.0"', 5.0, "3 say how accurate they are\n"),
        ('sensefly:GPSXYAccuracy="5.367" sensefly:GPSZAccuracy="3.978"', 5.367, "3 say how accurate they are\n"),
        ('s:GpsHorizontalAccuracy="0.21" s:GpsVerticalAccuracy="0.42"', 0.21, "3 say how accurate they are\n"),
        ('Camera:GPSXYAccuracy="4294967.5" Camera:GPSZAccuracy="3750005.75"', None, "not stated\n"),
    ],
)
def test_stated_accuracies_and_which_are_those_of_rtk(tmp_path, attributes, std, words):
    for k in range(3):
        found = photograph(tmp_path, k, attributes)
        assert found.gps_std is None if std is None else found.gps_std[:2] == (std, std)
    kept = collect_images([tmp_path])
    console = Console(width=300, record=True, file=io.StringIO())
    print_preflight(make_preflight_report(kept, read_gps_priors(kept.images, None, (1.0, 2.0))), kept, [], console)
    assert words in "".join(f"{line.rstrip()}\n" for line in console.export_text().splitlines())


# --------------------------------------------------------------------------------------------------------- lens


def crop(left: float, right: float, top: float, bottom: float, angle: float = 0.0, applied: str = "True") -> str:
    return (
        f'crs:HasCrop="True" crs:CropLeft="{left}" crs:CropRight="{right}" crs:CropTop="{top}" '
        f'crs:CropBottom="{bottom}" crs:CropAngle="{angle}" crs:AlreadyApplied="{applied}" '
    )


#: A Phantom 4 Pro, whole: 5472 x 3648 px, 13.2 mm.
P4P = {0x0110: "FC6310"}
WHOLE_PX = 8.8 / 13.2 * 5472
CALIBRATED = 'drone-dji:CalibratedFocalLength="3648" drone-dji:CalibratedOpticalCenterX="2736" '
ALIKE, ASKEW = (0.15, 0.85, 0.15, 0.85), (0.2, 0.8, 0.1, 0.9)


@pytest.mark.parametrize("calibration", ["", CALIBRATED])
@pytest.mark.parametrize(
    ("stated", "size", "shrunk", "left"),
    [
        pytest.param(crop(*ALIKE), (3830, 2554), 1, True, id="cropped alike"),
        pytest.param(crop(*ALIKE), (1915, 1277), 2, True, id="and shrunk"),
        pytest.param(crop(*ASKEW), (3283, 2918), 1, True, id="to another shape"),
        pytest.param(crop(*ASKEW, applied="False"), (3283, 2918), 1, True, id="by its shape"),
        pytest.param(crop(0.35, 0.65, 0, 1), (1642, 3648), 1, True, id="upright"),
        pytest.param(crop(*ALIKE, applied="False"), (5472, 3648), 1, False, id="not applied"),
        pytest.param(crop(*ASKEW, applied="False"), (5472, 3648), 1, False, id="another shape, not applied"),
        pytest.param(crop(0, 1, 0, 1), (5472, 3648), 1, False, id="of nothing"),
        pytest.param(crop(*ALIKE).replace("True", "False", 1), (5472, 3648), 1, False, id="none"),
    ],
)
def test_a_crop_that_a_program_exported_leaves_the_focal_length_in_pixels(calibration, stated, size, shrunk, left):
    """Lightroom writes the size of what it exports into EXIF, and keeps all that is said of the lens."""
    details = {0x920A: 8.8, 0xA405: 24, 0xA002: size[0], 0xA003: size[1]}
    lens = read_lens(P4P, details, packet(stated + calibration), *size)
    assert lens is not None
    assert shrunk * lens.focal * max(size) == pytest.approx(WHOLE_PX, rel=5e-3)
    assert ("cropped by a program" in lens.remark) is left
    assert lens.doubt == ""


def test_a_crop_that_was_turned_is_a_rectangle_between_two_corners():
    turn, (wide, high) = np.radians(5.0), (3000, 2000)
    across = (wide * np.cos(turn) - high * np.sin(turn)) / 5472
    down = (wide * np.sin(turn) + high * np.cos(turn)) / 3648
    stated = crop(0.5 - across / 2, 0.5 + across / 2, 0.5 - down / 2, 0.5 + down / 2, 5.0)
    lens = read_lens({}, {0xA405: 24, 0xA002: wide, 0xA003: high}, packet(stated), wide, high)
    assert lens is not None
    assert lens.focal * wide == pytest.approx(24 / np.hypot(36, 24) * np.hypot(5472, 3648), rel=5e-3)


def test_a_crop_that_contradicts_the_size_is_doubted_unless_the_picture_is_whole():
    xmp = packet(crop(*ASKEW))
    lens = read_lens(P4P, {0x920A: 8.8, 0xA405: 24}, xmp, 3000, 1000)
    assert lens is not None
    assert "cropped by a program, but not as XMP says (crs:HasCrop: 60% of the width" in lens.doubt
    whole = read_lens(P4P, {0x920A: 8.8, 0xA405: 24}, packet(crop(*ASKEW) + CALIBRATED), 5472, 3648)
    assert whole is not None
    assert whole.doubt + whole.remark == ""


@pytest.mark.parametrize(
    ("stated", "size", "beside"),
    [
        pytest.param(crop(0, 0.5, 0, 0.5), (2736, 1824), "by 60% of", id="upper left"),
        pytest.param(crop(0.41, 0.71, 0, 1), (1642, 3648), "by 9% of", id="upright"),
        pytest.param(crop(0.1, 0.9, 0, 0.8), (4378, 2918), "by 8% of", id="upper"),
        pytest.param(crop(0.26, 0.76, 0.25, 0.75), (2736, 1824), "by 2% of", id="by 55 px of 2736"),
        pytest.param(crop(0.252, 0.752, 0.252, 0.752), (2736, 1824), "", id="by 13 px of 2736"),
        pytest.param(crop(0, 0.5, 0, 0.5, applied="False"), (5472, 3648), "", id="not applied"),
    ],
)
def test_a_focal_length_is_not_held_where_a_crop_lies_beside_the_middle(stated, size, beside):
    """The view meets the middle of the whole: of a crop that is beside it, another pixel than the middle one, which is
    the one that is assumed."""
    details = {0x920A: 8.8, 0xA405: 24, 0xA002: size[0], 0xA003: size[1]}
    lens = read_lens(P4P, details, packet(stated), *size)
    assert lens is not None
    assert lens.focal * max(size) == pytest.approx(WHOLE_PX, rel=5e-3)
    assert lens.doubt.startswith("cropped beside the middle") is bool(beside)
    assert beside in lens.doubt
    assert lens.remark.startswith("cropped by a program") is (size[0] < 5472)


@pytest.mark.parametrize(
    ("changes", "focal", "source", "doubted"),
    [
        pytest.param({}, 13 / 10.88, SENSOR, True, id="FLIR's Duo Pro R: the width in mm"),
        pytest.param({0xA20F: None}, 13 / 10.88, SENSOR, True, id="the width alone"),
        pytest.param({0xA405: 43}, 13 / 10.88, SENSOR, False, id="confirmed"),
        pytest.param({0xA20F: 10.88}, 13 / 58.82, SENSOR, True, id="a density, of huge pixels"),
        pytest.param({0xA20E: 58.82, 0xA20F: 58.82}, 13 / 10.88, SENSOR, False, id="a density"),
        pytest.param({0xA210: 2, 0xA405: 43}, 1.273, EQUIVALENT, False, id="inches"),
    ],
)
def test_a_density_of_pixels_that_no_sensor_has_is_not_held(changes, focal, source, doubted):
    lens = read_lens({}, {0x920A: 13.0, 0xA20E: 10.88, 0xA20F: 8.704, 0xA210: 4} | changes, {}, 640, 512)
    assert lens is not None
    assert (lens.focal, lens.source) == (pytest.approx(focal, rel=1e-3), source)
    assert bool(lens.doubt) is doubted
    assert ("which no sensor has" in lens.doubt) is doubted
