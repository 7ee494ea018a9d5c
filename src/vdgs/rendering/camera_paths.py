"""Camera paths in the ground frame (z up): through key frames, around a scene, along a flight. See `path_io`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vdgs.config.commands import MAX_FRAMES
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.geometry.view_convergence import Convergence, find_convergence

DEFAULT_FPS = 30.0
DEFAULT_SECONDS = 12.0
#: A flyover looks down at least this far from straight down, so that what stands up is seen (choice).
FLYOVER_TILT_DEG = 20.0
#: Cameras of the flight that a flyover keeps at most; more would not be seen through the smoothing.
_MAX_TRACK_CAMERAS = 400
#: An orbit about a place is no wider than so many times the median distance of those that look at it (choice).
MOST_OF_MEDIAN = 1.5


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The cameras of a video, one a frame, all of one size."""

    cameras: tuple[Camera, ...]
    fps: float
    converged: Convergence | None = None
    """The place at which all of them look, where the views of the training cameras converge on it."""


def frame_count(seconds: float, fps: float) -> int:
    """Frames of a video, at least one. Raises VdgsError for more than can be drawn."""
    if not seconds * fps <= MAX_FRAMES:
        raise VdgsError(
            f"a film of {seconds:g} seconds at {fps:g} frames a second has {seconds * fps:,.0f} frames, more than "
            f"{MAX_FRAMES:,}. Give fewer --seconds or less --fps."
        )
    return max(1, round(seconds * fps))


def interpolate(keyframes: Sequence[Camera], n_frames: int, closed: bool = False) -> list[Camera]:
    """`n_frames` cameras through the key frames: Catmull-Rom on positions, slerp on rotations.

    The knots are spaced by the distance between key frames, so that the speed is even, and half evenly,
    so that turning on the spot takes time too (choice). The ends are met exactly; a closed path leaves
    out the frame that would repeat the first. Intrinsics are interpolated linearly, the size is the first's
    (`Camera.reshaped`).
    """
    from scipy.interpolate import CubicHermiteSpline  # slow to load, and most who look at a scene make no path
    from scipy.spatial.transform import Rotation, Slerp

    if not keyframes:
        raise ValueError("a path needs at least one key frame")
    frames = [*keyframes, keyframes[0]] if closed and len(keyframes) > 1 else list(keyframes)
    if len(frames) == 1:
        return [frames[0]] * n_frames
    positions = np.stack([camera.position for camera in frames])
    knots = _knots(positions)
    times = np.linspace(0.0, knots[-1], n_frames, endpoint=not closed)
    spline = CubicHermiteSpline(knots, positions, _tangents(positions, knots, closed))
    rotations = Rotation.from_matrix(np.stack([camera.camera_from_world[:3, :3] for camera in frames]))
    turned = Slerp(knots, rotations)(times).as_matrix()
    first = frames[0]
    reshaped = [camera.reshaped(first.width, first.height) for camera in frames]
    intrinsics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in reshaped])
    values = np.stack([np.interp(times, knots, column) for column in intrinsics.T], axis=1)
    return [
        replace(first, camera_from_world=pose_from_rotation(rotation, position), fx=fx, fy=fy, cx=cx, cy=cy)
        for rotation, position, (fx, fy, cx, cy) in zip(turned, spline(times), values.tolist(), strict=True)
    ]


