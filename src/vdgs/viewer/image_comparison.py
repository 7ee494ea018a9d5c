"""Photographs beside the model: the one nearest to a view, laid over it, and what the model gets wrong of it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from vdgs.captures.image_cache import resize_area
from vdgs.evaluation.view_exposures import apply_exposure_numpy
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import render
from vdgs.viewer.viewer_scene import ViewerScene

#: Photographs are compared at most so large (longer side): an error map is for looking at.
_MAX_COMPARE_PX = 800
#: A point is what a photograph shows if the depths agree so well (share).
_DEPTH_TOLERANCE = 0.03
#: Error maps in the cache.
_MAX_CACHED = 6


@dataclass(frozen=True, eq=False)
class ImageErrorMap:
    """How far a model, in the exposure of a photograph, is from it, in the photograph's own pixels."""

    camera: Camera
    #: Mean absolute difference of the three channels, 0 to 1; NaN where the photograph is masked.
    error: Float[np.ndarray, "h w"]
    #: Median depth of the model; 0 where nothing is.
    depth: Float[np.ndarray, "h w"]


def nearest_view_index(scene: ViewerScene, camera: Camera) -> int:
    """The number of the photograph taken most nearly from where, and towards where, a camera looks.

    A distance of the flight's height counts as much as a turn of one radian (choice).
    """
    positions, directions = scene.view_rays
    turns = np.arccos(np.clip(directions @ camera.forward, -1.0, 1.0))
    away = np.linalg.norm(positions - camera.position, axis=1)
    return int(np.argmin(away / scene.camera_height + turns))


class ImageComparison:
    """Errors against photographs, cached. Used from the thread that draws."""

    def __init__(self, scene: ViewerScene) -> None:
        self._scene = scene
        self._cache: OrderedDict[tuple[int, str, int, int], ImageErrorMap] = OrderedDict()

    def error_map(
        self, name: str, camera: Camera, full_camera: Camera, min_visibility: int = 0
    ) -> Float[np.ndarray, "h w"]:
        """The error against the photograph nearest to `full_camera`, as its part `camera` sees it; NaN where that
        photograph does not show the point, or is masked. The model fades out below so many training cameras."""
        nearest = nearest_view_index(self._scene, full_camera)
        error_map = self._cached_error_map(name, nearest, min_visibility)
        shown = self._scene.shown(name, full_camera, min_visibility=min_visibility)
        depth = render(shown, camera, depth=True).median_depth
        assert depth is not None
        return _reproject_error(error_map, camera, depth.cpu().numpy())

    def _cached_error_map(self, name: str, index: int, min_visibility: int) -> ImageErrorMap:
        key = (self._scene.generation, name, index, min_visibility)
        if key not in self._cache:
            self._cache[key] = self._compute_error_map(name, index, min_visibility)
            while len(self._cache) > _MAX_CACHED:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]

    def _compute_error_map(self, name: str, index: int, min_visibility: int) -> ImageErrorMap:
        view = self._scene.capture.views[index]
        camera = view.camera.limit_size(_MAX_COMPARE_PX)
        photograph = resize_area(self._scene.images.get(index), camera.width, camera.height)
        shown = self._scene.shown(name, camera, min_visibility=min_visibility)
        exposures = self._scene.exposures(name)
        if exposures is not None and isinstance(shown, AnchorModel):
            shown = shown.without_local_exposure()
        raster = render(shown, camera, depth=True)
        assert raster.median_depth is not None
        drawn = raster.image.cpu().numpy()
        if exposures is not None:
            drawn = apply_exposure_numpy(drawn, exposures(view))
        error = np.abs(drawn.clip(0, 1) - photograph.image.numpy() / 255.0).mean(axis=-1).astype(np.float32)
        if photograph.mask is not None:
            error[photograph.mask.numpy() == 0] = np.nan
        return ImageErrorMap(camera, error, raster.median_depth.cpu().numpy())


def _reproject_error(
    error_map: ImageErrorMap, camera: Camera, depth: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Errors where `camera` sees them, from where the photograph does."""
    pixels, distance = error_map.camera.project(camera.unproject(depth).reshape(-1, 3))
    x, y = ((pixels[:, axis] - 0.5).reshape(depth.shape).astype(np.float32) for axis in (0, 1))
    shown_depth = cv2.remap(error_map.depth, x, y, cv2.INTER_NEAREST, borderValue=0.0)
    error = cv2.remap(error_map.error, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    distance = distance.reshape(depth.shape)
    agrees = np.abs(shown_depth - distance) <= _DEPTH_TOLERANCE * np.abs(distance)
    return np.where((depth > 0) & (distance > 0) & (shown_depth > 0) & agrees, error, np.nan).astype(np.float32)


def load_resized_image(scene: ViewerScene, index: int, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """A photograph at a size. Raises CaptureError if it cannot be read."""
    pixels = scene.images.get(index).image.numpy()
    return np.ascontiguousarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))


def warp_image(
    scene: ViewerScene, index: int, camera: Camera
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """A photograph as another camera at the same position sees it, and where it covers that view: without a change of
    position, pixels map to pixels."""
    taken = scene.capture.views[index].camera
    scale = min(1.0, camera.fx / taken.fx)
    taken = taken.resized(max(1, round(taken.width * scale)), max(1, round(taken.height * scale)))
    image = load_resized_image(scene, index, taken.width, taken.height)
    turn = camera.camera_from_world[:3, :3] @ taken.camera_from_world[:3, :3].T
    mapping = _intrinsics(camera) @ turn @ np.linalg.inv(_intrinsics(taken))
    size = (camera.width, camera.height)
    warped = cv2.warpPerspective(image, mapping, size, flags=cv2.INTER_LINEAR)
    inside = cv2.warpPerspective(np.ones(image.shape[:2], np.uint8), mapping, size, flags=cv2.INTER_NEAREST)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    in_front = np.linalg.inv(mapping)[2] @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    return np.asarray(warped), (inside > 0) & (in_front.reshape(inside.shape) > 0)


def _intrinsics(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """For OpenCV, where the center of the first pixel is (0, 0)."""
    return np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
