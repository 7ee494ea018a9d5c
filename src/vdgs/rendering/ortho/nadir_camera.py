"""Cameras that look straight down on tiles of a map, by what a capture and its coordinates say: no model is needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from vdgs.captures.camera_height import view_distance
from vdgs.captures.capture import Capture
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.geometry.map_projection import MapProjection
from vdgs.geometry.similarity import Similarity
from vdgs.rendering.ortho.pixel_grid import PixelGrid, ground_height

#: Cameras by which the ceiling over a place is found, and the share of the sparse points about it that are under it.
_NUM_NEIGHBORS, _POINT_QUANTILE = 8, 0.995
#: How far, in pixels, the exact map may part from the similarity by which a tile is drawn.
TOLERANCE_PX = 0.1


@dataclass(frozen=True, eq=False)
class ClipHeight:
    """How high over a place the scene ends and the air in which cameras fly begins, in the ground frame."""

    cameras: Float[np.ndarray, "c 3"]
    #: The sparse points, ascending in x: of millions, each tile looks at those about it.
    points: Float[np.ndarray, "p 3"]
    cameras_above_scene: bool

    @staticmethod
    def of(capture: Capture) -> ClipHeight:
        cameras = np.array([view.camera.position for view in capture.train_views])
        points = capture.points[np.argsort(capture.points[:, 0])]
        flown = len(points) > 0 and view_distance(cameras, points, np.array([0.0, 0.0, 1.0])).is_height
        return ClipHeight(cameras, points, flown)

    def height_above(self, point: Float[np.ndarray, "3"], radius: float) -> float:
        """z under which everything solid about `point` stands (choice).

        Where a drone flew there is air: what a model has as high as the cameras nearby hangs in front of them, unless
        the sparse points say that something stands there. Cameras that do not fly above the scene say nothing: then
        the ceiling is above all points.
        """
        if not self.cameras_above_scene:
            return self._top + radius
        distances = np.hypot(*(self.cameras[:, :2] - point[:2]).T)
        flying = float(np.median(self.cameras[np.argsort(distances)[:_NUM_NEIGHBORS], 2]))
        about = self._points_about(point, radius)[:, 2]
        if not len(about):
            return flying
        # Above the highest points by a tenth of their height: roofs are wider than the points on them.
        top, low = float(np.quantile(about, _POINT_QUANTILE)), float(np.median(about))
        return max(flying, top + 0.1 * (top - low))

    @cached_property
    def _top(self) -> float:
        """z of the highest point or camera."""
        return max(float(self.points[:, 2].max(initial=-np.inf)), float(self.cameras[:, 2].max()))

    def _points_about(self, point: Float[np.ndarray, "3"], radius: float) -> Float[np.ndarray, "a 3"]:
        """The points no farther than `radius` from `point` in x and in y."""
        # Twice as far, so that no rounding leaves out one that is near.
        first, last = np.searchsorted(self.points[:, 0], (point[0] - 2 * radius, point[0] + 2 * radius))
        strip = self.points[first:last]
        return strip[(np.abs(strip[:, :2] - point[:2]) <= radius).all(axis=1)]


@dataclass(frozen=True, eq=False)
class NadirCamera:
    """Cameras above a capture, in the coordinates of a map."""

    capture: Capture
    placement: MapProjection
    clip_height: ClipHeight

    @staticmethod
    def of(capture: Capture, placement: MapProjection) -> NadirCamera:
        return NadirCamera(capture, placement, ClipHeight.of(capture))

    def camera(self, grid: PixelGrid) -> Camera:
        """The orthographic camera whose pixels are those of the grid, above everything solid.

        Raises VdgsError where the target's z is not up, or no similarity fits the target over the grid.
        """
        similarity, center = self._similarity(grid)
        up = similarity.rotation[2]  # the target's, in the ground frame
        radius = 0.75 * max(grid.width, grid.height) * grid.gsd / similarity.scale
        ceiling = self.clip_height.height_above(center, max(radius, 1e-6))
        above = center + up * (ceiling - center[2]) / up[2]
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ similarity.rotation
        pose[:3, 3] = -pose[:3, :3] @ above
        per_unit = similarity.scale / grid.gsd
        return Camera(
            camera_from_world=pose, fx=per_unit, fy=per_unit, cx=grid.width / 2, cy=grid.height / 2, width=grid.width,
            height=grid.height, model="orthographic",
        )  # fmt: skip

    def middle_of(self, grid: PixelGrid) -> Float[np.ndarray, "3"]:
        """What lies on the ground in the middle of a map, in the ground frame."""
        middle: np.ndarray = self.placement.to_ground(np.array([[*grid.center, self._ground_level]]))[0]
        return middle

    @cached_property
    def _ground_level(self) -> float:
        """Height of the ground in the target's coordinates."""
        return float(self.placement.project(np.array([[0.0, 0.0, ground_height(self.capture)]]))[0, 2])

    def _similarity(self, grid: PixelGrid) -> tuple[Similarity, Float[np.ndarray, "3"]]:
        """The similarity about the middle of the grid, and that place on the ground."""
        level, center = self._ground_level, self.middle_of(grid)
        similarity = self.placement.similarity_at(center)
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
        return similarity, center
