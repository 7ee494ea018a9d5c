"""What single fields of transforms.json may say, and what is said of mistakes in them."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support.captures import (
    assert_sees_the_scene,
    tiny_scene,
)
from support.dataset_layouts import (
    write_transforms,
)
from vdgs.captures.formats.center_sizes import told_size
from vdgs.captures.formats.json_poses import parse_intrinsics, parse_matrix
from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.loading import load_capture
from vdgs.errors import CaptureError

FUZZ = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def test_angles_stand_in_for_focal_lengths(tmp_path, scene):
    camera = next(iter(scene.cameras.values()))
    content = write_transforms(tmp_path, scene)
    for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
        content.pop(key)
    content["camera_angle_x"] = 2 * np.arctan(camera.width / 2 / camera.fx)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert_sees_the_scene(load_capture(tmp_path), scene)


@pytest.mark.parametrize(("factor", "off"), [(2, 0.0), (2, 0.004), (4, 0.0), (1.5, 0.0), (0.5, 0.0)])
def test_a_lens_without_a_size_is_of_the_size_that_its_principal_point_says(tmp_path, scene, factor, off):
    """Of photographs that were shrunk after the file was written, or of a file that was written for shrunk ones."""
    camera = next(iter(scene.cameras.values()))
    content = write_transforms(tmp_path, scene)
    for key in ("w", "h"):
        content.pop(key)
    for key in ("fl_x", "fl_y", "cx", "cy"):
        content[key] *= factor
    content["cx"] += off * factor * camera.width
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    [seen] = {(view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) for view in load_capture(tmp_path).views}
    assert seen == pytest.approx((camera.fx, camera.fy, camera.cx + off * camera.width, camera.cy))


@pytest.mark.parametrize(
    ("lens", "size", "expected"),
    [
        ((82.900625, 66.383875), (640, 512), (160, 128)),  # DTU, its Cameras/train
        ((331.6025, 265.5355), (640, 512), (640, 512)),
        ((995.3, 746.2), (480, 360), (1920, 1440)),
        ((1016.3, 762.2), (480, 360), (1920, 1440)),
        ((320.0, 240.0), (480, 360), (640, 480)),
        ((2000.0, 1500.0), (3000, 2250), (4000, 3000)),
        ((2000.0, 1500.0), (5000, 3750), (4000, 3000)),
        ((2000.0, 1500.0), (3840, 2880), (4000, 3000)),
        ((1999.5, 1499.5), (4000, 3000), (4000, 3000)),  # pixels count from the middle of the first
        ((2747.0, 1815.0), (5472, 3648), (5472, 3648)),
        ((2747.0, 1815.0), (2736, 1824), (5472, 3648)),
        ((380.0, 240.0), (640, 480), (640, 480)),  # a part of a photograph
        ((360.0, 270.0), (240, 180), (720, 540)),
        ((990.3, 745.2), (640, 480), (1920, 1440)),
        ((2000.0, 1500.0), (640, 480), (4000, 3000)),  # the middle, whatever the factor
        ((2736.0, 1824.0), (640, 427), (5472, 3648)),
        ((4096.0, 2730.0), (1600, 1066), (8192, 5460)),
        ((787.0, 591.0), (1600, 1200), (1600, 1200)),  # rounded, and of no size that photographs have
        ((392.0, 392.5), (800, 800), (800, 800)),
        ((796.0, 446.5), (2985, 1674), (1592, 893)),  # no multiple is likely
    ],
)
def test_the_nearest_whole_factor_is_the_size_of_a_lens_off_the_middle(lens, size, expected):
    assert told_size(size, lens, Path("transforms.json"), "a.png", "") == expected


@pytest.mark.parametrize(
    ("lens", "size"), [((496.3, 372.2), (64, 48)), ((823.2, 619.1), (1280, 960)), ((823.2, 619.1), (2000, 1500))]
)
def test_a_factor_that_cannot_be_told_is_refused(lens, size):
    """15 or 16 times, or a lens off the middle of photographs that were shrunk or enlarged by no whole number."""
    with pytest.raises(CaptureError, match=r"of another size\. Write w"):
        told_size(size, lens, Path("transforms.json"), "a.png", "Write w")


@pytest.mark.parametrize("center", [(0.5, 0.5), (0.497, 0.512), (0.013, -0.008)])
def test_principal_points_that_are_shares_of_the_sides_are_named(tmp_path, scene, center):
    write_transforms(tmp_path, scene, cx=center[0], cy=center[1])
    with pytest.raises(CaptureError, match=r"\(normalised\)\. Write it in pixels.* 32, 24 for the middle"):
        load_capture(tmp_path)


@pytest.mark.parametrize("center", [(64.0, 30.0), (83.0, 60.0), (-5.0, 24.0)])
def test_a_lens_that_may_be_of_any_other_size_is_refused(tmp_path, scene, center):
    content = write_transforms(tmp_path, scene)
    content |= {"w": None, "h": None, "cx": center[0], "cy": center[1]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(
        CaptureError, match=r"principal point at .* photograph is 64x48: it is of another size\. Write w"
    ):
        load_capture(tmp_path)


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
        ({"frames": [{"file_path": "images/frame_000.png", "c2w": []}]}, "has no 'transform_matrix' .*'c2w'"),
        ({"frames": [{"file_path": "images/frame_000.png", "transform_matrix": [1] * 16}]}, "4 lists of 4"),
        ({"frames": [frame(np.diag([2.0, 1, 1, 1]))]}, r"orthonormal \(scaled or sheared\).*Blender.*Ctrl-A"),
        ({"frames": [frame(np.eye(4), "../gone.png")]}, "inside the capture.*--images FOLDER"),
        ({"frames": [frame(np.eye(4), "images/no.png")]}, r"1 of 1 images .* are missing(?s:.)*no\.png"),
        ({"fl_x": "wide"}, "finite number"),
        ({"fl_x": -3.0, "fl_y": -3.0}, "focal length"),
        ({"camera_model": "EQUIRECTANGULAR"}, "not supported.* vdgs sfm IMAGES"),
        ({"equirectangular": True}, "'equirectangular' describes is not supported.* vdgs sfm IMAGES"),
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


def test_a_transposed_pose_is_refused(tmp_path):
    """Without a look at the last row all cameras would stand at the origin."""
    place = np.eye(4)
    place[:3, 3] = 3.0, 4.0, 5.0
    assert np.array_equal(parse_matrix(place.tolist(), tmp_path, "frame 1"), place)
    with pytest.raises(CaptureError, match=r"frame 1 has a matrix whose last row is not 0 0 0 1\. It seems transposed"):
        parse_matrix(place.T.tolist(), tmp_path, "frame 1")


def test_both_angles_stand_in_for_both_focal_lengths(tmp_path):
    angles = {"camera_angle_x": 2 * np.arctan(400 / 2 / 500.0), "camera_angle_y": 2 * np.arctan(300 / 2 / 520.0)}
    lens = parse_intrinsics({}, {"w": 400, "h": 300, **angles}, tmp_path / "a.png", tmp_path / "transforms.json")
    assert lens.focal == pytest.approx((500.0, 520.0))


def test_masks_that_frames_lack_are_asked_for_where_the_others_are_named(tmp_path, scene):
    content = write_transforms(tmp_path, scene)
    names = [Path(frame["file_path"]).name for frame in content["frames"]]
    (tmp_path / "mine").mkdir()
    cv2.imwrite(str(tmp_path / "mine" / "one.png"), np.full((48, 64), 255, np.uint8))
    for frame in content["frames"][1:]:
        frame["mask_path"] = "mine/one.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    (said,) = [warning for warning in load_capture(tmp_path).warnings if "have a mask" in warning]
    assert "mask_path" in said
    proposed = Path(said.rsplit(" ", 1)[1].removesuffix("."))
    proposed.parent.mkdir(parents=True)
    cv2.imwrite(str(proposed), np.full((48, 64), 255, np.uint8))
    capture = load_capture(tmp_path)  # one put where the warning says counts
    assert {view.name: view.mask_path for view in capture.views}[names[0]] == proposed
    assert not any("have a mask" in warning for warning in capture.warnings)


def test_the_mask_that_a_frame_names_counts_before_one_in_the_folder_of_masks(tmp_path, scene):
    content = write_transforms(tmp_path, scene)
    name = Path(content["frames"][0]["file_path"]).name
    for folder in ("masks", "mine"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / name), np.full((48, 64), 255, np.uint8))
    content["frames"][0]["mask_path"] = f"mine/{name}"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    masks = {view.name: view.mask_path for view in load_capture(tmp_path).views}
    assert masks[name] == tmp_path / "mine" / name
