"""The CUDA rasterizer without a GPU: its kernels, run on the processor by a stand-in driver, against the reference."""

from __future__ import annotations

import ctypes
import gc
import weakref
from dataclasses import fields, replace

import pytest
import torch

from support.cuda_on_host import (
    ORDERS,
    HostDriver,
    Stuck,
    barriers_of,
    build_on_host,
    needs_a_compiler,
    needs_nvrtc,
)
from support.rasterize_scenes import (
    Scene,
    assert_close,
    assert_first_gradients_are_those_of_all,
    assert_gradients_of_another_picture_are_refused,
    assert_same_picture,
    in_runs,
    loss_of,
    make_scene,
    splats_of,
)
from vdgs.kernels.cuda.driver import get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.cuda.rasterize import PROGRAM, rasterize, rasterize_vjp
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.torch_ref.rasterize import rasterize as reference

pytestmark = [needs_nvrtc, pytest.mark.usefixtures("not_for_a_card"), pytest.mark.xdist_group("cuda_rasterize")]

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
def library(compiled_code):
    return build_on_host(compiled_code)


def drawn(scene: Scene, library: ctypes.CDLL, order: int = 0, depth: bool = True, left_out: int = -1) -> Raster:
    driver = HostDriver(library, order, left_out=left_out)
    program = CudaProgram(name="rasterize.cu", driver=driver, headers=PROGRAM.headers)
    return rasterize(*splats_of(scene.tensors), scene.width, scene.height, depth=depth, program=program)


def bits_of(scene: Scene, library: ctypes.CDLL, order: int, left_out: int = -1) -> list[bytes]:
    """Everything that drawing and the way back give."""
    scene = scene.to(torch.float32)
    raster = drawn(scene, library, order, left_out=left_out)
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


@needs_a_compiler
@pytest.mark.parametrize("order", ORDERS[1:])
def test_no_barrier_is_missing(order, library):
    """The order in which threads and warps take turns changes no bit."""
    assert bits_of(SCENES["ordinary"], library, order) == bits_of(SCENES["ordinary"], library, 0)


@needs_a_compiler
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_wherever_splats_stand_picture_and_gradients_have_the_same_bits(seed, library):
    """Where depths are equal, the order that splats are given with decides."""
    program = CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers)
    scene = SCENES["ordinary"]
    splats, background = splats_of(scene.tensors)
    level = replace(splats, depths=(splats.depths / 40).floor() + 1)
    moved, order = in_runs(level, 7, seed)
    assert torch.equal(moved.segments.order(len(order)).long(), order)
    assert not torch.equal(order, order.sort()[0])
    size, wanted = (scene.width, scene.height), torch.randn(scene.height, scene.width, 3)

    def found(drawn: Splats) -> tuple[torch.Tensor, ...]:
        raster, pullback = rasterize_vjp(drawn, background, *size, program=program)
        gradients = pullback(wanted)
        return raster.image, *gradients[:4], gradients.background

    image, *of_splats, of_background = found(level)
    other, *of_moved, of_background_then = found(moved)
    assert torch.equal(image, other)
    assert torch.equal(of_background, of_background_then)
    assert all(torch.equal(one, two[order]) for one, two in zip(of_splats, of_moved, strict=True))
    # It is by the order: as rows alone, they make another picture.
    rows = Splats(*(getattr(moved, field.name) for field in fields(Splats)))
    assert not torch.equal(image, found(rows)[0])
    assert torch.equal(image, rasterize(moved, background, *size, program=program).image)


def test_splats_joined_with_others_keep_the_order_of_each():
    one, first = in_runs(splats_of(SCENES["ordinary"].tensors)[0], 5)
    other, second = in_runs(splats_of(SCENES["tiny"].tensors)[0], 4, 1)
    both = one.concat(other)
    expected = torch.cat([first, second + len(first)])
    assert torch.equal(both.segments.order(len(expected)).long(), expected)
    alone = replace(one, segments=None).concat(other)
    assert torch.equal(
        alone.segments.order(len(expected)).long(), torch.cat([torch.arange(len(first)), expected[len(first) :]])
    )
    assert replace(one, segments=None).concat(replace(other, segments=None)).segments is None


