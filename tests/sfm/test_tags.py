"""Tags of photographs that contradict each other, are defaults, or are written as few programs write them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from support.flights import add_xmp, write_photograph
from vdgs.captures.angles import degrees_of_parts, degrees_of_text
from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm.cross_checks import cross_checked, strays
from vdgs.sfm.exif_gps import read_altitude, read_altitudes, read_place
from vdgs.sfm.feature_extraction import group_by_camera
from vdgs.sfm.focal_decision import should_fix_focal
from vdgs.sfm.focal_length import AGREE, EQUIVALENT, SENSOR, read_lens
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import (
    DEFAULT_ANGLES,
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
R = IFDRational
SOUTH, WEST = -33.5, -70.6


def photograph(folder: Path, number: int, **more) -> ImageMetadata:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"p{number:02d}.jpg"
    write_photograph(file, np.roll(NOISE, number, axis=0), number, np.array((10.0 * number, 0, 40)), **more)
    return read_image_metadata(file, file.name)


def packet(attributes: str) -> dict[str, str]:
    return read_xmp(f"<rdf:Description {attributes}/>".encode())


# ------------------------------------------------------------------------------------------------------ places


@pytest.mark.parametrize(
    ("latitude", "side", "longitude", "other_side"),
    [
        pytest.param((R(33, 1), R(30, 1), R(0, 1)), "S", (R(70, 1), R(36, 1), R(0, 1)), "W", id="as it should be"),
        pytest.param((R(33, 1), R(30, 1)), "S", (R(70, 1), R(36, 1)), "W", id="degrees and minutes"),
        pytest.param((R(33, 1), R(30, 1), R(0, 0)), "S", (R(70, 1), R(36, 1), R(0, 0)), "W", id="seconds 0/0"),
        pytest.param(R(335, 10), "S", R(706, 10), "W", id="one rational"),
        pytest.param((R(335, 10),), "s\0", (R(706, 10),), "w\0", id="one in a list, small letters"),
        pytest.param((R(335, 10), R(0, 1), R(0, 1)), "South", (R(706, 10), R(0, 1), R(0, 1)), "West", id="words"),
        pytest.param((-33.5, 0.0, 0.0), "", (-70.6, 0.0, 0.0), "", id="signs"),
        pytest.param((-33.0, 30.0, 0.0), "S", (-70.0, 36.0, 0.0), "W", id="signs and references"),
        pytest.param("33.5", "S", "70.6", "W", id="text"),
        pytest.param("33,30,0S", "", "70,36.0W", "", id="text as in XMP"),
        pytest.param(b"33 30 0\0", b"S", b"70 36 0\0", b"W", id="bytes"),
        pytest.param("33\u00b030'0\" South", "", "70 deg 36' 0.00\" W", "", id="text as of exiftool"),
    ],
)
def test_places_are_read_in_every_way_that_programs_write_them(latitude, side, longitude, other_side):
    place, said = read_place({1: side, 2: latitude, 3: other_side, 4: longitude}, {})
    assert place == pytest.approx((SOUTH, WEST), abs=1e-9)
    assert said == ""


def test_xmp_says_what_exif_cuts_off_at_seconds():
    xmp = packet('drone-dji:GpsLatitude="-33.5000931" drone-dji:GpsLongtitude="-70.6001257"')
    for second, expected in ((0.0, (-33.5000931, -70.6001257)), (0.34, (-33.5 - 0.34 / 3600, WEST))):
        place, said = read_place({1: "S", 2: (33.0, 30.0, second), 3: "W", 4: (70.0, 36.0, 0.0)}, xmp)
        assert (place, said) == (pytest.approx(expected, abs=1e-9), "")


@pytest.mark.parametrize(
    ("gps", "said"),
    [
        ({1: "S", 2: (R(33, 1), R(0, 0), R(0, 0)), 3: "W", 4: (70.5, 0.0, 0.0)}, "not understood (latitude"),
        ({1: "S", 2: (R(0, 0), R(0, 0), R(0, 0)), 3: "W", 4: (70.0, 36.0, 0.0)}, "not understood (latitude"),
        ({1: "S", 2: (33.0, R(5, 0), 0.0), 3: "W", 4: (70.0, 36.0, 0.0)}, "not understood (latitude"),
        ({1: "S", 2: (33.0, 30.0, 0.0)}, "not understood (longitude missing)"),
        ({1: "S", 2: (133.0, 30.0, 0.0), 3: "W", 4: (70.0, 36.0, 0.0)}, "not understood (latitude"),
        ({1: "O", 2: (33.0, 30.0, 0.0), 3: "O", 4: (70.0, 36.0, 0.0)}, "not understood (latitude"),
        ({2: (33.0, 30.0, 0.0), 4: (70.0, 36.0, 0.0)}, "no hemisphere (latitude S or N, longitude W or E)"),
        ({1: "S", 2: (33.0, 30.0, 0.0), 4: (70.0, 36.0, 0.0)}, "no hemisphere (longitude W or E)"),
        ({1: "N", 2: (-33.5, 0.0, 0.0), 3: "W", 4: (-70.6, 0.0, 0.0)}, "not understood (latitude -33.5 0.0 0.0 N)"),
        ({1: "S", 2: "33.5", 3: "E", 4: "-70.6"}, "not understood (longitude -70.6 E)"),
    ],
)
def test_what_is_there_but_not_understood_is_said(gps, said):
    place, why = read_place(gps, {})
    assert place is None
    assert said in why


@pytest.mark.parametrize(
    "attributes",
    [
        'drone-dji:GpsLatitude="-33.5" drone-dji:GpsLongtitude="-70.6"',
        'drone-dji:GpsLatitude="-33.5" drone-dji:GpsLongitude="-70.6"',
        'drone-skydio:Latitude="-33.5" drone-skydio:Longitude="-70.6"',
        'exif:GPSLatitude="33,30.0S" exif:GPSLongitude="70,36.0W"',
        'exif:GPSLatitude="33,30,0S" exif:GPSLongitude="70,36,0W"',
    ],
)
def test_xmp_fills_what_exif_lacks_and_its_contradiction_is_no_knowledge(attributes):
    xmp = packet(attributes)
    assert read_place({}, xmp) == (pytest.approx((SOUTH, WEST)), "")
    assert read_place({2: (33.0, 30.0, 0.0), 4: (70.0, 36.0, 0.0)}, xmp) == (pytest.approx((SOUTH, WEST)), "")
    assert read_place({1: "S", 2: (33.0, 30.0, 0.0), 3: "W", 4: (70.0, 36.0, 0.1)}, xmp)[1] == ""
    for sides, minutes, said in ((("N", "W"), 30.0, "hemispheres"), (("S", "W"), 31.0, "places")):
        place, why = read_place({1: sides[0], 2: (33.0, minutes, 0.0), 3: sides[1], 4: (70.0, 36.0, 0.0)}, xmp)
        assert place is None
        assert f"different {said}" in why


@pytest.mark.parametrize(
    ("gps", "altitude"),
    [
        ({5: b"\0", 6: R(120, 1)}, 120),
        ({5: b"\1", 6: R(120, 1)}, -120),
        ({5: 1, 6: R(-120, 1)}, -120),
        ({5: "1", 6: 120.0}, -120),
        ({5: 2, 6: 120.0}, 120),  # Exif 3: above the sea
        ({5: 3, 6: 120.0}, -120),
        ({5: "3", 6: 120.0}, -120),
        ({6: R(0, 0)}, None),
        ({5: 0, 6: 1e9}, None),
    ],
)
def test_altitudes_and_their_references(gps, altitude):
    assert read_altitude(gps, {})[0] == altitude
    if altitude is None and 5 not in gps:
        assert read_altitude(gps, packet('drone-dji:AbsoluteAltitude="+41.5"'))[0] == 41.5


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("-33.5", -33.5),
        ("33,5", 33.5),
        ("+0.1", 0.1),
        ("N 33 30 0", 33.5),
        ("-33.5 S", -33.5),
        ("-33.5 N", None),  # its sign and its side contradict each other
        ("33 minutes", 33),
        ("33?30'0\" N", 33.5),  # a program without the sign of degrees
        ("33.5?", None),
        ("33°60'0\"", 34.0),  # rounded seconds
        ("33°75'0\"", None),
        ("33°30'61\"", None),
        ("x", None),
        ("", None),
        ("50%", None),
    ],
)
def test_angles_are_read_from_text(text, degrees):
    assert degrees_of_text(f"{text}%", "latitude") is None
    read = degrees_of_text(text, "latitude")
    assert (read and read[0]) == (degrees if degrees is None else pytest.approx(degrees))


def test_minutes_just_south_of_the_equator_keep_the_sign_of_their_degrees():
    assert degrees_of_parts([-0.0, 30.0]) == -0.5
    assert degrees_of_parts([-33.0, 30.0, 36.0]) == pytest.approx(-33.51)


@pytest.mark.parametrize(
    ("text", "axis", "degrees"),
    [
        ("北緯35度30分36秒", "latitude", 35.51), ("南纬33.5", "latitude", -33.5), ("东经 116°24′", "longitude", 116.4),
        ("西経70.5", "longitude", -70.5), ("南纬33.5", "longitude", None), ("33.5 ю.ш.", "latitude", None),
    ],
)  # fmt: skip
def test_sides_in_other_scripts_are_read_or_refused(text, axis, degrees):
    read = degrees_of_text(text, axis)
    assert read == (None if degrees is None else (pytest.approx(degrees), True))


@pytest.mark.parametrize(("absolute", "altitude"), [("+96.20", 96.2), ("-96.20", -96), ("+300", -96), (None, -96)])
def test_the_wrong_reference_of_an_altitude_gives_way_to_the_sign_in_xmp(absolute, altitude):
    xmp = {"drone-dji:AbsoluteAltitude": absolute} if absolute else {}
    assert read_altitude({5: b"\x01", 6: 96.0}, xmp)[0] == altitude
    assert read_altitude({5: b"\x00", 6: 0.0}, xmp)[0] == float(absolute or 0)  # firmware that leaves EXIF empty


@pytest.mark.parametrize(
    ("in_exif", "altitude", "said"), [(1640.42, 500, "in XMP as"), (50.0, 500, "in XMP as"), (420.0, 420, "differs")]
)
def test_altitudes_in_feet_or_over_the_take_off_give_way_to_xmp(in_exif, altitude, said):
    xmp = packet('drone-dji:AbsoluteAltitude="+500.0" drone-dji:RelativeAltitude="+50.1"')
    found, datum = read_altitude({5: b"\x00", 6: in_exif}, xmp)
    assert found == altitude
    assert said in datum


@pytest.mark.parametrize(("in_exif", "words"), [(500.4, "RtkAlt as recorded"), (525.0, "EXIF GPSAltitude as recorded")])
def test_the_reference_that_xmp_names_is_that_of_its_own_altitude(in_exif, words):
    """Programs that correct positions afterwards write EXIF alone, above the ellipsoid perhaps."""
    xmp = packet('drone-dji:AbsoluteAltitude="+500.0" drone-dji:AltitudeType="RtkAlt"')
    altitude, reference = read_altitude({5: b"\x00", 6: in_exif}, xmp)
    assert altitude == in_exif
    assert reference.startswith(words)
    assert ("differs from AbsoluteAltitude in XMP (RtkAlt)" in reference) is (in_exif == 525)


@pytest.mark.parametrize(
    ("gps", "xmp", "found"),
    [
        ({}, 'drone-dji:AbsoluteAltitude="+545.00"', (545.0, "AbsoluteAltitude in XMP as recorded, datum not stated")),
        ({6: R(0, 0)}, 'drone-dji:AbsoluteAltitude="+545.00"',
         (545.0, "AbsoluteAltitude in XMP as recorded, datum not stated")),
        ({}, 'drone-dji:AbsoluteAltitude="+545.00" drone-dji:AltitudeType="RtkAlt"',
         (545.0, "RtkAlt as recorded")),
        ({5: b"\2", 6: 120.0}, "", (120.0, "EXIF GPSAltitude, above sea level (GPSAltitudeRef) as recorded")),
        ({5: b"\3", 6: 120.0}, "", (-120.0, "EXIF GPSAltitude, above sea level (GPSAltitudeRef) as recorded")),
        ({}, 'exif:GPSAltitude="12/1" exif:GPSAltitudeRef="2"',
         (12.0, "exif:GPSAltitude in XMP, above sea level (GPSAltitudeRef) as recorded")),
        ({5: b"\0", 6: 120.0}, "", (120.0, "EXIF GPSAltitude as recorded, datum not stated")),
        ({5: 2, 6: 500.0}, 'drone-dji:AbsoluteAltitude="+525.00"',
         (500.0, "EXIF GPSAltitude, above sea level (GPSAltitudeRef) as recorded, which differs from AbsoluteAltitude "
          "in XMP")),
    ],
)  # fmt: skip
def test_an_altitude_names_where_it_stands_and_its_reference(gps, xmp, found):
    """EXIF 3.0 tells the sea (2, 3) from the ellipsoid; its 0 and 1 are those of EXIF 2, which meant the sea."""
    assert read_altitude(gps, packet(xmp)) == found


def test_an_altitude_gives_way_to_no_default_and_not_where_another_source_confirms_it():
    heights = 'drone-dji:RelativeAltitude="+50.1" drone-dji:AbsoluteAltitude='
    for xmp in ('"+0.00"', '"+90.00" drone-dji:AltitudeWGS84="50.0"'):  # a take-off at the sea
        assert read_altitude({5: b"\x00", 6: 50.0}, packet(heights + xmp))[0] == 50.0
    assert read_altitude({5: b"\x00", 6: 50.6}, packet(f'{heights}"+90.00"'))[0] == 50.6  # near the height by chance
    found = read_altitude({5: b"\x00", 6: 0.0}, packet(f'{heights}"+90.00" drone-dji:AltitudeType="RtkAlt"'))
    assert found == (90.0, "AbsoluteAltitude in XMP (RtkAlt) as recorded")


def test_altitudes_are_exchanged_by_flight_and_not_by_photograph(tmp_path):
    """EXIF's are those over an ellipsoid, near the heights over the take-off in one photograph, and 0 in another."""
    seen = []
    for k, (in_exif, over) in enumerate([(50.0, 47.0), (51.0, 48.0), (50.5, 50.4), (0.0, 47.5), (50.2, 47.1)]):
        xmp = packet(f'drone-dji:RelativeAltitude="+{over}" drone-dji:AbsoluteAltitude="+{over + 45}"')
        taken, both = read_altitudes({5: b"\x00", 6: in_exif}, xmp)
        seen.append(replace(photograph(tmp_path, k), altitude=taken[0], altitude_type=taken[1], altitudes=both))
    assert [photo.altitude for photo in seen] == [50, 51, 95.4, 92.5, 50.2]
    checked = cross_checked(seen)
    assert [photo.altitude for photo in checked] == pytest.approx([50, 51, 50.5, 92.5 - 42.0, 50.2], abs=0.1)
    assert len({photo.altitude_type for photo in checked}) == 1
    alone = [replace(photo, datetime=f"2026:06:{1 + (k == 2):02d} 10:00:00") for k, photo in enumerate(seen)]
    assert cross_checked(alone)[2].altitude == 95.4  # of another flight


