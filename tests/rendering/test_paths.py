"""Camera paths: what the file says, what a smooth path promises."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from support.captures import TinyScene, write_colmap
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.rendering.camera_paths import flyover, frame_count, interpolate, look_at_pose, orbit
from vdgs.rendering.path_io import load_path

TEMPLATE = Camera(camera_from_world=np.eye(4), fx=400.0, fy=410.0, cx=160.0, cy=90.0, width=320, height=180)


def standing(position, target, **changes) -> Camera:
    return replace(
        TEMPLATE, camera_from_world=look_at_pose(np.array(position, float), np.array(target, float)), **changes
    )


def write(folder: Path, content) -> Path:
    file = folder / "path.json"
    file.write_text(json.dumps(content))
    return file


def is_rigid(camera: Camera) -> bool:
    rotation = camera.camera_from_world[:3, :3]
    return np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0


coordinates = st.tuples(*[st.floats(-50, 50)] * 3)


@given(coordinates, coordinates)
@settings(max_examples=60)
def test_look_at_puts_the_target_in_the_middle(position, target):
    if np.linalg.norm(np.subtract(position, target)) < 0.1:
        return
    camera = standing(position, target)
    assert is_rigid(camera)
    np.testing.assert_allclose(camera.position, position, atol=1e-9)
    pixels, depth = camera.project(np.array([target]))
    np.testing.assert_allclose(pixels[0], [160, 90], atol=1e-6)
    assert depth[0] > 0


def test_up_is_up():
    camera = standing([0, 0, 10], [0, 30, 0])
    (higher, right), _ = camera.project(np.array([[0, 30, 3.0], [5.0, 30, 0]]))
    assert higher[1] < 90
    assert right[0] > 160


def test_interpolation_meets_its_keyframes():
    keys = [
        standing([0, 0, 10], [0, 5, 0]),
        standing([10, 0, 12], [10, 9, 0]),
        standing([20, 8, 10], [0, 9, 0]),
    ]
    path = interpolate(keys, 501)
    np.testing.assert_allclose(path[0].camera_from_world, keys[0].camera_from_world, atol=1e-9)
    np.testing.assert_allclose(path[-1].camera_from_world, keys[-1].camera_from_world, atol=1e-9)
    nearest = min(path, key=lambda camera: np.linalg.norm(camera.position - keys[1].position))
    np.testing.assert_allclose(nearest.camera_from_world, keys[1].camera_from_world, atol=0.1)
    assert all(is_rigid(camera) for camera in path)


def test_interpolation_is_smooth_and_even():
    rng = np.random.default_rng(0)
    places = np.cumsum(rng.uniform(1, 3, (6, 3)), axis=0)
    path = interpolate([standing(place, place + np.array([1, 2, -5])) for place in places], 600)
    velocity = np.diff([camera.position for camera in path], axis=0)
    speed = np.linalg.norm(velocity, axis=1)
    assert speed.max() < 4 * np.median(speed)
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() < 0.1 * np.median(speed)


def test_a_straight_line_stays_straight():
    keys = [standing([x, 2 * x, 10], [x, 2 * x + 5, 0]) for x in (0.0, 1.0, 2.0, 3.0)]
    path = np.array([camera.position for camera in interpolate(keys, 50)])
    np.testing.assert_allclose(path, np.linspace([0, 0, 10], [3, 6, 10], 50), atol=1e-9)


def test_a_zoom_goes_evenly_from_key_to_key_in_pixels_of_the_first():
    keys = [
        standing([0, 0, 10], [0, 5, 0], fx=100.0, fy=120.0),
        standing([10, 0, 10], [10, 5, 0], fx=400.0, fy=480.0, cx=320.0, cy=160.0, width=640, height=360),
    ]
    path = interpolate(keys, 3)
    assert {(camera.width, camera.height) for camera in path} == {(320, 180)}
    found = [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in path]
    np.testing.assert_allclose(found, [(100, 120, 160, 90), (150, 180, 160, 85), (200, 240, 160, 80)])


def test_interpolation_commutes_with_a_rigid_motion():
    keys = [
        standing([0, 0, 10], [0, 5, 0]),
        standing([10, 0, 12], [10, 9, 0]),
        standing([20, 8, 10], [0, 9, 0]),
    ]
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.2, 1.1]).as_matrix()
    motion[:3, 3] = [3, -4, 5]
    back = np.linalg.inv(motion)
    moved = [replace(key, camera_from_world=key.camera_from_world @ back) for key in keys]
    for here, there in zip(interpolate(keys, 40), interpolate(moved, 40), strict=True):
        np.testing.assert_allclose(here.camera_from_world @ back, there.camera_from_world, atol=1e-9)


def test_a_closed_path_loops_without_a_seam():
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    keys = [standing([10 * np.cos(a), 10 * np.sin(a), 8], [0, 0, 0]) for a in angles]
    path = np.array([camera.position for camera in interpolate(keys, 400, closed=True)])
    around = np.concatenate([path, path[:2]])
    steps = np.linalg.norm(np.diff(around, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.min()
    np.testing.assert_allclose(np.linalg.norm(path[:, :2], axis=1), 10, atol=0.1)


def test_single_and_repeated_keyframes():
    key = standing([0, 0, 10], [0, 5, 0])
    for keys in ([key], [key, key, key]):
        path = interpolate(keys, 4)
        assert len(path) == 4
        for camera in path:
            np.testing.assert_allclose(camera.camera_from_world, key.camera_from_world, atol=1e-12)


def test_a_file_with_everything(tmp_path: Path):
    pose = look_at_pose(np.array([1.0, 2, 3]), np.array([4.0, 5, 0]))
    entries = [
        {"position": [0, 0, 30], "look_at": [0, 20, 0], "fov_deg": 60},
        {
            "camera_from_world": pose.tolist(),
            "fx": 800,
            "fy": 790,
            "cx": 480,
            "cy": 270,
            "width": 960,
            "height": 540,
        },
    ]
    file = write(tmp_path, {"keyframes": entries, "interpolate": False, "fps": 24})
    path = load_path(file, TEMPLATE)
    first, second = path.cameras
    assert path.fps == 24
    assert first.fy == pytest.approx(270 / np.tan(np.radians(30)))
    for camera in path.cameras:  # what leaves its size out takes that of the others: one film, one size
        assert (camera.width, camera.height) == (960, 540)
    assert second.fx == pytest.approx(800)
    np.testing.assert_allclose(second.camera_from_world, pose)
    smooth = load_path(write(tmp_path, entries), TEMPLATE, seconds=2.0, fps=10.0)
    assert len(smooth.cameras) == 20


def test_films_of_another_shape_than_the_photographs_are_not_stretched(tmp_path: Path):
    file = write(tmp_path, [VIEW | {"width": 400, "height": 360}, VIEW | {"position": [0, 5, 1]}])
    for camera in load_path(file, TEMPLATE, seconds=1.0).cameras:
        assert (camera.width, camera.height) == (400, 360)
        found = camera.fx, camera.fy, camera.cx, camera.cy
        assert found == pytest.approx((800.0, 820.0, 200.0, 180.0))  # twice as high as the template, and as the view is


def test_a_path_in_the_source_frame_shows_the_same(tmp_path: Path):
    rotation = Rotation.from_euler("xyz", [1.2, 0.3, -0.4]).as_matrix()
    ground = GroundFrame(
        scale=2.5, rotation=rotation, translation=np.array([10.0, -4, 7]), metric=False, description="test"
    )
    entry = {"position": [0, 1, 2], "look_at": [3, 3, 3], "up": [0, 1, 0]}
    plain = load_path(write(tmp_path, [entry]), TEMPLATE).cameras[0]
    file = write(tmp_path, {"frame": "source", "keyframes": [entry]})
    moved = load_path(file, TEMPLATE, ground).cameras[0]
    points = np.random.default_rng(1).uniform(-5, 5, (20, 3))
    before, depth = plain.project(points)
    after, scaled = moved.project(ground.to_ground(points))
    np.testing.assert_allclose(after, before, atol=1e-6)
    np.testing.assert_allclose(scaled, 2.5 * depth, atol=1e-9)


def test_a_path_in_the_form_of_nerfstudio(tmp_path: Path):
    looking_north = np.array([[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1.0]])  # OpenGL: -z forward
    content = {
        "frame": "source", "render_width": 640, "render_height": 480, "fps": 25, "seconds": 1,
        "camera_path": [{"camera_to_world": looking_north.ravel().tolist(), "fov": 90, "aspect": 4 / 3}] * 3,
    }  # fmt: skip
    path = load_path(write(tmp_path, content), TEMPLATE)
    assert (len(path.cameras), path.fps) == (3, 25)
    camera = path.cameras[0]
    assert (camera.width, camera.height, camera.fx, camera.cx) == (640, 480, pytest.approx(240), 320)
    np.testing.assert_allclose(camera.position, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(camera.forward, [0, 1, 0], atol=1e-12)
    above, _ = camera.project(np.array([[1.0, 10, 4]]))
    assert above[0, 1] < 240


def of_nerfstudio(motion: np.ndarray, scale: float, poses: list[np.ndarray]) -> dict[str, object]:
    """What nerfstudio's viewer saves of cameras in the source frame: camera-to-world, OpenGL axes, moved, then their
    places scaled."""
    moved = [motion @ np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1]) for pose in poses]
    for each in moved:
        each[:3, 3] *= scale
    return {"camera_path": [{"camera_to_world": each.ravel().tolist(), "fov": 50} for each in moved]}


#: Where nerfstudio's frame may be said: beside camera_paths/a.json, one folder up, in the capture.
@pytest.mark.parametrize("place", ["data/camera_paths", "data", "capture"])
def test_a_path_of_nerfstudio_leads_back_to_the_capture(place: str, tmp_path: Path):
    for folder in ("data/camera_paths", "capture"):
        (tmp_path / folder).mkdir(parents=True)
    # nerfstudio turns and moves what `applied_transform` has turned already.
    applied, oriented = np.eye(4), np.eye(4)
    applied[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    oriented[:3, :3] = Rotation.from_euler("xyz", [0.4, -1.1, 0.3]).as_matrix()
    oriented[:3, 3] = [3.0, -20.0, 5.0]
    motion, scale = oriented @ applied, 0.0125
    said = {"transform": motion[:3].astype(np.float32).tolist(), "scale": scale}
    (tmp_path / place / "dataparser_transforms.json").write_text(json.dumps(said))
    poses = [look_at_pose(np.array([x, 4.0, 30]), np.array([x, 20.0, 0])) for x in (-40.0, 0.0, 55.0)]
    file = tmp_path / "data/camera_paths/a.json"
    file.write_text(json.dumps(of_nerfstudio(motion, scale, poses)))
    rotation = Rotation.from_euler("xyz", [1.2, 0.3, -0.4]).as_matrix()
    ground = GroundFrame(
        scale=2.5, rotation=rotation, translation=np.array([10.0, -4, 7]), metric=False, description="test"
    )
    found = load_path(file, TEMPLATE, ground, capture=tmp_path / "capture").cameras
    assert len(found) == 3
    for camera, pose in zip(found, poses, strict=True):
        assert is_rigid(camera)
        position = np.linalg.inv(pose)[:3, 3]
        np.testing.assert_allclose(camera.position, ground.to_ground(position[None])[0], atol=1e-3)
        np.testing.assert_allclose(camera.camera_from_world[:3, :3], pose[:3, :3] @ rotation.T, atol=1e-6)


def test_a_path_of_nerfstudio_without_its_frame_is_refused(tmp_path: Path):
    content = of_nerfstudio(np.eye(4), 1.0, [look_at_pose(np.array([0.0, 0, 9]), np.array([0.0, 1, 0]))])
    file = write(tmp_path, content)
    with pytest.raises(VdgsError, match=r"outputs/NAME/METHOD/DATE/dataparser_transforms.json") as caught:
        load_path(file, TEMPLATE, capture=tmp_path / "capture")
    assert str(file) in str(caught.value)
    assert str(tmp_path / "capture") in str(caught.value)
    assert '"frame": "source"' in str(caught.value)
    for said, why in (
        ({"transform": np.eye(4)[:3].tolist()}, "scale is None"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "scale is 0"),
        ({"transform": np.diag([1.0, 1, -1, 1]).tolist(), "scale": 1}, "mirrors the world"),
        ({"scale": 1}, "transform needs a 4x4 matrix"),
    ):
        (tmp_path / "dataparser_transforms.json").write_text(json.dumps(said))
        with pytest.raises(VdgsError, match=rf"dataparser_transforms.json: .*{why}"):
            load_path(file, TEMPLATE)
    ground = GroundFrame(
        scale=2.0, rotation=np.eye(3), translation=np.array([1.0, 0, 0]), metric=False, description="test"
    )
    for frame, x in (("source", 1.0), ("ground", 0.0)):
        camera = load_path(write(tmp_path, {**content, "frame": frame}), TEMPLATE, ground).cameras[0]
        assert camera.position[0] == pytest.approx(x)


@pytest.mark.parametrize(("text", "given"), [(True, ""), (True, "images.txt"), (False, ""), (False, "images.bin")])
def test_the_images_of_a_colmap_model_are_a_path(tmp_path: Path, text: bool, given: str):
    """In order of their names, in the world of the capture, without distortion, all of one size."""
    poses = {f"DJI_{k}.jpg": standing([float(k), 0, 9], [float(k), 5, 0], fx=300.0 + k) for k in (10, 1, 2)}
    poses["DJI_10.jpg"] = replace(poses["DJI_10.jpg"], width=640, height=360, fx=620.0, fy=820.0, cx=320.0, cy=180.0)
    folder = write_colmap(
        tmp_path, TinyScene(poses, np.zeros((1, 3)), np.zeros((1, 3), np.uint8)), text=text, images=None,
        model="OPENCV", extra=(0.1, -0.05, 0.0, 0.0),
    )  # fmt: skip
    ground = GroundFrame(
        scale=2.0, rotation=np.eye(3), translation=np.array([1.0, 0, 0]), metric=False, description="test"
    )
    path = load_path(folder / given, TEMPLATE, ground)
    places = [camera.position for camera in path.cameras]
    np.testing.assert_allclose(places, [[3, 0, 18], [5, 0, 18], [21, 0, 18]], atol=1e-9)
    found = [(camera.fx, camera.fy, camera.cx, camera.width, camera.height) for camera in path.cameras]
    np.testing.assert_allclose(found, [(301, 410, 160, 320, 180), (302, 410, 160, 320, 180), (310, 410, 160, 320, 180)])
    assert len(load_path(folder / given, TEMPLATE, ground, seconds=2.0, fps=10.0).cameras) == 20


def test_a_folder_without_a_colmap_model_is_no_path(tmp_path: Path):
    with pytest.raises(VdgsError, match="no COLMAP model here"):
        load_path(tmp_path, TEMPLATE)


#: A key frame.
VIEW = {"position": [0, 0, 1], "look_at": [0, 0, 0]}


def nerfstudio(frame: dict[str, object] | None = None, **more: object) -> dict[str, object]:
    """A camera path of nerfstudio's viewer with what its editor keeps, and more."""
    view = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60, "aspect": 16 / 9, **(frame or {})}
    own = {"camera_type": "perspective", "render_width": 1920, "render_height": 1080, "fps": 24, "seconds": 4}
    kept = {"default_fov": 75, "default_transition_sec": 2.0, "is_cycle": False, "smoothness_value": 0.5, "crop": None}
    return {**own, **kept, "keyframes": [{"matrix": "[]"}], "camera_path": [view], "frame": "source", **more}


