"""Camera poses of a client: the browser's camera as a `Camera` and back, and the poses that buttons lead to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vdgs.captures.capture import Capture
from vdgs.captures.first_view import FOV_DEG, default_view
from vdgs.config.commands import MAX_RENDER_SIDE_PX, RENDER_BYTES_PER_PIXEL
from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import pose_from_rotation

#: With a steeper view than this, the heading no longer follows from the direction of the view.
_NADIR_COSINE = 0.995
#: How far a view from straight above is tilted, so that it knows which way is north.
_NADIR_TILT = 1e-3
#: No canvas has more pixels: those of a screen of 8K (choice).
MAX_CANVAS_PIXELS = 7680 * 4320
#: The panel and its margin, at the right, in pixels of the page (`control_width` medium). Windows up to the other width
#: have the panel below. A canvas so wide is taken for one of a screen of two pixels for each of the page (choice).
PANEL_PX, MAX_MOBILE_WIDTH_PX, DENSE_WIDTH_PX = 335, 576, 2000
#: `default_view` fills a share of the height with what many cameras see. With what fewer see at its ends, what is shown
#: is so many heights wide (choice).
NEEDED_SHARE = 1.2


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Position and look-at point of a client's camera, ground frame; z is up."""

    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]

    @property
    def distance(self) -> float:
        """From the position to the look-at point."""
        return float(np.linalg.norm(self.look_at - self.position))


def camera_from_browser(wxyz: np.ndarray, position: np.ndarray, fov: float, width: int, height: int) -> Camera:
    """The browser's camera: `wxyz` turns camera axes (OpenCV) into the world, `fov` is vertical, in radians.

    Raises ValueError for what is no camera: numbers that are not finite, an empty canvas, an impossible angle.
    """
    quaternion, position = np.asarray(wxyz, np.float64), np.asarray(position, np.float64)
    usable = np.isfinite(quaternion).all() and np.isfinite(position).all() and np.linalg.norm(quaternion) > 1e-6
    if not (usable and width > 0 and height > 0 and 1e-3 < fov < math.pi - 1e-3):
        raise ValueError("this is no camera")
    pose = pose_from_rotation(_rotation_matrix(quaternion / np.linalg.norm(quaternion)).T, position)
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(camera_from_world=pose, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)


def max_render_pixels(free_bytes: int) -> int:
    """How many pixels an image may have where so many bytes of memory are free."""
    return max(1, min(MAX_CANVAS_PIXELS, free_bytes // RENDER_BYTES_PER_PIXEL))


def limit_resolution(camera: Camera, max_pixels: float) -> Camera:
    """The same view with at most `max_pixels` pixels and `MAX_RENDER_SIDE_PX` a side: the browser enlarges what comes.
    The same object where it is no larger."""
    pixels, longest = camera.width * camera.height, max(camera.width, camera.height)
    scale = min((max_pixels / pixels) ** 0.5, MAX_RENDER_SIDE_PX / longest)
    if scale >= 1.0:
        return camera
    return camera.resized(max(1, int(scale * camera.width)), max(1, int(scale * camera.height)))


def _rotation_matrix(wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """The rotation of a unit quaternion: v -> v + 2w (u × v) + 2u × (u × v)."""
    w, (x, y, z) = wxyz[0], wxyz[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * (w * cross + cross @ cross)


def overview_pose(capture: Capture, canvas: tuple[int, int] | None = None, whole: bool = False) -> CameraPose:
    """The first view, on a canvas of this width and height in pixels (None: one that hides nothing): all of the flight,
    or unless the `whole` is asked for, what the photographs look at (`default_view`)."""
    pose = CameraPose(*default_view(capture, whole))
    return pose if canvas is None else fitted_pose(pose, canvas)


def fitted_pose(pose: CameraPose, canvas: tuple[int, int]) -> CameraPose:
    """A first view on a canvas of this width and height (`fit_beside_panel`)."""
    farther, aside = fit_beside_panel(*canvas)
    target, away = pose.look_at, farther * (pose.position - pose.look_at)
    right = np.cross((0.0, 0.0, 1.0), away)
    right *= aside * 2 * math.tan(math.radians(FOV_DEG / 2)) * np.linalg.norm(away) / np.linalg.norm(right)
    return CameraPose(target + away + right, target + right)


def fit_beside_panel(width: int, height: int) -> tuple[float, float]:
    """How many times farther one stands than `default_view`, and how far to the right of it, in heights of the picture:
    so that what is shown lies beside the panel, in the middle of what is free or left of the middle of the window."""
    if width < height or width <= MAX_MOBILE_WIDTH_PX:
        return max(1.0, height / width), 0.0
    panel = (2 if width >= DENSE_WIDTH_PX else 1) * PANEL_PX
    needed, free = NEEDED_SHARE * height / 2, width / 2 - panel
    shift = min(max(needed - free, 0.0), panel / 2)
    return max(1.0, needed / (free + shift)), shift / height


def top_down_pose(pose: CameraPose) -> CameraPose:
    """The same place from straight above, north up."""
    return CameraPose(pose.look_at + pose.distance * np.array([0.0, -_NADIR_TILT, 1.0]), pose.look_at)


def north_up_pose(pose: CameraPose) -> CameraPose:
    """The same place, as steeply and as far, looking north."""
    away = pose.position - pose.look_at
    return CameraPose(pose.look_at + np.array([0.0, -np.hypot(away[0], away[1]) - 1e-9, away[2]]), pose.look_at)


def zoom_to(pose: CameraPose, target: Float[np.ndarray, "3"], factor: float = 0.35) -> CameraPose:
    """Looking at a place in the same direction, from a share of the present distance to it."""
    direction = (pose.position - pose.look_at) / max(pose.distance, 1e-9)
    return CameraPose(target + direction * factor * float(np.linalg.norm(pose.position - target)), target)


def pose_from_camera(camera: Camera, distance: float) -> CameraPose:
    """Where a photograph was taken, looking where it looks `distance` away. One taken straight down is tilted by a
    hair, so that its upper edge stays up: z is up for whoever moves on from there."""
    forward, up = camera.forward, -camera.camera_from_world[1, :3]
    if abs(forward[2]) > _NADIR_COSINE:
        forward = forward + 3 * _NADIR_TILT * up
    forward = forward / np.linalg.norm(forward)
    return CameraPose(camera.position.copy(), camera.position + distance * forward)


def fov_to_fit(camera: Camera, aspect: float) -> float:
    """The vertical angle, in radians, at which a canvas (width over height) holds all of a photograph's."""
    return 2.0 * math.atan(max(0.5 * camera.height / camera.fy, 0.5 * camera.width / camera.fx / aspect))
