"""transforms.json, Mega-NeRF and MatrixCity: written here as their tools write them, read as one scene."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from support.captures import TinyScene, moved, tiny_scene, to_source, write_colmap, write_images, write_ply
from support.dataset_layouts import DRB, OPENGL, halves, matrixcity_frames, write_matrixcity, write_mega_nerf
from vdgs.captures.capture import Capture
from vdgs.captures.formats.json_poses import parse_intrinsics, parse_matrix
from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.captures.formats.source_capture import Intrinsics, NoTiePoints
from vdgs.captures.image_files import decode_mask
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def scene() -> TinyScene:
    return tiny_scene()


def assert_sees_the_scene(capture: Capture, scene: TinyScene, rename=lambda name: name) -> None:
    """Every point falls on the same pixel as in the scene that was written."""
    assert len(capture.views) == len(scene.cameras)
    assert len(capture.points) == len(scene.points)
    np.testing.assert_array_equal(capture.point_colors, scene.colors)
    for view in capture.views:
        camera = scene.cameras[rename(view.name)]
        expected, depth = camera.project(scene.points)
        found, _ = view.camera.project(capture.points)
        front = depth > 1
        np.testing.assert_allclose(found[front], expected[front], atol=1e-3)


# ------------------------------------------------------------------------------------------- nerfstudio


def write_transforms(root: Path, scene: TinyScene, applied: np.ndarray | None = None, **changes) -> dict:
    """As ns-process-data: poses and cloud both in the world after `applied`."""
    world = np.eye(4) if applied is None else applied
    first = next(iter(scene.cameras.values()))
    content: dict = {
        "camera_model": "OPENCV", "w": first.width, "h": first.height, "fl_x": first.fx, "fl_y": first.fy,
        "cx": first.cx, "cy": first.cy, "k1": 0.0, "ply_file_path": "sparse_pc.ply",
        "frames": [
            {"file_path": f"images/{name}", "transform_matrix": (
                world @ np.linalg.inv(camera.camera_from_world) @ OPENGL).tolist()}
            for name, camera in scene.cameras.items()
        ],
    }  # fmt: skip
    if applied is not None:
        content["applied_transform"] = applied[:3].tolist()
    content |= changes
    root.mkdir(parents=True, exist_ok=True)
    (root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    write_ply(root / "sparse_pc.ply", scene.points @ world[:3, :3].T + world[:3, 3], scene.colors)
    write_images(root / "images", scene)
    return content


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


@pytest.mark.parametrize(("key", "side"), [("train_filenames", "train"), ("test_filenames", "test")])
def test_a_side_without_a_list_takes_the_frames_that_the_other_leaves(tmp_path, scene, key, side):
    names = sorted(scene.cameras)
    write_transforms(tmp_path, scene, **{key: [f"images/{name}" for name in names[3:7]]})
    capture = load_capture(tmp_path)
    assert [view.name for view in capture.views if view.split == side] == names[3:7]
    assert (len(capture.views), capture.warnings) == (12, ())


def test_lists_of_what_is_no_frame_are_refused(tmp_path, scene):
    write_transforms(tmp_path, scene, train_filenames=["images/frame_000.JPG"], test_filenames=["images/else.png"])
    with pytest.raises(CaptureError, match=r"1 names in its lists .*--split every\.\n  images/else\.png"):
        load_capture(tmp_path)
    assert len(load_capture(tmp_path, CaptureOptions(split="every")).views) == 12


def shifted_by_nerfstudio() -> np.ndarray:
    """A world_from_source of ns-process-data, and more than its turn of axes."""
    applied = np.eye(4)[[0, 2, 1, 3]]
    applied[2] *= -1
    applied[:3, 3] = [1.0, 2.0, 3.0]
    return applied


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


def test_angles_stand_in_for_focal_lengths(tmp_path, scene):
    camera = next(iter(scene.cameras.values()))
    content = write_transforms(tmp_path, scene)
    for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
        content.pop(key)
    content["camera_angle_x"] = 2 * np.arctan(camera.width / 2 / camera.fx)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_sees_the_scene(load_capture(tmp_path), scene)


@pytest.mark.parametrize("says", [
    {"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "OPENCV_FISHEYE", "is_fisheye": True},
])  # fmt: skip
def test_fisheyes_are_read_as_such(says):
    """nerfstudio names the model; instant-ngp knows `is_fisheye` and no model. Both mean k1...k4 of OpenCV's."""
    lens = {"fl_x": 50.0, "fl_y": 51.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    lens |= {"k1": 0.04, "k2": 0.03, "k3": 0.02, "k4": 0.01}
    found = parse_intrinsics({}, lens | says, Path("a.png"), Path("transforms.json"))
    assert found == Intrinsics("OPENCV_FISHEYE", (50.0, 51.0, 32.0, 24.0, 0.04, 0.03, 0.02, 0.01), 64, 48)


def test_distortion_is_read_from_keys_and_lists_alike():
    lens = {
        "fl_x": 50.0,
        "fl_y": 51.0,
        "cx": 32.0,
        "cy": 24.0,
        "w": 64,
        "h": 48,
        "k5": 0.0,
        "rolling_shutter": [0, 0.0],
    }
    by_keys = lens | {"k1": 0.04, "k2": 0.03, "p1": 0.02, "p2": 0.01}
    by_list = lens | {"distortion_params": [0.04, 0.03, 0, 0, 0.02, 0.01]}
    one, other = (parse_intrinsics({}, each, Path("a.png"), Path("transforms.json")) for each in (by_keys, by_list))
    assert one == other
    assert one.model == "OPENCV"
    found = parse_intrinsics({}, by_keys | {"k3": -0.02, "k4": 0.3}, Path("a.png"), Path("transforms.json"))
    x, y, r2 = 0.3, -0.4, 0.25
    radial = 1 + 0.04 * r2 + 0.03 * r2**2 - 0.02 * r2**3 + 0.3 * r2**4
    bent = x * radial + 2 * 0.02 * x * y + 0.01 * (r2 + 2 * x * x), y * radial + 0.02 * (r2 + 2 * y * y) + 0.02 * x * y
    np.testing.assert_allclose(ray_pixels(found, np.array([[x, y]]))[0], (50 * bent[0] + 32, 51 * bent[1] + 24))


def frame(pose: np.ndarray, path: str = "images/frame_000.png") -> dict:
    return {"file_path": path, "transform_matrix": pose.tolist()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "none"),
        ({"frames": [{"file_path": "images/frame_000.png"}]}, "4x4 matrix"),
        ({"frames": [frame(2 * np.eye(4))]}, "orthonormal"),
        ({"frames": [frame(np.eye(4), "../frame_000.png")]}, "inside the capture"),
        ({"frames": [frame(np.eye(4), "images/no.png")]}, r"1 of 1 images .* are missing(?s:.)*no\.png"),
        ({"fl_x": "wide"}, "finite number"),
        ({"fl_x": -3.0, "fl_y": -3.0}, "focal length"),
        ({"camera_model": "EQUIRECTANGULAR"}, "not supported"),
        ({"camera_model": "FISHEYE624"}, "'FISHEYE624' is not supported; undistort"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 61.0}, "camera_angle_x 61 must be radians"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "'THIN_PRISM_FISHEYE' is not supported; undistort"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye contradicts the camera model OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}, "p1, p2 of a fisheye"),
        ({"k6": 0.01}, "lens parameter k6 is not supported"),
        ({"rolling_shutter": [0, 0, 0.1, 0]}, "rolling_shutter is not supported"),
        ({"distortion_params": [0.1]}, "must be a list of k1"),
        ({"ftheta_p0": 0.0}, "'ftheta_p0' describes is not supported"),
        ({"ply_file_path": "../../cloud.ply"}, "inside the capture"),
        ({"ply_file_path": None}, None),
        ({"applied_transform": (3 * np.eye(4)[:3]).tolist()}, "orthonormal"),
    ],
)  # fmt: skip
def test_mistakes_in_transforms_json_are_named(tmp_path, scene, changes, message):
    write_transforms(tmp_path, scene, **changes)
    if message is None:  # sparse_pc.ply is found by its usual name
        assert len(load_capture(tmp_path).points) == len(scene.points)
        return
    with pytest.raises(CaptureError, match=message):
        load_capture(tmp_path)


