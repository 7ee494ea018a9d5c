"""Single operations of `vdgs.ops`: arrays as tensors, and the kernels' own results."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.captures import camera_at
from vdgs import ops
from vdgs.errors import VdgsError
from vdgs.kernels import cpu
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder


def some_anchors(n: int = 40) -> Anchors:
    random = torch.Generator().manual_seed(1)
    positions = torch.rand(n, 3, generator=random) * 4 - 2
    draws = (torch.randn(n, *rest, generator=random) for rest in ((32,), (3, 3)))
    return Anchors(positions, *draws, torch.full((n, 6), -2.0))


def test_anchors_are_culled_and_decoded():
    anchors, camera = some_anchors(), camera_at(0.5, 0.0)
    rows = ops.cull(anchors.positions, anchors.log_scales, camera)
    assert torch.equal(rows, cpu.cull(anchors.positions, anchors.log_scales, camera))
    same = ops.cull(anchors.positions.numpy(), anchors.log_scales.numpy(), camera)
    assert isinstance(same, np.ndarray)
    assert same.tolist() == rows.tolist()
    decoder = Decoder.init_random(3, False, 0, 1, torch.Generator().manual_seed(0))
    splats = ops.decode_anchors(anchors, decoder, camera)
    again = ops.decode_anchors(anchors, decoder, camera, rows)
    assert 0 < len(splats.depths) <= 3 * len(rows)
    assert torch.equal(splats.means_px, again.means_px)


def test_gaussians_are_projected():
    random = torch.Generator().manual_seed(0)
    means = torch.rand(9, 3, generator=random).requires_grad_(True)
    quats, scales = torch.randn(9, 4, generator=random), torch.rand(9, 3, generator=random)
    camera = camera_at(0.0, 0.0)
    found = ops.project(means, quats, scales, camera)
    pixels, depths = camera.project(means.detach().double().numpy())
    np.testing.assert_allclose(found.means_px.detach().numpy(), pixels, atol=1e-3)
    np.testing.assert_allclose(found.depths.detach().numpy(), depths, rtol=1e-5)
    found.conics.sum().backward()
    assert bool(means.grad.abs().sum() > 0)
    arrays = ops.project(means.detach().numpy(), quats.numpy(), scales.numpy(), camera)
    np.testing.assert_array_equal(arrays.conics, found.conics.detach().numpy())


def test_the_loss_of_a_picture_is_zero_for_itself():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    found = ops.photometric_loss(image / 255, image)
    assert isinstance(found.loss, np.ndarray)
    assert float(found.loss) == pytest.approx(0.0, abs=1e-6)
    assert float(found.ssim) == pytest.approx(1.0, abs=1e-5)
    drawn = torch.zeros(20, 30, 3).requires_grad_(True)
    ops.photometric_loss(drawn, torch.from_numpy(image)).loss.backward()
    assert bool(drawn.grad.abs().sum() > 0)


@pytest.mark.parametrize("weight", [2.0, -1.0, float("nan"), "0.2"])
def test_a_weight_of_the_loss_is_a_share(weight):
    image = np.zeros((20, 20, 3), np.float32)
    with pytest.raises(VdgsError, match=r"^ssim_weight is .*it must be"):
        ops.photometric_loss(image, image.astype(np.uint8), ssim_weight=weight)


@pytest.mark.parametrize(
    "wrong", [{"lr": float("nan")}, {"lr": -1.0}, {"betas": (0.9, 1.0)}, {"betas": 0.9}, {"eps": -1e-8}], ids=str
)
def test_numbers_that_adam_cannot_step_by_are_named(wrong):
    moved = [np.zeros((4, 3), np.float32) for _ in range(3)]
    [name] = wrong
    with pytest.raises(VdgsError, match=f"^{name} is .*it must be"):
        ops.sparse_adam_(*moved, np.ones((4, 3), np.float32), None, 1, **({"lr": 0.1} | wrong))
    assert not any(each.any() for each in moved)


@pytest.mark.parametrize("kind", [torch.from_numpy, np.asarray], ids=["torch", "numpy"])
def test_adam_moves_the_rows_that_it_is_given_as_torch_does(kind):
    start = np.linspace(-1, 1, 12, dtype=np.float32).reshape(4, 3)
    gradient = np.linspace(1, 2, 6, dtype=np.float32).reshape(2, 3)
    parameter, first, second = (each.copy() for each in (start, np.zeros_like(start), np.zeros_like(start)))
    rows = np.array([0, 2])
    assert ops.sparse_adam_(*map(kind, (parameter, first, second, gradient, rows)), 1, lr=0.1)
    reference = torch.from_numpy(start[rows].copy()).requires_grad_(True)
    reference.grad = torch.from_numpy(gradient)
    torch.optim.Adam([reference], 0.1, eps=1e-15).step()
    np.testing.assert_allclose(parameter[rows], reference.detach().numpy(), rtol=1e-6)
    np.testing.assert_array_equal(parameter[[1, 3]], start[[1, 3]])


def test_what_adam_may_not_write_to_is_refused(tmp_path):
    np.save(tmp_path / "parameter.npy", np.ones((4, 3), np.float32))
    mapped, frozen = np.load(tmp_path / "parameter.npy", mmap_mode="r"), np.ones((4, 3), np.float32)
    frozen.setflags(write=False)

    def step(place: int, array: np.ndarray) -> bool:
        moved = [np.zeros((4, 3), np.float32) for _ in range(3)]
        moved[place] = array
        return ops.sparse_adam_(*moved, np.ones((4, 3), np.float32), None, 1, lr=0.1)

    for place, name in enumerate(("parameter", "first", "second")):
        for array in (mapped, frozen):
            with pytest.raises(ValueError, match=f"^{name} is changed in place, and the array is read-only"):
                step(place, array)
        with pytest.raises(TypeError, match=f"^{name} is changed in place, and its bytes are swapped"):
            step(place, np.ones((4, 3), ">f4"))
    assert (frozen == 1).all()
    writable = np.load(tmp_path / "parameter.npy", mmap_mode="r+")
    assert step(0, writable)
    assert (writable < 1).all()


def test_a_parameter_of_another_precision_is_named():
    moved = [np.zeros((4, 3)) for _ in range(3)]
    with pytest.raises(TypeError, match=r"^parameter must be float32, not torch\.float64"):
        ops.sparse_adam_(*moved, np.ones((4, 3)), None, 1, lr=0.1)
    first = [moved[0].astype(np.float32), *moved[1:]]
    with pytest.raises(TypeError, match=r"^first moment must be .*, torch\.float32, not torch\.float64"):
        ops.sparse_adam_(*first, np.ones((4, 3)), None, 1, lr=0.1)


def test_arrays_of_swapped_bytes_are_read():
    """As PLY files hold them."""
    given = [np.random.default_rng(0).uniform(0.1, 1, (9, n)).astype(np.float32) for n in (3, 4, 3)]
    wanted = ops.project(*given, camera_at(0.0, 0.0))
    found = ops.project(*(each.astype(">f4") for each in given), camera_at(0.0, 0.0))
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_step_is_a_whole_number_of_any_kind():
    moved = [[np.ones((4, 3), np.float32), *(np.zeros((4, 3), np.float32) for _ in range(2))] for _ in range(2)]
    for each, step in zip(moved, (3, np.int64(3)), strict=True):
        assert ops.sparse_adam_(*each, np.ones((4, 3), np.float32), None, step, lr=0.1)
    np.testing.assert_array_equal(*(each[0] for each in moved))


def test_wrong_kinds_of_arguments_are_named():
    three, camera, anchors = np.ones((9, 3), np.float32), camera_at(0.0, 0.0), some_anchors()
    quats, decoder = np.ones((9, 4), np.float32), Decoder.init_random(3, False, 2, 4, torch.Generator())
    for call, said in (
        (lambda: ops.project(three.tolist(), quats, three, camera), "means must be torch.Tensor or numpy.ndarray, not"),
        (lambda: ops.project(three, quats, None, camera), "scales must be torch.Tensor or numpy.ndarray, not NoneType"),
        (lambda: ops.project(three, quats, three, np.eye(3)), "camera must be vdgs.Camera, not ndarray"),
        (lambda: ops.cull(three, [1.0], camera), "log_scales must be torch.Tensor or numpy.ndarray, not list"),
        (lambda: ops.cull(three, three, np.eye(3)), "camera must be vdgs.Camera"),
        (lambda: ops.decode_anchors(three, decoder, camera), "anchors must be vdgs.Anchors, not ndarray"),
        (lambda: ops.decode_anchors(anchors, three, camera), "decoder must be vdgs.Decoder"),
        (lambda: ops.decode_anchors(anchors, decoder, camera, [1]), "rows must be torch.Tensor or numpy.ndarray"),
        (lambda: ops.photometric_loss([1.0], three), "image must be torch.Tensor or numpy.ndarray, not list"),
        (lambda: ops.photometric_loss(three, [1.0]), "target must be"),
        (lambda: ops.photometric_loss(three, three, [1]), "mask must be"),
        (lambda: ops.sparse_adam_([1.0], three, three, three, None, 1, lr=1.0), "parameter must be"),
        (lambda: ops.sparse_adam_(three, three, three, [1.0], None, 1, lr=1.0), "gradient must be"),
        (lambda: ops.sparse_adam_(three, three, three, three, [1], 1, lr=1.0), "rows must be"),
        (lambda: ops.sparse_adam_(three, three, three, three, None, 1.5, lr=1.0), "step must be"),
    ):
        with pytest.raises(TypeError, match="^" + said):
            call()
    for wrong in (4, -1, "a", 1.5):
        with pytest.raises(VdgsError, match=f"^image_index is '?{wrong}'?; it must be"):
            ops.decode_anchors(anchors, decoder, camera, image_index=wrong)
