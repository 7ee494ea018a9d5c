"""Color correction undoes what a quadratic can express, and only where there is enough to fit."""

from __future__ import annotations

import numpy as np
import pytest

from support.photographs import photograph, psnr
from vdgs.evaluation import metrics
from vdgs.evaluation.color_correction import correct_colors, correct_colors_affine


def directly_corrected(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The same definition, written with one dense least squares per channel and round."""
    x0, y = (each.reshape(-1, 3) / 255 for each in (image, reference))
    low, high = 0.5 / 255, 1 - 0.5 / 255
    x = x0
    for _ in range(5):
        terms = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
        design = np.column_stack([*terms, x, np.ones(len(x))])
        columns = []
        for c in range(3):
            rows = np.all([(low <= v[:, c]) & (v[:, c] <= high) for v in (x0, x, y)], axis=0)
            columns.append(design @ np.linalg.lstsq(design[rows], y[rows, c], rcond=None)[0])
        x = np.clip(np.column_stack(columns), 0, 1)
    return x.reshape(image.shape)


def distorted(reference: np.ndarray) -> np.ndarray:
    """Another exposure, white balance and some mixing of the channels."""
    mix = np.array([[0.8, 0.1, 0.0], [0.05, 0.9, 0.0], [0.0, 0.1, 1.1]])
    return metrics.to_8bit((reference / 255) @ mix.T * 0.9 + 0.04)


def test_a_change_of_exposure_and_white_balance_is_undone():
    reference = photograph(np.random.default_rng(0), 96, 128)
    image = distorted(reference)
    result = correct_colors(image, reference)
    assert result.fitted
    assert psnr(image, reference) < 30
    assert psnr(metrics.to_8bit(result.image), reference) > 45


def test_an_affine_map_undoes_exposure_and_white_balance_and_nothing_that_is_curved():
    reference = photograph(np.random.default_rng(0), 96, 128)
    image = distorted(reference)
    result = correct_colors_affine(image, reference)
    assert result.fitted
    assert psnr(metrics.to_8bit(result.image), reference) > 45
    curved = metrics.to_8bit((reference / 255) ** 2)
    affine, quadratic = correct_colors_affine(curved, reference), correct_colors(curved, reference)
    assert psnr(curved, reference) < psnr(metrics.to_8bit(affine.image), reference)
    assert psnr(metrics.to_8bit(affine.image), reference) < psnr(metrics.to_8bit(quadratic.image), reference) - 3
    black = np.zeros_like(reference)
    assert not correct_colors_affine(black, reference).fitted


def test_equals_the_direct_computation():
    rng = np.random.default_rng(1)
    reference = photograph(rng, 40, 50)
    reference[:10] = 255  # saturated in the reference, in one channel only for some
    reference[12:16, :, 1] = 0
    image = metrics.to_8bit(distorted(reference) / 255 + rng.normal(0, 0.05, reference.shape))
    result = correct_colors(image, reference)
    np.testing.assert_allclose(result.image, directly_corrected(image, reference), atol=1e-6)


def test_memory_is_bounded_without_changing_the_result():
    rng = np.random.default_rng(2)
    reference = photograph(rng)
    image = distorted(reference)
    whole = correct_colors(image, reference).image
    np.testing.assert_allclose(correct_colors(image, reference, chunk=97).image, whole, atol=1e-9)


def test_pixels_outside_the_mask_do_not_steer_the_fit():
    reference = photograph(np.random.default_rng(3), 64, 64)
    image = distorted(reference)
    mask = np.zeros((64, 64), bool)
    mask[:, :40] = True
    odd = image.copy()
    odd[:, 40:] = 255 - odd[:, 40:]
    inside = correct_colors(image, reference, mask).image[mask]
    np.testing.assert_array_equal(correct_colors(odd, reference, mask).image[mask], inside)


@pytest.mark.parametrize("value", [0, 255])
def test_a_saturated_image_comes_back_as_it_is(value: int):
    reference = photograph(np.random.default_rng(4))
    image = np.full_like(reference, value)
    result = correct_colors(image, reference)
    assert not result.fitted
    np.testing.assert_array_equal(metrics.to_8bit(result.image), image)


def test_gray_images_have_collinear_features_and_still_fit():
    gray = np.repeat(photograph(np.random.default_rng(5))[..., :1], 3, axis=2)
    result = correct_colors(metrics.to_8bit(gray / 255 * 0.8 + 0.1), gray)
    assert result.fitted
    assert psnr(metrics.to_8bit(result.image), gray) > 45
