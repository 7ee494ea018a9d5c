"""Thermal pictures among photographs: left out where the maker says so, or the name and a second sign do."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from support.flights import add_xmp, write_photograph
from support.small_flights import pixels
from vdgs.sfm.image_list import ImageList, collect_images

COUNT, SIZE, THERMAL = 5, (400, 300), (320, 256)


def shoot(
    folder: Path,
    names: list[str],
    number: int = 0,
    size: tuple[int, int] = SIZE,
    late_s: int = 0,
    focal_mm: float = 8.5,
) -> list[Path]:
    """Photographs a few seconds after each other."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        shown = pixels(number + k, *size)
        place = np.array([10.0 * k, 0.0, 40.0])
        write_photograph(folder / name, shown, 5 * k + late_s, place, focal_mm=focal_mm)
    return [folder / name for name in names]


def heat(files: list[Path], palette: int | None = None) -> list[Path]:
    """The files as a thermal camera shows them: in gray, or in the false color of one of OpenCV's palettes."""
    for file in files:
        with Image.open(file) as image:
            exif, gray = image.getexif(), np.asarray(image.convert("L"))
        shown = gray if palette is None else cv2.applyColorMap(gray, palette)[..., ::-1]
        Image.fromarray(np.ascontiguousarray(shown)).save(file, exif=exif, quality=90)
    return files


def rename_model(file: Path, model: str) -> None:
    with Image.open(file) as image:
        exif, shown = image.getexif(), np.asarray(image)
    exif[0x0110] = model
    Image.fromarray(shown).save(file, exif=exif, quality=95)


def add_segment(file: Path, marker: int, content: bytes) -> None:
    data = file.read_bytes()
    file.write_bytes(data[:2] + struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content + data[2:])


def used(found: ImageList) -> list[str]:
    return [photo.name for photo in found.images]


def only_thermal_are_left_out(folder: Path, visible: list[Path], thermal: list[Path], why: str) -> None:
    found = collect_images([folder])
    assert used(found) == sorted(str(file.relative_to(folder)) for file in visible)
    assert {each.name for each in found.excluded} == {str(file.relative_to(folder)) for file in thermal}
    assert all(why in each.reason and "give a folder of those alone" in each.reason for each in found.excluded)


@pytest.mark.parametrize("sign", ["ImageSource", "BandName", "XT", "FLIR", "DJI", "DJI behind a head"])
@pytest.mark.parametrize("together", [True, False])
def test_what_the_maker_calls_thermal_is_left_out_whatever_its_name_and_size(tmp_path, sign, together):
    """And used where all are thermal."""
    visible = shoot(tmp_path, [f"DJI_{2 * k:04d}.JPG" for k in range(COUNT)]) if together else []
    thermal = shoot(tmp_path, [f"DJI_{2 * k + 1:04d}.JPG" for k in range(COUNT)], 50, (300, 210))
    for file in visible:
        add_xmp(file, b'<rdf:Description drone-dji:ImageSource="WideCamera" Camera:BandName="NIR, Near infrared"/>')
    for file in thermal:
        if sign == "ImageSource":
            add_xmp(file, b'<rdf:Description drone-dji:ImageSource="InfraredCamera"/>')
        elif sign == "BandName":
            add_xmp(file, b'<rdf:Description Camera:BandName="LWIR"/>')
        elif sign == "XT":
            rename_model(file, "XT")
        elif sign == "FLIR":
            add_segment(file, 0xE1, b"FLIR\0\1\0\0" + bytes(40))
        else:
            add_segment(file, 0xE4, b"\xaa\x55\x12\x06" if sign == "DJI" else bytes(32) + b"\xaa\x55\x38\x00")
    if together:
        only_thermal_are_left_out(tmp_path, visible, thermal, "is a thermal picture (")
    else:
        assert len(collect_images([tmp_path]).images) == COUNT


