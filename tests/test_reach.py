"""A block's step draws no more of a view than its splats reach, and moves them as if it had drawn all."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from block_support import block_stage
from rasterise_scenes import make_scene, splats_of
from vdgs.kernels import choose
from vdgs.kernels.reach import box_reached
from vdgs.kernels.types import Splats
from vdgs.settings.method import BlockConfig
from vdgs.training import Surroundings, loop, start_state, train_step
from vdgs.training.crops import Crop

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
        one = Splats(*(getattr(splats, field)[i : i + 1] for field in ("means_px", "conics", "depths", "colours")),
                     splats.opacities[i : i + 1])  # fmt: skip
        alpha = choose(torch.device("cpu")).rasterise(one, background, scene.width, scene.height).alpha
        box = box_reached(one, scene.width, scene.height)
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
    assert box_reached(faint, 61, 47) is None
    lost = replace(splats, means_px=torch.full_like(splats.means_px, torch.nan))
    assert box_reached(lost, 61, 47) is None
    assert box_reached(Splats(*(getattr(splats, name)[:0] for name in vars(splats))), 61, 47) is None


def stepped(monkeypatch: pytest.MonkeyPatch, crop: Crop | None, narrow: bool, decoder: str = "frozen"):
    """A block after its first step, and how large the picture was that it drew."""
    stage, state = block_stage(BlockConfig())
    stage = replace(stage, frozen_decoder=decoder == "frozen", crops=crop and (crop,) * stage.image_count)
    west = state.anchors.select(state.anchors.positions[:, 0] < -2.6)
    small = replace(west, log_scales=torch.full_like(west.log_scales, -2.0))
    state = start_state(small, state.decoder, stage)
    drawn = []
    with monkeypatch.context() as patch:
        if not narrow:
            patch.setattr(loop, "part_reached", lambda *_: None)
        draw = loop.draw_view
        patch.setattr(loop, "draw_view", lambda *given: drawn.append(given[1]) or draw(*given))
        train_step(state, stage)
    (camera,) = drawn
    return state, (camera.width, camera.height)


@pytest.mark.parametrize("crop", [None, Crop(0.1, 0.1, 0.95, 0.9)], ids=["whole", "part"])
@pytest.mark.parametrize("decoder", ["frozen", "own"])
def test_a_step_moves_a_block_as_if_it_had_drawn_all(monkeypatch, crop, decoder):
    found, (width, height) = stepped(monkeypatch, crop, True, decoder)
    expected, (full_width, full_height) = stepped(monkeypatch, crop, False, decoder)
    assert width * height < 0.9 * full_width * full_height
    # Adam's first moments are a tenth of the gradients.
    for ours, theirs in (
        *((found.optimiser.anchors.first[name], each) for name, each in expected.optimiser.anchors.first.items()),
        *((found.optimiser.decoder.first[name], each) for name, each in expected.optimiser.decoder.first.items()),
        (found.statistics.gradient, expected.statistics.gradient),
    ):  # fmt: skip
        assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-5 * float(theirs.abs().max()))
    assert float(expected.statistics.gradient.max()) > 0
    for name in ("drawn", "opacity", "seen"):
        assert torch.equal(getattr(found.statistics, name), getattr(expected.statistics, name))


def test_a_block_with_nothing_around_it_draws_all(monkeypatch):
    stage, state = block_stage(BlockConfig())
    nothing = stage.surroundings.anchors.select(torch.zeros(0, dtype=torch.int64))
    camera, drawn, draw = stage.images.camera(0), [], loop.draw_view
    monkeypatch.setattr(loop, "draw_view", lambda *given: drawn.append(given[1]) or draw(*given))
    train_step(state, replace(stage, surroundings=Surroundings(nothing, state.decoder)))
    assert [(each.width, each.height) for each in drawn] == [(camera.width, camera.height)]