def test_what_the_editor_of_nerfstudio_keeps_is_no_fault(tmp_path: Path):
    (camera,) = load_path(write(tmp_path, nerfstudio({"render_time": 0})), TEMPLATE).cameras
    assert (camera.width, camera.height) == (1920, 1080)


def test_the_size_of_a_film_is_what_nerfstudio_reads_not_the_aspect_of_its_frames(tmp_path: Path):
    """nerfstudio's add-on for Blender writes an aspect of 1 into every frame."""
    (camera,) = load_path(write(tmp_path, nerfstudio({"aspect": 1})), TEMPLATE).cameras
    focal = pytest.approx(540 / np.tan(np.radians(30)))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (1920, 1080, focal, focal)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"keyframes": []}, "at least one"),
        ({"keyframes": [{"position": [0, 0, 1]}]}, "key frame 0: give camera_from_world"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 1]}], "same point"),
        ([{"position": [0, 0], "look_at": [0, 0, 1]}], "position must be three numbers"),
        ([{"camera_from_world": np.diag([2.0, 2, 2, 1]).tolist()}], "rotation and a translation"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "fov_deg": 180}], "fov_deg"),
        ({"frame": "moon", "keyframes": [{}]}, "ground or source"),
        ({"camera_path": [{}]}, "camera_to_world"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist()}], "frame": "moon"}, "ground or source"),
        ("path", "list of key frames"),
        ({"camera_angle_x": 0.8, "frames": [{"transform_matrix": np.eye(4).tolist()}]}, "which is no camera path"),
        ({"keyframes": [{"position": [0, 0, 1], "look_at": [0, 0, 0]}], "fps": -3}, "fps is -3; it must be"),
        ({"keyframes": [{"position": [0, 0, 1], "look_at": [0, 0, 0]}], "second": 3}, "did you mean 'seconds'"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "fovdeg": 60}], "key frame 0: there is no 'fovdeg'; did you"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "fov_deg": float("nan")}], "fov_deg is nan; it must be"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "width": 100_000_000}], "width is 100000000; it must be"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "fx": "wide"}], "fx is 'wide'; it must be a number"),
        ([{"position": [0, 0, 1], "look_at": [0, 0, 0], "fx": 100, "fov_deg": 50}], "fov_deg or fx and fy"),
        ([{"position": [0, 0, 1e300], "look_at": [0, 0, 0]}], "position must be three numbers"),
        ([{"position": "here", "look_at": [0, 0, 0]}], "position must be three numbers"),
        ([{"camera_from_world": np.eye(4).tolist(), "up": [0, 0, 1]}], "leave out up"),
        ({"keyframes": [{"position": [0, 0, 1], "look_at": [0, 0, 0]}], "closed": "no"}, "closed is 'no'; it must be"),
        ({"camera_path": [[1, 2]]}, "frame 0 of camera_path: it must be an object"),
        ({"camera_path": [{"camera_to_world": np.eye(4).tolist(), "fov": 400}]}, "fov is 400"),
        ([VIEW | {"width": 960}, VIEW, VIEW | {"width": 640}], "key frame 2 asks for 640x180, key frame 0"),
        (nerfstudio(camera_type="fisheye"), "camera_type is 'fisheye'"),
        (nerfstudio(camera_type="equirectangular"), "camera_type is 'equirectangular'"),
        (nerfstudio(camera_type="omnidirectional"), "camera_type is 'omnidirectional'"),
        (nerfstudio(crop={"crop_center": [0, 0, 0]}), "it has a crop"),
        (nerfstudio(time_scale=2), "there is no 'time_scale'"),
        (nerfstudio({"camera_type": "fisheye"}), "frame 0 of camera_path: there is no 'camera_type'"),
        (nerfstudio({"render_time": 0.5}), "render_time is 0.5"),
    ],
)
def test_what_is_wrong_is_named(content, says: str, tmp_path: Path):
    file = write(tmp_path, content)
    with pytest.raises(VdgsError, match=says) as caught:
        load_path(file, TEMPLATE)
    assert str(file) in str(caught.value)


