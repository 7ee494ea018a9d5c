"""Detail from the photographs for an orthophoto: each pixel's place looked up in the pictures that see it best.

Colors from afar (low frequencies) stay those of the scene, which knows no seams between exposures; what is finer
than `_BLUR_PX` comes from the photographs, through the depth of the map. A photograph counts where it truly sees the
place: the scene as that photograph shows it is no nearer, and not of quite another color. What a pixel gets depends on
its place and on pixels up to `HALO_PX` away, and on no tile: tiles that are drawn with such a halo show no borders.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from vdgs.captures.capture import Capture
from vdgs.captures.image_cache import ImageCache
from vdgs.geometry.camera import Camera
from vdgs.model.renderer import Drawable, render
from vdgs.visibility.visibility_counts import NearbyCameras

#: Photographs looked up for one place; bytes of photographs, and depth maps, that are kept between tiles.
_MAX_VIEWS, _IMAGE_CACHE_BYTES, _MAX_CACHED_DEPTHS = 12, 512_000_000, 32
#: Those of a tile are found by so many of its places; in between, one may be trusted this much more. How many places
#: are looked at together.
_SAMPLE_POINTS, _TRUST_MARGIN, _POINTS_PER_CHUNK = 1000, 1.25, 16_384
#: A photograph counts by what it is trusted more than this share of the first that is not looked up: those that come
#: and go from place to place do so without a step, and many that are trusted alike all count (choice).
_MIN_TRUST_SHARE = 0.99
#: How far behind the surface that a photograph shows a place may lie, in parts of its depth.
_DEPTH_TOLERANCE = 0.01
#: How much a view straight from above is preferred: the power of the cosine. High, so that pixels are not means.
_NADIR_POWER = 24
#: A photograph that differs from the scene by more than this (of 1, mean over the channels) shows something else there:
#: what stood in between, what moved, or the wrong side of an edge.
_COLOR_SIGMA = 0.08
#: Detail is finer than this many pixels of the map; photographs fade out over so many of theirs at their borders.
_BLUR_PX, _BORDER_PX = 6.0, 12.0
#: How far the blur reaches: detail is right so many pixels from the border of a picture.
HALO_PX = round(4 * _BLUR_PX)


class CacheSizes(NamedTuple):
    """What a `DetailTransfer` keeps between tiles, at most (bytes)."""

    images: int = 0
    depths: int = 0


def cache_sizes(detail_from_images: bool, capture: Capture) -> CacheSizes:
    """What drawing keeps of photographs, where detail is taken from them."""
    if not detail_from_images:
        return CacheSizes()
    pixels = max(view.camera.width * view.camera.height for view in capture.train_views)
    return CacheSizes(_IMAGE_CACHE_BYTES, 4 * _MAX_CACHED_DEPTHS * pixels)


class DetailTransfer:
    """Takes detail from the training photographs of a capture; caches images and depths between tiles."""

    def __init__(self, model: Drawable, capture: Capture) -> None:
        self._model = model
        self._views = capture.train_views
        self._cameras = NearbyCameras([view.camera for view in self._views])
        self._images = ImageCache(self._views, _IMAGE_CACHE_BYTES)
        self._depths: OrderedDict[int, Float[np.ndarray, "h w"]] = OrderedDict()

    def close(self) -> None:
        self._images.close()

    def detail(
        self, points: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "h w 3"], shown: Bool[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "h w 3"]:
        """What the photographs add to the colors. `points`: the places of the pixels that are shown."""
        light, weight = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        agreed = np.zeros(len(points), np.float32)
        drawn = colors[shown]
        chosen = self._select_views(points)
        min_trust = self._min_trust(chosen, points)
        for index in chosen:
            rows, sampled, trust = self._sample_view(index, points, min_trust)
            agreement = np.exp(-0.5 * (np.abs(sampled - drawn[rows]).mean(axis=1) / _COLOR_SIGMA) ** 2)
            light[rows] += (trust * agreement)[:, None] * sampled
            agreed[rows] += trust * agreement
            weight[rows] += trust
        known = agreed > 0
        detail = np.zeros_like(colors)
        inside = np.zeros(shown.shape, np.float32)
        at = np.flatnonzero(shown.ravel())[known]
        share = agreed[known, None] / weight[known, None]
        detail.reshape(-1, 3)[at] = share * (light[known] / agreed[known, None] - colors.reshape(-1, 3)[at])
        inside.ravel()[at] = 1.0
        return inside[..., None] * (detail - _blurred(detail) / np.maximum(_blurred(inside)[..., None], 1e-6))

    def _select_views(self, points: Float[np.ndarray, "n 3"]) -> list[int]:
        """The photographs that are among the most trusted ones at any of the places."""
        some = points[:: max(1, len(points) // _SAMPLE_POINTS)]
        near = self._cameras.indices(torch.from_numpy(some))  # others are trusted nowhere here
        trust = np.array([_trust(self._views[index].camera, some) for index in near]).reshape(len(near), len(some))
        most = (trust > 0) & (_TRUST_MARGIN * trust > _trust_threshold(trust))
        return [int(index) for index in near[most.any(axis=1)]]

    def _min_trust(self, chosen: list[int], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """How much a photograph must be trusted at each place to count there."""
        if len(chosen) <= _MAX_VIEWS:
            return np.zeros(len(points), np.float32)
        cameras = [self._views[index].camera for index in chosen]
        parts = (points[first : first + _POINTS_PER_CHUNK] for first in range(0, len(points), _POINTS_PER_CHUNK))
        trusts = (np.stack([_trust(camera, part) for camera in cameras]) for part in parts)
        return np.concatenate([_trust_threshold(trust) for trust in trusts])

    def _sample_view(
        self, index: int, points: Float[np.ndarray, "n 3"], min_trust: Float[np.ndarray, " n"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the points that a photograph truly sees and is trusted at more than `min_trust`, their colors [m, 3]
        in [0, 1], and the trust above it [m]."""
        camera = self._views[index].camera
        trust = _trust(camera, points) - min_trust
        rows = np.flatnonzero(trust > 0)
        if not len(rows):
            return rows, np.zeros((0, 3), np.float32), trust[rows]
        cached = self._images.get(index)
        pixels, depth = camera.project(points[rows])
        column, row = pixels.astype(np.int64).T
        clear = depth <= (1 + _DEPTH_TOLERANCE) * self._depth(index)[row, column]
        if cached.mask is not None:
            clear &= cached.mask.numpy()[row, column] > 0
        rows = rows[clear]
        return rows, _sample_image(cached.image.numpy(), (pixels[clear] - 0.5).astype(np.float32)), trust[rows]

    def _depth(self, index: int) -> Float[np.ndarray, "h w"]:
        """Median depth of the scene in a photograph; infinite where it shows nothing solid."""
        if index in self._depths:
            self._depths.move_to_end(index)
            return self._depths[index]
        with torch.inference_mode():
            median_depth = render(self._model, self._views[index].camera, depth=True).median_depth
        assert median_depth is not None
        depth = median_depth.cpu().numpy()
        self._depths[index] = np.where(depth > 0, depth, np.inf)
        if len(self._depths) > _MAX_CACHED_DEPTHS:
            self._depths.popitem(last=False)
        return self._depths[index]


