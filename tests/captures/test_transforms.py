"""transforms.json: written here as its tools write it, read as one scene; models beside it, and paths."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from support.captures import (
    TinyScene,
    assert_sees_the_scene,
    moved,
    to_source,
    write_colmap,
    write_images,
    write_ply,
)
from support.dataset_layouts import (
    write_transforms,
)
from vdgs.captures.formats.source_capture import NoTiePoints
from vdgs.captures.image_files import decode_mask
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError


def test_transforms_json(tmp_path, scene):
    write_transforms(tmp_path, scene)
    capture = load_capture(tmp_path)
    assert (capture.source, capture.images) == ("transforms", "images")
    assert_sees_the_scene(capture, scene)


def test_transforms_json_is_read_with_shrunk_photographs_alone(tmp_path, scene):
    """nerfstudio's tools write images_2, images_4, ...; the largest are taken where images/ is gone."""
    write_transforms(tmp_path, scene)
    (tmp_path / "images").rename(tmp_path / "images_4")
    write_images(tmp_path / "images_2", scene)
    capture = load_capture(tmp_path)
    assert capture.images == "images_2"
    assert any("images_2 is used instead" in warning for warning in capture.warnings)
    assert_sees_the_scene(capture, scene)


def test_applied_transform_is_undone(tmp_path, scene):
    """The capture's own world is the one before it, so that a georeference keeps its meaning."""
    applied = np.eye(4)[[0, 2, 1, 3]]
    applied[2] *= -1
    applied[:3, 3] = [1.0, 2.0, 3.0]
    write_transforms(tmp_path, scene, applied)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert_sees_the_scene(capture, scene)
    np.testing.assert_allclose(to_source(capture.ground, capture.points), scene.points, atol=1e-9)


def test_applied_scale_is_undone_too(tmp_path, scene):
    small = moved(scene, 0.25, np.eye(3), np.zeros(3))
    write_transforms(tmp_path, small, applied_scale=0.25)
    write_images(tmp_path / "images", scene)
    capture = load_capture(tmp_path)
    assert_sees_the_scene(capture, scene)
    np.testing.assert_allclose(to_source(capture.ground, capture.points), scene.points, atol=1e-9)


@pytest.mark.parametrize("above", ["images/", "../old/images/", "/data/old/images/", "./images/v1.2_"])
def test_names_without_extension_are_photographs_and_no_masks(tmp_path, scene, above):
    """A photograph must not be taken for the mask of the name that lacks its extension."""
    content = write_transforms(tmp_path, scene)
    start = above.rpartition("/")[2]
    for frame, name in zip(content["frames"], scene.cameras, strict=True):
        frame["file_path"] = above + name.removesuffix(".png")
        (tmp_path / "images" / name).rename(tmp_path / "images" / (start + name))
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    capture = load_capture(tmp_path)
    assert {view.name for view in capture.views} == {start + name for name in scene.cameras}
    assert {view.mask_path for view in capture.views} == {None}


@pytest.mark.parametrize("scale", [0.01, 0.5, 30.0])
def test_a_scaled_camera_of_blender_is_the_same_camera(tmp_path, scene, scale):
    """Its matrix_world has the scale of the camera object in the rotation, and not in the place."""
    content = write_transforms(tmp_path, scene)
    for frame in content["frames"][::2]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([scale, scale, scale, 1])).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    assert_sees_the_scene(load_capture(tmp_path), scene)


def test_the_focal_length_of_a_frame_comes_before_a_common_one_in_other_words(tmp_path, scene):
    content = write_transforms(tmp_path, scene)
    content["frames"][0]["camera_angle_x"] = 2 * np.arctan(32 / 100)
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    focal = {view.name: view.camera.fx for view in load_capture(tmp_path).views}
    first, second = list(scene.cameras)[:2]
    assert focal[first] == pytest.approx(100)
    assert focal[second] == scene.cameras[second].fx


