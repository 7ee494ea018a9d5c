"""gsplat behind the own operations: its own Python, with a stand-in for what it compiles (support/fake_gsplat.py)."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch

from support import fake_gsplat
from support.rasterize_scenes import (
    assert_close,
    assert_first_gradients_are_those_of_all,
    loss_of,
    make_scene,
    smooth,
    splats_of,
)
from vdgs.errors import VdgsError
from vdgs.kernels.gsplat import GsplatUnavailable, load_gsplat, rasterize, rasterize_vjp, splat_radii_px
from vdgs.kernels.torch_ref.rasterize import rasterize as reference
from vdgs.kernels.torch_ref.rasterize import rasterize_vjp as reference_vjp

SCENES = {
    "ordinary": make_scene(120, 37, 29),
    "dense": make_scene(250, 20, 18, opacity=2.0),
    "huge": make_scene(40, 33, 33, size=200.0, opacity=-2.0),
    "tiny": make_scene(200, 20, 20, size=0.05),
    "edge-on": make_scene(80, 25, 35, size=4.0, thinness=2.0),
    "off-screen": make_scene(100, 20, 20, margin=4.0),
    "empty": make_scene(0, 20, 10),
    "one pixel": make_scene(10, 1, 1, size=1.0),
}


@pytest.fixture
def _compiled(monkeypatch: pytest.MonkeyPatch):
    fake_gsplat.install(monkeypatch)


@fake_gsplat.needs_gsplat
@pytest.mark.usefixtures("_compiled")
@pytest.mark.parametrize("name", SCENES)
def test_it_draws_and_differentiates_what_the_reference_does(name):
    scene = SCENES[name]
    ours = rasterize(*splats_of(scene.tensors), scene.width, scene.height, depth=True)
    exact_scene = scene.to(torch.float64)
    exact = reference(*splats_of(exact_scene.tensors), scene.width, scene.height, depth=True)
    for actual, expected in zip(smooth(ours), smooth(exact), strict=True):
        assert actual.shape == expected.shape
        assert_close(actual, expected, 1e-4)
    used = scene.tensors if name != "empty" else scene.tensors[5:]
    wanted = exact_scene.tensors if name != "empty" else exact_scene.tensors[5:]
    gradients = torch.autograd.grad(loss_of(ours), used, allow_unused=True)
    for actual, expected in zip(gradients, torch.autograd.grad(loss_of(exact), wanted), strict=True):
        assert_close(actual, expected, 1e-3)


@fake_gsplat.needs_gsplat
@pytest.mark.usefixtures("_compiled")
def test_the_way_back_gives_what_training_asks_for():
    """Gradients of the means in pixels and of the conics go where they are wanted; a picture without depth has none."""
    scene, exact = SCENES["ordinary"], SCENES["ordinary"].to(torch.float64)
    raster, pullback = rasterize_vjp(*splats_of(scene.tensors), scene.width, scene.height)
    _, exactly = reference_vjp(*splats_of(exact.tensors), scene.width, scene.height)
    assert (raster.depth, raster.median_depth) == (None, None)
    assert not raster.image.requires_grad
    g = torch.Generator().manual_seed(3)
    by_image, by_alpha = torch.randn(29, 37, 3, generator=g), torch.randn(29, 37, generator=g)
    room = torch.zeros(len(scene.tensors[0]), 2), torch.zeros(len(scene.tensors[0]), 3)
    found = pullback(by_image, by_alpha, out=room)
    assert found.means_px is room[0]
    assert found.conics is room[1]
    assert found.depths is None
    for name, expected in exactly(by_image.double(), by_alpha.double())._asdict().items():
        if expected is not None:
            assert_close(getattr(found, name), expected, 1e-4)


@fake_gsplat.needs_gsplat
@pytest.mark.usefixtures("_compiled")
def test_gradients_of_the_first_splats_are_those_that_they_have_among_all():
    scene = SCENES["ordinary"]
    size, (splats, background) = (scene.width, scene.height), splats_of(scene.tensors)
    assert_first_gradients_are_those_of_all(
        lambda: rasterize_vjp(splats, background, *size)[1], len(splats.depths), *size
    )


def test_unsuitable_arguments_are_refused():
    scene, engine = SCENES["ordinary"], SimpleNamespace()
    with pytest.raises(TypeError, match="means_px must be float32"):
        rasterize(*splats_of(scene.to(torch.float64).tensors), 37, 29, engine=engine)
    with pytest.raises(ValueError, match="width"):
        rasterize(*splats_of(scene.tensors), 0, 29, engine=engine)


def test_without_compiled_kernels_the_error_says_so(monkeypatch: pytest.MonkeyPatch):
    for name in ("gsplat", "gsplat.cuda._backend"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(_C=None))  # type: ignore[arg-type]
    with pytest.raises(GsplatUnavailable, match="no CUDA toolkit"):
        load_gsplat()


@pytest.mark.parametrize("column", range(5))
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_rows_that_are_not_finite_are_not_drawn(column, value):
    tensors = [tensor.detach().clone() for tensor in SCENES["ordinary"].tensors]
    tensors[column].view(len(tensors[column]), -1)[3, 0] = value
    reach = splat_radii_px(splats_of(tensors)[0])
    assert torch.all(reach[3] == 0)
    assert torch.any(reach > 0)


@pytest.mark.parametrize("conic", [(-1.0, 0.0, 1.0), (1.0, 2.0, 1.0), (0.0, 0.0, 0.0)])
def test_conics_that_are_not_positive_definite_are_not_drawn(conic):
    tensors = [tensor.detach().clone() for tensor in SCENES["ordinary"].tensors]
    tensors[1][5] = torch.tensor(conic)
    assert torch.all(splat_radii_px(splats_of(tensors)[0])[5] == 0)


def test_without_gsplat_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    scene = SCENES["ordinary"]
    with pytest.raises(GsplatUnavailable, match=r"import of gsplat halted.*vdgs\[gsplat\]") as raised:
        rasterize(*splats_of(scene.tensors), scene.width, scene.height)
    assert isinstance(raised.value, VdgsError)


@pytest.mark.gpu
@pytest.mark.parametrize("name", SCENES)
def test_gsplat_itself_draws_what_the_reference_does(name):
    pytest.importorskip("gsplat")
    scene = SCENES[name]
    there = [tensor.detach().cuda().requires_grad_() for tensor in scene.tensors]
    ours = rasterize(*splats_of(there), scene.width, scene.height, depth=True)
    exact = reference(*splats_of(scene.to(torch.float64).tensors), scene.width, scene.height, depth=True)
    for actual, expected in zip(smooth(ours), smooth(exact), strict=True):
        assert_close(actual.cpu(), expected, 1e-3)
