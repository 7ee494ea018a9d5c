"""The rasterizer: what it draws and how that changes with its input."""

from __future__ import annotations

import gc
import os
import threading
from dataclasses import fields
from functools import cache, partial

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
    draw,
    loss_of,
    make_scene,
    splats_of,
)
from vdgs.kernels import constants
from vdgs.kernels.cpu.extension import load_extension, supported_isas
from vdgs.kernels.cpu.rasterize import rasterize, rasterize_vjp, splat_contributions
from vdgs.kernels.kernel_types import Raster, SplatContributions, Splats
from vdgs.kernels.torch_ref.rasterize import rasterize as reference
from vdgs.kernels.torch_ref.rasterize import splat_contributions as twin

ISAS = supported_isas()
NAMES = ("means_px", "conics", "colors", "opacities", "depths", "background")


SCENES = {
    "ordinary": make_scene(300, 45, 37),
    "dense": make_scene(1200, 33, 29, opacity=2.0),
    "huge": make_scene(100, 50, 50, size=200.0, opacity=-2.0),
    "tiny": make_scene(800, 36, 36, size=0.05),
    "edge-on": make_scene(200, 40, 50, size=4.0, thinness=2.0),
    "off-screen": make_scene(300, 20, 20, margin=4.0),
    "opaque": make_scene(200, 33, 17, size=6.0, opacity=30.0),
    "empty": make_scene(0, 20, 10),
    "one pixel": make_scene(30, 1, 1, size=1.0),
    "one row": make_scene(100, 70, 1),
}


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
def test_picture_and_gradients_equal_the_reference(isa: str) -> None:
    for name, each in SCENES.items():
        scene, (exact, exact_gradients) = each.to(torch.float32), exact_of(each)
        actual = draw(scene, isa)
        assert_same_picture(actual, exact, 2e-5)
        loss_of(actual).backward()
        for a, e in zip(scene.tensors, exact_gradients, strict=True):
            # A mean or conic is known to 6e-8; a splat seen edge-on multiplies that.
            assert_close(a.grad, e, 2e-3 if name == "edge-on" else 5e-5)


@pytest.mark.parametrize("isa", ISAS)
@pytest.mark.parametrize("depth", [False, True])
def test_gradients_of_the_first_splats_alone_have_the_bits_that_they_have_among_all(isa: str, depth: bool) -> None:
    module = load_extension(isa)
    for scene in SCENES.values():
        size, (splats, background) = (scene.width, scene.height), splats_of(tuple(t.detach() for t in scene.tensors))
        pullback = partial(rasterize_vjp, splats, background, *size, depth=depth, module=module)
        assert_first_gradients_are_those_of_all(lambda vjp=pullback: vjp()[1], len(splats.depths), *size)


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


@cache
def exact_shares(scene: Scene) -> tuple[Tensor, SplatContributions]:
    """A picture to be, and what the reference finds of it; once for all instruction sets."""
    wanted = torch.rand(scene.height, scene.width, 3, generator=torch.Generator().manual_seed(3))
    splats = splats_of(tuple(tensor.detach() for tensor in scene.to(torch.float64).tensors))
    return wanted, twin(*splats, scene.width, scene.height, wanted.double())


@pytest.mark.parametrize("isa", ISAS)
def test_shares_are_what_each_splat_makes_of_the_picture_and_of_what_it_lacks(isa: str) -> None:
    module = load_extension(isa)
    for each in SCENES.values():
        scene, (wanted, expected) = each.to(torch.float32), exact_shares(each)
        size, (splats, background) = (scene.width, scene.height), splats_of(tuple(t.detach() for t in scene.tensors))
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
        reference(*splats_of(SCENES["ordinary"].tensors), 45, 37, depth=True),
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
    """8000 splats on four tiles."""
    scene = make_scene(8000, 20, 18, size=1.5, opacity=-2.5)
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


def test_frames_are_reused_across_sizes() -> None:
    """Memory kept from one picture must not leak into the next."""
    sizes = [(3000, 90, 60), (50, 10, 10), (3000, 90, 60), (0, 33, 9), (200, 200, 5)]
    for seed, (n, width, height) in enumerate(sizes):
        scene = make_scene(n, width, height, seed=seed)
        fresh = everything(scene, ISAS[0])
        gc.collect(1)
        load_extension(ISAS[0]).drop_idle_frames()
        for a, b in zip(fresh, everything(scene, ISAS[0]), strict=True):
            np.testing.assert_array_equal(a, b)
