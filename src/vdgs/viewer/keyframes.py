"""A camera path made by looking: key frames in the file that `vdgs render --path` reads."""

from __future__ import annotations

import json
from collections.abc import Sequence

from vdgs.geometry.camera import Camera
from vdgs.rendering.camera_paths import DEFAULT_FPS, interpolate

#: A film has even sides, and is at most so wide (choice).
_MAX_WIDTH = 1920


def path_json(keyframes: Sequence[Camera], seconds: float, closed: bool = False, fps: float = DEFAULT_FPS) -> str:
    """The text of a camera path in the ground frame, of the size of its first key frame. Numbers keep all digits.

    Raises ValueError without key frames.
    """
    if not keyframes:
        raise ValueError("a camera path needs at least one key frame")
    first = keyframes[0].limit_size(_MAX_WIDTH)
    width, height = (max(2, size // 2 * 2) for size in (first.width, first.height))
    content = {
        "frame": "ground", "seconds": seconds, "fps": fps, "closed": closed, "interpolate": True,
        "keyframes": [_keyframe_json(camera.resized(width, height)) for camera in keyframes],
    }  # fmt: skip
    return json.dumps(content, indent=1) + "\n"


def _keyframe_json(camera: Camera) -> dict[str, object]:
    return {
        "camera_from_world": camera.camera_from_world.tolist(), "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
        "cy": camera.cy, "width": camera.width, "height": camera.height,
    }  # fmt: skip


def camera_at_time(keyframes: Sequence[Camera], seconds: float, time: float, closed: bool = False) -> Camera:
    """The camera of a path after so many seconds of it, as the film will have it."""
    frames = interpolate(keyframes, max(1, round(seconds * DEFAULT_FPS)), closed)
    return frames[min(max(int(time * DEFAULT_FPS), 0), len(frames) - 1)]
