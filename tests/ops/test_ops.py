"""Single operations of `vdgs.ops`: arrays as tensors, and the kernels' own results."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.captures import camera_at
from vdgs import ops
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
