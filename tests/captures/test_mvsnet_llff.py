"""Cameras of MVSNet (BlendedMVS) and poses of LLFF: written here as their tools write them, read as one scene."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import TinyScene, assert_sees_the_scene, write_colmap, write_images, write_ply
from support.dataset_layouts import write_llff, write_mvsnet
from vdgs.captures.format_dispatch import lacks_points, read_source
from vdgs.captures.formats.mvsnet import read_mvsnet
from vdgs.captures.formats.source_capture import NoTiePoints, SourceCapture
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_output
from vdgs.cli.capture_cmds import sfm_command
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError, VdgsError
from vdgs.sfm.image_list import collect_images

Write = Callable[[Path, TinyScene], object]


def write_any(root: Path, scene: TinyScene, kind: str) -> TinyScene:
    """Either layout, and the views by the names that a capture gives them."""
    if kind == "mvsnet":
        return write_mvsnet(root, scene)
    write_llff(root, scene)
    return scene


def cameras_of(source: SourceCapture) -> list[str]:
    return [view.name for view in source.views]


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_every_point_falls_on_its_pixel(tmp_path, scene, kind):
    expected = write_any(tmp_path, scene, kind)
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert capture.source == kind
    assert not capture.ground.metric
    assert_sees_the_scene(capture, expected)
    assert not any("no camera" in warning for warning in capture.warnings)
    assert len(capture.test_views) == 2  # every 8th of 12


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_the_written_poses_are_those_that_are_read(tmp_path, scene, kind):
    expected = write_any(tmp_path, scene, kind)
    source = read_source(tmp_path, CaptureOptions(), needs_points=False)
    assert cameras_of(source) == sorted(expected.cameras)
    for view in source.views:
        camera = expected.cameras[view.name]
        np.testing.assert_allclose(view.camera_from_world, camera.camera_from_world, atol=1e-12)
        assert view.intrinsics.focal == (camera.fx, camera.fy)
        assert view.intrinsics.principal_point == (camera.cx, camera.cy)


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_points_are_to_be_found_or_come_from_a_model_of_the_same_photographs(tmp_path, scene, kind):
    expected = write_any(tmp_path, scene, kind)
    assert lacks_points(tmp_path, CaptureOptions())
    with pytest.raises(NoTiePoints, match=r"no 3D points.*vdgs sfm .* --output CAPTURE"):
        load_capture(tmp_path)
    write_colmap(tmp_path, expected, images=None)
    capture = load_capture(tmp_path, CaptureOptions(up="z", format=kind))
    assert capture.source == kind
    assert_sees_the_scene(capture, expected)
    images = "blended_images" if kind == "mvsnet" else None
    assert load_capture(tmp_path, CaptureOptions(images=images)).source == "colmap"


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_shrunk_photographs_have_the_lens_of_their_size(tmp_path, scene, kind):
    write_any(tmp_path, scene, kind)
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    folder = tmp_path / ("blended_images" if kind == "mvsnet" else "images")
    (tmp_path / "images_4").mkdir()
    for number, file in enumerate(sorted(each for each in folder.iterdir() if "masked" not in each.name)):
        name = file.name if kind == "mvsnet" else f"image{number:03d}.png"  # NeRF's sets have other names there
        cv2.imwrite(str(tmp_path / "images_4" / name), cv2.resize(cv2.imread(str(file)), None, fx=0.25, fy=0.25))
    for gone in (False, True):
        if gone:
            shutil.rmtree(folder)
        camera = load_capture(tmp_path, CaptureOptions(images="images_4")).views[0].camera
        first = next(iter(scene.cameras.values()))
        assert (camera.width, camera.height) == (first.width // 4, first.height // 4)
        assert (camera.fx, camera.cx) == pytest.approx((first.fx / 4, first.cx / 4))
    assert load_capture(tmp_path).images == "images_4"


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_photographs_lie_in_the_root(tmp_path, scene, kind):
    expected = write_any(tmp_path, scene, kind)
    folder = tmp_path / ("blended_images" if kind == "mvsnet" else "images")
    for file in folder.iterdir():
        file.rename(tmp_path / file.name)
    folder.rmdir()
    assert lacks_points(tmp_path, CaptureOptions())
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert capture.images == "."
    assert_sees_the_scene(capture, expected)
    assert cameras_of(read_source(tmp_path, CaptureOptions(images="."))) == [view.name for view in capture.views]


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_poses_that_cannot_be_used_are_no_dead_end(tmp_path, scene, kind):
    """As of photographs that were added, or of files of others by the same name; the remedy leads on."""
    write_any(tmp_path, scene, kind)
    images = tmp_path / ("blended_images" if kind == "mvsnet" else "images")
    if kind == "llff":
        next(images.iterdir()).unlink()
    else:
        for file in (tmp_path / "cams").iterdir():
            file.write_text("something else")
    with pytest.raises(CaptureError, match=r"\nTo make new poses .* a folder of them without poses"):
        sfm_command([str(tmp_path), "--output", str(tmp_path / "made")])
    with pytest.raises(CaptureError, match="a scene needs 3"):  # their size is all that is wrong with these
        sfm_command([str(images), "--output", str(tmp_path / "made")])


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_it_is_named_from_above_and_guarded(tmp_path, scene, kind):
    write_any(tmp_path / "scan1", scene, kind)
    with pytest.raises(CaptureError, match=r"scan1 is a capture: vdgs run"):
        load_capture(tmp_path)
    with pytest.raises(CaptureError, match=r"is a capture already"):
        collect_images([tmp_path / "scan1"])
    part = "poses_bounds.npy" if kind == "llff" else "cams/00000003_cam.txt"
    with pytest.raises(CaptureError, match=rf"part of a capture. Give the folder of it all: {tmp_path / 'scan1'}$"):
        load_capture(tmp_path / "scan1" / part)
    with pytest.raises(VdgsError, match="for inputs of the capture"):
        check_output(tmp_path / "scan1" / ("images" if kind == "llff" else "cams") / "run")


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_a_pose_that_is_none_is_left_out(tmp_path, scene, kind):
    write_any(tmp_path, scene, kind)
    if kind == "mvsnet":
        file = tmp_path / "cams" / "00000004_cam.txt"
        file.write_text(file.read_text()[:40])
    else:
        rows = np.load(tmp_path / "poses_bounds.npy")
        rows[4, 6] = np.nan
        np.save(tmp_path / "poses_bounds.npy", rows)
    source = read_source(tmp_path, CaptureOptions(), needs_points=False)
    assert len(source.views) == 11
    assert any("left out, for the pose cannot be used" in warning for warning in source.warnings)
    with pytest.raises(CaptureError, match=r"_cam\.txt: needs 'extrinsic'|a pose that is not a finite number"):
        read_source(tmp_path, CaptureOptions(strict=True), needs_points=False)


# --------------------------------------------------------------------------------------------- MVSNet


def test_masked_copies_are_no_photographs_of_a_folder(tmp_path, scene):
    write_mvsnet(tmp_path, scene)
    for file in (tmp_path / "blended_images").iterdir():  # large enough for vdgs sfm
        picture = cv2.resize(cv2.imread(str(file)), (160, 120)) // (2 if "masked" in file.name else 1)
        picture[0, 0] = int(file.name[:8])
        cv2.imwrite(str(file), picture)
    images = collect_images([tmp_path / "blended_images"])
    assert len(images.images) == 12
    assert sum("masked copy" in each.reason for each in images.excluded) == 12


@pytest.mark.parametrize("cameras", ["Cameras", "cams_1", "cams"])
def test_other_writers_of_cameras(tmp_path, scene, cameras):
    """Folders, depths that lack, empty lines, three rows, names of photographs, other numbers of digits and cases."""
    expected = write_mvsnet(tmp_path, scene, cameras, depths="")
    (tmp_path / "blended_images").rename(tmp_path / "Images")
    files = sorted((tmp_path / cameras).glob("*_cam.txt"))
    files[0].write_text(files[0].read_text().replace("\n", "\r\n\r\n"))
    files[1].write_text("\n" + files[1].read_text().replace("0.0 0.0 0.0 1.0 \n", ""))
    files[2].rename(files[2].with_name("00000002.png_cam.txt"))
    files[3].rename(files[3].with_name("003_cam.txt"))
    (tmp_path / "Images" / "00000004.png").rename(tmp_path / "Images" / "00000004.PNG")
    (tmp_path / cameras / "._00000000_cam.txt").write_bytes(b"\0\1")
    source = read_source(tmp_path, CaptureOptions(), needs_points=False)
    assert source.images == "Images"
    assert sorted(name.lower() for name in cameras_of(source)) == sorted(expected.cameras)
    for view in source.views:
        camera = expected.cameras[view.name.lower()]
        np.testing.assert_allclose(view.camera_from_world, camera.camera_from_world, atol=1e-12)


def test_of_two_folders_of_cameras_cams_is_read(tmp_path, scene):
    write_mvsnet(tmp_path, scene)
    shutil.copytree(tmp_path / "cams", tmp_path / "cams_1")
    source = read_mvsnet(tmp_path, CaptureOptions(), False)
    assert any("those in cams_1 beside it are not" in warning for warning in source.warnings)


def test_photographs_of_another_size_than_the_lens_are_refused(tmp_path, scene):
    """There is no size in the files: one that the principal point contradicts is told."""
    write_mvsnet(tmp_path, scene)
    for file in (tmp_path / "blended_images").iterdir():
        cv2.imwrite(str(file), cv2.resize(cv2.imread(str(file)), (40, 20)))
    with pytest.raises(CaptureError, match=r"it is of another size. Give the photographs that the cameras were made"):
        read_mvsnet(tmp_path, CaptureOptions(), False)


def test_missing_and_spare_photographs_are_counted(tmp_path, scene):
    write_mvsnet(tmp_path, scene)
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    shutil.move(tmp_path / "blended_images" / "00000000.png", tmp_path / "blended_images" / "spare.png")
    capture = load_capture(tmp_path)
    assert len(capture.views) == 11
    assert any("1 of 12 images that have a camera are missing" in warning for warning in capture.warnings)
    assert any(re.search(r"have no camera .*spare\.png", warning) for warning in capture.warnings)
    shutil.rmtree(tmp_path / "blended_images")
    with pytest.raises(CaptureError, match=r"no folder of the photographs .*--images FOLDER"):
        load_capture(tmp_path)


def number_from(folder: Path, first: int, digits: int) -> None:
    """Give the photographs of the cameras 0, 1, ... numbers from `first`."""
    for file in sorted((file for file in folder.iterdir() if "masked" not in file.name), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + first:0{digits}d}.png"))


@pytest.mark.parametrize("images", [None, "blended_images"])
def test_photographs_counted_from_1_are_paired_in_their_order(tmp_path, scene, images):
    """Tanks and Temples: images/000001.jpg, ... and cams/00000000_cam.txt, ..."""
    expected = list(write_mvsnet(tmp_path, scene).cameras.values())
    number_from(tmp_path / "blended_images", 1, 6)
    source = read_mvsnet(tmp_path, CaptureOptions(images=images), False)
    assert len(source.views) == len(expected)
    for view in source.views:
        camera = expected[int(view.name[:6]) - 1]
        np.testing.assert_allclose(view.camera_from_world, camera.camera_from_world, atol=1e-12)
    assert any("counted from 0 and photographs from 1: paired in their order" in note for note in source.warnings)


@pytest.mark.parametrize(("digits", "gone"), [(8, ()), (6, (12,)), (6, (5,)), (6, (1, 3))])
def test_numbers_that_may_be_those_of_the_neighbours_are_refused(tmp_path, scene, digits, gone):
    """A pose of the neighbour would pass every other check."""
    write_mvsnet(tmp_path, scene)
    number_from(tmp_path / "blended_images", 1, digits)
    for number in gone:
        (tmp_path / "blended_images" / f"{number:0{digits}d}.png").unlink()
    with pytest.raises(CaptureError, match=r"which belong together cannot be told.*Rename the photographs"):
        read_mvsnet(tmp_path, CaptureOptions(), False)


def test_numbers_that_are_further_apart_are_refused(tmp_path, scene):
    """Two photographs may be missing at one end, and two cameras at the other."""
    write_mvsnet(tmp_path, scene)
    number_from(tmp_path / "blended_images", 2, 6)
    with pytest.raises(CaptureError, match="which belong together cannot be told"):
        read_mvsnet(tmp_path, CaptureOptions(), False)


def test_photographs_that_are_gone_shift_no_numbers(tmp_path, scene):
    expected = write_mvsnet(tmp_path, scene).cameras
    number_from(tmp_path / "blended_images", 0, 6)
    for number in (4, 11):
        (tmp_path / "blended_images" / f"{number:06d}.png").unlink()
    source = read_mvsnet(tmp_path, CaptureOptions(), False)
    assert len(source.views) == 10
    for view in source.views:
        camera = expected[f"00{view.name}"]
        np.testing.assert_allclose(view.camera_from_world, camera.camera_from_world, atol=1e-12)


def test_other_names_than_those_of_cameras_are_told_apart(tmp_path, scene):
    """DTU: Rectified/scan1/rect_001_3_r5000.png is of Cameras/00000000_cam.txt."""
    write_mvsnet(tmp_path, scene)
    for file in sorted((tmp_path / "blended_images").glob("????????.png")):
        file.rename(file.with_name(f"rect_{int(file.stem) + 1:03d}_3_r5000.png"))
    with pytest.raises(CaptureError, match=r"none of the .* is named as one of the 12 cameras.*00000000\.png for"):
        read_mvsnet(tmp_path, CaptureOptions(images="blended_images"), False)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("0.0 0.0 0.0 1.0 ", "1.0 2.0 3.0 1.0 ", "last row is not 0 0 0 1"),
        ("intrinsic", "calibration", "needs 'extrinsic'"),
        ("57.6 0.0 32.0", "57.6 0.5 32.0", "skew is not supported"),
        ("57.6 0.0 32.0", "nan 0.0 32.0", "must be fx 0 cx"),
    ],
)
def test_damaged_cameras_are_named(tmp_path, scene, old, new, says):
    write_mvsnet(tmp_path, scene)
    for file in (tmp_path / "cams").glob("*_cam.txt"):
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new))
    with pytest.raises(CaptureError, match=rf"00000000_cam\.txt: .*{says}"):
        read_mvsnet(tmp_path, CaptureOptions(), False)


# ----------------------------------------------------------------------------------------------- LLFF


@pytest.mark.parametrize("change", ["more", "fewer"])
def test_as_many_photographs_as_poses_are_needed(tmp_path, scene, change):
    write_llff(tmp_path, scene)
    first = tmp_path / "images" / "frame_000.png"
    if change == "more":
        shutil.copyfile(first, first.with_name("z.png"))
    else:
        first.unlink()
    count = 13 if change == "more" else 11
    with pytest.raises(CaptureError, match=rf"has 12 poses, and .*images has {count} photographs. .*order of names"):
        load_capture(tmp_path)


def test_photographs_of_another_folder(tmp_path, scene):
    write_llff(tmp_path, scene)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(CaptureError, match=r"no folder images .*--images FOLDER"):
        load_capture(tmp_path)
    write_images(tmp_path / "elsewhere", scene)
    options = CaptureOptions(images="elsewhere")
    assert len(read_source(tmp_path, options, needs_points=False).views) == 12


def test_nothing_in_a_file_of_numpy_can_run(tmp_path, scene):
    write_llff(tmp_path, scene)
    file = tmp_path / "poses_bounds.npy"
    np.save(file, np.array([{"pose": 1}] * 12), allow_pickle=True)
    with pytest.raises(CaptureError, match="holds objects of Python") as refused:
        load_capture(tmp_path)
    assert "allow_pickle" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (np.zeros((12, 12)), "has an array of 12x12"),
        (np.zeros((12, 3, 5)), "has an array of 12x3x5"),
        (np.zeros((0, 17)), "has an array of 0x17"),
        (np.full((12, 17), "a"), "one array of numbers"),
        (np.zeros((12, 17)), "not orthonormal"),
    ],
)
def test_other_arrays_are_refused(tmp_path, scene, content, says):
    write_llff(tmp_path, scene)
    np.save(tmp_path / "poses_bounds.npy", content)
    with pytest.raises(CaptureError, match=rf"poses_bounds\.npy: .*{says}"):
        load_capture(tmp_path)


@pytest.mark.parametrize("how", ["cut", "empty", "zip"])
def test_damaged_files_of_poses_are_named(tmp_path, scene, how):
    write_llff(tmp_path, scene)
    file = tmp_path / "poses_bounds.npy"
    if how == "zip":
        with file.open("wb") as stream:
            np.savez(stream, poses=np.zeros((12, 17)))
    else:
        file.write_bytes(file.read_bytes()[: 300 if how == "cut" else 0])
    with pytest.raises(CaptureError, match=r"poses_bounds\.npy: .*(Copy it again)"):
        load_capture(tmp_path)


def test_shrunk_photographs_under_other_names_take_the_points_of_the_model(tmp_path, scene):
    """NeRF's sets: images/IMG_4026.JPG, images_4/image000.png, and a COLMAP model of the former."""
    write_llff(tmp_path, scene)
    write_colmap(tmp_path, scene, images=None)
    (tmp_path / "images_4").mkdir()
    for number, file in enumerate(sorted((tmp_path / "images").iterdir())):
        small = cv2.resize(cv2.imread(str(file)), None, fx=0.25, fy=0.25)
        cv2.imwrite(str(tmp_path / "images_4" / f"image{number:03d}.png"), small)
    with pytest.raises(CaptureError, match=r"images_4 has other names .*give --images images --downscale 4 instead"):
        load_capture(tmp_path, CaptureOptions(images="images_4"))
    source = read_source(tmp_path, CaptureOptions(images="images_4", format="llff"))
    assert len(source.views) == 12
    np.testing.assert_allclose(source.points, scene.points, atol=1e-6)
    shrunk = load_capture(tmp_path, CaptureOptions(images="images", downscale=4))
    assert shrunk.views[0].camera.width == next(iter(scene.cameras.values())).width // 4
