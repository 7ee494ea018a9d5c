"""What the rasterizer makes of unusual input, and what it refuses."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
import torch

from support.rasterize_scenes import (
    Scene,
    assert_close,
    assert_gradients_of_another_picture_are_refused,
    draw,
    loss_of,
    make_scene,
    splats_of,
)
from vdgs.kernels.autograd import check_splats
from vdgs.kernels.cpu.extension import load_extension, supported_isas
from vdgs.kernels.cpu.rasterize import rasterize, rasterize_vjp
from vdgs.kernels.kernel_types import Splats
from vdgs.kernels.torch_ref.rasterize import rasterize as reference

ISAS = supported_isas()
NAMES = ("means_px", "conics", "colors", "opacities", "depths", "background")


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_rows_that_are_not_finite_are_not_drawn(isa: str, value: float) -> None:
    scene = make_scene(60, 40, 30)
    spoiled, kept = [], np.ones(60, bool)
    for i, (name, t) in enumerate(zip(NAMES, scene.tensors, strict=True)):
        t = t.detach().clone()
        if name != "background":
            t[7 * i].reshape(-1)[-1] = value
            kept[7 * i] = False
        spoiled.append(t.requires_grad_())
    actual = draw(Scene(tuple(spoiled), 40, 30), isa)
    without = [t.detach()[kept] if len(t) == 60 else t.detach() for t in scene.tensors]
    expected = rasterize(*splats_of(without), 40, 30, depth=True, module=load_extension(isa))
    for a, e in zip(actual, expected, strict=True):
        assert torch.equal(a, e)
    loss_of(actual).backward()
    for t in spoiled[:5]:
        assert t.grad.isfinite().all()
        assert not t.grad[~kept].any()
    twin = reference(*splats_of(tuple(t.detach().double() for t in spoiled)), 40, 30)
    assert_close(actual.image, twin.image, 1e-5)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("conic", [(1.0, 1.0, 1.0), (1.0, 2.0, 1.0), (-1.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_conics_that_are_not_positive_definite_are_not_drawn(isa: str, conic: tuple[float, ...]) -> None:
    one = [torch.tensor([[5.0, 5.0]]), torch.tensor([conic]), torch.ones(1, 3), torch.ones(1), torch.ones(1)]
    scene = Scene((*one, torch.zeros(3)), 10, 10).to(torch.float32)
    raster = draw(scene, isa)
    assert not raster.image.any()
    loss_of(raster).backward()
    assert all(not t.grad.any() for t in scene.tensors[:5])


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("opacity", [0.0, 0.5 / 255, 1.0, 7.0, 1e6])
def test_opacity_outside_its_range(isa: str, opacity: float) -> None:
    conic = torch.tensor([[0.02, 0.003, 0.03]])
    one = (torch.tensor([[9.0, 6.0]]), conic, torch.ones(1, 3), torch.tensor([opacity]), torch.ones(1))
    scene = Scene((*one, torch.zeros(3)), 30, 20)
    exact_scene, scene = scene.to(torch.float64), scene.to(torch.float32)
    exact, actual = reference(*splats_of(exact_scene.tensors), 30, 20, depth=True), draw(scene, isa)
    loss_of(exact).backward()
    loss_of(actual).backward()
    assert_close(actual.image, exact.image, 1e-5)
    for a, e in zip(scene.tensors, exact_scene.tensors, strict=True):
        assert_close(a.grad, e.grad, 1e-4)


@pytest.mark.parametrize("isa", ISAS)
def test_equal_depths_keep_the_order_of_the_rows(isa: str) -> None:
    n = 40
    colors = torch.eye(3).repeat(14, 1)[:n]
    means, conics = torch.full((n, 2), 8.0), torch.tensor([[0.01, 0.0, 0.01]]).repeat(n, 1)
    args = (means, conics, colors, torch.full((n,), 0.3), torch.full((n,), 5.0), torch.zeros(3))
    first = draw(Scene(args, 16, 16), isa).image[8, 8]
    assert first[0] > first[1] > first[2]


@pytest.mark.parametrize("isa", ISAS)
def test_depths_of_either_sign_and_zeros_of_either_keep_the_order_of_the_rows(isa: str) -> None:
    scene = make_scene(60, 16, 16, opacity=2.0)
    depths = torch.tensor([-3.0, 0.0, -0.0, 2.0, 2.0]).repeat(12)
    scene = Scene((*scene.tensors[:4], depths, scene.tensors[5]), 16, 16)
    exact = reference(*splats_of(scene.to(torch.float64).tensors), 16, 16)
    assert_close(draw(scene, isa).image, exact.image, 1e-5)


@pytest.mark.parametrize("name", ["image", "alpha", "depth"])
def test_gradients_of_another_picture_are_refused(name: str) -> None:
    assert_gradients_of_another_picture_are_refused(
        name, lambda splats, behind: rasterize_vjp(splats, behind, 37, 29, depth=True)[1]
    )


def test_order_of_the_rows_does_not_matter() -> None:
    scene = make_scene(500, 50, 40)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    shuffled = [t.detach()[order] if len(t) == 500 else t.detach() for t in scene.tensors]
    first, second = (rasterize(*splats_of(each), 50, 40).image for each in (shuffled, scene.tensors))
    assert torch.equal(first, second)


def test_inputs_may_be_strided() -> None:
    scene = make_scene(200, 40, 30)
    strided = [
        t.detach().t().contiguous().t() if t.dim() == 2 else t.detach().repeat(2)[::1][: len(t)] for t in scene.tensors
    ]
    strided[3] = torch.stack([scene.tensors[3].detach()] * 2, dim=1)[:, 0]
    assert not strided[0].is_contiguous()
    assert not strided[3].is_contiguous()
    strided = [t.requires_grad_() for t in strided]
    raster = rasterize(*splats_of(strided), 40, 30)
    assert torch.equal(raster.image, rasterize(*splats_of(scene.tensors), 40, 30).image)
    raster.image.transpose(0, 1).square().sum().backward()
    rasterize(*splats_of(scene.tensors), 40, 30).image.square().sum().backward()
    for a, b in zip(strided[:4], scene.tensors[:4], strict=True):
        assert torch.equal(a.grad, b.grad)


def test_only_what_is_asked_for_gets_gradients() -> None:
    scene = make_scene(100, 30, 30)
    tensors = [t.detach() for t in scene.tensors]
    assert not rasterize(*splats_of(tensors), 30, 30).image.requires_grad
    tensors[2].requires_grad_()
    raster = rasterize(*splats_of(tensors), 30, 30)
    assert raster.depth is None
    assert raster.median_depth is None
    raster.alpha.sum().backward()
    assert not tensors[2].grad.any(), "alpha does not depend on colors"
    assert all(t.grad is None for i, t in enumerate(tensors) if i != 2)


def test_backward_may_be_repeated_but_not_differentiated() -> None:
    scene = make_scene(100, 30, 30)
    raster = draw(scene, ISAS[0])
    first = torch.autograd.grad(raster.image.square().sum(), scene.tensors[:4], retain_graph=True)
    again = torch.autograd.grad(raster.image.square().sum(), scene.tensors[:4], retain_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    for loss in (raster.image.square().sum(), raster.image.sum()):
        with pytest.raises(RuntimeError, match="differentiate twice"):
            torch.autograd.grad(loss, scene.tensors[0], create_graph=True)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda t: t.__setitem__(0, t[0].double()), TypeError, "means_px must be float32"),
        (
            lambda t: t.__setitem__(1, t[1][:, :2]),
            ValueError,
            r"conics must have shape \[9, 3\], not \[9, 2\]",
        ),
        (lambda t: t.__setitem__(3, t[3][:5]), ValueError, r"opacities must have shape \[9\], not \[5\]"),
        (lambda t: t.__setitem__(5, torch.zeros(4)), ValueError, "background must have shape"),
    ],
)
def test_wrong_tensors_are_named(change, error: type[Exception], message: str) -> None:
    tensors = [t.detach() for t in make_scene(9, 10, 10).tensors]
    change(tensors)
    splats = object.__new__(Splats)  # without the run-time types of the tests, here and below
    for name, tensor in zip(("means_px", "conics", "colors", "opacities", "depths"), tensors[:5], strict=True):
        object.__setattr__(splats, name, tensor)
    with pytest.raises(error, match=message):
        inspect.unwrap(rasterize)(splats, tensors[5], 10, 10)


@pytest.mark.parametrize(("width", "height"), [(0, 5), (5, -1), (2**20, 1)])
def test_impossible_pictures_are_refused(width: int, height: int) -> None:
    tensors = [t.detach() for t in make_scene(3, 10, 10).tensors]
    with pytest.raises(ValueError, match="must be from 1 to"):
        rasterize(*splats_of(tensors), width, height)


def test_more_splats_than_can_be_numbered_are_refused() -> None:
    tensors = tuple(torch.zeros(1, *tail).expand(2**31, *tail) for tail in ((2,), (3,), (3,), (), ()))
    with pytest.raises(ValueError, match=r"at most 2.31 - 1 splats"):
        check_splats((*tensors, torch.zeros(3)), 10, 10)


@pytest.mark.parametrize("room", [((9, 1), (9, 3)), ((9, 2), (9, 2)), ((8, 2), (9, 3)), ((9, 2), (8, 3))])
def test_room_for_gradients_of_another_shape_is_refused(room) -> None:
    _, pullback = rasterize_vjp(*splats_of([each.detach() for each in make_scene(9, 10, 10).tensors]), 10, 10)
    with pytest.raises(ValueError, match="gradients of 9 splats of 9 do not fit"):
        pullback(torch.ones(10, 10, 3), out=tuple(torch.zeros(shape) for shape in room))
