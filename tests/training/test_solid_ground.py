"""Solid ground: where pictures show it, how it becomes opaque, and how large Gaussians may be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.block_training import block_stage
from support.checkerboard import Photographs
from vdgs.config.method import BlockConfig, DensifyConfig, LossConfig
from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.ground import BELOW_HORIZON_DEG, below_horizon
from vdgs.model.renderer import decode_view, render
from vdgs.model.scale_bounds import (
    CLOSEST_SHARE,
    MAX_IMAGE_FRACTION,
    MAX_OFFSET_FACTOR,
    MAX_SIGMA,
    max_log_scales,
    photograph_pixel,
)
from vdgs.training import TrainingProblem, train
from vdgs.training.target import background_at
from vdgs.visibility.frustum import project_points

pytestmark = pytest.mark.slow

FOCAL, WIDTH, HEIGHT = 100.0, 200, 160


def camera_at(x: float = 0.0, height: float = 20.0, tilt: float = 0.0) -> Camera:
    """Above (x, 0), looking straight down, or by `tilt` radians towards +y."""
    down = np.diag([1.0, -1.0, -1.0])
    turn = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ down
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0.0, height])
    return Camera(camera_from_world=pose, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), tilt=st.floats(-1.5, 1.5))
def test_points_fall_where_the_camera_says(seed, tilt):
    points, camera = np.random.default_rng(seed).uniform(-30, 30, (200, 3)), camera_at(tilt=tilt)
    seen = project_points(torch.from_numpy(points), camera)
    assert np.array_equal(seen.inside.numpy(), camera.in_frustum(points))
    pixels, depth = camera.project(points)
    inside = seen.inside.numpy()
    assert np.allclose(np.stack([seen.column, seen.row], axis=1)[inside], pixels[inside])
    assert np.allclose(seen.depth, depth)
    assert np.allclose(seen.distance, np.linalg.norm(points - camera.position, axis=1))
    assert depth[inside].min(initial=1.0) > NEAR_PLANE


@settings(max_examples=20)
@given(tilt=st.floats(-1.5, 1.5))
def test_pixels_well_below_the_horizon_show_no_sky(tilt):
    camera = camera_at(tilt=tilt)
    below = below_horizon(camera, HEIGHT, WIDTH)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1)
    up = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ camera.camera_from_world[:3, :3][:, 2]
    down = np.degrees(np.arcsin(-up))
    assert below[down > BELOW_HORIZON_DEG + 0.01].all()
    assert not below[down < BELOW_HORIZON_DEG - 0.01].any()


# ------------------------------------------------------------------------------------------ backgrounds


class Gray(Photographs):
    """Of a place that has the color of the background."""

    def get(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, None]:
        return torch.full_like(super().get(index, downscale)[0], 128), None


def light_through(loss: LossConfig) -> float:
    """The median of 1 - alpha, of a model that was trained before the color of gray."""
    stage, state = block_stage(BlockConfig())
    config = replace(stage.config, iterations=300, loss=loss, densify=DensifyConfig(num_levels=0, start=10_000))
    photographs, gray = Gray(), (128 / 255,) * 3
    stage = replace(stage, config=config, background=gray, frozen_anchors=None, images=photographs)
    train(state, stage, stop=lambda: False, after_step=lambda *_: None)
    model = state.model(stage)
    return float((1.0 - render(model, photographs.camera(0)).alpha.clamp(0, 1)).quantile(0.5))


def test_ground_becomes_opaque_although_the_background_has_its_color():
    """Without backgrounds of random color light shines through, with them nearly none does."""
    board = light_through(LossConfig())
    assert board < 0.02
    assert light_through(LossConfig(random_background=0.0)) > 3 * board


def test_backgrounds_are_of_all_colors_the_same_for_a_seed_and_no_others_without_noise():
    stage, _ = block_stage(BlockConfig())

    def colors(share: float) -> torch.Tensor:
        loss = LossConfig(random_background=share)
        changed = replace(stage, config=replace(stage.config, loss=loss), background=(0.2, 0.5, 0.8))
        return torch.stack([background_at(changed, iteration) for iteration in range(500)])

    own = torch.tensor([0.2, 0.5, 0.8])
    every = colors(1.0)
    assert torch.equal(every, colors(1.0))
    assert float(every.min()) >= 0
    assert float(every.max()) <= 1
    assert (every.amin(0) < 0.03).all()
    assert (every.amax(0) > 0.97).all()
    torch.testing.assert_close(colors(0.25), own + 0.25 * (every - own))
    assert (colors(0.0) == own).all()


# ------------------------------------------------------------------------------------------------ the law of sizes


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_no_camera_that_holds_a_place_is_veiled_from_there(seed):
    """A Gaussian as large as allowed, drawn at full opacity, spans no more than its share of any picture."""
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.uniform(-15, 15, (300, 3)) * [1, 1, 0.3])
    cameras = [camera_at(x, height, tilt) for x, height, tilt in rng.uniform([-10, 8, -0.5], [10, 30, 0.5], (5, 3))]
    diameter = 2 * MAX_SIGMA * max_log_scales(points, cameras).exp().numpy()
    held = np.zeros(len(points), bool)
    longest = np.zeros(len(points))
    for camera in cameras:
        inside = camera.in_frustum(points.numpy())
        depth = camera.project(points.numpy())[1]
        longest[inside] = np.maximum(longest, diameter * FOCAL / depth)[inside]
        held |= inside
    assert held.sum() > 10
    assert longest[held].max() <= MAX_IMAGE_FRACTION * WIDTH * (1 + 1e-6)
    assert longest[held].min() > MAX_IMAGE_FRACTION * WIDTH * 0.999  # no smaller than it must be


def test_the_pixel_of_photographs_is_that_of_those_that_show_places_closest():
    points = torch.from_numpy(np.random.default_rng(3).uniform(-8, 8, (400, 3)) * [1, 1, 0.5])
    depths = camera_at().project(points.numpy())[1]
    expected = np.quantile(depths, CLOSEST_SHARE) / FOCAL
    assert photograph_pixel(points, [camera_at(), camera_at(height=40.0)]) == pytest.approx(expected, rel=1e-5)
    assert photograph_pixel(points, []) == photograph_pixel(points[:0], [camera_at()]) == 0.0


def test_photographs_of_several_sizes_count_by_their_own_pixels():
    points = torch.from_numpy(np.random.default_rng(3).uniform(-8, 8, (400, 3)) * [1, 1, 0.5])
    camera = camera_at()
    alone = photograph_pixel(points, [camera])
    # A large picture of a place far away does not make the pixels of this one smaller.
    elsewhere = camera_at(9000.0).resized(20 * WIDTH, 20 * HEIGHT)
    assert photograph_pixel(points, [camera, elsewhere]) == pytest.approx(alone, rel=1e-5)
    # From half as high, in a quarter of the pixels: the picture from above shows smaller ones.
    low, middle = camera_at(height=10.0).resized(WIDTH // 4, HEIGHT // 4), 0.1 * points
    assert photograph_pixel(middle, [camera, low]) == pytest.approx(photograph_pixel(middle, [camera]), rel=1e-5)


def test_what_no_camera_holds_is_bounded_by_the_nearest_and_nothing_without_cameras():
    beside = torch.tensor([[500.0, 0.0, 20.0]])
    bound = max_log_scales(beside, [camera_at(), camera_at(100.0)]).exp()
    assert float(bound) == pytest.approx(400.0 * WIDTH / FOCAL * MAX_IMAGE_FRACTION / (2 * MAX_SIGMA), rel=1e-5)
    assert max_log_scales(beside, []).tolist() == [math.inf]


def test_an_anchor_in_the_center_of_a_camera_has_a_size_that_can_be_trained():
    assert max_log_scales(torch.tensor([[0.0, 0.0, 20.0]]), [camera_at()]).isfinite().all()


def test_training_leaves_no_gaussian_larger_than_its_bound_nor_far_from_its_anchor():
    """Scales begin too large, of Gaussians and of the unit of their offsets; anchors that grow are bounded too."""
    stage, state = block_stage(BlockConfig())
    growth = DensifyConfig(
        every=10, stats_start=0, start=10, stop_fraction=0.8, grad_threshold=1e-6, min_draw_fraction=0.05
    )
    config = replace(stage.config, iterations=47, swa_fraction=0.1, densify=growth)
    cameras = Photographs().cameras
    stage = replace(stage, config=config, max_log_scale=lambda places: max_log_scales(places, cameras) - 3.0)
    state.max_log_scale = stage.max_log_scale_at(state.anchors.positions)
    state.anchors.log_scales.add_(4.0)
    before = len(state.anchors)
    train(state, stage, stop=lambda: False, after_step=lambda *_: None)
    anchors, decoder = state.result()
    assert len(anchors) != before
    bound = max_log_scales(anchors.positions, cameras) - 3.0
    for scales, most in (
        (anchors.log_scales[:, :3], bound + math.log(MAX_OFFSET_FACTOR)),
        (anchors.log_scales[:, 3:], bound),
    ):
        assert (scales <= most[:, None] + 1e-5).all()
        assert (scales > most[:, None] - 0.5).any()
    model = AnchorModel(anchors=anchors, decoder=decoder, voxel_size=stage.voxel_size, background=(0.0, 0.0, 0.0))
    for camera in cameras:
        rows, splats = decode_view(model, camera)
        of = rows[splats.source.long() // anchors.offsets.shape[1]]
        largest = (3 * bound[of]).exp()
        assert (splats.volumes <= largest * 1.001).all()


def test_an_unbounded_stage_changes_no_scale():
    stage, state = block_stage(BlockConfig())
    assert isinstance(stage, TrainingProblem)
    assert torch.equal(state.max_log_scale, torch.full((len(state.anchors),), math.inf))