def orbit(
    points: Float[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    template: Camera,
    seconds: float = DEFAULT_SECONDS,
    fps: float = DEFAULT_FPS,
) -> CameraPath:
    """Once around what the photographs look at, looking at it, as high as the flight.

    That is the place on which their views converge (`find_convergence`), seen from as far as those views are; where
    they do not, the median of the points. The orbit is an ellipse along the axes of the flight, so that
    a long narrow one is not left sideways: its half axes are the 90 % extent of the training cameras that converge,
    or two thirds of that of all, but at least a quarter of the height (choices). `template` gives intrinsics and size.
    """
    converged = find_convergence(cameras)
    positions = np.stack([camera.position for camera in cameras])
    if converged is not None:
        # No nearer: photographs of what is tall hold it just so, and from within their ring its top is cut off.
        center, positions, share = converged.place, positions[converged.looking], 1.0
        height = float(np.median(positions[:, 2]) - center[2])
    else:
        center, share = np.median(points, axis=0), 2.0 / 3.0
        height = max(float(np.median(positions[:, 2]) - center[2]), 1e-3)
    offsets = positions[:, :2] - center[:2]
    axes = np.linalg.svd(offsets, full_matrices=False)[2] if len(offsets) > 1 else np.eye(2)
    reach = np.quantile(np.abs(offsets @ axes.T), 0.9, axis=0)
    radii = np.maximum(share * reach, 0.25 * abs(height))
    if converged is not None:  # some may have looked there on their way
        radii = np.minimum(radii, MOST_OF_MEDIAN * float(np.median(np.linalg.norm(offsets, axis=1))))
    angles = np.linspace(0.0, 2.0 * np.pi, frame_count(seconds, fps), endpoint=False)
    offsets = ((radii * [np.cos(angle), np.sin(angle)]) @ axes for angle in angles)
    poses = (look_at_pose(center + np.append(offset, height), center) for offset in offsets)
    return CameraPath(tuple(replace(template, camera_from_world=pose) for pose in poses), fps, converged)


def flyover(
    cameras: Sequence[Camera],
    template: Camera,
    seconds: float = DEFAULT_SECONDS,
    fps: float = DEFAULT_FPS,
) -> CameraPath:
    """Along the track of the training cameras, smoothed, looking ahead and down.

    Its angle from straight down is the median of the training cameras, at least `FLYOVER_TILT_DEG`. Where views
    converge on a place (`find_convergence`), the film looks at that place, along the track of the cameras that do: what
    is ahead in an orbit is not what it was flown for. Cameras are taken in the order given, or from neighbor to
    neighbor where that is much shorter (names do not always follow the flight). The speed is even.
    """
    if not cameras:
        raise ValueError("a flyover needs training cameras")
    converged = find_convergence(cameras)
    if converged is not None:
        poses = _poses_about(converged, cameras, frame_count(seconds, fps))
        return CameraPath(tuple(replace(template, camera_from_world=pose) for pose in poses), fps, converged)
    from scipy.ndimage import gaussian_filter1d

    downwards = np.clip([-camera.forward[2] for camera in cameras], -1.0, 1.0)
    tilt_deg = max(FLYOVER_TILT_DEG, float(np.degrees(np.arccos(np.median(downwards)))))
    n_frames = frame_count(seconds, fps)
    track = _smooth_track(np.stack([camera.position for camera in cameras]), n_frames)
    # Turns take a second: where one strip ends and the next begins, the track folds back on itself.
    step = gaussian_filter1d(np.gradient(track[:, :2], axis=0), max(fps / 2.0, 1.0), axis=0, mode="nearest") \
        if n_frames > 1 else np.array([[0.0, 1.0]])  # fmt: skip
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    ahead, down = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
    frames = []
    for position, angle in zip(track, heading, strict=True):
        level = np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = ahead * level - np.array([0.0, 0.0, down])
        pose = look_at_pose(position, position + forward, up=level if tilt_deg < 45.0 else np.array([0.0, 0.0, 1.0]))
        frames.append(replace(template, camera_from_world=pose))
    return CameraPath(tuple(frames), fps)


def _poses_about(converged: Convergence, cameras: Sequence[Camera], n_frames: int) -> Iterator[np.ndarray]:
    """Poses along the smoothed track of the cameras whose views converge on a place, all of them looking at it."""
    place, looking = converged.place, np.stack([camera.position for camera in cameras])[converged.looking]
    away = np.linalg.norm(looking - place, axis=1)
    # Distances are smoothed by themselves: a smoothed ring is narrower, and what is tall would not fit the frames.
    track, away = np.split(_smooth_track(np.column_stack([looking, away]), n_frames), [3], axis=1)
    offsets = track - place
    offsets *= away / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9)
    return (look_at_pose(place + offset, place) for offset in offsets)


