"""2DGS: the laws of its terms, and 3DGS without them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from experiments.baselines.gs2d.surface import (
    Gs2dConfig,
    _draw_depths,
    depth_distortion,
    flatten,
    surface_loss,
    with_surface_terms,
)
from experiments.baselines.gs3d.density import DensityConfig
from experiments.baselines.gs3d.model import initialize_gaussians
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dProblem, gs3d_train_step, initial_state, scene_extent
from support.checkerboard import Photographs
from vdgs.geometry.camera import Camera
from vdgs.model.gaussians import Gaussians, project_splats

CONFIG = Gs3dConfig(iterations=30, resolution_schedule=((0, 2),), density=DensityConfig(start=5, interval=10))
CAMERA = Camera(camera_from_world=np.eye(4), fx=20.0, fy=20.0, cx=10.5, cy=10.5, width=21, height=21)


def trained(stage: Gs3dProblem, steps: int) -> Gaussians:
    points = np.concatenate([np.random.default_rng(0).uniform(-4, 4, (100, 2)), np.zeros((100, 1))], axis=1)
    state = initial_state(initialize_gaussians(points, np.full((100, 3), 128, np.uint8), 0.1, 3))
    for _ in range(steps):
        gs3d_train_step(state, stage)
    return state.gaussians


def test_without_its_terms_it_is_3dgs_and_with_them_gaussians_are_flat() -> None:
    plain = Gs3dProblem(CONFIG, Photographs(), 8, scene_extent(Photographs().cameras))
    free = replace(plain, config=Gs2dConfig(**vars(CONFIG), flatness=0, distortion=0, normal=0))
    terms = replace(plain, config=Gs2dConfig(**vars(CONFIG), distortion_start=0, normal_start=0))
    one, same, flat = (trained(stage, 12) for stage in (plain, with_surface_terms(free), with_surface_terms(terms)))
    for name, tensor in one.tensors().items():
        assert torch.equal(tensor, same.tensors()[name])
    assert bool((flat.log_scales[:, 2] <= flat.log_scales[:, :2].amax(1) + np.log(0.01) + 1e-6).all())


def slab(depths: list[float], turn: float = 0.0, opacity: float = 0.6) -> Gaussians:
    """Wide flat Gaussians in front of the camera, turned about y."""
    n = len(depths)
    quaternion = torch.tensor([np.cos(turn / 2), 0.0, np.sin(turn / 2), 0.0], dtype=torch.float32)
    flat = Gaussians(
        means=torch.tensor([[0.0, 0.0, depth] for depth in depths]), log_scales=torch.full((n, 3), 1.5),
        quaternions=quaternion.repeat(n, 1), opacity_logits=torch.full((n,), opacity).logit(),
        sh0=torch.zeros(n, 3), shN=torch.zeros(n, 0, 3),
    )  # fmt: skip
    flatten(flat, 0.01)
    return flat


def test_distortion_is_the_sum_over_pairs() -> None:
    depths = torch.tensor([2.0, 2.5, 4.0])
    gaussians = slab(depths.tolist())
    drawn = _draw_depths(project_splats(gaussians, CAMERA, 0), gaussians.means[:, 2], CAMERA)
    weights, logs = 0.6 * torch.tensor([1.0, 0.4, 0.16]), depths.log()
    pairs = (weights[:, None] * weights * (logs[:, None] - logs).square()).sum()
    assert float(depth_distortion(drawn)[10, 10]) == pytest.approx(float(pairs), rel=2e-3)
    together = slab([2.0, 2.0])
    drawn = _draw_depths(project_splats(together, CAMERA, 0), together.means[:, 2], CAMERA)
    assert float(depth_distortion(drawn).abs().max()) < 1e-6


def test_normals_agree_with_a_wall_and_turn_towards_it() -> None:
    config = Gs2dConfig(iterations=10, distortion=0.0, normal=1.0, normal_start=0.5)
    loss = partial(surface_loss, config, camera=CAMERA)
    straight, turned = slab([3.0], opacity=0.98), slab([3.0], turn=0.4, opacity=0.98)
    assert float(loss(turned, iteration=4)) == 0.0
    assert abs(float(loss(straight, iteration=5))) < 0.01 < float(loss(turned, iteration=5))
    turned.quaternions.requires_grad_()
    loss(turned, iteration=5).backward()
    assert turned.quaternions.grad is not None
    assert float(turned.quaternions.grad[0, 2]) > 0  # a step turns it back
