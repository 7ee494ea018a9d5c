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
_FISHEYE = {
    "equidistant", "equi", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kb4", "simple_fisheye",
    "simple_radial_fisheye", "radial_fisheye",
}  # fmt: skip
_POLYNOMIAL_IF_ZERO = {"inverse_brown_conrady", "modified_brown_conrady"}
_NO_MODEL = {"", "none", "no", "false", "null", "undistorted", "rectified", "ideal", "linear"}
#: Keys of such names; the model of a lens may be that of a shop.
_MODEL_KEYS, _LOOSE_MODEL_KEYS = ("distortion_model", "distortion_type", "distortion"), ("lens_model", "model")
#: Of which kind keys are, without case, underscores, spaces and hyphens: coefficients in OpenCV's order, matrices of
#: focal lengths and principal point (or these four), objects that hold the keys of a lens, ...
_Kind = Literal["list", "radial", "tangential", "matrix", "params", "object", "same", "size", "term", "bends"]
_KINDS: dict[_Kind, set[str]] = {
    "list": {
        "distortion", "distortions", "distortioncoefficients", "distortioncoeffs", "distortioncoefs", "distcoeffs",
        "distcoefs", "distcoefficients", "distortionparameters", "distortionvector", "lensdistortion", "dist",
        "distparams", "coeffs", "coefs", "coefficients", "cameracoeffs", "lenscoeffs", "kappa", "kappas",
    },
    "radial": {"radial", "radialdistortion", "radialcoeffs", "radialcoefficients"},
    "tangential": {"tangential", "tangentialdistortion", "tangentialcoeffs", "tangentialcoefficients"},
    "matrix": {
        "k", "intrinsics", "intrinsic", "cameramatrix", "cameraintrinsics", "intrinsicmatrix", "intrinsicsmatrix",
        "intrinsicparameters", "kmatrix",
    },
    "params": {
        "params", "colmapparams", "modelparams", "cameramodelparams", "cameraparams", "cameraparameters", "lensparams",
        "lensparameters",
    },
    "object": {"camera", "camerainfo", "calibration", "lens"},
    "same": {"fx", "fy", "focalx", "focaly", "flx", "fly", "cx", "cy", "ppx", "ppy"},
    "size": {"w", "h", "width", "height", "imagewidth", "imageheight"},
}  # fmt: skip
_SAME = {"f": "fl_", "c": "c", "p": "c"}
#: The parameters of COLMAP's models in its order, by nerfstudio's keys (f: both focal lengths); COLMAP's one k is k1.
_COLMAP: dict[str, tuple[str, ...]] = {
    name: tuple(keys.split())
    for name, keys in {
        "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fl_x fl_y cx cy", "SIMPLE_RADIAL": "f cx cy k1",
        "RADIAL": "f cx cy k1 k2", "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2", "SIMPLE_FISHEYE": "f cx cy",
        "FISHEYE": "fl_x fl_y cx cy", "SIMPLE_RADIAL_FISHEYE": "f cx cy k1", "RADIAL_FISHEYE": "f cx cy k1 k2",
        "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    }.items()
}  # fmt: skip
#: Of these, lenses that bend: programs write OPENCV of pinholes too, and the others have no coefficients.
_BENT = {"SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
#: Keys that are said of other things too: distances to the scene, angles of a pose, numbers of any function.
_DISTANCES, _ANGLES, _ANY_COEFFICIENTS, _MOST_COEFFICIENTS = "dist", "kappa", {"coeffs", "coefs", "coefficients"}, 14
#: Numbers from this on are pixels, and below coefficients (choice): lenses have focal lengths of more pixels.
_LEAST_PX = 10.0
#: instant-ngp's angles of view, in degrees, which count more than focal lengths there.
_DEGREES = {"x_fov": "camera_angle_x", "y_fov": "camera_angle_y"}
#: Names of distortion that are not known, and names of what else may be a part of a lens.
_BENDS = re.compile(
    r"(?<!un)distort|dist_?coef|radial|tangential|thin_?prism|fisheye|^xi$|omnidir|_k[1-6]$", re.IGNORECASE
)
#: What stands before the name of a coefficient (`lens_k1`).
_PREFIX = re.compile(r"^(lens|camera|cam|opencv|radial|tangential|distortion|dist|coeff?s?)(?=[kp]\d$)")
#: What else is said of distortion, or of a lens that bends: no coefficients.
_ABOUT = re.compile(r"score|error|rms|appl|enabled|correct|fov|field_?of_?view|version|count|num_", re.IGNORECASE)
_OF_A_LENS = re.compile(
    r"^(cameras|lens(es)?|focals?)$|intrins|calib|camera_?(mat|info|param)|lens_?param|fov|field_?of_?view|focal_?len",
    re.IGNORECASE,
)
#: Known keys, which are looked at elsewhere.
_KNOWN = {*LENS, "distortion_params", "is_fisheye", "camera_model", "frames", "transform_matrix", *_MODEL_KEYS[:2]}
#: Keys that nerfstudio's lens has not, which are looked at in `json_poses` as the others are.
OTHER_PARAMETERS = ("k5", "k6", "p3", "p4", "s1", "s2", "s3", "s4", "b1", "b2", "skew", "rolling_shutter")
_NESTED, _TERMS = (*LENS, *OTHER_PARAMETERS), {*LENS, "k5", "k6", "p3", "p4"}
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
            if (key in _MODEL_KEYS and name not in _NO_MODEL) or name in _POLYNOMIAL_IF_ZERO:
                raise CaptureError(f"{file}: the lens of {key} {said!r} is not supported; undistort the images first.")
    return None


def named_model(values: Mapping[str, Any]) -> str:
    """The camera model of COLMAP's, in capitals, that a frame or the file names; empty where none is."""
    said = [values.get("camera_model")]
    said += [inner.get(key) for inner in _objects(values) for key in ("camera_model", *_LOOSE_MODEL_KEYS)]
    return next((name for each in said if (name := str(each or "").strip().upper()) in _COLMAP), "")


def check_has_coefficients(model: str, values: Mapping[str, Any], file: Path) -> None:
    """Raise `CaptureError` where the named model is that of a lens that bends, and no coefficient was read, not even
    zero."""
    if model in _BENT and all(values.get(key) is None for key in LENS):
        raise CaptureError(
            f"{file}: the camera model {model} bends, and no key is known to hold its coefficients. {_REMEDY} Write "
            "camera_model PINHOLE where they are undistorted."
        )


def with_known_keys(values: Mapping[str, Any], fisheye: bool, file: Path, model: str = "") -> JsonObject:
    """What a frame, or the file for all frames, says of its lens, by nerfstudio's keys and `RATIONAL`; other keys as
    they are. Lists of coefficients are in the order of OpenCV's fisheye, or else of its polynomial, and parameters of a
    `model` of COLMAP's that is named in its order.

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
        focals = [
            inner[key] for key, kind in kinds.items() if kind in ("matrix", "params") or _plain(key) in ("fx", "focalx")
        ]
        # Beside a known focal length the others may be of the photograph before it was shrunk, and so its size.
        has_size = bool(focals) and (not has_focal or any(_starts_with(each, found.get("fl_x")) for each in focals))
        for key, kind in kinds.items():
            if (kind != "size" or has_size) and not (has_focal and kind == "same" and "f" in _plain(key)):
                _read_key(found, key, kind, inner[key], fisheye, model, file)
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
    if key is None or "w" in own or "fl_x" not in own or not FOCAL.isdisjoint(frame):
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


def _read_key(
    found: JsonObject, key: str, kind: _Kind, value: Any, fisheye: bool, model: str, file: Path
) -> None:  # fmt: skip
    """Add what one key of another program says of the lens to what is `found`."""
    numbers = _numbers(value)
    listed = numbers if isinstance(value, list | dict) else None
    if _is_of_something_else(key, numbers, listed is not None):
        pass
    elif kind == "params" or (kind == "matrix" and listed is not None and _are_parameters(listed, model, fisheye)):
        _add_params(found, key, listed or [], model, fisheye, file)
    elif _plain(key) == "k" and numbers is not None and _are_coefficients(key, numbers, file):
        _add_terms(found, _terms(key, numbers, fisheye, file), key, file)
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
        _add_terms(found, {_term(key): value}, key, file)


def _is_of_something_else(key: str, numbers: list[float] | None, is_list: bool) -> bool:
    """Whether a key that may be of a lens says something else: near and far distances, the angle kappa of a pose, a
    count or the number of a frame, how many coefficients there are, or more of them than a lens has."""
    name, numbers = _plain(key), numbers or []
    if name == "k" and not is_list and numbers and numbers[0].is_integer() and numbers[0]:
        return True  # no lens has a whole number for k1
    if name == _DISTANCES:
        small = is_list and 0 < max(numbers, default=0.0) < 1
        return len(numbers) < 4 and all(each >= 0 for each in numbers) and not small
    is_any = name in _ANY_COEFFICIENTS and len(numbers) > _MOST_COEFFICIENTS
    return is_any or (not is_list and name in (_ANGLES, *_ANY_COEFFICIENTS))


def _are_coefficients(key: str, numbers: list[float], file: Path) -> bool:
    """Whether numbers under k, or K, are coefficients: not a matrix row by row, nor fx, fy, cx, cy. Raises
    `CaptureError` where they may be either."""
    if len(numbers) in _PLACES and len(numbers) != 4:
        return False
    if len(numbers) == 4 and all(each >= _LEAST_PX for each in numbers[:2]):
        return False
    (low, high), shares = CENTERED, numbers[2:]
    if any(abs(each) >= _LEAST_PX for each in numbers) or (shares and all(low < each < high for each in shares)):
        raise CaptureError(
            f"{file}: {key!r} may be coefficients, or focal lengths and a principal point. Write fl_x, fl_y, cx, cy in "
            "pixels, and k1, k2, p1, p2."
        )
    return True


def _are_parameters(numbers: list[float], model: str, fisheye: bool) -> bool:
    """Whether numbers under the name of a matrix are the parameters of a camera model: as many as the named one has, or
    as OpenCV's have."""
    if len(numbers) == 4:  # else fx, fy, cx, cy
        return model in _BENT and abs(numbers[3]) < 1
    return len(numbers) == len(_parameters(model, fisheye)) and numbers[0] >= _LEAST_PX


def _parameters(model: str, fisheye: bool) -> tuple[str, ...]:
    return _COLMAP[model or ("OPENCV_FISHEYE" if fisheye else "OPENCV")]


def _add_params(
    found: JsonObject, key: str, numbers: list[float], model: str, fisheye: bool, file: Path
) -> None:  # fmt: skip
    """Focal lengths, principal point and coefficients of a list in COLMAP's order; known keys beside it count more.
    Raises `CaptureError` for a list of a lens that is not as long as the model's."""
    names, focal = _parameters(model, fisheye), found.get("fl_x")
    if not any(numbers):
        return
    is_of_a_lens = numbers[0] >= _LEAST_PX if focal is None else _starts_with(numbers, focal)
    if _plain(key) == "params" and not model and not is_of_a_lens:
        return
    if len(numbers) != len(names):
        order = f"{model} has {len(names)}" if model else "no camera_model says which"
        raise CaptureError(f"{file}: {key!r} holds {len(numbers)} parameters of a lens, and {order}. {_REMEDY}")
    values = dict(zip(names, numbers, strict=True))
    if FOCAL.isdisjoint(found):
        found.update(fl_x=values.get("f", values.get("fl_x")), fl_y=values.get("f", values.get("fl_y")))
        found |= {name: found.get(name, values[name]) for name in ("cx", "cy")}
    elif _is_of_size(found, (values["cx"], values["cy"])):
        found |= {name: found.get(name, values[name]) for name in ("cx", "cy")}
    terms: JsonObject = {name: values[name] for name in LENS if name in values}
    _add_terms(found, terms and dict.fromkeys(LENS, 0.0) | terms, key, file)


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
        if 4 < len(numbers) < 9 and _starts_with(numbers, found.get("fl_x")) and found.keys().isdisjoint(LENS):
            raise CaptureError(f"{file}: {key!r} may hold lens distortion, which cannot be read. {_REMEDY}")
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
        kinds = ("list", "matrix", "object", "params")
        if isinstance(value, dict) and _kind(key) in kinds and _numbers(value) is None:
            yield value
            yield from _objects(value)


@lru_cache(maxsize=1024)
def _kind(key: str) -> _Kind | None:
    """Of what kind a key of a lens is that is not looked at elsewhere; None for all else."""
    if key in _KNOWN:
        return None
    if key == "D":
        return "list"
    if _term(key) in _TERMS:  # in capitals, with blanks, or with what it is of before it
        return "term"
    kind = next((kind for kind, names in _KINDS.items() if _plain(key) in names), None)
    return kind or ("bends" if _BENDS.search(key) and not _ABOUT.search(key) else None)


@lru_cache(maxsize=1024)
def _is_of_a_lens(key: str) -> bool:
    return _OF_A_LENS.search(key) is not None


def _term(key: str) -> str:
    return _PREFIX.sub("", _plain(key))


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