def test_cut_photographs_have_the_focal_length_of_the_others_in_pixels_and_copies_are_told(tmp_path):
    seen = [photograph(tmp_path, k) for k in range(4)]
    longer, short = max(seen[0].size), min(seen[0].size)
    cut = replace(seen[3], width=longer - 20, height=short)
    checked = cross_checked([*seen[:3], cut])
    assert checked[3].lens.focal * (longer - 20) == pytest.approx(seen[0].lens.focal * longer)
    assert "cut to another shape" in checked[3].doubts[-1]
    assert not any(photo.doubts for photo in checked[:3])
    copy = replace(seen[0], name="p00 (1).jpg")
    assert list(strays([*seen, copy, replace(copy, name="p00-edited.jpg")])[0]) == ["p00 (1).jpg", "p00-edited.jpg"]
    assert strays([*seen, replace(copy, datetime="2026:06:02 10:00:00")])[0] == {}  # of another moment
    edited = [replace(copy, name=f"p00{tail}.jpg") for tail in ("-modifié", "-ha editado", "_HDR", "-edited(1)")]
    assert [*strays([*seen, *edited])[0]] == [photo.name for photo in edited]
    phone = replace(seen[0], name="a/IMG_0001.HEIC"), replace(seen[0], name="a/IMG_E0001.JPG")
    assert list(strays(phone)[0]) == ["a/IMG_E0001.JPG"]
    enhanced = [replace(seen[0], name=name) for name in ("p.dng", "p-Enhanced-NR.dng", "p-HDR.jpg")]
    assert list(strays(enhanced)[0]) == ["p-Enhanced-NR.dng", "p-HDR.jpg"]


