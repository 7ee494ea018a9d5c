"""Lines and points that the browser draws over the picture: borders of blocks, cameras, sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float, UInt8

from vdgs.geometry.camera import Camera
from vdgs.viewer.viewer_scene import ViewerScene, block_rgb

#: Borders follow the ground in steps of this share of the camera height; cameras are drawn so large (choices).
_STEP, _SIZE = 0.1, 0.06
#: Sparse points that a browser is sent at most.
_MAX_POINTS = 150_000
_GRAY = (150, 150, 150)

LineSegments = tuple[Float[np.ndarray, "s 2 3"], UInt8[np.ndarray, "s 2 3"]]


def block_borders(scene: ViewerScene) -> LineSegments:
    """The cores of the blocks as segments that lie on the ground, each in its block's color."""
    lines: list[np.ndarray] = []
    colors: list[tuple[int, int, int]] = []
    step = _STEP * scene.camera_height
    for index, block in enumerate(scene.blocks.items if scene.blocks is not None else ()):
        ring = shapely.get_coordinates(shapely.segmentize(block.core.exterior, max(step, block.core.length / 2000)))
        draped = np.column_stack([ring, _ground_below(scene, ring)])
        segments = np.stack([draped[:-1], draped[1:]], axis=1)
        lines.append(segments)
        colors += [block_rgb(index)] * len(segments)
    return _segments(lines, colors)


def _ground_below(scene: ViewerScene, points_xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Height of the ground at positions: the median of the nearest eight sparse points."""
    points = scene.capture.points
    if not len(points):
        return np.zeros(len(points_xy))
    from scipy.spatial import cKDTree  # slow to import

    _, nearest = cKDTree(points[:, :2]).query(points_xy, k=min(8, len(points)))
    return np.asarray(np.median(points[:, 2][np.reshape(nearest, (len(points_xy), -1))], axis=1))


def camera_frusta(scene: ViewerScene) -> LineSegments:
    """All cameras as small frusta, in the color of the block that they stand above."""
    views = scene.capture.views
    size = _SIZE * scene.camera_height
    colors = [_GRAY] * len(views)
    if scene.blocks is not None:
        owners = scene.blocks.owner(np.stack([view.camera.position[:2] for view in views]))
        colors = [block_rgb(int(owner)) for owner in owners]
    lines = [_frustum(view.camera, size) for view in views]
    return _segments(lines, [color for color in colors for _ in range(8)])


def _frustum(camera: Camera, size: float) -> Float[np.ndarray, "8 2 3"]:
    """Four edges from the camera to the corners of its picture at a distance, four between these."""
    corners = camera.resized(1, 1)
    x = (np.array([0.0, 1.0, 1.0, 0.0]) - corners.cx) / corners.fx
    y = (np.array([0.0, 0.0, 1.0, 1.0]) - corners.cy) / corners.fy
    local = size * np.column_stack([x, y, np.ones(4)])
    ring = (local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]
    spokes = np.stack([np.broadcast_to(camera.position, (4, 3)), ring], axis=1)
    return np.concatenate([spokes, np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)])


def sparse_points(scene: ViewerScene) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """The sparse points and their colors, evenly thinned where there are many."""
    capture = scene.capture
    every = max(1, -(-len(capture.points) // _MAX_POINTS))
    return capture.points[::every].astype(np.float32), capture.point_colors[::every]


def _segments(lines: Sequence[np.ndarray], colors: Sequence[tuple[int, int, int]]) -> LineSegments:
    if not lines:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    each = np.asarray(colors, np.uint8)
    return np.concatenate(lines).astype(np.float32), np.repeat(each[:, None], 2, axis=1)
