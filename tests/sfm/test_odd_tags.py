"""Exposures of brackets, fixes that EXIF itself does not vouch for, altitudes that are rounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm.brackets import unused_exposures
from vdgs.sfm.cross_checks import cross_checked
from vdgs.sfm.exif_gps import FLAT, VOID, is_measured_in_xmp
from vdgs.sfm.flights import flights_of
from vdgs.sfm.focal_decision import _over_slope, should_fix_focal
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import ImageMetadata, attitude_from_gimbal, read_image_metadata
from vdgs.sfm.map_datums import to_wgs84

NOISE = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)


def tagged(file: Path, number: int, east: float, details: dict[int, object], gps: dict[int, object]) -> ImageMetadata:
    write_photograph(file, np.roll(NOISE, number, axis=0), number, np.array((east, 0, 40)))
    with Image.open(file) as image:
        exif = image.getexif()
        exif.get_ifd(0x8769).update(details)
        exif.get_ifd(0x8825).update(gps)
        image.save(file, exif=exif)
    return read_image_metadata(file, file.name)


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> ImageMetadata:
    return tagged(tmp_path_factory.mktemp("one") / "p.jpg", 0, 0, {0x9204: -0.7, 0x829A: 0.01, 0x8827: 200}, {})


def shots(first: ImageMetadata, biases: list[float | None], every_s: int = 1, step_m: float = 0.3, each: int = 3):
    """Photographs of which `each` follow at once, and places 15 m apart."""
    found = []
    for k, bias in enumerate(biases):
        seconds, east = 20 * (k // each) + every_s * (k % each), 15 * (k // each) + step_m * (k % each)
        found.append(
            replace(
                first, name=f"p{k:03d}.jpg", exposure_bias=bias, lat_lon=(-33.5, -70.6 + east / 92800),
                datetime=f"2026:06:01 10:{seconds // 60:02d}:{seconds % 60:02d}",
            )
        )  # fmt: skip
    return found


def test_one_photograph_of_each_bracket_is_used_and_the_others_are_named(tmp_path, first):
    assert first.exposure_bias == pytest.approx(-0.7)
    assert first.exposure_stops == pytest.approx(1)
    for k in range(9):
        tagged(tmp_path / f"p{k}.jpg", k, 20 * (k // 3) + 0.1 * k, {0x9204: (0.0, -0.7, 0.7)[k % 3]}, {})
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == ["p0.jpg", "p3.jpg", "p6.jpg"]
    assert "one bracket with p3.jpg" in found.excluded[2].reason
    assert any("3 of 3" in note and "other 6" in note and "--brackets all" in note for note in found.notes)
    assert len(collect_images([tmp_path], brackets="all").images) == 9


def test_exposures_that_were_sorted_into_folders_by_one_name_are_no_versions_of_each_other(tmp_path):
    for k in range(6):
        for folder, seconds in (("a", 0.01), ("b", 0.02)):
            (tmp_path / folder).mkdir(exist_ok=True)
            tagged(tmp_path / folder / f"p{k}.jpg", k, 15 * k, {0x829A: seconds, 0x8827: 200}, {})
    assert len(collect_images([tmp_path], brackets="all").images) == 12


def test_brackets_of_five_of_lost_exposures_and_of_manual_cameras_are_found(first):
    five = shots(first, [0, -0.7, 0.7, -1.3, 1.3] * 4, each=5)
    assert len(unused_exposures(five)[0]) == 16
    del five[7], five[0]  # an exposure is lost, even the middle one
    left, _ = unused_exposures(five)
    assert len(left) == 14
    assert {"p005.jpg", "p010.jpg", "p015.jpg"}.isdisjoint(left)
    by_time = [replace(p, exposure_stops=(-6.0, -7.5, -4.5)[k % 3]) for k, p in enumerate(shots(first, [0.0] * 9))]
    assert len(unused_exposures(by_time)[0]) == 6
    without_place = [replace(photo, lat_lon=None) for photo in shots(first, [0, -1, 1] * 3)]
    assert len(unused_exposures(without_place)[0]) == 6
    assert not unused_exposures([replace(photo, datetime="") for photo in without_place])[0]


def in_folders(photographs: list[ImageMetadata], *names: str) -> list[ImageMetadata]:
    return [replace(p, name=f"{names[k % len(names)]}/{p.name}") for k, p in enumerate(photographs)]


def test_brackets_sorted_into_a_folder_for_each_exposure_are_found(first):
    names = "normal", "under", "over"
    by_bias = in_folders(shots(first, [0, -2, 2] * 6), *names)
    left, notes = unused_exposures(by_bias)
    assert sorted({name.split("/")[0] for name in left}) == ["over", "under"]
    assert len(left) == 12
    assert "--brackets all" in notes[0]
    two_flights = [replace(p, name=f"flight{k // 9}/{p.name}") for k, p in enumerate(by_bias)]
    assert len(unused_exposures(two_flights)[0]) == 12
    stops = [(-6.0, -8.0, -4.0)[k % 3] + 0.1 * (k // 3) for k in range(18)]  # the light changes
    by_time = [replace(p, exposure_bias=0.0, exposure_stops=stops[k]) for k, p in enumerate(by_bias)]
    assert len(unused_exposures(by_time)[0]) == 12
    assert unused_exposures([replace(p, exposure_bias=0.0) for p in by_bias])[0] == {}
    one_place = in_folders(shots(first, [0, -2, 2] * 6, step_m=9.0), *names)
    assert unused_exposures(one_place)[0] == {}


@pytest.mark.parametrize("folders", [("",), ("a", "b", "c", "d", "e")])
def test_cameras_of_a_rig_with_automatic_exposure_are_no_brackets(first, folders):
    """Five equal cameras without serial numbers release together; the sun lights what each sees another way."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        light = np.tile(rng.normal(0, 1.0, 5), 12) + rng.normal(0, 0.4, 60)
        rig = in_folders(shots(first, [0.0] * 60, every_s=0, step_m=0.0, each=5), *folders)
        by_stops = [replace(p, exposure_stops=-7 + round(3 * light[k]) / 3) for k, p in enumerate(rig)]
        assert unused_exposures(by_stops)[0] == {}
        by_bias = [replace(p, exposure_bias=round(3 * light[k]) / 3) for k, p in enumerate(rig)]
        assert len(unused_exposures(by_bias)[0]) == 0


