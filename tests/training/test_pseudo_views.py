"""Views that nobody photographed: where they look from, and what a photograph says of them."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.block_training import CONFIG, coarse
from support.checkerboard import Photographs
from vdgs.config.method import DensifyConfig, LossConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.renderer import render
from vdgs.training import TrainingProblem, TrainingState, from_checkpoint, initial_state, to_checkpoint, train
from vdgs.training.pseudo_views import MAX_DIFFERENCE, MAX_TILT, NEARER, SIZE, pseudo_camera, warp_photograph
from vdgs.training.target import TrainingTarget
from vdgs.training.training_loop import PSEUDO_STREAM, pseudo_step

HEIGHT = 5.0


def plane(camera: Camera) -> tuple[Raster, np.ndarray]:
    """The view of an opaque plane at z = 0, and the places that its pixels show; no place above the horizon."""
    rays = camera.unproject(np.ones((camera.height, camera.width))) - camera.position
    with np.errstate(divide="ignore"):
        depth = np.where(rays[..., 2] < 0, -camera.position[2] / rays[..., 2], 0.0)
    alpha, depths = torch.from_numpy(depth > 0).float(), torch.from_numpy(depth).float()
    image = torch.zeros(camera.height, camera.width, 3)
    return Raster(image, alpha, depths, depths), camera.position + rays * depth[..., None]


def target_of(index: int, mask: torch.Tensor | None = None) -> TrainingTarget:
    photographs = Photographs()
    camera = photographs.camera(index)
    counted = camera.width * camera.height if mask is None else int(mask.count_nonzero())
    return TrainingTarget(image=photographs.get(index)[0], mask=mask, camera=camera, counted_pixels=counted)


def pseudo_view(index: int = 0, seed: int = 0) -> Camera:
    camera = Photographs().camera(index)
    found = pseudo_camera(camera, plane(camera)[0], np.random.default_rng(seed))
    assert found is not None
    return found


def test_pseudo_views_look_at_a_place_of_the_photograph_from_nearer_and_more_tilted() -> None:
    camera, tilts = Photographs().camera(0), []
    for seed in range(20):
        found = pseudo_view(seed=seed)
        assert found.camera_from_world[:3, :3] @ found.camera_from_world[:3, :3].T == pytest.approx(np.eye(3))
        assert np.linalg.det(found.camera_from_world[:3, :3]) == pytest.approx(1.0)
        middle = found.position - found.forward * found.position[2] / found.forward[2]
        assert camera.in_frustum(middle[None]).all()
        near = np.linalg.norm(found.position - middle) / np.linalg.norm(camera.position - middle)
        assert NEARER[0] <= near <= NEARER[1]
        assert found.camera_from_world[0, 2] == pytest.approx(0.0)  # the horizon is level
        assert found.width / found.fx == pytest.approx(camera.width / camera.fx)  # as wide a view, in fewer pixels
        assert found.width == round(SIZE * camera.width)
        tilts.append(math.degrees(math.acos(-found.forward[2])))
    assert max(tilts) < MAX_TILT
    assert np.ptp(tilts) > 15
    nothing = plane(camera)[0]._replace(alpha=torch.zeros(camera.height, camera.width))
    assert pseudo_camera(camera, nothing, np.random.default_rng(0)) is None
    part = camera.cropped(3, 2, 15, 12)
    found = pseudo_camera(part, plane(part)[0], np.random.default_rng(0))
    assert found is not None
    assert (found.width, found.height, found.uncropped_size) == (round(12 * SIZE), round(10 * SIZE), None)


def test_a_photograph_lends_its_colors_where_both_show_the_same_place() -> None:
    camera = pseudo_view()
    raster, places = plane(camera)
    found = warp_photograph(target_of(0), plane(Photographs().camera(0))[0], camera, raster, HEIGHT)
    assert found is not None
    assert found.mask is not None
    counts = found.mask.numpy() > 0
    assert counts.mean() == pytest.approx(found.valid_fraction)
    assert np.array_equal(counts, Photographs().camera(0).in_frustum(places.reshape(-1, 3)).reshape(counts.shape))
    true = 255 * (0.5 + 0.1 * places[..., :2].clip(-5, 5))
    pixels = Photographs().camera(0).project(places.reshape(-1, 3))[0].reshape(*counts.shape, 2)
    inner = counts & (np.abs(pixels / [camera.width, camera.height] - 0.5).max(-1) < 0.45)
    assert np.abs(found.image.numpy()[inner][:, 1:] - true[inner]).max() < 2


def test_what_the_photograph_does_not_see_or_is_masked_does_not_count() -> None:
    seen, camera = Photographs().camera(0), pseudo_view()
    shown, (raster, _) = plane(seen)[0], plane(camera)
    assert shown.median_depth is not None
    hidden = shown._replace(median_depth=shown.median_depth - 1.5 * MAX_DIFFERENCE * HEIGHT)
    assert warp_photograph(target_of(0), hidden, camera, raster, HEIGHT) is None
    left = torch.zeros(seen.height, seen.width, dtype=torch.uint8)
    left[:, : seen.width // 2] = 1
    all_of_it, part = (warp_photograph(target_of(0, mask), shown, camera, raster, HEIGHT) for mask in (None, left))
    assert all_of_it is not None
    assert part is not None
    assert 0 < part.valid_fraction < all_of_it.valid_fraction


def test_a_pixel_weighs_the_same_whatever_part_of_the_photograph_a_pseudo_view_is_near() -> None:
    whole = Photographs().camera(0)
    weights = []
    for seen in (whole, whole.cropped(4, 0, 44, 40), whole.cropped(14, 10, 34, 30)):
        image = torch.zeros(seen.height, seen.width, 3, dtype=torch.uint8)
        target = TrainingTarget(image=image, mask=None, camera=seen, counted_pixels=1, valid_fraction=0.5)
        camera = pseudo_camera(seen, plane(seen)[0], np.random.default_rng(0))
        assert camera is not None
        found = warp_photograph(target, plane(seen)[0], camera, plane(camera)[0], HEIGHT)
        assert found is not None
        assert found.mask is not None
        weights.append(found.valid_fraction / int(found.mask.sum()))
    assert weights == pytest.approx([1 / (SIZE**2 * whole.width * whole.height)] * 3, rel=0.05)


def trained(iterations: int = 60) -> tuple[TrainingProblem, TrainingState]:
    """The plane after so many steps without pseudo views. From so high a camera all depths agree."""
    anchors, decoder = coarse()
    config = replace(CONFIG, iterations=iterations, densify=DensifyConfig(num_levels=0, start=10_000))
    stage = TrainingProblem(config=config, images=Photographs(), num_images=8, voxel_size=0.4, camera_height=100.0)
    state = initial_state(anchors, decoder, stage)
    return stage, finish(stage, state, iterations)


def finish(stage: TrainingProblem, state: TrainingState, until: int) -> TrainingState:
    train(state, stage, stop=lambda: state.iteration >= until, after_step=lambda *_: None)
    return state


def test_a_step_brings_a_pseudo_view_closer_to_its_photograph() -> None:
    stage, state = trained()
    stage = replace(stage, config=replace(stage.config, iterations=600, loss=LossConfig(pseudo_views=1.0)))
    target, shown = target_of(0), plane(Photographs().camera(0))[0]
    camera = pseudo_camera(target.camera, shown, np.random.default_rng((stage.config.seed, PSEUDO_STREAM, 60)))
    assert camera is not None

    def error() -> float:
        raster = render(state.model(stage), camera, depth=True)
        wanted = warp_photograph(target, shown, camera, raster._replace(median_depth=plane(camera)[0].depth), HEIGHT)
        assert wanted is not None
        assert wanted.mask is not None
        return float((raster.image - wanted.image / 255)[wanted.mask > 0].square().mean())

    before = error()
    for _ in range(10):
        pseudo_step(state, stage, 0, target, shown)
    assert error() < 0.8 * before


def test_training_with_pseudo_views_is_stopped_and_continued_with_the_same_bits() -> None:
    stage, state = trained()
    start, config = to_checkpoint(state), replace(stage.config, iterations=100)
    results = []
    for weight, stops in ((0.0, (80,)), (0.3, (80,)), (0.3, (66, 71, 80))):
        stage = replace(stage, config=replace(config, loss=LossConfig(pseudo_views=weight)))
        saved = copy.deepcopy(start)
        for until in stops:
            saved = to_checkpoint(finish(stage, from_checkpoint(saved, stage), until))
        results.append(saved.tensors)
    without, unbroken, continued = results
    assert all(torch.equal(tensor, continued[name]) for name, tensor in unbroken.items())
    assert int(unbroken["updates.anchors"].max()) > int(without["updates.anchors"].max())