def test_attitudes_of_gimbal_and_aircraft_agree_straight_down():
    level = attitude_from_aircraft(30, 0, 0)
    assert attitude_from_gimbal(30, -90, 0).camera_from_enu == pytest.approx(level.camera_from_enu, abs=1e-12)
    ahead = -level.camera_from_enu[1]
    assert ahead == pytest.approx([0.5, np.sqrt(0.75), 0], abs=1e-12)  # the top of the picture looks where it flies
    assert attitude_from_aircraft(0, 10, 0).camera_from_enu[2] @ [0, 1, 0] > 0.17  # nose up: the view swings ahead
    assert (
        attitude_from_aircraft(0, 0, 10).camera_from_enu[2] @ [1, 0, 0] < -0.17
    )  # right wing down: it swings to the left
    assert np.linalg.det(attitude_from_gimbal(12, -60, 5).camera_from_enu) == pytest.approx(1)


def test_no_flight_is_far_below_the_sea():
    altitude, datum = read_altitude({5: b"\x01", 6: 512.0}, {})
    assert altitude == 512.0
    assert "'below sea level' cannot be true" in datum
    assert read_altitude({5: b"\x01", 6: 390.0}, {})[0] == -390.0  # over the shore of the Dead Sea


def test_a_flight_without_a_hemisphere_is_told(tmp_path):
    for k in range(4):
        photograph(tmp_path, k)
        file = tmp_path / f"p{k:02d}.jpg"
        with Image.open(file) as image:
            exif = image.getexif()
        for tag in (1, 3):
            del exif.get_ifd(0x8825)[tag]
        Image.fromarray(np.roll(NOISE, k, axis=0)).save(file, quality=95, exif=exif)
    kept = collect_images([tmp_path])
    found = make_preflight_report(kept, read_gps_priors(kept.images, None, (1.0, 2.0)))
    assert any("p00.jpg, p01.jpg, p02.jpg and 1 more: " in each and "no hemisphere" in each for each in found.warnings)