def test_intrinsics_per_frame_splits_and_masks(tmp_path, scene):
    content = write_transforms(tmp_path, scene)
    names = [frame["file_path"] for frame in content["frames"]]
    for frame in content["frames"]:
        frame |= {key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
        frame["mask_path"] = "masks/one.png"
    write_images(
        tmp_path / "masks",
        TinyScene({"one.png": next(iter(scene.cameras.values()))}, scene.points, scene.colors),
    )
    content |= {"fl_x": 1.0, "train_filenames": names[:9], "test_filenames": names[9:]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert_sees_the_scene(capture, scene)
    assert [view.split for view in capture.views] == ["train"] * 9 + ["test"] * 3
    assert all(view.mask_path == tmp_path / "masks" / "one.png" for view in capture.views)
    (tmp_path / "masks" / "one.png").unlink()
    with pytest.raises(CaptureError, match=r"one\.png: no such mask, though .* is said to have it"):
        load_capture(tmp_path)


def test_frames_in_no_list_are_left_out_and_told(tmp_path, scene):
    """As nerfstudio takes its lists: those are the training and the test photographs, and there are no others."""
    names = [f"images/{name}" for name in sorted(scene.cameras)]
    lists = {"train_filenames": names[:8], "val_filenames": names[8:9], "test_filenames": names[9:10]}
    write_transforms(tmp_path, scene, **lists)
    for split in ("auto", "explicit"):
        capture = load_capture(tmp_path, CaptureOptions(split=split))
        assert [f"images/{view.name}" for view in capture.train_views] == names[:8]
        assert [f"images/{view.name}" for view in capture.test_views] == names[8:10]
        assert [each for each in capture.warnings if "none of the capture's lists" in each] == [
            "2 of 12 photographs stand in none of the capture's lists of training and test photographs and are left "
            "out (frame_010.png, frame_011.png). --split every uses them all."
        ]
    every = load_capture(tmp_path, CaptureOptions(split="every"))
    assert (len(every.views), every.warnings) == (12, ())
    (tmp_path / "mine.txt").write_text("frame_011\n")
    mine = load_capture(tmp_path, CaptureOptions(test_list=tmp_path / "mine.txt"))
    assert (len(mine.views), [view.name for view in mine.test_views]) == (12, ["frame_011.png"])
    assert mine.warnings == ()


@pytest.mark.parametrize("tested", ["val_filenames", "test_filenames", "test_frames"])
def test_photographs_of_both_sides_only_test_and_are_told(tmp_path, scene, tested):
    """Lists of nerfstudio that train on all, and frames of ScanNet++ that stand in both of its lists."""
    content = write_transforms(tmp_path, scene)
    names = [frame["file_path"] for frame in content["frames"]]
    both = content["frames"][::4] if tested == "test_frames" else names[::4]
    for lists in ({tested: both}, {"train_filenames": names, tested: both}):
        if tested != "test_frames" and len(lists) == 1:
            continue  # the other side takes the rest
        (tmp_path / "transforms.json").write_text(json.dumps(content | lists))
        capture = load_capture(tmp_path)
        assert [f"images/{view.name}" for view in capture.test_views] == names[::4]
        assert len(capture.train_views) == 9
        assert capture.warnings == (
            "images/frame_000.png, images/frame_004.png, images/frame_008.png: among the photographs for training and "
            "among those for the test; only for the test, not for training (3 in all).",
        )
        assert load_capture(tmp_path, CaptureOptions(split="every")).warnings == ()


@pytest.mark.parametrize(("key", "side"), [("train_filenames", "train"), ("test_filenames", "test")])
def test_a_side_without_a_list_takes_the_frames_that_the_other_leaves(tmp_path, scene, key, side):
    names = sorted(scene.cameras)
    write_transforms(tmp_path, scene, **{key: [f"images/{name}" for name in names[3:7]]})
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views if view.split == side] == names[3:7]
    assert (len(capture.views), capture.warnings) == (12, ())


def test_lists_of_what_is_no_frame_are_refused(tmp_path, scene):
    write_transforms(tmp_path, scene, train_filenames=["images/frame_000.JPG"], test_filenames=["images/else.png"])
    with pytest.raises(CaptureError, match=r"test_filenames: 1 of its 1 names .*--split every\.\n  images/else\.png"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(split="every")).views) == 12


def test_lists_of_file_names_and_of_frames_that_are_not_there(tmp_path, scene):
    names = sorted(scene.cameras)
    write_transforms(tmp_path, scene, train_filenames=names[:9], test_filenames=[*names[9:], "unregistered.png"])
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.test_views] == names[9:]
    assert len(capture.train_views) == 9
    [said] = capture.warnings
    assert "test_filenames: 1 of its 4 names" in said
    assert "(unregistered.png)" in said


@pytest.mark.parametrize("key", ["test_filenames", "val_filenames", "test_frames"])
def test_test_photographs_that_are_gone_are_replaced_by_no_others(tmp_path, scene, key):
    names = sorted(scene.cameras)
    content = write_transforms(tmp_path, scene)
    held = [content["frames"].pop() for _ in range(2)] if key == "test_frames" else names[10:]
    (tmp_path / "transforms.json").write_text(json.dumps(content | {key: held}))
    (tmp_path / "images" / names[10]).unlink()
    assert any("1 of its 2 test photographs are missing" in note for note in load_capture(tmp_path).warnings)
    (tmp_path / "images" / names[11]).unlink()
    with pytest.raises(CaptureError, match=r"transforms\.json: none of its 2 test photographs is there"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(split="every")).views) == 10


