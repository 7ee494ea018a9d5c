"""The pinhole cameras of photographs whose lens distortion is removed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np

from vdgs.captures.formats.brown_lens import MAX_ANGLE, MAX_SCALE, brown_pinhole
from vdgs.captures.formats.lens_projection import KEPT_LENSES, colmap_camera, fold_radius, is_valid_ray, ray_pixels
from vdgs.captures.formats.source_capture import OWN_LENSES, Intrinsics
from vdgs.errors import CaptureError

#: A lens that folds over is used where at least this share of its photographs lies before the fold (choice).
MIN_VALID = 0.25
#: Of a lens that is valid in this share of its photographs nothing is said.
_NEARLY_ALL = 0.98
#: It is used up to this share of the angle at which it folds over, for closer to that pictures are stretched ever more.
#: It costs 0.1 % of the radius in the photograph (choice).
_USED = 0.98
#: For that share photographs are drawn so large, in pixels, with so many corners of the fold's outline.
_DRAWN_PX, _FOLD_CORNERS, _FAR_PX = 128, 180, 10_000
#: Which pictures `_limited_pinhole` compares: so many ratios of the sides, along whose edges it looks at so many rays,
#: and how often it halves the size.
_SHAPES, _EDGE_RAYS, _HALVINGS = 33, 48, 20


def undistorted_pinhole(intrinsics: Intrinsics) -> Intrinsics:
    """The pinhole camera whose picture holds no blank pixels (COLMAP's own choice of size and center), and none from
    beyond where the lens folds over. Raises `CaptureError` for a lens that leaves too little of the photograph."""
    return _pinhole_and_shown(intrinsics)[0]


def fold_notes(lenses: Iterable[Intrinsics]) -> list[str]:
    """What to say of lenses whose photographs are cut, for the lens folds over within them: of the one that leaves the
    most out, and how many there are. Raises as `undistorted_pinhole`."""
    cut = {
        lens: shown for lens in dict.fromkeys(each for each in lenses if each.is_distorted)
        if (shown := _pinhole_and_shown(lens)[1]) is not None
    }  # fmt: skip
    if not cut:
        return []
    lens = min(cut, key=lambda each: cut[each])
    others = f" Of {len(cut)} such lenses this one leaves the most out." if len(cut) > 1 else ""
    return [
        f"the lens {_described(lens)} {_why(lens)}: {1 - cut[lens]:.0%} of each photograph is left out, and the "
        f"{cut[lens]:.0%} in the middle are used. A calibration that holds up to the corners, or that of a fisheye "
        f"where the lens is one, would use more.{others}"
    ]


def folds_to_nothing(intrinsics: Intrinsics) -> bool:
    """Whether a lens leaves too little of its photographs: there is no such lens."""
    try:
        if intrinsics.is_distorted:
            undistorted_pinhole(intrinsics)
    except CaptureError:
        return True
    return False


@lru_cache(maxsize=KEPT_LENSES)
def _pinhole_and_shown(lens: Intrinsics) -> tuple[Intrinsics, float | None]:
    """The pinhole camera, and which share of a photograph it shows if the lens is not valid in all of that."""
    whole = brown_pinhole(lens) if lens.model in OWN_LENSES else _colmap_pinhole(lens)
    if whole is None or not is_valid_ray(lens, _corner(whole)[None])[0]:
        return _limited_pinhole(lens)
    if _valid_share(lens) >= _NEARLY_ALL:
        return whole, None
    scales = np.array([[whole.width / lens.width, whole.height / lens.height]])
    shown = float(_shown_share(lens, scales)[0])
    if shown >= MIN_VALID:
        return whole, shown
    limited = _limited_pinhole(lens)  # COLMAP's rule may have gone by rays that its inverse found wrongly
    return (whole, shown) if shown > limited[1] / 2 else limited


def _colmap_pinhole(lens: Intrinsics) -> Intrinsics:
    from vdgs.system.lazy_pycolmap import pycolmap  # 60 MB of memory: only for lenses that need it

    try:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), colmap_camera(lens))
    except Exception as error:  # pycolmap raises plain ValueError and RuntimeError kinds
        raise CaptureError(
            f"the camera {lens.model} {lens.params} cannot be undistorted ({error}). "
            "Undistort with colmap image_undistorter and use its output folder."
        ) from error
    center = (camera.principal_point_x, camera.principal_point_y)
    focal = (camera.focal_length_x, camera.focal_length_y)
    return Intrinsics("PINHOLE", (*focal, *center), camera.width, camera.height)


def _corner(camera: Intrinsics) -> np.ndarray:
    """x/z and y/z of the corner of a picture without distortion that is farthest from the axis (without signs)."""
    (fx, fy), (cx, cy) = camera.focal, camera.principal_point
    return np.array([max(abs(cx), abs(camera.width - cx)) / fx, max(abs(cy), abs(camera.height - cy)) / fy])


def _limited_pinhole(lens: Intrinsics) -> tuple[Intrinsics, float]:
    """The pinhole camera that shows the most of a photograph, of those that show only what is in it and nearer to the
    axis than where the lens folds over; and which share of the photograph it shows.

    As COLMAP's it has the focal lengths of the lens, and its principal point where the lens has it by the sides. Of
    each shape the largest is found by halving, all shapes at once: a part of what is valid is valid.
    """
    corner = _corner(lens)
    limit = math.tan(min(_USED * math.atan(fold_radius(lens)), MAX_ANGLE))
    shapes = np.radians(np.linspace(5, 85, _SHAPES))
    directions = np.stack([np.cos(shapes), np.sin(shapes)], axis=1) / corner
    low, high = np.zeros(_SHAPES), np.full(_SHAPES, limit)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = _is_inside(lens, _outline(lens, np.minimum(middle[:, None] * directions, MAX_SCALE)))
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    scales = np.minimum(low[:, None] * directions, MAX_SCALE)
    shown = _shown_share(lens, scales)
    best = int(np.argmax(shown))
    width, height = (int(scale * side) for scale, side in zip(scales[best], (lens.width, lens.height), strict=True))
    if not (shown[best] > 0 and min(width, height) > 0 and _valid_share(lens) >= MIN_VALID):  # NaN included
        why = f"{_why(lens)}, and no more than {_valid_share(lens):.0%} of each photograph has rays"
        if not shown[best] > 0:
            why = f"has its principal point outside of {_size(lens)}"
        raise CaptureError(
            f"the lens {_described(lens)} {why}. Calibrate it again, or undistort the photographs in the program that "
            "calibrated it and export them."
        )
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    center = cx * width / lens.width, cy * height / lens.height
    return Intrinsics("PINHOLE", (fx, fy, *center), width, height), float(shown[best])


def _outline(lens: Intrinsics, scales: np.ndarray) -> np.ndarray:
    """Where the edges of pictures without distortion, as large as the photograph times `scales` [n, 2], lie in the
    photograph: pixels [n, 4 edges, 2], one after the other around each."""
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    along, ends = np.linspace(0, 1, _EDGE_RAYS, endpoint=False), np.zeros(_EDGE_RAYS)
    x = np.concatenate([along, ends + 1, 1 - along, ends]) * lens.width - cx
    y = np.concatenate([ends, along, ends + 1, 1 - along]) * lens.height - cy
    rays = np.stack([x / fx, y / fy], axis=-1) * scales[:, None]
    return ray_pixels(lens, rays.reshape(-1, 2)).reshape(rays.shape)


def _is_inside(lens: Intrinsics, pixels: np.ndarray) -> np.ndarray:
    """Whether all pixels of each row [n, m, 2] lie between the middles of a photograph's outermost pixels."""
    return np.all((pixels >= 0.5) & (pixels <= (lens.width - 0.5, lens.height - 0.5)), axis=(1, 2))


def _shown_share(lens: Intrinsics, scales: np.ndarray) -> np.ndarray:
    """Which shares [n] of a photograph pictures without distortion show, by the areas of their outlines in it."""
    x, y = np.moveaxis(_outline(lens, scales), -1, 0)
    areas = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1) / 2
    return areas / (lens.width * lens.height)


