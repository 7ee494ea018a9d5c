"""What lies in a folder is used: photographs that are left, models below it, points beside a model, any colors."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from support.advice import advised_words
from support.captures import TinyScene, tiny_scene, write_colmap, write_images, write_ply
from support.dataset_layouts import (
    DRB,
    OPENGL,
    halves,
    write_blender,
    write_matrixcity,
    write_mega_nerf,
)
from vdgs.captures.format_dispatch import lacks_points
from vdgs.captures.formats.colmap import partial_model
from vdgs.captures.formats.json_poses import axis_rotation
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import is_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.sfm.image_list import collect_images, is_image_folder
from vdgs.system.quoting import shell_word


@pytest.fixture(scope="module")
def scene() -> TinyScene:
    return tiny_scene()


def write_transforms(root: Path, scene: TinyScene, **changes) -> None:
    first = next(iter(scene.cameras.values()))
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(each.camera_from_world) @ OPENGL).tolist()}
        for name, each in scene.cameras.items()
    ]
    content = {"fl_x": first.fx, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height, "frames": frames}
    root.mkdir(parents=True, exist_ok=True)
    (root / "transforms.json").write_text(json.dumps(content | changes))
    write_images(root / "images", scene)
    write_ply(root / "sparse_pc.ply", scene.points, scene.colors)


# ------------------------------------------------------------------------------- photographs that are gone


def write_kind(kind: str, root: Path, scene: TinyScene) -> tuple[Path, list[Path]]:
    """A capture of twelve photographs, and their files."""
    if kind == "colmap":
        write_colmap(root, scene)
    elif kind == "transforms":
        write_transforms(root, scene)
    elif kind == "mega-nerf":
        write_mega_nerf(root, scene)
        write_ply(root / "points3D.ply", scene.points @ DRB.T, scene.colors)
    else:
        root = root / "aerial/pose/block_A"
        write_matrixcity(root, *halves(scene))
        return root, sorted((root.parent.parent).rglob("*.png"))
    return root, sorted(root.rglob("*.png"))


@pytest.mark.parametrize("kind", ["colmap", "transforms", "mega-nerf", "matrixcity"])
def test_a_capture_is_used_without_the_photographs_that_are_gone(tmp_path, scene, kind):
    root, images = write_kind(kind, tmp_path, scene)
    assert len(images) == 12
    for image in images[1:4]:
        image.unlink()
    capture = load_capture(root)
    assert len(capture.views) == 9
    (said,) = [warning for warning in capture.warnings if "are missing; the others are used" in warning]
    assert f"{root}" in said.split(": 3 of 12 images that have a camera are missing")[0]
    assert all(image.stem in said for image in images[1:4])
    for image in images[4:8]:
        image.unlink()
    with pytest.raises(CaptureError, match=r"7 of 12 images that have a camera are missing") as refused:
        load_capture(root)
    assert all(image.stem in str(refused.value) for image in images[1:8])


@pytest.mark.parametrize("gone", [3, 8])
def test_of_a_smaller_size_with_fewer_photographs_the_whole_one_is_named(tmp_path, scene, gone):
    root, images = write_kind("colmap", tmp_path, scene)
    shutil.copytree(root / "images", root / "images_4")
    shutil.copytree(root / "images", root / "images_masks")
    for image in images[:gone]:
        (root / "images_4" / image.name).unlink()
    said = f"{root / 'images'} has them: --images images uses all."
    if gone == 3:
        warnings = load_capture(root, CaptureOptions(images="images_4")).warnings
        assert said in warnings
        assert any(each.startswith(f"{root / 'images_4'}: 3 of 12 images") for each in warnings)
    else:
        with pytest.raises(CaptureError, match=re.escape(said)):
            load_capture(root, CaptureOptions(images="images_4"))
    images[0].unlink()  # no folder has all
    assert "has them" not in " ".join(_said(root))


def _said(root: Path) -> list[str]:
    try:
        return list(load_capture(root, CaptureOptions(images="images_4")).warnings)
    except CaptureError as error:
        return [str(error)]


# --------------------------------------------------------------------------------------------- models below

PLACES = [
    ("dense/0", "images", "sparse"), ("dense/0", "images", "sparse/0"), ("undistorted", "images", "sparse"),
    ("a/b/c", "images", "sparse/0"), ("project", "images", "colmap/sparse/0"), ("out/capture", "images_2", "sparse/0"),
]  # fmt: skip


@pytest.mark.parametrize(("below", "images", "sparse"), PLACES)
def test_captures_below_are_named_before_poses_are_made_anew(tmp_path, scene, below, images, sparse):
    write_colmap(tmp_path / below, scene, images=images, sparse=sparse)
    write_images(tmp_path / "input", scene)
    assert is_image_folder(tmp_path)
    said = re.escape(f"{below} is a capture: vdgs run {shell_word(tmp_path / below)}")
    for refuses in (lambda: collect_images([tmp_path]), lambda: load_capture(tmp_path)):
        with pytest.raises(CaptureError, match=said):
            refuses()
    assert len(load_capture(tmp_path / below).views) == 12  # as the message says
    assert is_image_folder(tmp_path / "input")


def test_a_capture_of_nerfstudio_below_is_named(tmp_path, scene):
    write_transforms(tmp_path / "processed", scene)
    with pytest.raises(CaptureError, match=r"processed is a capture: vdgs run"):
        collect_images([tmp_path])


@pytest.mark.parametrize("sparse", ["distorted/sparse/0", "distorted/sparse", "work/0", "model"])
def test_a_model_apart_from_its_photographs_is_named_with_what_joins_them(tmp_path, scene, sparse):
    write_images(tmp_path / "input", scene)
    write_colmap(tmp_path, scene, images=None, sparse=sparse)
    with pytest.raises(CaptureError, match=r"is a COLMAP model of 12 photographs") as refused:
        collect_images([tmp_path])
    target, link, capture = advised_words(r"ln -s WORD WORD; vdgs run WORD --output RUN", str(refused.value))
    Path(link).symlink_to(target)
    assert len(load_capture(Path(capture)).views) == 12


@pytest.mark.parametrize("name", ["zz", "aa"])
def test_a_capture_below_comes_before_a_model_without_photographs(tmp_path, scene, name):
    write_colmap(tmp_path / "calibration" / "middle", scene, images=None)
    write_colmap(tmp_path / "calibration" / name, scene)
    with pytest.raises(CaptureError, match=f"calibration/{name} is a capture: vdgs run"):
        load_capture(tmp_path)


def test_a_capture_below_whose_photographs_lie_beside_it_is_named_with_them(tmp_path, scene):
    write_transforms(tmp_path / "nerf", scene)
    (tmp_path / "nerf" / "images").rename(tmp_path / "photographs")
    with pytest.raises(CaptureError, match="nerf is a capture") as refused:
        load_capture(tmp_path)
    capture, images = advised_words("vdgs run WORD --images WORD --output RUN", str(refused.value))
    assert len(load_capture(Path(capture), CaptureOptions(images=images)).views) == 12


@pytest.mark.parametrize("images", ["images/dslr_images_undistorted", "datasets/place/mapping"])
def test_a_model_whose_photographs_lie_deep_beside_it_is_named_with_them(tmp_path, scene, images):
    """As ETH3D and hloc have them."""
    write_images(tmp_path / images, scene)
    write_colmap(tmp_path, scene, images=None, sparse="outputs/calibration")
    write_images(tmp_path / "masks", scene)
    with pytest.raises(CaptureError, match=r"calibration is a COLMAP model of 12 photographs") as refused:
        load_capture(tmp_path)
    target, link, capture = advised_words(r"ln -s WORD WORD; vdgs run WORD --output RUN", str(refused.value))
    Path(link).symlink_to(target)
    assert len(load_capture(Path(capture)).views) == 12


def test_a_model_alone_that_is_none_of_the_folder_above_names_the_photographs(tmp_path, scene):
    write_images(tmp_path / "images", scene)
    write_colmap(tmp_path, scene, images=None, sparse="calibration")
    with pytest.raises(CaptureError, match="is a model alone") as refused:
        load_capture(tmp_path / "calibration")
    capture, images = advised_words("vdgs run WORD --images WORD$", str(refused.value))
    assert len(load_capture(Path(capture), CaptureOptions(images=images)).views) == 12


def test_photographs_beside_a_capture_are_found_at_its_own_level(tmp_path, scene):
    """As ScanNet++ has them: SCENE/dslr/nerfstudio and SCENE/dslr/resized_images."""
    write_transforms(tmp_path / "dslr/nerfstudio", scene)
    (tmp_path / "dslr/nerfstudio/images").rename(tmp_path / "dslr/resized_images")
    with pytest.raises(CaptureError, match="nerfstudio is a capture") as refused:
        load_capture(tmp_path)
    capture, images = advised_words("vdgs run WORD --images WORD --output RUN", str(refused.value))
    assert len(load_capture(Path(capture), CaptureOptions(images=images)).views) == 12


def test_captures_beside_the_one_that_is_named_are_said(tmp_path, scene):
    for side in ("train", "val"):
        write_colmap(tmp_path / side, scene)
    with pytest.raises(CaptureError, match=r"train is a capture: .* --output RUN \(beside it: val;"):
        load_capture(tmp_path)


def test_registered_cameras_of_realityscan_are_told_from_tables(tmp_path):
    write_images(tmp_path, tiny_scene(width=160, height=120))
    (tmp_path / "gps.csv").write_text("name,lat,lon,alt\nframe_000.png,1,2,3\n")
    assert not is_capture(tmp_path)
    (tmp_path / "poses").mkdir()
    table = tmp_path / "poses" / "out.csv"
    table.write_text("#name,x,y,alt,heading,pitch,roll,f,px,py\nframe_000.png,1,2,3,0,0,0,30,0,0\n")
    with pytest.raises(CaptureError, match=r"out\.csv is a project of RealityScan: vdgs run .*out\.csv'? --images"):
        collect_images([tmp_path])
    table.rename(tmp_path / "out.csv")
    assert is_capture(tmp_path)


# --------------------------------------------------------------------------------------- points and sizes


@pytest.mark.parametrize("folder", [".", "photos"])
def test_the_only_place_of_photographs_beside_a_model_is_used(tmp_path, scene, folder):
    write_colmap(tmp_path, scene, text=True, images=folder, sparse="." if folder == "." else "sparse/0")
    write_images(tmp_path / "masks", scene)
    capture = load_capture(tmp_path)
    assert (capture.images, len(capture.views)) == (folder, len(scene.cameras))
    assert any("no images/ folder; the photographs in" in each for each in capture.warnings)


def test_a_model_alone_names_the_folder_that_has_its_photographs(tmp_path, scene):
    folder = write_colmap(tmp_path, scene)
    with pytest.raises(
        CaptureError, match=rf"is a model alone.* Give the folder of both: {re.escape(shell_word(tmp_path))}"
    ):
        load_capture(folder)


def test_transforms_json_stands_for_its_folder(tmp_path, scene):
    write_transforms(tmp_path, scene)
    write_colmap(tmp_path, scene, images=None)
    capture = load_capture(tmp_path / "transforms.json")
    assert (capture.source, capture.root, len(capture.views)) == ("transforms", tmp_path, len(scene.cameras))
    assert not lacks_points(tmp_path / "transforms.json", CaptureOptions())


@pytest.mark.parametrize("cloud", ["sparse/0/points3D.ply", "sparse/0/cloud.ply", "sparse/points.ply", "my_points.ply"])
@pytest.mark.parametrize("text", [True, False])
def test_points_come_from_a_cloud_beside_the_model(tmp_path, scene, cloud, text):
    folder = write_colmap(tmp_path, scene, text=text)
    (points,) = folder.glob("points3D.*")
    points.unlink()
    with pytest.raises(CaptureError, match=r"no 3D points(?s:.)*points3D\.ply"):
        load_capture(tmp_path)
    (tmp_path / "photographs").symlink_to(tmp_path / "images")
    with pytest.raises(
        CaptureError, match=re.escape(f"vdgs sfm {shell_word(tmp_path)} --images photographs --output CAPTURE")
    ):
        load_capture(tmp_path, CaptureOptions(images="photographs"))
    write_ply(tmp_path / cloud, scene.points, scene.colors)
    capture = load_capture(tmp_path)
    assert len(capture.points) == len(scene.points)
    assert np.array_equal(capture.point_colors, scene.colors)
    assert any(cloud in warning for warning in capture.warnings)


def test_numbers_that_are_whole_may_be_written_with_a_point(tmp_path, scene):
    folder = write_colmap(tmp_path / "colmap", scene, text=True)
    cameras = (folder / "cameras.txt").read_text()
    (folder / "cameras.txt").write_text(re.sub(r"PINHOLE (\d+) (\d+) ", r"PINHOLE \1.0 \2.000 ", cameras))
    assert load_capture(tmp_path / "colmap").views[0].camera.width == 64
    (folder / "cameras.txt").write_text(re.sub(r"PINHOLE (\d+) ", r"PINHOLE \1.5 ", cameras))
    with pytest.raises(CaptureError, match="CAMERA_ID MODEL WIDTH HEIGHT"):
        load_capture(tmp_path / "colmap")
    write_transforms(tmp_path / "nerf", scene, w=64.0, h="48", fl_x="57.6")
    assert load_capture(tmp_path / "nerf").views[0].camera.height == 48


@pytest.mark.parametrize("last", [True, False])
def test_images_of_a_text_model_may_lack_the_lines_of_their_points(tmp_path, scene, last):
    write_colmap(tmp_path, scene, text=True)
    file = tmp_path / "sparse/0/images.txt"
    lines = [line for line in file.read_text().splitlines() if line.endswith(".png")]
    file.write_text("\n".join(lines if last else [*lines, ""]).replace("\n", "\n\n", 1))
    capture = load_capture(tmp_path)
    assert len(capture.views) == len(lines) == 12


@pytest.mark.parametrize(("model", "disk"), [("images/", ""), ("DCIM/100/", ""), ("", "flight/"), ("a/", "b/a/")])
def test_images_may_lie_in_other_folders_than_the_model_says(tmp_path, scene, model, disk):
    write_colmap(tmp_path, scene, text=True)
    file = tmp_path / "sparse/0/images.txt"
    file.write_text(re.sub(r" (\S+\.png)", rf" {model}\1", file.read_text()))
    (tmp_path / "images").rename(tmp_path / "old")
    (tmp_path / "images" / disk).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "old").rename(tmp_path / "images" / disk)
    capture = load_capture(tmp_path)
    assert len({view.image_path for view in capture.views}) == 12
    assert any("by other folders" in warning for warning in capture.warnings)


@pytest.mark.parametrize("folder", ["Images", "input", "photos"])
def test_folders_of_images_by_other_names_are_used_or_named(tmp_path, scene, folder):
    write_colmap(tmp_path, scene)
    images = tmp_path / "images"
    images.rename(tmp_path / folder)
    if folder == "photos":
        shutil.copytree(tmp_path / folder, tmp_path / "more")
    if folder == "Images":
        assert any("Images is used" in warning for warning in load_capture(tmp_path).warnings)
        return
    with pytest.raises(CaptureError, match=rf"--images {re.escape(folder)}[. ]"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(images=folder)).views) == 12


def test_an_archive_is_called_a_file(tmp_path):
    (tmp_path / "place.zip").write_bytes(b"PK")
    with pytest.raises(CaptureError, match="of an archive, once it is unpacked"):
        load_capture(tmp_path / "place.zip")


def test_a_part_of_a_capture_names_the_folder_of_it_all(tmp_path, scene):
    """Files that people give instead: what their other programs open."""
    write_colmap(tmp_path / "model", scene)
    write_blender(tmp_path / "set", scene, scene)
    parts = ["model/sparse/0/images.bin", "model/sparse/0/points3D.bin", "set/transforms_train.json"]
    for part in parts:
        root = tmp_path / part.split("/")[0]
        with pytest.raises(
            CaptureError, match=rf"is a part of a capture\. Give the folder of it all: {re.escape(shell_word(root))}$"
        ):
            load_capture(tmp_path / part)
        assert len(load_capture(root, CaptureOptions(up="z")).views) >= len(scene.cameras)
        with pytest.raises(CaptureError, match=rf"Give the folder of it all: {re.escape(shell_word(root))}$"):
            collect_images([tmp_path / part])


def test_poses_by_another_name_than_transforms_json_say_what_to_call_them(tmp_path, scene):
    write_transforms(tmp_path, scene)
    (tmp_path / "transforms.json").rename(tmp_path / "mine.json")
    for given in (tmp_path, tmp_path / "mine.json"):
        with pytest.raises(CaptureError, match=r"mine\.json: .*as transforms\.json in a folder of its own it is read"):
            load_capture(given)


def test_cameras_of_a_trained_scene_are_no_reconstruction(tmp_path):
    """Neither by their folder (above) nor as a file: OpenSfM's is a list too."""
    file = tmp_path / "cameras.json"
    file.write_text('[{"id": 0, "img_name": "a", "width": 9, "position": [0, 0, 1], "fx": 900}]')
    with pytest.raises(CaptureError, match=r"cameras\.json: is cameras of a trained 3DGS scene"):
        load_capture(file)