@FUZZ
@given(data=st.data())
def test_damaged_transforms_json_ends_in_a_message_or_a_capture(tmp_path, data):
    write_transforms(tmp_path, tiny_scene(columns=2, rows=2, points=8))
    file = tmp_path / "transforms.json"
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        position = data.draw(st.integers(0, len(content) - 1))
        match data.draw(st.sampled_from(["flip", "digit", "cut"])):
            case "flip":
                content[position] ^= 1 << data.draw(st.integers(0, 7))
            case "digit":
                content[position : position + 1] = data.draw(
                    st.sampled_from([b"9e999", b"null", b"[]", b"{}", b'""', b"-"])
                )
            case "cut":
                del content[position : position + data.draw(st.integers(1, 400))]
        content = content or bytearray(b"{}")
    file.write_bytes(bytes(content))
    with contextlib.suppress(CaptureError):
        capture = load_capture(tmp_path)
        assert all(np.isfinite(view.camera.camera_from_world).all() for view in capture.views)
        assert np.isfinite(capture.points).all()


# -------------------------------------------------------------------------------------------------- PLY


@pytest.mark.parametrize("text", [False, True])
def test_point_clouds_are_read_as_written(tmp_path, scene, text):
    write_ply(tmp_path / "a.ply", scene.points, scene.colors, text=text)
    points, colors = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, scene.points)
    np.testing.assert_array_equal(colors, scene.colors)