def test_a_film_has_no_more_frames_than_can_be_drawn(tmp_path: Path):
    file = write(tmp_path, [{"position": [0, 0, z], "look_at": [0, 9, 0]} for z in (1, 2)])
    with pytest.raises(VdgsError, match=r"86,400,000 frames.*fewer --seconds"):
        load_path(file, TEMPLATE, seconds=86_400.0, fps=1000.0)
    with pytest.raises(VdgsError, match="nan frames"):
        frame_count(float("nan"), 30.0)
    assert frame_count(0.001, 1.0) == 1


def test_a_path_saved_with_a_byte_order_mark(tmp_path: Path):
    file = write(tmp_path, [{"position": [0, 0, 1], "look_at": [0, 0, 0]}])
    file.write_text(file.read_text(), encoding="utf-8-sig")
    assert len(load_path(file, TEMPLATE).cameras) == 1


def test_a_file_that_is_not_json(tmp_path: Path):
    file = tmp_path / "path.json"
    with pytest.raises(VdgsError, match="no such camera path"):
        load_path(file, TEMPLATE)
    file.write_text("{")
    with pytest.raises(VdgsError, match="not a camera path in JSON"):
        load_path(file, TEMPLATE)


def strips(rows: int = 4, columns: int = 10) -> list[Camera]:
    """A flight to and fro at 30 m, looking straight down."""
    places = [(x if row % 2 == 0 else columns - 1 - x, row * 3) for row in range(rows) for x in range(columns)]
    return [standing([4.0 * x, 4.0 * y, 30], [4.0 * x, 4.0 * y, 0]) for x, y in places]


