"""The whole pipeline on a card that is not there, by the composed set of operations: `--device cuda`, from photographs
to pictures and files, beside the same by the native set. Own kernels run their own text on the processor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from support.cuda_on_host import host_compiler, needs_nvrtc
from support.fake_device import pretended_card
from support.fake_gsplat import needs_gsplat
from support.gpu_on_host import build, install
from support.small_pipeline import COARSE, MERGED, after_the_coarse_stage, psnr, train_coarse, vdgs
from vdgs.kernels import device_selection
from vdgs.runs.open_run import open_run
from vdgs.viewer.layers import DisplayOptions, Layer, Painter
from vdgs.viewer.viewer_scene import ViewerScene

pytestmark = [
    pytest.mark.slow,
    needs_nvrtc, needs_gsplat, pytest.mark.xdist_group("composition"),
    pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler"),
]  # fmt: skip


@pytest.fixture(scope="module")
def runs(native_small, tmp_path_factory, compiled_code) -> tuple[Path, Path]:
    """By the native set, and on the card."""
    folder = tmp_path_factory.mktemp("composed")
    drivers = build(compiled_code)
    card = folder / "card"
    with pytest.MonkeyPatch.context() as patch:
        install(drivers, compiled_code, patch, "cuda", "cuda")
        patch.setattr(device_selection, "_no_card", lambda index: "")
        with pretended_card():
            train_coarse(native_small.capture, card, "--device", "cuda")
            after_the_coarse_stage(card, "--device", "cuda")
            vdgs("render", card, "--mode", "depth", "--output", folder / "depth", "--device", "cuda")
            vdgs("ortho", card, "--device", "cuda")
            vdgs("lod", card)
            painted = paint_layers(card, "cuda")
            vdgs("export", card, "--output", folder / "scene.ply", "--color-iterations", "1", "--device", "cuda")
    for layer, image in paint_layers(card, "cpu").items():
        np.testing.assert_allclose(painted[layer].mean(axis=(0, 1)), image.mean(axis=(0, 1)), atol=4, err_msg=layer)
    return native_small.whole, card


def paint_layers(run: Path, device: str) -> dict[str, np.ndarray]:
    """What the viewer shows of a run with a tree, by layer."""
    scene = ViewerScene(open_run(run, "merged", device), lambda name: open_run(run, name, device))
    painter, camera = Painter(scene), scene.capture.train_views[0].camera
    try:
        return {layer: painter.paint(DisplayOptions(layer), camera, camera) for layer in get_args(Layer)}
    finally:
        scene.close()


def test_a_card_learns_the_place_as_the_processor_does(runs):
    native, card = runs
    for ours, theirs in ((psnr(native, name), psnr(card, name)) for name in (COARSE, MERGED)):
        assert ours > 13  # 12.0 for a plain gray picture
        assert theirs == pytest.approx(ours, abs=0.6)
    first, same = (json.loads((run / "coarse" / "log.jsonl").read_text().splitlines()[0]) for run in runs)
    assert first["loss"] == pytest.approx(same["loss"], rel=0.05)


def test_pictures_of_depth_and_explicit_gaussians_come_from_the_card_too(runs):
    folder = runs[1].parent
    assert any(path.is_file() for path in (folder / "depth").rglob("*"))
    assert (folder / "scene.ply").stat().st_size > 1000