def _valid_share(lens: Intrinsics) -> float:
    """Which share of a photograph lies nearer to the axis than where the lens folds over, as far as the picture of that
    is round; all of it where that is unknown."""
    fold = fold_radius(lens)
    if math.isinf(fold):
        return 1.0
    turns = np.linspace(0, 2 * np.pi, _FOLD_CORNERS, endpoint=False)
    rim = ray_pixels(lens, fold * np.stack([np.cos(turns), np.sin(turns)], axis=1)) / (lens.width, lens.height)
    drawn = np.zeros((_DRAWN_PX, _DRAWN_PX), np.uint8)
    corners = np.clip(np.nan_to_num(rim) * _DRAWN_PX, -_FAR_PX, _FAR_PX).round().astype(np.int32)
    return float(cv2.fillPoly(drawn, [corners], (1.0,)).mean())


def _why(lens: Intrinsics) -> str:
    """Why a lens cannot be used up to the edges of its photographs."""
    fold = fold_radius(lens)
    if math.isinf(fold):
        return f"has no rays at the edges of {_size(lens)}"
    return f"folds over {math.degrees(math.atan(fold)):.0f}° from its axis, within {_size(lens)}"


def _size(lens: Intrinsics) -> str:
    return f"its photographs of {lens.width}x{lens.height} pixels"


def _described(lens: Intrinsics) -> str:
    return f"{lens.model} {', '.join(f'{value:.6g}' for value in lens.params)}"
