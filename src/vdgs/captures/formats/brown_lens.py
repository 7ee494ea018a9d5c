"""The lenses of photogrammetry programs that COLMAP's models lack: Brown's with a fourth radial term and skew (BROWN),
with growing tangential terms (GENERAL), and fisheyes with any powers of the angle (GENERAL_FISHEYE) or of twice the
sine of half of it (EQUISOLID).

Of a ray x, y (z = 1), r² = x² + y²: x' = x d + (2 p1 x y + p2 (r² + 2 x²)) g and y' = y d + (p1 (r² + 2 y²) + 2 p2 x y)
g, with d = 1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ + o1 r + o3 r³ + o5 r⁵ + o7 r⁷ and g = 1 + p3 r² + p4 r⁴; u = fx x' +
skew y' + cx and v = fy y' + shear x' + cy in pixels. Of fisheyes x, y point as the ray, as long as its angle to the
axis, or as twice the sine of half of it. p1, p2 are OpenCV's. Parameters: fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, skew
(BROWN ends here; the first eight are those of COLMAP's OPENCV), p3, p4, shear, o1, o3, o5, o7.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vdgs.captures.formats.source_capture import BROWN, EQUISOLID, GENERAL, GENERAL_FISHEYE, Intrinsics

#: Newton's steps, which settle in five for lenses that there are, and what is left of the ray at most.
MAX_STEPS, TOLERANCE = 30, 1e-12
#: A picture without distortion is at least, and at most, so large a share of the distorted one (as COLMAP's).
MIN_SCALE, MAX_SCALE = 0.2, 2.0
#: Of a fisheye no more is kept than this angle to the axis, in radians.
MAX_ANGLE = 1.3
_NUM_TERMS, MAX_POWERS = 14, 10
_FISHEYES = (GENERAL_FISHEYE, EQUISOLID)


def brown_intrinsics(
    focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int], radial: Sequence[float] = (),
    tangential: tuple[float, float] = (0.0, 0.0), skew: float = 0.0, growth: tuple[float, float] = (0.0, 0.0),
) -> Intrinsics:  # fmt: skip
    """The plainest model that is exactly this lens: up to four `radial` terms, `tangential` in OpenCV's order with p3
    and p4 of its `growth`, and the skew in pixels; PINHOLE, OPENCV, FULL_OPENCV, BROWN or GENERAL."""
    k1, k2, k3, k4 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    head, opencv = (*focal, *center), (k1, k2, *tangential)
    if any(growth) and any(tangential):
        return Intrinsics(GENERAL, (*head, *opencv, k3, k4, skew, *growth, 0.0, 0.0, 0.0, 0.0, 0.0), *size)
    if k4 or skew:
        return Intrinsics(BROWN, (*head, *opencv, k3, k4, skew), *size)
    if k3:
        return Intrinsics("FULL_OPENCV", (*head, *opencv, k3, 0.0, 0.0, 0.0), *size)
    return Intrinsics("OPENCV", (*head, *opencv), *size) if any(opencv) else Intrinsics("PINHOLE", head, *size)


def fisheye_intrinsics(
    affine: tuple[float, float, float, float], center: tuple[float, float], size: tuple[int, int],
    powers: Sequence[float], tangential: tuple[float, float] = (0.0, 0.0), *, equisolid: bool = False,
) -> Intrinsics:  # fmt: skip
    """The plainest model that is exactly this fisheye: `affine` matrix row by row in pixels, and the factors of the
    first to eighth powers of the angle in d; OPENCV_FISHEYE, THIN_PRISM_FISHEYE, GENERAL_FISHEYE or EQUISOLID."""
    fx, skew, shear, fy = affine
    o1, k1, o3, k2, o5, k3, o7, k4 = (*powers, *[0.0] * 8)[:8]
    head = (fx, fy, *center)
    if equisolid or skew or shear or o1 or o3 or o5 or o7:
        tail = (k1, k2, *tangential, k3, k4, skew, 0.0, 0.0, shear, o1, o3, o5, o7)
        return Intrinsics(EQUISOLID if equisolid else GENERAL_FISHEYE, (*head, *tail), *size)
    if any(tangential):
        return Intrinsics("THIN_PRISM_FISHEYE", (*head, k1, k2, *tangential, k3, k4, 0.0, 0.0), *size)
    return Intrinsics("OPENCV_FISHEYE", (*head, k1, k2, k3, k4), *size)


def quarter_turn_fisheye(
    affine: Sequence[float], center: tuple[float, float], size: tuple[int, int], polynomial: Sequence[float]
) -> Intrinsics | None:
    """Pix4D's and Bentley's fisheye, which counts the angle in quarter turns: the `affine` matrix row by row in pixels
    and the factors of the powers of the angle from the zeroth on. None where the polynomial is not that of a lens: it
    does not begin with zero, or does not grow."""
    if polynomial[0] or not polynomial[1] > 0 or len(polynomial) > MAX_POWERS:
        return None
    turn, first = 2 / np.pi, polynomial[1]
    fx, skew, shear, fy = (first * turn * each for each in affine)
    powers = [each / first * turn**power for power, each in enumerate(polynomial[2:], 1)]
    return fisheye_intrinsics((fx, skew, shear, fy), center, size, powers)


def project_rays(lens: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of rays x/z, y/z [n, 2]."""
    fx, fy, cx, cy = lens.params[:4]
    skew, shear = _affine(lens)
    if lens.model in _FISHEYES:
        radius = np.hypot(*rays.T)[:, None]
        angles = np.arctan(radius) if lens.model == GENERAL_FISHEYE else 2 * np.sin(np.arctan(radius) / 2)
        rays = rays * np.where(radius > 1e-9, angles / np.maximum(radius, 1e-9), 1.0)
    bent = _bent(lens, rays)
    u = fx * bent[:, 0] + skew * bent[:, 1] + cx
    return np.stack([u, fy * bent[:, 1] + shear * bent[:, 0] + cy if shear else fy * bent[:, 1] + cy], axis=1)