@pytest.mark.parametrize("twice", [3, 12])
def test_images_that_lie_in_two_folders_are_called_so(tmp_path, scene, twice):
    """The model names them without folders. Both folders are there, and either may be given."""
    write_colmap(tmp_path, scene)
    (tmp_path / "images").rename(tmp_path / "left")
    (tmp_path / "images/right").mkdir(parents=True)
    (tmp_path / "left").rename(tmp_path / "images/left")
    for name in sorted(scene.cameras)[:twice]:
        shutil.copy(tmp_path / "images/left" / name, tmp_path / "images/right" / name)
    said = (
        rf"{twice} of the missing images are there several times, .*'frame_000\.png' may be (left|right)/frame_000\.png"
    )
    if twice == 3:
        assert any(re.search(said, note) for note in load_capture(tmp_path).warnings)
    else:
        with pytest.raises(CaptureError, match=rf"12 of 12 images(?s:.*){said}"):
            load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(images="images/left")).views) == 12


def test_images_of_one_name_in_two_folders_are_not_guessed(tmp_path, scene):
    write_colmap(tmp_path, scene, text=True)
    file = tmp_path / "sparse/0/images.txt"
    names = [line.split()[-1] for line in file.read_text().splitlines() if line.endswith(".png")]
    text = file.read_text()
    for k, name in enumerate(names):
        text = text.replace(f" {name}", f" {'ab'[k % 2]}/{names[k - k % 2]}")
    file.write_text(text)
    with pytest.raises(CaptureError, match="12 of 12 images"):
        load_capture(tmp_path)