def test_heads_of_a_rig_that_call_their_photographs_the_same_are_no_brackets(first):
    heads = in_folders(shots(first, [-0.3, 0.0, 0.3] * 6, every_s=0, step_m=0.0), "left", "nadir", "right")
    assert len(unused_exposures(heads)[0]) == 12  # of one camera, that numbers what it takes
    rig = [replace(p, name=f"{p.name.split('/')[0]}/{k // 3}.jpg") for k, p in enumerate(heads)]
    assert unused_exposures(rig)[0] == {}
    manual = [replace(p, exposure_bias=0.0, exposure_stops=(9.0, 10.0, 11.0)[k % 3]) for k, p in enumerate(rig)]
    assert unused_exposures(manual)[0] == {}


def test_brackets_about_another_exposure_each_are_found(first):
    steps = np.array([0.0, -0.7, 0.7])
    biases = [float(each) for compensation in (0, 0.3, 0.7, 1.0, -0.3, -0.7) for each in steps + compensation]
    assert len(unused_exposures(shots(first, biases))[0]) == 12


def test_photographs_that_merely_are_dense_stay(first):
    assert unused_exposures(shots(first, [0.0] * 30, each=30))[0] == {}
    assert unused_exposures(shots(first, [0, 0, 0, -0.3, -0.3, -0.3], each=6))[0] == {}  # the pilot chose another
    assert unused_exposures(shots(first, [0, -1, 1] * 3, step_m=8.0))[0] == {}
    assert unused_exposures(shots(first, [0, -1, 1] * 3, every_s=5))[0] == {}
    turning = [
        replace(p, attitude=attitude_from_gimbal(30.0 * k, -60, 0)) for k, p in enumerate(shots(first, [0, -1, 1]))
    ]
    assert unused_exposures(turning)[0] == {}
    assert len(unused_exposures([replace(p, attitude=turning[0].attitude) for p in turning])[0]) == 2
    rng = np.random.default_rng(1)  # automatic exposure while the drone hovers
    for size in (0.1, 0.5, 1.0):
        auto = [replace(p, exposure_stops=float(rng.normal(0, size))) for p in shots(first, [0.0] * 90, each=90)]
        assert unused_exposures(auto)[0] == {}
    dusk = [replace(p, exposure_stops=k / 3) for k, p in enumerate(shots(first, [0.0] * 40, each=40))]
    assert unused_exposures(dusk)[0] == {}


