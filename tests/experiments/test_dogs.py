"""DOGS: equal blocks stay equal, blocks agree on the mean, and a stop changes nothing (one block is 3DGS:
test_gaussian_blocks.py)."""

import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch
from rich.console import Console

from experiments.baselines import turns
from experiments.baselines.dogs.consensus import Consensus, ConsensusConfig, find_members, mean_gaussians
from experiments.baselines.dogs.cut import cut_dogs
from experiments.baselines.dogs.training import DogsTraining, begin_consensus, restore, train_dogs
from experiments.baselines.gaussian_blocks.cut import GaussianCut
from experiments.baselines.gaussian_blocks.training import GaussianBlocksConfig, train_scene
from experiments.baselines.gs3d.model import initialize_gaussians
from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dProblem, Gs3dState, initial_state, scene_extent
from support.captures import tiny_scene, write_colmap
from support.checkerboard import Photographs
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import Stopped
from vdgs.model.gaussians import Gaussians
from vdgs.partition.blocks import Block, Blocks
from vdgs.runs.stage_folder import StageFolder
from vdgs.training.session.training_session import run_session

QUIET = Console(quiet=True)
CONFIG = Gs3dConfig(iterations=14, resolution_schedule=((0, 2),), degree=1)
#: Cells that meet at x = 0 and share what lies within 1 of it.
BLOCKS = Blocks(
    (
        Block(shapely.box(-4, -4, 0, 4), shapely.box(-5, -5, 1, 5)),
        Block(shapely.box(0, -4, 4, 4), shapely.box(-1, -5, 5, 5)),
    )
)


def plane() -> Gaussians:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-4, 4, (150, 2)), np.zeros((150, 1))], axis=1)
    return initialize_gaussians(points, np.full((150, 3), 128, np.uint8), 0.5, 1)


def grown(views: tuple[tuple[int, ...], ...], blocks: Blocks = BLOCKS) -> DogsTraining:
    """Two blocks that begin with consensus after 4 of 14 steps."""
    photographs, states = Photographs(), dict[int, Gs3dState]()
    for index in range(len(views)):
        states[index] = initial_state(plane())
        states[index].iteration = 4
    problems = [Gs3dProblem(CONFIG, photographs, len(each), scene_extent(photographs.cameras)) for each in views]
    return begin_consensus(GaussianCut(blocks, views), states, {}, problems)


def finish(training: DogsTraining, steps: int = 10_000) -> DogsTraining:
    while training.iteration < steps and training.advance() is not None:
        pass
    return training


def bits(gaussians: Gaussians) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in gaussians.tensors().items()}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return load_capture(folder, CaptureOptions(up="z"))


def test_cameras_train_the_points_of_their_place_in_the_grid():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-40, 40, 900), rng.uniform(-10, 10, 900), np.zeros(900)])
    looks_down = Photographs().cameras[0].camera_from_world
    cameras = []
    for x, y in rng.uniform((-40, -10), (40, 10), (60, 2)):
        pose = looks_down.copy()
        pose[:3, 3] = -pose[:3, :3] @ (x, y, 10.0)
        cameras.append(replace(Photographs().cameras[0], camera_from_world=pose))
    cut = cut_dogs(points, cameras, 4)
    assert len(cut.blocks) == 4
    assert set().union(*cut.views) == set(range(60))
    for block, views in zip(cut.blocks.items, cut.views, strict=True):
        x, y = np.array([cameras[view].position[:2] for view in views]).T
        assert shapely.contains_xy(block.expanded, x, y).mean() > 0.8
        assert len(views) < 30
    shares = np.bincount(cut.blocks.owner(points[:, :2])) / len(points)
    assert shares.min() > 0.15


def test_a_scene_that_is_stopped_while_blocks_agree_continues(capture, tmp_path, monkeypatch):
    config = GaussianBlocksConfig(blocks=2, iterations=10, scene=scale_schedule(10, Gs3dConfig()))
    whole = train_scene(capture, config, StageFolder(tmp_path / "whole"), train_dogs, QUIET)
    with monkeypatch.context() as patched:
        patched.setattr(
            turns, "run_session",
            lambda session, loop: run_session(session, lambda _: loop(lambda: session.state.iteration >= 15)),
        )  # fmt: skip
        with pytest.raises(Stopped, match="15"):
            train_scene(capture, config, StageFolder(tmp_path / "half"), train_dogs, QUIET)
    again = train_scene(capture, config, StageFolder(tmp_path / "half"), train_dogs, QUIET)
    assert bits(again.gaussians) == bits(whole.gaussians)
    lines = [json.loads(line) for line in (tmp_path / "half" / "consensus" / "log.jsonl").read_text().splitlines()]
    assert [line["of_block"] for line in lines] == [6, 6, 7, 7, 8, 8, 9, 9, 10, 10]
    assert lines[-1]["residuals"].keys() == whole.gaussians.tensors().keys()
    assert StageFolder(tmp_path / "half").status().iteration == 20


