"""The exposure of photographs: neutral on average, fitted in training, left out of what is drawn and measured."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from checkerboard import Photographs
from test_training import CONFIG, bits, run, stage, start
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.exposure import exposed, exposure_of, neutral_exposures
from vdgs.model.render import render
from vdgs.training import Stage, from_saved, start_state, to_saved, train_step

pytestmark = pytest.mark.xdist_group("training")

GAINS = torch.tensor([0.7, 1.3, 0.8, 1.2, 0.9, 1.1, 0.75, 1.25])


class Unequal(Photographs):
    """The checkerboard, photographed darker and brighter."""

    def get(self, index: int, downscale: int = 1):
        picture, mask = super().get(index, downscale)
        return (picture.float() * 0.7 * GAINS[index]).clamp(0, 255).to(torch.uint8), mask


@given(seed=st.integers(0, 1000), images=st.integers(1, 12))
def test_over_all_photographs_the_mean_is_neutral(seed, images):
    departures = torch.randn(images, 3, 4, generator=torch.Generator().manual_seed(seed)).double()
    mean = torch.stack([exposure_of(departures, image) for image in range(images)]).mean(0)
    assert torch.allclose(mean, torch.eye(3, 4).double(), atol=1e-12)


def test_neutral_exposures_change_no_colour():
    picture = torch.rand(5, 7, 3)
    assert torch.equal(exposed(picture, exposure_of(neutral_exposures(4), 2)), picture)


def test_an_exposure_maps_colours():
    picture = torch.rand(5, 7, 3)
    model = torch.tensor([[2.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.5, -0.1]])
    red, green, blue = picture.unbind(-1)
    expected = torch.stack([2 * red + 0.1, green, 0.5 * green + 0.5 * blue - 0.1], dim=-1)
    assert torch.allclose(exposed(picture, model), expected, atol=1e-6)


def fitted(config=CONFIG, kind: str = "coarse") -> tuple:
    """A state whose photographs have exposures, and its stage."""
    plain = start(config)
    decoder = replace(plain.decoder, exposure=neutral_exposures(8))
    given_stage: Stage = replace(stage(config), images=Unequal(), kind=kind)
    return start_state(plain.anchors, decoder, given_stage), given_stage


def test_the_gradient_is_that_of_finite_differences():
    state, _ = fitted()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        state.decoder.exposure.copy_(0.1 * torch.randn(8, 3, 4, generator=generator))
    picture, target = torch.rand(40, 48, 3, generator=generator), torch.rand(40, 48, 3, generator=generator)

    def cost(departures: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        return ((exposed(image, exposure_of(departures, 3)) - target.double()) ** 2).sum()

    leaves = state.decoder.exposure.detach().double().requires_grad_(True), picture.double().requires_grad_(True)
    found = torch.autograd.grad(cost(*leaves), leaves)
    for which, place in ((0, (3, 0, 1)), (0, (3, 2, 3)), (0, (5, 1, 1)), (1, (4, 5, 1))):
        step = torch.zeros_like(leaves[which])
        step[place] = 1e-6
        moved = [[each + sign * step if i == which else each for i, each in enumerate(leaves)] for sign in (1, -1)]
        slope = (cost(*moved[0]) - cost(*moved[1])) / 2e-6
        assert float(found[which][place]) == pytest.approx(float(slope.detach()), rel=1e-4, abs=1e-6)


def test_photographs_of_unequal_brightness_are_told_from_the_scene():
    config = replace(CONFIG, iterations=600, rates=replace(CONFIG.rates, exposure=(0.005, 5e-4)))
    config = replace(config, anchors=replace(config.anchors, appearance=0))
    state, unequal = fitted(config)
    plain = run(start(config), replace(stage(config), images=Unequal()))
    run(state, unequal)
    brightness = torch.tensor([float(state.decoder.exposure_of(i).detach()[:, :3].sum(1).mean()) for i in range(8)])
    assert float(torch.corrcoef(torch.stack([brightness, GAINS]))[0, 1]) > 0.9

    def error(trained) -> float:
        """Against the place as it is, at the mean brightness."""
        model = AnchorModel(trained.anchors, trained.decoder, 0.4, (0.0, 0.0, 0.0), {})
        truth, errors = Photographs(), []
        for index, camera in enumerate(truth.cameras):
            picture = truth.get(index)[0] * (0.7 / 255)
            errors.append(float(((render(model, camera).image - picture) ** 2).mean()))
        return sum(errors)

    assert error(state) < error(plain)


def test_blocks_take_exposures_as_they_are():
    state, block = fitted(kind="block")
    with torch.no_grad():
        state.decoder.exposure.copy_(torch.linspace(-0.1, 0.1, 96).reshape(8, 3, 4))
    before = state.decoder.exposure.clone()
    for _ in range(3):
        train_step(state, block)
    assert torch.equal(state.decoder.exposure, before)
    neutral, _ = fitted(kind="block")
    for _ in range(3):
        train_step(neutral, block)
    assert bits(neutral)["anchors.features"] != bits(state)["anchors.features"]  # but they count


def test_a_stopped_run_and_a_file_keep_them(tmp_path):
    state, unequal = fitted()
    whole = bits(run(state, unequal))
    state, _ = fitted()
    run(state, unequal, until=33)
    again = run(from_saved(to_saved(state), unequal), unequal)
    assert bits(again) == whole
    AnchorModel(again.anchors, again.decoder, 0.4, (0.0, 0.0, 0.0), {}).save(tmp_path / "model.safetensors")
    read = AnchorModel.load(tmp_path / "model.safetensors")
    assert torch.equal(read.decoder.exposure, again.decoder.exposure)
    assert read.decoder.exposure.abs().max() > 0
    neutral = replace(read, decoder=replace(read.decoder, exposure=None))
    camera = Photographs().camera(0)
    assert torch.equal(render(read, camera).image, render(neutral, camera).image)
