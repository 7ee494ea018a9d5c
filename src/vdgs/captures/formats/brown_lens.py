"""The lens of photogrammetry programs, which COLMAP's models lack: Brown's with a fourth radial term and skew.

Of a ray x, y (z = 1), r² = x² + y²: x' = x d + 2 p1 x y + p2 (r² + 2 x²), y' = y d + p1 (r² + 2 y²) + 2 p2 x y, with
d = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸; u = fx x' + skew y' + cx and v = fy y' + cy in pixels. p1, p2 are OpenCV's.
Parameters: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, skew; the first eight are those of COLMAP's OPENCV.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vdgs.captures.formats.source_capture import BROWN, Intrinsics
from vdgs.errors import CaptureError

#: Newton's steps, which settle in five for lenses that there are, and what is left of the ray at most.
MAX_STEPS, TOLERANCE = 30, 1e-12
#: A picture without distortion is at least, and at most, so large a share of the distorted one (as COLMAP's).
MIN_SCALE, MAX_SCALE = 0.2, 2.0


def brown_intrinsics(
    focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int], radial: Sequence[float] = (),
    tangential: tuple[float, float] = (0.0, 0.0), skew: float = 0.0,
) -> Intrinsics:  # fmt: skip
    """The plainest model that is exactly this lens: up to four `radial` terms, `tangential` in OpenCV's order, and the
    skew in pixels; PINHOLE, OPENCV, FULL_OPENCV or BROWN."""
    k1, k2, k3, k4 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    head, opencv = (*focal, *center), (k1, k2, *tangential)
    if k4 or skew:
        return Intrinsics(BROWN, (*head, *opencv, k3, k4, skew), *size)
    if k3:
        return Intrinsics("FULL_OPENCV", (*head, *opencv, k3, 0.0, 0.0, 0.0), *size)
    return Intrinsics("OPENCV", (*head, *opencv), *size) if any(opencv) else Intrinsics("PINHOLE", head, *size)


def project_rays(lens: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of rays x/z, y/z [n, 2]."""
    fx, fy, cx, cy, *_, skew = lens.params
    bent = _bent(lens, rays)
    return np.stack([fx * bent[:, 0] + skew * bent[:, 1] + cx, fy * bent[:, 1] + cy], axis=1)


def unproject_pixels(lens: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """Rays x/z, y/z [n, 2] of pixels [n, 2] by Newton's method; NaN where no ray falls on the pixel, or only where the
    lens folds over."""
    fx, fy, cx, cy, *_, skew = lens.params
    y = (pixels[:, 1] - cy) / fy
    bent = np.stack([(pixels[:, 0] - cx - skew * y) / fx, y], axis=1)
    rays = bent.copy()
    with np.errstate(all="ignore"):
        for _ in range(MAX_STEPS):
            miss, (a, b, d) = _bent(lens, rays) - bent, _slopes(lens, rays)
            area = a * d - b * b
            step = np.stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - b * miss[:, 0]], axis=1) / area[:, None]
            rays = rays - step
            if not (np.abs(step) > TOLERANCE).any():
                break
        a, b, d = _slopes(lens, rays)
        missed = np.abs(_bent(lens, rays) - bent).max(axis=1, initial=0.0)
        good = (missed < 1e-9) & (a > 0) & (a * d - b * b > 0)
    return np.where(good[:, None], rays, np.nan)


def brown_pinhole(lens: Intrinsics) -> Intrinsics:
    """The pinhole camera whose picture holds no blank pixels, by COLMAP's rule for its own models."""
    (fx, fy), (cx, cy), width, height = lens.focal, lens.principal_point, lens.width, lens.height
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    left, right = (_undistorted(lens, np.full(height, at), y)[:, 0] for at in (0.5, width - 0.5))
    top, bottom = (_undistorted(lens, x, np.full(width, at))[:, 1] for at in (0.5, height - 0.5))
    gaps = cx - left.max(), right.min() - cx, cy - top.max(), bottom.min() - cy
    if not all(gap > 0 for gap in gaps):  # NaN included
        raise CaptureError(
            f"the lens {lens.model} {lens.params} folds over within its {width}x{height} pixels: no lens does. "
            "Calibrate it again, or undistort the photographs in the program that calibrated it and export them."
        )
    across = max(cx / gaps[0], (width - 0.5 - cx) / gaps[1])
    down = max(cy / gaps[2], (height - 0.5 - cy) / gaps[3])
    new_width = int(min(max(1 / across, MIN_SCALE), MAX_SCALE) * width)
    new_height = int(min(max(1 / down, MIN_SCALE), MAX_SCALE) * height)
    new_center = cx * new_width / width, cy * new_height / height
    return Intrinsics("PINHOLE", (fx, fy, *new_center), new_width, new_height)


def _undistorted(lens: Intrinsics, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return unproject_pixels(lens, np.stack([x, y], axis=1)) * lens.focal + lens.principal_point


def _bent(lens: Intrinsics, rays: np.ndarray) -> np.ndarray:
    k1, k2, p1, p2, k3, k4 = lens.params[4:10]
    x, y = rays.T
    r2 = x * x + y * y
    d = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack(
        [x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * d + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1
    )


def _slopes(lens: Intrinsics, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """dx'/dx, dx'/dy = dy'/dx and dy'/dy."""
    k1, k2, p1, p2, k3, k4 = lens.params[4:10]
    x, y = rays.T
    r2 = x * x + y * y
    d = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)))
    return (
        d + x * x * slope + 2 * p1 * y + 6 * p2 * x,
        x * y * slope + 2 * p1 * x + 2 * p2 * y,
        d + y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )
