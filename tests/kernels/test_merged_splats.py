"""Splats of Gaussians that stand for others: the twin against many members, the native kernel against the twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.decode_scenes import CAMERAS
from support.gaussians import random_gaussians
from support.instruction_sets import every_instruction_set, on_threads, using
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.constants import ALPHA_MIN, DILATION_PX2
from vdgs.kernels.cpu.merged_splats import merged_splats as native
from vdgs.kernels.kernel_types import SPLAT_TENSORS, MergedGaussians
from vdgs.kernels.torch_ref.merged_splats import merged_splats as twin
from vdgs.kernels.torch_ref.merged_splats import shown_members

CAMERA = Camera(camera_from_world=np.eye(4), fx=300.0, fy=300.0, cx=200.0, cy=150.0, width=400, height=300)
#: The logarithm of the least weight that is drawn 30 units before that camera.
LEAST = float(np.log(ALPHA_MIN * DILATION_PX2 * 30.0**2 / CAMERA.fx**2))


def merged(n: int, degree: int, camera: Camera, seed: int = 0) -> MergedGaussians:
    """Of all sizes about the least that the camera draws, in half precision but for the means."""
    some, g = random_gaussians(n, degree, seed), torch.Generator().manual_seed(seed)
    depths = camera.project(some.means.numpy())[1] if camera.model == "pinhole" else np.ones(n)
    least = ALPHA_MIN * DILATION_PX2 / (camera.fx * camera.fy) * np.clip(np.abs(depths), 0.1, None) ** 2
    std = 4 * torch.rand(n, generator=g) ** 3
    factors = (1.5 * torch.rand(n, generator=g)).clamp(max=1)
    factors[32:64] = 0
    of_members = MergedGaussians(
        some.means, some.log_scales - 2, some.quaternions, some.opacity_logits, some.sh0, some.shN,
        covers=1 + 20 * torch.rand(n, generator=g) ** 4,
        log_weight_mean=torch.from_numpy(np.log(least)).float() + 3 * torch.randn(n, generator=g), log_weight_std=std,
        sh0_log_weight_cov=std[:, None] * torch.randn(n, 3, generator=g) * 0.2, opacity_factors=factors,
    )  # fmt: skip
    return of_members._replace(**{name: t.half() for name, t in of_members._asdict().items() if name != "means"})


@every_instruction_set
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("n", "degree"), [(0, 1), (1, 0), (17, 2), (5000, 1), (3000, 3)])
def test_the_native_kernel_draws_what_the_twin_does(n: int, degree: int, camera: Camera, instructions: str) -> None:
    gaussians = merged(n, degree, camera)
    wanted = twin([gaussians._replace(means=gaussians.means.double())], camera)
    with using(instructions):
        found = native([gaussians], camera)
        as_floats = native([MergedGaussians(*(tensor.float() for tensor in gaussians))], camera)
        with on_threads(1):
            parts = zip(*(tensor.split([n // 3, n // 5, n - n // 3 - n // 5]) for tensor in gaussians), strict=True)
            first, *others = (MergedGaussians(*part) for part in parts)
            alone = native(others, camera, native([first], camera))
    for name in SPLAT_TENSORS:
        assert torch.equal(getattr(found, name), getattr(as_floats, name))
        assert torch.equal(getattr(found, name), getattr(alone, name))
    drawn = wanted.opacities > ALPHA_MIN * 1.01
    assert ((found.opacities > 0) | ~drawn).all()
    assert (found.opacities[~drawn] < ALPHA_MIN * 1.02).all()
    assert n < 3000 or 0.2 < drawn.float().mean() < 0.9
    for name, tolerance in (("means_px", 1e-3), ("depths", 1e-5), ("colors", 2e-4), ("opacities", 2e-4)):
        torch.testing.assert_close(
            getattr(found, name)[drawn].double(), getattr(wanted, name)[drawn], atol=tolerance, rtol=tolerance
        )
    torch.testing.assert_close(found.conics[drawn].double(), wanted.conics[drawn], atol=1e-5, rtol=2e-3)


@pytest.mark.parametrize("camera", CAMERAS)
def test_parts_of_a_view_show_what_all_of_it_shows(camera: Camera) -> None:
    """Although each part leaves out what lies beside it."""
    every = merged(4000, 1, camera)
    sorted_rows = torch.from_numpy(camera.project(every.means.numpy())[0][:, 0].argsort())
    gaussians = MergedGaussians(*(tensor[sorted_rows] for tensor in every))
    kernels, left, black = get_backend(torch.device("cpu")), camera.width // 3, torch.zeros(3)
    whole = kernels.rasterize(native([gaussians], camera), black, camera.width, camera.height).image
    assert (whole > 0.1).float().mean() > 0.05
    for first, last in ((0, left), (left, camera.width)):
        part = camera.cropped(first, 0, last, camera.height)
        splats = native([gaussians], part)
        assert (splats.opacities == 0).sum() > (native([gaussians], camera).opacities == 0).sum()
        image = kernels.rasterize(splats, black, part.width, part.height).image
        torch.testing.assert_close(image, whole[:, first:last], atol=2e-5, rtol=0)


def test_halves_are_read_as_floats():
    """Also those below the least normal one, infinity and NaN."""
    every = torch.arange(1 << 16, dtype=torch.int32).to(torch.uint16).view(torch.float16)
    ones, zeros = torch.ones(len(every)).half(), torch.zeros(len(every)).half()
    one = merged(len(every), 0, CAMERA)._replace(opacity_logits=every, log_weight_mean=zeros, opacity_factors=ones)
    one = one._replace(means=torch.tensor([0.0, 0.0, 9.0]).expand(len(every), 3))
    as_floats = native([MergedGaussians(*(tensor.float() for tensor in one))], CAMERA)
    found = native([one], CAMERA)
    assert torch.equal(found.opacities.view(torch.int32), as_floats.opacities.view(torch.int32))
    # A color is its own coefficient, where nothing else is.
    plain = one._replace(sh0=every[:, None].expand(-1, 3), sh0_log_weight_cov=torch.zeros(len(every), 3).half())
    shown = native([plain], CAMERA).colors[:, 0]
    wanted = torch.addcmul(torch.tensor(0.5), torch.tensor(0.28209479177387814), every.float()).clamp_min(0)
    finite = every.isfinite()
    torch.testing.assert_close(shown[finite], wanted[finite], rtol=1e-6, atol=1e-6)


def test_what_fades_nowhere_is_drawn_as_with_factors_of_one():
    gaussians = merged(200, 1, CAMERA)
    ones = gaussians._replace(opacity_factors=torch.ones(200).half())
    none = ones._replace(opacity_factors=None)
    for draw in (native, twin):
        for name in SPLAT_TENSORS:
            assert torch.equal(*(getattr(draw([each], CAMERA), name) for each in (none, ones)))


@pytest.mark.parametrize(
    "wrong", [{"opacity_factors": torch.ones(3)}, {"covers": torch.ones(5)}, {"shN": torch.zeros(4, 4, 3)}]
)
def test_rows_that_do_not_match_are_refused(wrong):
    with pytest.raises(ValueError, match="merged Gaussians must be"):
        native([merged(4, 1, CAMERA)._replace(**wrong)], CAMERA)


def test_members_too_small_to_be_drawn_show_nothing_in_the_gaussian_that_stands_for_them():
    """What is left of members of many sizes below `ALPHA_MIN`, by the mean of their drawn shares."""
    alone = np.array([0.3, 0.99, 1.5, 4.0, 1e4])
    weights, depth = np.exp(LEAST + np.random.default_rng(3).normal(0.4, 1.2, 400_000)), torch.tensor([30.0])
    for std, mean, wanted in (
        (np.zeros(5), LEAST + np.log(alone), np.maximum(0, 1 - 1 / alone)),
        # Weighted by themselves, logarithms that are normally distributed are so with the same deviation.
        (np.array([1.2]), np.array([LEAST + 0.4 + 1.2**2]),
         [np.average(np.maximum(0, 1 - np.exp(LEAST) / weights), weights=weights)]),
        (np.array([7.0, 0.0]), LEAST + np.array([-300.0, 300.0]), [0.0, 1.0]),
    ):  # fmt: skip
        shown, _ = shown_members(torch.tensor(mean).float(), torch.tensor(std).float(), depth.expand(len(mean)), CAMERA)
        np.testing.assert_allclose(shown.numpy(), wanted, atol=5e-3)
    ortho = replace(CAMERA, model="orthographic", fx=CAMERA.fx / 30, fy=CAMERA.fy / 30)
    few = LEAST + torch.tensor([1.0, -1.0, -3.0]), torch.ones(3)
    torch.testing.assert_close(
        shown_members(*few, torch.tensor([1.0, 2.0, 3.0]), ortho), shown_members(*few, depth.expand(3), CAMERA)
    )


@pytest.mark.parametrize(("above", "std"), [(2.0, 1.0), (0.0, 0.5), (-1.5, 1.5)])
def test_a_gaussian_has_the_color_of_those_of_its_members_that_are_drawn(above: float, std: float) -> None:
    """The larger ones are brighter here; weighted by what is drawn of each."""
    logs = LEAST + above + std * np.random.default_rng(1).normal(size=1_000_000)  # as they count by their weights
    brightness = 0.1 * (logs - LEAST)
    drawn = np.maximum(0, 1 - np.exp(LEAST - logs))
    cov = np.cov(brightness, logs)[0, 1]
    one = MergedGaussians(
        means=torch.tensor([[0.0, 0.0, 30.0]]), log_scales=torch.full((1, 3), -4.0),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]), opacity_logits=torch.zeros(1),
        sh0=torch.full((1, 3), brightness.mean()), shN=torch.zeros(1, 0, 3), covers=torch.ones(1),
        log_weight_mean=torch.tensor([logs.mean()]), log_weight_std=torch.tensor([std]),
        sh0_log_weight_cov=torch.full((1, 3), cov),
    )  # fmt: skip
    shown = twin([MergedGaussians(*(tensor if tensor is None else tensor.float() for tensor in one))], CAMERA)
    wanted = 0.5 + 0.28209479 * np.average(brightness, weights=drawn)
    np.testing.assert_allclose(shown.colors.numpy(), wanted, atol=1e-3)
