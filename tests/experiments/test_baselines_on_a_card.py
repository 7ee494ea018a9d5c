"""Every other method of the bench on a card that is not there: nothing mixes devices, and all is drawn on the card."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from experiments.baselines.gs3d.density import DensityConfig
from experiments.bench.baseline_stages import BASELINES
from support.captures import tiny_scene, write_colmap
from support.fake_device import pretended_card
from vdgs import kernels
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import BlockConfig, MethodConfig, PartitionConfig, TrainConfig
from vdgs.kernels import torch_ref
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.torch_ref import adam
from vdgs.runs.run_folder import RunFolder

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


@pytest.mark.parametrize("name", BASELINES)
def test_a_method_trains_and_is_measured_on_the_card(name, capture, tmp_path, monkeypatch):
    monkeypatch.setenv(kernels.KERNELS_ENV_VAR, "torch_ref")
    adam.bias_correction_tables.cache_clear()  # kept for a card, and each test has its own
    drawn, draw, baseline = set[str](), torch_ref.rasterize, BASELINES[name]

    def watched(splats: Splats, *rest: Any, **named: Any) -> Raster:
        drawn.add(splats.means_px.device.type)
        return draw(splats, *rest, **named)

    monkeypatch.setattr(torch_ref, "rasterize", watched)
    with pretended_card():
        baseline.run(
            RunFolder(tmp_path), capture, busy(baseline.settings(METHOD)), Console(quiet=True), lpips_weights=None,
            device="cuda",
        )  # fmt: skip
    assert (tmp_path / "evaluation" / "metrics.json").exists()
    assert drawn == {"cuda"}
