"""The Gaussians of 3DGS: where they start, what a view shows of them, where they are added and removed."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.baselines.gs3d.density import (
    DensityConfig,
    adaptive_density_control,
    cap_opacity_logits,
    split_gaussians,
)
from experiments.baselines.gs3d.model import GaussianModel, initialize_gaussians
from support.checkerboard import Photographs
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels.spherical_harmonics import eval_sh_colors
from vdgs.model.gaussians import Gaussians, render_gaussians, visible_gaussian_rows

# What a view shows


def some_gaussians(count: int = 40, seed: int = 0, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-4, 4, (count, 2)), rng.uniform(-0.2, 0.2, (count, 1))], axis=1)
    start = initialize_gaussians(points, rng.integers(0, 255, (count, 3), dtype=np.uint8), 0.3, degree)
    noise = torch.from_numpy(rng.normal(0, 0.3, start.shN.shape).astype(np.float32))
    return replace(start, shN=noise, quaternions=torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32)))


@given(seed=st.integers(0, 10_000), size=st.floats(-3, 1.5))
@settings(max_examples=25)
def test_what_is_left_out_of_a_view_would_not_change_it(seed, size):
    everything = some_gaussians(seed=seed)
    everything = replace(
        everything,
        log_scales=everything.log_scales + size,
        opacity_logits=torch.full_like(everything.opacity_logits, 6.0),
    )
    camera = Photographs().camera(seed % 8)
    rows = visible_gaussian_rows(everything, camera)
    whole, _ = render_gaussians(everything, camera, torch.zeros(3), 1)
    part, _ = render_gaussians(everything.select(rows), camera, torch.zeros(3), 1)
    torch.testing.assert_close(part.image, whole.image, rtol=0, atol=0)


def test_what_lies_behind_or_beside_the_camera_is_not_visible():
    camera = Photographs().camera(0)
    x, y, _ = camera.position
    points = np.array([[x, y, 0.0], [x, y, 9.0], [x + 50, y, 0.0]])
    placed = initialize_gaussians(points, np.zeros((3, 3), np.uint8), 0.1, 0)
    placed = replace(placed, log_scales=torch.full((3, 3), -3.0))
    assert visible_gaussian_rows(placed, camera).tolist() == [0]


def test_a_gaussian_shows_another_color_from_another_side():
    rest = torch.zeros(1, 3, 3)
    rest[0, 2, 0] = -0.6
    shown = Gaussians(
        means=torch.zeros(1, 3), log_scales=torch.zeros(1, 3), quaternions=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.full((1,), 5.0), sh0=torch.zeros(1, 3), shN=rest,
    )  # fmt: skip
    reds = []
    for x in (-3.0, 3.0):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0, 5.0])
        camera = Camera(camera_from_world=pose, fx=20.0, fy=20.0, cx=16.0, cy=16.0, width=32, height=32)
        reds.append(float(GaussianModel(shown, (0.0, 0.0, 0.0), {}).render(camera).image[..., 0].max()))
    assert reds[0] > reds[1] + 0.1  # seen from -x the viewing direction has a positive x


def test_gaussians_start_as_the_sparse_points_say():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    colors = np.array([[255, 0, 51]] * 4, np.uint8)
    start = initialize_gaussians(points, colors, 0.1, 3)
    assert float(start.log_scales[0].exp().mean()) == pytest.approx((1 + 2 + 3) / 3)
    torch.testing.assert_close(start.opacity_logits.sigmoid(), torch.full((4,), 0.1))
    towards = torch.tensor([[0.0, 0, 1]]).expand(4, 3)
    shown = eval_sh_colors(start.sh0, start.shN, towards, start.sh_degree)
    torch.testing.assert_close(shown[0], torch.tensor([1.0, 0, 0.2]), atol=1e-6, rtol=0)
    twice = initialize_gaussians(np.zeros((5, 3)), np.zeros((5, 3), np.uint8), 0.1, 0)
    assert torch.isfinite(twice.log_scales).all()
    with pytest.raises(VdgsError, match="at least 2"):
        initialize_gaussians(points[:1], colors[:1], 0.1, 0)


# Control of density


def four(logits: float = 2.0) -> Gaussians:
    """Two small and two large Gaussians; the extent of their scene is 10, so 0.1 divides small from large."""
    start = some_gaussians(4)
    sizes = torch.tensor([0.02, 0.05, 0.5, 0.8]).log()
    return replace(start, log_scales=sizes[:, None].repeat(1, 3), opacity_logits=torch.full((4,), logits))


def decide(gaussians: Gaussians, gradient: list[float], *, prune_large: bool = False, **changes):
    generator = torch.Generator().manual_seed(0)
    config = DensityConfig(**changes)
    return adaptive_density_control(gaussians, torch.tensor(gradient), 10.0, config, generator, prune_large=prune_large)


def test_small_gaussians_are_cloned_and_large_ones_split():
    before = four()
    change = decide(before, [1e-3, 0.0, 2e-4, 1e-4])
    assert (change.cloned, change.split, change.pruned) == (1, 1, 0)
    assert change.kept.tolist() == [True, True, False, True, True, True, True]
    after = before.concat(change.added).select(change.kept)
    assert len(after) == 4 + 1 + 1
    for name, tensor in change.added.tensors().items():
        assert torch.equal(tensor[0], before.tensors()[name][0])  # the clone
    torch.testing.assert_close(change.added.log_scales[1:].exp(), torch.full((2, 3), 0.5 / 1.6))
    assert torch.equal(change.added.shN[1], before.shN[2])


def test_where_nothing_asks_nothing_changes():
    change = decide(four(), [1e-4] * 4)
    assert len(change.added) == 0
    assert bool(change.kept.all())


def test_faint_and_oversized_gaussians_go():
    faint = four()
    faint.opacity_logits[1] = math.log(0.004 / 0.996)
    change = decide(faint, [0.0] * 4)
    assert change.kept.tolist() == [True, False, True, True]
    assert change.pruned == 1
    huge = four()
    huge.log_scales[3, 1] = math.log(1.5)
    assert bool(decide(huge, [0.0] * 4).kept.all())
    assert decide(huge, [0.0] * 4, prune_large=True).kept.tolist() == [True, True, True, False]


def test_the_limit_serves_the_largest_gradients_first():
    change = decide(four(), [3e-4, 5e-4, 4e-4, 2e-4], max_gaussians=6)
    assert (change.cloned, change.split) == (1, 1)
    assert torch.equal(change.added.means[0], four().means[1])
    assert len(change.kept) == 7
    assert len(decide(four(), [1.0] * 4, max_gaussians=3).added) == 0


def test_the_parts_of_a_split_gaussian_are_spread_as_it_is():
    parent = replace(some_gaussians(1 + 1).select(torch.tensor([0])), log_scales=torch.tensor([[2.0, 0.5, 0.1]]).log())
    many = parent.select(torch.zeros(20_000, dtype=torch.int64))
    parts = split_gaussians(many, 1.6, torch.Generator().manual_seed(3))
    first, second = (parts.means - parent.means).double().chunk(2)
    for offsets in (first, second):
        spread = torch.linalg.eigvalsh(offsets.T @ offsets / len(offsets))
        torch.testing.assert_close(spread.sqrt(), torch.tensor([0.1, 0.5, 2.0]).double(), rtol=0.03, atol=0)
        assert float(offsets.mean(0).norm()) < 0.05
    # A pair straddles its parent: drawn independently of each other, on average halfway between the two.
    assert abs(float((first * second).sum(1).mean())) < 0.1
    beyond = ((first * second).sum(1) < 0).double().mean()
    assert 0.45 < float(beyond) < 0.55


def test_a_reset_lowers_opacities_and_raises_none():
    logits = torch.tensor([5.0, 0.0, -4.0, -8.0])
    after = cap_opacity_logits(logits, 0.01).sigmoid()
    torch.testing.assert_close(after[:2], torch.full((2,), 0.01))
    torch.testing.assert_close(after[3], logits[3].sigmoid())
    assert bool((after <= 0.01 + 1e-6).all())
    assert bool((after <= logits.sigmoid() + 1e-6).all())
