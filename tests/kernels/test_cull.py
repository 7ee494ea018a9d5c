"""Laws of culling: nothing that touches the image is lost, and little that does not is kept."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.decode_scenes import CAMERAS, anchors, ellipse_touches_image, looking_down
from support.instruction_sets import using
from vdgs.geometry.camera import NEAR_PLANE
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.cull import cull as native_cull
from vdgs.kernels.torch_ref.cull import cull as twin_cull

BOTH = pytest.mark.parametrize("cull", [twin_cull, native_cull])


@BOTH
@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), spread=st.floats(0.5, 30), log_scale=st.floats(-6, 3), which=st.integers(0, 3))
def test_never_drops_what_touches_the_image(cull, seed, spread, log_scale, which):
    positions, log_scales = anchors(400, seed, spread, log_scale)
    touching = ellipse_touches_image(positions, log_scales, CAMERAS[which]).nonzero()[:, 0]
    assert set(touching.tolist()) <= set(cull(positions, log_scales, CAMERAS[which]).tolist())


@BOTH
@pytest.mark.parametrize("camera", CAMERAS)
def test_keeps_little_else(cull, camera):
    positions, log_scales = anchors(20_000, seed=1, log_scale=-2.0)
    kept = cull(positions, log_scales, camera)
    touching = ellipse_touches_image(positions, log_scales, camera)
    assert len(kept) < 1.5 * int(touching.sum())
    assert (torch.diff(kept) > 0).all()
    _, depths = camera.project(positions[kept].double().numpy())
    assert (depths > NEAR_PLANE).all()


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("n", [0, 1, 15, 17, 5000])
def test_every_instruction_set_equals_the_twin(camera, n):
    positions, log_scales = anchors(n, seed=2)
    twin = set(twin_cull(positions.double(), log_scales.double(), camera).tolist())
    for instructions in extension.supported_isas():
        with using(instructions):
            ours = set(native_cull(positions, log_scales, camera).tolist())
        assert len(ours ^ twin) <= n // 1000, instructions  # the last bit decides at the bound


@BOTH
def test_what_is_not_a_number_is_dropped(cull):
    positions, log_scales = torch.zeros(5, 3), torch.zeros(5, 6)
    positions[0, 0] = positions[1, 2] = float("nan")
    positions[2, 1] = float("inf")
    assert cull(positions, log_scales, looking_down()).tolist() == [3, 4]
