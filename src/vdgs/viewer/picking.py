"""A clicked point: its position, how many cameras see it, which, and whether something stands between."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from vdgs.geometry.camera import Camera
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.model.renderer import Drawable, render
from vdgs.viewer.image_comparison import load_resized_image
from vdgs.viewer.measurement import MeasuredPoint
from vdgs.viewer.viewer_scene import ViewerScene

#: A camera sees a point unoccluded if the drawn depth is so near to its depth (share; choice).
_OCCLUSION_TOLERANCE = 0.02
#: Thumbnails: how large (longer side), and how large the part of the photograph about the place is (share).
_THUMBNAIL_PX, _THUMBNAIL_CROP = 320, 0.5
#: Photographs that a measured point is marked in, at most, and by which its depth is judged.
_MARKED_IMAGES = 8
_MARKER_COLOR = (255, 60, 40)


@dataclass(frozen=True, eq=False)
class ImageHit:
    """A photograph that a point lies in."""

    #: In `capture.views`.
    index: int
    name: str
    #: Where in the photograph, pixels.
    pixel: tuple[float, float]
    #: Units of the ground frame that a pixel shows there.
    ground_sampling: float
    #: Nothing stands between.
    unoccluded: bool
    #: The depth that is drawn there less the depth of the point; 0 where nothing is drawn.
    depth_error: float = 0.0


@dataclass(frozen=True, eq=False)
class PickedPoint:
    """A point on the surface of the model."""

    position: Float[np.ndarray, "3"]
    #: V: training cameras whose pictures it lies in.
    visibility: int
    #: The block whose anchors the model has there; None where the scene is not cut.
    block: int | None
    #: All photographs that it lies in, the test views too: unoccluded ones first, then the nearest.
    hits: tuple[ImageHit, ...]
    #: Coordinates for people, a line each.
    coordinates: tuple[str, ...]


def pick_position(model: Drawable, camera: Camera, x: float, y: float) -> Float[np.ndarray, "3"] | None:
    """The point of the surface (median depth) that the pixel at `x`, `y` shows; None where nothing is drawn.

    Pixels from the upper left corner; the point lies on the ray through exactly there.
    """
    column, row = int(np.floor(x)), int(np.floor(y))
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        return None
    depth, alpha = _render_pixel(model, camera, column, row)
    if depth <= 0 or alpha <= 0.5:
        return None
    local = np.array([(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth])
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    return (local - translation) @ rotation


def pick_point(
    scene: ViewerScene, name: str, position: Float[np.ndarray, "3"], *, min_visibility: int = 0
) -> PickedPoint:
    """What is known of a point, where the model fades out below so many training cameras."""
    model, views = scene.shown(name, min_visibility=min_visibility), scene.capture.views
    hits = [
        _image_hit(model, view.camera, index, view.name, position)
        for index, view in enumerate(views)
        if view.camera.in_frustum(position[None])[0]
    ]
    visibility = sum(views[hit.index].split == "train" for hit in hits)
    block_at = scene.block_lookup(name)
    block = None if block_at is None else int(block_at(torch.from_numpy(position[None]))[0])
    hits.sort(key=lambda hit: (not hit.unoccluded, hit.ground_sampling))
    return PickedPoint(position, visibility, block, tuple(hits), coordinate_lines(scene, position))


def _image_hit(model: Drawable, camera: Camera, index: int, name: str, position: np.ndarray) -> ImageHit:
    pixels, depth = camera.project(position[None])
    x, y = float(pixels[0, 0]), float(pixels[0, 1])
    column, row = min(int(x), camera.width - 1), min(int(y), camera.height - 1)
    drawn, _ = _render_pixel(model, camera, column, row)
    unoccluded = drawn == 0 or drawn >= float(depth[0]) * (1 - _OCCLUSION_TOLERANCE)
    error = drawn - float(depth[0]) if drawn > 0 else 0.0
    return ImageHit(index, name, (x, y), float(depth[0]) / camera.fx, unoccluded, error)


def measured_point(
    scene: ViewerScene, name: str, camera: Camera, x: float, y: float, *, min_visibility: int = 0
) -> MeasuredPoint | None:
    """The point that the pixel at `x`, `y` shows, for the ruler; None where nothing is drawn.

    It is off across the view by half a pixel of the clicked picture, or of the photograph that shows it best where that
    is coarser, and along it by what the depths disagree that the nearest photographs see.
    """
    position = pick_position(scene.shown(name, min_visibility=min_visibility), camera, x, y)
    if position is None:
        return None
    point = pick_point(scene, name, position, min_visibility=min_visibility)
    hits = [hit for hit in point.hits if hit.unoccluded][:_MARKED_IMAGES]
    pixel = float(np.linalg.norm(position - camera.position)) / camera.fx
    across = 0.5 * max([pixel, *(hit.ground_sampling for hit in hits[:1])])
    along = float(np.median([abs(hit.depth_error) for hit in hits])) if hits else 0.0
    rays = []
    for hit in hits:
        seen = scene.capture.views[hit.index].camera
        rays.append((hit.name, (hit.pixel[0] - seen.cx) / seen.fx, (hit.pixel[1] - seen.cy) / seen.fy))
    return MeasuredPoint(position, float(np.hypot(across, 1.48 * along)), tuple(rays))


def _render_pixel(model: Drawable, camera: Camera, column: int, row: int) -> tuple[float, float]:
    """Median depth and alpha of one pixel."""
    raster = render(model, camera.cropped(column, row, column + 1, row + 1), depth=True)
    assert raster.median_depth is not None
    return float(raster.median_depth[0, 0]), float(raster.alpha[0, 0])


def coordinate_lines(scene: ViewerScene, position: Float[np.ndarray, "3"]) -> tuple[str, ...]:
    """A point in the ground frame, on Earth and on the map, as far as these are known."""
    ground = scene.capture.ground
    x, y = ("east", "north") if ground.origin_geo else ("x", "y")
    lines = [f"{x} {position[0]:.2f}, {y} {position[1]:.2f}, up {position[2]:.2f} {ground.unit} (ground frame)"]
    if ground.origin_geo is not None:
        latitude, longitude, height = geodetic_from_enu(position[None], ground.origin_geo, ground.axes_origin)[0]
        lines.append(f"{latitude:.7f}°, {longitude:.7f}°, {height:.2f} m (WGS 84)")
    for placement in scene.map_projections:
        east, north, up = placement.project(position[None])[0]
        lines.append(f"{east:,.2f}, {north:,.2f}, {up:,.2f} ({placement.name})")
    return tuple(lines)


def thumbnail(scene: ViewerScene, hit: ImageHit) -> UInt8[np.ndarray, "h w 3"]:
    """The part of a photograph about a point, which is marked. Raises CaptureError if it cannot be read."""
    camera = scene.capture.views[hit.index].camera
    image = load_resized_image(scene, hit.index, camera.width, camera.height)
    width, height = max(1, round(_THUMBNAIL_CROP * camera.width)), max(1, round(_THUMBNAIL_CROP * camera.height))
    left = int(np.clip(hit.pixel[0] - width / 2, 0, camera.width - width))
    top = int(np.clip(hit.pixel[1] - height / 2, 0, camera.height - height))
    part = image[top : top + height, left : left + width]
    scale = _THUMBNAIL_PX / max(width, height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    center = (round((hit.pixel[0] - left) * scale), round((hit.pixel[1] - top) * scale))
    cv2.circle(small, center, 9, (255, 255, 255), 3, cv2.LINE_AA)
    cv2.circle(small, center, 9, _MARKER_COLOR, 2, cv2.LINE_AA)
    return np.asarray(small)
