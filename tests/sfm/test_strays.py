"""What lies among the photographs of a flight and is none of them; files that are whole but for their end."""

from __future__ import annotations

import json
import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from support.flights import add_xmp, write_photograph
from support.raw_writer import write_dng
from support.small_flights import COUNT, flight, half, picture, pixels, said
from vdgs.captures import image_files
from vdgs.captures.image_files import decode_image, decode_mask
from vdgs.captures.strays import is_result, walk
from vdgs.config.sfm_options import SfmOptions
from vdgs.errors import CaptureError
from vdgs.sfm.cross_checks import strays
from vdgs.sfm.feature_extraction import write_upright_images
from vdgs.sfm.find_images import find_files
from vdgs.sfm.focal_decision import should_fix_focal
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images, is_image_folder
from vdgs.sfm.image_metadata import read_image_metadata
from vdgs.sfm.mask_files import apply_orientation
from vdgs.sfm.workspace import Workspace
from vdgs.system.lazy_pycolmap import pycolmap


def test_a_folder_with_several_links_to_it_is_entered_once_by_its_own_name(tmp_path):
    (tmp_path / "card/photos").mkdir(parents=True)
    for name in ("again", "more"):
        (tmp_path / "card" / name).symlink_to(tmp_path / "card/photos")
    assert [each for each, _, _ in walk(tmp_path / "card")] == [tmp_path / "card", tmp_path / "card/photos"]


# --------------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize(
    "named",
    [
        "{stem}_mask.JPG", "{stem}_mask.png", "{stem}-mask.png", "{stem}.mask.png", "{stem}_Mask.PNG",
        "mask_{stem}.png",
        "{stem}.JPG.png", "{stem}.JPG.mask.png", "masks/{stem}.png", "mask/{stem}.png", "_masks/{stem}.JPG",
        "masks/{stem}_mask.png", "images_masks/{stem}.JPG.png", "Mask/{stem}_mask.jpg", "my_masks/{stem}.tif",
    ],
)  # fmt: skip
def test_masks_by_any_usual_name_are_masks(tmp_path, named):
    names = flight(tmp_path)
    for name in names:
        picture(tmp_path / named.format(stem=name.removesuffix(".JPG")), half())
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert all(photo.mask is not None for photo in found.images)
    assert should_fix_focal(found.images, read_gps_priors(found.images, None, (1, 2)), SfmOptions())[0]


@pytest.mark.parametrize(
    "kind", ["0 and 1", "0 and 255", "16 bits", "16 bits of 255", "16 bits of 1", "one bit", "gray"]
)
def test_masks_of_every_scale_keep_the_same(tmp_path, kind):
    keep = half() > 0
    file = tmp_path / "mask.png"
    if kind == "one bit":
        Image.fromarray(keep).save(file)
    elif "16" in kind:
        top = 65535 if kind == "16 bits" else int(kind.split()[-1])
        cv2.imwrite(str(file), keep.astype(np.uint16) * top)
    else:
        picture(file, keep.astype(np.uint8) * (1 if kind == "0 and 1" else 200 if kind == "gray" else 255))
    assert np.array_equal(decode_mask(file, 160, 120), keep)
    assert np.array_equal(decode_mask(file, 80, 60), keep[::2, ::2])


# -------------------------------------------------------------------------------------------------- strays


