"""One tile of a map: the scene seen straight from above, its heights, and how many cameras see each place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16

from vdgs.cameras import Camera
from vdgs.captures.capture import Capture
from vdgs.captures.heights import reach
from vdgs.errors import VdgsError
from vdgs.maps.grid import Grid, ground_height
from vdgs.maps.sharpening import Sharpener
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.render import render
from vdgs.model.visibility import visibility_of
from vdgs.placing.placement import LocalSimilarity, Placement

#: At least this opaque, a pixel shows a surface: the median depth is that of half.
DRAWN_ALPHA = 0.5
#: What stands for no value in the files.
NO_HEIGHT, NO_COUNT = -9999.0, 65535
#: Cameras by which the ceiling over a place is found, and the share of the sparse points about it that are under it.
_NEIGHBOURS, _UNDER = 8, 0.995
#: How far, in pixels, the exact map may part from the similarity by which a tile is drawn.
TOLERANCE_PX = 0.1
#: Most samples per pixel, each way.
_MOST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Tile:
    """What a tile shows; nothing (0, `NO_HEIGHT`, `NO_COUNT`) where the scene is open or no camera looks."""

    colours: UInt8[np.ndarray, "h w 3"]
    alpha: UInt8[np.ndarray, "h w"]
    heights: Float[np.ndarray, "h w"]
    visibility: UInt16[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Ceiling:
    """How high over a place the scene ends and the air in which cameras fly begins, in the ground frame."""

    cameras: Float[np.ndarray, "c 3"]
    points: Float[np.ndarray, "p 3"]
    flown: bool

    @staticmethod
    def of(capture: Capture) -> Ceiling:
        cameras = np.array([view.camera.position for view in capture.train_views])
        flown = reach(cameras, capture.points, np.array([0.0, 0.0, 1.0])).is_height
        return Ceiling(cameras, capture.points, flown)

    def over(self, place: Float[np.ndarray, "3"], radius: float) -> float:
        """z under which everything solid about `place` stands (choice).

        Where a drone flew there is air: what a model has as high as the cameras nearby hangs in front of them, unless
        the sparse points say that something stands there. Cameras that do not fly above the scene say nothing: then
        the ceiling is above all points.
        """
        if not self.flown:
            return max(float(self.points[:, 2].max()), float(self.cameras[:, 2].max())) + radius
        away = np.hypot(*(self.cameras[:, :2] - place[:2]).T)
        near = self.cameras[np.argsort(away)[:_NEIGHBOURS]]
        flying = float(np.median(near[:, 2]))
        about = self.points[(np.abs(self.points[:, :2] - place[:2]) <= radius).all(axis=1), 2]
        if not len(about):
            return flying
        # Above the highest points by a tenth of their height: roofs are wider than the points on them.
        top, low = float(np.quantile(about, _UNDER)), float(np.median(about))
        return max(flying, top + 0.1 * (top - low))


@dataclass(frozen=True, eq=False)
class Surveyor:
    """Draws tiles of a map of one model."""

    model: AnchorModel
    capture: Capture
    placement: Placement
    ceiling: Ceiling
    #: Samples per pixel, each way.
    samples: int
    #: Takes detail from the photographs, where that is asked for.
    sharpener: Sharpener | None

    @staticmethod
    def of(
        model: AnchorModel, capture: Capture, placement: Placement, samples: int = 1, sharpener: Sharpener | None = None
    ) -> Surveyor:
        return Surveyor(model, capture, placement, Ceiling.of(capture), samples, sharpener)

    def camera(self, grid: Grid) -> Camera:
        """The orthographic camera whose pixels are those of the grid, above everything solid.

        Raises VdgsError where the target's z is not up, or no similarity fits the target over the grid.
        """
        similarity, centre = self._similarity(grid)
        up = similarity.rotation[2]  # the target's, in the ground frame
        radius = 0.75 * max(grid.width, grid.height) * grid.gsd / similarity.scale
        ceiling = self.ceiling.over(centre, max(radius, 1e-6))
        above = centre + up * (ceiling - centre[2]) / up[2]
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ similarity.rotation
        pose[:3, 3] = -pose[:3, :3] @ above
        per_unit = similarity.scale / grid.gsd
        return Camera(
            pose, per_unit, per_unit, grid.width / 2, grid.height / 2, grid.width, grid.height, "orthographic"
        )

    def tile(self, grid: Grid) -> Tile:
        """Draw the pixels of a grid, each from `samples`² of its own."""
        fine = Grid(grid.left, grid.top, grid.gsd / self.samples, grid.width * self.samples, grid.height * self.samples)
        camera = self.camera(fine)
        with torch.inference_mode():
            raster = render(self.model, camera, background=(0.0, 0.0, 0.0), depth=True)
        assert raster.median_depth is not None
        opacity = _blocks(raster.alpha.cpu().numpy(), self.samples).mean(axis=-1)
        image = raster.image.cpu().numpy()
        light = np.stack([_blocks(image[..., c], self.samples).mean(axis=-1) for c in range(3)], axis=-1)
        depth = raster.median_depth.cpu().numpy().astype(np.float64)
        depth[raster.alpha.cpu().numpy() < DRAWN_ALPHA] = np.nan
        # One of the samples, not their mean: at a wall the mean is a height that nothing has.
        depth = _lower_median(_blocks(depth, self.samples))
        return self._tile(self.camera(grid) if self.samples > 1 else camera, light, opacity, depth)

    def _tile(
        self, camera: Camera, light: Float[np.ndarray, "h w 3"], opacity: Float[np.ndarray, "h w"],
        depth: Float[np.ndarray, "h w"],
    ) -> Tile:  # fmt: skip
        shown = (opacity >= DRAWN_ALPHA) & np.isfinite(depth)
        points = camera.unproject(np.where(shown, depth, 0.0))[shown]
        counts = visibility_of(torch.from_numpy(points), [view.camera for view in self.capture.train_views]).numpy()
        heights = self.placement.places(points)[:, 2] if len(points) else np.zeros(0)
        seen = counts > 0  # what no photograph shows, the model invents
        shown[shown] = seen
        tile = Tile(
            np.zeros((*shown.shape, 3), np.uint8), np.zeros(shown.shape, np.uint8),
            np.full(shown.shape, NO_HEIGHT, np.float32), np.full(shown.shape, NO_COUNT, np.uint16),
        )  # fmt: skip
        colours = light / np.maximum(opacity, DRAWN_ALPHA)[..., None]
        if self.sharpener is not None and shown.any():
            colours = self.sharpener.sharpened(points[seen], colours, shown)
        tile.colours[shown] = (colours[shown].clip(0, 1) * 255 + 0.5).astype(np.uint8)
        tile.alpha[shown] = 255
        tile.heights[shown] = heights[seen]
        tile.visibility[shown] = counts[seen].clip(max=NO_COUNT - 1)
        return tile

    def _similarity(self, grid: Grid) -> tuple[LocalSimilarity, Float[np.ndarray, "3"]]:
        """The similarity about the middle of the grid, and that place on the ground."""
        level = self.placement.places(np.array([[0.0, 0.0, ground_height(self.capture)]]))[0, 2]
        centre = self.placement.to_ground(np.array([[*grid.centre, level]]))[0]
        similarity = self.placement.similarity_at(centre)
        x0, y0, x1, y1 = grid.bounds
        corners = np.array([[x, y, level] for x in (x0, x1) for y in (y0, y1)])
        if similarity.rotation[2, 2] < 0.98:
            raise VdgsError(
                f"--crs {self.placement.crs}: the third axis of {self.placement.name} does not point up here, so it "
                "has no map. Leave --crs out, or give a projected system."
            )
        off = np.abs(similarity.apply(self.placement.to_ground(corners)) - corners)[:, :2].max() / grid.gsd
        if off > TOLERANCE_PX:
            raise VdgsError(
                f"--crs {self.placement.crs}: {self.placement.name} stretches north and east unlike: over one tile "
                f"pixels would be {off:.1f} off. Give a conformal system (UTM), and let the map's viewer turn it."
            )
        return similarity, centre


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
