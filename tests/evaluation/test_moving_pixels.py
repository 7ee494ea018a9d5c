"""What moves: found where one photograph alone differs, and not where a model is wrong for all of them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from support.captures import render_plane, tiny_scene
from vdgs.evaluation.moving_pixels import Residual, make_residual, moving_pixels, overlapping_views
from vdgs.geometry.camera import Camera
from vdgs.visibility.visibility_counts import NearbyCameras

CAMERAS = list(tiny_scene(columns=3, rows=2, width=160, height=120).cameras.values())


def plane_depth(camera) -> np.ndarray:
    near, far = (camera.unproject(np.full((camera.height, camera.width), depth))[..., 2] for depth in (1.0, 2.0))
    return 1 + near / (near - far)


def residual(camera, box=None, mask=None, ghost=0.0) -> Residual:
    """Of a model that shows no detail, and `ghost` too bright in a place that all views see."""
    photograph, depth = render_plane(camera), plane_depth(camera)
    shown = cv2.GaussianBlur(photograph, (0, 0), 6).astype(np.float32) / 255
    places = camera.unproject(depth)
    shown[np.hypot(places[..., 0] - 3, places[..., 1] - 1.5) < 0.7] += ghost
    if box is not None:
        photograph = photograph.copy()
        photograph[box] = (250, 250, 20)
    return make_residual(camera, photograph, mask, shown, depth)


BOX = np.s_[50:62, 80:102]  # where at least three of the others look


def found(own: Residual) -> np.ndarray:
    near = overlapping_views(2, own, NearbyCameras(CAMERAS))
    return moving_pixels(own, [residual(CAMERAS[other], ghost=0.3) for other in near])


@pytest.mark.parametrize("index", range(len(CAMERAS)))
def test_a_view_is_compared_with_those_that_see_most_of_it(index):
    own = residual(CAMERAS[index])
    places = CAMERAS[index].unproject(own.depth).reshape(-1, 3)
    seen = [camera.in_frustum(places).mean() for camera in CAMERAS]
    near = overlapping_views(index, own, NearbyCameras(CAMERAS))
    assert index not in near
    assert set(near) >= {other for other, share in enumerate(seen) if share > 0.1} - {index}
    shares = [seen[other] for other in near]
    assert np.all(np.diff(shares) < 0.1)


def test_of_a_large_flight_only_what_is_near_is_asked(monkeypatch):
    """Else photographs by photographs would be compared."""
    own, hold, asked = residual(CAMERAS[2]), Camera.in_frustum, list[int]()
    away = np.eye(4)
    away[0, 3] = 1000.0
    far = [replace(camera, camera_from_world=camera.camera_from_world @ away) for camera in 20 * CAMERAS]
    near = overlapping_views(2, own, NearbyCameras(CAMERAS))
    monkeypatch.setattr(Camera, "in_frustum", lambda self, places: asked.append(len(places)) or hold(self, places))
    assert overlapping_views(2, own, NearbyCameras([*CAMERAS, *far])) == near
    assert 0 < len(asked) < len(CAMERAS)


def test_an_object_of_one_photograph_is_found_and_nothing_else():
    moves, painted = found(residual(CAMERAS[2], BOX, ghost=0.3)), np.zeros((120, 160), bool)
    painted[BOX] = True
    assert moves[painted].mean() > 0.9
    assert moves[~painted].mean() < 0.015


def test_what_the_model_lacks_or_shows_in_all_photographs_does_not_move():
    assert not found(residual(CAMERAS[2], ghost=0.3)).any()


def test_what_a_mask_leaves_out_is_not_looked_at():
    mask = np.ones((120, 160), np.uint8)
    mask[45:67, 75:107] = 0
    assert not found(residual(CAMERAS[2], BOX, mask, ghost=0.3)).any()


@pytest.mark.parametrize("others", [0, 2])
def test_too_few_other_photographs_say_nothing(others):
    assert not moving_pixels(residual(CAMERAS[2], BOX), [residual(camera) for camera in CAMERAS[:others]]).any()