def test_test_frames_of_scannetpp_are_tested_on(tmp_path, scene):
    content = write_transforms(tmp_path, scene)
    content["frames"], content["test_frames"] = content["frames"][:8], content["frames"][8:]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert_sees_the_scene(capture, scene)
    assert [view.split for view in capture.views] == ["train"] * 8 + ["test"] * 4
    assert capture.warnings == ()
    content["val_filenames"] = [content["frames"][0]["file_path"]]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert [view.split for view in load_capture(tmp_path).views] == ["test"] + ["train"] * 7 + ["test"] * 4
    content["test_frames"] = "none"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=r"must hold a list 'test_frames'"):
        load_capture(tmp_path)


@pytest.mark.parametrize("top", ["/home/other/place/images/", "C:\\data\\place\\", "../images/", "images/"])
def test_photographs_of_other_folders_are_found_where_a_person_says(tmp_path, scene, top):
    content = write_transforms(tmp_path / "nerf", scene)
    (tmp_path / "nerf" / "images").rename(tmp_path / "photographs")
    names = [top + each["file_path"].removeprefix("images/") for each in content["frames"]]
    for each, name in zip(content["frames"], names, strict=True):
        each["file_path"] = name
    content["test_filenames"] = names[2:4]
    (tmp_path / "nerf" / "transforms.json").write_text(json.dumps(content))
    options = CaptureOptions(images=str(tmp_path / "photographs"))
    capture = load_capture(tmp_path / "nerf", options)
    assert_sees_the_scene(capture, scene)
    assert [view.name for view in capture.test_views] == sorted(scene.cameras)[2:4]
    (tmp_path / "photographs" / "frame_011.png").unlink()
    assert any("1 of 12 images" in note for note in load_capture(tmp_path / "nerf", options).warnings)


def test_photographs_in_a_folder_of_another_name_are_found_and_told(tmp_path, scene):
    """Not among masks, and not where each name is there twice."""
    write_transforms(tmp_path, scene)
    (tmp_path / "images").rename(tmp_path / "masks")
    with pytest.raises(CaptureError, match="are missing"):
        load_capture(tmp_path)
    (tmp_path / "masks").rename(tmp_path / "photos")
    capture = load_capture(tmp_path)
    assert capture.images == "photos"
    assert any("images/frame_000.png is taken as photos/frame_000.png" in note for note in capture.warnings)
    assert_sees_the_scene(capture, scene)
    shutil.copytree(tmp_path / "photos", tmp_path / "others")
    with pytest.raises(CaptureError, match=r"may be others/frame_000\.png or photos/.*--images"):
        load_capture(tmp_path)


@pytest.mark.parametrize(("meant", "there"), [("test", "train"), ("flight1", "flight2"), ("val/rgb", "Train/rgb")])
def test_photographs_of_another_folder_of_the_kind_are_not_taken(tmp_path, scene, meant, there):
    """Train and test photographs, and those of two flights, have the same names."""
    content = write_transforms(tmp_path, scene)
    (tmp_path / there).parent.mkdir(exist_ok=True)
    (tmp_path / "images").rename(tmp_path / there)
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("images", meant)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="are missing"):
        load_capture(tmp_path)
    (tmp_path / there).rename(tmp_path / "photographs")
    assert len(load_capture(tmp_path).views) == len(scene.cameras)


def test_names_that_are_partly_there_twice_say_nothing_of_the_others(tmp_path, scene):
    write_transforms(tmp_path, scene)
    (tmp_path / "images").rename(tmp_path / "train")
    (tmp_path / "test").mkdir()
    for name in list(scene.cameras)[:3]:
        shutil.copy(tmp_path / "train" / name, tmp_path / "test")
    with pytest.raises(CaptureError, match=r"may be test/frame_000\.png or train/.*--images"):
        load_capture(tmp_path)


def test_masks_outside_of_the_capture_are_refused_as_in_a_uri_too(tmp_path, scene):
    content = write_transforms(tmp_path / "place", scene)
    content["frames"][0]["mask_path"] = "%2e%2e/mask.png"
    Image.new("L", (64, 48), 255).save(tmp_path / "mask.png")
    (tmp_path / "place" / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="not a path inside the capture"):
        load_capture(tmp_path / "place")