def test_point_clouds_of_other_programs_are_read(tmp_path, scene):
    import trimesh

    cloud = trimesh.PointCloud(scene.points, np.column_stack([scene.colors, np.full(len(scene.points), 255)]))
    for encoding in ("ascii", "binary"):
        (tmp_path / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(cloud, encoding=encoding))
        points, colors = read_point_cloud(tmp_path / "a.ply")
        np.testing.assert_allclose(points, scene.points, atol=1e-5)
        np.testing.assert_array_equal(colors, scene.colors)


@FUZZ
@given(data=st.data(), text=st.booleans())
def test_damaged_point_clouds_end_in_a_message_or_points(tmp_path, data, text):
    file = tmp_path / "a.ply"
    write_ply(file, np.zeros((5, 3)), np.zeros((5, 3), np.uint8), text=text)
    content = bytearray(file.read_bytes())
    content = content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content
    for _ in range(3 if content else 0):
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(bytes(content))
    with contextlib.suppress(CaptureError):
        points, colors = read_point_cloud(file)
        assert points.shape == colors.shape


# -------------------------------------------------------------------------------------------- Mega-NeRF


@pytest.mark.parametrize("points", ["ply", "colmap", "colmap of the originals"])
def test_mega_nerf(tmp_path, scene, points):
    """The split is the shipped one, down is x, and points may come from a COLMAP model in any world."""
    renamed = write_mega_nerf(tmp_path, scene)
    if points == "ply":
        write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    else:
        of = scene if "originals" in points else TinyScene(
            {Path(name).name: camera for name, camera in renamed.cameras.items()}, scene.points, scene.colors
        )  # fmt: skip
        angle = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
        write_colmap(tmp_path, moved(of, 0.07, angle, np.array([1.0, 2, 3])), images=None)
    capture = load_capture(tmp_path)
    assert capture.source == "mega-nerf"
    assert capture.ground.metric
    assert {view.name for view in capture.test_views} == {n for n in renamed.cameras if n.startswith("val/")}
    assert_sees_the_scene(capture, renamed)
    back = capture.points - np.median(capture.points, axis=0)
    np.testing.assert_allclose(back, scene.points - np.median(scene.points, axis=0), atol=1e-3)


def test_mistakes_in_mega_nerf_folders_are_named(tmp_path, scene):
    write_mega_nerf(tmp_path, scene)
    with pytest.raises(CaptureError, match=r"brings no 3D points(?s:.)*points3D\.ply"):
        load_capture(tmp_path)
    write_ply(tmp_path / "points3D.ply", scene.points @ DRB.T, scene.colors)
    file = tmp_path / "train" / "metadata" / "000001.pt"
    whole = file.read_bytes()
    for content in (whole[:100], b"", b"not torch at all", whole[:-60]):
        file.write_bytes(content)
        with pytest.raises(CaptureError, match=r"000001\.pt: cannot be read as a torch file"):
            load_capture(tmp_path)
    torch.save({"H": 48, "W": 64}, file)
    with pytest.raises(CaptureError, match="needs 'intrinsics'"):
        load_capture(tmp_path)
    file.write_bytes(whole)
    gone = sorted((tmp_path / "train" / "rgbs").glob("*.png"))[:7]
    for image in gone:
        image.unlink()
    with pytest.raises(CaptureError, match=r"[67] of 12 images .* are missing(?s:.)*000002(?s:.)*UrbanScene3D"):
        load_capture(tmp_path)


