"""The depth of one photograph's pixels: pairs matched by semi-global matching (Hirschmüller, 2008; OpenCV's), and what
most pairs agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from vdgs.geometry.camera import Camera
from vdgs.model.initialization.stereo.rectification import RectifiedPair

#: Side of the window that is compared, in pixels (choice).
WINDOW = 5
#: Depths are matched in at most so many steps of a column; pairs that would need more are too close to the ground.
MAX_DISPARITIES = 256
#: Per cent by which the best match must beat the second: water and sky match anything.
UNIQUENESS_RATIO = 5
#: Where gray values about a pixel, in a window of so many, deviate by less there is nothing to match (of 255; choice).
MIN_CONTRAST, CONTRAST_WINDOW = 2.0, 11
#: Two depths agree when they differ by less than this share.
MAX_RELATIVE_DIFFERENCE = 0.01


@dataclass(frozen=True, eq=False)
class StereoView:
    """A photograph as it is matched: gray, at its camera's size, and the depths between which its ground lies."""

    camera: Camera
    gray: UInt8[np.ndarray, "h w"]
    min_depth: float
    max_depth: float


def pair_depth(first: StereoView, second: StereoView) -> Float[np.ndarray, "h w"] | None:
    """Depth along the axis of the first camera at its pixels, 0 where the two do not match both ways; None where they
    have no common picture plane."""
    common = RectifiedPair.of(first.camera, second.camera)
    if common is None:
        return None
    least = int(np.floor(common.disparity(first.max_depth))) - 2
    steps = -(-(int(np.ceil(common.disparity(first.min_depth))) + 3 - least) // 16) * 16
    overlap = common.width + min(least, 0) - max(least + steps, 0)
    if not 0 < steps <= MAX_DISPARITIES or overlap <= WINDOW:
        return None
    turned = [
        cv2.warpPerspective(
            view.gray, common.homography_to_image(view.camera, which), (common.width, common.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        for which, view in enumerate((first, second))
    ]  # fmt: skip
    area = WINDOW * WINDOW
    matcher = cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=steps,
        blockSize=WINDOW,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=1,
        uniquenessRatio=UNIQUENESS_RATIO,
    )
    found = matcher.compute(turned[0], turned[1]).astype(np.float32) / 16.0
    # At the ends of the range lies what has its match beyond it, or nowhere.
    between = (found >= least + 1) & (found <= least + steps - 2)
    along = np.where(between, common.depth(found), 0.0).astype(np.float32)
    depth = _as_seen_by(first.camera, common, along)
    return np.where((depth >= first.min_depth) & (depth <= first.max_depth), depth, np.float32(0))


def _as_seen_by(camera: Camera, common: RectifiedPair, along: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "h w"]:
    """Depth along the common axis, in the common picture, as depth along the axis of the first camera at its pixels."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(np.float64)
    there = cv2.perspectiveTransform(grid, np.linalg.inv(common.homography_to_image(camera, 0)))
    column, row = (there[..., axis].astype(np.float32) for axis in (0, 1))
    depth = cv2.remap(along, column, row, cv2.INTER_NEAREST, borderValue=0)
    axis = camera.forward @ common.rotation.T
    x, y = (column + 0.5 - common.columns[0]) / common.focal, (row + 0.5 - common.row) / common.focal
    across = np.stack([x, y, np.ones_like(row)], -1)
    return np.maximum(depth * (across @ axis), 0.0).astype(np.float32)


def multi_view_depth(view: StereoView, source_views: Sequence[StereoView]) -> Float[np.ndarray, "h w"]:
    """Depth at the pixels of a photograph, 0 where no pair tells it: of what its pairs say, what most agree on, their
    mean."""
    depths = [depth for partner in source_views if (depth := pair_depth(view, partner)) is not None]
    if not depths:
        return np.zeros(view.gray.shape, np.float32)
    said = np.stack(depths)
    said[said <= 0] = np.nan
    most, best = np.zeros(view.gray.shape, np.int32), np.full(view.gray.shape, np.nan, np.float32)
    for depth in said:
        count = _agrees(said, depth).sum(0)
        better = count > most
        most[better], best[better] = count[better], depth[better]
    agreeing = _agrees(said, best)
    total = np.where(agreeing & _textured(view.gray), said, 0.0).sum(0)
    return (total / np.maximum(agreeing.sum(0), 1)).astype(np.float32)


def _textured(gray: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where there is something to match."""
    values, window = gray.astype(np.float32), (CONTRAST_WINDOW, CONTRAST_WINDOW)
    variance = cv2.blur(values * values, window) - cv2.blur(values, window) ** 2
    textured: np.ndarray = variance > MIN_CONTRAST**2
    return textured


def _agrees(said: Float[np.ndarray, "p h w"], depth: Float[np.ndarray, "h w"]) -> np.ndarray:
    """Where each of several depths is that one, [p, h, w]; what is not known agrees with nothing."""
    with np.errstate(invalid="ignore"):
        return np.abs(said - depth) < MAX_RELATIVE_DIFFERENCE * depth
