"""Laws of the projection of Gaussians: the twin against calculus, the native kernel against the twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.decode_scenes import CAMERAS, looking_down
from support.instruction_sets import using
from vdgs.geometry.camera import Camera
from vdgs.kernels import constants
from vdgs.kernels.constants import DILATION_PX2
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.project import project as native_project
from vdgs.kernels.gaussian_projection import GaussianShapes, area_shares, dilations_px2, project_gaussians
from vdgs.kernels.rotations import rotation_matrices
from vdgs.kernels.torch_ref.project import project as twin_project


def gaussians(m: int, seed: int = 0, log_sigma: float = -2.0) -> tuple[torch.Tensor, ...]:
    """Random Gaussians under the cameras above, some of them out of the picture, float64."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(m, 3, generator=g, dtype=torch.float64) * torch.tensor([3.0, 3.0, 1.0])
    scales = torch.exp(torch.randn(m, 3, generator=g, dtype=torch.float64) + log_sigma)
    return means, scales, torch.randn(m, 4, generator=g, dtype=torch.float64)


def monte_carlo_covariance(mean: np.ndarray, scales, quaternion, camera: Camera) -> np.ndarray:
    rotation = rotation_matrices(quaternion[None])[0].numpy()
    samples = np.random.default_rng(0).normal(size=(200_000, 3)) * scales.numpy() @ rotation.T + mean
    depth = float(camera.project(mean[None])[1][0]) if camera.model == "pinhole" else 1.0
    magnified = max(1.0, camera.photograph_pixel * np.sqrt(camera.fx * camera.fy) / depth)
    return np.cov(camera.project(samples)[0].T) + DILATION_PX2 * magnified**2 * np.eye(2)


@pytest.mark.parametrize("camera", CAMERAS)
def test_small_gaussians_have_the_covariance_of_their_projected_samples(camera):
    means, scales, quaternions = gaussians(4, log_sigma=-3.0)
    means = means * 0.3  # near the axis, where nothing is clamped
    projected = twin_project(means, scales, quaternions, camera)
    pixels, depths = camera.project(means.numpy())
    np.testing.assert_allclose(projected.means_px.numpy(), pixels, rtol=1e-12)
    np.testing.assert_allclose(projected.depths.numpy(), depths, rtol=1e-12)
    for i in range(4):
        xx, xy, yy = projected.conics[i].tolist()
        covariance = np.linalg.inv([[xx, xy], [xy, yy]])
        sampled = monte_carlo_covariance(means[i].numpy(), scales[i], quaternions[i], camera)
        assert np.abs(covariance - sampled).max() < 0.02 * np.abs(sampled).max()


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_conic_alone_says_which_share_of_its_area_a_gaussian_had_before_the_blur(camera):
    means, scales, quaternions = gaussians(300, log_sigma=-3.0)
    exact = project_gaussians(means, GaussianShapes(scales, quaternions), camera)
    shown = exact.projected.valid
    conics = native_project(means.float(), scales.float(), quaternions.float(), camera).conics[shown]
    blur = torch.zeros(len(conics)) + dilations_px2(exact.projected.depths[shown].float(), camera)
    shares = area_shares(conics, blur)
    torch.testing.assert_close(shares.double(), exact.compensation[shown], atol=4e-4, rtol=0)
    assert shares.min() < 0.1
    assert shares.max() > 0.5
    assert (area_shares(conics, torch.zeros(len(conics))) == 1).all()


@pytest.mark.parametrize("camera", CAMERAS)
def test_gradients_of_the_twin_are_those_of_finite_differences(camera):
    means, scales, quaternions = gaussians(2, seed=1)
    means = torch.cat([means, means * torch.tensor([20.0, 20.0, 1.0])])  # beyond the clamp
    scales, quaternions = torch.cat([scales, scales]), torch.cat([quaternions, quaternions])
    arguments = [t.requires_grad_() for t in (means, scales, quaternions)]

    def f(*gaussian):
        projected = twin_project(*gaussian, camera)
        return projected.means_px, projected.conics, projected.depths

    assert torch.autograd.gradcheck(f, arguments, eps=1e-6, atol=1e-6, rtol=1e-5)


def awkward() -> tuple[torch.Tensor, ...]:
    """Behind the camera, on its plane, nearly edge-on, huge, tiny, no rotation, not a number."""
    means, scales, quaternions = gaussians(40, seed=2)
    means[0, 2], means[1, 2] = 50.0, 10.0
    means[2] = torch.tensor([40.0, 0.0, 9.9])
    scales[3], scales[4], scales[5] = 1e3, 1e-6, 1e39
    scales[6] = torch.tensor([10.0, 1e-7, 1e-7])
    quaternions[7] = 0.0
    means[8, 0] = scales[9, 1] = quaternions[10, 2] = float("nan")
    means[11, 1] = scales[12, 0] = float("inf")
    return means, scales, quaternions