def test_paths_as_in_a_uri_are_those_of_files_with_blanks(tmp_path, scene):
    """Where the file is not there as it is written; names with a percent sign stay."""
    named = {f"a%20{k}.png" if k == 5 else f"a {k}.png": camera for k, camera in enumerate(scene.cameras.values())}
    content = write_transforms(tmp_path, replace(scene, cameras=named))
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace(" ", "%20")
    content["test_filenames"] = [content["frames"][k]["file_path"] for k in (3, 5)]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    capture = load_capture(tmp_path)
    assert {view.name for view in capture.views} == set(named)
    assert {view.name for view in capture.test_views} == {"a 3.png", "a%205.png"}


def shifted_by_nerfstudio() -> np.ndarray:
    """A world_from_source of ns-process-data, and more than its turn of axes."""
    applied = np.eye(4)[[0, 2, 1, 3]]
    applied[2] *= -1
    applied[:3, 3] = [1.0, 2.0, 3.0]
    return applied


@pytest.mark.parametrize("is_named", [False, True])
def test_a_cloud_in_the_world_before_applied_transform_is_brought_over(tmp_path, scene, is_named):
    """As COLMAP has it; one of another place is refused."""
    write_transforms(tmp_path, scene, shifted_by_nerfstudio())
    cloud = tmp_path / "sparse_pc.ply"
    if not is_named:
        content = json.loads((tmp_path / "transforms.json").read_text())
        del content["ply_file_path"]
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    write_ply(cloud, scene.points, scene.colors)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert any("in the world before applied_transform" in note for note in capture.warnings)
    np.testing.assert_allclose(to_source(capture.ground, capture.points), scene.points, atol=1e-5)
    write_ply(cloud, scene.points + np.array([5e3, 0, 0]), scene.colors)
    with pytest.raises(CaptureError, match=r"not where the cameras look .*world of the poses(?s:.)*vdgs sfm"):
        load_capture(tmp_path)


def test_a_model_beside_transforms_json_is_read_and_told(tmp_path, scene):
    """A folder of ns-process-data: the same cameras twice, and tracks in the model."""
    write_transforms(tmp_path, scene, shifted_by_nerfstudio())
    write_colmap(tmp_path, scene, sparse="colmap/sparse/0", tracks=True)
    capture = load_capture(tmp_path, CaptureOptions(up="z"))
    assert capture.source == "colmap"
    assert all(view.observations is not None for view in capture.views)
    assert capture.warnings == (
        "the COLMAP model in colmap/sparse/0 is read; transforms.json beside it is not (--format transforms reads that "
        "instead).",
    )
    asked = load_capture(tmp_path, CaptureOptions(up="z", format="transforms"))
    assert (asked.source, asked.warnings) == ("transforms", ())
    assert_sees_the_scene(asked, scene)
    assert load_capture(tmp_path, CaptureOptions(up="z", format="colmap")).warnings == ()
    (tmp_path / "transforms.json").write_text("{")  # of no matter where it is not read
    assert load_capture(tmp_path).source == "colmap"
    with pytest.raises(CaptureError, match=r"--format matrixcity, but .* It holds: colmap, transforms\."):
        load_capture(tmp_path, CaptureOptions(format="matrixcity"))


