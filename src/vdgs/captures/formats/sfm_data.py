"""OpenMVG's sfm_data.json and AliceVision's (Meshroom's) .sfm: photographs, lenses, poses and tie points in JSON.

Both place a camera by its center and the rotation from the world to its axes right, down, forward; AliceVision writes
it column by column. Pixels count from the corner, AliceVision's principal point from the middle; its focal length is in
millimetres of the sensor, and in files before version 1.2.2 in pixels. The worlds have no scale and no place.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath

import numpy as np

from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.json_poses import parse_number, parse_vector, read_capture_json
from vdgs.captures.formats.photograph_sizes import name_unaligned
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import files_ending, holds, holds_match
from vdgs.captures.text_tables import decode_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

_OPENMVG = b'"sfm_data_version"'
_OPENMVG_POSES = re.compile(rb'"extrinsics"\s*:\s*\[\s*\{')
_AGAIN = "Export it again."
#: AliceVision's kinds of lenses, as its versions call them, by the terms of `_lens`.
_ALICEVISION = {
    "pinhole": "", "none": "", "radial1": "radial", "radialk1": "radial", "radial3": "radial", "radialk3": "radial",
    "brown": "brown", "fisheye4": "fisheye", "fisheye": "fisheye", "radialk3pt": "radial at one",
    "equidistant": "equidistant", "equidistant_r3": "equidistant", "equidistant radialk3pt": "equidistant",
}  # fmt: skip
#: How AliceVision writes that a photograph is of no rig.
_OF_NO_RIG = {"None", "-1", "4294967295"}
#: OpenMVG's, by the name of their parameters.
_PARAMETERS = {"disto_k1": "radial", "disto_k3": "radial", "disto_t2": "brown", "fisheye": "fisheye"}


def is_openmvg(file: Path) -> bool:
    return file.suffix.lower() == ".json" and _head(file, _OPENMVG)


def is_alicevision(file: Path) -> bool:
    return file.suffix.lower() in (".sfm", ".json") and _head(file, b'"version"', b'"viewId"')


def find_openmvg(root: Path) -> list[Path]:
    """The files of a folder that have poses; the one that lists the photographs has none, though places by GPS."""
    return [file for file in files_ending(root, ".json") if is_openmvg(file) and holds_match(file, _OPENMVG_POSES)]


def find_alicevision(root: Path) -> list[Path]:
    files = filter(is_alicevision, files_ending(root, ".sfm", ".json"))
    return [file for file in files if holds(file, b'"poses"', b'"center"')]


def read_openmvg(file: Path, options: CaptureOptions) -> Project:
    """Raises `CaptureError` for damaged files and those without poses."""
    content = read_capture_json(file)
    lenses = {str(entry["key"]): _openmvg_lens(entry, file) for entry in _entries(content, "intrinsics", "key", file)}
    poses = {
        str(entry["key"]): _pose(_dict(entry.get("value")), file, f"pose {entry['key']}", turned=False)
        for entry in _entries(content, "extrinsics", "key", file)
    }
    views = []
    for entry in _entries(content, "views", "key", file):
        view = _flat(entry.get("value"))
        name = PurePosixPath(str(view.get("local_path") or "")) / str(view.get("filename") or f"view {entry['key']}")
        views.append((str(entry["key"]), str(name), str(view.get("id_intrinsic")), poses.get(str(view.get("id_pose")))))
    landmarks = [_dict(entry.get("value")) for entry in _entries(content, "structure", "key", file)]
    seen = [
        (each.get("X"), None, [(str(one.get("key")), _dict(one.get("value"))) for one in _list(each, file)])
        for each in landmarks
    ]
    return _project("openmvg", file, lenses, views, _points(seen, file))


def read_alicevision(file: Path, options: CaptureOptions) -> Project:
    """Raises `CaptureError` for damaged files and those without poses."""
    content = read_capture_json(file)
    version = tuple(parse_vector(content.get("version"), 3, file, "'version'").astype(int).tolist())
    lenses = {
        str(entry["intrinsicId"]): _alicevision_lens(entry, version, file)
        for entry in _entries(content, "intrinsics", "intrinsicId", file)
    }
    pose_of = _alicevision_poses(content, file)
    views = [
        (str(entry["viewId"]), str(entry.get("path") or f"view {entry['viewId']}"), str(entry.get("intrinsicId")),
         pose_of(entry))
        for entry in _entries(content, "views", "viewId", file)
    ]  # fmt: skip
    seen = [
        (entry.get("X"), entry.get("color"), [(str(one.get("observationId")), one) for one in _list(entry, file)])
        for entry in _entries(content, "structure", "X", file)
    ]
    return _project("alicevision", file, lenses, views, _points(seen, file))


# ------------------------------------------------------------------------------------------------- parts

_View = tuple[str, str, str, np.ndarray | None]


class _TiePoints:
    """Points, colors, and by view the points that it shows."""

    def __init__(self) -> None:
        self.points, self.colors = array("d"), array("d")
        self.shown: dict[str, tuple[array[int], array[float]]] = {}


def _project(
    name: str, file: Path, lenses: dict[str, Intrinsics | str], views: list[_View], ties: _TiePoints
) -> Project:
    found, refused, unaligned = list[ProjectView](), dict[str, list[str]](), list[str]()
    for number, path, lens_number, pose in views:
        lens = lenses.get(lens_number, f"its lens {lens_number} is not in the file")
        if pose is None:
            unaligned.append(path)
        elif isinstance(lens, str):
            refused.setdefault(lens, []).append(path)
        else:
            points, pixels = ties.shown.get(number, (array("q"), array("d")))
            shown = (np.array(points, np.int64), np.array(pixels).reshape(-1, 2)) if len(points) else None
            found.append(ProjectView(names=(path,), camera_from_world=pose, intrinsics=lens, sightings=shown))
    return Project(
        format=name, file=file, views=tuple(found), points=np.array(ties.points).reshape(-1, 3),
        colors=np.array(ties.colors).reshape(-1, 3).clip(0, 255).astype(np.uint8),
        warnings=tuple(name_unaligned(unaligned)), refused=refused,
    )  # fmt: skip


def _pose(transform: JsonObject, file: Path, label: str, *, turned: bool) -> np.ndarray:
    try:
        rotation = np.array(transform.get("rotation"), np.float64).reshape(3, 3)
    except (TypeError, ValueError, OverflowError):
        raise CaptureError(f"{file}: {label} has no rotation of nine numbers. {_AGAIN}") from None
    center = parse_vector(transform.get("center"), 3, file, f"{label}: 'center'")
    pose = to_rigid(np.column_stack([rotation.T if turned else rotation, np.zeros(3)]), file, label)
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def _alicevision_poses(content: JsonObject, file: Path) -> Callable[[JsonObject], np.ndarray | None]:
    """What finds the pose of a view, None where it has none. A view of a rig has that of the rig, then its camera's
    within the rig (`subPoses`), unless it is independent of it."""
    poses = {
        str(entry["poseId"]): _pose(
            _dict(_dict(entry.get("pose")).get("transform")), file, f"pose {entry['poseId']}", turned=True
        )
        for entry in _entries(content, "poses", "poseId", file)
    }
    within: dict[tuple[str, str], np.ndarray | None] = {}
    for rig in _entries(content, "rigs", "rigId", file):
        for index, entry in enumerate(_entries(rig, "subPoses", "pose", file)):
            known = str(entry.get("status", "")).lower() != "uninitialized"
            label = f"sub-pose {index} of rig {rig['rigId']}"
            within[str(rig["rigId"]), str(index)] = (
                _pose(_dict(entry["pose"]), file, label, turned=True) if known else None
            )

    def pose_of(view: JsonObject) -> np.ndarray | None:
        pose, rig = poses.get(str(view.get("poseId"))), str(view.get("rigId"))
        is_independent = str(view.get("isPoseIndependant", "true")).lower() not in ("0", "false")
        if pose is None or is_independent or rig in _OF_NO_RIG:
            return pose
        inside = within.get((rig, str(view.get("subPoseId"))))
        return None if inside is None else inside @ pose

    return pose_of


def _points(seen: Iterable[tuple[object, object, list[tuple[str, JsonObject]]]], file: Path) -> _TiePoints:
    """Tie points from their places, colors and measurements."""
    ties = _TiePoints()
    for index, (place, color, measured) in enumerate(seen):
        ties.points.extend(parse_vector(place, 3, file, f"tie point {index}"))
        ties.colors.extend([GRAY] * 3 if color is None else parse_vector(color, 3, file, f"tie point {index}"))
        for view, one in measured:
            if one.get("x") is not None:
                numbers, pixels = ties.shown.setdefault(view, (array("q"), array("d")))
                pixels.extend(parse_vector(one["x"], 2, file, f"tie point {index}"))
                numbers.append(index)
    return ties


def _openmvg_lens(entry: JsonObject, file: Path) -> Intrinsics | str:
    values, label = _flat(entry.get("value")), f"lens {entry['key']}"
    kind = next((key for key in _PARAMETERS if key in values), "")
    if "focal_length" not in values:
        return f"{label} is {values.get('polymorphic_name') or 'of a kind'} without a focal length, which is not read"
    focal = parse_number(values, "focal_length", file) or 0.0
    center = parse_vector(values.get("principal_point"), 2, file, f"{label}: 'principal_point'").tolist()
    return _lens(_PARAMETERS.get(kind, ""), (focal, focal), center, values, values.get(kind), (file, label))


def _alicevision_kind(entry: JsonObject) -> str:
    """A lens of AliceVision in one word or two; since version 1.2.7 the distortion has a word of its own, as a measured
    undistortion has (anamorphic lenses), which counts instead of the distortion where it has parameters."""
    kind, bend = str(entry.get("type", "")).lower(), str(entry.get("distortionType") or "none").lower()
    undone, values = str(entry.get("undistortionType") or "none").lower(), entry.get("undistortionParams")
    if undone != "none" and isinstance(values, list) and any(re.search("[1-9]", str(value)) for value in values):
        return f"{kind} {undone}"
    if bend == "none" or kind not in ("pinhole", "equidistant"):
        return kind
    return bend if kind == "pinhole" else f"{kind} {bend}"


def _alicevision_lens(entry: JsonObject, version: tuple[int, ...], file: Path) -> Intrinsics | str:
    label, kind = f"lens {entry['intrinsicId']}", _alicevision_kind(entry)
    if kind not in _ALICEVISION:
        return f"{label} is {kind!r}; read are {', '.join(_ALICEVISION)}"

    def number(key: str, default: float = 0.0) -> float:
        value = parse_number(entry, key, file)
        return default if value is None else value

    width, height = number("width"), number("height")
    center = parse_vector(entry.get("principalPoint"), 2, file, f"{label}: 'principalPoint'")
    if version >= (1, 2, 1):
        center = center + np.array([width / 2, height / 2])
    if version < (1, 2, 0):
        focal = (number("pxFocalLength"),) * 2
    elif version < (1, 2, 2):
        focal = tuple(parse_vector(entry.get("pxFocalLength"), 2, file, f"{label}: 'pxFocalLength'").tolist())
    else:
        across, ratio = number("focalLength") / (number("sensorWidth") or 36.0) * width, number("pixelRatio", 1.0)
        focal = (across, across / ratio if version < (1, 2, 5) else across * ratio)
    bends = entry.get("distortionParams")
    if _ALICEVISION[kind] in ("equidistant", "radial at one"):
        unit = 1.0
        if _ALICEVISION[kind] == "equidistant":
            focal, unit = _equidistant_scale(focal[0], (width, height), entry, file)
        focal, bends = _fixed_at_one(focal, unit, bends, (file, label))
    lens = "fisheye" if _ALICEVISION[kind] == "equidistant" else _ALICEVISION[kind]
    return _lens(lens, focal, center.tolist(), entry, bends, (file, label))


def _equidistant_scale(
    focal: float, size: tuple[float, float], entry: JsonObject, file: Path
) -> tuple[tuple[float, float], float]:
    """The pixels of a radian in AliceVision's equidistant lens, and how many of its units, in which it bends, a radian
    is: one is the angle that half the shorter side of the sensor spans, and as long as the radius of the circle."""
    longer, shorter = max(size), min(size)
    if not shorter > 0:
        return (focal, focal), 1.0
    across = parse_number(entry, "sensorWidth", file) or 36.0
    down = parse_number(entry, "sensorHeight", file) or across * shorter / longer
    radius = parse_number(entry, "fisheyeCircleRadius", file) or shorter / 2
    unit = 2 * focal * across / longer / min(across, down)
    return (radius * unit, radius * unit), unit


def _fixed_at_one(
    focal: tuple[float, float], unit: float, bends: object, told: tuple[Path, str]
) -> tuple[tuple[float, float], list[float]]:
    """The focal lengths and the radial terms of a lens whose terms, of a radius in `unit`s, leave the radius one as it
    is: (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k1 + k2 + k3). Raises `CaptureError` where they do so for no radius."""
    file, label = told
    bends = bends if isinstance(bends, list) else []
    terms = parse_vector(bends, len(bends), file, f"{label}: its distortion")
    whole = 1.0 + float(terms.sum())
    if not whole > 0:
        raise CaptureError(f"{file}: {label} has a distortion that turns the picture round. {_AGAIN}")
    return (focal[0] / whole, focal[1] / whole), [k * unit ** (2 * n) for n, k in enumerate(terms.tolist(), 1)]


def _lens(
    kind: str, focal: tuple[float, float], center: list[float], sized: JsonObject, bends: object, told: tuple[Path, str]
) -> Intrinsics:
    file, label = told
    width, height = (int(parse_number(sized, key, file) or 0) for key in ("width", "height"))
    bends = bends if isinstance(bends, list) else []
    terms = parse_vector(bends, len(bends), file, f"{label}: its distortion").tolist()
    if any(terms[4 if kind == "fisheye" else 5 :]):
        raise CaptureError(f"{file}: {label} has {len(terms)} terms of distortion, more than its model. {_AGAIN}")
    if kind == "fisheye":
        lens = Intrinsics("OPENCV_FISHEYE", (*focal, *center, *[*terms, *[0.0] * 4][:4]), width, height)
    else:
        k1, k2, k3, t1, t2 = [*terms, *[0.0] * 5][:5]
        lens = brown_intrinsics(focal, (center[0], center[1]), (width, height), (k1, k2, k3), (t1, t2))
    return check_intrinsics(lens, file, label)


# -------------------------------------------------------------------------------------------------- JSON


def _head(file: Path, *texts: bytes) -> bool:
    if not file.is_file():
        return False
    try:
        with file.open("rb") as stream:
            head = decode_text(stream.read(1 << 16)).encode()
    except OSError:
        return False
    return all(text in head for text in texts)


def _dict(value: object) -> JsonObject:
    return value if isinstance(value, dict) else {}


def _list(landmark: JsonObject, file: Path) -> list[JsonObject]:
    found = landmark.get("observations") or []
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise CaptureError(f"{file}: the 'observations' of a tie point are no list. {_AGAIN}")
    return found


def _entries(content: JsonObject, name: str, key: str, file: Path) -> list[JsonObject]:
    """The objects of a list, which all have a key; none where the file has no such list."""
    found = content.get(name) or []
    if not isinstance(found, list) or not all(isinstance(each, dict) and each.get(key) is not None for each in found):
        raise CaptureError(f"{file}: {name!r} is no list of objects with {key!r}. {_AGAIN}")
    return found


def _flat(value: object, deep: int = 8) -> JsonObject:
    """All that an object holds, with what its parts hold: versions of OpenMVG nest it differently."""
    found: JsonObject = {}
    for key, each in _dict(value).items():
        found |= _flat(each, deep - 1) if isinstance(each, dict) and deep else {key: each}
    return found