@pytest.mark.parametrize("camera", CAMERAS)
def test_what_is_not_valid_is_zero_and_has_no_gradient(camera):
    arguments = [t.float().requires_grad_() for t in awkward()]
    for project in (twin_project, native_project):
        projected = project(*arguments, camera)
        bad = ~projected.valid
        assert set(range(7, 13)) | {5} <= set(bad.nonzero()[:, 0].tolist())
        numbers = torch.cat([projected.means_px, projected.conics, projected.depths[:, None]], 1)
        assert torch.isfinite(numbers).all()
        assert (numbers[bad] == 0).all()
        for gradient in torch.autograd.grad((numbers * torch.randn_like(numbers)).sum(), arguments):
            assert torch.isfinite(gradient).all()
            assert (gradient[bad] == 0).all()


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("make", [awkward, lambda: gaussians(333, seed=3), lambda: gaussians(0)])
def test_every_instruction_set_equals_the_twin(camera, make):
    generator = torch.Generator().manual_seed(0)
    exact = [t.float().double().requires_grad_() for t in make()]
    twin = twin_project(*exact, camera)
    parts = [(name, getattr(twin, name)) for name in ("means_px", "conics", "depths")]
    weights = [torch.randn(part.shape, generator=generator, dtype=torch.float64) for _, part in parts]
    weighted = sum((part * weight).sum() for (_, part), weight in zip(parts, weights, strict=True))
    expected = torch.autograd.grad(weighted, exact)
    for instructions in extension.supported_isas():
        single, loss = [t.detach().float().requires_grad_() for t in exact], torch.zeros(())
        with using(instructions):
            ours = native_project(*single, camera)
            assert torch.equal(ours.valid, twin.valid)
            for (name, part), weight in zip(parts, weights, strict=True):
                torch.testing.assert_close(getattr(ours, name).double(), part, rtol=2e-5, atol=1e-4)
                loss = loss + (getattr(ours, name) * weight.float()).sum()
            gradients = torch.autograd.grad(loss, single)
        for ours_g, twin_g in zip(gradients, expected, strict=True):
            # Relative to each Gaussian's largest component: they span many magnitudes.
            size = twin_g.abs().amax(-1, keepdim=True).clamp(min=1e-3)
            torch.testing.assert_close(ours_g.double() / size, twin_g / size, rtol=1e-3, atol=2e-3)


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), angle=st.floats(-3, 3))
def test_moving_the_world_and_the_camera_together_changes_nothing(seed, angle):
    means, scales, quaternions = gaussians(5, seed=seed)
    camera = looking_down()
    turn = torch.tensor([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
    rotation = rotation_matrices(turn[None])[0]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation.numpy(), [1.0, -2.0, 3.0]
    moved = Camera(
        camera_from_world=camera.camera_from_world @ np.linalg.inv(motion), fx=camera.fx, fy=camera.fy, cx=camera.cx,
        cy=camera.cy, width=64, height=48,
    )  # fmt: skip
    w, x, y, z = quaternions.unbind(-1)
    c, s = turn[0], turn[3]
    turned_quaternions = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
    a = twin_project(means, scales, quaternions, camera)
    b = twin_project(means @ rotation.T + torch.from_numpy(motion[:3, 3]), scales, turned_quaternions, moved)
    torch.testing.assert_close(a.means_px, b.means_px)
    torch.testing.assert_close(a.conics, b.conics)


@pytest.mark.parametrize("isa", extension.supported_isas())
def test_the_constants_of_the_kernels_are_those_of_the_twins(isa):
    for name, value in extension.load_extension(isa).constants.items():
        assert value == pytest.approx(getattr(constants, name), rel=1e-6), name


def test_second_derivatives_are_refused_where_there_are_none():
    """Rather than taken for zero, as by a penalty on gradients; also of a loss whose gradient is a number."""
    arguments = [t.float().requires_grad_() for t in gaussians(6)]
    means_px = native_project(*arguments, looking_down()).means_px
    for loss in (means_px.square().sum(), means_px.sum()):
        with pytest.raises(RuntimeError, match="differentiate twice"):
            torch.autograd.grad(loss, arguments[0], create_graph=True)


def test_shapes_that_do_not_belong_together_are_refused():
    means, scales, quaternions = gaussians(3)
    with pytest.raises((ValueError, TypeError)):
        native_project(means, scales, quaternions[:, :3], CAMERAS[0])
