"""Scaffold-GS and Octree-GS: their settings, levels and growth; one level is plain training, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from experiments.baselines.octree_gs.levels import Octree, fit_octree, octree_starts
from experiments.baselines.octree_gs.model import OctreeModel
from experiments.baselines.octree_gs.run import run_octree
from experiments.baselines.octree_gs.settings import OctreeConfig, octree_config, scaffold_config
from experiments.baselines.octree_gs.training import (
    grow_levels,
    octree_problem,
    octree_state,
    random_decoder,
    start_state,
)
from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import TrainConfig
from vdgs.config.serialization import diff_settings, to_dict
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import render
from vdgs.pipeline.train_coarse import open_training_images
from vdgs.runs.run_folder import RunFolder
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint
from vdgs.training import from_checkpoint, initial_state, to_checkpoint, train
from vdgs.training.training_loop import REFERENCE_HEIGHT

pytestmark = pytest.mark.xdist_group("octree_gs")
STEPS = 24


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(points=150, width=48, height=36))
    return load_capture(folder, CaptureOptions(up="z"))


def short(config: OctreeConfig) -> OctreeConfig:
    """A few steps that grow and prune."""
    growth = replace(
        config.training.densify, every=6, stats_start=0, start=6, stop_fraction=0.8, min_draw_fraction=0.2,
        grad_threshold=2e-6, prune_opacity=0.2, prune_view_fraction=0.2,
    )  # fmt: skip
    return replace(config, training=replace(config.training, iterations=STEPS, densify=growth), progressive_share=0.4)


SCAFFOLD = short(scaffold_config(STEPS, seed=3))
OCTREE = replace(short(octree_config(STEPS, seed=3)), levels=3)


def problem_of(capture, config, images):
    cameras = [view.camera for view in capture.train_views]
    octree = fit_octree(capture.points, cameras, config)
    return octree, octree_problem(capture, config, octree, images, cameras)


def started(capture, problem, octree):
    return octree_state(capture.points, [view.camera for view in capture.train_views], problem, octree)


def run(state, problem, until=STEPS):
    train(state, problem, stop=lambda: state.iteration >= until, after_step=lambda *_: None)
    return state


def bits(state):
    return {name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()}


def test_one_level_is_plain_training_bit_for_bit(capture):
    unbounded = replace(SCAFFOLD, max_log_scale=100.0)  # but for the bound that follows each decision
    with open_training_images(capture, unbounded.training, 10**8) as images:
        octree, problem = problem_of(capture, unbounded, images)
        levels = run(started(capture, problem, octree), problem)
        anchors, _ = octree_starts(capture.points, [], octree, 10)
        plain = run(
            initial_state(anchors, random_decoder(problem), problem), replace(problem, select_rows=None, grow=None)
        )
    changed = bits(levels)
    assert set(changed) - set(bits(plain)) == {"octree.levels", "octree.bias"}
    assert all(changed[name] == value for name, value in bits(plain).items())
    assert len(levels.anchors) != len(anchors)
    assert not levels.levels.any()
    assert not levels.bias.any()


def test_scaffold_gs_differs_from_the_defaults_where_it_is_listed():
    published = scaffold_config(30_000).training
    changes = {line.split(":")[0] for line in diff_settings(to_dict(TrainConfig()), to_dict(published))}
    assert changes == {
        "iterations", "optimizer", "lr_offsets_unit", "model.bound_scales", "model.photograph_blur",
        "init.outlier_distance", "init.fill_gaps",
        "loss.background", "loss.random_background", "densify.start", "densify.stop_fraction",
    }  # fmt: skip
    rates = published.lr
    assert (rates.offsets, rates.features, rates.log_scales) == ((0.01, 1e-4), (0.0075, 0.0075), (0.007, 0.007))
    assert (rates.opacity, rates.covariance, rates.color) == ((0.002, 2e-5), (0.004, 0.004), (0.008, 5e-5))
    assert (published.loss.volume_reg, published.loss.ssim_lambda, published.densify.grad_threshold) == (
        0.01,
        0.2,
        2e-4,
    )
    growth = published.densify
    assert (growth.stats_start, growth.start, growth.every) == (500, 1501, 100)
    assert growth.stop_fraction * 30_000 == pytest.approx(14_999)
    assert scaffold_config(3_000).training.densify.start == 151
    assert octree_config(40_000).training.densify.stop_fraction * 40_000 == pytest.approx(24_999)


def test_a_stopped_and_continued_run_has_the_same_bits(capture, tmp_path):
    with open_training_images(capture, OCTREE.training, 10**8) as images:
        octree, problem = problem_of(capture, OCTREE, images)
        whole = run(started(capture, problem, octree), problem)
        state = run(started(capture, problem, octree), problem, until=13)
        save_checkpoint(tmp_path, to_checkpoint(state))
        saved, _ = load_latest_checkpoint(tmp_path)
        assert saved is not None
        continued = run(from_checkpoint(saved, problem, start_state), problem)
    assert bits(continued) == bits(whole)
    assert set(whole.levels.tolist()) == {0, 1}  # no camera is so near that it shows the finest
    assert whole.bias.any()


def test_the_volume_weight_is_of_the_unit_of_the_capture(capture):
    doubled = replace(capture, ground=replace(capture.ground, scale=2.0))  # its own unit is half as long
    for place, scale in ((capture, capture.ground.scale), (doubled, 2.0)):
        with open_training_images(place, SCAFFOLD.training, 10**8) as images:
            _, problem = problem_of(place, SCAFFOLD, images)
        weight = problem.config.loss.volume_reg / (problem.camera_height / REFERENCE_HEIGHT) ** 3
        assert weight == pytest.approx(0.01 / scale**3)


@pytest.mark.parametrize("config", [SCAFFOLD, OCTREE], ids=["scaffold-gs", "octree-gs"])
@pytest.mark.parametrize("scale", [0.25, 2.0])
def test_a_decision_bounds_sizes_in_the_unit_of_the_capture(capture, config, scale):
    """The three that Gaussians multiply; those that offsets multiply stay."""
    place = replace(capture, ground=replace(capture.ground, scale=scale))
    with open_training_images(place, config.training, 10**8) as images:
        octree, problem = problem_of(place, config, images)
    state = started(place, problem, octree)
    state.anchors.log_scales.fill_(3.0)
    assert problem.grow is not None
    problem.grow(state, problem)
    offsets, sizes = state.anchors.log_scales.split(3, dim=1)
    torch.testing.assert_close(sizes.exp(), torch.full_like(sizes, scale * np.exp(0.05)))
    assert torch.equal(offsets, torch.full_like(offsets, 3.0))


def test_levels_follow_the_distances_of_the_cameras(capture):
    cameras = [view.camera for view in capture.train_views]
    octree = fit_octree(capture.points, cameras, octree_config(100))
    reached = np.concatenate([np.linalg.norm(capture.points - camera.position, axis=1) for camera in cameras])
    assert octree.distance == pytest.approx(reached.max(), rel=0.05)
    assert octree.num_levels == round(np.log2(octree.distance / reached.min())) + 1
    nearer = replace_distance(octree, 4 * octree.distance)  # all is nearer by two levels
    places, finest = torch.from_numpy(capture.points).float(), nearer.num_levels + 1
    nearer = Octree(nearer.num_levels + 2, 1, nearer.voxel, nearer.distance)
    levels = torch.full((len(places),), finest, dtype=torch.int32)
    shown = [int(nearer.shown(places, levels - i, 0.0, cameras[0], finest + 1).sum()) for i in range(finest + 1)]
    assert shown == sorted(shown)
    assert shown[-1] == len(places)
    assert int(nearer.shown(places, levels, 9.0, cameras[0], finest + 1).sum()) == len(places)  # by their bias
    assert int(nearer.shown(places, levels, 9.0, cameras[0], finest).sum()) == 0  # its level is not open yet


def test_a_view_shows_the_nearest_level_to_what_its_distance_asks_for():
    octree = Octree(4, 1, 1.0, 8.0)
    camera = tiny_scene().cameras["frame_000.png"]
    asked = torch.tensor([0.4, 0.6, 1.4, 1.6, 9.0])  # nearer than the finest level's distance at the end
    places = torch.from_numpy(camera.position).float() + torch.outer(8 / 2**asked, torch.tensor([0.0, 0.0, 1.0]))

    def finest(octree: Octree, bias: float) -> list[int]:
        shown = [
            octree.shown(places, torch.full((5,), level, dtype=torch.int32), bias, camera, 4) for level in range(4)
        ]
        return (torch.stack(shown).sum(dim=0) - 1).tolist()

    assert finest(octree, 0.0) == [0, 1, 1, 2, 3]
    assert finest(octree, 0.2) == [1, 1, 2, 2, 3]
    assert finest(replace(octree, round_down=True), 0.0) == [0, 0, 1, 1, 3]


def replace_distance(octree: Octree, distance: float) -> Octree:
    return replace(octree, distance=distance)


def test_levels_open_one_after_another_each_faster():
    octree, config = Octree(6, 2, 1.0, 1.0), octree_config(1_000)
    opened = [octree.open_levels(iteration, config) for iteration in range(1_000)]
    assert opened == sorted(opened)
    assert (opened[0], opened[-1]) == (3, 6)
    times = [opened.count(levels) for levels in (3, 4, 5)]
    assert sum(times) == pytest.approx(250, abs=2)
    assert times == sorted(times, reverse=True)
    assert Octree(1, 0, 1.0, 1.0).open_levels(0, config) == 1


def test_growth_makes_anchors_of_the_same_level_or_of_the_next():
    octree, config = Octree(3, 1, 4.0, 1e9), octree_config(1_000)
    threshold = config.training.densify.grad_threshold
    positions = torch.tensor([[0.0, 0, 0], [40.0, 0, 0], [80.0, 0, 0]])
    anchors = Anchors(positions, torch.ones(3, 32), torch.full((3, 2, 3), 0.3), torch.full((3, 6), 3.0))
    levels, gradient = torch.tensor([0, 0, 2], dtype=torch.int32), torch.zeros(3, 2)
    gradient[0, 0], gradient[1, 0], gradient[2, 0] = 1.05 * threshold, 9 * threshold, 9 * threshold
    cameras = [tiny_scene().cameras["frame_000.png"]]
    added, of = grow_levels(anchors, levels, gradient, octree, config, cameras, deepen=True)
    assert of.tolist() == [0, 1]  # the finest level has no next: above that threshold it grows nothing (program)
    assert added.features[:, 0].tolist() == [1.0, 0.0]
    assert torch.allclose(added.log_scales[:, 0].exp(), torch.tensor([4.0, 2.0]))
    assert torch.equal(
        (added.positions / torch.tensor([[4.0], [2.0]])).round() * torch.tensor([[4.0], [2.0]]), added.positions
    )
    _, shallow = grow_levels(anchors, levels, gradient, octree, config, cameras, deepen=False)
    assert shallow.tolist() == [0]
    everything = anchors.concat(added), torch.cat([levels, of]), torch.cat([gradient, torch.zeros(2, 2)])
    again, _ = grow_levels(*everything, octree, config, cameras, deepen=True)
    assert len(again) == 0  # the cells are taken


def test_a_run_is_measured_and_its_model_is_read_as_it_was(capture, tmp_path):
    run_ = RunFolder(tmp_path)
    figures = run_octree(run_, capture, OCTREE, Console(quiet=True))
    assert figures["model"] == "octree"
    assert figures["n_anchors"] > 0
    assert figures["psnr"] > 5
    model, camera = OctreeModel.load(tmp_path / "octree"), capture.test_views[0].camera
    assert figures["n_anchors"] == len(model.levels)
    model.save(tmp_path)
    assert torch.equal(OctreeModel.load(tmp_path).render(camera).image, model.render(camera).image)
    assert len(model.rows(camera, 0)) < len(model.rows(camera, 1)) <= len(model.rows(camera))
    flat = OctreeModel(model.anchors, torch.zeros_like(model.levels), model.bias, (Octree(1, 0, 1.0, 1.0),))
    assert torch.equal(flat.render(camera).image, render(model.anchors, camera).image)
