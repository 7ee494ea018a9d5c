"""Lenses of transforms.json under the keys of other programs (ROS, OpenCV, Kalibr, ...), as nerfstudio's keys.

What is not ambiguous is read; lens distortion that cannot be read is refused by its key, for the capture would be taken
for one of a pinhole. Coefficients that are all zero are no distortion.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from vdgs.captures.formats.source_capture import CENTERED
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

#: Keys of nerfstudio's that say how a lens bends, in the order of its list `distortion_params`.
LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Of OpenCV's rational lens: the factors k4, k5, k6 of r², r⁴, r⁶ in the divisor. No file has this key.
RATIONAL = "k4, k5, k6 of the divisor"
#: Ways to say a focal length, one of which is enough.
FOCAL = frozenset({"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"})
#: Names in `distortion_model` of OpenCV's polynomial and of its fisheye; lenses of the third kind are the first where
#: their coefficients are zero.
_POLYNOMIAL = {
    "plumb_bob", "radtan", "radtan8", "radial_tangential", "brown", "brown_conrady", "rational_polynomial", "opencv",
    "full_opencv", "pinhole", "simple_pinhole", "perspective", "simple_radial", "radial", "brown5", "opencv5",
}  # fmt: skip
_FISHEYE = {"equidistant", "equi", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kb4"}
_POLYNOMIAL_IF_ZERO = {"inverse_brown_conrady", "modified_brown_conrady"}
_NO_MODEL = {"", "none", "no", "false", "null", "undistorted", "rectified", "ideal", "linear"}
#: Keys of such names; the model of a lens may be that of a shop.
_MODEL_KEYS, _LOOSE_MODEL_KEYS = ("distortion_model", "distortion_type", "distortion"), ("lens_model", "model")
#: Of which kind keys are, without case, underscores, spaces and hyphens: coefficients in OpenCV's order, matrices of
#: focal lengths and principal point (or these four), objects that hold the keys of a lens, ...
_Kind = Literal["list", "radial", "tangential", "matrix", "object", "same", "size", "term", "bends"]
_KINDS: dict[_Kind, set[str]] = {
    "list": {
        "distortion", "distortions", "distortioncoefficients", "distortioncoeffs", "distortioncoefs", "distcoeffs",
        "distcoefs", "distcoefficients", "distortionparameters", "distortionvector", "lensdistortion", "dist",
        "distparams",
    },
    "radial": {"radial", "radialdistortion", "radialcoeffs", "radialcoefficients"},
    "tangential": {"tangential", "tangentialdistortion", "tangentialcoeffs", "tangentialcoefficients"},
    "matrix": {
        "k", "intrinsics", "intrinsic", "cameramatrix", "cameraintrinsics", "intrinsicmatrix", "intrinsicsmatrix",
        "intrinsicparameters", "kmatrix",
    },
    "object": {"camera", "camerainfo", "calibration", "lens", "lensparameters", "cameraparameters", "cameraparams"},
    "same": {"fx", "fy", "focalx", "focaly", "flx", "fly", "cx", "cy", "ppx", "ppy"},
    "size": {"w", "h", "width", "height", "imagewidth", "imageheight"},
}  # fmt: skip
_SAME = {"f": "fl_", "c": "c", "p": "c"}
#: instant-ngp's angles of view, in degrees, which count more than focal lengths there.
_DEGREES = {"x_fov": "camera_angle_x", "y_fov": "camera_angle_y"}
#: Names of distortion that are not known, and names of what else may be a part of a lens.
_BENDS = re.compile(r"(?<!un)distort|dist_?coef|radial|tangential|thin_?prism|fisheye|^xi$|omnidir", re.IGNORECASE)
#: What else is said of distortion, or of a lens that bends: no coefficients.
_ABOUT = re.compile(r"score|error|rms|appl|enabled|correct|fov|field_?of_?view|version|count|num_", re.IGNORECASE)
_OF_A_LENS = re.compile(
    r"^(cameras|lens(es)?|focals?)$|intrins|calib|camera_?(mat|info|param)|lens_?param|fov|field_?of_?view|focal_?len",
    re.IGNORECASE,
)
#: Known keys, which are looked at elsewhere.
_KNOWN = {*LENS, "distortion_params", "is_fisheye", "camera_model", "frames", "transform_matrix", *_MODEL_KEYS[:2]}
#: Keys that nerfstudio's lens has not, which are looked at in `json_poses` as the others are.
OTHER_PARAMETERS = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "skew", "rolling_shutter")
_NESTED = (*LENS, *OTHER_PARAMETERS)
#: Numbers that differ by so much (share) are one, written with fewer digits (choice).
_ROUNDED = 1e-4
_REMEDY = "Write k1, k2, p1, p2 (and k3) of OpenCV's lens, or undistort the images first."
#: By its length, where fx, fy, cx, cy are in a matrix row by row, and where its ones are.
_PLACES = {4: (0, 1, 2, 3), 9: (0, 4, 2, 5), 12: (0, 5, 2, 6), 16: (0, 5, 2, 6)}
_ONES: dict[int, tuple[int, ...]] = {4: (), 9: (8,), 12: (10,), 16: (10, 15)}


def with_nested_model(values: Mapping[str, Any]) -> JsonObject:
    """The values, with a camera model that only an object in them has, and that is no name of a shop: with blanks."""
    inner = [
        {key: each[key] for key in ("camera_model", "is_fisheye") if key in each and " " not in str(each[key]).strip()}
        for each in _objects(values)
    ]
    return {key: value for each in [*inner, values] for key, value in each.items() if value is not None}


def model_of_distortion(values: Mapping[str, Any], file: Path) -> Literal["OPENCV", "OPENCV_FISHEYE"] | None:
    """The camera model that the name of a distortion model means; None without one. Raises `CaptureError` for that of
    another lens."""
    objects = (values, *_objects(values))
    for inner in objects:
        for key in (*_MODEL_KEYS, *_LOOSE_MODEL_KEYS):
            said = inner.get(key)
            if not isinstance(said, str) or (key == "model" and inner is values):
                continue
            name = re.sub(r"[\s-]+", "_", said.strip().lower()).removeprefix("distortion.")
            if name in _FISHEYE:
                return "OPENCV_FISHEYE"
            if name in _POLYNOMIAL or (name in _POLYNOMIAL_IF_ZERO and not any(map(_bends, objects))):
                return "OPENCV"
            if key in _MODEL_KEYS and name not in _NO_MODEL:
                raise CaptureError(f"{file}: the lens of {key} {said!r} is not supported; undistort the images first.")
    return None


def with_known_keys(values: Mapping[str, Any], fisheye: bool, file: Path) -> JsonObject:
    """What a frame, or the file for all frames, says of its lens, by nerfstudio's keys and `RATIONAL`; other keys as
    they are. Lists of coefficients are in the order of OpenCV's fisheye, or else of its polynomial.

    Raises `CaptureError` naming the key of a distortion that cannot be read, or that contradicts another.
    """
    found: JsonObject = {key: value for key, value in values.items() if value is not None}
    given = found.get("distortion_params")
    if given is not None:
        if not isinstance(given, list) or len(given) != len(LENS):
            raise CaptureError(f"{file}: distortion_params must be a list of {', '.join(LENS)}. Export the file again.")
        found |= dict(zip(LENS, given, strict=True)) | {RATIONAL: (0.0, 0.0, 0.0)}
    has_focal = not FOCAL.isdisjoint(found)
    for inner in (values, *_objects(values)):
        kinds = {key: kind for key, value in inner.items() if value is not None and (kind := _kind(key)) is not None}
        focals = [inner[key] for key, kind in kinds.items() if kind == "matrix" or _plain(key) in ("fx", "focalx")]
        # Beside a known focal length the others may be of the photograph before it was shrunk, and so its size.
        has_size = bool(focals) and (not has_focal or any(_starts_with(each, found.get("fl_x")) for each in focals))
        for key, kind in kinds.items():
            if (kind != "size" or has_size) and not (has_focal and kind == "same" and "f" in _plain(key)):
                _read_key(found, key, kind, inner[key], fisheye, file)
        for key in () if inner is values else [each for each in _NESTED if each in inner]:
            _add_terms(found, {key: inner[key]}, key, file)
        if all(any(_numbers(inner.get(key)) or ()) for key in ("alpha", "beta")):
            raise CaptureError(
                f"{file}: the lens parameters alpha, beta are not supported; undistort the images first."
            )
    for key, name in _DEGREES.items():
        angle = _numbers(found.get(key))
        if angle is not None and len(angle) == 1:
            found.pop("fl_" + name[-1], None)
            found[name] = math.radians(angle[0])
    return found


def check_own_matrix(frame: Mapping[str, Any], own: Mapping[str, Any], size: tuple[float, float], file: Path) -> None:
    """Raise `CaptureError` for a matrix of one frame (`own`: its known keys) that is of another size than the file says
    of all frames."""
    key = next((key for key in frame if _kind(key) == "matrix"), None)
    if key is None or "w" in own or not FOCAL.isdisjoint(frame):
        return
    (low, high), center = CENTERED, [own.get("cx"), own.get("cy")]
    if not all((c := _numbers(each)) and low < c[0] / side < high for each, side in zip(center, size, strict=True)):
        raise CaptureError(
            f"{file}: {key!r} of a frame has its principal point at {center[0]}, {center[1]}, and w and h are "
            f"{size[0]:g}x{size[1]:g}: it is of another size. Write w and h of the frame beside it, or remove it."
        )


def unread_keys(common: Mapping[str, Any], frames: Sequence[JsonObject]) -> list[str]:
    """What to say of keys that may be of a lens and are not read: lists and objects of the file, and what differs
    between frames that have no focal length of their own."""
    keys = [key for key, value in common.items() if isinstance(value, dict | list) and _may_say_more(key, value)]
    others = [frame for frame in frames if FOCAL.isdisjoint(frame)]
    own = dict.fromkeys(key for frame in others for key, value in frame.items() if _may_say_more(key, value))
    keys += [key for key in own if len({str(frame.get(key)) for frame in others}) > 1]
    return [f"{', '.join(map(repr, keys))}: not read, though the name is that of a part of a lens."] if keys else []


def _may_say_more(key: str, value: object) -> bool:
    known = key in _KNOWN or key in FOCAL or key in _DEGREES or _kind(key) is not None
    return not known and _is_of_a_lens(key) and any(_numbers(value, deep=True) or ())


def _read_key(found: JsonObject, key: str, kind: _Kind, value: Any, fisheye: bool, file: Path) -> None:
    """Add what one key of another program says of the lens to what is `found`."""
    numbers = _numbers(value)
    listed = numbers if isinstance(value, list | dict) else None
    if key.lower() == "dist" and numbers is not None and len(numbers) < 4:
        pass  # any distances
    elif kind == "list" and listed is not None:
        _add_terms(found, _terms(key, listed, fisheye, file), key, file)
    elif kind == "list" and isinstance(value, dict | str):
        pass  # the object is gone through, the text is the name of a model
    elif kind == "radial" and listed is not None and len(listed) <= (4 if fisheye else 3):
        _add_terms(found, dict(zip(LENS, listed, strict=False)), key, file)
    elif kind == "tangential" and listed is not None and len(listed) == 2:
        _add_terms(found, dict(zip(("p1", "p2"), listed, strict=True)), key, file)
    elif kind in ("radial", "tangential", "list", "bends"):
        if any(_numbers(value, deep=True) or ()) or (value is True and "fisheye" in key.lower()):
            raise CaptureError(f"{file}: the lens distortion under {key!r} cannot be read. {_REMEDY}")
    elif kind == "matrix" and listed is not None:
        _add_matrix(found, key, listed, file)
    elif kind == "same":
        name = _plain(key)
        found.setdefault(_SAME[name[0]] + name[-1], value)
    elif kind == "size" and numbers is not None and all(each >= 1 for each in numbers):
        found.setdefault(_plain(key).removeprefix("image")[0], value)
    elif kind == "term":
        _add_terms(found, {key.lower(): value}, key, file)


def _terms(key: str, numbers: list[float], fisheye: bool, file: Path) -> JsonObject:
    """Coefficients of a list in OpenCV's order. Raises `CaptureError` where their number does not say what they are."""
    terms: JsonObject = dict.fromkeys(LENS, 0.0) | {RATIONAL: (0.0, 0.0, 0.0)}
    if not any(numbers):
        return terms
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    counts = (4,) if fisheye else (1, 2, 4, 5, 8)
    count = next((count for count in counts if count >= len(numbers)), counts[-1])
    if len(numbers) != count and (len(numbers) < count or any(numbers[count:])):
        order = "k1, k2, k3, k4" if fisheye else "k1, k2, p1, p2, and k3, k4, k5, k6 where there are more"
        raise CaptureError(
            f"{file}: the lens distortion under {key!r} cannot be read: {len(numbers)} numbers, and OpenCV's are "
            f"{order}. {_REMEDY}"
        )
    terms |= dict(zip(names, numbers, strict=False))
    return terms | ({RATIONAL: tuple(numbers[5:8])} if count == 8 else {})


