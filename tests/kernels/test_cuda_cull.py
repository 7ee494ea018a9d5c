"""The CUDA culling without a GPU: its own kernels, run on the processor by a stand-in driver, against the reference."""

from __future__ import annotations

import ctypes

import pytest
import torch

from support.cuda_on_host import ORDERS, HostDriver, build_on_host, needs_a_compiler, needs_nvrtc
from support.decode_scenes import CAMERAS, anchors, ellipse_touches_image, looking_down
from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu.cull import cull as native
from vdgs.kernels.cuda.cull import PROGRAM, cull
from vdgs.kernels.cuda.driver import get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram, read_source
from vdgs.kernels.torch_ref.cull import cull as reference

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card"), pytest.mark.xdist_group("cuda_cull")]


@pytest.fixture(scope="module")
def library(compiled_code):
    return build_on_host(compiled_code)


def kept(
    positions: torch.Tensor, log_scales: torch.Tensor, camera: Camera, library: ctypes.CDLL, order: int = 0
) -> torch.Tensor:
    program = CudaProgram(name=PROGRAM.name, driver=HostDriver(library, order), headers=PROGRAM.headers)
    return cull(positions, log_scales, camera, program=program)


@needs_a_compiler
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("n", [0, 1, 31, 33, 256, 3000])
def test_it_equals_the_reference_and_the_processor(camera, n, library):
    positions, log_scales = anchors(n, seed=2)
    rows = kept(positions, log_scales, camera, library)
    assert rows.dtype == torch.int64
    assert (torch.diff(rows) > 0).all()
    exact = reference(positions.double(), log_scales.double(), camera)
    for theirs in (exact, native(positions, log_scales, camera)):
        assert len(set(rows.tolist()) ^ set(theirs.tolist())) <= n // 1000  # the last bit decides at the bound
    assert n < 3000 or 100 < len(rows) < 2500


@needs_a_compiler
@pytest.mark.parametrize("camera", CAMERAS)
def test_large_anchors_beside_the_picture_are_kept(camera, library):
    """So that scales decide: hardly a center lies on the image."""
    positions, log_scales = anchors(2000, seed=4, spread=15.0, log_scale=1.0)
    rows = set(kept(positions, log_scales, camera, library).tolist())
    without = set(kept(positions, log_scales - 20.0, camera, library).tolist())
    assert without < rows
    assert set(ellipse_touches_image(positions, log_scales, camera).nonzero()[:, 0].tolist()) <= rows
    assert len(rows ^ set(reference(positions.double(), log_scales.double(), camera).tolist())) <= 2


@needs_a_compiler
def test_what_is_not_a_number_is_dropped(library):
    positions, log_scales = torch.zeros(5, 3), torch.zeros(5, 6)
    positions[0, 0] = positions[1, 2] = float("nan")
    positions[2, 1] = float("inf")
    assert kept(positions, log_scales, looking_down(), library).tolist() == [3, 4]


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_in_which_threads_take_turns_changes_nothing(order, library):
    positions, log_scales = anchors(700, seed=3)
    assert torch.equal(*(kept(positions, log_scales, CAMERAS[2], library, turns) for turns in (0, order)))


def test_there_is_no_barrier_that_could_be_missing():
    """Threads meet but once, in a vote of their warp; in test_cuda_rasterize.py barriers are left out."""
    text = read_source(PROGRAM.name)
    assert "__shared__" not in text
    assert "__sync" not in text
    assert text.count("_sync(") == text.count("__ballot_sync(") == 1


@needs_a_compiler
def test_unsuitable_anchors_are_refused(library):
    positions, log_scales = anchors(4, seed=0)
    with pytest.raises((ValueError, TypeError), match="log_scales"):
        kept(positions, log_scales[:3], looking_down(), library)
    with pytest.raises(TypeError, match="float32"):
        kept(positions.double(), log_scales, looking_down(), library)


@pytest.mark.gpu
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_card_gives_what_the_reference_gives(camera):
    get_cuda_driver()
    positions, log_scales = anchors(20_000, seed=2)
    rows = cull(positions.cuda(), log_scales.cuda(), camera).cpu()
    assert (torch.diff(rows) > 0).all()
    assert len(set(rows.tolist()) ^ set(reference(positions.double(), log_scales.double(), camera).tolist())) <= 20