def test_an_orbit_looks_at_the_scene_from_where_the_flight_was():
    cameras = strips()
    points = np.random.default_rng(2).uniform([0, 0, -1], [36, 36, 1], (500, 3))
    path = orbit(points, cameras, TEMPLATE, seconds=4.0, fps=25.0)
    assert len(path.cameras) == 100
    center = np.median(points, axis=0)
    for camera in path.cameras:
        assert camera.position[2] == pytest.approx(30)
        np.testing.assert_allclose(camera.project(center[None])[0][0], [160, 90], atol=1e-6)


def test_an_orbit_has_two_thirds_of_the_reach_of_the_flight_and_no_seam():
    """Along and across a flight that is longer than wide; the last frame is as far from the first as from its other
    neighbor."""
    cameras = strips(rows=4, columns=20)
    center = np.array([38.0, 18.0, 0.0])
    path = orbit(center[None], cameras, TEMPLATE, seconds=4.0, fps=25.0)
    flown = np.array([camera.position for camera in cameras]) - center
    around = (np.array([camera.position for camera in path.cameras]) - center)[:, :2]
    radii = 2 / 3 * np.quantile(np.abs(flown[:, :2]), 0.9, axis=0)
    np.testing.assert_allclose(np.abs(around).max(axis=0), radii)
    angles = np.arctan2(*(around / radii).T)
    turns = np.diff(np.unwrap([*angles, angles[0]]))
    np.testing.assert_allclose(np.abs(turns), 2 * np.pi / 100)
    assert np.abs(turns.sum()) == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("shuffled", [False, True])