@pytest.mark.parametrize(
    ("visible", "thermal"),
    [
        ("MAX_{:04d}.JPG", "IRX_{:04d}.JPG"),  # Autel
        ("DJI_{:04d}.JPG", "DJI_{:04d}_R.JPG"),  # DJI's XT2
        ("visible/a{:04d}.JPG", "thermal/b{:04d}.JPG"),
        ("rgb/a{:04d}.JPG", "ir/DCIM/100MEDIA/b{:04d}.JPG"),
        ("p{:04d}.JPG", "p{:04d}_IR.JPG"),
        ("DJI_{:04d}.JPG", "DJI_{:04d}_T.JPG"),
    ],
)
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("palette", [None, cv2.COLORMAP_INFERNO, cv2.COLORMAP_RAINBOW])
def test_what_its_name_calls_thermal_is_left_out_where_it_has_the_size_of_its_sensor(
    tmp_path, visible, thermal, together, palette
):
    """At any moment, but for those that one letter behind a name tells; and used where all are thermal."""
    names = [thermal.format(k) for k in range(COUNT)]
    (tmp_path / names[0]).parent.mkdir(parents=True, exist_ok=True)
    late_s = 1 if thermal.endswith(("_R.JPG", "_T.JPG")) else 1800
    cold = heat(shoot(tmp_path, names, 50, THERMAL, late_s), palette)
    if not together:
        assert len(collect_images([tmp_path]).images) == COUNT
        return
    names = [visible.format(k) for k in range(COUNT)]
    (tmp_path / names[0]).parent.mkdir(parents=True, exist_ok=True)
    only_thermal_are_left_out(tmp_path, shoot(tmp_path, names), cold, "by its name and size (320 x 256)")


@pytest.mark.parametrize(
    ("palette", "contrast", "mark"),
    [
        (None, 1.0, (0, 255, 0)),
        (cv2.COLORMAP_BONE, 1.0, None),
        (cv2.COLORMAP_INFERNO, 0.125, None),
        (cv2.COLORMAP_TURBO, 0.125, None),
        (cv2.COLORMAP_JET, 1.0, (255, 255, 255)),
    ],
)
def test_thermal_pictures_with_marks_and_of_few_colors_are_none_in_color(tmp_path, palette, contrast, mark):
    """Without a sure sign of color, what name and size say is so. A cross in the middle: 1 % of the pixels."""
    files = shoot(tmp_path, [f"IRX_{k:04d}.JPG" for k in range(COUNT)], 50, THERMAL)
    for file in files:
        with Image.open(file) as image:
            exif, gray = image.getexif(), np.asarray(image.convert("L"))
        gray = (gray * contrast + 120 * (1 - contrast)).astype(np.uint8)
        shown = np.stack([gray] * 3, 2) if palette is None else cv2.applyColorMap(gray, palette)[..., ::-1].copy()
        if mark:
            shown[126:132, 130:190] = shown[99:159, 157:163] = mark
        Image.fromarray(shown).save(file, exif=exif, quality=92)
    only_thermal_are_left_out(
        tmp_path, shoot(tmp_path, [f"MAX_{k:04d}.JPG" for k in range(COUNT)]), files, "by its name and size"
    )


@pytest.mark.parametrize("late_s", [1, 1800])
def test_what_its_folder_calls_thermal_is_left_out_beside_a_larger_photograph_of_its_moment(tmp_path, late_s):
    """A name alone is no sign."""
    visible = shoot(tmp_path / "rgb", [f"a{k}.JPG" for k in range(COUNT)])
    thermal = heat(shoot(tmp_path / "infrared", [f"b{k}.JPG" for k in range(COUNT)], 50, (300, 210), late_s))
    if late_s > 2:
        assert len(collect_images([tmp_path]).images) == 2 * COUNT
    else:
        only_thermal_are_left_out(tmp_path, visible, thermal, "by its name, and rgb/a")


@pytest.mark.parametrize("size", [(160, 120), SIZE])
@pytest.mark.parametrize("name", ["DJI_{:04d}_R.JPG", "FLIRTATION_{:04d}.JPG", "IRIS_{:04d}.JPG"])
def test_photographs_that_only_their_names_could_call_thermal_are_used(tmp_path, name, size):
    """As right ones of a pair, and those of a size like the others'."""
    shoot(tmp_path, [name.format(k) for k in range(COUNT)], 0, size, late_s=600)
    shoot(tmp_path, [f"p{k}.JPG" for k in range(COUNT)], 50, size)
    assert len(collect_images([tmp_path]).images) == 2 * COUNT


@pytest.mark.parametrize("folders", [("", ""), ("visible/", "other/")])
def test_djis_thermal_pictures_are_left_out_across_folders_and_without_a_partner(tmp_path, folders):
    stems = [f"DJI_2024032912000{k}_{k + 1:04d}" for k in range(COUNT)]
    visible = shoot(tmp_path / folders[0], [f"{stem}_W.JPG" for stem in stems[:-1]])
    thermal = heat(shoot(tmp_path / folders[1], [f"{stem}_T.JPG" for stem in stems], 50, (300, 210)))
    only_thermal_are_left_out(tmp_path, visible, thermal, "thermal picture")
    assert f"of the size of {folders[1]}{stems[0]}_T" in collect_images([tmp_path]).excluded[-1].reason


