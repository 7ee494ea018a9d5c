"""Where one stands: the camera of a browser, of a photograph and of a path, without a scene."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.captures import camera_at
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import look_at_pose
from vdgs.rendering.path_io import load_path
from vdgs.viewer import navigation
from vdgs.viewer.path_panel import camera_at_time, path_json, video_cameras


def test_the_browsers_camera_is_ours():
    pose = look_at_pose(np.array([3.0, -8.0, 6.0]), np.array([1.0, 2.0, 0.0]))
    wxyz = np.roll(Rotation.from_matrix(pose[:3, :3].T).as_quat(), 1)
    camera = navigation.camera_from_browser(wxyz, np.array([3.0, -8.0, 6.0]), math.radians(60), 800, 600)
    assert np.allclose(camera.camera_from_world, pose)
    assert camera.fy == pytest.approx(300 / math.tan(math.radians(30)))
    for broken in (np.zeros(4), np.array([np.nan, 0, 0, 1])):
        with pytest.raises(ValueError, match="no camera"):
            navigation.camera_from_browser(broken, np.zeros(3), 1.0, 8, 8)
    with pytest.raises(ValueError, match="no camera"):
        navigation.camera_from_browser(wxyz, np.zeros(3), 1.0, 0, 8)


def test_no_canvas_is_larger_than_can_be_drawn():
    def of(width: int, height: int) -> Camera:
        return navigation.camera_from_browser(np.array([1.0, 0, 0, 0]), np.zeros(3), 1.0, width, height)

    most = navigation.max_render_pixels(1 << 40)
    for width, height in ((1280, 800), (3840, 2160), (7680, 4320)):
        whole = of(width, height)
        assert navigation.limit_resolution(whole, most) is whole
    for width, height in ((200_000, 200_000), (200_000, 100), (1, 10**9), (20_000, 1)):
        asked, drawn = of(width, height), navigation.limit_resolution(of(width, height), most)
        assert drawn.width * drawn.height <= most
        assert max(drawn.width, drawn.height) <= 16_384
        assert drawn.fy / drawn.height == pytest.approx(asked.fy / asked.height)  # it sees the same
    # Little memory is left: small pictures, but pictures.
    assert navigation.limit_resolution(of(1280, 800), navigation.max_render_pixels(20_000_000)).height == 353
    assert navigation.limit_resolution(of(1280, 800), navigation.max_render_pixels(0)).width == 1


def test_all_of_a_photograph_fits_the_canvas():
    camera = Camera(camera_from_world=np.eye(4), fx=100.0, fy=100.0, cx=80.0, cy=60.0, width=160, height=120)
    for aspect in (0.5, 1.0, 3.0):
        fov = navigation.fov_to_fit(camera, aspect)
        focal = 0.5 / math.tan(fov / 2)  # of a canvas one high
        assert focal * 160 / 100 <= aspect + 1e-9
        assert focal * 120 / 100 <= 1 + 1e-9


def test_a_window_that_changes_its_shape_between_key_frames_stretches_no_film(tmp_path):
    at, level = np.zeros(3), np.array([1.0, 0, 0, 0])
    frames = [navigation.camera_from_browser(level, at, 1.0, *size) for size in ((1600, 900), (900, 1201), (320, 200))]
    file = tmp_path / "path.json"
    file.write_text(path_json(frames, 4.0, fps=10.0))
    for camera in (*load_path(file, camera_at(0, 0)).cameras, *video_cameras(frames, 4.0)):
        assert (camera.width, camera.height) == (1600, 900)
        assert (camera.cx, camera.cy) == pytest.approx((800, 450))
        assert camera.fx == pytest.approx(camera.fy)
        assert 2 * math.atan(450 / camera.fy) == pytest.approx(1.0)  # as high as the viewer showed it


def test_a_path_is_read_back_as_it_was_set(tmp_path):
    frames = [camera_at(x, 1.0, 5.0, 10.0 * x, 7.0 * x, 640) for x in (0.0, 1.3, 2.9)]
    file = tmp_path / "path.json"
    file.write_text(path_json(frames, 4.0, fps=10.0))
    read = load_path(file, camera_at(0, 0))
    assert len(read.cameras) == 40
    for first, second in ((frames[0], read.cameras[0]), (frames[-1], read.cameras[-1])):
        assert np.allclose(first.camera_from_world, second.camera_from_world, atol=1e-12)
        assert (first.fx, first.width, first.height) == (second.fx, second.width, second.height)
    content = json.loads(file.read_text())
    assert np.array_equal(content["keyframes"][1]["camera_from_world"], frames[1].camera_from_world)
    video = video_cameras(frames, 4.0)
    for time, frame in ((0.0, frames[0]), (99.0, frames[-1])):
        assert np.allclose(camera_at_time(video, time).camera_from_world, frame.camera_from_world)
    with pytest.raises(ValueError, match="at least one"):
        path_json([], 1.0)