@needs_a_compiler
@pytest.mark.parametrize("barrier", barriers_of("rasterize"))
def test_a_missing_barrier_would_be_noticed(barrier, library):
    """And every barrier is needed: without any one of them the order of turns changes the result, or threads wait in
    vain for others."""
    scene = make_scene(600, 17, 5, opacity=-1.0)  # more than fit into shared memory at once

    def results(left_out: int) -> set[tuple[bytes, ...] | str]:
        found: set[tuple[bytes, ...] | str] = set()
        for order in ORDERS:
            try:
                found.add(tuple(bits_of(scene, library, order, left_out)))
            except Stuck:
                found.add("stuck")
        return found

    whole = results(-1)
    assert len(whole) == 1
    assert results(barrier) != whole


@needs_a_compiler
class TestMeaning:
    def test_without_depth_there_is_none_and_the_picture_is_the_same(self, library):
        scene = SCENES["ordinary"]
        plain, whole = drawn(scene, library, depth=False), drawn(scene, library)
        assert (plain.depth, plain.median_depth) == (None, None)
        assert torch.equal(plain.image, whole.image)
        assert torch.equal(plain.alpha, whole.alpha)

    @pytest.mark.parametrize("column", range(5))
    def test_rows_that_are_not_finite_are_not_drawn_and_get_no_gradient(self, column, library):
        scene = SCENES["ordinary"].to(torch.float32)
        with torch.no_grad():
            scene.tensors[column].view(len(scene.tensors[column]), -1)[3, 0] = torch.nan
        raster = drawn(scene, library)
        assert all(tensor.isfinite().all() for tensor in raster)
        gradients = torch.autograd.grad(loss_of(raster), scene.tensors)
        assert all(tensor.isfinite().all() for tensor in gradients)
        assert all((tensor[3] == 0).all() for tensor in gradients[:5])

    def test_depths_of_either_sign_and_equal_ones_keep_the_order_of_the_rows(self, library):
        scene = make_scene(60, 16, 16, opacity=2.0)
        depths = torch.tensor([-3.0, -0.0, 0.0, 2.0, 2.0]).repeat(12)
        scene = Scene((*scene.tensors[:4], depths, scene.tensors[5]), 16, 16)
        exact = reference(*splats_of(scene.to(torch.float64).tensors), 16, 16)
        assert_close(drawn(scene, library, depth=False).image, exact.image, 1e-5)

    def test_the_way_back_overwrites_what_it_may(self, library):
        scene, program = (
            SCENES["ordinary"],
            CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers),
        )
        splats, background = splats_of([tensor.detach().clone() for tensor in scene.tensors])
        by_alpha = torch.randn(scene.height, scene.width, generator=torch.Generator().manual_seed(0))
        expected = rasterize_vjp(splats, background, scene.width, scene.height, program=program)[1](None, by_alpha)
        _, pullback = rasterize_vjp(splats, background, scene.width, scene.height, program=program)
        found = pullback(None, by_alpha, out=(splats.means_px, splats.conics))
        assert found.means_px is splats.means_px
        assert found.depths is expected.depths is None
        for ours, theirs in zip(found, expected, strict=True):
            assert ours is theirs is None or torch.equal(ours, theirs)

    @pytest.mark.parametrize("name", SCENES)
    def test_gradients_of_the_first_splats_alone_have_the_bits_that_they_have_among_all(self, name, library):
        scene, program = (
            SCENES[name],
            CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers),
        )
        size, (splats, background) = (scene.width, scene.height), splats_of([each.detach() for each in scene.tensors])
        assert_first_gradients_are_those_of_all(
            lambda: rasterize_vjp(splats, background, *size, program=program)[1], len(splats.depths), *size
        )

    @pytest.mark.parametrize("depth", [False, True])
    @pytest.mark.parametrize("backward", [False, True])
    def test_a_picture_that_nobody_holds_is_freed_with_what_its_way_back_keeps(self, backward, depth, library):
        scene, kept = SCENES["ordinary"].to(torch.float32), []

        class Watched(CudaProgram):
            def launch(self, kernel, grid, block, *arguments):
                kept.extend(weakref.ref(each) for each in arguments if isinstance(each, torch.Tensor))
                super().launch(kernel, grid, block, *arguments)

        given = {id(tensor) for tensor in scene.tensors}
        program = Watched(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers)
        raster = rasterize(*splats_of(scene.tensors), scene.width, scene.height, depth=depth, program=program)
        assert any(each() is not None for each in kept)
        if backward:
            raster.image.sum().backward()
        del raster
        gc.collect()
        assert not [each() for each in kept if each() is not None and id(each()) not in given]

    def test_a_picture_that_was_changed_has_no_way_back(self, library):
        """The way back reads the picture: it would give other gradients without a word."""
        scene = SCENES["ordinary"].to(torch.float32)
        raster = drawn(scene, library)
        raster.image.add_(0.5 * (1 - raster.alpha)[..., None])
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            raster.image.sum().backward()

    @pytest.mark.parametrize("changed", range(5))
    def test_splats_that_were_changed_have_no_way_back(self, changed, library):
        """The way back reads them too."""
        scene = SCENES["ordinary"].to(torch.float32)
        raster = drawn(scene, library)
        with torch.no_grad():
            scene.tensors[changed].mul_(0.5)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            raster.image.sum().backward()

    def test_room_for_gradients_of_another_shape_is_refused(self, library):
        scene = SCENES["ordinary"]
        program = CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers)
        splats, background = splats_of([each.detach() for each in scene.tensors])
        size, m = (scene.width, scene.height), len(splats.depths)
        _, pullback = rasterize_vjp(splats, background, *size, program=program)
        for shapes in (((m, 1), (m, 3)), ((m, 2), (m - 1, 3))):
            with pytest.raises(ValueError, match="do not fit"):
                pullback(torch.ones(*size[::-1], 3), out=tuple(torch.zeros(shape) for shape in shapes))

    @pytest.mark.parametrize("name", ["image", "alpha", "depth"])
    def test_gradients_of_another_picture_are_refused(self, name, library):
        program = CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers)
        assert_gradients_of_another_picture_are_refused(
            name, lambda splats, behind: rasterize_vjp(splats, behind, 37, 29, depth=True, program=program)[1]
        )

    def test_unsuitable_tensors_are_refused(self, library):
        splats, background = splats_of(SCENES["ordinary"].to(torch.float64).tensors)
        program = CudaProgram(name="rasterize.cu", driver=HostDriver(library), headers=PROGRAM.headers)
        with pytest.raises(TypeError, match="float32"):
            rasterize(splats, background, 37, 29, program=program)
        with pytest.raises(ValueError, match="width"):
            rasterize(*splats_of(SCENES["ordinary"].tensors), 0, 29, program=program)


@pytest.mark.gpu
@pytest.mark.parametrize("name", SCENES)
def test_a_card_gives_what_the_reference_gives(name):
    get_cuda_driver()
    scene, exact_scene = SCENES[name].to(torch.float32), SCENES[name].to(torch.float64)
    there = [tensor.detach().cuda().requires_grad_() for tensor in scene.tensors]
    found = rasterize(*splats_of(there), scene.width, scene.height, depth=True)
    exact = reference(*splats_of(exact_scene.tensors), scene.width, scene.height, depth=True)
    here = Raster(*(tensor.cpu() for tensor in found))
    assert_same_picture(here, exact, 1e-4)
    gradients = torch.autograd.grad(loss_of(here), there)
    once_more = rasterize(*splats_of(there), scene.width, scene.height, depth=True)
    again = torch.autograd.grad(loss_of(Raster(*(tensor.cpu() for tensor in once_more))), there)
    for ours, expected in zip(gradients, torch.autograd.grad(loss_of(exact), exact_scene.tensors), strict=True):
        assert_close(ours.cpu(), expected, 2e-3 if name == "edge-on" else 1e-3)
    assert all(torch.equal(one, other) for one, other in zip(gradients, again, strict=True))
