"""Camera paths from files: the images of a COLMAP model in the source frame, one a frame (`colmap_path`); or JSON,
either our own:

    {
      "frame": "ground",              // or "source": the frame of the capture's own cameras
      "seconds": 10, "fps": 30,       // optional
      "closed": false,                // optional: come back to the first key frame
      "interpolate": true,            // optional: false shows the key frames as they are, one a frame
      "keyframes": [
        {"position": [0, 0, 30], "look_at": [0, 20, 0], "up": [0, 0, 1], "fov_deg": 60},
        {"camera_from_world": [[...], [...], [...], [0, 0, 0, 1]],
         "fx": 800, "fy": 800, "cx": 480, "cy": 270, "width": 960, "height": 540}
      ]
    }

or a camera path exported by nerfstudio's viewer (`camera_path`, OpenGL cameras): in nerfstudio's own frame, which
dataparser_transforms.json leads back from (`rendering.nerfstudio`), unless it has a `frame` too. `fov_deg` is the
vertical angle of view. What a key frame leaves out of the intrinsics comes from the camera that the caller gives. What
is not named here is a mistake. So it is in a file of nerfstudio's, where what its editor keeps for itself (`keyframes`,
`smoothness_value`, ...) has its part in the frames already; what asks for another camera, a crop or another time is
refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vdgs.captures.text_tables import decode_text
from vdgs.config import commands
from vdgs.config.ranges import Range
from vdgs.config.serialization import suggest
from vdgs.errors import VdgsError
from vdgs.geometry.camera import MAX_COORDINATE, Camera, is_rigid_motion
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.rendering.camera_paths import (
    DEFAULT_FPS,
    DEFAULT_SECONDS,
    CameraPath,
    frame_count,
    interpolate,
    look_at_pose,
    pose_from_rotation,
)
from vdgs.rendering.colmap_path import is_colmap, read_colmap_path
from vdgs.rendering.nerfstudio import find_nerfstudio_frame, pose_in_source

#: What our own files may hold.
_FILE_KEYS = ("frame", "seconds", "fps", "closed", "interpolate", "keyframes")
_FRAMES = ("ground", "source")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_SIZE = ("width", "height")
_FRAME_KEYS = ("position", "look_at", "up", "camera_from_world", "fov_deg", *_INTRINSICS, *_SIZE)
#: What a file of nerfstudio's may hold. Its editor's own settings have made the frames of `camera_path`.
_NERFSTUDIO_KEYS = (
    "camera_path", "camera_type", "render_width", "render_height", "fps", "seconds", "frame", "crop", "closed",
    "keyframes", "smoothness_value", "is_cycle", "default_fov", "default_transition_sec",
)  # fmt: skip
#: `aspect` is not read, as nerfstudio does not: its Blender add-on writes 1 for films of any shape.
_NERFSTUDIO_FRAME_KEYS = ("camera_to_world", "fov", "aspect", "render_time")
#: Focal lengths and principal points, in pixels.
_FOCAL, _PIXELS = Range(0, 1e7, exclusive_min=True), Range(-1e7, 1e7)
_SIDE = Range(1, commands.MAX_RENDER_SIDE_PX)
_FOV_DEG = Range(0, 180, exclusive_min=True, exclusive_max=True)


def load_path(
    file: Path,
    default: Camera,
    ground: GroundFrame | None = None,
    seconds: float | None = None,
    fps: float | None = None,
    capture: Path | None = None,
) -> CameraPath:
    """Read a camera path (module docstring); `default` gives the size and intrinsics left out.

    `ground` brings paths in the source frame (and nerfstudio's) into the ground frame; `seconds` and
    `fps` go before what the file says; `capture` is the folder where nerfstudio's frame is looked for last. Cameras
    come back in the ground frame (z up). Raises VdgsError naming the file, the key frame and the field, and where
    nerfstudio's frame is not known.
    """
    content = {} if is_colmap(file) else _read(file)
    try:
        if is_colmap(file):
            cameras, interpolated, frame = read_colmap_path(file, default), False, "source"
        elif "camera_path" in content:
            cameras, interpolated, frame = _from_nerfstudio(content, default)
        else:
            cameras, interpolated, frame = _from_keyframes(content, default)
        rate = fps or _number(content, "fps", commands.FPS_RANGE) or DEFAULT_FPS
        length = seconds or _number(content, "seconds", commands.SECONDS_RANGE) or DEFAULT_SECONDS
        closed = _flag(content, "closed", False)
    except (TypeError, ValueError, OverflowError) as error:
        raise VdgsError(f"{file}: {error}. `vdgs render --help` says under --path what a camera path holds.") from error
    if frame == "nerfstudio":
        known = find_nerfstudio_frame(file, capture)
        cameras = [replace(each, camera_from_world=pose_in_source(each.camera_from_world, known)) for each in cameras]
    if frame != "ground" and ground is not None:
        cameras = [_to_ground(camera, ground) for camera in cameras]
    if interpolated or (seconds is not None and len(cameras) > 1):
        cameras = interpolate(cameras, frame_count(length, rate), closed=closed)
    return CameraPath(tuple(cameras), rate)


def _read(file: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(decode_text(file.read_bytes()))
    except FileNotFoundError as error:
        raise VdgsError(f"{file}: no such camera path.") from error
    except OSError as error:
        raise VdgsError(f"{file}: cannot be read ({error.strerror or error}).") from error
    except (ValueError, RecursionError) as error:
        raise VdgsError(
            f"{file}: is not a camera path in JSON ({error}). Save it anew from the viewer, or mend that place."
        ) from error
    if isinstance(content, list):
        content = {"keyframes": content}
    if not isinstance(content, Mapping):
        raise VdgsError(f"{file}: a camera path is a list of key frames, or an object with `keyframes`.")
    if "frames" in content:
        raise VdgsError(
            f"{file}: lists photographs and their poses (as transforms.json does), which is no camera path. Write each "
            "pose as camera_from_world of a key frame, or give the folder of a COLMAP model of them."
        )
    return content


def _from_keyframes(content: Mapping[str, Any], default: Camera) -> tuple[list[Camera], bool, str]:
    """The cameras, whether there shall be others between them, and the frame that they are in."""
    _check_keys(content, _FILE_KEYS)
    frames, frame = content.get("keyframes"), _frame(content, "ground")
    _require(isinstance(frames, list) and len(frames) > 0, "`keyframes` must be a list of at least one")
    cameras, default = list[Camera](), _common_size(frames or [], default)
    for number, entry in enumerate(frames or []):
        try:
            _require(isinstance(entry, Mapping), "it must be an object")
            cameras.append(_keyframe(entry, default))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"key frame {number}: {error}") from error
    return cameras, _flag(content, "interpolate", True) and len(cameras) > 1, frame


def _common_size(frames: Sequence[Any], default: Camera) -> Camera:
    """The default in the size that key frames ask for. Raises ValueError where they ask for several: a path has one."""
    first: tuple[int, Camera] | None = None
    for number, entry in enumerate(frames):
        if not isinstance(entry, Mapping) or all(entry.get(name) is None for name in _SIZE):
            continue
        try:
            width, height = (_number(entry, name, _SIDE) for name in _SIZE)
        except ValueError as error:
            raise ValueError(f"key frame {number}: {error}") from error
        asked = default.reshaped(int(width or default.width), int(height or default.height))
        if first is None:
            first = number, asked
        elif (asked.width, asked.height) != (first[1].width, first[1].height):
            raise ValueError(
                f"key frame {number} asks for {asked.width}x{asked.height}, key frame {first[0]} for "
                f"{first[1].width}x{first[1].height}, and a path has one size. Give one width and height, or leave "
                "them out and use --width"
            )
    return default if first is None else first[1]


def _frame(content: Mapping[str, Any], default: str) -> str:
    frame = content.get("frame", default)
    _require(frame in (*_FRAMES, default), f"`frame` is {frame!r}; it must be {' or '.join(_FRAMES)}")
    return str(frame)


def _keyframe(entry: Mapping[str, Any], default: Camera) -> Camera:
    _check_keys(entry, _FRAME_KEYS)
    if "camera_from_world" in entry:
        twice = [name for name in ("position", "look_at", "up") if name in entry]
        _require(not twice, f"camera_from_world already says where the camera is: leave out {', '.join(twice)}")
        pose = _matrix(entry["camera_from_world"], "camera_from_world")
    else:
        _require("position" in entry and "look_at" in entry, "give camera_from_world, or position and look_at")
        pose = look_at_pose(
            _vector(entry["position"], "position"),
            _vector(entry["look_at"], "look_at"),
            _vector(entry.get("up", (0, 0, 1)), "up"),
        )
    camera = replace(default, camera_from_world=pose)
    fov = _number(entry, "fov_deg", _FOV_DEG)
    if fov is not None:
        _require("fx" not in entry and "fy" not in entry, "give fov_deg or fx and fy, not both")
        camera = _with_fov(camera, fov)
    bounds = {"fx": _FOCAL, "fy": _FOCAL, "cx": _PIXELS, "cy": _PIXELS}
    given = {name: _number(entry, name, bounds[name]) for name in _INTRINSICS if name in entry}
    return replace(camera, **given)  # type: ignore[arg-type]


def _from_nerfstudio(content: Mapping[str, Any], default: Camera) -> tuple[list[Camera], bool, str]:
    """nerfstudio: camera_to_world of OpenGL cameras (+y up, +z backward), 16 numbers, vertical `fov`; every frame is
    there."""
    _check_keys(content, _NERFSTUDIO_KEYS)
    kind = content.get("camera_type", "perspective")
    _require(
        isinstance(kind, str) and kind.lower() in ("perspective", "persp"),
        f"camera_type is {kind!r}, and only perspective cameras are drawn. Choose Perspective in nerfstudio and export "
        "the path again",
    )
    _require(content.get("crop") is None, "it has a crop, and no part of a scene is drawn alone. Remove `crop`")
    width, height = (_number(content, f"render_{name}", _SIDE) for name in _SIZE)
    size = int(width or default.width), int(height or default.height)
    entries = content["camera_path"]
    _require(isinstance(entries, list) and len(entries) > 0, "`camera_path` must be a list of at least one")
    cameras = []
    for number, entry in enumerate(entries):
        try:
            _require(isinstance(entry, Mapping), "it must be an object")
            _require("camera_to_world" in entry, "camera_to_world is missing")
            _check_keys(entry, _NERFSTUDIO_FRAME_KEYS)
            _refuse_other_times(entry)
            world_from_camera = _matrix(entry["camera_to_world"], "camera_to_world") @ np.diag([1.0, -1.0, -1.0, 1.0])
            camera = replace(default.reshaped(*size), camera_from_world=np.linalg.inv(world_from_camera))
            cameras.append(_with_fov(camera, _number(entry, "fov", _FOV_DEG) or 50.0))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"frame {number} of camera_path: {error}") from error
    return cameras, False, _frame(content, "nerfstudio")


def _refuse_other_times(entry: Mapping[str, Any]) -> None:
    """Raise ValueError for a frame of another time."""
    moment = entry.get("render_time")
    _require(moment in (None, 0, 0.0), f"render_time is {moment!r}, and the scene stands still. Remove `render_time`")


def _check_keys(entry: Mapping[str, Any], keys: Sequence[str]) -> None:
    unknown = [str(key) for key in entry if key not in keys]
    if unknown:
        raise ValueError(f"there is no {unknown[0]!r}{suggest(unknown[0], keys)} (possible here are {', '.join(keys)})")


def _number(entry: Mapping[str, Any], name: str, bounds: Range) -> float | None:
    """A number by its name; None where it is not there."""
    value = entry.get(name)
    if value is None:
        return None
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    _require(is_number and bounds.contains(value), f"{name} is {value!r}; it must be a number, {bounds}")
    return float(value)


def _flag(entry: Mapping[str, Any], name: str, default: bool) -> bool:
    value = entry.get(name, default)
    _require(isinstance(value, bool), f"{name} is {value!r}; it must be true or false")
    return bool(value)


def _with_fov(camera: Camera, fov_deg: float) -> Camera:
    focal = 0.5 * camera.height / math.tan(0.5 * math.radians(fov_deg))
    return replace(camera, fx=focal, fy=focal, cx=camera.width / 2.0, cy=camera.height / 2.0)


def _matrix(value: Any, name: str) -> Float[np.ndarray, "4 4"]:
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.size == 12:
        matrix = np.concatenate([matrix.reshape(3, 4), [[0.0, 0.0, 0.0, 1.0]]])
    _require(matrix.size == 16, f"{name} must be 4 x 4 numbers")
    matrix = matrix.reshape(4, 4)
    _require(is_rigid_motion(matrix), f"{name} must be a rotation and a translation")
    return matrix


def _vector(value: Any, name: str) -> Float[np.ndarray, "3"]:
    try:
        vector = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    whole = vector.shape == (3,) and bool(np.isfinite(vector).all()) and np.abs(vector).max() <= MAX_COORDINATE
    _require(bool(whole), f"{name} must be three numbers")
    return vector


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _to_ground(camera: Camera, ground: GroundFrame) -> Camera:
    position = ground.to_ground(camera.position[None])[0]
    return replace(
        camera, camera_from_world=pose_from_rotation(camera.camera_from_world[:3, :3] @ ground.rotation.T, position)
    )
