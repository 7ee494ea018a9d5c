"""What the JSON formats of the NeRF family share: reading safely, camera axes, intrinsics by key."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from vdgs.captures.formats.center_sizes import told_size
from vdgs.captures.formats.lens_keys import (
    FOCAL,
    LENS,
    OTHER_PARAMETERS,
    RATIONAL,
    check_has_coefficients,
    check_own_matrix,
    model_of_distortion,
    named_model,
    with_known_keys,
    with_nested_model,
)
from vdgs.captures.formats.source_capture import (
    BROWN,
    BadPose,
    Intrinsics,
    check_intrinsics,
    safe_name,
    say_of_panoramas,
    to_rigid,
)
from vdgs.captures.image_files import read_header
from vdgs.captures.name_resolution import find_file
from vdgs.captures.text_tables import read_text
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

#: So many keys of a frame are named in messages.
_SAID_KEYS = 8
#: Camera axes: OpenGL (right, up, back) from OpenCV (right, down, forward); its own inverse.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
#: A rotation that is longer or shorter by more than this share is scaled; rounding makes less.
_SCALED = 1e-3
_UNSCALE = (
    "The file is damaged or of another convention; if Blender wrote it, apply the scale of the camera and of what it "
    "hangs on (Ctrl-A, Scale), and export again."
)


def mask_of_frame(frame: JsonObject, file: Path, root: Path) -> Path | None:
    """The mask that a frame names, also as in a URI (`%20`). Raises `CaptureError` for a path that leaves the
    capture."""
    mask = frame.get("mask_path")
    if not mask:
        return None
    name = safe_name(str(mask), file, "mask_path", root)
    decoded = safe_name(unquote(name), file, "mask_path", root)
    return find_file(root, name) or find_file(root, decoded) or root / name


def read_capture_json(file: Path) -> JsonObject:
    """The object in a JSON file. Raises `CaptureError` for anything else."""
    content = read_json_text(file, "Export it again.")
    if not isinstance(content, dict):
        raise CaptureError(f"{file}: must hold a JSON object with a list 'frames'{_found_instead(content)}")
    return content


def _found_instead(content: object) -> str:
    """What a JSON file holds instead of an object, and what is read."""
    first = content[0] if isinstance(content, list) and content else None
    if isinstance(first, dict) and {"file_path", "transform"} <= first.keys():
        return (
            ", and is a list as ns-export cameras of nerfstudio writes it, without lenses. The transforms.json or "
            "COLMAP model that the training was of is read. Give the folder of that."
        )
    return f", not {'a list' if isinstance(content, list) else 'this'}. Export it again."


def read_json_text(file: Path, remedy: str) -> Any:
    """What a JSON file holds. Raises `CaptureError`, which ends in the remedy, for a file that is none."""
    text = read_text(file)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{file}: is not JSON ({error}). {remedy}") from None


def get_frames(content: JsonObject, file: Path, key: str = "frames") -> list[JsonObject]:
    """The list of frames. Raises `CaptureError` if there are none."""
    frames = content.get(key)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise CaptureError(f"{file}: must hold a list {key!r} of posed images, and it has none.")
    return frames


def matrix_of_frame(frame: JsonObject, file: Path, label: str, *keys: str) -> np.ndarray:
    """The matrix of a frame [4, 4] by the first of the keys that it has, `transform_matrix` if none is given. Raises
    `BadPose`, which says what the frame has instead."""
    keys = keys or ("transform_matrix",)
    value = next((frame[key] for key in keys if frame.get(key) is not None), None)
    if value is None:
        has = ", ".join(map(repr, list(frame)[:_SAID_KEYS])) or "nothing"
        raise BadPose(
            f"{file}: {label} has no {keys[0]!r} (it has {has}). Write its pose there: world from camera, 4 rows of 4 "
            "numbers, axes of OpenGL (x right, y up, z back)."
        )
    if isinstance(value, list) and len(value) in (12, 16) and not any(isinstance(each, list) for each in value):
        raise BadPose(
            f"{file}: {label} has a matrix as one list of {len(value)} numbers. Write it as 4 lists of 4, row by row, "
            "with the place in the last column."
        )
    return parse_matrix(value, file, label)


def parse_matrix(value: object, file: Path, label: str) -> np.ndarray:
    """A matrix [3 or 4, 4] float64 from nested lists, completed to [4, 4]. Raises `CaptureError`."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise BadPose(f"{file}: {label} needs a 4x4 matrix of finite numbers. Export it again.")
    if len(matrix) == 4 and np.abs(matrix[3, :3]).max() > 1e-6 * np.abs(matrix).max():
        way = " It seems transposed: the place belongs into the last column." if not matrix[:3, 3].any() else ""
        raise BadPose(f"{file}: {label} has a matrix whose last row is not 0 0 0 1.{way} Export it again.")
    result = np.eye(4)
    result[:3] = matrix[:3]
    return result


