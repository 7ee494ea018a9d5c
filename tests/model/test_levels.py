"""Levels of anchors: what a view draws follows from its pixels, and all that keeps anchors keeps their levels."""

import math
from dataclasses import replace

import numpy as np
import torch

from support.block_training import BLOCKS
from support.checkerboard import Photographs
from support.small_training import BLACK, CONFIG, bits, run, stage, start
from vdgs.config.method import DensifyConfig, MergeConfig
from vdgs.export.bake import view_contributions
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.levels import add_coarser_levels, fit_levels, level_sizes, pixel_sizes
from vdgs.model.lod_nodes import load_anchors, save_anchors
from vdgs.model.renderer import cull_anchors
from vdgs.partition.block_regions import visible_anchors
from vdgs.partition.merging import merge_blocks
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint
from vdgs.training import from_checkpoint, initial_state, to_checkpoint
from vdgs.training.densification import decide_densification

#: From 5 above the ground a pixel is 0.125; half photographs (`small_training`) have pixels of 0.25.
SIZES = (0.18, 0.36, math.inf)


def raised(height: float, turn: float = 0.0):
    camera = Photographs().cameras[3]
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ camera.camera_from_world[:3, :3]
    pose, center = np.eye(4), camera.position * [1, 1, 0] + [0, 0, height]
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return replace(camera, camera_from_world=pose)


def leveled() -> tuple:
    """A stage with three levels and its start."""
    problem, plain = replace(stage(), max_pixels=tuple(np.float32(SIZES).tolist())), start()
    anchors = add_coarser_levels(plain.anchors, 0.4, problem.max_pixels)
    return problem, initial_state(anchors, plain.decoder, problem)


def test_levels_follow_the_pixels_of_the_photographs():
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    low, high = [raised(10.0)] * 5, [raised(40.0)] * 3
    assert fit_levels(points, low, 0) == fit_levels(points, low + high, 1) == ()
    assert fit_levels(points, low + [raised(20.0)] * 3, 0) == ()
    sizes = fit_levels(points, low + high, 0)
    np.testing.assert_allclose(sizes[:2], [0.25 * 2**0.5, 0.5 * 2**0.5], rtol=0.06)
    assert sizes[2:] == (math.inf,)
    assert len(fit_levels(points, low, 4)) == 4
    assert fit_levels(points, [], 3) == fit_levels(points[:0], low, 3) == ()


def test_the_farther_the_camera_the_fewer_anchors_it_draws():
    _, state = leveled()
    anchors, before = state.anchors, set(range(len(state.anchors)))
    scene = {"decoder": state.decoder, "voxel_size": 0.4, "background": BLACK}
    for height in (5.0, 10.0, 20.0):
        camera, plain = raised(height), replace(anchors, max_pixels=None)
        rows = cull_anchors(anchors, camera)
        shown = anchors.max_pixels >= pixel_sizes(anchors.positions, camera)
        assert rows.tolist() == [row for row in cull_anchors(plain, camera).tolist() if shown[row]]
        drawn = set(np.flatnonzero(shown.numpy()).tolist())
        assert drawn < before or (height == 5.0 and drawn == before)
        turned = pixel_sizes(anchors.positions, raised(height, 1.0))
        torch.testing.assert_close(turned, pixel_sizes(anchors.positions, camera))
        everything = view_contributions(AnchorModel(**scene, anchors=anchors), camera).gaussians
        assert torch.equal(everything, view_contributions(AnchorModel(**scene, anchors=plain), camera).gaussians)
        before = drawn
    assert before == set(np.flatnonzero(np.isinf(anchors.max_pixels.numpy())).tolist())
    # Half of the steps of a block draw all levels of what is around.
    assert torch.equal(visible_anchors(anchors, [raised(20.0)]), visible_anchors(plain, [raised(20.0)]))
    # A photograph that is shrunk is drawn as one from farther away.
    whole, half = raised(5.0), raised(5.0).resized(24, 20)
    torch.testing.assert_close(pixel_sizes(anchors.positions, half), 2 * pixel_sizes(anchors.positions, whole))
    assert len(cull_anchors(anchors, half)) < 0.7 * len(cull_anchors(anchors, whole))


