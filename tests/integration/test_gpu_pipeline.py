"""The whole pipeline on a card that is not there, by the composed set of operations: `--device cuda`, from photographs
to pictures and files, beside the same by the native set. Own kernels run their own text on the processor."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from support.cuda_on_host import host_compiler, needs_nvrtc
from support.fake_device import pretended_card
from support.fake_gsplat import needs_gsplat
from support.gpu_on_host import build, install
from support.small_pipeline import BLOCK, COARSE, MERGED, psnr, train_coarse, vdgs
from vdgs.kernels import device_selection
from vdgs.runs.open_run import open_run
from vdgs.viewer.layers import DisplayOptions, Layer, Painter
from vdgs.viewer.viewer_scene import ViewerScene

pytestmark = [
    pytest.mark.slow,
    needs_nvrtc, needs_gsplat, pytest.mark.xdist_group("composition"),
    pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler"),
]  # fmt: skip


CARD = ("--device", "cuda")


@pytest.fixture(scope="module")
def runs(native_small, tmp_path_factory, compiled_code) -> tuple[Path, Path, Path]:
    """A run by the native set; a coarse stage on the card; and the native run with one of its two blocks from the card,
    with which it goes on there."""
    folder = tmp_path_factory.mktemp("composed")
    coarse, shared = folder / "card", folder / "shared"
    shutil.copytree(native_small.whole, shared)
    shutil.rmtree(shared / "blocks" / "00")
    drivers = build(compiled_code)
    with pytest.MonkeyPatch.context() as patch:
        install(drivers, patch, "cuda", "cuda")
        patch.setattr(device_selection, "_no_card", lambda index: "")
        with pretended_card():
            train_coarse(native_small.capture, coarse, *CARD)
            vdgs("train-blocks", shared, "--block", 0, *BLOCK, *CARD)
            vdgs("merge", shared)
            vdgs("eval", shared, "--model", "merged", *CARD)
            vdgs("render", shared, "--mode", "depth", "--output", folder / "depth", *CARD)
            vdgs("ortho", shared, *CARD)
            vdgs("lod", shared)
            painted = paint_layers(shared, "cuda")
            vdgs("export", shared, "--output", folder / "scene.ply", "--color-iterations", "1", *CARD)
    vdgs("eval", coarse, "--model", "coarse", "--device", "cpu")
    for layer, image in paint_layers(shared, "cpu").items():
        np.testing.assert_allclose(painted[layer].mean(axis=(0, 1)), image.mean(axis=(0, 1)), atol=4, err_msg=layer)
    return native_small.whole, coarse, shared


def paint_layers(run: Path, device: str) -> dict[str, np.ndarray]:
    """What the viewer shows of a run with a tree, by layer."""
    scene = ViewerScene(open_run(run, "merged", device), lambda name: open_run(run, name, device))
    painter, camera = Painter(scene), scene.capture.train_views[0].camera
    try:
        return {layer: painter.paint(DisplayOptions(layer), camera, camera) for layer in get_args(Layer)}
    finally:
        scene.close()


def test_a_card_learns_the_place_as_the_processor_does(runs):
    native, coarse, shared = runs
    for name, card in ((COARSE, coarse), (MERGED, shared)):
        ours, theirs = psnr(native, name), psnr(card, name)
        assert ours > 13  # 12.0 for a plain gray picture
        assert theirs == pytest.approx(ours, abs=0.6)
    first, same = (json.loads((run / "coarse" / "log.jsonl").read_text().splitlines()[0]) for run in (native, coarse))
    assert first["loss"] == pytest.approx(same["loss"], rel=0.05)
    before, after = ((run / "blocks" / "00" / "model.safetensors").read_bytes() for run in (native, shared))
    assert after != before  # it was trained anew


def test_pictures_of_depth_and_explicit_gaussians_come_from_the_card_too(runs):
    folder = runs[1].parent
    assert any(path.is_file() for path in (folder / "depth").rglob("*"))
    assert (folder / "scene.ply").stat().st_size > 1000