def test_a_foreign_colmap_model_is_refused(tmp_path, scene):
    write_mega_nerf(tmp_path, scene)
    shuffled = np.random.default_rng(0).permutation(list(scene.cameras))
    others = dict(zip(shuffled.tolist(), scene.cameras.values(), strict=True))
    write_colmap(tmp_path, TinyScene(others, scene.points, scene.colors), images=None)
    with pytest.raises(CaptureError, match="disagree"):
        load_capture(tmp_path)


# -------------------------------------------------------------------------------------------- MatrixCity


def test_matrixcity_pose_folder(tmp_path, scene):
    """pose/<block>/transforms_train.json: units of 100 m, images found above, in their blocks."""
    train, test = halves(scene)
    root = tmp_path / "aerial" / "pose" / "block_A"
    both = write_matrixcity(root, train, test)
    capture = load_capture(root)
    assert capture.source == "matrixcity"
    assert capture.ground.metric
    assert (len(capture.train_views), len(capture.test_views)) == (9, 3)
    assert_sees_the_scene(capture, both)
    np.testing.assert_allclose(np.ptp(capture.points, axis=0), np.ptp(scene.points, axis=0), rtol=1e-9)
    files = [root / f"transforms_{side}.json" for side in ("train", "test")]
    contents = [json.loads(file.read_text()) for file in files]
    contents[1]["frames"].append(contents[0]["frames"][8])
    files[1].write_text(json.dumps(contents[1]))
    twice = load_capture(root)
    assert (len(twice.train_views), len(twice.test_views)) == (8, 4)
    assert any("0008.png: in the training file and in the test file" in warning for warning in twice.warnings)
    for k in range(7):
        (tmp_path / "aerial" / "train" / "block_1" / f"000{k}.png").unlink()
    with pytest.raises(CaptureError, match=r"7 of 13 images .* are missing(?s:.)*0003\.png(?s:.)*Unpack the \.tar"):
        load_capture(root)


def test_matrixcity_blocks(tmp_path, scene):
    """train/<block>/transforms.json: metres, the rotation divided by 100, images in rgb/."""
    train, test = halves(scene)
    first = next(iter(scene.cameras.values()))
    for part, block in ((train, "train/block_1"), (test, "test/block_1_test")):
        frames = []
        for frame in matrixcity_frames(part, block, 1.0):
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= 0.01
            frames.append({"frame_index": frame["frame_index"], "rot_mat": pose.tolist()})
        (tmp_path / block).mkdir(parents=True)
        content = {"camera_angle_x": 2 * np.arctan(first.width / 2 / first.fx), "frames": frames}
        (tmp_path / block / "transforms.json").write_text(json.dumps(content))
        write_images(tmp_path / block / "rgb", part)
    write_ply(tmp_path / "points3D.ply", scene.points, scene.colors)
    capture = load_capture(tmp_path)
    assert capture.ground.metric
    both = {f"train/block_1/rgb/{n}": c for n, c in train.cameras.items()}
    both |= {f"test/block_1_test/rgb/{n}": c for n, c in test.cameras.items()}
    assert_sees_the_scene(capture, TinyScene(both, scene.points, scene.colors))
    np.testing.assert_allclose(np.ptp(capture.points, axis=0), np.ptp(scene.points, axis=0), rtol=1e-9)


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
    with pytest.raises(CaptureError, match=r"the ply_file_path '/elsewhere/cloud\.ply' is not a path inside"):
        load_capture(tmp_path)


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
    content["frames"][0]["transform_matrix"] = (2 * np.eye(4)).tolist()
    content["frames"][3]["transform_matrix"] = []
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="orthonormal"):
        load_capture(tmp_path)


def test_a_transposed_pose_is_refused(tmp_path):
    """Without a look at the last row all cameras would stand at the origin."""
    place = np.eye(4)
    place[:3, 3] = 3.0, 4.0, 5.0
    assert np.array_equal(parse_matrix(place.tolist(), tmp_path, "frame 1"), place)
    with pytest.raises(CaptureError, match=r"frame 1 has a matrix whose last row is not 0 0 0 1\. It seems transposed"):
        parse_matrix(place.T.tolist(), tmp_path, "frame 1")
