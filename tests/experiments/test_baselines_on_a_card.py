"""Every other method of the bench on a card that is not there: nothing mixes devices, and all is drawn on the card."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from experiments.baselines.gs3d.density import DensityConfig
from experiments.baselines.momentum_gs.blocks import MomentumTraining
from experiments.baselines.momentum_gs.guidance import MomentumConfig
from experiments.bench.baseline_stages import BASELINES
from support.block_training import CONFIG, block_stage, coarse
from support.captures import tiny_scene, write_colmap
from support.fake_device import CARD, pretended_card
from vdgs import kernels
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import BlockConfig, CompensationConfig, MethodConfig, PartitionConfig, TrainConfig
from vdgs.kernels import torch_ref
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.torch_ref import adam
from vdgs.runs.run_folder import RunFolder
from vdgs.training import FrozenAnchors, initial_state

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("octree_gs")]
METHOD = MethodConfig(
    training=TrainConfig(iterations=4), partition=PartitionConfig(blocks=2), block=BlockConfig(iterations=4)
)
#: Decisions fall into a few steps, and everything asks for growth.
BUSY = DensityConfig(interval=2, start=1, until=1.0, threshold=1e-9, reset_interval=4, dense=0.001)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(columns=3, rows=2, points=60, width=24, height=18))
    return load_capture(folder, CaptureOptions(up="z"))


def busy(settings):
    """The settings of a method with growth in its few steps."""
    if hasattr(settings, "density"):
        return replace(settings, density=BUSY)
    if hasattr(settings, "levels"):
        growth = replace(
            settings.training.densify, every=2, stats_start=0, start=2, stop_fraction=0.9, min_draw_fraction=0.1,
            grad_threshold=1e-9,
        )  # fmt: skip
        return replace(settings, training=replace(settings.training, densify=growth), levels=settings.levels or 2)
    parts = {name: busy(getattr(settings, name)) for name in ("coarse", "octree", "scene") if hasattr(settings, name)}
    return replace(settings, **parts)


@pytest.fixture(autouse=True)
def kernels_of_a_card(monkeypatch) -> None:
    monkeypatch.setenv(kernels.KERNELS_ENV_VAR, "torch_ref")
    adam.bias_correction_tables.cache_clear()  # kept for a card, and each test has its own


@pytest.fixture
def drawn(monkeypatch) -> set[str]:
    """The devices that something is drawn on."""
    devices, draw = set[str](), torch_ref.rasterize

    def watched(splats: Splats, *rest: Any, **named: Any) -> Raster:
        devices.add(splats.means_px.device.type)
        return draw(splats, *rest, **named)

    monkeypatch.setattr(torch_ref, "rasterize", watched)
    return devices


def test_blocks_of_momentum_gs_train_on_the_card():
    """They are one stage of a run: its others, which are the package's own, have tests of their own."""
    growth = replace(CONFIG.densify, every=2, start=2)
    settings = replace(CONFIG, iterations=2, densify=growth, compensation=CompensationConfig(enabled=False))
    with pretended_card():
        problems, states, decoder = [], [], coarse()[1].to(CARD)
        for index in range(2):
            problem, state = block_stage(BlockConfig(), index, settings)
            around = problem.frozen_anchors
            assert around is not None
            around = FrozenAnchors(around.anchors.to(CARD), decoder)
            problem = replace(problem, frozen_decoder=False, kind="block", device=CARD, frozen_anchors=around)
            problems.append(problem)
            states.append(initial_state(state.anchors.to(CARD), decoder, problem))
        before = [len(state.anchors) for state in states]
        training = MomentumTraining(states, problems, MomentumConfig())
        while training.advance() is not None:
            pass
        assert {state.anchors.positions.device.type for state in training.states} == {"cuda"}
        assert all(len(state.anchors) > n for state, n in zip(training.states, before, strict=True))


@pytest.mark.parametrize("name", BASELINES)
def test_a_method_trains_and_is_measured_on_the_card(name, capture, tmp_path, drawn):
    baseline = BASELINES[name]
    with pretended_card():
        baseline.run(
            RunFolder(tmp_path), capture, busy(baseline.settings(METHOD)), Console(quiet=True), lpips_weights=None,
            device="cuda",
        )  # fmt: skip
    assert (tmp_path / "evaluation" / "metrics.json").exists()
    assert drawn == {"cuda"}