# -------------------------------------------------------------------------------------------------------- lens

#: 8.5 mm and 40 pixels a millimetre: 340 px of 400, or 30 mm of 35 mm film.
DETAILS = {0x920A: 8.5, 0xA002: 400, 0xA003: 300, 0xA20E: 40.0, 0xA210: 4}


@pytest.mark.parametrize(
    ("changes", "size", "focal", "source", "doubted"),
    [
        pytest.param({}, (400, 300), 0.85, SENSOR, False, id="plain"),
        pytest.param({0xA405: 30}, (400, 300), 0.85, SENSOR, False, id="two that agree"),
        pytest.param({0xA405: 30}, (200, 150), 0.85, SENSOR, False, id="shrunk"),
        pytest.param({0xA20E: 160.0, 0xA405: 30}, (400, 300), 0.867, EQUIVALENT, True, id="shrunk, size rewritten"),
        pytest.param({0xA210: 2, 0xA405: 30}, (400, 300), 0.867, EQUIVALENT, False, id="called inches"),
        pytest.param({0xA405: 8.5}, (400, 300), 0.85, SENSOR, True, id="an equivalent that repeats the focal length"),
        pytest.param({0xA405: 0}, (400, 300), 0.85, SENSOR, False, id="no equivalent"),
        pytest.param({0xA404: 2.0}, (400, 300), 1.7, SENSOR, False, id="digital zoom"),
        pytest.param({0xA404: 2.0, 0xA405: 60}, (400, 300), 1.7, SENSOR, False, id="zoom that the equivalent knows"),
        pytest.param({0xA404: 2.0, 0xA405: 30}, (400, 300), 1.7, SENSOR, False, id="zoom that it does not"),
        pytest.param({0xA404: 0.0}, (400, 300), 0.85, SENSOR, False, id="zoom 0: none"),
        pytest.param({0xA404: R(0, 0)}, (400, 300), 0.85, SENSOR, False, id="zoom 0/0"),
        pytest.param({0xA404: 1.0}, (400, 300), 0.85, SENSOR, False, id="zoom 1"),
        pytest.param({0x920A: 0, 0xA404: 2.0, 0xA405: 60}, (400, 300), 1.733, EQUIVALENT, False, id="phone, zoomed"),
        pytest.param({0xA405: 30}, (400, 225), 0.85, SENSOR, False, id="cut above and below"),
        pytest.param({0xA405: 30}, (200, 300), 340 / 300, SENSOR, False, id="cut at the sides"),
        pytest.param({0xA405: 30}, (320, 250), 340 / 320, SENSOR, False, id="cut on all sides"),
        pytest.param({0xA405: 30}, (250, 320), 340 / 320, SENSOR, False, id="cut on all sides, upright"),
        pytest.param({0xA405: 30}, (160, 100), 0.85, SENSOR, True, id="cut and shrunk"),
        pytest.param({0xA405: 30}, (280, 158), 0.85, SENSOR, False, id="exported in 16:9"),
        pytest.param({0xA405: 30}, (270, 180), 0.85, SENSOR, False, id="exported in 3:2"),
        pytest.param({0xA405: 30}, (160, 119), 0.85, SENSOR, False, id="shrunk, rounded"),
    ],
)
def test_ways_to_the_focal_length_are_held_against_each_other(changes, size, focal, source, doubted):
    lens = read_lens({}, DETAILS | changes, {}, *size)
    assert lens is not None
    assert (lens.focal, lens.source) == (pytest.approx(focal, abs=2e-3), source)
    assert bool(lens.doubt) is doubted