def look_at_pose(position: np.ndarray, target: np.ndarray, up: Sequence[float] | np.ndarray = (0, 0, 1)) -> np.ndarray:
    """`camera_from_world` [4, 4] of a camera at `position` that sees `target` in its middle.

    `up` points to the upper edge of the image; where it is parallel to the view, north (+y) does.
    Raises ValueError where position and target are one point.
    """
    forward = np.asarray(target, dtype=np.float64) - position
    length = np.linalg.norm(forward)
    if length <= 1e-12:
        raise ValueError("`position` and `look_at` are the same point")
    forward = forward / length
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pose_from_rotation(rotation, np.asarray(position, dtype=np.float64))


def pose_from_rotation(
    rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """`camera_from_world` of a camera with this rotation at this position."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix


def _knots(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    even = np.full(len(lengths), 1.0 / len(lengths))
    shares = 0.5 * (lengths / lengths.sum() + even) if lengths.sum() > 0 else even
    return np.concatenate([[0.0], np.cumsum(shares)])


def _tangents(
    positions: Float[np.ndarray, "n 3"], knots: Float[np.ndarray, "n"], closed: bool
) -> Float[np.ndarray, "n 3"]:
    """Catmull-Rom: the slope between the neighbors; at the ends of an open path, to the one neighbor."""
    if closed:
        before, after = positions[-2] - positions[-1], positions[1] - positions[0]
        padded = np.concatenate([[positions[0] + before], positions, [positions[-1] + after]])
        times = np.concatenate([[knots[-2] - knots[-1]], knots, [knots[-1] + knots[1]]])
    else:
        padded, times = positions[[0, *range(len(positions)), -1]], knots[[0, *range(len(knots)), -1]]
    return (padded[2:] - padded[:-2]) / (times[2:] - times[:-2])[:, None]


def _smooth_track(positions: Float[np.ndarray, "n k"], n_frames: int) -> Float[np.ndarray, "f k"]:
    """The positions, and what is to be smoothed with them, as one even, smooth line of `n_frames` points."""
    if len(positions) > _MAX_TRACK_CAMERAS:
        positions = positions[np.linspace(0, len(positions) - 1, _MAX_TRACK_CAMERAS).round().astype(int)]
    chained = _neighbor_order(positions)
    if _length(chained) < 0.6 * _length(positions):
        positions = chained
    if len(positions) == 1 or _length(positions) == 0.0:
        return np.repeat(positions[:1], n_frames, axis=0)
    from scipy.ndimage import gaussian_filter1d

    dense = _resample_line(positions, max(16 * len(positions), n_frames))
    # Smoothing over about two cameras rounds the turns and takes out the jitter of single positions.
    smooth = gaussian_filter1d(dense, 2.0 * len(dense) / len(positions), axis=0, mode="nearest")
    return _resample_line(smooth, n_frames)


def _neighbor_order(positions: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
    """From the first position always to the nearest one not yet visited; O(n²)."""
    left, order = np.ones(len(positions), bool), [0]
    left[0] = False
    while left.any():
        distance = np.where(left, np.linalg.norm(positions - positions[order[-1]], axis=1), np.inf)
        order.append(int(distance.argmin()))
        left[order[-1]] = False
    return positions[order]


def _resample_line(line: Float[np.ndarray, "n k"], count: int) -> Float[np.ndarray, "m k"]:
    """`count` points at even distances along a polyline."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, column) for column in line.T], axis=1)


def _length(line: Float[np.ndarray, "n k"]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
