"""Needles, floaters and angles to training views, on splats and cameras whose figures are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.splat_artifacts import (
    ANGLE_EDGES,
    MAX_ANGLE_PIXELS,
    floater_share,
    needle_share,
    training_view_angles,
)
from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import DILATION_PX2
from vdgs.kernels.kernel_types import Splats

SIDE = 40


def camera_at(x: float, z: float = -10.0) -> Camera:
    """A camera that looks along z."""
    pose = np.eye(4)
    pose[:3, 3] = -x, 0.0, -z
    return Camera(camera_from_world=pose, fx=40.0, fy=40.0, cx=20.0, cy=20.0, width=SIDE, height=SIDE)


def splats(*sizes: tuple[float, float]) -> Splats:
    """Splats of standard deviations along and across (pixels, before the blur), far apart."""
    count = len(sizes)
    variances = torch.tensor(sizes, dtype=torch.float64).reshape(-1, 2) ** 2 + DILATION_PX2
    conics = torch.stack([1 / variances[:, 0], torch.zeros(count), 1 / variances[:, 1]], 1)
    middles = torch.tensor([[20.0, 5.0 + 10.0 * k] for k in range(count)]).reshape(-1, 2)
    return Splats(
        means_px=middles, conics=conics.float(), depths=torch.ones(count), colors=torch.ones(count, 3),
        opacities=torch.full((count,), 0.8),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("size", "is_needle"),
    [((3.0, 1.0), False), ((4.0, 0.05), True), ((5.0, 0.3), True), ((0.2, 0.01), False), ((1.0, 0.2), False)],
)
def test_a_needle_is_long_and_thin(size: tuple[float, float], is_needle: bool) -> None:
    assert needle_share(splats(size), camera_at(0.0)) == pytest.approx(float(is_needle), abs=1e-6)


def test_needles_count_by_what_they_draw() -> None:
    share = needle_share(splats((4.0, 0.05), (2.0, 2.0), (2.0, 2.0)), camera_at(0.0))
    assert share is not None
    assert 0.05 < share < 0.4
    assert needle_share(splats(), camera_at(0.0)) is None


def test_floaters_hang_before_the_truth() -> None:
    true = np.array([[10.0, 10.0, np.inf, np.inf]])
    depth, alpha = np.array([[9.0, 9.9, 9.0, 9.0]]), np.array([[1.0, 1.0, 1.0, 0.1]])
    assert floater_share(depth, alpha, true, camera_height=10.0) == 0.5


def test_angles_are_those_to_the_nearest_camera_that_holds_the_place() -> None:
    depth = np.full((SIDE, SIDE), 10.0)
    depth[:, 0] = np.inf
    angles = training_view_angles(camera_at(0.0), depth, [camera_at(3.0), camera_at(0.0, 5.0)])
    middle = angles[20, 20]  # the place is all but straight ahead, at a distance of 10
    assert middle == pytest.approx(math.degrees(math.atan(0.3)), abs=0.5)
    assert np.isnan(angles[:, 0]).all()
    assert angles[20, 2] == 180.0  # outside both pictures


def test_only_cameras_that_reach_what_a_view_shows_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight of thousands of photographs has dozens near each place."""
    depth = 10.0 + np.random.default_rng(0).uniform(-1, 1, (240, 320))
    depth[:100, :100] = np.inf
    camera = replace(camera_at(0.0), fx=300.0, fy=300.0, cx=160.0, cy=120.0, width=320, height=240)
    flight = [camera_at(0.5 * k) for k in range(-200, 200)]
    asked, hold = list[int](), Camera.in_frustum
    monkeypatch.setattr(Camera, "in_frustum", lambda self, places: asked.append(len(places)) or hold(self, places))
    found = training_view_angles(camera, depth, flight)
    pixels = np.isfinite(found)
    assert 0 < sum(asked) < 0.15 * pixels.sum() * len(flight)
    places = camera.unproject(np.where(pixels, depth, 1.0))[pixels]
    toward = camera.position - places
    expected = np.full(len(places), 180.0)
    for other in flight:
        back = other.position - places
        lengths = np.linalg.norm(toward, axis=1) * np.linalg.norm(back, axis=1)
        angle = np.degrees(np.arccos(((toward * back).sum(axis=1) / lengths).clip(-1, 1)))
        expected = np.where(hold(other, places), np.minimum(expected, angle), expected)
    assert np.allclose(found[pixels], expected, atol=1e-5)
    assert pixels.sum() > 0.5 * MAX_ANGLE_PIXELS


def test_bins_are_cut_at_given_values() -> None:
    histogram = VisibilityHistogram(["squared_error"])
    histogram.add(np.array([[0.0, 9.0, 10.0, 50.0]]), {"squared_error": np.array([[0.1, 0.1, 0.01, 0.001]])})
    bins = histogram.bins_at(ANGLE_EDGES)
    assert [(each["lower"], each["upper"], each["pixels"]) for each in bins] == [(0, 10, 2), (10, 20, 1), (40, None, 1)]
    assert [each["psnr"] for each in bins] == pytest.approx([10.0, 20.0, 30.0])
