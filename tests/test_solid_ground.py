"""Solid ground: where pictures show it, what training asks of alpha there, and how large Gaussians may be."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from block_support import block_stage
from checkerboard import Photographs
from vdgs.cameras import NEAR, Camera
from vdgs.captures.capture import Capture, View
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.frustum import project
from vdgs.model.ground import CELLS, at_size, known_cells, solid_cells
from vdgs.model.render import decode_view, render
from vdgs.model.sizes import REACH, SPAN, SPREAD, largest_log_scales
from vdgs.runs.ground import ground_of
from vdgs.settings.method import AnchorConfig, BlockConfig, GrowthConfig, LossConfig
from vdgs.training import Stage, train
from vdgs.training.background import background_at
from vdgs.training.target import Target

FOCAL, WIDTH, HEIGHT = 100.0, 200, 160


def camera_at(x: float = 0.0, height: float = 20.0, tilt: float = 0.0) -> Camera:
    """Above (x, 0), looking straight down, or by `tilt` radians towards +y."""
    down = np.diag([1.0, -1.0, -1.0])
    turn = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ down
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0.0, height])
    return Camera(pose, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def plain(step: float = 0.4, half: float = 60.0) -> torch.Tensor:
    x, y = torch.meshgrid(torch.arange(-half, half, step), torch.arange(-half, half, step), indexing="ij")
    return torch.stack([x.ravel(), y.ravel(), torch.zeros(x.numel())], dim=1)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), tilt=st.floats(-1.5, 1.5))
def test_points_fall_where_the_camera_says(seed, tilt):
    points, camera = np.random.default_rng(seed).uniform(-30, 30, (200, 3)), camera_at(tilt=tilt)
    seen = project(torch.from_numpy(points), camera)
    assert np.array_equal(seen.inside.numpy(), camera.sees(points))
    pixels, depth = camera.project(points)
    inside = seen.inside.numpy()
    assert np.allclose(np.stack([seen.column, seen.row], axis=1)[inside], pixels[inside])
    assert np.allclose(seen.depth, depth)
    assert np.allclose(seen.distance, np.linalg.norm(points - camera.position, axis=1))
    assert depth[inside].min(initial=1.0) > NEAR


def wall(low: float = 0.0, high: float = 60.0, step: float = 0.4) -> torch.Tensor:
    """A cliff 20 in front of a camera that looks along y from the origin, up to a height."""
    x, z = torch.meshgrid(torch.arange(-60.0, 60.0, step), torch.arange(low, high, step), indexing="ij")
    return torch.stack([x.ravel(), torch.full((x.numel(),), 20.0), z.ravel()], dim=1)


#: Looks along y, at no height: the lower half of its picture lies below the horizon.
LEVEL = camera_at(height=0.0, tilt=math.pi / 2)
UPPER = slice(0, HEIGHT // 2)


def wanted(points: torch.Tensor, camera: Camera) -> np.ndarray:
    return at_size(solid_cells(points, camera), WIDTH, HEIGHT).numpy()


@settings(max_examples=20)
@given(tilt=st.floats(-0.4, 0.4))
def test_below_the_horizon_there_is_no_sky(tilt):
    """Whatever is known of the place: water and woods may hold no sparse points."""
    assert wanted(torch.zeros(0, 3), camera_at(tilt=tilt)).all()


def test_sky_is_left_alone():
    for camera in (camera_at(tilt=1.5), camera_at(tilt=1.3)):
        horizon = camera.project(np.array([[0.0, 1e6, 0.0]]))[0][0, 1]
        cell, limit = WIDTH / CELLS, FOCAL * 2 * math.tan(math.radians(5.0))
        below, above = np.arange(HEIGHT) > horizon + cell + limit, np.arange(HEIGHT) < horizon
        for points in (torch.zeros(0, 3), plain(step=0.1)):
            assert wanted(points, camera)[below].all()
            assert not wanted(points, camera)[above].any()


def test_what_stands_above_the_horizon_is_solid_but_for_its_border():
    top = 6.0
    picture = wanted(wall(high=top), LEVEL)
    edge, cell = HEIGHT / 2 - FOCAL * top / 20.0, WIDTH / CELLS
    assert not picture[: math.floor(edge)].any()
    assert picture[math.ceil(edge + 2 * cell) : HEIGHT // 2 - 1].all()


def test_a_hole_that_known_ground_encloses_is_known_and_one_that_it_does_not_is_none():
    points = wall()
    window = (points[:, [0, 2]] - torch.tensor([0.0, 8.0])).norm(dim=1) > 4
    assert wanted(points[window], LEVEL)[UPPER].all()
    half = wanted(points[points[:, 0] < 0], LEVEL)[UPPER]
    edge = WIDTH / CELLS
    assert half[:, : int(WIDTH / 2 - 2 * edge)].all()
    assert not half[: HEIGHT // 4, WIDTH // 2 :].any()


def test_ground_that_no_camera_sees_is_not_known():
    cameras = [camera_at(x) for x in (-20.0, 0.0, 20.0, 30.0)]
    points = plain(2.0).double().numpy()
    views = tuple(View(f"{i}.png", camera, Path(f"{i}.png"), None, "train") for i, camera in enumerate(cameras))
    frame: Any = None  # asked by nobody
    capture = Capture(Path(), "colmap", "images", views, points, np.zeros(points.shape, np.uint8), frame)
    known = ground_of(capture, AnchorConfig(voxel=2.0)).double().numpy()
    times = sum(camera.sees(known).astype(int) for camera in cameras)
    assert 0 < len(known) < len(points)
    assert times.min() == 1


def test_no_ground_at_all_is_not_known():
    assert not known_cells(torch.zeros(0, 3), camera_at()).any()


# ------------------------------------------------------------------------------------------ the term of the loss


def target(ground: torch.Tensor, mask: torch.Tensor | None = None) -> Target:
    height, width = ground.shape
    return Target(torch.zeros(height, width, 3, dtype=torch.uint8), mask, ground, camera_at())


@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_of_transparency_is_that_of_finite_differences(masked):
    generator = torch.Generator().manual_seed(0)
    alpha = torch.rand(5, 7, generator=generator, dtype=torch.float64)
    mask = (torch.rand(5, 7, generator=generator) > 0.3).to(torch.uint8) if masked else None
    ground = torch.rand(5, 7, generator=generator) > 0.3
    term = target(ground if mask is None else ground & (mask > 0), mask)
    _, gradient = term.transparency(alpha, 0.3)
    for pixel in np.ndindex(5, 7):
        step = torch.zeros_like(alpha)
        step[pixel] = 1e-6
        above, below = (term.transparency(alpha + sign * step, 0.3)[0] for sign in (1, -1))
        assert float(gradient[pixel]) == pytest.approx(float(above - below) / 2e-6, rel=1e-5, abs=1e-12)


def test_opaque_ground_costs_nothing_and_what_is_no_ground_neither():
    ground = torch.zeros(4, 6, dtype=torch.bool)
    ground[:, :3] = True
    opaque, clear = torch.ones(4, 6), torch.ones(4, 6)
    clear[:, 3:] = 0.0
    assert float(target(ground).transparency(opaque, 0.5)[0]) == pytest.approx(0.0, abs=1e-7)
    cost, gradient = target(ground).transparency(clear, 0.5)
    assert float(cost) == pytest.approx(0.0, abs=1e-7)
    assert not gradient[:, 3:].any()
    half = float(target(ground).transparency(torch.zeros(4, 6), 0.5)[0])
    assert half == pytest.approx(0.5 * 0.5, rel=0.05)  # half of the pixels, weight a half


class Grey(Photographs):
    """Of a place that has the colour of the background."""

    def get(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, None]:
        return torch.full_like(super().get(index, downscale)[0], 128), None


def light_through(loss: LossConfig, photographs: Photographs) -> float:
    """The median of 1 - alpha, of a model that was trained before the colour of grey."""
    stage, state = block_stage(BlockConfig())
    config = replace(stage.config, iterations=300, loss=loss, growth=GrowthConfig(levels=0, start=10_000))
    ground, grey = [torch.ones(24, 32, dtype=torch.bool)] * 8, (128 / 255,) * 3
    stage = replace(
        stage, config=config, background=grey, surroundings=None, ground=ground, images=photographs
    )  # fmt: skip
    train(state, stage, stop=lambda: False, after_step=lambda *_: None)
    model = AnchorModel(*state.result(), stage.voxel, grey, {})
    return float((1.0 - render(model, photographs.camera(0)).alpha.clamp(0, 1)).quantile(0.5))


@pytest.mark.parametrize(
    ("means", "photographs"),
    [(LossConfig(), Grey()), (LossConfig(alpha_weight=0.05, background_noise=0.0), Photographs())],
)
def test_ground_becomes_opaque_although_the_background_has_its_colour(means, photographs):
    """Without any means light shines through, with one nearly none does."""
    board = light_through(means, photographs)
    assert board < 0.02
    assert light_through(LossConfig(background_noise=0.0), photographs) > 3 * board


def test_backgrounds_are_of_all_colours_the_same_for_a_seed_and_no_others_without_noise():
    stage, _ = block_stage(BlockConfig())

    def colours(share: float) -> torch.Tensor:
        loss = LossConfig(background_noise=share)
        changed = replace(stage, config=replace(stage.config, loss=loss), background=(0.2, 0.5, 0.8))
        return torch.stack([background_at(changed, iteration) for iteration in range(500)])

    own = torch.tensor([0.2, 0.5, 0.8])
    every = colours(1.0)
    assert torch.equal(every, colours(1.0))
    assert float(every.min()) >= 0
    assert float(every.max()) <= 1
    assert (every.amin(0) < 0.03).all()
    assert (every.amax(0) > 0.97).all()
    torch.testing.assert_close(colours(0.25), own + 0.25 * (every - own))
    assert (colours(0.0) == own).all()


# ------------------------------------------------------------------------------------------------ the law of sizes


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_no_camera_that_holds_a_place_is_veiled_from_there(seed):
    """A Gaussian as large as allowed, drawn at full opacity, spans no more than its share of any picture."""
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.uniform(-15, 15, (300, 3)) * [1, 1, 0.3])
    cameras = [camera_at(x, height, tilt) for x, height, tilt in rng.uniform([-10, 8, -0.5], [10, 30, 0.5], (5, 3))]
    diameter = 2 * REACH * largest_log_scales(points, cameras).exp().numpy()
    held = np.zeros(len(points), bool)
    longest = np.zeros(len(points))
    for camera in cameras:
        inside = camera.sees(points.numpy())
        depth = camera.project(points.numpy())[1]
        longest[inside] = np.maximum(longest, diameter * FOCAL / depth)[inside]
        held |= inside
    assert held.sum() > 10
    assert longest[held].max() <= SPAN * WIDTH * (1 + 1e-6)
    assert longest[held].min() > SPAN * WIDTH * 0.999  # no smaller than it must be


def test_what_no_camera_holds_is_bounded_by_the_nearest_and_nothing_without_cameras():
    beside = torch.tensor([[500.0, 0.0, 20.0]])
    bound = largest_log_scales(beside, [camera_at(), camera_at(100.0)]).exp()
    assert float(bound) == pytest.approx(400.0 * WIDTH / FOCAL * SPAN / (2 * REACH), rel=1e-5)
    assert largest_log_scales(beside, []).tolist() == [math.inf]


def test_an_anchor_in_the_centre_of_a_camera_has_a_size_that_can_be_trained():
    assert largest_log_scales(torch.tensor([[0.0, 0.0, 20.0]]), [camera_at()]).isfinite().all()


def test_training_leaves_no_gaussian_larger_than_its_bound_nor_far_from_its_anchor():
    """Scales begin too large, of Gaussians and of the unit of their offsets; anchors that grow are bounded too."""
    stage, state = block_stage(BlockConfig())
    growth = GrowthConfig(interval=10, statistics_from=0, start=10, until=0.8, threshold=1e-6, gate=0.05)
    config = replace(stage.config, iterations=47, average=0.1, growth=growth)
    cameras = Photographs().cameras
    stage = replace(stage, config=config, largest=lambda places: largest_log_scales(places, cameras) - 3.0)
    state.largest = stage.largest_at(state.anchors.positions)
    state.anchors.log_scales.add_(4.0)
    before = len(state.anchors)
    train(state, stage, stop=lambda: False, after_step=lambda *_: None)
    anchors, decoder = state.result()
    assert len(anchors) != before
    bound = largest_log_scales(anchors.positions, cameras) - 3.0
    for scales, most in ((anchors.log_scales[:, :3], bound + math.log(SPREAD)), (anchors.log_scales[:, 3:], bound)):
        assert (scales <= most[:, None] + 1e-5).all()
        assert (scales > most[:, None] - 0.5).any()
    model = AnchorModel(anchors, decoder, stage.voxel, (0.0, 0.0, 0.0), {})
    for camera in cameras:
        rows, splats = decode_view(model, camera)
        of = rows[splats.source.long() // anchors.offsets.shape[1]]
        largest = (3 * bound[of]).exp()
        assert (splats.volumes <= largest * 1.001).all()


def test_an_unbounded_stage_changes_no_scale():
    stage, state = block_stage(BlockConfig())
    assert isinstance(stage, Stage)
    assert torch.equal(state.largest, torch.full((len(state.anchors),), math.inf))
