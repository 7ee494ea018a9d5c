"""Copies of photographs that a program undistorted or saved again: none beside the originals, whatever they show."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from support.small_flights import flight, picture
from vdgs.sfm.image_list import collect_images

NAMES = [f"DJI_{k + 1:04d}.JPG" for k in range(4)]
SIZE = (320, 240)


def ground(number: int) -> np.ndarray:
    """Something with detail of all sizes, [h, w, 3] uint8."""
    random = np.random.default_rng(number)
    sums = np.zeros((SIZE[1], SIZE[0], 3))
    for cell in (40, 20, 10, 5):
        rough = random.uniform(0, 255, (SIZE[1] // cell, SIZE[0] // cell, 3))
        sums += cv2.resize(rough, SIZE, interpolation=cv2.INTER_CUBIC)
    return (sums / 4).clip(0, 255).astype(np.uint8)


def bent(
    shown: np.ndarray, bend: float = 0.0, wider: int = 0, moved: float = 0.0, turned_deg: float = 0.0
) -> np.ndarray:
    """The picture of another lens, `wider` by so many pixels; of a camera that `moved` by a share of the width."""
    height, width = shown.shape[:2]
    y, x = np.mgrid[: height - wider, : width + wider].astype(np.float64)
    x, y = x + 0.5 - (width + wider) / 2, y + 0.5 - (height - wider) / 2
    factor = 1 + bend * (x**2 + y**2) / width**2
    c, s = np.cos(np.radians(turned_deg)), np.sin(np.radians(turned_deg))
    u = (c * x - s * y) * factor + (0.5 + moved) * width - 0.5
    v = (s * x + c * y) * factor + height / 2 - 0.5
    return cv2.remap(shown, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def two_folders(root: Path, first: str, second: str, **change: float) -> tuple[list[str], list[str]]:
    """The names of what is used and what is left out of a folder and one of the same names, changed."""
    for k, name in enumerate(NAMES):
        picture(root / first / name, ground(k), quality=95)
        picture(root / second / name, bent(ground(k), **change), quality=90)
    found = collect_images([root])
    return [photo.name for photo in found.images], [each.name for each in found.excluded]


@pytest.mark.parametrize("change", [{}, {"bend": -0.15}, {"bend": 0.2, "wider": 4}], ids=["saved again", "in", "out"])
def test_undistorted_copies_in_a_folder_of_any_name_are_left_out(tmp_path, change):
    used, left_out = two_folders(tmp_path, "photos", "x/results", **change)
    assert used == [f"photos/{name}" for name in NAMES]
    assert left_out == [f"x/results/{name}" for name in NAMES]


@pytest.mark.parametrize(
    ("first", "second", "change"),
    [
        ("monday", "friday", {"moved": 0.03}),
        ("monday", "friday", {"turned_deg": 2.0}),
        ("flight1", "flight2", {}),
        ("image_left", "image_right", {}),
    ],
)
def test_other_photographs_of_the_same_names_are_used(tmp_path, first, second, change):
    used, left_out = two_folders(tmp_path, first, second, **change)
    assert (len(used), left_out) == (8, [])


def test_a_second_flight_to_the_same_places_is_used(tmp_path):
    """Cameras say when."""
    for folder in ("monday", "friday"):
        names = flight(tmp_path / folder)
        for name in names if folder == "friday" else ():
            with Image.open(tmp_path / folder / name) as image:
                exif, shown = image.getexif(), np.asarray(image)
            exif.get_ifd(0x8769)[0x9003] = f"2026:07:01 12:{int(name[4:8]):02d}:00"
            picture(tmp_path / folder / name, shown[::-1], exif=exif)
    assert not collect_images([tmp_path]).excluded


@pytest.mark.parametrize(
    "folder",
    ["undistorted_images", "undistorted", "rectified", "images_undistorted", "corrected_images", "dense/images"],
)
def test_folders_called_undistorted_are_left_out_beside_originals_alone(tmp_path, folder):
    names = flight(tmp_path / "images")
    for k, name in enumerate([*names, "DJI_0099.JPG"]):
        picture(tmp_path / folder / name, np.full((118, 162, 3), 20 * k, np.uint8))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images if "images/DJI_0099" not in photo.name][:6] == [
        f"images/{name}" for name in names
    ]
    assert sum("undistorted copy of images/" in each.reason for each in found.excluded) == len(names)
    assert len(collect_images([tmp_path / folder.partition("/")[0]]).images) == len(names) + 1


@pytest.mark.parametrize("folder", ["confidence", "conf", "monodepth", "depth_da", "flow", "instance", "sky_mask"])
def test_pictures_about_photographs_are_left_out_beside_these_alone(tmp_path, folder):
    names = flight(tmp_path / "images")
    for k, name in enumerate(names):
        picture(tmp_path / folder / name.replace(".JPG", ".png"), ground(k)[..., 0])
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"images/{name}" for name in names]
    assert any(f"not read: {folder} (results" in note for note in found.notes)
    assert len(collect_images([tmp_path / folder]).images) == len(names)


def test_photographs_in_a_folder_called_like_results_are_used(tmp_path):
    flight(tmp_path / "images", 3)
    for k, name in enumerate(flight(tmp_path / "flow", 3)):
        with Image.open(tmp_path / "flow" / name) as image:
            exif = image.getexif()
        exif.get_ifd(0x8769)[0x9003] = f"2026:07:01 12:{k:02d}:00"
        picture(tmp_path / "flow" / name, ground(k), exif=exif)
    assert len(collect_images([tmp_path]).images) == 6


def test_masks_by_number_and_previews_of_a_set_are_left_out(tmp_path):
    for k in range(4):
        picture(tmp_path / f"frame_{k:04d}.png", ground(k))
        picture(tmp_path / f"dynamic_mask_{k}.png", np.zeros((240, 320), np.uint8))
    picture(tmp_path / "thumbnail.jpg", ground(0)[::2, ::2])
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"frame_{k:04d}.png" for k in range(4)]
    assert len(found.excluded) == 5