def _add_terms(found: JsonObject, terms: JsonObject, key: str, file: Path) -> None:
    """Raises `CaptureError` where other keys say that the lens bends otherwise."""
    bends = any(any(_numbers(value) or ()) for value in terms.values())
    for name, value in terms.items():
        there = found.get(name)
        if there is not None and bends and not _agree(there, value):
            raise CaptureError(
                f"{file}: the lens distortion under {key!r} contradicts {name} {there}. Leave one of them in the file."
            )
        found.setdefault(name, value)


def _agree(there: object, value: object) -> bool:
    """Whether two values are the same but for how they are rounded."""
    ones, others = _numbers(there) or [], _numbers(value) or []
    return len(ones) == len(others) and all(map(_almost_equal, ones, others))


def _starts_with(value: object, number: object) -> bool:
    """Whether a focal length, or the first number of a matrix, is a number."""
    found, known = _numbers(value), _numbers(number)
    return bool(found and known and _agree(found[:1], known))


def _almost_equal(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=_ROUNDED, abs_tol=_ROUNDED**2)


def _add_matrix(found: JsonObject, key: str, numbers: list[float], file: Path) -> None:
    """Focal lengths and principal point of a matrix [3, 3], [3, 4] or [4, 4], or of fx, fy, cx, cy; known keys beside
    it count more. Larger matrices of another kind are poses. Raises `CaptureError` for another small one."""
    has_focal = not FOCAL.isdisjoint(found)
    places = _PLACES.get(len(numbers))
    if len(numbers) == 9 and not numbers[2] and not numbers[5]:  # column by column, as Apple's
        numbers = [numbers[3 * row + column] for column in range(3) for row in range(3)]
    rest = {place: value for place, value in enumerate(numbers) if places is not None and place not in places}
    if places is None or any(value != float(place in _ONES[len(numbers)]) for place, value in rest.items()):
        if has_focal or len(numbers) in (12, 16):
            return
        raise CaptureError(
            f"{file}: {key!r} is neither fx, fy, cx, cy nor the matrix fx 0 cx, 0 fy cy, 0 0 1 (a skew is not "
            "supported). Write fl_x, fl_y, cx, cy, and undistort the images first where there is a skew."
        )
    fx, fy, cx, cy = (numbers[place] for place in places)
    if not has_focal:
        found.update(fl_x=fx, fl_y=fy)
    elif not _is_of_size(found, (cx, cy)):
        return
    found.setdefault("cx", cx)
    found.setdefault("cy", cy)


