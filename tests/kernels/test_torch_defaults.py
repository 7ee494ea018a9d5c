"""torch's default dtype, which pose graphs and calibrations set to float64, changes no bit of any result; nor does its
default device, which programs for gsplat set to their card."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import vdgs
from support.captures import camera_at
from support.small_training import bits, run, stage, start
from vdgs import ops
from vdgs.kernels import cpu
from vdgs.kernels.kernel_types import DensificationStats, MergedGaussians, Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder

PACKAGE = Path(vdgs.__file__).parent
#: What torch makes in its default dtype unless it is told another, and what also on its default device.
MAKERS = {"empty", "eye", "full", "linspace", "ones", "rand", "randn", "tensor", "zeros"}
MAKERS_ON_A_DEVICE = MAKERS | {
    "arange", "as_tensor", "asarray", "logspace", "randint", "randperm", "scalar_tensor", "tril_indices",
    "triu_indices",
}  # fmt: skip
CAMERA = camera_at(0.0, 0.0)


@pytest.fixture(params=["float64", "another device"])
def other_defaults(request):
    """float64, or a device that is not the CPU (and has no numbers), as the default, from the call on."""
    if request.param == "float64":
        yield lambda: torch.set_default_dtype(torch.float64)
        torch.set_default_dtype(torch.float32)
    else:
        yield lambda: torch.set_default_device("meta")
        torch.set_default_device(None)


def floats(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
    drawn = np.random.default_rng(sum(shape)).uniform(low, high, shape)
    return torch.from_numpy(drawn.astype(np.float32))


def gaussians(n: int = 50) -> dict[str, torch.Tensor]:
    return {
        "means": floats(n, 3), "quats": floats(n, 4), "scales": floats(n, 3, low=0.05, high=0.4),
        "opacities": floats(n, low=0.2, high=0.9),
    }  # fmt: skip


def rasterization(packed: bool, poses: bool = False, **options):
    K = [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]
    given = gaussians() | {"colors": floats(50, 4, 3) if "sh_degree" in options else floats(50, 3, low=0.0)}
    given["viewmats"] = torch.from_numpy(CAMERA.camera_from_world.astype(np.float32))[None]
    moved = [each.requires_grad_() for name, each in given.items() if poses or name != "viewmats"]
    picture, alpha, meta = ops.rasterization(
        **given, Ks=torch.tensor([K], dtype=torch.float32, device="cpu"), width=CAMERA.width, height=CAMERA.height,
        packed=packed, **options,
    )  # fmt: skip
    gradients = torch.autograd.grad((picture.square().sum() + alpha.sum()), moved)
    return picture, alpha, *gradients, *(meta[name] for name in sorted(meta))


def splats(n: int = 50) -> Splats:
    conics = torch.tensor([[0.1, 0.01, 0.2]], dtype=torch.float32, device="cpu").repeat(n, 1)
    depths, opacities = floats(n, low=1.0, high=2.0), floats(n, low=0.2, high=0.9)
    return Splats(floats(n, 2, low=0.0, high=30.0), conics, depths, floats(n, 3), opacities)


def loss():
    image = floats(20, 30, 3, low=0.0).requires_grad_()
    target = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8))
    found = ops.photometric_loss(image, target)
    return *found, *torch.autograd.grad(found.loss, image)


def loss_vjp():
    target = torch.zeros(20, 30, 3, dtype=torch.uint8, device="cpu")
    found, gradient = cpu.photometric_loss_vjp(floats(20, 30, 3, low=0.0), target)
    return *found, gradient


def adam():
    parameter, first, second = floats(4, 3), torch.zeros_like(floats(4, 3)), torch.zeros_like(floats(4, 3))
    ops.sparse_adam_(parameter, first, second, floats(4, 3), None, 1, lr=0.1)
    return parameter, first, second


def merged():
    means, one = floats(9, 3), floats(9, low=0.5, high=1.0)
    columns = [floats(9, 3, low=-3.0, high=-1.0), floats(9, 4), one, floats(9, 3), floats(9, 3, 3), one, one, one]
    return cpu.merged_splats([MergedGaussians(means, *columns, floats(9, 3), one)], CAMERA).tensors


def random_model() -> AnchorModel:
    anchors = Anchors(floats(40, 3), floats(40, 32), floats(40, 3, 3), floats(40, 6, low=-3.0, high=-1.0))
    decoder = Decoder.init_random(3, False, 2, 4, torch.Generator().manual_seed(0))
    decoder = replace(decoder, envmap=floats(8, 16, 3, low=0.0))
    return AnchorModel(anchors=anchors, decoder=decoder, voxel_size=0.1, background=(0.1, 0.2, 0.3))


def drawn():
    return vdgs.render(vdgs.Scene(random_model()), CAMERA, mode="rgb+depth", image_index=1)


def statistics():
    sums = DensificationStats.zeros(4, 3)
    visible, source = STARTS - STARTS.new_tensor([0, 1]), STARTS.new_tensor([0, 4], dtype=torch.int32)
    cpu.add_view_statistics(sums, visible, visible >= 0, source, floats(2, low=0.1), floats(2, 2), 8, 8)
    return tuple(sums.tensors().values())


STARTS = torch.tensor([0, 3], dtype=torch.int64)
RESULTS = {
    "rasterization, packed": lambda: rasterization(True),
    "rasterization, all rows": lambda: rasterization(False),
    "rasterization with depth": lambda: rasterization(True, render_mode="RGB+ED"),
    "rasterization of harmonics, antialiased": lambda: rasterization(
        True, sh_degree=1, rasterize_mode="antialiased", poses=True
    ),
    "project": lambda: ops.project(*list(gaussians().values())[:3], CAMERA),
    "photometric_loss": loss,
    "photometric_loss_vjp": loss_vjp,
    "sparse_adam_": adam,
    "render": drawn,
    "count_visibility": lambda: (vdgs.count_visibility(floats(30, 3), [CAMERA]),),
    "visibility_ratio": lambda: (vdgs.visibility_ratio(floats(30, 3), [CAMERA]),),
    "splat_contributions": lambda: tuple(cpu.splat_contributions(splats(), floats(3), 30, 20)),
    "merged_splats": merged,
    "mean_ellipsoids": lambda: cpu.mean_ellipsoids(floats(7, 3), floats(7, 4), floats(7, low=0.1), STARTS),
    "fit_harmonics": lambda: (
        cpu.fit_harmonics(floats(7, 3), floats(7, 3), floats(7, low=0.1), STARTS, 1, 0.1),
    ),
    "harmonic_colors": lambda: (cpu.harmonic_colors(floats(2, 3), floats(9, 12), STARTS, floats(3), 1),),
    "fade_factors": lambda: (cpu.fade_factors(floats(30, 3), [CAMERA], 1, 0.1),),
    "fade_factors of no camera": lambda: (cpu.fade_factors(floats(30, 3), [], 1, 0.1),),
    "add_view_statistics": statistics,
}  # fmt: skip


@pytest.mark.parametrize("name", RESULTS)
def test_results_are_the_same_to_the_last_bit(name, other_defaults):
    wanted = RESULTS[name]()
    other_defaults()
    for found, expected in zip(RESULTS[name](), wanted, strict=True):
        if isinstance(expected, torch.Tensor):
            assert (found.dtype, found.device) == (expected.dtype, expected.device)
            assert found.detach().numpy().tobytes() == expected.detach().numpy().tobytes()
            assert expected.numel() > 0
        else:
            assert found == expected


def test_so_are_gradients_of_a_picture_drawn_before(other_defaults):
    given = splats()
    moved = given.colors.requires_grad_(True)
    raster = cpu.rasterize(given, floats(3), 30, 20)
    (wanted,) = torch.autograd.grad(raster.image.square().sum(), moved, retain_graph=True)
    other_defaults()
    assert torch.equal(torch.autograd.grad(raster.image.square().sum(), moved)[0], wanted)


def test_so_is_a_trained_model(other_defaults):
    wanted, again = bits(run(start(), stage())), (start(), stage())
    other_defaults()
    assert bits(run(*again)) == wanted


def test_no_file_leaves_the_dtype_or_the_device_to_torch():
    """Of what a kernel fills, its binding would convert a float64 one into a copy and lose what it wrote, and not know
    one on another device."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            if ast.unparse(node.func.value) != "torch" or node.func.attr not in MAKERS_ON_A_DEVICE:
                continue
            wanted = {"device"} | ({"dtype"} if node.func.attr in MAKERS else set())
            if not wanted <= {word.arg for word in node.keywords}:
                found.append(f"{file.relative_to(PACKAGE)}:{node.lineno} {ast.unparse(node)}")
    assert found == []


@pytest.mark.parametrize("spoil", [lambda t: t.double(), lambda t: t.repeat(1, 2)[:, : t.shape[1]]])
def test_what_a_kernel_cannot_fill_is_refused(spoil):
    raster, pullback = cpu.rasterize_vjp(splats(), floats(3), 30, 20)
    out = spoil(torch.empty(50, 2, dtype=torch.float32)), torch.empty(50, 3, dtype=torch.float32)
    with pytest.raises(TypeError, match="means must be float32 and contiguous"):
        pullback(raster.image, out=out)