@pytest.mark.parametrize(("size", "said"), [((320, 250), "cut only"), ((200, 120), "shrunk"), ((400, 225), "")])
def test_what_is_assumed_of_photographs_that_were_cut_on_all_sides_is_said(tmp_path, size, said):
    file = tmp_path / "photograph.jpg"
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x920A: 8.5, 0xA002: 400, 0xA003: 300, 0xA405: 30})
    Image.new("RGB", size).save(file, exif=exif)
    doubts = read_image_metadata(file, file.name).doubts
    assert [doubt.endswith(f"taken as if it was {said}") for doubt in doubts] == ([True] if said else [])


def test_a_contradiction_names_both_and_is_not_held(tmp_path):
    lens = read_lens({}, DETAILS | {0xA20E: 160.0, 0xA405: 30}, {}, 400, 300)
    assert lens is not None
    assert "1360 px by EXIF's focal length and sensor" in lens.doubt
    assert "347 px by EXIF's 35 mm equivalent" in lens.doubt
    seen = [replace(photograph(tmp_path, k), lens=lens) for k in range(4)]
    where = read_gps_priors(seen, None, (1.0, 2.0))
    assert should_fix_focal(seen, where, SfmOptions()) == (False, "what the photographs say of it contradicts itself")


def test_what_three_ways_say_is_by_majority():
    tags = {0x0110: "FC6310"}  # a sensor 13.2 mm wide
    details = {0x920A: 8.8, 0xA405: 24, 0xA002: 1368, 0xA20E: 2 * 5472 / 13.2, 0xA210: 4}
    lens = read_lens(tags, details, {}, 1368, 912)
    assert lens is not None
    assert lens.focal == pytest.approx(8.8 / 13.2)
    assert "FC6310" in lens.source
    assert "px by EXIF's focal length and sensor" in lens.doubt


