"""Photographs that a program cut: what their focal length is then, and cut or copied ones beside the whole ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from support.small_flights import COUNT, flight, picture, pixels
from vdgs.sfm.cross_checks import cross_checked
from vdgs.sfm.cut_pictures import cut_pictures
from vdgs.sfm.edited_names import first_stems
from vdgs.sfm.focal_length import EQUIVALENT, Lens
from vdgs.sfm.image_list import collect_images

WHOLE = (160, 120)


def left_out_of(folder: Path, size: tuple[int, int], count: int = 2) -> list[str]:
    """The photographs of a flight that are left out where some have another size, to which a program cut them and wrote
    EXIF's anew."""
    flight(folder)
    images = list(collect_images([folder]).images)
    images[:count] = [replace(photo, width=size[0], height=size[1]) for photo in images[:count]]
    return list(cut_pictures(images))


def test_pictures_that_were_cut_are_named_with_the_size_of_the_others(tmp_path):
    for k, name in enumerate(flight(tmp_path)[:2]):
        write_photograph(tmp_path / name, pixels(k, 100, 100), k, np.array([10.0 * k, 0, 40]))
    said = [(each.name, each.reason) for each in collect_images([tmp_path]).excluded]
    assert [name for name, _ in said] == ["DJI_0001.JPG", "DJI_0002.JPG"]
    assert all("100 x 100 px, others 160 x 120" in reason and "Give it as" in reason for _, reason in said)


