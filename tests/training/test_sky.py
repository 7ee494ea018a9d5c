"""What is behind the scene: the environment map, skylines, and training with both."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from support.hand_made_models import camera_above, model_at, opaque_plane, quadrants
from support.small_training import bits, run, start
from support.small_training import stage as small_stage
from vdgs.config.method import MergeConfig, TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import TrainingSplats
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.envmap import ray_angles, ray_directions, row_elevations, sample_envmap
from vdgs.model.initialization.sky import above_skyline, find_skyline, find_skylines, in_sky, initial_envmap, sky_above
from vdgs.model.initialization.sky_masks import SkyMask
from vdgs.model.renderer import render
from vdgs.partition.merging import merge_blocks
from vdgs.training import TrainingState, from_checkpoint, initial_state, to_checkpoint
from vdgs.training.sky_background import EMPTY_WEIGHT, with_sky
from vdgs.training.target import TrainingTarget
from vdgs.training.training_step import RenderedTrainingView, compute_loss, render_for_training

TOWN = np.random.default_rng(0).uniform((-20, -20, 0), (20, 20, 2), (4000, 3))
NOTHING = model_at(np.zeros((0, 3)))


def dome(directions: torch.Tensor) -> torch.Tensor:
    """A smooth sky that differs in every direction, over a plain ground."""
    x, y, z = directions.unbind(-1)
    sky = torch.stack([0.5 + 0.2 * x + 0.2 * z, 0.5 + 0.3 * y, 0.7 - 0.2 * x * y], dim=-1)
    return torch.where(z[..., None] > 0, sky, torch.tensor([0.2, 0.3, 0.1]))


def with_dome(model: AnchorModel, rows: int = 128) -> AnchorModel:
    """The model with a map of the dome at the centers of its cells."""
    elevation = row_elevations(rows)[:, None]
    azimuth = -math.pi + 2 * math.pi * torch.arange(4 * rows) / (4 * rows)
    across = elevation.cos()
    up = elevation.sin().expand(rows, 4 * rows)
    directions = torch.stack([across * azimuth.cos(), across * azimuth.sin(), up], dim=-1)
    return replace(model, decoder=replace(model.decoder, envmap=dome(directions)))


def level_camera(yaw_deg: float, tilt_deg: float = 88.0, altitude: float = 6.0) -> Camera:
    return camera_above(0.0, 0.0, altitude, tilt_deg, yaw_deg)


@pytest.mark.parametrize("yaw", [-90.0, 0.0, 37.0])  # -90 looks along -x, where the ends of the map meet
def test_a_scene_without_anchors_is_the_dome(yaw: float) -> None:
    camera = level_camera(yaw)
    shown, true = render(with_dome(NOTHING), camera).image, dome(ray_directions(camera))
    # But for the row at the horizon.
    apart = (shown - true).abs().amax(dim=(1, 2))
    assert float(apart.sort().values[-3]) < 2e-3


def test_rays_are_those_of_the_camera() -> None:
    camera = level_camera(37.0, 70.0).cropped(3, 5, 40, 30)
    places = camera.unproject(np.full((25, 37), 2.0)) - camera.position
    places /= np.linalg.norm(places, axis=-1, keepdims=True)
    np.testing.assert_allclose(ray_directions(camera).numpy(), places, atol=1e-6)


def test_maps_and_plain_backgrounds_leave_it_out() -> None:
    plane = opaque_plane()
    lit, camera = with_dome(plane), level_camera(0.0)
    above = replace(camera_above(0.0, 0.0), model="orthographic", fx=8.0, fy=8.0)
    assert torch.equal(render(lit, above).image, render(plane, above).image)
    assert torch.equal(
        render(lit, camera, background=(0.0, 0.0, 0.0)).image, render(plane, camera, background=(0, 0, 0)).image
    )
    assert not torch.equal(render(lit, camera).image, render(plane, camera).image)


def test_files_keep_it_and_models_without_one_open(tmp_path) -> None:
    for model in (with_dome(NOTHING, 16), NOTHING):
        model.save(tmp_path / "model.safetensors")
        back = AnchorModel.load(tmp_path / "model.safetensors").envmap
        assert back is None if model.envmap is None else torch.equal(back, model.envmap)


def test_merged_blocks_keep_one() -> None:
    coarse = with_dome(model_at(TOWN[:50] / 10), 16)
    own = replace(coarse, metadata=ModelMetadata(decoder="own"))
    other = replace(own, decoder=replace(model_at(TOWN[:1], decoder_seed=1).decoder, envmap=coarse.envmap))
    for blocks in ([coarse] * 4, [own] * 4, [own, other, own, own]):
        merged, _ = merge_blocks(coarse, blocks, quadrants(), [[]] * 4, MergeConfig())
        assert torch.equal(merged.envmap, coarse.envmap)
        assert all(span.decoder.envmap is None for span in merged.decoder_spans)


def test_a_skyline_is_above_the_town_but_not_above_mismatches() -> None:
    eye = np.array([0.0, 0.0, 6.0])
    tower = np.column_stack([np.full(9, 10.0), np.zeros(9), np.linspace(2, 12, 9)])
    skyline = find_skyline(eye, np.concatenate([TOWN, tower, [[-10.0, 0.0, 30.0]]]))

    def is_sky(x: float, y: float, z: float) -> bool:
        ray = torch.tensor([[x, y, z]]) / math.hypot(x, y, z)
        return bool(above_skyline(ray, skyline))

    assert is_sky(-10, 0, 0.1)  # one point alone does not count
    assert not is_sky(10, 0, 3)
    assert is_sky(10, 0, 7)
    assert is_sky(0, 10, 0.1)
    assert not is_sky(0, 10, -5)
    assert in_sky(
        np.array([[-10.0, 0, 9], [10, 0, 7], [0, 10, 0]]), [level_camera(y) for y in (-90, 90, 0)], [skyline] * 3
    ).tolist() == [True, False, False]


def test_flights_that_look_down_have_no_sky() -> None:
    obliques = [camera_above(x, 0, 6.0, 45.0, 60 * x) for x in range(3)]
    skylines, show_sky = find_skylines(lambda: pytest.fail("not needed"), obliques)
    assert (skylines, show_sky) == ((None,) * 3, False)
    skylines, show_sky = find_skylines(lambda: TOWN, [*obliques, level_camera(0.0)])
    assert show_sky
    assert [skyline is None for skyline in skylines] == [True, True, True, False]


def test_the_first_map_is_what_the_photographs_show() -> None:
    cameras = [level_camera(yaw) for yaw in range(0, 360, 40)]
    skylines, _ = find_skylines(lambda: TOWN, cameras)
    read = lambda index: ((dome(ray_directions(cameras[index])) * 255).byte(), None, cameras[index])  # noqa: E731
    above = [partial(sky_above, skyline) for skyline in skylines]
    envmap = initial_envmap(read, above, cameras, (0.9, 0.1, 0.9))
    for yaw in (20.0, 100.0, 200.0):  # between the photographs
        directions = ray_directions(level_camera(yaw))
        clear = ray_angles(directions)[1] > 0.03
        apart = (sample_envmap(envmap, directions) - dome(directions)).abs()[clear]
        assert float(apart.mean()) < 0.01
        assert float(apart.max()) < 0.1
    straight_down = sample_envmap(envmap, torch.tensor([[[0.0, 0.0, -1.0]]]))
    torch.testing.assert_close(straight_down[0, 0], torch.tensor([0.9, 0.1, 0.9]))


def _target(camera: Camera, mask: torch.Tensor | None = None) -> TrainingTarget:
    """A white photograph."""
    white = torch.full((camera.height, camera.width, 3), 255, dtype=torch.uint8)
    counted = camera.width * camera.height if mask is None else int(mask.count_nonzero())
    return TrainingTarget(image=white, mask=mask, camera=camera, counted_pixels=counted)


def _drawn(
    envmap: torch.Tensor, opacity: float, mask: torch.Tensor | None = None, empty: bool = False
) -> RenderedTrainingView:
    """A splat larger than the picture before the map, in a step."""
    state, camera = start(TrainConfig(iterations=1)), level_camera(0.0)
    sky = sky_above(find_skyline(camera.position, TOWN), camera).numpy()
    stage = replace(small_stage(), sky_masks=(SkyMask.of(camera, sky, sky & empty),))
    decoder = replace(state.decoder, envmap=envmap)
    splats = TrainingSplats(
        means_px=torch.tensor([[30.0, 8.0]]), conics=torch.tensor([[1e-5, 0.0, 1e-5]]), depths=torch.ones(1),
        colors=torch.full((1, 3), 0.3), opacities=torch.tensor([opacity]), segments=None,
        source=torch.zeros(1, dtype=torch.int32), volume=torch.tensor(1.0),
    )  # fmt: skip
    background = torch.tensor([0.9, 0.2, 0.6])
    return with_sky(
        render_for_training(splats, camera, background), stage, 0, decoder, _target(camera, mask), background
    )


def test_gradients_are_finite_differences() -> None:
    envmap = with_dome(NOTHING, 16).envmap.clone().requires_grad_()
    drawn = _drawn(envmap, 0.4)
    weights = torch.rand(drawn.image.shape, generator=torch.Generator().manual_seed(2))
    gradients = drawn.backward(weights.clone(), 0.0)
    loss = lambda *given: float((_drawn(*given).image.double() * weights).sum())  # noqa: E731
    # The gradient of a cell is the mean over the pixels that show it, in the loss of one pixel.
    for row, column in ((5, 47), (6, 50), (7, 45)):
        step = torch.zeros_like(envmap)
        step[row, column] = 1.0
        apart = (_drawn(envmap.detach() + step, 0.4).image - _drawn(envmap.detach(), 0.4).image).double()
        expected = float((apart * weights).sum()) * 64 * 48 / max(float(apart.sum()) / 3, 1.0)
        assert expected > 0
        assert float(envmap.grad[row, column].sum()) == pytest.approx(expected, rel=1e-4, abs=1e-6)
    by_opacity = (loss(envmap.detach(), 0.401) - loss(envmap.detach(), 0.399)) / 0.002
    assert float(gradients.opacities) == pytest.approx(by_opacity, rel=1e-3)
    # What lies below the skyline does not show the map.
    assert torch.equal(drawn.image[-1], _drawn(1 - envmap.detach(), 0.4).image[-1])
    assert not torch.equal(drawn.image[0], _drawn(1 - envmap.detach(), 0.4).image[0])


def test_what_hangs_in_empty_sky_fades_whatever_its_color() -> None:
    """A splat that looks as the sky behind it does changes no pixel: nothing else would remove it."""
    camera = level_camera(0.0)
    decoder, config = start(TrainConfig(iterations=1)).decoder, TrainConfig()
    config = replace(config, loss=replace(config.loss, ssim_lambda=0.0))
    top = torch.zeros(48, 64, dtype=torch.uint8)
    top[:10] = 1
    seen = top.bool()

    def by_opacity(empty: bool, mask: torch.Tensor = top) -> float:
        drawn = _drawn(torch.full((16, 64, 3), 0.3), 0.4, mask, empty)
        drawn = replace(drawn, image=torch.ones_like(drawn.image))  # as the photograph is
        gradient = compute_loss(drawn, _target(camera, mask), decoder, 0, config).image
        return float(drawn.backward(gradient, 0.0).opacities)

    assert by_opacity(False) == 0
    spread = float(_drawn(torch.full((16, 64, 3), 0.3), 0.4).raster.alpha[seen].mean()) / 0.4
    assert by_opacity(True) == pytest.approx(EMPTY_WEIGHT * spread, rel=1e-3)
    assert by_opacity(True, torch.zeros_like(top)) == 0  # what is masked costs nothing


def test_a_mask_makes_the_steps_of_the_map_no_larger() -> None:
    """A cell moves as fast whatever share of the photograph counts, by pixels that count alone."""
    whole, camera = torch.ones(48, 64, dtype=torch.uint8), level_camera(0.0)
    right, tenth = whole.clone(), whole.clone()
    right[:, :32] = 0
    tenth[5:] = 0

    def steps(mask: torch.Tensor | None) -> torch.Tensor:
        envmap = torch.full((16, 64, 3), 0.5).requires_grad_()
        drawn, decoder = _drawn(envmap, 0.1, mask), start(TrainConfig(iterations=1)).decoder
        config = replace(TrainConfig(), loss=replace(TrainConfig().loss, ssim_lambda=0.0))
        drawn.backward(compute_loss(drawn, _target(camera, mask), decoder, 0, config).image, 0.0)
        return envmap.grad.sum(dim=-1)

    plain = steps(None)
    torch.testing.assert_close(steps(whole), plain)
    for mask in (right, tenth):
        found = steps(mask)
        moved = found != 0
        assert 0 < moved.sum() < (plain != 0).sum()
        # Where enough of a cell shows.
        largest = plain.min()
        assert float(found.min()) == pytest.approx(float(largest), rel=0.05)
    assert not steps(torch.zeros_like(whole)).any()


def test_blocks_do_not_move_it() -> None:
    model = with_dome(model_at(TOWN[:5]), 16)
    for kind, moves in (("coarse", True), ("block", False)):
        state = initial_state(model.anchors, model.decoder.copy(), replace(small_stage(), kind=kind))
        assert state.decoder.envmap.requires_grad == moves


def test_a_training_that_goes_on_moves_it_to_the_same_bits() -> None:
    stage, everywhere = small_stage(), np.ones((48, 64), bool)
    masks = [SkyMask.of(stage.images.camera(view), everywhere, ~everywhere) for view in range(8)]
    stage = replace(stage, sky_masks=[None if view % 2 else mask for view, mask in enumerate(masks)])

    def begin() -> TrainingState:
        state = start()
        decoder = replace(state.decoder.copy(), envmap=torch.full((16, 64, 3), 0.5))
        return initial_state(state.anchors, decoder, stage)

    whole, part = run(begin(), stage, 12), run(begin(), stage, 5)
    again = run(from_checkpoint(to_checkpoint(part), stage), stage, 12)
    assert bits(again) == bits(whole)
    moved = (whole.decoder.envmap.detach() - 0.5).abs().amax(dim=(1, 2))
    assert float(moved[-1]) > 0
    assert float(moved[:8].max()) == 0  # cameras that look down see nothing of it