def test_void_positions_and_altitudes_of_flat_fixes_are_not_used_unless_the_tag_is_a_default(tmp_path):
    tags: list[dict[int, object]] = [{9: "A", 10: "3"}, {9: "V"}, {10: "2"}, {11: 99.9}, {11: 12.0}]
    read = [tagged(tmp_path / f"p{k}.jpg", k, 10.0 * k, {}, gps) for k, gps in enumerate(tags)]
    assert [photo.fix for photo in read] == ["", VOID, FLAT, VOID, ""]
    assert [photo.gps_error_m for photo in read] == [None] * 4 + [12.0]
    checked = cross_checked(read)
    assert [photo.lat_lon is None for photo in checked] == [False, True, False, True, False]
    assert [photo.altitude is None for photo in checked] == [False, False, True, False, False]
    assert "void position" in checked[1].doubts[-1]
    everywhere = cross_checked([replace(photo, fix=VOID) for photo in read])
    assert all(photo.lat_lon and "used" in photo.doubts[-1] for photo in everywhere)
    one_without = cross_checked([replace(p, fix=VOID, lat_lon=p.lat_lon if k else None) for k, p in enumerate(read)])
    assert [photo.lat_lon is None for photo in one_without] == [True, False, False, False, False]
    both = ((564.0, "EXIF"), (600.0, "XMP"))
    flat = [
        replace(p, fix=FLAT if k == 0 else "", altitude=600.0 if k else 564.0, altitudes=both)
        for k, p in enumerate(read)
    ]
    assert [photo.altitude for photo in cross_checked(flat)] == [None, *[600.0] * 4]
    stale = cross_checked([replace(photo, fix=VOID, lat_lon=read[0].lat_lon) for photo in read])
    assert not any(photo.lat_lon for photo in stale)


@pytest.mark.parametrize(
    ("datum", "place", "moved_m", "error_m"),
    [
        ("WGS-84", (35.6, 139.7), 0, 0),
        ("", (35.6, 139.7), 0, 0),
        ("World Geodetic System 1984", (35.6, 139.7), 0, 0),
        ("EPSG:4326", (35.6, 139.7), 0, 0),
        ("IGS14", (35.6, 139.7), 0, 0),
        ("SWEREF 99", (59.0, 18.0), 0, 0),
        ("RGF93", (46.0, 2.0), 0, 0),
        ("TOKYO", (35.6, 139.7), 460, 9),
        ("NAD 27", (40.0, -100.0), 35, 7),
        ("S-42", (55.0, 37.0), 120, 3),
        ("ED50", (48.0, 8.0), 125, 1),
        ("GCJ-02", (30.0, 110.0), 0, 700),
        ("Beijing 1954", (30.0, 110.0), 0, 300),
        ("MINE", (30.0, 110.0), 0, 300),
    ],
)
def test_positions_of_another_datum_are_converted_or_their_error_is_stated(datum, place, moved_m, error_m):
    found, said, error = to_wgs84(place, {0x12: datum})
    away = np.hypot((found[0] - place[0]) * 111e3, (found[1] - place[1]) * 111e3 * np.cos(np.radians(place[0])))
    assert (away, error) == (pytest.approx(moved_m, abs=30), error_m)
    assert (said != "" and datum in said) is (error_m > 0)
    assert ("converted" in said) is (moved_m > 0)


@pytest.mark.parametrize(
    ("datum", "place", "seconds"),
    [
        ("TOKYO", (35.6, 139.7), (11.6, -11.6)),
        ("ED50", (48.0, 8.0), (-3.2, -4.3)),
        ("NAD27", (40.0, -100.0), (0.1, -1.4)),
    ],
)
def test_positions_are_converted_from_their_datum_and_not_to_it(datum, place, seconds):
    found, _, _ = to_wgs84(place, {0x12: datum})
    assert 3600 * np.subtract(found, place) == pytest.approx(seconds, abs=0.7)


