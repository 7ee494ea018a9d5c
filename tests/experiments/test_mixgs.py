"""MixGS: its hash encoding, its mix, its two parts of training, stopped and continued."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from experiments.baselines.gs3d.model import GaussianModel
from experiments.baselines.gs3d.run import train_gs3d
from experiments.baselines.gs3d.training import Gs3dProblem, from_checkpoint, scene_extent, to_checkpoint
from experiments.baselines.mixgs.model import MixModel, MixScene, decode_details, encode_places, mix_scene
from experiments.baselines.mixgs.run import run_mixgs
from experiments.baselines.mixgs.settings import mix_config
from experiments.baselines.mixgs.training import MixProblem, mixed_state, network_of, train_mixed
from support.captures import tiny_scene, write_colmap
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.runs.run_folder import RunFolder
from vdgs.system.checkpoints import load_latest_checkpoint, save_checkpoint

pytestmark = pytest.mark.xdist_group("octree_gs")
QUIET = Console(quiet=True)
CONFIG = replace(mix_config(30, seed=2), num_levels=4, width=16)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(points=150, width=48, height=36))
    return load_capture(folder, CaptureOptions(up="z"))


@pytest.fixture(scope="module")
def coarse(capture, tmp_path_factory):
    return train_gs3d(capture, CONFIG.coarse, tmp_path_factory.mktemp("coarse"), QUIET).gaussians


def run(capture, coarse, state, scene, until):
    with ImageCache(capture.train_views, 10**8) as images:
        extent = scene_extent([view.camera for view in capture.train_views])
        base = Gs3dProblem(replace(CONFIG.coarse, iterations=20), images, len(capture.train_views), extent)
        problem = MixProblem(base, CONFIG, scene)
        train_mixed(state, problem, stop=lambda: state.iteration >= until, after_step=lambda *_: None)
    return state


def bits(state):
    return {name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()}


def test_the_encoding_is_the_tables_at_grid_corners_and_linear_between_them():
    scene = MixScene(low=(0.0, 0.0, 0.0), size=8.0, scale_unit=1.0, resolutions=(8.0,), min_scale=0.01)
    table = torch.rand(2**16, 2, generator=torch.Generator().manual_seed(0))  # so large that corners do not collide
    corner = encode_places(torch.tensor([[2.0, 0, 0]]), table, scene)
    assert torch.equal(corner, table[2:3])
    ends = encode_places(torch.tensor([[2.0, 5, 3], [3.0, 5, 3]]), table, scene)
    between = encode_places(torch.tensor([[2.25, 5, 3]]), table, scene)
    assert torch.allclose(between, 0.75 * ends[:1] + 0.25 * ends[1:])
    table.requires_grad_()
    encode_places(torch.tensor([[2.25, 5, 3]]), table, scene).sum().backward()
    assert table.grad.sum() == pytest.approx(2.0)  # of each feature the weights of eight corners


def test_details_follow_the_networks_formula(capture, coarse):
    """Written out in other words, with a network and offsets that are far from where they begin."""
    state, scene = mixed_state(coarse, replace(CONFIG, min_opacity=0.0))
    generator, camera = torch.Generator().manual_seed(0), capture.test_views[0].camera
    random = lambda shape: torch.randn(shape, generator=generator)  # noqa: E731
    network = {name: random(tensor.shape) for name, tensor in network_of(state).items()}
    offsets = random(coarse.means.shape)
    details, colors, opacities = decode_details(coarse, offsets, network, scene, camera)
    layer = lambda name, x: x @ network[f"{name}.w"].T + network[f"{name}.b"]  # noqa: E731
    turned, sizes = torch.nn.functional.normalize(coarse.quaternions), coarse.log_scales.exp() / scene.scale_unit
    pose = torch.from_numpy((camera.camera_from_world[:3, 3] / scene.size).astype(np.float32)).repeat(len(coarse), 1)
    gate = torch.tanh(layer("pose", torch.cat([pose, sizes, turned], dim=1)).clamp(min=0) / 2)  # 2 sigmoid(x) - 1
    hidden = layer("hidden", gate * layer("place", encode_places(coarse.means, network["table"], scene))).clamp(min=0)
    torch.testing.assert_close(details.means, coarse.means + offsets)
    torch.testing.assert_close(
        details.quaternions, torch.nn.functional.normalize(turned + layer("rotation", hidden)), rtol=1e-3, atol=1e-4
    )
    decoded = layer("scale", hidden).clamp(min=0.01) * scene.scale_unit
    torch.testing.assert_close(details.log_scales.exp(), decoded, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(colors, 1 / (1 + (-layer("color", hidden)).exp()), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(opacities, layer("opacity", hidden)[:, 0].sigmoid(), rtol=1e-3, atol=1e-4)


def test_details_without_opacity_leave_the_coarse_scene(capture, coarse):
    state, scene = mixed_state(coarse, replace(CONFIG, min_opacity=0.0))
    network = network_of(state)
    network["opacity.w"], network["opacity.b"] = torch.zeros(1, 16), torch.full((1,), -60.0)
    model = MixModel(
        gaussians=coarse, offsets=state.extra["offsets"], network=network, scene=scene, background=(0.0, 0.0, 0.0),
        metadata={},
    )  # fmt: skip
    camera = capture.test_views[0].camera
    alone = GaussianModel(coarse, (0.0, 0.0, 0.0), {}).render(camera).image
    assert torch.allclose(model.render(camera).image, alone, atol=1e-6)
    shown = replace(model, network=network | {"opacity.b": torch.zeros(1)})
    assert not torch.allclose(shown.render(camera).image, alone, atol=1e-2)


def test_the_decoder_is_trained_first_and_then_both(capture, coarse, tmp_path):
    state, scene = mixed_state(coarse, CONFIG)
    before = {name: tensor.clone() for name, tensor in state.gaussians.tensors().items()}
    first = CONFIG.frozen_iterations
    assert 0 < first < CONFIG.iterations == 20
    assert scene == mix_scene(state.gaussians, CONFIG)
    run(capture, coarse, state, scene, first)
    assert all(torch.equal(tensor, before[name]) for name, tensor in state.gaussians.tensors().items())
    assert state.extra["offsets"].any()
    assert state.extra["first.network.color.w"].any()
    save_checkpoint(tmp_path, to_checkpoint(state))
    whole = bits(run(capture, coarse, state, scene, 20))
    assert not torch.equal(state.gaussians.means, before["means"])
    saved, _ = load_latest_checkpoint(tmp_path)
    assert saved is not None
    assert bits(run(capture, coarse, from_checkpoint(saved), scene, 20)) == whole


def test_a_run_is_measured_and_its_model_is_read_as_it_was(capture, tmp_path):
    figures = run_mixgs(RunFolder(tmp_path), capture, CONFIG, QUIET)
    model = MixModel.load(tmp_path / "mixgs" / "model.safetensors")
    assert figures["model"] == "mixgs"
    assert figures["n_gaussians"] == 2 * len(model.gaussians) > 0
    model.save(tmp_path / "again.safetensors")
    camera = capture.test_views[0].camera
    assert torch.equal(MixModel.load(tmp_path / "again.safetensors").render(camera).image, model.render(camera).image)
    assert run_mixgs(RunFolder(tmp_path), capture, CONFIG, QUIET)["psnr"] == figures["psnr"]  # only read