@pytest.mark.parametrize(
    "folder",
    [
        ".Trashes/501", ".thumbnails", "@eaDir", "__MACOSX", "$RECYCLE.BIN", "System Volume Information", "thumbnails",
        "Thumbs", "odm_orthophoto", "odm_texturing/x", "opensfm/undistorted/images", "dsm", "orthophoto", "3_dsm_ortho",
        "project.files/0/0", "depth_maps", "renders", ".git/x", "Labels", "gt",
        "train-label-img", "label_images_semantic", "annotations", "segmentation", "Proxy",
        "Transcoded Media/Proxy Media",
    ],
)  # fmt: skip
@pytest.mark.parametrize("tagged", [True, False])
def test_folders_of_systems_and_programs_are_not_read(tmp_path, folder, tagged):
    names = flight(tmp_path)
    for k, name in enumerate(names):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        if tagged:
            write_photograph(tmp_path / folder / name, pixels(50 + k), k, np.zeros(3))
        else:
            picture(tmp_path / folder / name, pixels(50 + k))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert any(f"not read: {folder.partition('/')[0]}" in note for note in found.notes)
    assert not is_image_folder(tmp_path / folder.partition("/")[0] / "none")
    deepest = tmp_path / folder
    if "/" not in folder:  # given by itself it is what was asked for
        assert len(collect_images([deepest]).images) == COUNT


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("odm_orthophoto.tif", (300, 300)), ("site_orthomosaic.png", (160, 120)), ("dsm.tif", (160, 120)),
        ("plan_DSM.tif", (200, 200)), ("photographs.png", (300, 200)), ("contact sheet.jpg", (160, 120)),
        ("Screenshot 2026-06-01.png", (160, 120)), ("DJI_0001_thumb.JPG", (160, 120)),
        ("Screenshot_20260601-120000.png", (160, 120)), ("Schermata 2026-06-01.png", (160, 120)),
        ("DJI_0001_preview.jpg", (160, 120)),
        ("anything.jpg", (300, 100)), ("logo.png", (200, 200)),
    ],
)  # fmt: skip
def test_pictures_that_are_none_of_the_flight_are_left_out_and_change_no_rule(tmp_path, name, size):
    names = flight(tmp_path)
    picture(tmp_path / name, pixels(99, *size))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert [each.name for each in found.excluded] == [name.replace(" ", "_")]
    assert should_fix_focal(found.images, read_gps_priors(found.images, None, (1, 2)), SfmOptions())[0]


def test_pictures_of_the_screen_are_told_where_accents_are_letters_of_their_own():
    assert is_result(Path(unicodedata.normalize("NFD", "Capture d\u2019\u00e9cran 2026-06-01.png")))
    assert not is_result(Path("Screenshotel_0001.jpg"))


def test_photographs_of_folders_of_one_name_stay_apart_whatever_else_is_called_like_them(tmp_path):
    folders = [tmp_path / name for name in ("x/a", "y/a", "z/a_1", "z/A")]
    for folder in folders:
        folder.mkdir(parents=True)
        picture(folder / "1.png", pixels(0, 64, 48))
    found = find_files(folders).named
    assert found == {
        f"{name}/1.png": folder / "1.png" for name, folder in zip(("a_2", "a_3", "a_1", "A_4"), folders, strict=True)
    }


def test_maps_of_ours_among_photographs_are_left_out(tmp_path):
    names = flight(tmp_path)
    (tmp_path / "maps").mkdir()
    for folder in (tmp_path, tmp_path / "maps"):
        (folder / "map.json").write_text("{}")
        for name in ("hillshade.png", "preview.png", "visibility.tif", "orthophoto.tif"):
            picture(folder / name, pixels(7))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert any("maps" in note for note in found.notes)


def test_versions_of_photographs_in_another_folder_are_left_out(tmp_path):
    """Edited or raw; and not what another camera of a rig shows, at the same moments and places."""
    names = flight(tmp_path / "z")
    for k, name in enumerate(names):
        with Image.open(tmp_path / "z" / name) as image:
            exif, shown = image.getexif(), np.asarray(image)
        if k < 4:  # brighter, and without contrast in the lights
            picture(tmp_path / "edited" / name, (255 * (shown / 255) ** 0.6).clip(20, 230).astype(np.uint8), exif=exif)
        picture(tmp_path / "other camera" / name, pixels(50 + k), exif=exif)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [
        f"{folder}/{n}" for folder in ("other_camera", "z") for n in names
    ]
    assert all(f"another version of z/{each.name[-12:]}" in each.reason for each in found.excluded)