def test_a_flyover_follows_the_flight(shuffled: bool):
    cameras = strips()
    if shuffled:
        order = np.random.default_rng(3).permutation(len(cameras))
        cameras = [cameras[i] for i in order]
    path = flyover(cameras, TEMPLATE, seconds=8.0, fps=25.0)
    places = np.array([camera.position for camera in path.cameras])
    flown = np.array([camera.position for camera in cameras])
    apart = np.linalg.norm(places[:, None] - flown[None], axis=2)
    assert len(places) == 200
    assert apart.min(axis=1).max() < 10  # never far from where photographs were taken
    assert np.quantile(apart.min(axis=0), 0.8) < 6  # and past most of them
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() < 1.5 * steps.min()
    forwards = np.array([camera.forward for camera in path.cameras])
    np.testing.assert_allclose(np.degrees(np.arccos(-forwards[:, 2])), 20, atol=1e-6)
    assert all(is_rigid(camera) for camera in path.cameras)
    if not shuffled:  # a turn at the end of a strip takes many frames
        turned = np.degrees(np.arccos(np.clip((forwards[1:] * forwards[:-1]).sum(1), -1, 1)))
        assert turned.max() < 10


def test_a_flyover_looks_down_as_the_cameras_in_the_middle_do():
    tilts = np.radians([25.0, 60.0, 40.0, 25.0, 60.0])
    cameras = [standing([4.0 * k, 0, 30], [4.0 * k + np.tan(tilt), 0, 29]) for k, tilt in enumerate(tilts)]
    path = flyover(cameras, TEMPLATE, seconds=0.4, fps=25.0)
    forwards = np.array([camera.forward for camera in path.cameras])
    np.testing.assert_allclose(np.degrees(np.arccos(-forwards[:, 2])), 40, atol=1e-6)