def unproject_pixels(lens: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """Rays x/z, y/z [n, 2] of pixels [n, 2] by Newton's method; NaN where no ray falls on the pixel, or only where the
    lens folds over."""
    return _straight(lens, pixels, np.pi / 2 - 1e-6)


def _straight(lens: Intrinsics, pixels: np.ndarray, widest: float, *, clip: bool = False) -> np.ndarray:
    """Rays of pixels; those of fisheyes at more than the `widest` angle are NaN, or at that angle."""
    fx, fy, cx, cy = lens.params[:4]
    skew, shear = _affine(lens)
    across = pixels[:, 0] - cx
    y = (pixels[:, 1] - cy - shear / fx * across) / (fy - skew * shear / fx)
    bent = np.stack([(across - skew * y) / fx, y], axis=1)
    rays = bent.copy()
    with np.errstate(all="ignore"):
        for _ in range(MAX_STEPS):
            miss, (a, b, c, d) = _bent(lens, rays) - bent, _slopes(lens, rays)
            area = a * d - b * c
            step = np.stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - c * miss[:, 0]], axis=1) / area[:, None]
            rays = rays - step
            if not (np.abs(step) > TOLERANCE).any():
                break
        a, b, c, d = _slopes(lens, rays)
        missed = np.abs(_bent(lens, rays) - bent).max(axis=1, initial=0.0)
        good = (missed < 1e-9) & (a > 0) & (a * d - b * c > 0)
        if lens.model in _FISHEYES:
            lengths = np.hypot(*rays.T)
            angles = lengths if lens.model == GENERAL_FISHEYE else 2 * np.arcsin(np.minimum(lengths / 2, 1.0))
            good &= clip | (angles < widest)
            kept = np.minimum(angles, widest)
            rays = rays * np.where(lengths > 1e-9, np.tan(kept) / np.maximum(lengths, 1e-9), 1.0)[:, None]
    return np.where(good[:, None], rays, np.nan)


