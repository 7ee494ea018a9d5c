"""Photographs that a program cut: what their focal length is then, and cut or copied ones beside the whole ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from support.flights import write_photograph
from support.small_flights import COUNT, flight, picture, pixels
from vdgs.config.sfm_options import SfmOptions
from vdgs.sfm.cross_checks import cross_checked
from vdgs.sfm.feature_extraction import CameraGroup, group_by_camera
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.incremental_mapper import ASKED, fit_doubted, should_fix_focal
from vdgs.sfm.preflight import make_preflight_report
from vdgs.system.lazy_pycolmap import pycolmap

WHOLE = (160, 120)


def seen_with(folder: Path, size: tuple[int, int], count: int = 2) -> tuple[list[ImageMetadata], list[ImageMetadata]]:
    """A flight in which some photographs have another size, as if EXIF's size was rewritten; whole ones, and those."""
    flight(folder)
    images = list(collect_images([folder]).images)
    images[:count] = [replace(photo, width=size[0], height=size[1]) for photo in images[:count]]
    checked = cross_checked(images)
    return checked[count:], checked[:count]


@pytest.mark.parametrize(
    ("size", "how"), [((100, 100), "cut only"), ((90, 110), "cut only"), ((64, 64), "shrunk"), ((128, 60), "cut only")]
)
def test_another_shape_that_is_smaller_on_both_sides_is_doubted_and_named(tmp_path, size, how):
    whole, cut = seen_with(tmp_path, size)
    pixels_of = {photo.lens.focal * max(photo.size) for photo in cut}
    expected = whole[0].lens.focal * (max(WHOLE) if how == "cut only" else max(size))
    assert [*pixels_of] == [pytest.approx(expected)]
    assert all(f"as if it was {how}" in photo.doubts[-1] and photo.lens.doubt for photo in cut)
    assert not any(photo.doubts for photo in whole)
    positions = read_gps_priors([*cut, *whole], None, (1.0, 2.0))
    assert should_fix_focal([*cut, *whole], positions, SfmOptions())[0]
    assert [group.is_doubted for group in group_by_camera([*cut, *whole])] == [True, False]
    listed = replace(collect_images([tmp_path]), images=(*cut, *whole))
    warnings = make_preflight_report(listed, positions).warnings
    assert any("DJI_0001.JPG, DJI_0002.JPG: of another shape than most of its camera" in each for each in warnings)


@pytest.mark.parametrize("size", [(160, 90), (120, 120), (80, 45), (60, 60), (80, 60), (200, 200), (320, 240),
             (112, 63), (108, 72)])  # fmt: skip
def test_modes_of_a_camera_are_not_doubted(tmp_path, size):
    """The whole width or height of the sensor, with half the pixels across, too, or larger; and stills of the size of
    films, shrunk from the whole width."""
    _, other = seen_with(tmp_path, size)
    assert not any(photo.lens.doubt for photo in other)


def test_the_same_shape_is_taken_as_shrunk_and_that_is_said(tmp_path):
    whole, small = seen_with(tmp_path, (120, 90))
    assert {photo.lens for photo in small} == {whole[0].lens}
    assert all("as if it was shrunk, not cut" in photo.doubts[-1] for photo in small)


@pytest.mark.parametrize("why", ["one height", ASKED])
def test_a_doubted_focal_length_alone_is_fitted_where_those_of_the_others_are_held(why):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, 6, 150
    model = pycolmap.synthesize_dataset(options)
    true = [model.cameras[k].focal_length for k in (1, 2)]
    model.cameras[2].focal_length *= 1.2
    as_held = pycolmap.BundleAdjustmentOptions()
    as_held.print_summary, as_held.refine_focal_length = False, False
    pycolmap.bundle_adjustment(model, as_held)  # what a mapper makes of it
    groups = [
        CameraGroup(
            camera="", width=0, height=0, focal_px=true[0], has_focal_prior=True, source="", images=(),
            is_doubted=doubted,
        )
        for doubted in (False, True)
    ]  # fmt: skip
    fit_doubted(model, (True, why), groups, 1)
    assert model.cameras[1].focal_length == true[0]
    assert (model.cameras[2].focal_length == pytest.approx(true[1], rel=0.01)) is (why != ASKED)


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
