"""Parts of photographs: what they draw is what the whole picture shows there, and they hold what shows the block."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from support.block_training import BLOCKS, block_stage, coarse
from support.decode_scenes import Scene, looking_down, turned
from vdgs.config.method import BlockConfig, MethodConfig
from vdgs.config.presets import PRESETS
from vdgs.errors import RunError
from vdgs.kernels import cpu, torch_ref
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import render_scalar
from vdgs.partition.block_regions import split_trainable_anchors
from vdgs.training import from_checkpoint, to_checkpoint, train, train_step
from vdgs.training.crops import (
    FULL_AREA_FRACTION,
    FULL_IMAGE,
    FULL_IMAGE_EVERY,
    MARGIN,
    MAX_STEP_FACTOR,
    MIN_CONTRIBUTION,
    TAIL_FRACTION,
    Crop,
    _crop,
    compute_crops,
    crop_at,
    load_or_compute_crops,
    mean_crop_area,
    steps_for,
)
from vdgs.training.depth_agreement import is_agreement_due
from vdgs.training.pseudo_views import is_pseudo_view_due

CAMERAS = [looking_down(), looking_down("orthographic"), turned()]
ALL_OF = (0, 0, 64, 48)
PARTS = [(0, 0, 20, 48), (30, 10, 64, 31), (5, 40, 6, 48), ALL_OF]


def drawn(scene: Scene, camera, part, kernels) -> torch.Tensor:
    """What the part of the camera's picture draws of the anchors that the whole picture draws."""
    rows = kernels.cull(scene.positions, scene.log_scales, camera)
    part = camera.cropped(*part)
    splats = kernels.decode(scene.positions, scene.features, scene.offsets, scene.log_scales, scene.weights, part, rows)
    return kernels.rasterize(splats, torch.tensor([0.1, 0.5, 0.9]), part.width, part.height).image


@pytest.mark.parametrize("kernels", [cpu, torch_ref], ids=["native", "twin"])
@pytest.mark.parametrize("camera", CAMERAS, ids=["down", "orthographic", "turned"])
@pytest.mark.parametrize("log_scale", [-1.5, 0.5], ids=["small", "large"])
def test_a_part_draws_what_the_whole_picture_shows_there(kernels, camera, log_scale):
    # Large Gaussians beyond the border are where a narrower limit of the Jacobian would show.
    scene = Scene.random(60, 4, spread=6.0, log_scale=log_scale)
    whole = drawn(scene, camera, ALL_OF, kernels)
    for left, top, right, bottom in PARTS:
        part = drawn(scene, camera, (left, top, right, bottom), kernels)
        assert torch.allclose(part, whole[top:bottom, left:right], atol=2e-4), (left, top, right, bottom)
    assert float(whole.std()) > 0.05


@pytest.mark.parametrize("camera", CAMERAS, ids=["down", "orthographic", "turned"])
def test_its_gradients_are_those_of_the_pixels_that_it_holds(camera):
    scene = Scene.random(60, 4, spread=4.0, log_scale=-0.5)
    left, top, right, bottom = 10, 5, 50, 40
    weight = torch.randn(48, 64, 3, generator=torch.Generator().manual_seed(1))
    inside = torch.zeros_like(weight)
    inside[top:bottom, left:right] = 1
    found = []
    for part, incoming in ((ALL_OF, weight * inside), ((left, top, right, bottom), weight[top:bottom, left:right])):
        scene_ = replace(scene, features=scene.features.clone().requires_grad_(True))
        (drawn(scene_, camera, part, cpu) * incoming).sum().backward()
        found.append(scene_.features.grad)
    assert torch.allclose(found[0], found[1], atol=1e-3 * float(found[0].abs().max()))
    assert float(found[0].abs().max()) > 0


def test_a_part_keeps_the_size_of_the_whole_and_must_lie_in_it():
    camera = looking_down()
    part = camera.cropped(10, 5, 50, 40).cropped(1, 1, 20, 20)
    assert (part.width, part.height) == (19, 19)
    assert part.full_size == (64, 48)
    assert (part.cx, part.cy) == (camera.cx - 11, camera.cy - 6)
    for bad in ((-1, 0, 5, 5), (0, 0, 65, 5), (5, 0, 5, 5), (0, 9, 5, 4)):
        with pytest.raises(ValueError, match="no part of a picture of 64x48"):
            camera.cropped(*bad)
    with pytest.raises(ValueError, match="resize the whole picture"):
        part.resized(10, 10)