@pytest.mark.parametrize("name", ["{}-bearbeitet.jpg", "{}_HDR.jpg", "flight_{}_small.jpg"])
@pytest.mark.parametrize("change", ["", "stripped", "another moment", "another picture"])
def test_edited_versions_in_another_folder_under_another_name_are_left_out(tmp_path, name, change):
    """By the name and the moment, or by what they show; not those of other flights, whose files count from 1, too."""
    names = flight(tmp_path / "card")
    for k, first in enumerate(names[:4]):
        with Image.open(tmp_path / "card" / first) as image:
            exif, shown = image.getexif(), (255 * (np.asarray(image) / 255) ** 0.7).astype(np.uint8)
        if change.startswith("another"):
            exif.get_ifd(0x8769)[0x9003] = f"2026:06:02 12:00:{k:02d}"
        if change == "another picture":
            shown = pixels(60 + k)
        more = {} if change == "stripped" else {"exif": exif}
        picture(tmp_path / "out" / name.format(first.removesuffix(".JPG")), shown, quality=92, **more)
    found = collect_images([tmp_path])
    named = not name.startswith("flight")
    left_out = change == "" or (named and change != "another picture")
    assert len(found.images) == COUNT + (0 if left_out else 4)
    if left_out:
        assert all("another version of card/DJI_" in each.reason for each in found.excluded)


@pytest.mark.parametrize(
    ("name", "change", "left_out"),
    [
        ("edit_{}.jpg", "", True), ("{}_q80.jpg", "", True), ("edit_{}.png", "", True), ("{}_W.JPG", "", True),
        ("edit_{}.jpg", "moved", False), ("edit_{}.jpg", "another place", False), ("edit_{}.jpg", "exposure", False),
        ("DJI_1{}.JPG", "", False),
    ],
)  # fmt: skip
def test_photographs_that_were_saved_again_beside_the_first_are_left_out(tmp_path, name, change, left_out):
    """By what they show, under a name of another kind; not what a drone took at the same second and named so."""
    for k, first in enumerate(flight(tmp_path)):
        with Image.open(tmp_path / first) as image:
            exif, shown = image.getexif(), np.asarray(image)
        if k > 2:
            continue
        if change == "moved":
            shown = np.roll(shown, 4, axis=1)
        elif change == "another place":
            exif.get_ifd(0x8825)[2] = (33.0, 31.0, 0.0)
        elif change == "exposure":
            for each, time in ((first, 0.01), (None, 0.04)):
                exif.get_ifd(0x8769).update({0x829A: time, 0x829D: 2.8, 0x8827: 100})
                if each:
                    picture(tmp_path / each, shown, exif=exif)
        called = name.format(first.removesuffix(".JPG") if name.startswith("{") else k)
        picture(tmp_path / called, shown, quality=80, exif=exif)
    found = collect_images([tmp_path])
    assert len(found.images) == COUNT + (0 if left_out else 3)
    assert all(re.match("is a copy of DJI_", each.reason) for each in found.excluded)
    assert len(found.excluded) == (3 if left_out else 0)


@pytest.mark.parametrize("counted", ["20260601_100000-1", "20260601_100000(0)", "20260601_100000_1"])
@pytest.mark.parametrize("subseconds", [None, ("000", "500")])
def test_photographs_of_one_second_are_no_copies_of_each_other(tmp_path, counted, subseconds):
    """Cameras and programs that name photographs by their second count those of one; what is downloaded twice shows the
    same."""
    shown = [pixels(0), np.roll(pixels(0), 40, axis=1), pixels(0)]
    for name, each, part in zip(("20260601_100000", counted, "20260601_100000 (3)"), shown, (0, 1, 0), strict=True):
        write_photograph(tmp_path / f"{name}.jpg", each, 0, np.array([0.0, 0.0, 40.0]))
        with Image.open(tmp_path / f"{name}.jpg") as image:
            exif = image.getexif()
        if subseconds:
            exif.get_ifd(0x8769)[0x9291] = subseconds[part]
        picture(tmp_path / f"{name}.jpg", each, exif=exif, quality=90 + part)
    found = {photo.name: photo for photo in (read_image_metadata(file, file.name) for file in tmp_path.iterdir())}
    reasons, _ = strays([*found.values()])
    assert [*reasons] == ["20260601_100000 (3).jpg"]
    if subseconds:  # those of which both say it differ, whatever they show
        same = replace(found[f"{counted}.jpg"], path=found["20260601_100000.jpg"].path)
        assert not strays([found["20260601_100000.jpg"], same])[0]
        assert strays([found["20260601_100000.jpg"], replace(same, subsecond=0.0)])[0]


