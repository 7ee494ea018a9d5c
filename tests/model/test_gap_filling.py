"""Gap points: on ground that a camera sees and that holds no sparse point, and nowhere else."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vdgs.geometry.camera import Camera
from vdgs.model.initialization.gap_filling import CELL_VOXELS, MAX_GAP_FRACTION, find_gap_points

VOXEL = 0.25


def camera(x: float = 0.0, y: float = 0.0, height: float = 20.0) -> Camera:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, y, height])
    return Camera(camera_from_world=pose, fx=100.0, fy=100.0, cx=100.0, cy=100.0, width=200, height=200)


def ground(seed: int = 0, count: int = 4000) -> np.ndarray:
    """Points on a slope over [-20, 20]^2, without those of a hole of 16 x 16 about the origin."""
    flat = np.random.default_rng(seed).uniform(-20, 20, (count, 2))
    flat = flat[(np.abs(flat) > 8).any(axis=1)]
    return np.column_stack([flat, 0.05 * flat[:, 0]])


@settings(max_examples=20)
@given(seed=st.integers(0, 100))
def test_a_hole_is_filled_at_the_height_of_the_ground_about_it(seed):
    points = ground(seed)
    filled = find_gap_points(points, [camera()], VOXEL)
    inner = filled[(np.abs(filled[:, :2]) < 7).all(axis=1)]
    assert len(inner) > 20
    assert camera().in_frustum(filled).all()
    assert len(filled) <= MAX_GAP_FRACTION * len(points)
    assert np.abs(inner[:, 2]).max() <= 1.0 + 1e-9  # the slope's heights all about the hole


def test_no_gap_point_lies_near_a_sparse_one():
    points = ground()
    filled = find_gap_points(points, [camera()], VOXEL)
    distance = np.abs(filled[:, None, :2] - points[None, :, :2]).max(axis=2).min(axis=1)
    assert distance.min() > 0.5 * CELL_VOXELS * VOXEL


def test_what_no_camera_sees_stays_empty():
    assert len(find_gap_points(ground(), [camera(500.0, 500.0)], VOXEL)) == 0
    assert len(find_gap_points(ground(), [], VOXEL)) == 0


def test_complete_cover_is_left_alone():
    x, y = np.meshgrid(np.arange(-10, 10, 0.5), np.arange(-10, 10, 0.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    inside = find_gap_points(points, [camera()], VOXEL)
    assert not (np.abs(inside[:, :2]) < 9.5).all(axis=1).any()
