"""One tile of a map: the scene seen straight from above, its heights, and how many cameras see each place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from vdgs.geometry.camera import Camera
from vdgs.model.renderer import Drawable, render
from vdgs.rendering.ortho.detail_transfer import HALO_PX, DetailTransfer
from vdgs.rendering.ortho.nadir_camera import NadirCamera
from vdgs.rendering.ortho.pixel_grid import PixelGrid
from vdgs.visibility.visibility_counts import NearbyCameras, count_visibility

#: At least this opaque, a pixel shows a surface: the median depth is that of half.
MIN_ALPHA = 0.5
#: What stands for no value in the files.
NODATA_HEIGHT, NODATA_COUNT = -9999.0, 65535
#: Most samples per pixel, each way.
_MAX_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class OrthoTile:
    """What a tile shows; nothing (0, `NODATA_HEIGHT`, `NODATA_COUNT`) where the scene is open or no camera looks."""

    colors: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"]
    heights: Float[np.ndarray, "h w"]
    visibility: UInt16[np.ndarray, "h w"]


class _PixelSurfaces(NamedTuple):
    """What pixels show, of which some are `shown`: for those, places in the ground frame and how many cameras look."""

    colors: Float[np.ndarray, "h w 3"]
    shown: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    counts: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class TileRenderer:
    """Draws tiles of a map of one model."""

    model: Drawable
    nadir_camera: NadirCamera
    #: Samples per pixel, each way.
    samples: int = 1
    #: Takes detail from the photographs, where that is asked for.
    detail_transfer: DetailTransfer | None = None

    def render_tile(self, grid: PixelGrid) -> OrthoTile:
        """Draw the pixels of a grid, each from `samples`² of its own."""
        n = self.samples
        fine = self.nadir_camera.camera(PixelGrid(grid.left, grid.top, grid.gsd / n, grid.width * n, grid.height * n))
        camera = self.nadir_camera.camera(grid) if n > 1 else fine
        surfaces = self._surfaces(fine, camera)
        shown, colors = surfaces.shown, surfaces.colors
        if self.detail_transfer is not None and shown.any():
            # Drawn once more, with what lies about it; not cut from that, so that heights and V are those without.
            around = self._surfaces(_pad_camera(fine, HALO_PX * n), _pad_camera(camera, HALO_PX))
            detail = self.detail_transfer.detail(around.points, around.colors, around.shown)
            colors = colors + detail[HALO_PX:-HALO_PX, HALO_PX:-HALO_PX]
        tile = OrthoTile(
            np.zeros((*shown.shape, 3), np.uint8), np.zeros(shown.shape, np.uint8),
            np.full(shown.shape, NODATA_HEIGHT, np.float32), np.full(shown.shape, NODATA_COUNT, np.uint16),
        )  # fmt: skip
        tile.colors[shown] = (colors[shown].clip(0, 1) * 255 + 0.5).astype(np.uint8)
        tile.alpha[shown] = 255
        if shown.any():
            tile.heights[shown] = self.nadir_camera.placement.project(surfaces.points)[:, 2]
        tile.visibility[shown] = surfaces.counts.clip(max=NODATA_COUNT - 1)
        return tile

    def _surfaces(self, fine: Camera, camera: Camera) -> _PixelSurfaces:
        """What the pixels of a camera show, each from `samples`² pixels of the `fine` camera, which is drawn."""
        with torch.inference_mode():
            raster = render(self.model, fine, background=(0.0, 0.0, 0.0), depth=True)
        assert raster.median_depth is not None
        alpha = raster.alpha.cpu().numpy()
        opacity = _blocks(alpha, self.samples).mean(axis=-1)
        image = raster.image.cpu().numpy()
        light = np.stack([_blocks(image[..., c], self.samples).mean(axis=-1) for c in range(3)], axis=-1)
        depth = raster.median_depth.cpu().numpy().astype(np.float64)
        depth[alpha < MIN_ALPHA] = np.nan
        # One of the samples, not their mean: at a wall the mean is a height that nothing has.
        depth = _lower_median(_blocks(depth, self.samples))
        shown = (opacity >= MIN_ALPHA) & np.isfinite(depth)
        points = camera.unproject(np.where(shown, depth, 0.0))[shown]
        places = torch.from_numpy(points)
        counts = count_visibility(places, self._cameras.of(places)).numpy()
        visible = counts > 0  # what no photograph shows, the model invents
        shown[shown] = visible
        colors = light / np.maximum(opacity, MIN_ALPHA)[..., None]
        return _PixelSurfaces(colors, shown, points[visible], counts[visible])

    @cached_property
    def _cameras(self) -> NearbyCameras:
        """The training cameras: a tile asks those about it."""
        return NearbyCameras([view.camera for view in self.nadir_camera.capture.train_views])


def _pad_camera(camera: Camera, by: int) -> Camera:
    """The same camera with so many pixels more on every side."""
    width, height = camera.width + 2 * by, camera.height + 2 * by
    return replace(camera, cx=camera.cx + by, cy=camera.cy + by, width=width, height=height)


def samples_per_side(gsd: float, finest: float | None) -> int:
    """Samples per pixel, each way, for a map coarser than the photographs (`finest`; None: not known): splats smaller
    than a pixel are drawn too large (they get 0.3 px² each)."""
    return 1 if finest is None else int(np.clip(round(gsd / finest), 1, _MAX_SAMPLES))


def _blocks(values: np.ndarray, side: int) -> np.ndarray:
    """[h * side, w * side] to [h, w, side * side]."""
    height, width = values.shape[0] // side, values.shape[1] // side
    return values.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)


def _lower_median(values: Float[np.ndarray, "h w k"]) -> Float[np.ndarray, "h w"]:
    """The median of the values that are there, one of them; NaN where fewer than half are."""
    ordered = np.sort(values, axis=-1)  # NaN last
    known = np.isfinite(values).sum(axis=-1)
    chosen = np.take_along_axis(ordered, np.maximum(known - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(2 * known >= values.shape[-1], chosen, np.nan)
