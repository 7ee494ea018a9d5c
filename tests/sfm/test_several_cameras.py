"""Photographs of several cameras or lenses at once: which are one camera, and how far those of each overlap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from support.small_flights import flight, picture, pixels, said
from vdgs.sfm.feature_extraction import group_by_camera
from vdgs.sfm.focal_length import lens_numbers
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import ImageList, collect_images
from vdgs.sfm.preflight import make_preflight_report


def overlap_of(found: ImageList) -> float | None:
    return make_preflight_report(found, read_gps_priors(found.images, None, (1.0, 2.0))).forward_overlap


def of_unknown_sensor(file: Path, focal_mm: float, zoom: float = 1.0) -> None:
    with Image.open(file) as image:
        exif, shown = image.getexif(), np.asarray(image)
    details = exif.get_ifd(0x8769)
    details.pop(0xA20E)
    details[0x920A], details[0xA404] = focal_mm, zoom
    picture(file, shown, exif=exif, quality=92)


@pytest.mark.parametrize(("second", "count"), [((30.0, 1.0), 2), ((20.0, 1.5), 2), ((20.0, 1.0), 1)])
def test_focal_lengths_part_cameras_also_where_the_sensor_is_unknown(tmp_path, second, count):
    for k, name in enumerate(flight(tmp_path)):
        of_unknown_sensor(tmp_path / name, *(second if k % 2 else (20.0, 1.0)))
    groups = group_by_camera(collect_images([tmp_path]).images)
    assert [len(group.images) for group in groups] == [6 // count] * count
    assert not any(group.has_focal_prior for group in groups)


def test_a_few_photographs_of_another_focal_length_merge_no_lenses():
    assert lens_numbers([24.0, 50.0] * 5 + [35.0, None]) == [0, 1] * 5 + [1, 0]


@pytest.mark.parametrize("focals", [(4.15, 4.17), (3.6, 3.7, 3.9, 3.65, 3.8, 3.75), (24, 35, 24, 24, 24, 24)])
def test_a_lens_that_follows_the_focus_and_a_zoom_of_few_photographs_are_one_camera(tmp_path, focals):
    for k, name in enumerate(flight(tmp_path)):
        of_unknown_sensor(tmp_path / name, focals[k % len(focals)])
    assert len(group_by_camera(collect_images([tmp_path]).images)) == 1


def with_serial(file: Path, serial: str) -> None:
    with Image.open(file) as image:
        exif, shown = image.getexif(), np.asarray(image)
    exif.get_ifd(0x8769)[0xA431] = serial
    picture(file, shown, exif=exif, quality=92)


@pytest.mark.parametrize(("serials", "count"), [("abcdef", 1), ("aabbcc", 1), ("aaabbb", 2), ("aaaabb", 2)])
def test_serial_numbers_of_one_or_two_photographs_each_are_no_cameras(tmp_path, serials, count):
    for name, serial in zip(flight(tmp_path), serials, strict=True):
        with_serial(tmp_path / name, serial)
    found = collect_images([tmp_path])
    assert len(group_by_camera(found.images)) == count
    told = [note for note in found.notes if "serial numbers" in note]
    assert len(told) == (count == 1)
    assert all(f"6 photographs have {len(set(serials))} serial numbers" in note for note in told)


@pytest.mark.parametrize("letters", ["XWDSA", "VNSWE"])
@pytest.mark.parametrize("name", ["DSC{:05d}_{}.JPG", "{1}/DSC{0:05d}_{1}.JPG", "DJI_{:04d}_{}.JPG"])
@pytest.mark.parametrize("size", [(160, 120), (130, 100)])
def test_lenses_of_a_rig_named_by_letters_are_all_used_and_overlap_each_for_itself(tmp_path, letters, name, size):
    """Whatever the sizes: no letter of them says a screen, as DJI's `_S` beside `_W` and `_V` does."""
    for k in range(4):
        for n, letter in enumerate(letters):
            file = tmp_path / name.format(k, letter)
            file.parent.mkdir(exist_ok=True)
            shown = pixels(10 * k + n, *(size if letter == "S" else (160, 120)))
            write_photograph(file, shown, 2 * k, np.array([10.0 * k, 0, 40]))
    found = collect_images([tmp_path])
    assert (len(found.images), found.excluded) == (20, ())
    first = replace(found, images=tuple(photo for photo in found.images if photo.name.endswith(f"{letters[0]}.JPG")))
    assert overlap_of(found) == pytest.approx(overlap_of(first), abs=0.02)