def test_a_flyover_of_one_camera_stands_still():
    path = flyover(strips(1, 1), TEMPLATE, seconds=0.2, fps=25.0)
    assert len(path.cameras) == 5
    assert all(is_rigid(camera) for camera in path.cameras)


def rings() -> list[Camera]:
    """Around a tower of 41 m at two heights, then away and home."""
    places = [(r * np.cos(a), r * np.sin(a), z) for r, z in ((66, 28), (56, 62)) for a in np.arange(18) * np.pi / 9]
    home = [standing([100 + 10 * k, 0, 60], [200 + 10 * k, 0, 50]) for k in range(6)]
    return [standing(place, [0, 0, 17]) for place in places] + home


@pytest.mark.parametrize("made", [orbit, flyover])
def test_films_look_at_what_photographs_converge_on_from_as_far_as_they_were(made):
    cameras = rings()
    template = Camera(camera_from_world=np.eye(4), fx=136.0, fy=136.0, cx=80.0, cy=60.0, width=160, height=120)
    ground = np.random.default_rng(2).uniform([-150, -150, -1], [150, 150, 1], (500, 3))
    path = made(*([ground] if made is orbit else []), cameras, template, seconds=2.0, fps=10.0)
    assert path.converged is not None
    for camera in path.cameras:
        pixels, depth = camera.project(np.array([[0, 0, 17.0], [0, 0, 0], [0, 0, 41]]))
        np.testing.assert_allclose(pixels[0], [80, 60], atol=0.5)
        assert camera.holds(pixels, depth).all()  # from its foot to its top
        assert 63 < depth[0] < 73


def test_an_orbit_is_as_wide_as_most_cameras_are_away_where_some_look_at_the_place_on_their_way():
    on_their_way = [standing([60 + 30 * k, 0, 60], [0, 0, 17]) for k in range(1, 7)]
    path = orbit(np.zeros((1, 3)), rings() + on_their_way, TEMPLATE, seconds=2.0, fps=10.0)
    away = [np.hypot(*camera.position[:2]) for camera in path.cameras]
    assert path.converged is not None
    assert 50 < min(away) <= max(away) < 100


def test_a_survey_has_no_place_that_films_look_at():
    assert flyover(strips(), TEMPLATE, seconds=0.2).converged is None
    assert orbit(np.zeros((1, 3)), strips(), TEMPLATE, seconds=0.2).converged is None