def test_a_size_that_was_rewritten_does_not_vote_twice():
    """The calibration and the sensor are both of the original's pixels, four times too long here."""
    xmp = packet('drone-dji:CalibratedFocalLength="3648.0"')
    details = {0x920A: 8.8, 0xA405: 24, 0xA002: 1368, 0xA003: 912, 0xA20E: 5472 / 13.2, 0xA210: 4}
    lens = read_lens({}, details, xmp, 1368, 912)
    assert lens is not None
    assert (lens.source, lens.focal) == (EQUIVALENT, pytest.approx(0.667, abs=2e-3))
    without = read_lens({0x0110: "FC6310"}, {**details, 0xA405: 0}, {}, 1368, 912)
    assert without is not None
    assert without.focal == pytest.approx(8.8 / 13.2)  # the table of sensors


def test_the_makers_calibration_survives_a_rewritten_size():
    xmp = packet('drone-dji:CalibratedFocalLength="3666.6" drone-dji:CalibratedOpticalCenterX="2736.0"')
    lens = read_lens({}, {0xA002: 1368, 0xA003: 912}, xmp, 1368, 912)
    assert lens is not None
    assert lens.focal == pytest.approx(3666.6 / 5472)
    assert 1 / AGREE < lens.focal / 0.667 < AGREE


def test_a_calibration_of_a_shrunk_photograph_is_as_good_as_its_center_lies_in_the_middle_of_the_longer_side():
    """40 px off the middle down are more of the height than 10 across are of the width."""
    xmp = packet(
        'drone-dji:CalibratedFocalLength="3666.6" drone-dji:CalibratedOpticalCenterX="2746.0" '
        'drone-dji:CalibratedOpticalCenterY="1784.0"'
    )
    lens = read_lens({}, {0xA002: 1368, 0xA003: 912}, xmp, 1368, 912)
    assert lens is not None
    assert lens.focal == pytest.approx(3666.6 / 5472, rel=0.005)


ADOBE = "Adobe Photoshop Lightroom 6.0 (Windows)"


