"""PSNR, SSIM and the bins by visibility against direct computations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import convolve

from support.photographs import noisy, photograph, psnr, real_photographs, ssim
from vdgs.evaluation import metrics
from vdgs.evaluation.by_visibility import VisibilityHistogram, format_bounds, quantile_groups, view_bins
from vdgs.evaluation.metrics import MAX_PSNR_DB, psnr_from_mse


def direct_ssim_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """SSIM written out with a full two-dimensional window, zero padded."""
    offset = np.arange(11) - 5
    window = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def blur(plane: np.ndarray) -> np.ndarray:
        return convolve(plane, window, mode="constant", cval=0)

    maps = []
    for channel in range(3):
        x, y = image[..., channel] / 255, reference[..., channel] / 255
        mx, my = blur(x), blur(y)
        sxx, syy, sxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
        top = (2 * mx * my + 0.01**2) * (2 * sxy + 0.03**2)
        maps.append(top / ((mx * mx + my * my + 0.01**2) * (sxx + syy + 0.03**2)))
    return np.mean(maps, axis=0)


def test_psnr_of_a_known_error():
    black = np.zeros((7, 9, 3), np.uint8)
    one_level = np.ones_like(black)
    assert psnr(one_level, black) == pytest.approx(20 * math.log10(255))
    assert psnr(np.full_like(black, 255), black) == pytest.approx(0.0)
    assert psnr(black, black) == MAX_PSNR_DB == 100.0  # not infinite, so that means with equal images are figures
    assert psnr_from_mse(1e-12) == 100.0
    assert math.isnan(psnr_from_mse(math.nan))


def test_psnr_equals_the_definition():
    rng = np.random.default_rng(0)
    reference = photograph(rng)
    image = noisy(reference, rng)
    error = np.mean((image / 255 - reference / 255) ** 2)
    assert psnr(image, reference) == pytest.approx(-10 * math.log10(error), rel=1e-12)


def test_masked_pixels_change_no_metric():
    rng = np.random.default_rng(1)
    reference = photograph(rng)
    image = noisy(reference, rng)
    mask = np.ones(reference.shape[:2], bool)
    mask[10:30, 20:50] = False
    ruined = np.where(mask[..., None], image, 0).astype(np.uint8)
    for metric in (psnr, ssim):
        assert metric(ruined, reference, mask) == metric(image, reference, mask)
        assert metric(ruined, reference) < metric(image, reference)
        assert math.isnan(metric(image, reference, np.zeros_like(mask)))


def test_ssim_equals_the_direct_computation():
    rng = np.random.default_rng(2)
    for height, width in ((48, 64), (13, 7), (5, 40)):
        reference = photograph(rng, height, width)
        image = noisy(reference, rng, 0.1)
        expected = direct_ssim_map(image, reference)
        np.testing.assert_allclose(metrics.ssim_map(image, reference), expected, atol=1e-10)
        assert ssim(image, reference) == pytest.approx(expected.mean(), abs=1e-10)


def test_ssim_is_one_only_for_the_same_image_and_symmetric():
    rng = np.random.default_rng(3)
    reference = photograph(rng)
    image = noisy(reference, rng)
    assert ssim(reference, reference) == pytest.approx(1.0, abs=1e-12)
    assert ssim(image, reference) == pytest.approx(ssim(reference, image), abs=1e-12) != 1.0


def test_wrong_images_are_refused():
    good = np.zeros((8, 8, 3), np.uint8)
    refused = (ValueError, TypeError)  # the latter from the check of annotations, where that runs
    with pytest.raises(refused, match=r"(?i)uint8"):
        psnr(good.astype(np.float32), good)
    with pytest.raises(refused):
        ssim(good, good[:4])


def test_rounding_to_8_bits():
    values = np.array([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 0.5, 1.0, 2.0]).reshape(1, 7, 1)
    assert metrics.to_8bit(values).ravel().tolist() == [0, 0, 0, 1, 128, 255, 255]


@given(st.lists(st.integers(0, 60), min_size=1, max_size=300), st.integers(1, 9))
@settings(max_examples=60)
def test_quantile_bins_partition_the_pixels(visibility: list[int], n_bins: int):
    values = np.array(visibility, dtype=np.float64)[None]
    errors = np.linspace(0.01, 0.5, values.size)[None]
    histogram = VisibilityHistogram(["squared_error", "ssim"])
    half = values.size // 2
    histogram.add(values[:, :half], {"squared_error": errors[:, :half], "ssim": errors[:, :half]})
    histogram.add(values[:, half:], {"squared_error": errors[:, half:], "ssim": errors[:, half:]})
    bins = histogram.bins(n_bins)
    assert 1 <= len(bins) <= n_bins
    assert sum(each["pixels"] for each in bins) == values.size
    covered = np.zeros(values.shape, bool)
    for each in bins:
        inside = (values >= each["lower"]) & (values <= each["upper"])
        assert not (covered & inside).any()
        covered |= inside
        assert inside.sum() == each["pixels"]
        assert each["ssim"] == pytest.approx(errors[inside].mean())
        assert each["psnr"] == pytest.approx(-10 * np.log10(errors[inside].mean()))
    assert covered.all()


def test_bins_of_many_different_values_are_equal_shares():
    rng = np.random.default_rng(4)
    visibility = rng.gamma(2.0, 300.0, (200, 300)).astype(np.float32)
    histogram = VisibilityHistogram(["ssim"])
    histogram.add(visibility, {"ssim": np.ones_like(visibility)})
    bins = histogram.bins(5)
    assert [each["pixels"] / visibility.size for each in bins] == pytest.approx([0.2] * 5, abs=2e-3)
    edges = np.quantile(visibility, [0.2, 0.4, 0.6, 0.8])
    assert [each["upper"] for each in bins[:-1]] == pytest.approx(edges, rel=5e-3)


def test_bins_are_of_whole_cameras():
    rng = np.random.default_rng(1)
    visibility = rng.uniform(0.4, 9.3, (60, 80)).astype(np.float32)
    histogram = VisibilityHistogram(["ssim"])
    histogram.add(visibility, {"ssim": visibility.astype(np.float64)})
    bins = histogram.bins(4)
    ends = [each[end] for each in bins for end in ("lower", "upper")]
    assert ends == sorted(round(end) for end in ends)
    assert all(low == high + 1 for high, low in zip(ends[1:-1:2], ends[2::2], strict=True))
    for each in bins:
        inside = (np.rint(visibility) >= each["lower"]) & (np.rint(visibility) <= each["upper"])
        assert inside.sum() == each["pixels"]
    assert [format_bounds(*ends) for ends in ((3.0, 5.0), (4.0, 4.0), (9.0, 12345.0))] == [
        "3 to 5", "4", "9 to 12,345",
    ]  # fmt: skip


def test_pixels_that_show_nothing_have_their_own_bin():
    visibility = np.array([[np.nan, np.nan, 1.0, 2.0]])
    mask = np.array([[True, False, True, True]])
    histogram = VisibilityHistogram(["squared_error"])
    histogram.add(visibility, {"squared_error": np.array([[1.0, 1.0, 0.01, 0.001]])}, mask)
    first, *rest = histogram.bins(2)
    assert (first["lower"], first["upper"], first["pixels"]) == (None, None, 1)
    assert [each["psnr"] for each in rest] == pytest.approx([20.0, 30.0])


def test_views_by_visibility():
    figures = [{"psnr": 10.0 * i, "lpips_vgg": None} for i in range(5)]
    bins = view_bins([5.0, 1.0, np.nan, 3.0, 1.0], figures, n_bins=2)
    assert [each["views"] for each in bins] == [2, 2]
    assert [each["psnr"] for each in bins] == [25.0, 15.0]
    assert [(each["lower"], each["upper"]) for each in bins] == [(1.0, 1.0), (3.0, 5.0)]
    assert all(each["lpips_vgg"] is None for each in bins)
    assert quantile_groups(np.array([], dtype=int), 3) == []
    # A class belongs to the share that holds its middle member: that of 4, 4 and 2 are the 2nd, 6th and 9th of 10.
    assert [group.tolist() for group in quantile_groups(np.array([4, 4, 2]), 2)] == [[0], [1, 2]]
    assert [group.tolist() for group in quantile_groups(np.array([8, 1, 1]), 2)] == [[0], [1, 2]]


@pytest.mark.capture
def test_on_a_photograph():
    (reference,) = real_photographs("copr", 1)
    image = noisy(reference, np.random.default_rng(5), 0.03)
    assert psnr(image, reference) == pytest.approx(-20 * math.log10(0.03), abs=0.2)
    expected = direct_ssim_map(image, reference).mean()
    assert ssim(image, reference) == pytest.approx(expected, abs=1e-10)
