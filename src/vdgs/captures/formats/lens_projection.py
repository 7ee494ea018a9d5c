"""Rays of pixels and pixels of rays through any lens that captures have, and how far from its axis a lens is valid."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from vdgs.captures.formats.brown_lens import MAX_SCALE, project_rays, unproject_pixels
from vdgs.captures.formats.source_capture import OWN_LENSES, Intrinsics

#: Where `fold_radius` looks: in so many directions, at so many angles in each as far as photographs without distortion
#: may reach and at so many beyond, up to this angle to the axis (degrees).
_DIRECTIONS, _ANGLES, _ANGLES_BEYOND, _WIDEST_DEG = 32, 96, 32, 89.0
#: Steps of its finite differences in radians, and how often it halves the angle between two of those in the end.
_STEP, _HALVINGS = 1e-5, 30
#: Of so many lenses what was found is kept, a few hundred bytes for each: captures may have one for each photograph,
#: and go through all of them several times.
KEPT_LENSES = 2**15


def pixel_rays(intrinsics: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """x/z and y/z [n, 2] of the rays through pixels [n, 2] of a camera, its lens undone; NaN where it has no ray, or
    only one from where the lens folds over."""
    if not intrinsics.is_distorted:
        return (pixels - intrinsics.principal_point) / intrinsics.focal
    if intrinsics.model in OWN_LENSES:
        rays = unproject_pixels(intrinsics, pixels)
    else:
        rays = np.asarray(colmap_camera(intrinsics).cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
    return np.where(is_valid_ray(intrinsics, rays)[:, None], rays, np.nan)


def ray_pixels(intrinsics: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of rays x/z, y/z [n, 2]; not finite where the lens does not take them. The formula of the lens
    alone, also where that folds over (`is_valid_ray`)."""
    if intrinsics.model in OWN_LENSES:
        return project_rays(intrinsics, rays)
    points = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(colmap_camera(intrinsics).img_from_cam(points), dtype=np.float64)


def is_valid_ray(intrinsics: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Whether rays x/z, y/z [n, 2] are nearer to the axis than where the lens folds over, [n] bool."""
    return np.hypot(*rays.T) <= fold_radius(intrinsics)


@lru_cache(maxsize=KEPT_LENSES)
def fold_radius(intrinsics: Intrinsics) -> float:
    """The length of x/z, y/z up to which a lens shows each ray at a place of its own; infinite where that holds for all
    rays ahead of it.

    Polynomials are fitted to the rays that a photograph has; farther out they may turn back, and show a second time,
    mirrored, what they have shown already. There the determinant of the derivative is not positive. The shortest of
    all directions counts.
    """
    (fx, fy), (cx, cy) = intrinsics.focal, intrinsics.principal_point
    corner = math.hypot(max(abs(cx), abs(intrinsics.width - cx)) / fx, max(abs(cy), abs(intrinsics.height - cy)) / fy)
    widest = math.radians(_WIDEST_DEG)
    reached = min(math.atan(MAX_SCALE * corner), widest)
    angles = np.concatenate(
        [np.linspace(0, reached, _ANGLES + 1)[1:], np.linspace(reached, widest, _ANGLES_BEYOND + 1)[1:]]
    )
    turns = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    valid = _is_upright(intrinsics, *np.broadcast_arrays(angles[:, None], turns))
    if valid.all():
        return math.inf
    first = int(np.argmin(valid.all(axis=1)))  # of the angles at which any direction is not valid
    low, high = angles[first - 1] if first else 0.0, angles[first]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if _is_upright(intrinsics, *np.broadcast_arrays(middle, turns)).all():
            low = middle
        else:
            high = middle
    return math.tan(low)


def _is_upright(intrinsics: Intrinsics, angles: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Whether pictures of what lies around rays are not mirrored: rays by their angles to the axis and about it."""

    def shown(angle: np.ndarray, turn: np.ndarray) -> np.ndarray:
        rays = np.tan(angle)[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return ray_pixels(intrinsics, rays.reshape(-1, 2)).reshape(rays.shape)

    with np.errstate(all="ignore"):
        outward = shown(angles + _STEP, turns) - shown(angles - _STEP, turns)
        around = shown(angles, turns + _STEP) - shown(angles, turns - _STEP)
        return outward[..., 0] * around[..., 1] - outward[..., 1] * around[..., 0] > 0


def colmap_camera(intrinsics: Intrinsics) -> Any:
    """A pycolmap.Camera of these intrinsics."""
    from vdgs.system.lazy_pycolmap import pycolmap  # 60 MB of memory: only for lenses that need it

    width, height, params = intrinsics.width, intrinsics.height, list(intrinsics.params)
    return pycolmap.Camera(model=intrinsics.model, width=width, height=height, params=params)
