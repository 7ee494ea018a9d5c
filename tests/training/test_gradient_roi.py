"""A block's step draws no more of a view than its splats reach, and moves them as if it had drawn all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from support.block_training import block_stage, coarse
from support.checkerboard import Photographs
from support.rasterize_scenes import make_scene, splats_of
from vdgs.config.method import BlockConfig
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import Splats
from vdgs.training import (
    FrozenAnchors,
    TrainingProblem,
    TrainingState,
    initial_state,
    pseudo_views,
    train_step,
    training_loop,
)
from vdgs.training.crops import Crop
from vdgs.training.gradient_roi import splat_bounds

SCENES = {
    "ordinary": make_scene(40, 61, 47),
    "huge": make_scene(3, 64, 64, size=200.0, opacity=-2.0),
    "edge-on": make_scene(20, 50, 70, size=4.0, thinness=4.0, spread=1.5),
    "off-screen": make_scene(5, 20, 20, margin=4.0),
}


@pytest.mark.parametrize("name", SCENES)
def test_the_box_holds_every_pixel_that_a_splat_changes(name):
    scene = SCENES[name]
    splats, background = splats_of([each.detach() for each in scene.tensors])
    for i in range(len(splats.depths)):
        one = Splats(*(getattr(splats, field)[i : i + 1] for field in ("means_px", "conics", "depths", "colors")),
                     splats.opacities[i : i + 1])  # fmt: skip
        alpha = get_backend(torch.device("cpu")).rasterize(one, background, scene.width, scene.height).alpha
        box = splat_bounds(one, scene.width, scene.height)
        if box is None:
            assert not alpha.any()
            continue
        left, top, right, bottom = box
        assert 0 <= left < right <= scene.width
        assert 0 <= top < bottom <= scene.height
        alpha[top:bottom, left:right] = 0
        assert not alpha.any()


def test_splats_that_are_not_drawn_open_no_box():
    splats, _ = splats_of([each.detach().clone() for each in SCENES["ordinary"].tensors])
    faint = replace(splats, opacities=torch.full_like(splats.opacities, 1e-3))
    assert splat_bounds(faint, 61, 47) is None
    lost = replace(splats, means_px=torch.full_like(splats.means_px, torch.nan))
    assert splat_bounds(lost, 61, 47) is None
    assert splat_bounds(Splats(*(getattr(splats, name)[:0] for name in vars(splats))), 61, 47) is None


@dataclass
class Stepped:
    """A block after its first step, how large the picture was that it drew, and how many splats around it took part."""

    state: TrainingState
    pixels: int
    around: int


class Masked(Photographs):
    """Photographs of which a corner does not count."""

    def get(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
        image, _ = super().get(index, downscale)
        mask = torch.ones(image.shape[:2], dtype=torch.uint8)
        mask[:14, :17] = 0
        return image, mask


class Nothing(Photographs):
    """Photographs of which no pixel counts."""

    def get(self, index: int, downscale: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
        image, _ = super().get(index, downscale)
        return image, torch.zeros(image.shape[:2], dtype=torch.uint8)


def step(monkeypatch: pytest.MonkeyPatch, stage: TrainingProblem, own: bool, narrowing: bool) -> Stepped:
    """The westernmost anchors, small, are the block; the others strew their Gaussians far over it and beyond. All hide
    enough to show a surface."""
    anchors, decoder = coarse()
    with torch.no_grad():
        decoder.weights.opacity.b2.add_(1.5)
    west = anchors.positions[:, 0] < -2.6
    small = anchors.select(west)
    small = replace(small, log_scales=torch.full_like(small.log_scales, -2.0))
    others = anchors.select(~west)
    others = replace(others, offsets=8 * others.offsets)
    stage = replace(stage, frozen_decoder=not own, frozen_anchors=FrozenAnchors(others, decoder.copy()))
    state, drawn = initial_state(small, decoder, stage), []
    with monkeypatch.context() as patch:
        if not narrowing:
            patch.setattr(training_loop, "crop_to_gradient_support", lambda stage, splats, camera, box, factors: box)
        draw = training_loop.render_for_training
        patch.setattr(
            training_loop, "render_for_training", lambda *given, **named: drawn.append(given) or draw(*given, **named)
        )
        train_step(state, stage)
    ((_, camera, _, around),) = drawn
    return Stepped(state, camera.width * camera.height, len(around.depths))


def with_agreement(stage: TrainingProblem, weight: float) -> TrainingProblem:
    return replace(stage, config=replace(stage.config, loss=replace(stage.config.loss, depth_agreement=weight)))


def stages() -> dict[str, TrainingProblem]:
    stage, _ = block_stage(BlockConfig())
    return {
        "whole": stage,
        "part": replace(stage, crops=(Crop(0.1, 0.1, 0.95, 0.9),) * stage.num_images),
        "masked": replace(stage, images=Masked()),
    }


@pytest.mark.parametrize("name", stages())
@pytest.mark.parametrize("own", [False, True], ids=["shared decoder", "own decoder"])
@pytest.mark.parametrize("agreement", [0.0, 0.5], ids=["", "depths agree"])
def test_a_step_moves_a_block_as_if_it_had_drawn_all(monkeypatch, name, own, agreement):
    stage = with_agreement(stages()[name], agreement)
    found, expected = (step(monkeypatch, stage, own, narrowing) for narrowing in (True, False))
    assert found.pixels < 0.9 * expected.pixels
    assert 10 < found.around < expected.around
    ours, theirs = found.state, expected.state
    # Adam's first moments are a tenth of the gradients.
    for one, other in (
        *((ours.optimizer.anchors.first[name], each) for name, each in theirs.optimizer.anchors.first.items()),
        *((ours.optimizer.decoder.first[name], each) for name, each in theirs.optimizer.decoder.first.items()),
        (ours.statistics.gradient, theirs.statistics.gradient),
    ):  # fmt: skip
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-5 * float(other.abs().max()))
    assert float(theirs.statistics.gradient.max()) > 0
    for name in ("drawn", "opacity", "seen"):
        assert torch.equal(getattr(ours.statistics, name), getattr(theirs.statistics, name))


@pytest.mark.parametrize("narrowing", [True, False])
def test_a_photograph_of_which_nothing_counts_asks_for_no_growth(monkeypatch, narrowing):
    stage = with_agreement(replace(stages()["whole"], images=Nothing()), 0.5)
    state = step(monkeypatch, stage, True, narrowing).state
    assert float(state.statistics.drawn.sum()) > 0
    assert not state.statistics.gradient.any()


def test_a_step_begins_its_pseudo_view_at_any_place_of_the_box(monkeypatch):
    """As on a GPU, where nothing narrows it: the same pseudo views."""
    begun = []
    monkeypatch.setattr(pseudo_views, "START_FRACTION", 0.0)
    monkeypatch.setattr(training_loop, "pseudo_step", lambda *given: begun.append(given[3].camera) or True)
    for stage in stages().values():
        loss = replace(stage.config.loss, pseudo_views=0.3)
        for narrowing in (True, False):
            step(monkeypatch, replace(stage, config=replace(stage.config, loss=loss)), True, narrowing)
        ours, theirs = begun[-2:]
        assert (ours.packed == theirs.packed).all()
    assert len(begun) == 6


def test_a_block_with_nothing_around_it_draws_all(monkeypatch):
    stage, state = block_stage(BlockConfig())
    nothing = stage.frozen_anchors.anchors.select(torch.zeros(0, dtype=torch.int64))
    camera, drawn, draw = stage.images.camera(0), [], training_loop.render_for_training
    monkeypatch.setattr(
        training_loop, "render_for_training", lambda *given, **named: drawn.append(given[1]) or draw(*given, **named)
    )
    train_step(state, replace(stage, frozen_anchors=FrozenAnchors(nothing, state.decoder)))
    assert [(each.width, each.height) for each in drawn] == [(camera.width, camera.height)]