@pytest.mark.parametrize(
    ("model", "program", "changes", "size", "focal", "said"),
    [
        pytest.param("Wing", "v1.02", {}, (400, 300), 0.85, "", id="a camera's own firmware"),
        pytest.param("Wing", ADOBE, {}, (400, 300), 0.85, f"{ADOBE} wrote it", id="a program"),
        pytest.param("Wing", ADOBE, {}, (200, 150), 0.85, "", id="a program that left the size"),
        pytest.param("Wing", ADOBE, {0xA405: 30}, (400, 300), 0.85, "", id="confirmed by the equivalent"),
        pytest.param("Canon EOS 6D", ADOBE, {0x920A: 30.6, 0xA003: 267, 0xA20E: 900 / 36}, (400, 267), 0.85,
                     "765 px by EXIF's focal length and sensor, but 340 px by EXIF's focal length, the sensor of",
                     id="shrunk, a sensor of 36 mm"),
    ],
)  # fmt: skip
def test_what_programs_may_have_rewritten_is_named_and_gives_way_to_the_sensor_of_the_model(
    model, program, changes, size, focal, said
):
    lens = read_lens({0x0110: model, 0x0131: program}, DETAILS | changes, {}, *size)
    assert lens is not None
    assert lens.focal == pytest.approx(focal, abs=2e-3)
    assert said in lens.doubt + lens.remark
    assert said or not lens.doubt + lens.remark
    assert lens.confirmed is (0xA405 in changes)


@pytest.mark.parametrize("in_focal_length", [False, True])
def test_digital_zoom_is_a_camera_of_its_own_and_counts_once(tmp_path, in_focal_length):
    for k in range(6):
        photograph(tmp_path, k)
        if k % 3 == 2:
            file = tmp_path / f"p{k:02d}.jpg"
            with Image.open(file) as image:
                exif, xmp = image.getexif(), image.info["xmp"]
            details = exif.get_ifd(0x8769)
            details[0xA404] = 2.0
            details[0x920A] = details[0x920A] * (2 if in_focal_length else 1)
            Image.fromarray(np.roll(NOISE, k, axis=0)).save(file, quality=95, exif=exif)
            add_xmp(file, xmp)
    kinds = group_by_camera(collect_images([tmp_path]).images)
    assert [(len(kind.images), kind.focal_px) for kind in kinds] == [
        (4, pytest.approx(136)), (2, pytest.approx(272)),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("plain", "zoomed", "times"),
    [
        pytest.param((8.5, 31), (8.5, 31), 1.5, id="neither has it"),
        pytest.param((8.5, 31), (12.75, 31), 1.5, id="the focal length has it"),
        pytest.param((None, 31), (None, 31), 1.5, id="nothing but the equivalent"),
        pytest.param((8.5, 31), (8.5, 46), 1.0, id="the equivalent has it"),
        pytest.param((12.75, 46), (8.5, 46), 1.0, id="others are zoomed by their lens"),
    ],
)
def test_an_equivalent_that_lacks_the_digital_zoom_is_told_by_photographs_without(tmp_path, plain, zoomed, times):
    def seen(k: int, focal_mm: float | None, equivalent: int, zoom: float) -> ImageMetadata:
        lens = read_lens({}, {0x920A: focal_mm, 0xA405: equivalent, 0xA404: zoom}, {}, 400, 300)
        return replace(photograph(tmp_path, k), lens=lens)

    found = cross_checked([seen(k, *(zoomed if k % 2 else plain), 1.5 if k % 2 else 1.0) for k in range(6)])
    focal = zoomed[1] * times * 5 / np.hypot(36, 24) / 4
    assert [photo.lens.focal for photo in found[1::2]] == pytest.approx([focal] * 3)
    assert [photo.lens.focal for photo in found[::2]] == pytest.approx([plain[1] * 5 / np.hypot(36, 24) / 4] * 3)


@pytest.mark.parametrize("equivalent", [None, 59])
def test_digital_zoom_of_all_photographs_is_doubted_unless_the_equivalent_has_it(tmp_path, equivalent):
    for k in range(4):
        photograph(tmp_path, k)
        file = tmp_path / f"p{k:02d}.jpg"
        with Image.open(file) as image:
            exif = image.getexif()
        details = exif.get_ifd(0x8769)
        details[0xA404] = 2.0
        if equivalent:
            details[0xA405] = equivalent
        Image.fromarray(np.roll(NOISE, k, axis=0)).save(file, quality=95, exif=exif)
    seen = collect_images([tmp_path]).images
    assert all(bool(photo.lens.doubt) == (equivalent is None) for photo in seen)
    said = make_preflight_report(collect_images([tmp_path]), read_gps_priors(seen, None, (1.0, 2.0))).warnings
    assert any("272 px if not, as taken, 136 px if so" in each for each in said) == (equivalent is None)


@pytest.mark.parametrize("unknown", [1, 5])
def test_one_stray_does_not_change_the_rule_for_all(tmp_path, unknown):
    seen = [photograph(tmp_path, k) for k in range(6)]
    seen = [replace(photo, lens=None) if k < unknown else photo for k, photo in enumerate(seen)]
    assert should_fix_focal(seen, read_gps_priors(seen, None, (1.0, 2.0)), SfmOptions())[0] is (unknown == 1)