def _is_of_size(found: Mapping[str, Any], center: tuple[float, float]) -> bool:
    """Whether a principal point may be of an image of the known size; yes where none is known."""
    (low, high), sides = CENTERED, [_numbers(found.get(key)) for key in ("w", "h")]
    return all(not side or low < c / max(side[0], 1) < high for c, side in zip(center, sides, strict=True))


def _bends(values: Mapping[str, Any]) -> bool:
    return any(
        any(_numbers(value) or ()) for key, value in values.items()
        if _kind(key) in ("list", "radial", "tangential", "term") or key in LENS
    )  # fmt: skip


def _objects(values: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The objects in an object that hold keys of its lens, and those in them."""
    for key, value in values.items():
        if isinstance(value, dict) and _kind(key) in ("list", "matrix", "object") and _numbers(value) is None:
            yield value
            yield from _objects(value)


@lru_cache(maxsize=1024)
def _kind(key: str) -> _Kind | None:
    """Of what kind a key of a lens is that is not looked at elsewhere; None for all else."""
    if key in _KNOWN:
        return None
    if key == "D":
        return "list"
    if key.lower() in LENS:  # in capitals
        return "term"
    kind = next((kind for kind, names in _KINDS.items() if _plain(key) in names), None)
    return kind or ("bends" if _BENDS.search(key) and not _ABOUT.search(key) else None)


@lru_cache(maxsize=1024)
def _is_of_a_lens(key: str) -> bool:
    return _OF_A_LENS.search(key) is not None


@lru_cache(maxsize=1024)
def _plain(key: str) -> str:
    return re.sub(r"[\s_-]", "", key).lower()


def _numbers(value: object, *, deep: bool = False) -> list[float] | None:
    """The numbers of a number, of lists in lists, and of a matrix of OpenCV's ({"data": [...]}), or `deep` of all that
    an object holds; None for all else."""
    if isinstance(value, dict):
        if deep:
            return [each for inner in value.values() for each in (_numbers(inner, deep=True) or ())]
        return _numbers(value["data"]) if isinstance(value.get("data"), list) else None
    if isinstance(value, list | tuple):
        parts = [_numbers(each, deep=deep) for each in value]
        if not deep and any(part is None for part in parts):
            return None
        return [each for part in parts for each in part or ()]
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return [number] if math.isfinite(number) else None