def camera_motion(matrix: np.ndarray, file: Path, label: str) -> np.ndarray:
    """World from camera [4, 4], a rigid motion with OpenCV's axes of the camera, of one with OpenGL's.

    A scale of the rotation is divided out: Blender writes it where the camera object is scaled, and sees the same with
    it. The place of the camera has no part in it. Raises `BadPose` where more than a scale is left.
    """
    matrix, scale = matrix.copy(), float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    if scale > 0 and abs(scale - 1) > _SCALED:
        matrix[:3, :3] /= scale
    return to_rigid(matrix @ OPENGL_FROM_OPENCV, file, label, remedy=_UNSCALE)


def axis_rotation(axis: int, degrees: float) -> np.ndarray:
    """The rotation [3, 3] about the axis x, y or z (0, 1, 2), to the right as seen along it."""
    one, other = [(1, 2), (2, 0), (0, 1)][axis]
    turn, angle = np.eye(3), np.radians(degrees)
    turn[one, one] = turn[other, other] = np.cos(angle)
    turn[other, one], turn[one, other] = np.sin(angle), -np.sin(angle)
    return turn


def parse_vector(value: object, count: int, file: Path, label: str) -> np.ndarray:
    """So many finite numbers, [count] float64. Raises `CaptureError` for anything else."""
    try:
        vector = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        vector = np.zeros(0)
    if vector.shape != (count,) or not np.isfinite(vector).all():
        raise CaptureError(f"{file}: {label} needs {count} finite numbers. Export the file again.")
    return vector


def parse_number(source: JsonObject, key: str, file: Path) -> float | None:
    """A finite number by key, or None where it is absent. Raises `CaptureError` for anything else."""
    value = source.get(key)
    if value is None:
        return None
    if isinstance(value, str):
        with suppress(ValueError):
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _finite(value):
        raise CaptureError(f"{file}: {key!r} must be a finite number, not {str(value)[:40]!r}.")
    return float(value)


