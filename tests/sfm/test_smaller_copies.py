"""Smaller copies of photographs, and smaller photographs whose names count from 1, too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from support.small_flights import flight, picture, pixels
from vdgs.sfm import photograph_versions
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import read_image_metadata


@pytest.mark.parametrize("rewritten", [False, True])
def test_smaller_copies_in_another_folder_are_left_out(tmp_path, rewritten):
    """Also those into which a program wrote its own date."""
    names = flight(tmp_path / "full")
    for name in names:
        with Image.open(tmp_path / "full" / name) as image:
            exif, shown = image.getexif(), np.asarray(image.resize((320, 240)))
        picture(tmp_path / "full" / name, shown, exif=exif)
        if rewritten:
            exif.get_ifd(0x8769)[0x9003] = "2026:07:01 12:00:00"
        picture(tmp_path / "web" / name, shown[::2, ::2], exif=exif)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"full/{name}" for name in names]
    assert all("smaller copy of full/" in each.reason for each in found.excluded)


@pytest.mark.parametrize(("late_s", "east_m"), [(1800, 0.0), (0, 50.0)])
def test_smaller_photographs_of_another_flight_are_no_copies(tmp_path, late_s, east_m):
    """Whose files count from 1 again: 48 megapixels, then 12."""
    for folder, count, size, late, east in (("1", 6, (320, 240), 0, 0.0), ("2", 4, (160, 120), late_s, east_m)):
        (tmp_path / folder).mkdir()
        for k in range(count):
            place = np.array([10.0 * k + east, 0.0, 40.0])
            write_photograph(tmp_path / folder / f"DJI_{k:04d}.JPG", pixels(k, *size), k + late, place)
    found = collect_images([tmp_path])
    assert (len(found.images), found.excluded) == (10, ())


def enlarged(shown: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(shown).resize((320, 240)))


def tags(camera: str, moment: str = "0000:00:00 00:00:00") -> Image.Exif:
    exif = Image.Exif()
    exif[0x0110] = camera
    exif.get_ifd(0x8769).update({0x9003: moment, 0xA405: 24})
    return exif


@pytest.mark.parametrize(
    ("name", "cameras"),
    [("frame_{:05d}.jpg", ()), ("{:04d}.png", ()), ("IMG_{:04d}.JPG", ("A", "B")), ("IMG_{:04d}.JPG", ("A", "A"))],
)
@pytest.mark.parametrize("is_copy", [False, True])
def test_smaller_pictures_whose_tags_tell_nothing_are_copies_where_they_show_the_same(tmp_path, name, cameras, is_copy):
    """Frames of two films, numbered pictures, and photographs by cameras whose clocks were never set. What two cameras
    took is no copy, whatever it shows."""
    for k in range(9):
        more = [{"exif": tags(camera)} for camera in cameras] or [{}, {}]
        picture(tmp_path / "first" / name.format(k + 1), enlarged(pixels(k)), **more[0])
        if k < 7:
            picture(tmp_path / "second" / name.format(k + 1), pixels(k if is_copy else 50 + k), **more[1])
    found = collect_images([tmp_path])
    left_out = 7 if is_copy and cameras != ("A", "B") else 0
    assert (len(found.images), len(found.excluded)) == (16 - left_out, left_out)
    assert all("smaller copy of first/" in each.reason for each in found.excluded)


def test_each_is_looked_at_where_some_of_a_folder_are_copies(tmp_path):
    for k in range(9):
        picture(tmp_path / f"full/{k}.jpg", enlarged(pixels(k)))
        picture(tmp_path / f"web/{k}.jpg", pixels(k if k % 2 else 50 + k))
    picture(tmp_path / "full/9.jpg", enlarged(pixels(9)))
    found = collect_images([tmp_path])
    assert [each.name for each in found.excluded] == [f"web/{k}.jpg" for k in (1, 3, 5, 7)]


def test_few_of_many_copies_are_decoded(tmp_path, monkeypatch):
    """Also where a program rewrote their dates."""
    for k in range(30):
        picture(tmp_path / f"full/{k}.jpg", pixels(k, 320, 240), exif=tags("A", f"2026:06:01 10:00:{k:02d}"))
        picture(tmp_path / f"web/{k}.jpg", pixels(k), exif=tags("A", f"2026:06:02 10:00:{k:02d}"))
    looked = list[Path]()
    monkeypatch.setattr(photograph_versions, "_gray_ranks", lambda path: looked.append(path) or np.arange(9.0))
    names = [f"{folder}/{k}.jpg" for folder in ("full", "web") for k in range(30)]
    found = photograph_versions.versions([read_image_metadata(tmp_path / name, name) for name in names])
    assert len(found) == 30
    assert len(looked) == 6


@pytest.mark.parametrize("is_copy", [False, True])
def test_measurements_of_16_bits_are_looked_at_over_their_whole_range(tmp_path, is_copy):
    for k in range(4):
        for folder, shown in (("a", enlarged(pixels(k))), ("b", pixels(k if is_copy else 50 + k))):
            picture(tmp_path / f"{folder}/{k}.png", shown[..., 0] * np.uint16(100) + np.uint16(5000))
    photographs = [
        read_image_metadata(tmp_path / f"{folder}/{k}.png", f"{folder}/{k}.png") for folder in "ab" for k in range(4)
    ]
    assert len(photograph_versions.versions(photographs)) == (4 if is_copy else 0)


def test_photographs_that_all_have_one_date_take_no_time_that_grows_with_their_square(tmp_path, monkeypatch):
    """Of a clock that stood still: 5000 took two minutes."""
    picture(tmp_path / "a.jpg", pixels(0), exif=tags("A", "2000:01:01 00:00:00"))
    one = read_image_metadata(tmp_path / "a.jpg", "a.jpg")
    named, kinds = list[str](), photograph_versions._kind_of_name
    monkeypatch.setattr(photograph_versions, "_kind_of_name", lambda photo: named.append(photo.name) or kinds(photo))
    assert not photograph_versions.versions([replace(one, name=f"DJI_{k:04d}.JPG") for k in range(200)])
    assert len(named) <= 200
