"""The CUDA rasteriser without a GPU: its own kernels, run on the processor by a stand-in driver, against the reference."""

from __future__ import annotations

import ctypes
import re

import pytest
import torch

from cuda_on_host import ORDERS, HostDriver, build_on_host, host_compiler
from rasterise_scenes import Scene, make_scene, splats_of
from test_cuda_compiling import needs_nvrtc
from test_rasterise import assert_close, assert_same_picture, loss_of, smooth
from vdgs.kernels.cuda import cache
from vdgs.kernels.cuda import rasterise as cuda
from vdgs.kernels.cuda.driver import cuda_driver
from vdgs.kernels.cuda.launching import Program, read_source
from vdgs.kernels.reference.rasterise import rasterise as reference
from vdgs.kernels.types import Raster

pytestmark = [needs_nvrtc, pytest.mark.xdist_group("cuda_rasterise")]
needs_a_compiler = pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler")
#: Whatever makes the threads of a block wait for each other.
BARRIER = re.compile(r"__syncthreads(?:_and|_or)?\(")
BARRIERS = 5
SCENES = {
    "ordinary": make_scene(150, 37, 29),
    "dense": make_scene(700, 20, 18, opacity=2.0),
    "huge": make_scene(40, 33, 33, size=200.0, opacity=-2.0),
    "tiny": make_scene(200, 20, 20, size=0.05),
    "edge-on": make_scene(120, 25, 35, size=4.0, thinness=2.0),
    "off-screen": make_scene(100, 20, 20, margin=4.0),
    "opaque": make_scene(200, 33, 17, size=6.0, opacity=30.0),
    "empty": make_scene(0, 20, 10),
    "one pixel": make_scene(10, 1, 1, size=1.0),
}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return build_on_host("rasterise.cu", tmp_path_factory.mktemp("host"))


@pytest.fixture(scope="module")
def numbered(tmp_path_factory):
    """The kernels, of whose barriers one can be left out: that of the number `left_out`."""
    text, number = read_source("rasterise.cu"), iter(range(BARRIERS))
    text = BARRIER.sub(lambda found: f"{found[0][:-1].replace('__', 'maybe_')}({next(number)}, ", text)
    assert next(number, None) is None
    text = text.replace(", )", ")")
    before = """
extern "C" int left_out;
int left_out = -1;
void maybe_syncthreads(int number) { if (number != left_out) __syncthreads(); }
int maybe_syncthreads_and(int number, int mine) { return number == left_out ? mine : __syncthreads_and(mine); }
int maybe_syncthreads_or(int number, int mine) { return number == left_out ? mine : __syncthreads_or(mine); }
"""
    return build_on_host("rasterise.cu", tmp_path_factory.mktemp("numbered"), before + text)


@pytest.fixture(scope="module")
def code(tmp_path_factory):
    """Where compiled code is kept, so that NVRTC runs once (that it is never wrong: test_cuda_compiling.py)."""
    return tmp_path_factory.mktemp("code")


@pytest.fixture(autouse=True)
def _compiled_once(code, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(code))


def drawn(scene: Scene, library: ctypes.CDLL, order: int = 0, depth: bool = True) -> Raster:
    program = Program("rasterise.cu", HostDriver(library, order), cuda.PROGRAM.headers)
    return cuda.rasterise(*splats_of(scene.tensors), scene.width, scene.height, depth=depth, program=program)


def bits_of(scene: Scene, library: ctypes.CDLL, order: int) -> list[bytes]:
    """Everything that drawing and the way back give."""
    scene = scene.to(torch.float32)
    raster = drawn(scene, library, order)
    gradients = torch.autograd.grad(loss_of(raster), scene.tensors)
    return [tensor.detach().numpy().tobytes() for tensor in (*raster, *gradients)]


@needs_a_compiler
@pytest.mark.parametrize("name", SCENES)
def test_picture_and_gradients_equal_the_reference(name, library):
    scene, exact_scene = SCENES[name].to(torch.float32), SCENES[name].to(torch.float64)
    exact = reference(*splats_of(exact_scene.tensors), scene.width, scene.height, depth=True)
    found = drawn(scene, library)
    assert_same_picture(found, exact, 2e-5)
    gradients = torch.autograd.grad(loss_of(found), scene.tensors)
    for actual, expected in zip(gradients, torch.autograd.grad(loss_of(exact), exact_scene.tensors), strict=True):
        # A mean or conic is known to 6e-8; a splat seen edge-on multiplies that.
        assert_close(actual, expected, 2e-3 if name == "edge-on" else 1e-4)