@pytest.mark.parametrize("size", [(100, 100), (90, 110), (72, 72), (128, 60)])
def test_pictures_that_are_cut_on_both_sides_are_left_out_where_they_are_few(tmp_path, size):
    assert left_out_of(tmp_path / "few", size) == ["DJI_0001.JPG", "DJI_0002.JPG"]
    assert left_out_of(tmp_path / "half", size, COUNT // 2) == []  # another mode of the camera?


@pytest.mark.parametrize(
    "size",
    [
        (160, 90),
        (120, 120),
        (118, 118),
        (80, 45),
        (60, 60),
        (80, 60),
        (200, 200),
        (320, 240),
        (120, 90),
        (112, 63),
        (108, 72),
        (128, 67),
    ],
)
def test_modes_of_a_camera_are_used(tmp_path, size):
    """The whole width or height of the sensor, with half the pixels across, too, or larger; stills of the size of
    films, shrunk from the whole width; and what was shrunk alone."""
    assert left_out_of(tmp_path, size) == []


@pytest.mark.parametrize(("size", "focal"), [((118, 118), 0.7 * 160 / 118), ((158, 119), 0.7), ((80, 60), 0.7)])
def test_a_mode_of_nearly_the_whole_height_has_the_pixels_of_the_others(tmp_path, size, focal):
    """As phones and cameras take 2992 x 2992 px of 4000 x 3000. A shrunk one of the shape of the others has not."""
    flight(tmp_path)
    images = [replace(photo, lens=Lens(0.7, EQUIVALENT)) for photo in collect_images([tmp_path]).images]
    images[0] = replace(images[0], width=size[0], height=size[1])
    lens = cross_checked(images)[0].lens
    assert lens is not None
    assert lens.focal == pytest.approx(focal)


def cut_copy(folder: Path, name: str, file: Path, box: tuple[int, int, int, int], moment: str = "") -> None:
    with Image.open(file) as image:
        exif, shown = image.getexif(), np.asarray(image.crop(box))
    if moment:
        exif.get_ifd(0x8769)[0x9003] = moment
    picture(folder / name, shown, exif=exif, quality=92)


@pytest.mark.parametrize(
    ("box", "moment", "left_out"),
    [
        ((20, 10, 130, 110), "", True),
        ((0, 0, 120, 120), "", True),
        ((20, 10, 130, 110), "2026:06:02 10:00:00", False),
    ],
)
def test_a_cut_copy_beside_its_whole_photograph_is_left_out(tmp_path, box, moment, left_out):
    """Whichever folder has more; not those of another flight whose files count from 1, too."""
    names = flight(tmp_path / "orig")
    for name in names:
        cut_copy(tmp_path / "cut", name, tmp_path / "orig" / name, box, moment)
    (tmp_path / "orig" / names[-1]).unlink()
    found = collect_images([tmp_path])
    assert [each.name for each in found.excluded] == ([f"cut/{name}" for name in names[:-1]] if left_out else [])
    assert all("is cut from orig/DJI_" in each.reason for each in found.excluded)


def test_other_lenses_of_one_name_and_moment_are_no_cut_copies(tmp_path):
    """A drone with two lenses and one serial number, in folders of any name: the pictures show other things."""
    names = flight(tmp_path / "nadir")
    (tmp_path / "oblique").mkdir()
    for k, name in enumerate(names):
        write_photograph(tmp_path / "oblique" / name, pixels(50 + k, 160, 100), k, np.array([10.0 * k, 0, 40]))
    assert collect_images([tmp_path]).excluded == ()


@pytest.mark.parametrize("kind", ["white", "16 bits"])
def test_pictures_that_show_nothing_to_compare_are_no_cut_copies(tmp_path, kind):
    """A burnt-out picture, and the measurements of another sensor under the name of one camera."""
    for name in flight(tmp_path / "orig"):
        with Image.open(tmp_path / "orig" / name) as image:
            exif = image.getexif()
        shown = (
            np.full((100, 110, 3), 255, np.uint8) if kind == "white" else pixels(9, 110, 100)[..., 0] * np.uint16(90)
        )
        picture(tmp_path / "other" / Path(name).with_suffix(".tif"), shown, exif=exif)
    assert not [each for each in collect_images([tmp_path]).excluded if "is cut from" in each.reason]


def test_a_cut_copy_that_was_shrunk_and_brightened_is_left_out(tmp_path):
    names = flight(tmp_path / "orig")
    with Image.open(tmp_path / "orig" / names[0]) as image:
        shown = np.clip(np.asarray(image.crop((10, 20, 130, 110)).resize((96, 72))) * 1.1 + 5, 0, 255).astype(np.uint8)
        picture(tmp_path / "small" / names[0], shown[:70], exif=image.getexif(), quality=92)
    assert [each.name for each in collect_images([tmp_path]).excluded] == [f"small/{names[0]}"]


def test_lenses_of_a_rig_with_other_sizes_are_no_cut_copies(tmp_path):
    for folder, size in (("cam1", (160, 120)), ("cam2", (130, 130))):
        (tmp_path / folder).mkdir()
        for k in range(COUNT):
            write_photograph(tmp_path / folder / f"{k:04d}.JPG", pixels(k, *size), k, np.array([10.0 * k, 0, 40]))
    assert collect_images([tmp_path]).excluded == ()


@pytest.mark.parametrize("tagged", [True, False])
def test_photographs_that_a_program_converted_beside_them_are_copies_and_no_masks(tmp_path, tagged):
    names = flight(tmp_path)
    for name in names:
        with Image.open(tmp_path / name) as image:
            exif = image.getexif() if tagged else Image.Exif()
            image.point(lambda value: min(255, int(1.3 * value))).save(tmp_path / f"{name}.jpg", exif=exif, quality=60)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images if photo.mask is None] == names
    assert len(found.excluded) == len(names) == len(found.images)


@pytest.mark.parametrize(
    "behind", [" — kopia", "_–_Kopia_(2)", " — копия", " - Kopio", " - コピー", " - 副本", " - 복사본"]
)
def test_copies_are_told_as_systems_of_many_languages_name_them(behind):
    assert first_stems(f"DJI_0003{behind}") == ["dji_0003"]


@pytest.mark.parametrize(
    "name",
    [
        "Copy of {}.JPG", "Kopie von {}.JPG", "Copie de {}.JPG", "Copia di {}.JPG", "Cópia de {}.JPG",
        "Copy of Copy of {}.JPG", "{} - Copy.JPG", "{} - Copy (2).JPG", "{} - kopia.JPG", "{} (1).JPG",
        "{}_cropped.JPG",
    ],
)  # fmt: skip
def test_copies_that_were_written_anew_are_told_by_their_names(tmp_path, name):
    names = flight(tmp_path)
    stem, first = names[2].removesuffix(".JPG"), tmp_path / names[2]
    cut_copy(tmp_path, name.format(stem), first, (0, 0, *WHOLE))
    if name.startswith("Copy of Copy"):
        cut_copy(tmp_path, f"Copy of {stem}.JPG", first, (0, 0, 159, 119))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert all("is a copy or another version of" in each.reason or "is a copy of" in each.reason
               for each in found.excluded)  # fmt: skip