def test_what_djis_first_cameras_of_three_lenses_call_by_words_is_told_as_what_letters_tell(tmp_path):
    """The Zenmuse H20T of 2020: no source of the picture in its tags, one model for all."""
    shoot(tmp_path, [f"DJI_{k:04d}_WIDE.JPG" for k in range(COUNT)])
    shoot(tmp_path, [f"DJI_{k:04d}_ZOOM.JPG" for k in range(COUNT)], 20)
    heat(shoot(tmp_path, [f"DJI_{k:04d}_THRM.JPG" for k in range(COUNT)], 50, (300, 210)))
    shoot(tmp_path, [f"DJI_{k:04d}_SCRN.JPG" for k in range(COUNT)], 70, (320, 180))
    found = collect_images([tmp_path])
    assert {name.rpartition("_")[2] for name in used(found)} == {"WIDE.JPG", "ZOOM.JPG"}
    assert (
        "thermal picture beside DJI_0000_WIDE.JPG"
        in {each.name: each.reason for each in found.excluded}["DJI_0000_THRM.JPG"]
    )
    assert len(found.images) == len(found.excluded) == 2 * COUNT


@pytest.mark.parametrize(("focal_mm", "late_s"), [(20.0, 1), (8.5, 1), (20.0, 1800)])
def test_pictures_of_the_size_of_a_thermal_sensor_need_a_longer_lens_and_a_photograph_of_their_moment(
    tmp_path, focal_mm, late_s
):
    """As DJI's Mavic 2 Enterprise counts both in one row."""
    visible = shoot(tmp_path, [f"DJI_{2 * k:04d}.JPG" for k in range(COUNT)])
    thermal = heat(shoot(tmp_path, [f"DJI_{2 * k + 1:04d}.JPG" for k in range(COUNT)], 50, THERMAL, late_s, focal_mm))
    if (focal_mm, late_s) == (20.0, 1):
        only_thermal_are_left_out(tmp_path, visible, thermal, "by its size (320 x 256), its longer lens and its moment")
    else:
        assert len(collect_images([tmp_path]).images) == 2 * COUNT


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("IR/IMG_{:04d}.JPG", THERMAL), ("site_IR/IMG_{:04d}.JPG", (300, 210)), ("p{:04d}_R.JPG", THERMAL),
        ("p{:04d}_T.JPG", THERMAL), ("facade_T_{:02d}.JPG", THERMAL), ("DJI_{:04d}_T.JPG", (300, 210)),
    ],
)  # fmt: skip
def test_photographs_in_color_are_used_whatever_their_names(tmp_path, name, size):
    """Also beside larger ones of their number and moment."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    shoot(tmp_path, [f"p{k:04d}.JPG" for k in range(COUNT)])
    shoot(tmp_path, [f"DJI_{k:04d}_W.JPG" for k in range(COUNT)], 20)
    shoot(tmp_path, [name.format(k) for k in range(COUNT)], 50, size)
    assert len(collect_images([tmp_path]).images) == 3 * COUNT


@pytest.mark.parametrize("name", ["cam_R_{:04d}.JPG", "facade_T_{:04d}.JPG"])
def test_a_letter_tells_a_thermal_camera_only_beside_another_and_not_where_left_ones_are(tmp_path, name):
    """Gray ones, too: cameras of a rig."""
    shoot(tmp_path, [f"cam_F_{k:04d}.JPG" for k in range(COUNT)])
    heat(shoot(tmp_path, [f"cam_L_{k:04d}.JPG" for k in range(COUNT)], 20, THERMAL))
    heat(shoot(tmp_path, [name.format(k) for k in range(COUNT)], 50, THERMAL))
    assert len(collect_images([tmp_path]).images) == 3 * COUNT


def test_a_larger_photograph_of_the_moment_counts_where_it_is_of_the_maker_or_the_place(tmp_path):
    visible = shoot(tmp_path, [f"a{k}.JPG" for k in range(COUNT)])
    thermal = heat(shoot(tmp_path, [f"a{k}_IR.JPG" for k in range(COUNT)], 50, (300, 210)))
    for file in (*visible, *thermal):
        with Image.open(file) as image:
            exif, shown = image.getexif(), np.asarray(image)
        exif[0x010F] = "Other" if file in thermal else "Maker"
        if file in thermal:
            exif.get_ifd(0x8825)[2] = (1.0, 0.0, 0.0)
        Image.fromarray(shown).save(file, exif=exif, quality=95)
    assert len(collect_images([tmp_path]).images) == 2 * COUNT
