"""The rasterizer: what it draws and how that changes with its input."""

from __future__ import annotations

import gc
import inspect
import os
import threading
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from support.instruction_sets import on_threads
from support.rasterize_scenes import (
    Scene,
    assert_close,
    assert_first_gradients_are_those_of_all,
    assert_same_picture,
    loss_of,
    make_scene,
    splats_of,
)
from vdgs.kernels import constants
from vdgs.kernels.cpu.extension import load_extension, supported_isas
from vdgs.kernels.cpu.rasterize import rasterize, rasterize_vjp, splat_contributions
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.torch_ref.rasterize import rasterize as reference
from vdgs.kernels.torch_ref.rasterize import splat_contributions as twin

ISAS = supported_isas()
NAMES = ("means_px", "conics", "colors", "opacities", "depths", "background")


SCENES = {
    "ordinary": make_scene(400, 61, 47),
    "dense": make_scene(2500, 45, 39, opacity=2.0),
    "huge": make_scene(150, 64, 64, size=200.0, opacity=-2.0),
    "tiny": make_scene(1500, 40, 40, size=0.05),
    "edge-on": make_scene(300, 50, 70, size=4.0, thinness=2.0),
    "off-screen": make_scene(300, 20, 20, margin=4.0),
    "opaque": make_scene(200, 33, 17, size=6.0, opacity=30.0),
    "empty": make_scene(0, 20, 10),
    "one pixel": make_scene(30, 1, 1, size=1.0),
    "one row": make_scene(100, 70, 1),
}


def draw(scene: Scene, isa: str, depth: bool = True) -> Raster:
    return rasterize(*splats_of(scene.tensors), scene.width, scene.height, depth=depth, module=load_extension(isa))


@cache
def exact_of(scene: Scene) -> tuple[Raster, list[Tensor]]:
    """What the reference draws, and the gradients of `loss_of`; once for all instruction sets."""
    scene = scene.to(torch.float64)
    exact = reference(*splats_of(scene.tensors), scene.width, scene.height, depth=True)
    loss_of(exact).backward()
    return exact, [tensor.grad for tensor in scene.tensors]