def test_raw_files_in_a_folder_beside_their_pictures_are_left_out(tmp_path):
    pytest.importorskip("rawpy")
    (tmp_path / "JPG").mkdir()
    for k in range(4):
        write_dng(tmp_path / f"DNG/p{k}.dng", pixels(k))
        write_photograph(tmp_path / f"JPG/p{k}.jpg", pixels(k, 152, 120), 0, np.array([10.0 * k, 0, 40]))
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [f"JPG/p{k}.jpg" for k in range(4)]
    assert all("another version of JPG/" in each.reason for each in found.excluded)


def test_a_photograph_that_lost_its_tags_is_used_as_the_others_of_its_size(tmp_path):
    names = flight(tmp_path)
    picture(tmp_path / names[2], pixels(2), quality=95)
    picture(tmp_path / "DJI_0099.JPG", np.repeat(half()[..., None], 3, 2), quality=95)  # a mask by another name
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert found.images[2].lens == found.images[1].lens
    assert "black and white" in found.excluded[0].reason
    assert any(f"{names[2]}: no tags of a camera; taken as by Maker Drone" in each for each in said(found))


@pytest.mark.parametrize(("lost", "lent"), [(COUNT // 2, True), (COUNT // 2 + 1, False)])
def test_where_half_lost_their_tags_they_are_of_the_others_camera(tmp_path, lost, lent):
    """And where more did, it is said that they may be."""
    names = flight(tmp_path)
    for k, name in enumerate(names[:lost]):
        picture(tmp_path / name, pixels(k), quality=95)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert len({photo.camera for photo in found.images}) == (1 if lent else 2)
    words = "taken as by Maker Drone" if lent else "but the size of those by Maker Drone.*exiftool -TagsFromFile"
    assert any(re.search(f"no tags of a camera[;,] {words}", each) for each in said(found))


def test_half_of_another_size_without_tags_are_photographs_and_masks_of_the_same_size_are_not(tmp_path):
    names = flight(tmp_path / "a")
    for k in range(COUNT):
        picture(tmp_path / f"a/other{k}.jpg", pixels(k, 200), quality=95)
        picture(tmp_path / f"b/mask{k}.jpg", np.repeat(half()[..., None], 3, 2), quality=95)
    assert len(collect_images([tmp_path / "a"]).images) == 2 * COUNT
    flight(tmp_path / "b")
    assert [photo.name for photo in collect_images([tmp_path / "b"]).images] == names


@pytest.mark.parametrize("beside", ["JPG.json", "JPG.supplemental-metadata.json", "HEIC.json", "xmp"])
def test_a_position_in_a_file_beside_a_stripped_photograph_takes_no_camera_from_it(tmp_path, beside):
    """Its camera and lens are those of the others of its size; of a size that no other has, its place speaks for it."""
    names = flight(tmp_path)
    for name, width in ((names[1], 160), (names[4], 160), ("DJI_0098.JPG", 200)):
        picture(tmp_path / name, pixels(int(name[4:8]) + 50, width), quality=95)
        place = json.dumps({"geoData": {"latitude": -33.5, "longitude": -70.6, "altitude": 540.0}})
        if beside == "xmp":
            place = '<rdf:Description exif:GPSLatitude="33,30.0S" exif:GPSLongitude="70,36.0W"/>'
        (tmp_path / name).with_suffix(f".{beside}").write_text(place)
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == [*names, "DJI_0098.JPG"]
    assert len({(photo.camera, photo.lens) for photo in found.images if photo.name in names}) == 1
    assert all(photo.lat_lon for photo in found.images)
    (tmp_path / "DJI_0098.JPG").with_suffix(f".{beside}").unlink()
    assert "has no tags of a camera, and 200 x 120 pixels" in collect_images([tmp_path]).excluded[0].reason


def test_photographs_without_any_tags_are_photographs(tmp_path):
    for k in range(COUNT):
        picture(tmp_path / f"{k}.png", pixels(k, 160 + 8 * (k % 2)))
    assert len(collect_images([tmp_path]).images) == COUNT


def test_linked_folders_are_read_and_loops_are_not(tmp_path):
    flight(tmp_path / "card")
    (tmp_path / "place").mkdir()
    (tmp_path / "place/sub").symlink_to(tmp_path / "card")
    (tmp_path / "card/loop").symlink_to(tmp_path / "card")
    (tmp_path / "card/up").symlink_to(tmp_path)
    (tmp_path / "card/gone.jpg").symlink_to(tmp_path / "nothing")
    for folder in (tmp_path / "card", tmp_path / "place"):
        assert len(collect_images([folder]).images) == COUNT


def test_thermal_pictures_beside_visible_ones_are_left_out(tmp_path):
    for name in flight(tmp_path):
        stem = name.removesuffix(".JPG")
        (tmp_path / name).rename(tmp_path / f"{stem}_V.JPG")
        thermal = np.repeat(pixels(int(stem[-1]), 128, 104)[..., :1], 3, 2)
        write_photograph(tmp_path / f"{stem}_T.JPG", thermal, 3, np.zeros(3))
    found = collect_images([tmp_path])
    assert [photo.name[-5] for photo in found.images] == ["V"] * COUNT
    assert all("thermal picture beside" in each.reason for each in found.excluded)
    for file in tmp_path.glob("*_V.JPG"):
        file.unlink()
    assert len(collect_images([tmp_path]).images) == COUNT


def test_cameras_of_one_moment_may_name_it_by_other_seconds(tmp_path):
    """Thermal pictures and pictures of the screen, as DJI names them; bands are left out."""
    for k in range(COUNT):
        for second, camera, size in ((59, "W", (160, 120)), (60, "T", (128, 104)), (59, "S", (150, 120))):
            time = f"2024032912{second // 60:02d}{second % 60:02d}"
            picture = pixels(k + len(camera) + second + size[0], *size)
            picture = np.repeat(picture[..., :1], 3, 2) if camera == "T" else picture
            write_photograph(tmp_path / f"DJI_{time}_{k + 1:04d}_{camera}.JPG", picture, k, np.zeros(3))
        Image.fromarray(np.full((120, 160), 300 * k, np.uint16)).save(tmp_path / f"DJI_{k + 1:04d}_MS_NIR.TIF")
    found = collect_images([tmp_path])
    assert [photo.name[-5] for photo in found.images] == ["W"] * COUNT
    reasons = [each.reason for each in found.excluded]
    for reason in ("thermal picture beside", "picture of the screen beside", "is of the band NIR"):
        assert sum(reason in each for each in reasons) == COUNT


def test_pictures_twice_as_wide_as_high_without_a_lens_are_remarked(tmp_path):
    for k in range(COUNT):
        picture(tmp_path / f"{k}.png", pixels(k, 240, 120))
    assert any(
        "If these are panoramas of 360°: --camera-model equirectangular" in each
        for each in said(collect_images([tmp_path]))
    )


@pytest.mark.parametrize(
    ("name", "size", "stitched"),
    [
        ("DJI_0003-Pano.jpg", (300, 130), True), ("DJI_0003_pano-2.jpg", (560, 160), True),
        ("PANO0001.JPG", (130, 300), True), ("DJI_0099.JPG", (960, 240), True),
        ("DJI_0098.JPG", (320, 140), False), ("Panorama_0001.JPG", (320, 240), False),
    ],
)  # fmt: skip
def test_long_pictures_with_the_tags_of_one_photograph_are_left_out_where_name_or_size_say_stitched(
    tmp_path, name, size, stitched
):
    names = [f"DJI_{k:04d}.JPG" for k in range(COUNT)]
    for k, each in enumerate(names):
        write_photograph(tmp_path / each, pixels(k, 320, 240), k, np.array((10.0 * k, 0.0, 40.0)))
    write_photograph(tmp_path / name, pixels(77, *size), 77, np.zeros(3))
    found = collect_images([tmp_path])
    assert [each.name for each in found.excluded if "is stitched" in each.reason] == [name] * stitched
    assert {photo.name for photo in found.images} == {*names, *([] if stitched else [name])}


def test_long_frames_of_films_without_tags_are_not_taken_for_stitched(tmp_path):
    for k in range(2 * COUNT):
        picture(tmp_path / f"{k:04d}.jpg", pixels(k, *((280, 120) if k % 2 else (160, 120))))
    assert len(collect_images([tmp_path]).images) == 2 * COUNT


def test_flights_of_long_pictures_alone_are_used(tmp_path):
    for k in range(COUNT):
        write_photograph(tmp_path / f"pano_{k}.JPG", pixels(k, 280, 120), k, np.array((10.0 * k, 0.0, 40.0)))
    assert len(collect_images([tmp_path]).images) == COUNT


def test_panoramas_are_named(tmp_path):
    names = flight(tmp_path)
    write_photograph(tmp_path / "PANO_0001.JPG", pixels(77, 240, 120), 77, np.zeros(3))
    add_xmp(tmp_path / "PANO_0001.JPG", b'<rdf:Description GPano:ProjectionType="equirectangular"/>')
    found = collect_images([tmp_path])
    assert [photo.name for photo in found.images] == names
    assert "is a panorama (equirectangular)" in found.excluded[0].reason


# -------------------------------------------------------------------------------------- kinds that are not read


@pytest.mark.parametrize(
    ("suffix", "remedy"),
    [
        (".HEIC", "pip install 'vdgs[photos]'"),
        (".cr3", "pip install 'vdgs[photos]'"),
        (".jxl", "convert them to JPEG, with their tags (djxl"),
        (".jp2", "convert"),
        (".jfif", "they are JPEG; rename"),
    ],
)
def test_photographs_of_kinds_that_are_not_read_are_named_with_the_remedy(tmp_path, monkeypatch, suffix, remedy):
    monkeypatch.setattr(image_files, "has_decoder", lambda _module: False)
    flight(tmp_path)
    for k in range(3):
        (tmp_path / f"IMG_{k}{suffix}").write_bytes(b"\0" * 40)
    (tmp_path / f"DJI_0001{suffix}").write_bytes(b"\0" * 40)  # beside its JPEG: no news
    found = collect_images([tmp_path])
    assert any(f"3 {suffix.lower()} files are not read: {remedy}" in note for note in found.notes)
    for file in tmp_path.glob("*.JPG"):
        file.unlink()
    with pytest.raises(CaptureError, match=re.escape(f"4 {suffix.lower()} files are not read: {remedy}")):
        collect_images([tmp_path])
    assert is_image_folder(tmp_path) == (suffix in (".HEIC", ".cr3"))


def test_films_are_named_where_there_is_nothing_else(tmp_path):
    (tmp_path / "DJI_0001.MP4").write_bytes(b"x")
    with pytest.raises(CaptureError, match=r"1 \.mp4 file is not read: name the films themselves"):
        collect_images([tmp_path])
    flight(tmp_path)
    assert not any("mp4" in note for note in collect_images([tmp_path]).notes)


def test_many_photographs_without_their_decoder_are_an_error(tmp_path, monkeypatch):
    """A few are a note; as many as those that are read are not left out with a note alone."""
    monkeypatch.setattr(image_files, "has_decoder", lambda _module: False)
    flight(tmp_path)
    for k in range(COUNT):
        (tmp_path / f"IMG_{k}.HEIC").write_bytes(b"\0" * 40)
    with pytest.raises(CaptureError, match=r"holds 6 photographs that can be read, and 6 \.heic .*'vdgs\[photos\]'"):
        collect_images([tmp_path])


def test_what_is_done_with_other_kinds_is_said(tmp_path):
    """Converted once, by the names of the capture; raw files beside their JPEG are left alone."""
    flight(tmp_path)
    pytest.importorskip("rawpy")
    for k in range(2):
        write_dng(tmp_path / f"R_{k}.DNG", pixels(k), orientation=6, lat_lon=(-33.5, -70.6))
    write_dng(tmp_path / "DJI_0001.DNG", pixels(0))
    Image.fromarray(pixels(9)).convert("CMYK").save(tmp_path / "print.jpg", quality=98, subsampling=0)
    notes = " ".join((found := collect_images([tmp_path])).notes)
    assert "R_0.DNG, R_1.DNG: raw; developed alike (the daylight white balance" in notes
    assert "(R_0.DNG.jpg)" in notes
    assert "1 .dng file is not used, but the pictures of the same names beside" in notes
    raw = next(each for each in found.images if each.name == "R_0.DNG")
    assert (raw.size, raw.lat_lon, raw.camera) == ((120, 160), pytest.approx((-33.5, -70.6)), "Maker Drone")
    workspace = Workspace(tmp_path.parent / "work")
    assert not write_upright_images(workspace, found.images, 1)
    shown = decode_image(workspace.images / "R_0.DNG")[0]
    off = np.abs(shown.astype(int) - np.rot90(pixels(0), -1))
    assert off[20:-20, 20:-20].mean() < 12  # the sensor has one color of three at each pixel


@pytest.mark.parametrize(("sides", "count"), [(("train", "test"), 1), (("train", "val"), 1), (("a", "b"), 0)])
def test_folders_of_a_split_are_said_to_decide_nothing(tmp_path, sides, count):
    for k in range(6):
        picture(tmp_path / sides[k % 2] / "rgb" / f"{k}.png", cv2.GaussianBlur(pixels(k), (0, 0), 4))
    notes = collect_images([tmp_path]).notes
    assert sum("3 photographs lie in train/ and 3 in" in note and "--test-list FILE" in note for note in notes) == count


@pytest.mark.parametrize("orientation", [1, 6])
def test_colmap_gets_pixels_of_every_format_that_is_read(tmp_path, orientation):
    """By the content of a file: COLMAP's decoder finds nothing in some formats, and reads others black."""
    tags = Image.Exif()
    tags[0x0112] = orientation
    formats = {
        "a.webp": {"lossless": True}, "webp.jpg": {"format": "WEBP", "lossless": True}, "gif.png": {"format": "GIF"},
        "jpeg2000.tif": {"format": "JPEG2000"}, "zstd.tif": {"compression": "zstd"},
        "lzma.tif": {"compression": "lzma"}, "lzw.tif": {"compression": "tiff_lzw"},
        "jpeg.tif": {"compression": "jpeg", "quality": 98}, "named.webp": {"format": "JPEG", "quality": 98},
        "plain.tif": {}, "b.png": {}, "c.bmp": {}, "png.jpg": {"format": "PNG"},
    }  # fmt: skip
    for k, (name, how) in enumerate(formats.items()):
        picture(tmp_path / "in" / name, cv2.GaussianBlur(pixels(k), (0, 0), 4), exif=tags, **how)
    found = collect_images([tmp_path / "in"])
    assert {each.name for each in found.images} == formats.keys()
    assert "WebP; converted to 8-bit sRGB and written as JPEG (a.webp.jpg)" in " ".join(found.notes)
    assert "zstd.tif: TIFF compressed by zstd; converted" in " ".join(found.notes)
    workspace = Workspace(tmp_path / "work")
    assert not write_upright_images(workspace, found.images, 1)
    for photo in found.images:
        seen = pycolmap.Bitmap.read(str(workspace.images / photo.name), True).to_array()
        shown = apply_orientation(decode_image(photo.path)[0], photo.orientation)
        assert np.abs(seen.astype(int) - shown).mean() < 2, photo.name