def _finite(value: int | float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond any float
        return False


def parse_intrinsics(frame: JsonObject, common: JsonObject, image: Path, file: Path) -> Intrinsics:
    """Intrinsics of a frame, its own keys before the common ones (fl_x, fl_y, cx, cy, w, h, k1...p2, or those of
    `lens_keys`).

    Focal lengths may be given as camera_angle_x, y (radians). Where w and h are absent the image's own
    size is taken, or the multiple of it that cx and cy are the middle of: the file may be of the photographs before
    they were shrunk. Raises `CaptureError` for missing focal lengths and for lenses that are not understood.
    """
    model = _model(with_nested_model(common) | with_nested_model(frame), file)
    named = named_model(frame) or named_model(common)
    own, shared = (with_known_keys(each, model in _FISHEYE, file, named) for each in (frame, common))
    replaced = FOCAL if not FOCAL.isdisjoint(own) else frozenset()  # a frame's angle says more than a common fl_x
    values = {**{key: value for key, value in shared.items() if key not in replaced}, **own}
    check_has_coefficients(named, values, file)

    def get(key: str, default: float | None = None) -> float | None:
        value = parse_number(values, key, file)
        return default if value is None else value

    width, height = get("w"), get("h")
    if width is None or height is None:
        header = read_header(image)
        width, height = header.width, header.height
        if (cx := get("cx")) and (cy := get("cy")):
            width, height = told_size((header.width, header.height), (cx, cy), file, image.name, _WRITE_SIZE)
    fx, fy = _focals(get, (width, height), file, image.name)
    # A corner is no principal point: programs that know none write 0.
    head = (fx, fy, get("cx", width / 2) or width / 2, get("cy", height / 2) or height / 2)
    if not FOCAL.isdisjoint(shared):
        check_own_matrix(frame, own, (width, height), file)
    model, tail = _lens(model, _distortion(values, file), values.get(RATIONAL) or (0.0, 0.0, 0.0), file)
    if not (0 < width < 1e6 and 0 < height < 1e6):
        raise CaptureError(f"{file}: {image.name} has an image size of {width}x{height}. Mend w and h.")
    return check_intrinsics(Intrinsics(model, (*head, *tail), int(width), int(height)), file, image.name)


def _focals(
    get: Callable[[str], float | None], size: tuple[float, float], file: Path, label: str
) -> tuple[float, float]:
    """Focal lengths in pixels along x and y, each the other's where only one is given. Raises CaptureError."""
    angles = {key: get(key) for key in ("camera_angle_x", "camera_angle_y")}
    across, down = (_focal(side, angle) for side, angle in zip(size, angles.values(), strict=True))
    fl_x, fl_y = get("fl_x"), get("fl_y")
    fx = across if fl_x is None else fl_x
    fy = fl_y if fl_y is not None else fx if fl_x is not None else down
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        given = " and ".join(f"{key} {angle:g}" for key, angle in angles.items() if angle is not None)
        wrong = f": {given} must be radians, below pi" if given else ""
        raise CaptureError(f"{file}: no focal length for {label} (fl_x or camera_angle_x{wrong}).")
    return fx, fy


_WRITE_SIZE = "Write w and h into the file, or give the photographs of that size."
#: Camera models that bend by radial and tangential polynomials, if at all, and fisheyes that k1...k4 describe.
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"}
_FISHEYE = {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE"}
#: Keys by which instant-ngp names lenses that are no camera model here.
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular")


def _distortion(values: JsonObject, file: Path) -> dict[str, float]:
    """k1 ... p2, zero where absent."""
    for key in OTHER_PARAMETERS:
        value = values.get(key)
        if any(each not in (None, 0) for each in (value if isinstance(value, list) else [value])):
            raise CaptureError(f"{file}: the lens parameter {key} is not supported; undistort the images first.")
    return {key: parse_number(values, key, file) or 0.0 for key in LENS}


def _focal(side: float, angle: float | None) -> float | None:
    """Focal length in pixels from the field of view (radians) across a side."""
    return side / 2 / math.tan(angle / 2) if angle is not None and 0 < angle < math.pi else None


def _model(values: JsonObject, file: Path) -> str:
    """The camera model in capitals, with what a distortion model says: ROS and Kalibr call a fisheye a pinhole whose
    distortion is equidistant."""
    model = _camera_model(values, file)
    if model not in _PERSPECTIVE | _FISHEYE:
        raise CaptureError(
            f"{file}: the camera model {model!r} is not supported; undistort the images to PINHOLE first (fisheyes of "
            f"other models than OPENCV_FISHEYE: colmap image_undistorter).{say_of_panoramas(model)}"
        )
    bent = model_of_distortion(values, file)
    if bent is None or (bent == "OPENCV" and model not in _FISHEYE) or (bent != "OPENCV" and model in _FISHEYE):
        return model
    named = str(values.get("camera_model") or "").upper()
    if bent == "OPENCV_FISHEYE" and named in ("", "PINHOLE", "PERSPECTIVE"):
        return bent
    raise CaptureError(f"{file}: the distortion model contradicts the camera model {model}. Remove the wrong one.")


def _camera_model(values: JsonObject, file: Path) -> str:
    """The camera model in capitals: nerfstudio's `camera_model`, or what instant-ngp says by keys of its own."""
    model = str(values.get("camera_model") or "OPENCV").upper()
    for key in _OTHER_LENSES:
        if values.get(key) is not None and values[key] is not False:
            raise CaptureError(
                f"{file}: the lens that {key!r} describes is not supported; undistort to PINHOLE first."
                f"{say_of_panoramas(key)}"
            )
    if not values.get("is_fisheye") or model in _FISHEYE:
        return model
    if values.get("camera_model"):
        raise CaptureError(
            f"{file}: is_fisheye contradicts the camera model {model}. Remove is_fisheye, or write OPENCV_FISHEYE."
        )
    return "OPENCV_FISHEYE"


def _lens(model: str, k: dict[str, float], divisor: tuple[float, ...], file: Path) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model and its distortion parameters for nerfstudio's keys."""
    if model in _FISHEYE:
        if k["p1"] or k["p2"]:
            raise CaptureError(f"{file}: the lens parameters p1, p2 of a fisheye are not supported; undistort first.")
        return "OPENCV_FISHEYE", (k["k1"], k["k2"], k["k3"], k["k4"])
    if any(divisor):
        return "FULL_OPENCV", (k["k1"], k["k2"], k["p1"], k["p2"], k["k3"], *divisor)
    if not any(k.values()):
        return "PINHOLE", ()
    if k["k4"]:  # of r^8, as nerfstudio and Metashape, whose k4 its converter writes, have it
        return BROWN, (k["k1"], k["k2"], k["p1"], k["p2"], k["k3"], k["k4"], 0.0)
    if k["k3"]:
        return "FULL_OPENCV", (k["k1"], k["k2"], k["p1"], k["p2"], k["k3"], 0.0, 0.0, 0.0)
    return "OPENCV", (k["k1"], k["k2"], k["p1"], k["p2"])