def test_equal_blocks_stay_equal():
    both = Block(shapely.box(-4, -4, 4, 4), shapely.box(-5, -5, 5, 5))
    training = grown(((0, 1, 2), (0, 1, 2)), Blocks((both, both)))
    finish(training)
    first, second = (state.gaussians for state in training.states)
    assert bits(first) == bits(second)
    for name, tensor in training.consensus.gaussians.tensors().items():
        torch.testing.assert_close(tensor, first.tensors()[name])
    assert all(not tensor.any() for duals in training.consensus.duals for tensor in duals.values())


def test_blocks_agree_on_what_they_share_and_keep_the_rest():
    training = finish(grown(((0, 1, 2, 3), (4, 5, 6, 7))))
    scene = training.consensus.gaussians
    assert len(scene) == 150
    for state, each in zip(training.states, training.consensus.members, strict=True):
        alone = torch.ones(len(each.rows), dtype=torch.bool).index_fill_(0, each.shared, False)
        assert torch.equal(scene.means[each.rows[alone]], state.gaussians.means[alone])
        assert 10 < len(each.shared) < 0.5 * len(each.rows)
    copies = [
        state.gaussians.sh0[torch.isin(each.rows, training.consensus.members[1 - k].rows)]
        for k, (state, each) in enumerate(zip(training.states, training.consensus.members, strict=True))
    ]
    shared = torch.isin(torch.arange(150), training.consensus.members[0].rows) & torch.isin(
        torch.arange(150), training.consensus.members[1].rows
    )
    torch.testing.assert_close(scene.sh0[shared], (copies[0] + copies[1]) / 2)


def test_a_step_pulls_what_is_shared_to_the_global_gaussians():
    """First moments, a tenth of the gradients after one step: rho (x - z) more than without, where z is 0.1 away."""
    pulled, alone = (grown(((0, 1, 2, 3), (4, 5, 6, 7))) for _ in range(2))
    alone._problems = [replace(each, pull=None) for each in alone._problems]
    agreed, shared = pulled.consensus, pulled.consensus.members[0].shared
    agreed.gaussians = Gaussians(**{name: tensor - 0.1 for name, tensor in agreed.gaussians.tensors().items()})
    pulled.step(0)
    alone.step(0)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh0"):
        expected = alone.states[0].moments.first[name].clone()
        expected[shared] += 0.1 * agreed.rho[name] * 0.1
        torch.testing.assert_close(pulled.states[0].moments.first[name], expected, rtol=1e-4, atol=1e-8)
        assert agreed.rho[name] > 1e-3


def test_consensus_finds_the_minimum_of_the_sum():
    """Of (x - 1)² / 2 and (x - 3)² / 2 for everything: 2, whatever the blocks begin with."""
    scene = plane()
    scene = Gaussians(**{name: torch.zeros_like(tensor) for name, tensor in scene.tensors().items()})
    every = torch.ones(len(scene), dtype=torch.bool)
    consensus = Consensus.begin(scene, find_members([every, every]), ConsensusConfig(over_relaxation=0.0))
    consensus.rho = consensus.first_rho = dict.fromkeys(scene.tensors(), 1.0)
    for _ in range(30):
        copies = []
        for index, target in enumerate((1.0, 3.0)):
            z, u = consensus.gaussians.tensors(), consensus.duals[index]
            copies.append(Gaussians(**{name: (target + z[name] - u[name]) / 2 for name in z}))
            pulled = consensus.pull(index, copies[-1])
            assert torch.allclose(pulled["sh0"], target - copies[-1].sh0, atol=1e-5)
        consensus.step(copies, adapt=False)
    for tensor in consensus.gaussians.tensors().values():
        torch.testing.assert_close(tensor, torch.full_like(tensor, 2.0), atol=1e-3, rtol=0)


def test_penalties_follow_the_residuals():
    scene = plane()
    every = torch.ones(len(scene), dtype=torch.bool)
    consensus = Consensus.begin(scene, find_members([every, every]), ConsensusConfig())
    before = dict(consensus.rho)
    apart = [replace(scene, sh0=scene.sh0 + shift) for shift in (1.0, -1.0)]
    moved = [replace(each, means=scene.means + 1.0) for each in apart]
    consensus.step(moved, adapt=True)
    assert consensus.rho["sh0"] == 2 * before["sh0"]  # copies disagree, the mean rests
    assert consensus.rho["means"] == before["means"] / 2  # they agree, and run away together
    assert consensus.rho["quaternions"] == before["quaternions"]
    torch.testing.assert_close(consensus.duals[0]["sh0"], torch.full_like(scene.sh0, 1.5 / 2))


def test_the_mean_leaves_alone_what_no_block_holds():
    scene = plane()
    west = scene.means[:, 0] < 0
    moved = scene.select(west)
    moved = replace(moved, means=moved.means + 1)
    mean = mean_gaussians(scene, [moved], find_members([west]))
    assert torch.equal(mean.means[~west], scene.means[~west])
    assert torch.equal(mean.means[west], scene.means[west] + 1)


def test_a_stop_changes_nothing():
    views = ((0, 1, 2, 3), (4, 5, 6, 7))
    whole = finish(grown(views))
    half = finish(grown(views), steps=8 + 11)
    problems = [replace(each, pull=None) for each in half._problems]
    again = finish(restore(half.to_checkpoint(), problems))
    assert bits(again.consensus.gaussians) == bits(whole.consensus.gaussians)
    assert again.consensus.rho == whole.consensus.rho