@given(
    sides=st.tuples(*[st.floats(0, 1)] * 4),
    width=st.integers(1, 300),
    height=st.integers(1, 300),
)
def test_pixels_of_a_part_cover_it_and_lie_in_the_photograph(sides, width, height):
    (left, right), (top, bottom) = sorted(sides[:2]), sorted(sides[2:])
    x0, y0, x1, y1 = Crop(left, top, right, bottom).pixels(width, height)
    assert 0 <= x0 < x1 <= width
    assert 0 <= y0 < y1 <= height
    assert x0 <= left * width
    assert x1 >= right * width
    looking_down(width=width, height=height).cropped(x0, y0, x1, y1)


def model_and_own() -> tuple[AnchorModel, torch.Tensor]:
    """A plane of opaque anchors and those of the western block."""
    anchors, decoder = coarse()
    anchors = replace(anchors, log_scales=torch.full_like(anchors.log_scales, -1.0))
    own, _ = split_trainable_anchors(anchors, BLOCKS, 0, BlockConfig())
    return AnchorModel(anchors=anchors, decoder=decoder, voxel_size=0.4, background=(0.0, 0.0, 0.0)), own


def test_parts_hold_nearly_all_that_shows_the_block_and_little_else():
    model, own = model_and_own()
    camera = looking_down(width=128, height=96)
    (crop,) = compute_crops(model, own, [camera])
    left, top, right, bottom = crop.pixels(128, 96)
    shown = render_scalar(model, own.float(), camera)[0].numpy() >= MIN_CONTRIBUTION
    assert shown.sum() > 1000
    assert not shown[:, 80:].any()  # the block is the western half
    assert shown[top:bottom, left:right].sum() >= (1 - 4 * TAIL_FRACTION) * shown.sum()
    columns, rows = np.flatnonzero(shown.any(0)), np.flatnonzero(shown.any(1))
    margin = MARGIN * 128 + 1
    assert left >= columns[0] - margin
    assert right <= columns[-1] + 1 + margin
    assert top >= rows[0] - margin
    assert bottom <= rows[-1] + 1 + margin
    assert crop.area < FULL_AREA_FRACTION


def test_what_shows_nothing_or_nearly_everything_of_the_block_stays_whole():
    model, own = model_and_own()
    camera = looking_down()
    assert compute_crops(model, torch.zeros_like(own), [camera]) == (FULL_IMAGE,)
    assert compute_crops(model, torch.ones_like(own), [camera]) == (FULL_IMAGE,)


def test_the_mean_area_is_that_of_the_photographs_as_they_are_used():
    crops = [FULL_IMAGE, Crop(0, 0, 0.5, 0.5)]
    every = 1 / FULL_IMAGE_EVERY
    assert mean_crop_area(crops, None) == pytest.approx(every + (1 - every) * 0.625)
    assert mean_crop_area(crops, (1.0, 3.0)) == pytest.approx(every + (1 - every) * (1 + 3 * 0.25) / 4)


def test_now_and_then_a_whole_photograph_is_drawn():
    """What a block lets stand beyond the parts must be seen by some step."""
    crops = (Crop(0, 0, 0.5, 0.5),) * 3
    drawn = [crop_at(crops, 1, iteration) for iteration in range(5 * FULL_IMAGE_EVERY)]
    assert drawn.count(FULL_IMAGE) == 5
    assert set(drawn) == {FULL_IMAGE, crops[1]}
    assert crop_at(None, 1, 0) == FULL_IMAGE