# ------------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize("place", ["lego", "blocks/lego", "small_city/lego", "matrix/lego", "pose/lego", "block_1"])
def test_units_are_never_told_by_where_a_set_lies(tmp_path, scene, place):
    root = tmp_path / place
    root.mkdir(parents=True)
    for part, half in zip(("train", "test"), halves(scene), strict=True):
        write_images(root / part, half)
        frames = [
            {"file_path": f"./{part}/{name.removesuffix('.png')}",
             "transform_matrix": (np.linalg.inv(each.camera_from_world) @ OPENGL).tolist()}
            for name, each in half.cameras.items()
        ]  # fmt: skip
        (root / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    write_ply(root / "points3D.ply", scene.points, scene.colors)
    ground = load_capture(root).ground
    assert not ground.metric
    assert ground.scale == pytest.approx(1, abs=0.1)  # the median camera height is 10 units


# ---------------------------------------------------------------------------------------------- photographs


def test_thumbnails_of_a_system_are_no_images_of_a_capture(tmp_path, scene):
    write_colmap(tmp_path, scene)
    shutil.copytree(tmp_path / "images", tmp_path / "images/@eaDir")
    shutil.copytree(tmp_path / "images/@eaDir", tmp_path / "images/.thumbs")
    capture = load_capture(tmp_path, CaptureOptions())
    assert len(capture.views) == 12
    assert not any("no camera" in warning for warning in capture.warnings)


def test_photographs_in_two_folders_beside_a_model_are_all_offered(tmp_path, scene):
    """VastGaussian's and Mega-NeRF's train/rgbs and val/rgbs beside a model that knows no folders."""
    write_colmap(tmp_path, scene)
    for k, image in enumerate(sorted((tmp_path / "images").iterdir())):
        folder = tmp_path / ("val" if k % 5 == 0 else "train") / "rgbs"
        folder.mkdir(parents=True, exist_ok=True)
        image.rename(folder / image.name)
    (tmp_path / "images").rmdir()
    with pytest.raises(CaptureError, match=r"; --images \. for those of train and val together\.$"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(images=".", up="z")).views) == len(scene.cameras)


