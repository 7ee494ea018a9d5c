"""PSNR and SSIM of 8-bit images, as they are saved.

Names and dimensions:

    image      uint8 [h, w, 3], what the model rendered, rounded to 8 bits
    reference  uint8 [h, w, 3], the photograph
    mask       bool [h, w], true where a pixel counts; None: everywhere

Papers measure on 8-bit files, so these functions take nothing else: rounding is part of the metric.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

#: SSIM (Wang et al. 2004) as 3DGS computes it: 11 x 11 Gaussian window, zero padding, data range 1.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
#: PSNR is at most this, as in training logs: of equal images it would be infinite, and so would a mean with one.
MAX_PSNR_DB = 100.0


def to_8bit(image: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Linear values in [0, 1] to the nearest of 256 levels; values outside are clipped."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def squared_error(image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Squared difference per pixel, mean over the channels, on the scale where white is 1."""
    _check(image, reference)
    difference = image.astype(np.int32) - reference.astype(np.int32)
    return np.einsum("hwc,hwc->hw", difference, difference) / (3.0 * 255.0**2)


def psnr_from_mse(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error on [0, 1], `MAX_PSNR_DB` at most; NaN of NaN."""
    return float(-10.0 * np.log10(np.maximum(mean_squared_error, 10.0 ** (-MAX_PSNR_DB / 10.0))))


def ssim_map(
    image: UInt8[np.ndarray, "h w 3"],
    reference: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Structural similarity of the window around each pixel, mean over the channels, float64.

    Choice: masked pixels of the image take the value of the reference first, so that what the model
    painted where nobody looks does not leak through the window into pixels that count.
    """
    _check(image, reference)
    shown = replace_masked(image, reference, mask)
    total = np.zeros(image.shape[:2])
    for channel in range(3):
        total += _ssim_channel(shown[..., channel] / 255.0, reference[..., channel] / 255.0)
    return total / 3.0


def replace_masked(
    image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None
) -> UInt8[np.ndarray, "h w 3"]:
    """The image where the mask keeps it, the reference elsewhere."""
    return image if mask is None else np.where(mask[..., None], image, reference)


def masked_mean(values: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"] | None) -> float:
    """Mean over the kept pixels; NaN where there are none."""
    kept = values if mask is None else values[mask]
    return float(kept.mean()) if kept.size else float("nan")


def _ssim_channel(x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    mean_x, mean_y = _blur(x), _blur(y)
    variance_x = _blur(x * x) - mean_x * mean_x
    variance_y = _blur(y * y) - mean_y * mean_y
    covariance = _blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)


def _blur(plane: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    kernel = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA, cv2.CV_64F)
    # The constant border of OpenCV is zero: what 3DGS's padded convolution does.
    return cv2.sepFilter2D(plane, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)


def _check(image: np.ndarray, reference: np.ndarray) -> None:
    for each in (image, reference):
        if each.dtype != np.uint8 or each.ndim != 3 or each.shape[2] != 3:
            raise ValueError(f"metrics take uint8 [h, w, 3], not {each.dtype} {list(each.shape)}")
    if image.shape != reference.shape:
        raise ValueError(f"image {list(image.shape)} and reference {list(reference.shape)} differ in size")