@pytest.mark.parametrize("late_s", [0, 1])
def test_two_drones_at_once_overlap_as_one_does(tmp_path, late_s):
    for drone, north in (("a", 0.0), ("b", 200.0)):
        (tmp_path / drone).mkdir()
        for k in range(6):
            place = np.array([5.0 * k, north, 40.0])
            file = tmp_path / drone / f"DJI_{k:04d}.JPG"
            write_photograph(file, pixels(k + int(north)), 3 * k + late_s * (drone == "b"), place)
    found = collect_images([tmp_path])
    one = replace(found, images=found.images[:6])
    assert overlap_of(found) == pytest.approx(overlap_of(one), abs=0.01)
    assert not any("they overlap by" in each for each in said(found))


def test_names_without_an_order_leave_a_flight_one(tmp_path):
    for k, name in enumerate(("ab", "cd", "ef", "gh", "ij", "kl")):
        write_photograph(tmp_path / f"{name}.jpg", pixels(k), 3 * k, np.array([5.0 * k, 0, 40.0]))
    assert overlap_of(collect_images([tmp_path])) == pytest.approx(0.84, abs=0.1)


def test_only_positions_without_an_altitude_are_named_as_such(tmp_path):
    names = flight(tmp_path)
    found = collect_images([tmp_path])
    images = [replace(photo, altitude=photo.altitude if k < 2 else None) for k, photo in enumerate(found.images)]
    notes = read_gps_priors(images, None, (1.0, 2.0)).notes
    words = f"{names[2]}, {names[3]}, {names[4]} and 1 more: the positions have no altitudes; those of 2 more are not"
    assert any(note.startswith(words) for note in notes)
    without = [replace(photo, altitude=None, relative_altitude=None) for photo in images]
    bare = read_gps_priors(without, None, (1.0, 2.0)).notes
    assert any("and 3 more: the positions have no altitudes. Positions give" in note for note in bare)


def test_overlap_and_pixels_are_those_of_the_wide_lens_where_a_zoom_flies_beside_it(tmp_path):
    """An H20T's `_W` and `_Z`: of the zoom, three times as long, photographs hardly overlap."""
    for k in range(8):
        for n, letter in enumerate("WZ"):
            shown = pixels(10 * k + n)
            write_photograph(tmp_path / f"DJI_{k:04d}_{letter}.JPG", shown, 3 * k, np.array([8.0 * k, 0, 40]))
    found = collect_images([tmp_path])
    images = [
        replace(photo, lens=replace(photo.lens, focal=(1 if photo.name.endswith("W.JPG") else 3) * photo.lens.focal))
        for photo in found.images
    ]
    assert len(images) == 16
    both = replace(found, images=tuple(images))
    alone = replace(found, images=tuple(photo for photo in images if photo.name.endswith("W.JPG")))
    one, other = (make_preflight_report(each, read_gps_priors(each.images, None, (1.0, 2.0))) for each in (both, alone))
    assert one.forward_overlap == pytest.approx(other.forward_overlap)
    assert one.gsd_m == pytest.approx(other.gsd_m)
    assert one.views_per_point == pytest.approx(other.views_per_point)


def test_flights_that_cover_each_others_gaps_have_none(tmp_path):
    for k in range(40):
        place = np.array([20.0 * (k % 4), 3.0 * (k // 4), 40.0])
        write_photograph(tmp_path / f"DJI_{k:04d}.JPG", pixels(k), 3 * k, place)
    found = collect_images([tmp_path])
    assert overlap_of(found) < 0.6
    assert not any("gaps come" in each for each in said(found))


@pytest.mark.parametrize(
    ("copied", "original"),
    [("copies", "mavic"), ("a/b", "flight"), ("a (1)", "flight"), ("backup 2023", "flight"), ("flight_copy", "flight")],
)
def test_of_copies_the_one_stays_that_does_not_say_that_it_is_one(tmp_path, copied, original):
    names = flight(tmp_path / original)
    (tmp_path / copied).mkdir(parents=True)
    for name in names:
        (tmp_path / copied / name).write_bytes((tmp_path / original / name).read_bytes())
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"{original}/{name}" for name in names]
    assert found.excluded[0].reason == f"is a copy of {original}/{names[0]}"