@pytest.mark.parametrize("isa", ISAS)
def test_constants_are_those_of_python(isa: str) -> None:
    for name in ("ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "MEDIAN_TRANSMITTANCE"):
        assert getattr(load_extension(isa), name) == pytest.approx(getattr(constants, name), rel=1e-6)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("name", SCENES)
def test_picture_and_gradients_equal_the_reference(name: str, isa: str) -> None:
    scene, (exact, exact_gradients) = SCENES[name].to(torch.float32), exact_of(SCENES[name])
    actual = draw(scene, isa)
    assert_same_picture(actual, exact, 2e-5)
    loss_of(actual).backward()
    for a, e in zip(scene.tensors, exact_gradients, strict=True):
        # A mean or conic is known to 6e-8; a splat seen edge-on multiplies that.
        assert_close(a.grad, e, 2e-3 if name == "edge-on" else 5e-5)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("depth", [False, True])
def test_gradients_of_the_first_splats_alone_have_the_bits_that_they_have_among_all(name: str, isa: str, depth: bool):
    scene = SCENES[name]
    size, module = (scene.width, scene.height), load_extension(isa)
    splats, background = splats_of(tuple(tensor.detach() for tensor in scene.tensors))
    assert_first_gradients_are_those_of_all(
        lambda: rasterize_vjp(splats, background, *size, depth=depth, module=module)[1], len(splats.depths), *size
    )


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("order", ["as they come", "near first", "far first"])
def test_so_they_have_in_several_slabs(order: str, isa: str):
    scene = crowd(True)
    splats, background = splats_of(tuple(tensor.detach() for tensor in scene.tensors))
    if order != "as they come":
        rows = splats.depths.argsort(descending=order == "far first")
        splats = Splats(*(getattr(splats, field.name)[rows] for field in fields(Splats)))
    module = load_extension(isa)
    assert rasterize_vjp(splats, background, 20, 18, module=module)[1].frame.statistics["slabs"] > 1  # type: ignore
    assert_first_gradients_are_those_of_all(
        lambda: rasterize_vjp(splats, background, 20, 18, module=module)[1], len(splats.depths), 20, 18
    )


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("name", SCENES)
def test_shares_are_what_each_splat_makes_of_the_picture_and_of_what_it_lacks(name: str, isa: str) -> None:
    scene, exact = SCENES[name].to(torch.float32), SCENES[name].to(torch.float64)
    wanted = torch.rand(scene.height, scene.width, 3, generator=torch.Generator().manual_seed(3))
    size, module = (scene.width, scene.height), load_extension(isa)
    splats, background = splats_of(tuple(tensor.detach() for tensor in scene.tensors))
    expected = twin(*splats_of(tuple(tensor.detach() for tensor in exact.tensors)), *size, wanted.double())
    found = splat_contributions(splats, background, *size, wanted, module=module)
    assert_close(found.pixels, expected.pixels, 5e-5)
    assert_close(found.residual, expected.residual, 5e-5)
    alone = splat_contributions(splats, background, *size, module=module)
    assert torch.equal(alone.pixels, found.pixels)
    assert not alone.residual.any()


@pytest.mark.parametrize("threads", [1, 3, 8])
def test_shares_have_the_same_bits_for_any_number_of_threads(threads: int) -> None:
    scene = make_scene(3000, 200, 150, seed=4).to(torch.float32)
    splats, background = splats_of(tuple(tensor.detach() for tensor in scene.tensors))
    wanted = torch.rand(150, 200, 3, generator=torch.Generator().manual_seed(0))
    expected = splat_contributions(splats, background, 200, 150, wanted)
    with on_threads(threads):
        again = splat_contributions(splats, background, 200, 150, wanted)
    assert torch.equal(again.pixels, expected.pixels)
    assert torch.equal(again.residual, expected.residual)


@settings(max_examples=25)
@given(
    n=st.integers(0, 120),
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    seed=st.integers(0, 2**20),
    size=st.sampled_from([0.1, 1.0, 5.0, 60.0]),
    opacity=st.sampled_from([-4.0, 0.0, 5.0]),
)
def test_any_scene_equals_the_reference(
    n: int, width: int, height: int, seed: int, size: float, opacity: float
) -> None:
    scene = make_scene(n, width, height, seed, size=size, opacity=opacity)
    exact = reference(*splats_of(scene.to(torch.float64).tensors), width, height, depth=True)
    assert_same_picture(draw(scene, ISAS[0]), exact, 1e-4)


@pytest.mark.parametrize("isa", ISAS)
def test_median_depth_is_that_of_the_splat_that_takes_transmittance_below_one_half(isa: str) -> None:
    """Wide splats in front of each other, so that transmittance behind each is known."""

    def median_of(*layers: tuple[float, float]) -> Tensor:
        depths, opacities = (torch.tensor(column) for column in zip(*layers, strict=True))
        n = len(layers)
        means, conics = torch.full((n, 2), 10.0), torch.tensor([[1e-9, 0.0, 1e-9]]).repeat(n, 1)
        scene = Scene((means, conics, torch.ones(n, 3), opacities, depths, torch.zeros(3)), 21, 19)
        found = draw(scene, isa).median_depth
        assert torch.equal(found, reference(*splats_of(scene.tensors), 21, 19, depth=True).median_depth)
        assert (found == found[0, 0]).all()
        return found[0, 0]

    assert median_of((9.0, 0.4), (4.0, 0.3), (6.0, 0.2), (5.0, 0.25)) == 6.0  # 0.7, 0.525, 0.42 are left
    assert median_of((9.0, 0.4), (4.0, 0.3), (6.0, 0.2), (5.0, 0.3)) == 5.0
    assert median_of((3.0, 0.25), (4.0, 0.25)) == 0.0  # 0.5625 of the light passes
    assert median_of((3.0, 0.75), (4.0, 0.75)) == 3.0
    assert median_of((8.0, 0.999), (9.0, 0.999), (10.0, 0.999)) == 8.0  # the pixel is finished before the second


def test_median_depth_has_no_gradient() -> None:
    for draws in (
        draw(make_scene(50, 20, 20), ISAS[0]),
        reference(*splats_of(SCENES["ordinary"].tensors), 61, 47, depth=True),
    ):
        assert draws.depth.requires_grad
        assert not draws.median_depth.requires_grad


@pytest.mark.parametrize("isa", ISAS)
def test_gradients_equal_finite_differences_in_float64(isa: str) -> None:
    # Broad, faint splats: no threshold is crossed within a step.
    scene = make_scene(12, 20, 18, size=30.0, thinness=0.2, opacity=-1.0)
    loss_of(draw(scene, isa)).backward()
    exact = scene.to(torch.float64)
    generator = np.random.default_rng(0)
    for t, e in zip(scene.tensors, exact.tensors, strict=True):
        for _ in range(4):
            direction = torch.from_numpy(generator.normal(size=tuple(t.shape)))
            direction /= direction.norm()
            step = 1e-6 * max(1.0, float(e.detach().abs().max())) * direction
            losses = []
            for sign in (1, -1):
                moved = [x.detach() + sign * step if x is e else x.detach() for x in exact.tensors]
                losses.append(float(loss_of(reference(*splats_of(moved), scene.width, scene.height, depth=True))))
            slope = (losses[0] - losses[1]) / (2 * float(step.norm()))
            assert float((t.grad * direction).sum()) == pytest.approx(slope, rel=2e-3, abs=2e-4 * float(t.grad.norm()))


@cache
def crowd(hole: bool) -> Scene:
    """12,000 splats on four tiles."""
    scene = make_scene(12_000, 20, 18, size=1.5, opacity=-2.5)
    if hole:  # the right half stays open, so that no slab may be left out
        with torch.no_grad():
            scene.tensors[0][:, 0] *= 0.4
    return scene


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("hole", [False, True])
def test_slabs_change_nothing(isa: str, hole: bool) -> None:
    """So many entries per tile that the splats come in several slabs, and finished tiles are skipped."""
    exact, exact_gradients = exact_of(crowd(hole))
    scene = crowd(hole).to(torch.float32)
    module, picture = load_extension(isa), [torch.empty(18, 20, 3), *(torch.empty(18, 20) for _ in range(3))]
    rows = [t.detach().numpy() for t in scene.tensors[:5]]
    counted = module.rasterize_forward(
        *rows, (0.2, 0.3, 0.4), 20, 18, *(p.numpy() for p in picture), counting=True
    ).statistics
    assert counted["slabs"] > 1
    assert counted["sorted"] < 0.9 * counted["candidates"], "what is hidden is not sorted"
    actual = draw(scene, isa)
    assert all(torch.equal(a, p) for a, p in zip(actual, picture, strict=True))
    loss_of(actual).backward()
    assert_same_picture(actual, exact, 5e-5)
    for a, e in zip(scene.tensors, exact_gradients, strict=True):
        assert_close(a.grad, e, 2e-4)


def everything(scene: Scene, isa: str) -> list[np.ndarray]:
    scene = scene.to(torch.float32)
    raster = draw(scene, isa)
    loss_of(raster).backward()
    return [t.detach().numpy() for t in raster] + [t.grad.numpy() for t in scene.tensors]


@pytest.mark.parametrize("isa", ISAS)
def test_same_bits_for_any_number_of_threads(isa: str) -> None:
    module = load_extension(isa)
    before = module.threads()
    scene = make_scene(40_000, 90, 70, opacity=1.0)
    try:
        results = []
        for count in (1, 2, 3, 5):
            module.set_threads(count)
            results.append(everything(scene, isa))
    finally:
        module.set_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("isa", ISAS)
def test_several_python_threads_draw_at_once(isa: str) -> None:
    scenes = [make_scene(3000 + 500 * i, 80 + i, 60, seed=i) for i in range(4)]
    expected = [everything(s, isa) for s in scenes]
    failures: list[str] = []

    def work(i: int) -> None:
        for _ in range(5):
            for a, b in zip(everything(scenes[i], isa), expected[i], strict=True):
                if not np.array_equal(a, b):
                    failures.append(f"scene {i} differs")

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not failures


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_draws_the_same() -> None:
    scene = make_scene(3000, 80, 60)
    args = [t.detach() for t in scene.tensors]
    expected = rasterize(*splats_of(args), 80, 60).image
    child = os.fork()
    if child == 0:
        same = torch.equal(rasterize(*splats_of(args), 80, 60).image, expected)
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0


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


def test_order_of_the_rows_does_not_matter() -> None:
    scene = make_scene(500, 50, 40)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    shuffled = [t.detach()[order] if len(t) == 500 else t.detach() for t in scene.tensors]
    assert torch.equal(rasterize(*splats_of(shuffled), 50, 40).image, draw(scene, ISAS[0]).image)


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
    assert torch.equal(raster.image, draw(scene, ISAS[0]).image)
    raster.image.transpose(0, 1).square().sum().backward()
    draw(scene, ISAS[0]).image.square().sum().backward()
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
    slope = torch.autograd.grad(raster.image.square().sum(), scene.tensors[0], create_graph=True)[0]
    with pytest.raises(RuntimeError, match="differentiate twice"):
        slope.sum().backward()


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


def test_frames_are_reused_across_sizes() -> None:
    """Memory kept from one picture must not leak into the next."""
    sizes = [(3000, 90, 60), (50, 10, 10), (3000, 90, 60), (0, 33, 9), (200, 200, 5)]
    for seed, (n, width, height) in enumerate(sizes):
        scene = make_scene(n, width, height, seed=seed)
        fresh = everything(scene, ISAS[0])
        gc.collect()
        load_extension(ISAS[0]).drop_idle_frames()
        for a, b in zip(fresh, everything(scene, ISAS[0]), strict=True):
            np.testing.assert_array_equal(a, b)
