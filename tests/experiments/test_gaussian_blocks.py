"""Explicit Gaussians in blocks: CityGaussian, VastGaussian and DOGS, by their laws."""

import io
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from experiments.baselines.citygaussian.training import fine_tuning, train_citygaussian
from experiments.baselines.dogs.training import train_dogs
from experiments.baselines.gaussian_blocks.cut import GaussianCut, cut_by_removal, cut_points, merge_cells
from experiments.baselines.gaussian_blocks.training import BlockScene, GaussianBlocksConfig, train_scene
from experiments.baselines.gs3d import schedule
from experiments.baselines.gs3d import session as gaussian_session
from experiments.baselines.gs3d.model import GaussianModel, initialize_gaussians
from experiments.baselines.gs3d.run import train_gs3d
from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig
from experiments.baselines.vastgaussian.appearance import AppearanceLoss, appearance_map, initial_appearance
from experiments.baselines.vastgaussian.training import train_vastgaussian
from support.captures import tiny_scene, write_colmap
from support.checkerboard import Photographs
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import Stopped
from vdgs.kernels import get_backend
from vdgs.runs.stage_folder import StageFolder

pytestmark = [pytest.mark.xdist_group("gaussian_blocks"), pytest.mark.slow]
QUIET = Console(quiet=True)
PLAIN_VASTGAUSSIAN = partial(train_vastgaussian, appearance=False)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return load_capture(folder, CaptureOptions(up="z"))


def config(blocks: int, iterations: int, coarse: int = 8) -> GaussianBlocksConfig:
    return GaussianBlocksConfig(
        blocks=blocks, iterations=iterations, scene=scale_schedule(coarse, Gs3dConfig(background="mean"))
    )


def bits(gaussians) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in gaussians.tensors().items()}


def blocks_of(folder: Path) -> list[Path]:
    return sorted((folder / "blocks").iterdir())


def plane(n: int = 200):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-4, 4, (n, 2)), np.zeros((n, 1))], axis=1)
    return points, initialize_gaussians(points, np.full((n, 3), 128, np.uint8), 0.5, 1)


@pytest.fixture
def often(monkeypatch) -> None:
    """Decisions about density every four steps: several in a few dozen."""
    monkeypatch.setattr(schedule, "MIN_INTERVAL", 4)


@pytest.mark.parametrize("method", [PLAIN_VASTGAUSSIAN, train_dogs], ids=["vastgaussian", "dogs"])
def test_one_block_is_3dgs_growth_included(capture, tmp_path, often, method):
    published = scale_schedule(30, Gs3dConfig(background="mean"))
    scene = GaussianBlocksConfig(blocks=1, iterations=30, scene=published)
    one = train_scene(capture, scene, StageFolder(tmp_path / "one"), method, QUIET)
    alone = train_gs3d(capture, published, tmp_path / "alone", QUIET)
    assert len(alone.gaussians) > 1.2 * len(capture.points)
    assert bits(one.gaussians) == bits(alone.gaussians)
    assert one.background == alone.background
    assert StageFolder(tmp_path / "one").status().iteration == 30