def brown_pinhole(lens: Intrinsics) -> Intrinsics | None:
    """The pinhole camera whose picture holds no blank pixels, by COLMAP's rule for its own models; None where no pixel
    of an edge of the photograph has a ray, or the principal point is not between the edges."""
    (fx, fy), (cx, cy), width, height = lens.focal, lens.principal_point, lens.width, lens.height
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    left, right = (_undistorted(lens, np.full(height, at), y)[:, 0] for at in (0.5, width - 0.5))
    top, bottom = (_undistorted(lens, x, np.full(width, at))[:, 1] for at in (0.5, height - 0.5))
    if any(np.isnan(edge).all() for edge in (left, right, top, bottom)):
        return None
    gaps = cx - np.nanmax(left), np.nanmin(right) - cx, cy - np.nanmax(top), np.nanmin(bottom) - cy
    if not all(gap > 0 for gap in gaps):
        return None
    across = max(cx / gaps[0], (width - 0.5 - cx) / gaps[1])
    down = max(cy / gaps[2], (height - 0.5 - cy) / gaps[3])
    new_width = int(min(max(1 / across, MIN_SCALE), MAX_SCALE) * width)
    new_height = int(min(max(1 / down, MIN_SCALE), MAX_SCALE) * height)
    new_center = cx * new_width / width, cy * new_height / height
    return Intrinsics("PINHOLE", (fx, fy, *new_center), new_width, new_height)


def _undistorted(lens: Intrinsics, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    rays = _straight(lens, np.stack([x, y], axis=1), MAX_ANGLE, clip=True)
    return rays * lens.focal + lens.principal_point


def _terms(lens: Intrinsics) -> tuple[float, ...]:
    return (*lens.params[4:], *[0.0] * _NUM_TERMS)[:_NUM_TERMS]


def _affine(lens: Intrinsics) -> tuple[float, float]:
    """Skew and shear."""
    terms = _terms(lens)
    return terms[6], terms[9]


def _stretch(lens: Intrinsics, r2: np.ndarray) -> np.ndarray:
    """By how much the radial terms lengthen rays, by the squares of their lengths."""
    k1, k2, _, _, k3, k4, _, _, _, _, *odd = _terms(lens)
    d = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    if any(odd):
        o1, o3, o5, o7 = odd
        d = d + np.sqrt(r2) * (o1 + r2 * (o3 + r2 * (o5 + r2 * o7)))
    return d


def _bent(lens: Intrinsics, rays: np.ndarray) -> np.ndarray:
    _, _, p1, p2, _, _, _, p3, p4, *_ = _terms(lens)
    x, y = rays.T
    r2 = x * x + y * y
    d = _stretch(lens, r2)
    if p3 or p4:
        g = 1 + r2 * (p3 + r2 * p4)
        p1, p2 = p1 * g, p2 * g  # type: ignore[assignment]
    return np.stack(
        [x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * d + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=1
    )


def _slopes(lens: Intrinsics, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """dx'/dx, dx'/dy, dy'/dx and dy'/dy."""
    k1, k2, p1, p2, k3, k4, _, p3, p4, _, *odd = _terms(lens)
    x, y = rays.T
    r2 = x * x + y * y
    d = _stretch(lens, r2)
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)))
    if any(odd):
        o1, o3, o5, o7 = odd
        slope = slope + (o1 + r2 * (3 * o3 + r2 * (5 * o5 + r2 * 7 * o7))) / np.maximum(np.sqrt(r2), 1e-12)
    g = 1 + r2 * (p3 + r2 * p4)
    more = 2 * (p3 + r2 * 2 * p4)
    tangential_x, tangential_y = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    across = x * y * slope + (2 * p1 * x + 2 * p2 * y) * g
    return (
        d + x * x * slope + (2 * p1 * y + 6 * p2 * x) * g + tangential_x * more * x,
        across + tangential_x * more * y,
        across + tangential_y * more * x,
        d + y * y * slope + (6 * p1 * y + 2 * p2 * x) * g + tangential_y * more * y,
    )