@pytest.mark.parametrize("is_due", [is_agreement_due, is_pseudo_view_due])
def test_whole_photographs_meet_the_losses_against_floaters(is_due):
    """As often as parts of photographs do."""
    laptop = PRESETS["laptop"].training
    steps = range(laptop.iterations // 2, laptop.iterations // 2 + 400)
    due = [step for step in steps if is_due(laptop, step)]
    whole = [step for step in due if crop_at((Crop(0, 0, 0.5, 0.5),), 0, step) == FULL_IMAGE]
    assert len(whole) == len(due) / FULL_IMAGE_EVERY > 0


def test_few_pixels_make_more_steps_but_not_endlessly_many():
    assert steps_for(100, 1.0) == 100
    assert steps_for(100, 0.5) == 200
    assert steps_for(100, 1e-4) == MAX_STEP_FACTOR * 100


def test_parts_are_found_once_and_kept(tmp_path):
    def never():
        raise AssertionError("looked for again")

    path, found = tmp_path / "crops.json", (FULL_IMAGE, Crop(0.1, 0.2, 1 / 3, 0.9))
    assert load_or_compute_crops(path, 2, lambda: found) == found
    assert load_or_compute_crops(path, 2, never) == found
    with pytest.raises(RunError, match=r"crops\.json: is damaged \(3 parts .* were expected\)\. Delete it"):
        load_or_compute_crops(path, 3, never)
    for damage in ("{}", '{"crops": [[0, 0, 1]]}', '{"crops": [[0, 0, 2, 1], [0, 0, 1, 1]]}', "nothing", "[1]"):
        path.write_text(damage)
        with pytest.raises(RunError, match=r"crops\.json"):
            load_or_compute_crops(path, 2, never)


def test_single_pixels_far_away_do_not_open_a_part_wide():
    shown = np.zeros((100, 200), np.float32)
    shown[40:60, 50:90] = 1
    near = _crop(shown)
    shown[2, 190] = shown[97, 3] = 1
    assert _crop(shown) == near
    left, top, right, bottom = near.pixels(200, 100)
    margin = MARGIN * 200
    assert left <= 50 - margin + 1
    assert right >= 90 + margin - 1
    assert top <= 40 - margin + 1
    assert bottom >= 60 + margin - 1


def in_parts(stage, crop: Crop):
    return replace(stage, crops=(crop,) * stage.num_images)


def trained_bits(stage, state, until: int = 1000) -> dict[str, bytes]:
    train(state, stage, stop=lambda: state.iteration >= until, after_step=lambda *_: None)
    return {name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()}


def test_whole_parts_are_whole_photographs_bit_for_bit():
    stage, state = block_stage(BlockConfig())
    _, other = block_stage(BlockConfig())
    assert trained_bits(stage, state) == trained_bits(in_parts(stage, FULL_IMAGE), other)


def test_a_block_in_parts_is_stopped_and_continued_with_the_same_bits():
    stage, state = block_stage(BlockConfig())
    stage = in_parts(stage, Crop(0.1, 0.0, 0.7, 1.0))
    _, broken = block_stage(BlockConfig())
    trained_bits(stage, broken, until=17)
    assert trained_bits(stage, from_checkpoint(to_checkpoint(broken), stage)) == trained_bits(stage, state)


def test_anchors_outside_of_all_parts_do_not_move():
    stage, state = block_stage(BlockConfig())
    before = state.anchors.features.clone()
    positions = state.anchors.positions.clone()
    stage = in_parts(stage, Crop(0.0, 0.0, 0.5, 0.5))
    for _ in range(FULL_IMAGE_EVERY - 1):
        train_step(state, stage)
    seen = torch.zeros(len(before), dtype=torch.bool)
    for camera in stage.images.cameras:
        part = camera.cropped(*stage.crops[0].pixels(camera.width, camera.height))
        seen[cpu.cull(positions, state.anchors.log_scales, part)] = True
    moved = (state.anchors.features[: len(before)] != before).any(1)
    assert moved.any()
    assert not (moved & ~seen).any()


class Masked:
    """The photographs of a stage with a mask that keeps a rectangle."""

    def __init__(self, images, left: int, top: int, right: int, bottom: int) -> None:
        self.images, self.box = images, (left, top, right, bottom)

    def get(self, index: int, downscale: int = 1):
        target, _ = self.images.get(index, downscale)
        left, top, right, bottom = self.box
        mask = torch.zeros(target.shape[:2], dtype=torch.uint8)
        mask[top:bottom, left:right] = 255
        return target, mask

    def camera(self, index: int, downscale: int = 1):
        return self.images.camera(index, downscale)

    def prefetch(self, indices, downscale: int = 1) -> None:
        self.images.prefetch(indices, downscale)


def test_gradients_of_a_part_are_those_of_the_whole_photograph():
    """Statistics of growth, in which thresholds are given, must not depend on how much else is drawn. Where a mask
    keeps only a rectangle, its part has all the photograph's pixels that count."""
    config = replace(block_stage(BlockConfig())[0].config, loss=replace(MethodConfig().training.loss, ssim_lambda=0.0))
    stage, whole = block_stage(BlockConfig(), training=config)
    _, part = block_stage(BlockConfig(), training=config)
    camera = stage.images.camera(0)
    crop = Crop(0.25, 0.25, 0.75, 0.75)
    box = crop.pixels(camera.width, camera.height)
    masked = replace(stage, images=Masked(stage.images, *box))
    train_step(whole, masked)
    train_step(part, in_parts(masked, crop))
    assert torch.allclose(part.statistics.gradient, whole.statistics.gradient, rtol=1e-3, atol=1e-9)
    assert float(whole.statistics.gradient.max()) > 0
    # Without a mask, the part counts for its share of the picture.
    _, bare = block_stage(BlockConfig(), training=config)
    train_step(bare, in_parts(stage, crop))
    share = (box[2] - box[0]) * (box[3] - box[1]) / (camera.width * camera.height)
    assert torch.allclose(bare.statistics.gradient, share * whole.statistics.gradient, rtol=1e-3, atol=1e-9)