@pytest.mark.parametrize(
    "method", [PLAIN_VASTGAUSSIAN, train_citygaussian, train_dogs], ids=["vastgaussian", "citygaussian", "dogs"]
)
def test_blocks_grow_to_their_share_of_the_scenes_limit(capture, tmp_path, often, monkeypatch, method):
    """A block's share is that of its cell; what else it holds comes on top. All ask for growth, none goes."""
    most, limits, begun = len(capture.points) + 20, list[int](), list[int]()
    configure = BlockScene.block_config

    def noting(scene: BlockScene, own: int, total: int, held: int) -> Gs3dConfig:
        limits.append(most * own // total + held - own)
        begun.append(held)
        config = configure(scene, own, total, held)
        eager = replace(config.density, threshold=1e-9, prune_opacity=0.0, prune_size=1e9)
        return replace(config, density=eager)

    monkeypatch.setattr(BlockScene, "block_config", noting)
    published = scale_schedule(4, Gs3dConfig(background="mean"), most)
    scene = GaussianBlocksConfig(blocks=2, iterations=30, scene=published)
    train_scene(capture, scene, StageFolder(tmp_path), method, QUIET)
    grown = [len(GaussianModel.load(folder / "model.safetensors").gaussians) for folder in blocks_of(tmp_path)]
    assert len(grown) == 2
    assert grown == limits
    assert all(after > before for after, before in zip(grown, begun, strict=True))


def test_citygaussian_goes_on_with_the_whole_scene_and_keeps_cells(capture, tmp_path):
    folder = StageFolder(tmp_path)
    model = train_scene(capture, config(2, 6), folder, train_citygaussian, QUIET)
    coarse = GaussianModel.load(tmp_path / "coarse" / "model.safetensors").gaussians
    cut = GaussianCut.load(tmp_path)
    assert cut is not None
    parts = [GaussianModel.load(tmp_path / "blocks" / f"0{index}" / "model.safetensors").gaussians for index in (0, 1)]
    assert [len(part) for part in parts] == [len(coarse)] * 2  # no growth in so few steps
    assert bits(merge_cells(cut.blocks, parts)) == bits(model.gaussians)
    assert not torch.equal(parts[0].means, coarse.means)
    status = folder.status()
    assert (status.state, status.iteration) == ("done", 8 + 2 * 6)
    again = io.StringIO()
    train_scene(capture, config(2, 6), folder, train_citygaussian, Console(file=again))
    assert "nothing to do" in again.getvalue()


def test_citygaussian_takes_smaller_steps_at_full_size():
    rates, published = fine_tuning(scale_schedule(3_000)).rates, Gs3dConfig().rates
    assert rates.means == pytest.approx((6.4e-5, 6.4e-7))
    assert rates.log_scales == pytest.approx(0.004)
    assert (rates.opacity_logits, rates.sh0) == (published.opacity_logits, published.sh0)


def test_cameras_join_by_what_a_block_changes_and_cells_have_one_owner():
    _, gaussians = plane()
    cameras = Photographs().cameras
    cut = cut_by_removal("citygaussian", gaussians, cameras, 2, 32)
    assert len(cut.blocks) == 2
    assert all(cut.views)
    whole = merge_cells(cut.blocks, [gaussians, gaussians])
    assert sorted(map(tuple, whole.means.tolist())) == sorted(map(tuple, gaussians.means.tolist()))


def test_cuts_are_saved(tmp_path):
    points, _ = plane()
    cut = cut_points("vastgaussian", points, Photographs().cameras, 4)
    cut.save(tmp_path)
    again = GaussianCut.load(tmp_path)
    assert again is not None
    assert again.views == cut.views
    np.testing.assert_array_equal(again.blocks.owner(points[:, :2]), cut.blocks.owner(points[:, :2]))


def test_appearance_begins_as_the_identity_and_learns_a_darker_photograph():
    extra = initial_appearance(2, 0)
    image = torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    target = (image.detach() * 255).to(torch.uint8)
    assert torch.equal(appearance_map(image, 1, extra), torch.ones(16, 20, 3))
    loss = AppearanceLoss(0.2, rate=0.02)
    plain = get_backend(image.device).photometric_loss(image, target, None, ssim_weight=0.2)
    first = loss(image, target, None, 1, extra)
    torch.testing.assert_close(first.loss, plain.loss)
    (by_image,) = torch.autograd.grad(plain.loss, [image])
    torch.testing.assert_close(torch.autograd.grad(first.loss, [image])[0], by_image)
    dark = (image.detach() * 128).to(torch.uint8)
    for step in range(1, 13):
        fitted = [tensor.requires_grad_() for tensor in loss.trained(extra)]
        value = loss(image, dark, None, 1, extra)
        gradients = torch.autograd.grad(value.loss, fitted, materialize_grads=True)
        loss.move(extra, gradients, step)
    assert float(value.l1) < 0.5 * float(loss(image, dark, None, 1, initial_appearance(2, 0)).l1)


def test_appearance_explains_colors_and_never_structure():
    """A map of 2 sigmoid(-1) everywhere: L1 is of the picture times the map, SSIM of the picture itself."""
    extra = initial_appearance(1, 0)
    extra[f"weight.b{max(int(name[8:]) for name in extra if name.startswith('weight.b'))}"].fill_(-1.0)
    image = torch.rand(16, 20, 3, generator=torch.Generator().manual_seed(0))
    target = (image * 137).to(torch.uint8)
    found = AppearanceLoss(0.2)(image, target, None, 0, extra)
    colors = (image * 2 / (1 + np.exp(1)) - target / 255).abs().mean()
    structure = get_backend(image.device).photometric_loss(image, target, None, ssim_weight=1.0)
    torch.testing.assert_close(found.l1, colors)
    torch.testing.assert_close(found.ssim, structure.ssim)
    torch.testing.assert_close(found.loss, 0.8 * colors + 0.2 * (1 - structure.ssim))


def test_a_stopped_scene_continues_with_its_appearance(capture, tmp_path, monkeypatch):
    train = gaussian_session.train

    def stopped(state, problem, *, stop, after_step):
        return train(state, problem, stop=lambda: state.iteration >= 2, after_step=after_step)

    whole = train_scene(capture, config(1, 4), StageFolder(tmp_path / "whole"), train_vastgaussian, QUIET)
    with monkeypatch.context() as patched:
        patched.setattr(gaussian_session, "train", stopped)
        with pytest.raises(Stopped, match="2"):
            train_scene(capture, config(1, 4), StageFolder(tmp_path / "half"), train_vastgaussian, QUIET)
    again = train_scene(capture, config(1, 4), StageFolder(tmp_path / "half"), train_vastgaussian, QUIET)
    assert bits(again.gaussians) == bits(whole.gaussians)
