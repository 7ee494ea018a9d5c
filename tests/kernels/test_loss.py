"""Photometric loss: the twin against its definition, the native kernel against the twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.instruction_sets import every_instruction_set, on_threads, using
from support.loss_scenes import scene, with_gradient
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu import loss as native
from vdgs.kernels.torch_ref import loss as reference

SIZES = [(1, 1), (1, 7), (3, 2), (5, 40), (37, 1), (13, 29), (64, 33), (131, 70)]


def definition(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """SSIM by its definition: weighted moments of each window, zeros outside the image."""
    offset = np.arange(11) - 5
    weight = np.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * 1.5**2))
    weight /= weight.sum()
    result = np.empty_like(image)
    x_all, y_all = (np.pad(a, ((5, 5), (5, 5), (0, 0))) for a in (image, target))
    for row, column, channel in np.ndindex(image.shape):
        x, y = (a[row : row + 11, column : column + 11, channel] for a in (x_all, y_all))
        mean_x, mean_y = (weight * x).sum(), (weight * y).sum()
        variance_x = (weight * (x - mean_x) ** 2).sum()
        variance_y = (weight * (y - mean_y) ** 2).sum()
        covariance = (weight * (x - mean_x) * (y - mean_y)).sum()
        result[row, column, channel] = (
            (2 * mean_x * mean_y + 0.01**2)
            * (2 * covariance + 0.03**2)
            / ((mean_x**2 + mean_y**2 + 0.01**2) * (variance_x + variance_y + 0.03**2))
        )
    return result


@pytest.mark.parametrize(("height", "width"), [(4, 3), (14, 17)])
def test_ssim_map_is_wang_2004_with_zero_padding(height, width):
    image, target, _ = scene(height, width)
    expected = definition(image.double().numpy(), target.numpy() / 255)
    np.testing.assert_allclose(reference.ssim_map(image, target).numpy(), expected, atol=1e-10)


def test_ssim_of_an_image_with_itself_is_one():
    _, target, _ = scene(20, 30)
    assert torch.all((reference.ssim_map(target, target) - 1).abs() < 1e-12)


def test_the_twin_combines_l1_and_ssim():
    image, target, _ = scene(20, 30)
    image = image.double()
    result = reference.photometric_loss(image, target, ssim_weight=0.3)
    l1 = (image - target / 255.0).abs().mean()
    ssim = reference.ssim_map(image, target).mean()
    torch.testing.assert_close(result.l1, l1)
    torch.testing.assert_close(result.ssim, ssim)
    torch.testing.assert_close(result.loss, 0.7 * l1 + 0.3 * (1 - ssim))


def test_gradients_of_the_twin_are_finite_differences():
    image, target, mask = scene(7, 6, kept=0.7)
    leaf = image.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: reference.photometric_loss(x, target, mask).loss, leaf, eps=1e-7)


@pytest.mark.parametrize("kept", [None, 0.7, 0.02])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_every_instruction_set_equals_the_twin(height, width, kept):
    image, target, mask = scene(height, width, kept=kept)
    truth, truth_gradient = with_gradient(reference, image.double(), target, mask)
    for instructions in extension.supported_isas():
        with using(instructions):
            result, gradient = with_gradient(native, image, target, mask)
        for value, expected in zip(result, truth, strict=True):
            assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=2e-6), instructions
        scale = float(truth_gradient.abs().max()) + 1e-12
        assert float((gradient - truth_gradient).abs().max()) < 1e-4 * scale, instructions


@settings(max_examples=25)
@given(st.integers(1, 90), st.integers(1, 40), st.floats(0, 1), st.integers(0, 99))
def test_native_equals_twin_at_any_size(height, width, weight, seed):
    image, target, mask = scene(height, width, seed, kept=0.8)
    truth, truth_gradient = with_gradient(reference, image.double(), target, mask, ssim_weight=weight)
    result, gradient = with_gradient(native, image, target, mask, ssim_weight=weight)
    assert float(result.loss.detach()) == pytest.approx(float(truth.loss.detach()), abs=2e-6)
    scale = float(truth_gradient.abs().max()) + 1e-12
    assert float((gradient - truth_gradient).abs().max()) < 1e-4 * scale


@every_instruction_set
def test_same_bits_for_any_number_of_threads(instructions):
    image, target, mask = scene(230, 57, kept=0.9)
    results = []
    with using(instructions):
        for threads in (1, 2, 3):
            with on_threads(threads):
                results.append(with_gradient(native, image, target, mask))
    for result, gradient in results[1:]:
        assert torch.equal(gradient, results[0][1])
        assert [float(v.detach()) for v in result] == [float(v.detach()) for v in results[0][0]]


@pytest.mark.parametrize("implementation", [reference, native])
class TestMeaning:
    def test_a_perfect_image_has_no_loss(self, implementation):
        _, target, _ = scene(20, 30)
        result, _ = with_gradient(implementation, target.float() / 255, target)
        assert float(result.loss.detach()) == pytest.approx(0, abs=1e-6)
        assert float(result.ssim) == pytest.approx(1, abs=1e-5)

    def test_what_lies_under_the_mask_is_without_effect(self, implementation):
        image, target, mask = scene(40, 30, kept=0.6)
        other = torch.where(mask[..., None] != 0, image, torch.full_like(image, torch.nan))
        result, gradient = with_gradient(implementation, image, target, mask)
        again, gradient_again = with_gradient(implementation, other, target, mask)
        assert float(result.loss.detach()) == float(again.loss.detach())
        assert torch.equal(gradient, gradient_again)
        assert torch.all(gradient[mask == 0] == 0)
        assert torch.any(gradient[mask != 0] != 0)

    def test_a_mask_that_keeps_all_is_no_mask(self, implementation):
        image, target, _ = scene(40, 30)
        result, gradient = with_gradient(implementation, image, target, torch.ones(40, 30, dtype=torch.uint8))
        plain, plain_gradient = with_gradient(implementation, image, target)
        assert float(result.loss.detach()) == pytest.approx(float(plain.loss.detach()), rel=1e-6)
        torch.testing.assert_close(gradient, plain_gradient)

    def test_nothing_kept_means_no_loss_and_no_gradient(self, implementation):
        image, target, _ = scene(12, 17)
        result, gradient = with_gradient(implementation, image, target, torch.zeros(12, 17, dtype=torch.uint8))
        assert [float(value.detach()) for value in result] == [0.0, 0.0, 1.0]
        assert torch.all(gradient == 0)

    @pytest.mark.parametrize("bad", [torch.nan, torch.inf])
    def test_a_value_that_is_not_finite_is_reported(self, implementation, bad):
        image, target, _ = scene(30, 30)
        image[3, 4, 1] = bad
        assert not torch.isfinite(with_gradient(implementation, image, target)[0].loss)

    def test_the_gradient_scales_with_what_follows(self, implementation):
        image, target, _ = scene(20, 14)
        leaf = image.clone().requires_grad_()
        (3 * implementation.photometric_loss(leaf, target).loss).backward()
        _, gradient = with_gradient(implementation, image, target)
        torch.testing.assert_close(leaf.grad, 3 * gradient)

    def test_a_second_pass_through_a_kept_graph_adds_the_same_gradient(self, implementation):
        image, target, _ = scene(20, 14)
        leaf = image.clone().requires_grad_()
        loss = implementation.photometric_loss(leaf * 1, target).loss
        loss.backward(retain_graph=True)
        once = leaf.grad.clone()
        (2 * loss).backward(retain_graph=True)
        loss.backward()
        torch.testing.assert_close(leaf.grad, 4 * once)

    @pytest.mark.parametrize("kept", [None, 0.7])
    def test_without_autograd_it_is_the_same_to_the_bit(self, implementation, kept):
        image, target, mask = scene(23, 17, kept=kept)
        expected, gradient = with_gradient(implementation, image, target, mask, ssim_weight=0.3)
        found, same_gradient = implementation.photometric_loss_vjp(image, target, mask, ssim_weight=0.3)
        assert all(torch.equal(one.detach(), other) for one, other in zip(expected, found, strict=True))
        assert torch.equal(gradient, same_gradient)
        assert not any(value.requires_grad for value in (*found, same_gradient))

    def test_only_the_loss_carries_a_gradient(self, implementation):
        image, target, _ = scene(8, 8)
        result = implementation.photometric_loss(image.requires_grad_(), target)
        assert [value.requires_grad for value in result] == [True, False, False]
        plain = implementation.photometric_loss(image.detach(), target)
        assert not plain.loss.requires_grad
        assert float(plain.loss) == float(result.loss.detach())

    def test_strided_inputs_are_read_as_they_are(self, implementation):
        image, target, mask = scene(24, 18, kept=0.7)
        turned = [tensor.transpose(0, 1) for tensor in (image, target, mask)]
        strided, gradient = with_gradient(implementation, *turned)
        dense, dense_gradient = with_gradient(implementation, *(tensor.contiguous() for tensor in turned))
        assert float(strided.loss.detach()) == float(dense.loss.detach())
        assert torch.equal(gradient, dense_gradient)

    @pytest.mark.parametrize(
        ("image", "target", "mask", "error"),
        [
            (torch.zeros(4, 4, 3).half(), torch.zeros(4, 4, 3).byte(), None, TypeError),
            (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), None, TypeError),
            (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3).byte(), torch.ones(4, 4), TypeError),
            (torch.zeros(4, 4), torch.zeros(4, 4).byte(), None, (ValueError, TypeError)),
            (torch.zeros(0, 4, 3), torch.zeros(0, 4, 3).byte(), None, ValueError),
            (torch.zeros(4, 4, 3), torch.zeros(4, 5, 3).byte(), None, (ValueError, TypeError)),
            (
                torch.zeros(4, 4, 3),
                torch.zeros(4, 4, 3).byte(),
                torch.ones(5, 4).byte(),
                (ValueError, TypeError),
            ),
        ],
    )
    def test_unsuitable_inputs_are_refused(self, implementation, image, target, mask, error):
        with pytest.raises(error, match=r"image|target|mask"):
            implementation.photometric_loss(image, target, mask)