@pytest.mark.parametrize("says", ["lists of training and test photographs", "masks"])
def test_transforms_json_is_read_where_it_says_what_a_model_cannot(tmp_path, scene, says):
    names = [f"images/{name}" for name in sorted(scene.cameras)]
    content = write_transforms(tmp_path, scene)
    if says == "masks":
        for frame in content["frames"]:
            frame["mask_path"] = "kept/mask.png"
        write_images(tmp_path / "kept", replace(scene, cameras={"mask.png": scene.cameras["frame_002.png"]}))
    else:
        content |= {"train_filenames": names[:7], "test_filenames": names[7:]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    write_colmap(tmp_path, scene, sparse="colmap/sparse/0")
    capture = load_capture(tmp_path)
    assert capture.source == "transforms"
    assert capture.warnings == (
        f"transforms.json is read, for its {says}; the COLMAP model in colmap/sparse/0 is not (--format colmap reads "
        "that instead).",
    )
    if says == "masks":
        assert {view.mask_path for view in capture.views} == {tmp_path / "kept" / "mask.png"}
    else:
        assert len(capture.test_views) == 5
    for k in range(7):
        (tmp_path / "images" / f"frame_00{k}.png").unlink()
    with pytest.raises(CaptureError, match=r"7 of 12 images .* are missing(?s:.)*--format colmap"):
        load_capture(tmp_path)


def test_points_of_a_model_stand_in_for_a_missing_cloud(tmp_path, scene):
    """As older nerfstudio left folders: poses moved by applied_transform, a model that is not, and no cloud."""
    write_transforms(tmp_path, scene, shifted_by_nerfstudio(), ply_file_path="gone.ply")
    assert any("gone.ply: is not there" in each for each in load_capture(tmp_path).warnings)
    (tmp_path / "sparse_pc.ply").unlink()
    with pytest.raises(
        NoTiePoints,
        match=r"gone\.ply is not there, brings no 3D points(?s:.)* as sparse/0 .* and give --format transforms\.",
    ):
        load_capture(tmp_path)
    write_colmap(tmp_path, moved(scene, 3.0, np.eye(3)[[1, 2, 0]], np.ones(3)), images=None)
    capture = load_capture(tmp_path, CaptureOptions(up="z", format="transforms"))
    assert_sees_the_scene(capture, scene)
    np.testing.assert_allclose(to_source(capture.ground, capture.points), scene.points, atol=1e-6)


def test_absolute_paths_inside_the_capture_are_those_of_its_files(tmp_path, scene):
    content = write_transforms(tmp_path / "place", scene)
    for each in content["frames"]:
        each["file_path"] = str(tmp_path / "place" / each["file_path"])
    content["ply_file_path"] = str(tmp_path / "place" / "sparse_pc.ply")
    (tmp_path / "place" / "transforms.json").write_text(json.dumps(content), encoding="utf-8-sig")
    (tmp_path / "link").symlink_to(tmp_path / "place")
    for root in (tmp_path / "place", tmp_path / "link"):
        capture = load_capture(root)
        assert capture.images == "images"
        assert_sees_the_scene(capture, scene)


@pytest.mark.parametrize(
    "top", ["/home/other/place/", "C:\\data\\place\\", "../place/", "../../", "file:///home/my%20place/"]
)
def test_paths_of_another_machine_are_those_of_the_captures_files(tmp_path, scene, top):
    content = write_transforms(tmp_path, scene)
    for each in content["frames"]:
        each["file_path"] = top + each["file_path"].replace("/", "\\" if "\\" in top else "/")
    content["ply_file_path"] = top + "sparse_pc.ply"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_sees_the_scene(load_capture(tmp_path), scene)


def test_a_path_outside_the_capture_is_called_what_it_is(tmp_path, scene):
    write_transforms(tmp_path, scene, ply_file_path="/elsewhere/cloud.ply")
    with pytest.raises(
        CaptureError, match=r"the ply_file_path '/elsewhere/cloud\.ply' is not a path .* beside it, by the same name"
    ):
        load_capture(tmp_path)
    (tmp_path / "sparse_pc.ply").rename(tmp_path / "cloud.ply")
    assert len(load_capture(tmp_path).points) == len(scene.points)


def test_single_poses_that_are_none_are_left_out_and_masks_of_instant_ngp_are_turned_round(tmp_path, scene):
    write_transforms(tmp_path, scene, k1=-0.05)
    file = tmp_path / "transforms.json"
    content = json.loads(file.read_text())
    names = [frame["file_path"] for frame in content["frames"]]
    content["frames"][1]["transform_matrix"][0][3] = float("nan")
    content["frames"].append(dict(content["frames"][2]))  # the same once more
    file.write_text(json.dumps(content))
    light = np.zeros((48, 64), np.uint8)
    light[:, :16] = 30  # not bright, but not black
    mask = tmp_path / names[0]
    Image.fromarray(light).save(mask.with_name(f"dynamic_mask_{mask.stem}.png"))
    capture = load_capture(tmp_path)
    assert len(capture.views) == len(names) - 1
    assert any(
        "left out, for the pose cannot be used. frame 'images/frame_001.png'" in note for note in capture.warnings
    )
    masked = next(view for view in capture.views if view.name == "frame_000.png")
    assert masked.mask_path is not None
    kept = decode_mask(masked.mask_path, masked.camera.width, masked.camera.height)
    assert not kept[:, : kept.shape[1] // 6].any()
    assert kept[:, kept.shape[1] // 3 :].all()
    with pytest.raises(CaptureError, match="finite numbers"):
        load_capture(tmp_path, CaptureOptions(strict=True))
    content["frames"][0]["transform_matrix"] = np.diag([2.0, 1, 1, 1]).tolist()
    content["frames"][3]["transform_matrix"] = []
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="orthonormal"):
        load_capture(tmp_path)
