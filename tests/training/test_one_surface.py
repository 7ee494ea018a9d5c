"""What keeps splats on one surface: the loss of depths, and noise of opacities."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from support.block_training import block_stage
from support.checkerboard import Photographs
from vdgs.config.method import BlockConfig, DensifyConfig, LossConfig
from vdgs.kernels.kernel_types import Raster, TrainingSplats
from vdgs.model.renderer import render
from vdgs.training import train, training_loop
from vdgs.training.depth_agreement import MIN_ALPHA, SMOOTH_BELOW, DepthAgreement, depth_agreement
from vdgs.training.gradient_roi import crop_to_gradient_support
from vdgs.training.target import background_at, opacity_factors_at
from vdgs.training.training_step import render_for_training

HEIGHT = 8.0


def test_gradients_are_those_of_the_loss() -> None:
    generator = torch.Generator().manual_seed(1)
    alpha, depth, median = (torch.rand(12, 9, generator=generator, dtype=torch.float64) for _ in range(3))
    depth, median = (alpha * (5 + 0.05 * depth)).requires_grad_(), 5 + 0.05 * median
    alpha = alpha.requires_grad_()
    shown = (alpha > MIN_ALPHA).detach()
    apart = ((depth - alpha * median) / HEIGHT)[shown].abs()
    loss = torch.where(apart > SMOOTH_BELOW, apart - SMOOTH_BELOW / 2, apart**2 / (2 * SMOOTH_BELOW)).sum() / 108
    loss.backward()
    found = depth_agreement(Raster(torch.zeros(12, 9, 3), alpha.detach(), depth.detach(), median), HEIGHT)
    torch.testing.assert_close(found.loss, loss.detach())
    torch.testing.assert_close(found.alpha, alpha.grad)
    torch.testing.assert_close(found.depth, depth.grad)
    assert 0 < shown.double().mean() < 1


def test_what_a_mask_leaves_out_takes_no_part() -> None:
    """Whatever is drawn there; parts of a picture add up to the whole, by what each keeps of it."""
    generator = torch.Generator().manual_seed(2)
    alpha, depth, median = (0.5 + torch.rand(12, 9, generator=generator) / 2 for _ in range(3))
    raster = Raster(torch.zeros(12, 9, 3), alpha, depth * 5, median * 5)
    mask = (torch.rand(12, 9, generator=generator) < 0.4).byte()
    found, plain = depth_agreement(raster, HEIGHT, mask), depth_agreement(raster, HEIGHT)
    kept = mask.double().mean()
    for name in ("alpha", "depth"):
        ours, theirs = getattr(found, name), getattr(plain, name)
        assert not ours[mask == 0].any()
        torch.testing.assert_close(ours, (theirs * mask / kept).float())
    total = torch.zeros(())
    for rows in (slice(0, 5), slice(5, 12)):
        part = depth_agreement(Raster(*(each[rows] for each in raster)), HEIGHT, mask[rows])  # type: ignore[arg-type]
        total += part.loss * mask[rows].sum() / mask.sum()
    torch.testing.assert_close(total, found.loss)
    nothing = depth_agreement(raster, HEIGHT, torch.zeros_like(mask))
    assert not any(each.any() for each in nothing)


def test_training_with_it_draws_splats_to_one_depth() -> None:
    def spread(weight: float) -> float:
        stage, state = block_stage(BlockConfig())
        still = DensifyConfig(num_levels=0, start=10_000)
        config = replace(stage.config, iterations=150, loss=LossConfig(depth_agreement=weight), densify=still)
        stage = replace(stage, config=config, frozen_anchors=None)
        train(state, stage, stop=lambda: False, after_step=lambda *_: None)
        model = state.model(stage)
        return float(depth_agreement(render(model, Photographs().camera(0), depth=True), stage.camera_height).loss)

    assert spread(1.0) < 0.7 * spread(0.0)


@pytest.mark.parametrize(("weight", "part"), [(1.0, 1.0), (3.0, 0.5)])
def test_every_second_step_counts_it_twice_and_the_others_do_not(
    monkeypatch: pytest.MonkeyPatch, weight: float, part: float
) -> None:
    """In the unit of the rest of the loss: as it is, however much the step weighs and whatever part of a photograph it
    draws."""
    stepped, whole = MagicMock(), training_loop.make_target
    stepped.weight.return_value, stepped.decoder_gradients.return_value = weight, {}
    monkeypatch.setattr(training_loop, "make_target", lambda *of: replace(whole(*of), valid_fraction=part))

    def one(raster: Raster, *_: object) -> DepthAgreement:
        return DepthAgreement(torch.tensor(1.0), torch.zeros_like(raster.alpha), torch.zeros_like(raster.alpha))

    def losses(agreement: float) -> list[float]:
        (stage, state), found = block_stage(BlockConfig()), list[float]()
        config = replace(stage.config, loss=LossConfig(depth_agreement=agreement))
        stage = replace(stage, config=config, guidance=stepped)
        train(state, stage, stop=lambda: len(found) == 4, after_step=lambda _, step: found.append(step.loss))
        return found

    monkeypatch.setattr(training_loop, "depth_agreement", one)
    more = np.subtract(losses(0.25), losses(0.0))
    assert more == pytest.approx([0.5, 0.0, 0.5, 0.0], abs=1e-6)


def test_opacities_vary_from_step_to_step_alike_for_a_seed() -> None:
    stage, _ = block_stage(BlockConfig())
    splats = one_splat(0.3, times=10_000)
    assert opacity_factors_at(stage, 3, splats) is None
    noisy = replace(stage, config=replace(stage.config, loss=LossConfig(opacity_noise=0.2)))
    one, again, other = (opacity_factors_at(noisy, iteration, splats) for iteration in (3, 3, 4))
    assert one is not None
    assert other is not None
    assert again is not None
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert abs(float(one.mean()) - 1) < 0.01
    assert abs(float(one.std()) - 0.2) < 0.01


def test_what_is_behind_a_step_says_nothing_of_its_opacities() -> None:
    """Both are drawn anew in each step, neither from the numbers of the other."""
    stage, _ = block_stage(BlockConfig())
    loss = LossConfig(opacity_noise=0.2, random_background=1.0)
    noisy, splats = replace(stage, config=replace(stage.config, loss=loss)), one_splat(0.3, times=16)

    def drawn(step: int) -> list[float]:
        factors = opacity_factors_at(noisy, step, splats)
        assert factors is not None
        return [float(background_at(noisy, step)[0]), abs(float(factors[0]) - 1)]

    together = torch.tensor([drawn(step) for step in range(1000)]).T.corrcoef()
    assert abs(float(together[0, 1])) < 0.1


def one_splat(opacity: float, times: int = 1) -> TrainingSplats:
    return TrainingSplats(
        means_px=torch.full((times, 2), 9.0), conics=torch.tensor([[0.1, 0.0, 0.1]]).repeat(times, 1),
        depths=torch.ones(times), colors=torch.ones(times, 3), opacities=torch.full((times,), opacity), segments=None,
        source=torch.arange(times, dtype=torch.int32), volume=torch.tensor(1.0),
    )  # fmt: skip


def test_the_gradient_of_an_opacity_is_that_of_its_noisy_self() -> None:
    """A factor of 2 of all opacities is a model that is twice as opaque, and moves twice as fast."""
    camera, background, splats = Photographs().camera(0), torch.zeros(3), one_splat(0.3)
    double = replace(splats, opacities=2 * splats.opacities)
    plain = render_for_training(double, camera, background)
    noisy = render_for_training(splats, camera, background, opacity_factors=torch.tensor([2.0]))
    assert torch.equal(plain.image, noisy.image)
    slope = torch.ones_like(plain.image)
    expected = 2 * plain.backward(slope, 0.0).opacities
    torch.testing.assert_close(noisy.backward(slope, 0.0).opacities, expected)


def test_an_opacity_whose_noisy_self_is_limited_has_no_gradient() -> None:
    """As autograd has it: what is drawn follows it no more."""
    camera, background = Photographs().camera(0), torch.zeros(3)
    drawn = render_for_training(one_splat(0.8), camera, background, opacity_factors=torch.tensor([2.0]))
    gradients = drawn.backward(torch.ones_like(drawn.image), 0.0)
    assert float(gradients.opacities) == 0.0
    assert float(gradients.colors.abs().max()) > 0


def test_a_step_draws_as_far_as_splats_reach_with_their_noise() -> None:
    stage, _ = block_stage(BlockConfig())
    camera, factors = Photographs().camera(0), torch.tensor([2.0])
    areas = []
    for opacity, given in ((0.2, None), (0.2, factors), (0.4, None)):
        left, top, right, bottom = crop_to_gradient_support(
            stage, one_splat(opacity), camera, (0, 0, camera.width, camera.height), given
        )
        areas.append((right - left) * (bottom - top))
    assert areas[0] < areas[1] == areas[2]