def test_a_list_of_photographs_is_no_part_of_a_model(tmp_path, scene):
    write_images(tmp_path, scene)
    (tmp_path / "images.txt").write_text("\n".join(sorted(file.name for file in tmp_path.iterdir())))
    assert partial_model(tmp_path) == ""
    (tmp_path / "images.txt").write_text("# Image list with two lines of data per image:\n")
    assert "no cameras.txt" in partial_model(tmp_path)
    (tmp_path / "images.txt").write_text("1 0.5 0.5 0.5 0.5 1 2 3 1 a.jpg\n\n")
    assert "no cameras.txt" in partial_model(tmp_path)


def test_cameras_as_ns_export_writes_them_say_what_is_read(tmp_path, scene):
    write_images(tmp_path, scene)
    (tmp_path / "transforms_train.json").write_text('[{"file_path": "a.png", "transform": [[1, 0, 0, 0]]}]')
    with pytest.raises(CaptureError, match=r"ns-export cameras.*Give the folder of that"):
        load_capture(tmp_path)


@pytest.mark.parametrize("degrees", [0, 90])
def test_points_of_a_model_whose_cameras_are_rolled_are_refused(tmp_path, scene, degrees):
    """Camera centers agree, and the photographs would be taken for turned ones."""
    write_colmap(tmp_path, scene)
    write_transforms(tmp_path, scene)
    (tmp_path / "sparse_pc.ply").unlink()
    content = json.loads((tmp_path / "transforms.json").read_text())
    turn = np.eye(4)
    turn[:3, :3] = axis_rotation(2, degrees)
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    options = CaptureOptions(format="transforms")
    if not degrees:
        assert len(load_capture(tmp_path, options).points) == len(scene.points)
        return
    with pytest.raises(CaptureError, match=r"turned against them by 90°.*all alike"):
        load_capture(tmp_path, options)