# --------------------------------------------------------------------------------------------------- attitudes


@pytest.mark.parametrize(
    ("attributes", "angles"),
    [
        ('dji:GimbalYawDegree="+30.0" dji:GimbalPitchDegree="-60.0" dji:GimbalRollDegree="+0.0"', (30, -60, 0)),
        ('drone:GimbalYawDegree="30" drone:GimbalPitchDegree="-60" drone:GimbalRollDegree="0"', (30, -60, 0)),
        ('parrot:CameraYawDegree="30" parrot:CameraPitchDegree="-60" parrot:CameraRollDegree="0"', (30, -60, 0)),
        ('Camera:Yaw="30" Camera:Pitch="30" Camera:Roll="0"', (30, -60, 0)),  # Pix4D: 0 looks down
        ('Camera:Yaw="30/1" Camera:Pitch="-60" Camera:Roll="0"', (30, -60, 0)),
        ('drone-dji:GimbalPitchDegree="-60" drone-dji:FlightYawDegree="+30.0"', (30, -60, 0)),
        ('drone-dji:GimbalPitchDegree="-90"', (0, -90, 0)),
    ],
)  # fmt: skip
def test_attitudes_are_read_under_every_makers_names(attributes, angles):
    xmp = packet(attributes)
    elements = "".join(f"<{name}>{value}</{name}>" for name, value in xmp.items())
    for values in (xmp, read_xmp(elements.encode())):
        readings, said = read_attitudes(values)
        attitude = likeliest_attitude(readings)
        assert attitude is not None
        assert said == ""
        assert attitude.camera_from_enu == pytest.approx(attitude_from_gimbal(*angles).camera_from_enu, abs=1e-9)


def test_a_camera_inside_a_structure_is_not_mistaken_for_the_vehicle():
    structure = (
        "<d:VehicleOrientationNED rdf:parseType='Resource'><d:Yaw>1</d:Yaw><d:Pitch>2</d:Pitch><d:Roll>3</d:Roll>"
        "</d:VehicleOrientationNED><d:CameraOrientationNED rdf:parseType='Resource'><d:Yaw>30</d:Yaw>"
        "<d:Pitch>-60</d:Pitch><d:Roll>0</d:Roll></d:CameraOrientationNED>"
    )
    readings, _ = read_attitudes(read_xmp(structure.encode()))
    attitude = likeliest_attitude(readings)
    assert attitude is not None
    assert attitude.camera_from_enu == pytest.approx(attitude_from_gimbal(30, -60, 0).camera_from_enu)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ('drone-dji:GimbalYawDegree="+0.00" drone-dji:GimbalPitchDegree="+0.00" drone-dji:GimbalRollDegree="+0.00"',
         DEFAULT_ANGLES),
        ('drone-dji:GimbalPitchDegree="0"', DEFAULT_ANGLES),
        ('drone-parrot:CameraYawDegree="0" drone-parrot:CameraPitchDegree="-0.0"', DEFAULT_ANGLES),
        ('drone-dji:GimbalPitchDegree="-45"', ""),  # oblique, and nothing says where to
        ('drone-dji:GimbalYawDegree="30"', ""),
        ("", ""),
    ],
)  # fmt: skip
def test_defaults_and_halves_of_attitudes_are_none(attributes, said):
    assert read_attitudes(packet(attributes)) == ({}, said)


def test_the_same_level_view_in_all_photographs_is_a_default(tmp_path):
    level = 'drone-dji:GimbalYawDegree="90.0" drone-dji:GimbalPitchDegree="0.1" drone-dji:GimbalRollDegree="0"'
    for k in range(4):
        photograph(tmp_path / "same", k, xmp=level)
        photograph(tmp_path / "other", k, xmp=level.replace("90.0", f"9{k}.0"))
    same, other = (collect_images([tmp_path / name]).images for name in ("same", "other"))
    assert all(photo.attitude is None and "default" in photo.doubts[0] for photo in same)
    assert all(photo.attitude is not None and not photo.doubts for photo in other)


@pytest.mark.parametrize(("reference", "expected"), [("1", -15.0), ("0", 15.0), (None, 15.0)])
def test_altitudes_of_xmp_have_a_reference_too(reference, expected):
    """As Lightroom and exiftool write them into sidecars."""
    xmp = {"exif:GPSAltitude": "15000/1000"} | ({"exif:GPSAltitudeRef": reference} if reference else {})
    (value, source), _ = read_altitudes({}, xmp)
    assert value == expected
    assert source.startswith("exif:GPSAltitude in XMP")
