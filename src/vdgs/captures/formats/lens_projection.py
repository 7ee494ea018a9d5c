"""Rays of pixels and pixels of rays through any lens that captures have."""

from __future__ import annotations

from typing import Any

import numpy as np

from vdgs.captures.formats.brown_lens import project_rays, unproject_pixels
from vdgs.captures.formats.source_capture import OWN_LENSES, Intrinsics


def pixel_rays(intrinsics: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """x/z and y/z [n, 2] of the rays through pixels [n, 2] of a camera, its lens undone; NaN where it has no ray."""
    if not intrinsics.is_distorted:
        return (pixels - intrinsics.principal_point) / intrinsics.focal
    if intrinsics.model in OWN_LENSES:
        return unproject_pixels(intrinsics, pixels)
    return np.asarray(colmap_camera(intrinsics).cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)


def ray_pixels(intrinsics: Intrinsics, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of rays x/z, y/z [n, 2]; not finite where the lens does not take them."""
    if intrinsics.model in OWN_LENSES:
        return project_rays(intrinsics, rays)
    points = np.column_stack([rays, np.ones(len(rays))])
    return np.asarray(colmap_camera(intrinsics).img_from_cam(points), dtype=np.float64)


def colmap_camera(intrinsics: Intrinsics) -> Any:
    """A pycolmap.Camera of these intrinsics."""
    from vdgs.system.lazy_pycolmap import pycolmap  # 60 MB of memory: only for lenses that need it

    width, height, params = intrinsics.width, intrinsics.height, list(intrinsics.params)
    return pycolmap.Camera(model=intrinsics.model, width=width, height=height, params=params)