def test_coarser_levels_have_an_anchor_in_each_cell_of_theirs():
    plain = start().anchors
    plain = replace(plain, features=torch.randn(plain.features.shape, generator=torch.Generator().manual_seed(0)))
    anchors = add_coarser_levels(plain, 0.4, SIZES)
    assert level_sizes(anchors) == tuple(np.float32(SIZES).tolist())
    for level, size in enumerate(level_sizes(anchors)):
        own, cell = anchors.select(anchors.max_pixels == size), 0.4 * 2**level
        of_cell = torch.floor(torch.round(plain.positions / 0.4) / 2**level + 0.5)
        assert {*map(tuple, of_cell.tolist())} == {*map(tuple, torch.round(own.positions / cell).tolist())}
        members = (of_cell == torch.round(own.positions[0] / cell)).all(1)
        torch.testing.assert_close(own.features[0], plain.features[members].mean(0))
        assert len(own) < len(plain) / 1.5**level or level == 0


def test_training_keeps_levels_and_grows_each_in_its_own_cells(tmp_path):
    problem, state = leveled()
    before = {size: int((state.anchors.max_pixels == size).sum()) for size in level_sizes(state.anchors)}
    state = run(state, problem, until=40)
    save_checkpoint(tmp_path, to_checkpoint(state))
    again = from_checkpoint(load_latest_checkpoint(tmp_path)[0], problem)
    assert bits(run(again, problem)) == bits(run(state, problem))
    assert set(level_sizes(state.anchors)) == set(before)
    assert any(int((state.anchors.max_pixels == size).sum()) > n for size, n in before.items())
    averaged = run(leveled()[1], replace(problem, config=replace(CONFIG, swa_fraction=0.1)))
    assert torch.equal(averaged.result()[0].max_pixels, averaged.anchors.max_pixels)

    model = state.model(problem)
    model.save(tmp_path / "model.safetensors")
    opened = AnchorModel.load(tmp_path / "model.safetensors")
    assert torch.equal(opened.anchors.max_pixels, state.anchors.max_pixels)
    left = opened.without_anchors().anchors.tensors()
    assert left.keys() == opened.anchors.tensors().keys()
    assert not any(tensor.untyped_storage().nbytes() for tensor in left.values())  # the memory is free
    save_anchors(tmp_path / "leaf.safetensors", opened.anchors, np.arange(len(opened.anchors)))
    assert torch.equal(load_anchors(tmp_path / "leaf.safetensors")[0].max_pixels, state.anchors.max_pixels)
    merged, _ = merge_blocks(opened, [opened, opened], BLOCKS, [Photographs().cameras] * 2, MergeConfig())
    assert torch.equal(merged.anchors.max_pixels.sort()[0], state.anchors.max_pixels.sort()[0])
    plain = run(start(), stage(), until=1)
    AnchorModel(anchors=plain.anchors, decoder=plain.decoder, voxel_size=0.4, background=BLACK).save(tmp_path / "plain")
    assert AnchorModel.load(tmp_path / "plain").anchors.max_pixels is None


def test_an_offset_asks_for_its_level_and_strongly_for_the_next_finer_one():
    config = DensifyConfig(min_draw_fraction=0.0, num_levels=1, coarsest_voxels=1.0, grad_threshold=1.0)
    parent = Anchors(torch.zeros(1, 3), torch.ones(1, 32), torch.full((1, 1, 3), 10.0), torch.zeros(1, 6))

    def grown(level: int, gradient: float) -> set[float]:
        found = set()
        for seed in range(6):
            statistics = DensificationStats(torch.full((1, 1), gradient), *(torch.ones(s) for s in ((1, 1), 1, 1)))
            leveled = replace(parent, max_pixels=torch.tensor([SIZES[level]]))
            sizes = tuple(np.float32(SIZES).tolist())
            added = decide_densification(
                leveled, statistics, 1.0, config, torch.Generator().manual_seed(seed), max_pixels=sizes
            ).added
            for size, log_scale in zip(added.max_pixels.tolist(), added.log_scales[:, 0].tolist(), strict=True):
                assert log_scale == np.float32(math.log(2.0 ** sizes.index(size)))
                found.add(sizes.index(size))
        return found

    assert [grown(level, 1.5) for level in range(3)] == [{0}, {1}, {2}]
    assert [grown(level, 2.5) for level in range(3)] == [{0}, {0, 1}, {1, 2}]
