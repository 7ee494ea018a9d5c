"""What moves between photographs, by the residuals of a trained model: no network, no classes.

A residual (photograph minus render) at a place is compared with the residuals that other photographs have at the same
place. Detail that the model has not learnt is missing in the same way in all of them, and so is the ghost of what was
there for a moment. What is there in one photograph alone, such as a car, differs from the median of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.visibility.visibility_counts import NearbyCameras

#: Longest side of the pictures that are compared: cars keep some 10 pixels, and a comparison takes a second.
COMPARED_SIZE_PX = 480
#: Other photographs that a place is compared with at most and at least (choice).
MAX_OTHERS, MIN_OTHERS = 20, 3
#: Width of the Gaussian that residuals are blurred by, in compared pixels: what is shifted by less cancels.
BLUR_PX = 1.5
#: Relative difference of depth up to which two photographs show the same place.
DEPTH_TOLERANCE = 0.06
#: A pixel moves where it deviates by so many units of noise (median + MAD of the view, and the spread of the others);
#: what is connected with it and deviates by `WEAK` of that belongs to it.
THRESHOLD, WEAK = 5.0, 0.6
#: Deviations below this are never motion, in colors from 0 to 1.
MIN_DEVIATION = 0.08
#: Smaller regions, in compared pixels, are dropped; what is left grows by so many.
MIN_REGION_PX, GROW_PX = 20, 1
#: Masks reach so many compared pixels farther than what is found: rims and soft shadows do harm too (choice).
MASK_MARGIN_PX = 2
#: With `--block.mask-moving auto` so many photographs, spread over the flight, are looked at first. Where less of them
#: moves, on average, nothing is masked: still scenes have up to 0.19 %, glittering water 0.28 %, traffic 2 % (choice).
SAMPLED_PHOTOGRAPHS, MIN_MOVING_SHARE = 12, 0.002
#: A photograph of which more is found is not masked: its camera or exposure is wrong, rather than all that it shows.
MAX_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Residual:
    """A view at the size of comparison: blurred photograph minus render, NaN where a mask leaves it out, and the depth
    of the scene, infinite where nothing is."""

    camera: Camera
    difference: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]


def make_residual(
    camera: Camera,
    photograph: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"] | None,
    shown: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
) -> Residual:
    """The residual of a view: `shown` is the render in the exposure of the photograph, a `mask` keeps what is not 0."""
    small = camera.limit_size(COMPARED_SIZE_PX)
    size = (small.width, small.height)
    kept = np.ones(depth.shape, np.float32) if mask is None else (mask > 0).astype(np.float32)
    difference = (photograph.astype(np.float32) / 255 - np.clip(shown, 0, 1)) * kept[..., None]
    weight = _blur(cv2.resize(kept, size, interpolation=cv2.INTER_AREA))
    blurred = _blur(cv2.resize(difference, size, interpolation=cv2.INTER_AREA))
    blurred = np.where(weight[..., None] > 0.5, blurred / np.maximum(weight, 1e-6)[..., None], np.nan)
    near = cv2.resize(np.where(depth > 0, depth, np.inf).astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    return Residual(small, blurred.astype(np.float32), near)


def overlapping_views(index: int, own: Residual, cameras: NearbyCameras) -> list[int]:
    """The others of all cameras that see most of what the view of this index shows, at most `MAX_OTHERS`."""
    step = max(1, max(own.depth.shape) // 12)
    solid = np.isfinite(own.depth)
    points = own.camera.unproject(np.where(solid, own.depth, 0))[::step, ::step][solid[::step, ::step]]
    near = [int(other) for other in cameras.indices(torch.from_numpy(points)) if other != index]
    seen = {other: int(cameras.cameras[other].in_frustum(points).sum()) for other in near}
    most = sorted(seen, key=lambda other: (-seen[other], abs(other - index)))[:MAX_OTHERS]
    return [other for other in most if seen[other]]


def moving_pixels(own: Residual, others: Sequence[Residual]) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a view show what the other views do not show there; none where fewer than `MIN_OTHERS` see a
    place."""
    deviation, spread, known = _deviations(own, others)
    if not known.any():
        return known
    middle = float(np.median(deviation[known]))
    noise = middle + 1.4826 * float(np.median(np.abs(deviation[known] - middle)))
    score = np.where(known, deviation / np.maximum(noise + spread, MIN_DEVIATION / THRESHOLD), 0)
    return _regions(score)


def _deviations(own: Residual, others: Sequence[Residual]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel: how far it is from the median of the others, how far these typically are, and whether enough see
    it."""
    points = own.camera.unproject(np.where(np.isfinite(own.depth), own.depth, 0)).reshape(-1, 3)
    solid = np.isfinite(own.depth) & np.isfinite(own.difference).all(axis=-1)
    stack = np.stack([_sample(other, points, solid) for other in others]) if others else np.zeros((0, *solid.shape, 3))
    count = np.isfinite(stack[..., 0]).sum(axis=0)
    known = solid & (count >= MIN_OTHERS)
    if not known.any():
        return np.zeros(solid.shape), np.zeros(solid.shape), known
    seen, number = torch.from_numpy(stack[:, known].transpose(1, 2, 0).copy()), torch.from_numpy(count[known])
    middle = _medians(seen, number)
    spread = _medians((seen - middle[..., None]).abs(), number).amax(dim=-1)
    away = (torch.from_numpy(own.difference[known]) - middle).abs().amax(dim=-1)
    deviation, scatter = np.zeros(solid.shape, np.float32), np.zeros(solid.shape, np.float32)
    deviation[known], scatter[known] = away.numpy(), 1.4826 * spread.numpy()
    return deviation, scatter, known


def _medians(values: Float[Tensor, "n 3 others"], count: Int64[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """The (lower) medians of the numbers among the values, `count` of each row: much faster than `nanmedian`."""
    ordered = values.nan_to_num(nan=float("inf")).sort(dim=-1).values
    return ordered.gather(-1, ((count - 1) // 2)[:, None, None].expand(-1, 3, 1))[..., 0]


def _sample(other: Residual, points: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """The differences that another view has at these places, NaN where it does not see them."""
    pixels, depth = other.camera.project(points)
    x, y = (pixels.astype(np.float32) - 0.5).reshape(*solid.shape, 2).transpose(2, 0, 1)
    depth = depth.reshape(solid.shape)
    there = cv2.remap(other.depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    with np.errstate(invalid="ignore"):
        sees = solid & (depth > 0) & (np.abs(there - depth) <= DEPTH_TOLERANCE * depth)
    found = cv2.remap(other.difference, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(sees[..., None], found, np.nan).astype(np.float32)


def _regions(score: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Where the score is high, with what is connected and still high; small regions are dropped, the others grown."""
    number, labels, stats, _ = cv2.connectedComponentsWithStats((score > WEAK * THRESHOLD).astype(np.uint8))
    strong = np.bincount(labels[score > THRESHOLD], minlength=number)
    keep = (stats[:, cv2.CC_STAT_AREA] >= MIN_REGION_PX) & (strong >= MIN_REGION_PX // 4)
    keep[0] = False
    return grow(keep[labels], GROW_PX)


def grow(pixels: Bool[np.ndarray, "h w"], by: int) -> Bool[np.ndarray, "h w"]:
    """What lies within so many pixels of these."""
    return cv2.dilate(pixels.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by + 1,) * 2)) > 0


def _blur(picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture, (0, 0), BLUR_PX)
