"""Detail from the photographs for an orthophoto: each pixel's place looked up in the pictures that see it best.

Colours from afar (low frequencies) stay those of the scene, which knows no seams between exposures; what is finer
than `_BLUR_PX` comes from the photographs, through the depth of the map. A photograph counts where it truly sees the
place: the scene as that photograph shows it is no nearer, and not of quite another colour.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from vdgs.cameras import Camera
from vdgs.captures.capture import Capture
from vdgs.captures.images import ImageCache
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.render import render

#: Photographs looked up for one tile; bytes of photographs, and depth maps, that are kept between tiles.
_MOST_VIEWS, _BUDGET_BYTES, _KEPT_DEPTHS = 12, 512_000_000, 24
#: How far behind the surface that a photograph shows a place may lie, in parts of its depth.
_BEHIND = 0.01
#: How much a view straight from above is preferred: the power of the cosine. High, so that pixels are not means.
_STRAIGHT = 24
#: A photograph that differs from the scene by more than this (of 1, mean over the channels) shows something else there:
#: what stood in between, what moved, or the wrong side of an edge.
_ALIKE = 0.08
#: Detail is finer than this many pixels of the map; photographs fade out over so many of theirs at their borders.
_BLUR_PX, _BORDER_PX = 6.0, 12.0


class Held(NamedTuple):
    """What a sharpener keeps between tiles, at most (bytes)."""

    pictures: int = 0
    depths: int = 0


def held_bytes(sharp: bool, capture: Capture) -> Held:
    """What drawing keeps of photographs, where detail is taken from them."""
    if not sharp:
        return Held()
    pixels = max(view.camera.width * view.camera.height for view in capture.train_views)
    return Held(_BUDGET_BYTES, 4 * _KEPT_DEPTHS * pixels)


class Sharpener:
    """Takes detail from the training photographs of a capture; remembers pictures and depths between tiles."""

    def __init__(self, model: AnchorModel, capture: Capture) -> None:
        self._model = model
        self._views = capture.train_views
        self._pictures = ImageCache(self._views, _BUDGET_BYTES)
        self._depths: OrderedDict[int, Float[np.ndarray, "h w"]] = OrderedDict()

    def close(self) -> None:
        """End the cache's threads."""
        self._pictures.close()

    def sharpened(
        self, points: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "h w 3"], shown: Bool[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "h w 3"]:
        """The colours with the detail of the photographs. `points`: the places of the pixels that are shown."""
        light, weight = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.float32)
        agreed = np.zeros(len(points), np.float32)
        drawn = colours[shown]
        for index in self._chosen(points):
            where, found, trust = self._look_up(index, points)
            agreement = np.exp(-0.5 * (np.abs(found - drawn[where]).mean(axis=1) / _ALIKE) ** 2)
            light[where] += (trust * agreement)[:, None] * found
            agreed[where] += trust * agreement
            weight[where] += trust
        known = agreed > 0
        detail = np.zeros_like(colours)
        inside = np.zeros(shown.shape, np.float32)
        at = np.flatnonzero(shown.ravel())[known]
        share = agreed[known, None] / weight[known, None]
        detail.reshape(-1, 3)[at] = share * (light[known] / agreed[known, None] - colours.reshape(-1, 3)[at])
        inside.ravel()[at] = 1.0
        spread = cv2.GaussianBlur(inside, (0, 0), _BLUR_PX)[..., None]
        coarse = cv2.GaussianBlur(detail, (0, 0), _BLUR_PX) / np.maximum(spread, 1e-6)
        return colours + inside[..., None] * (detail - coarse)

    def _chosen(self, points: Float[np.ndarray, "n 3"]) -> list[int]:
        """The photographs that see most of the places, straight from above rather than aslant."""
        some = points[:: max(1, len(points) // 200)]
        scores = []
        for view in self._views:
            seen = some[view.camera.sees(some)]
            scores.append(float((_straight(view.camera, seen) ** _STRAIGHT).sum()) if len(seen) else 0.0)
        order = np.argsort(scores)[::-1][:_MOST_VIEWS]
        return [int(index) for index in order if scores[index] > 0]

    def _look_up(self, index: int, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of the places that a photograph truly sees, their colours [m, 3] in [0, 1], its trust in each [m]."""
        camera, picture = self._views[index].camera, self._pictures.get(index)
        pixels, depth = camera.project(points)
        border = np.minimum.reduce(
            [pixels[:, 0], pixels[:, 1], camera.width - pixels[:, 0], camera.height - pixels[:, 1]]
        )
        rows = np.flatnonzero((depth > 0) & (border > 1.0))
        column, row = pixels[rows].astype(np.int64).T
        clear = depth[rows] <= (1 + _BEHIND) * self._depth(index)[row, column]
        if picture.mask is not None:
            clear &= picture.mask.numpy()[row, column] > 0
        rows = rows[clear]
        at = (pixels[rows] - 0.5).astype(np.float32)
        image = picture.image.numpy()
        found = _sampled(image, at)
        trust = _straight(camera, points[rows]) ** _STRAIGHT * np.minimum(border[rows] / _BORDER_PX, 1.0)
        return rows, found, trust.astype(np.float32)

    def _depth(self, index: int) -> Float[np.ndarray, "h w"]:
        """Median depth of the scene in a photograph; infinite where it shows nothing solid."""
        if index in self._depths:
            self._depths.move_to_end(index)
            return self._depths[index]
        with torch.inference_mode():
            found = render(self._model, self._views[index].camera, depth=True).median_depth
        assert found is not None
        depth = found.cpu().numpy()
        self._depths[index] = np.where(depth > 0, depth, np.inf)
        if len(self._depths) > _KEPT_DEPTHS:
            self._depths.popitem(last=False)
        return self._depths[index]


def _straight(camera: Camera, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How straight from above a camera sees places: the cosine to the vertical, 0 from below."""
    rays = camera.position - points
    return (rays[:, 2] / np.linalg.norm(rays, axis=1)).clip(min=0.0)


def _sampled(image: np.ndarray, at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Colours in [0, 1] between the pixels of an image, cubic."""
    side = 1 << 14
    padded = np.zeros((-(-max(len(at), 1) // side) * side, 2), np.float32)
    padded[: len(at)] = at
    grid = padded.reshape(-1, side, 2)
    found = cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, 3)[: len(at)].astype(np.float32) / 255