def _trust(camera: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How much a photograph is trusted at places, if nothing stands in between: 0 where they are not in its picture."""
    pixels, depth = camera.project(points)
    border = np.minimum.reduce([pixels[:, 0], pixels[:, 1], camera.width - pixels[:, 0], camera.height - pixels[:, 1]])
    held = (depth > 0) & (border > 1.0)
    trust = np.zeros(len(points), np.float32)
    rays = camera.position - points[held]
    cosine = (rays[:, 2] / np.linalg.norm(rays, axis=1)).clip(min=0.0)  # to the vertical; 0 from below
    trust[held] = cosine**_NADIR_POWER * np.minimum(border[held] / _BORDER_PX, 1.0)
    return trust


def _trust_threshold(trust: Float[np.ndarray, "views n"]) -> Float[np.ndarray, " n"]:
    """How much, at each place, a photograph is trusted that `_MAX_VIEWS` others make needless; 0 without so many."""
    if len(trust) <= _MAX_VIEWS:
        return np.zeros(trust.shape[1], np.float32)
    return _MIN_TRUST_SHARE * np.partition(trust, -1 - _MAX_VIEWS, axis=0)[-1 - _MAX_VIEWS]


def _blurred(values: Float[np.ndarray, "h w ..."]) -> Float[np.ndarray, "h w ..."]:
    return cv2.GaussianBlur(values, (2 * HALO_PX + 1,) * 2, _BLUR_PX)


def _sample_image(image: np.ndarray, at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Colors in [0, 1] between the pixels of an image, cubic."""
    side = 1 << 14
    padded = np.zeros((-(-max(len(at), 1) // side) * side, 2), np.float32)
    padded[: len(at)] = at
    grid = padded.reshape(-1, side, 2)
    sampled = cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(-1, 3)[: len(at)].astype(np.float32) / 255
