"""One tile of a map: the scene seen straight from above, its heights, and how many cameras see each place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import render
from vdgs.rendering.ortho.detail_transfer import HALO_PX, Sharpener
from vdgs.rendering.ortho.nadir_camera import Overhead
from vdgs.rendering.ortho.pixel_grid import Grid
from vdgs.visibility.visibility_counts import visibility_of

#: At least this opaque, a pixel shows a surface: the median depth is that of half.
DRAWN_ALPHA = 0.5
#: What stands for no value in the files.
NO_HEIGHT, NO_COUNT = -9999.0, 65535
#: Most samples per pixel, each way.
_MOST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Tile:
    """What a tile shows; nothing (0, `NO_HEIGHT`, `NO_COUNT`) where the scene is open or no camera looks."""

    colours: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"]
    heights: Float[np.ndarray, "h w"]
    visibility: UInt16[np.ndarray, "h w"]


class _Seen(NamedTuple):
    """What pixels show, of which some are `shown`: for those, places in the ground frame and how many cameras look."""

    colours: Float[np.ndarray, "h w 3"]
    shown: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    counts: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Surveyor:
    """Draws tiles of a map of one model."""

    model: AnchorModel
    above: Overhead
    #: Samples per pixel, each way.
    samples: int = 1
    #: Takes detail from the photographs, where that is asked for.
    sharpener: Sharpener | None = None

    def tile(self, grid: Grid) -> Tile:
        """Draw the pixels of a grid, each from `samples`² of its own."""
        fine = Grid(grid.left, grid.top, grid.gsd / self.samples, grid.width * self.samples, grid.height * self.samples)
        through = self.above.camera(fine)
        camera = self.above.camera(grid) if self.samples > 1 else through
        seen = self._seen(through, camera)
        shown, colours = seen.shown, seen.colours
        if self.sharpener is not None and shown.any():
            # Drawn once more, with what lies about it; not cut from that, so that heights and V are those without.
            around = self._seen(_widened(through, HALO_PX * self.samples), _widened(camera, HALO_PX))
            detail = self.sharpener.detail(around.points, around.colours, around.shown)
            colours = colours + detail[HALO_PX:-HALO_PX, HALO_PX:-HALO_PX]
        tile = Tile(
            np.zeros((*shown.shape, 3), np.uint8), np.zeros(shown.shape, np.uint8),
            np.full(shown.shape, NO_HEIGHT, np.float32), np.full(shown.shape, NO_COUNT, np.uint16),
        )  # fmt: skip
        tile.colours[shown] = (colours[shown].clip(0, 1) * 255 + 0.5).astype(np.uint8)
        tile.alpha[shown] = 255
        if shown.any():
            tile.heights[shown] = self.above.placement.places(seen.points)[:, 2]
        tile.visibility[shown] = seen.counts.clip(max=NO_COUNT - 1)
        return tile

    def _seen(self, through: Camera, camera: Camera) -> _Seen:
        """What the pixels of a camera show, each from `samples`² of those of the camera `through` which it is drawn."""
        with torch.inference_mode():
            raster = render(self.model, through, background=(0.0, 0.0, 0.0), depth=True)
        assert raster.median_depth is not None
        opacity = _blocks(raster.alpha.cpu().numpy(), self.samples).mean(axis=-1)
        image = raster.image.cpu().numpy()
        light = np.stack([_blocks(image[..., c], self.samples).mean(axis=-1) for c in range(3)], axis=-1)
        depth = raster.median_depth.cpu().numpy().astype(np.float64)
        depth[raster.alpha.cpu().numpy() < DRAWN_ALPHA] = np.nan
        # One of the samples, not their mean: at a wall the mean is a height that nothing has.
        depth = _lower_median(_blocks(depth, self.samples))
        shown = (opacity >= DRAWN_ALPHA) & np.isfinite(depth)
        points = camera.unproject(np.where(shown, depth, 0.0))[shown]
        counts = visibility_of(
            torch.from_numpy(points), [view.camera for view in self.above.capture.train_views]
        ).numpy()
        looked_at = counts > 0  # what no photograph shows, the model invents
        shown[shown] = looked_at
        return _Seen(light / np.maximum(opacity, DRAWN_ALPHA)[..., None], shown, points[looked_at], counts[looked_at])


def _widened(camera: Camera, by: int) -> Camera:
    """The same camera with so many pixels more on every side."""
    return replace(
        camera, cx=camera.cx + by, cy=camera.cy + by, width=camera.width + 2 * by, height=camera.height + 2 * by
    )


def samples_for(gsd: float, finest: float) -> int:
    """Samples per pixel, each way, for a map coarser than the photographs: splats smaller than a pixel are drawn too
    large (they get 0.3 px² each)."""
    return int(np.clip(round(gsd / finest), 1, _MOST_SAMPLES))


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """[h * side, w * side] to [h, w, side * side]."""
    height, width = values.shape[0] // side, values.shape[1] // side
    return values.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)


def _lower_median(values: Float[np.ndarray, "h w k"]) -> Float[np.ndarray, "h w"]:
    """The median of the values that are there, one of them; NaN where fewer than half are."""
    ordered = np.sort(values, axis=-1)  # NaN last
    there = np.isfinite(values).sum(axis=-1)
    chosen = np.take_along_axis(ordered, np.maximum(there - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(2 * there >= values.shape[-1], chosen, np.nan)
