"""HUG: its boxes, the pixels of each, the weights of its levels; one block of whole pictures is Octree-GS."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from experiments.baselines.hug.partition import cut_ground, pixel_owners
from experiments.baselines.hug.run import MaskedImages, level_weights, levels_at, run_hug
from experiments.baselines.hug.settings import HugConfig, hug_config
from experiments.baselines.octree_gs.levels import Octree, fit_octree
from experiments.baselines.octree_gs.model import OctreeModel
from experiments.baselines.octree_gs.run import run_octree
from experiments.baselines.octree_gs.training import octree_problem, octree_state
from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.pipeline.train_coarse import open_training_images
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json
from vdgs.training import to_checkpoint, train_step

pytestmark = [pytest.mark.xdist_group("octree_gs"), pytest.mark.slow]
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(points=150, width=48, height=36))
    return load_capture(folder, CaptureOptions(up="z"))


def short(blocks: int, **values) -> HugConfig:
    config = hug_config(12 * blocks, blocks, seed=1)
    growth = replace(
        config.octree.training.densify, every=4, stats_start=0, start=4, stop_fraction=0.8, min_draw_fraction=0.2,
        grad_threshold=2e-6,
    )  # fmt: skip
    training = replace(config.octree.training, densify=growth)
    return replace(config, octree=replace(config.octree, training=training, levels=2), **values)


@settings(max_examples=20)
@given(st.integers(1, 9), st.integers(0, 2**16))
def test_boxes_cut_the_ground_into_equally_many_points_without_gaps(count, seed):
    points = np.random.default_rng(seed).normal(size=(360, 3)) * [30.0, 10.0, 1.0]
    boxes = cut_ground(points, count)
    assert len(boxes) == count
    counts = np.bincount(boxes.owner(points[:, :2]), minlength=count)
    assert counts.max() - counts.min() <= 4
    everywhere = torch.from_numpy(np.random.default_rng(seed).uniform(-99, 99, (50, 2)))
    held = sum(boxes.holds(block, everywhere).int() for block in range(count))
    assert bool((held == 1).all())
    assert bool((boxes.holds(0, everywhere, 0.3) >= boxes.holds(0, everywhere)).all())


def test_every_pixel_has_one_block_that_of_what_it_shows(capture):
    boxes = cut_ground(capture.points, 2)
    owner = boxes.owner(capture.points[:, :2])
    cameras = [view.camera for view in capture.train_views]
    grids = pixel_owners(capture.points, owner, cameras, 1)
    agreed = []
    for camera, grid in zip(cameras, grids, strict=True):
        assert set(np.unique(grid)) <= {0, 1}
        local = capture.points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        column, row = (
            f * local[:, i] / local[:, 2] + c for i, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy))
        )
        held = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        scale = grid.shape[0] / camera.height
        agreed += (grid[(row[held] * scale).astype(int), (column[held] * scale).astype(int)] == owner[held]).tolist()
    assert np.mean(agreed) > 0.97  # but for cells that hold points of both
    shares = np.mean([[(grid == block).mean() for block in (0, 1)] for grid in grids], axis=0)
    assert shares.sum() == pytest.approx(1)
    assert shares.min() > 0.2


def test_a_block_learns_its_own_pixels_and_no_others(capture):
    """A step does not see what the others show, and does see what its own do."""
    config, cameras = short(1).octree, [view.camera for view in capture.train_views]
    grids = [np.arange(8)[None] < np.full((6, 1), 4) for _ in cameras]  # the left half
    octree, stepped = fit_octree(capture.points, cameras, config), []

    class Repainted(MaskedImages):
        painted = slice(0, 0)

        def get(self, index, downscale=1):
            image, mask = super().get(index, downscale)
            image = image.clone()
            image[:, self.painted] = 255 - image[:, self.painted]
            return image, mask

    with open_training_images(capture, config.training, 10**8) as images:
        _, mask = MaskedImages(images, grids).get(0)
        assert torch.equal(mask.bool(), (torch.arange(48) < 24).expand(36, 48))
        for painted in (slice(0, 0), slice(24 + 5, 48), slice(0, 24)):  # 5 pixels reach half of SSIM's window
            repainted = Repainted(images, grids)
            object.__setattr__(repainted, "painted", painted)
            problem = octree_problem(capture, config, octree, repainted, cameras)
            state = octree_state(capture.points, cameras, problem, octree)
            train_step(state, problem)
            stepped.append({name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()})
    whole, others, own = stepped
    assert others == whole
    assert own != whole


def test_levels_are_drawn_as_often_as_their_weight_in_the_loss():
    weights = level_weights(4, 0.2, 1.0)
    # Three levels below the full picture: k = 3 is the coarsest.
    expected = [0.8 / 2 + 0.2 / 8, 0.8 / 4 + 0.2 / 4, 0.8 / 8 + 0.2 / 2, 1.0]
    assert weights == pytest.approx(np.array(expected) / sum(expected))
    assert level_weights(4, 0.2, 0.0).tolist() == [0, 0, 0, 1]
    assert level_weights(1, 0.2, 1.0).tolist() == [1]
    config, octree = hug_config(4_000, 1), Octree(4, 2, 1.0, 1.0)
    drawn = np.bincount(list(map(levels_at(config, octree), range(2_000))), minlength=5)[1:]
    assert drawn / 2_000 == pytest.approx(level_weights(4, 0.2, config.coarse_weight), abs=0.03)


def test_one_block_that_is_drawn_at_all_levels_is_octree_gs(capture, tmp_path):
    config = short(1, coarse_weight=0.0)
    alone = run_hug(RunFolder(tmp_path / "hug"), capture, config, QUIET)
    plain = run_octree(RunFolder(tmp_path / "octree"), capture, config.octree, QUIET)
    assert alone["psnr"] == plain["psnr"]
    assert alone["n_anchors"] == plain["n_anchors"]
    hug, octree = OctreeModel.load(tmp_path / "hug" / "hug"), OctreeModel.load(tmp_path / "octree" / "octree")
    for name, tensor in octree.anchors.anchors.tensors().items():
        assert torch.equal(hug.anchors.anchors.tensors()[name], tensor)
    assert torch.equal(hug.levels, octree.levels)


def test_blocks_are_merged_by_place_and_their_costs_noted(capture, tmp_path, monkeypatch):
    run, masked, get = RunFolder(tmp_path), [], MaskedImages.get
    monkeypatch.setattr(MaskedImages, "get", lambda *of: masked.append(of) or get(*of))
    figures = run_hug(run, capture, short(2), QUIET)
    model = OctreeModel.load(tmp_path / "hug")
    boxes, positions = cut_ground(capture.points, 2), model.anchors.anchors.positions
    for block, (first, last, _) in enumerate(model.anchors.decoder_ranges()):
        assert bool(boxes.holds(block, positions[first:last, :2]).all())
    assert len({id(images) for images, *_ in masked}) == 2  # each from its own pixels
    costs = read_json(tmp_path / "hug" / "costs.json")
    assert costs["blocks"] == 2
    assert costs["block_seconds"] >= costs["longest_block_seconds"] > 0
    assert figures["n_anchors"] == len(model.levels)
    assert run_hug(run, capture, short(2), QUIET)["psnr"] == figures["psnr"]  # only read