@pytest.mark.parametrize(
    ("own", "name", "is_measured"),
    [(True, "drone-dji:GpsL", True), (True, "exif:GPSL", False), (False, "exif:GPSL", True)],
)
def test_what_editors_copy_from_exif_says_nothing_of_its_fix_and_datum(own, name, is_measured):
    xmp = {f"{name}atitude": "50.5", f"{name}ongitude": "8.25"}
    gps = {2: (50.0, 30.0, 0.0), 4: (8.0, 15.0, 0.0)} if own else {}
    assert is_measured_in_xmp(gps, xmp) is is_measured


@pytest.mark.parametrize(("step", "seen"), [(0.0, 0.0), (1.0, 1.0), (3.048, 3.048), (10.0, 10.0), (30.48, 30.48)])
def test_rounded_altitudes_count_as_errors_and_do_not_let_the_focal_length_be_fitted(first, step, seen):
    rng, photos = np.random.default_rng(2), []
    for k in range(40):
        altitude = 564.4 + rng.normal(0, 0.8)
        altitude = step * round(altitude / step) if step else altitude
        place = -33.5 + 25 * (k // 8) / 111_000, -70.6 + 12 * (k % 8) / 92_800
        when = f"2026:06:01 10:00:{k:02d}"
        photo = replace(first, name=f"{k}", lat_lon=place, altitude=altitude, datetime=when, attitude=None)
        photos.append(replace(photo, relative_altitude=None))
    priors = read_gps_priors(photos, None, (1.0, 2.0))
    assert priors.altitude_step_m == seen
    assert any("multiples" in note for note in priors.notes) is (seen > 0)
    assert priors.gps_std[0, 2] == pytest.approx(np.hypot(2, seen / 3))
    assert not np.ptp(priors.flights)
    assert should_fix_focal(photos, priors, SfmOptions())[0]
    alike = read_gps_priors([replace(photo, altitude=500.0) for photo in photos], None, (1.0, 2.0))
    assert alike.altitude_step_m == 0  # one height, as planned


@pytest.mark.parametrize(
    ("altitudes", "seen"),
    [
        ([528] * 20 + [562] * 14, 0),  # two rings
        ([512] * 8 + [530] * 8 + [528] * 7 + [512] * 8 + [530] * 8, 0),  # both sides of a bridge, and its end
        ([510, 520, 530, 530, 520, 510] * 5, 0),  # up and down a wall
        ([510, 520, 530, 540, 550, 550, 540, 530, 520, 510] * 3, 10),
        ([100] * 6 + [101] + [100] * 5 + [99] + [100] * 9, 1),
        ([560] * 12 + [570] * 3 + [560] * 12, 0),
    ],
)
def test_few_levels_are_not_altitudes_that_were_rounded(first, altitudes, seen):
    photos = [
        replace(first, name=f"{k}", lat_lon=(-33.5 + 1e-4 * k, -70.6 + 1e-4 * (k % 5)), altitude=float(each))
        for k, each in enumerate(altitudes)
    ]
    assert read_gps_priors(photos, None, (1.0, 2.0)).altitude_step_m == seen


def test_dates_with_hyphens_are_work_as_those_with_colons(tmp_path):
    """Pauses part flights by them; copies of other programs have the same moments."""
    seen = [tagged(tmp_path / f"{k}.jpg", k, 0, {0x9003: f"2026-06-01 {10 + 4 * (k // 3)}:00:{k:02d}"}, {})
            for k in range(6)]  # fmt: skip
    assert [photo.datetime for photo in seen[::5]] == ["2026:06:01 10:00:00", "2026:06:01 14:00:05"]
    assert flights_of(seen).tolist() == [0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize("longitude", [178.0, 180.0])
def test_a_slope_is_one_on_both_sides_of_the_antimeridian(first, longitude):
    east = (longitude + np.linspace(-0.001, 0.001, 9) + 180) % 360 - 180
    photos = [replace(first, lat_lon=(-16.8 + 1e-4 * (k % 3), float(each))) for k, each in enumerate(east)]
    heights = 80 + 5.0 * np.arange(9)
    assert _over_slope(heights, photos) == pytest.approx(np.zeros(9), abs=1e-6)
