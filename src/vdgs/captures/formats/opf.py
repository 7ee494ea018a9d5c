"""Pix4D's Open Photogrammetry Format: project.opf, which names the files of cameras, lenses, points and system.

Angles are omega, phi and kappa: world from camera, in axes right, up, back, is Rx(omega) Ry(phi) Rz(kappa). Positions
and points are in the processing system: the coordinates of the project's system, scaled, swapped where it is
left-handed, and shifted.
"""

from __future__ import annotations

from itertools import compress
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from vdgs.captures.coordinate_systems import (
    WITHOUT_GEOID,
    ToGeodetic,
    UnknownSystem,
    has_heights,
    height_unit,
    to_geodetic,
)
from vdgs.captures.formats.brown_lens import MAX_POWERS, brown_intrinsics, quarter_turn_fisheye
from vdgs.captures.formats.camera_bands import color_cameras
from vdgs.captures.formats.gltf_points import GltfPoints, join_points, read_gltf_points
from vdgs.captures.formats.json_poses import (
    OPENGL_FROM_OPENCV,
    axis_rotation,
    parse_number,
    parse_vector,
    read_capture_json,
)
from vdgs.captures.formats.photograph_sizes import name_unaligned
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, safe_name
from vdgs.captures.formats.surveyed_points import survey_note
from vdgs.captures.system_names import is_local_system
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject

_FORMAT = "application/opf-{}+json"
_AGAIN = "Export the project again."


def find_files(root: Path) -> list[Path]:
    return [file for file in sorted(root.glob("*.opf")) if is_file(file)]


def is_file(file: Path) -> bool:
    return file.suffix.lower() == ".opf" and file.is_file()


def read(file: Path, options: CaptureOptions) -> Project:
    """The project of an OPF file. Raises `CaptureError` for damaged and missing files and projects without
    calibration."""
    items = _Items(file)
    calibrated, list_file = items.document("calibrated-cameras"), items.path("camera-list")
    if calibrated is None or list_file is None:
        raise CaptureError(
            f"{file}: has no calibrated cameras: the project was not calibrated. Calibrate it, then export."
        )
    sensors = _sensors(items, calibrated, items.path("calibrated-cameras") or file)
    uris = {
        _number(each, "id", list_file): str(each.get("uri"))
        for each in _dicts(read_capture_json(list_file), "cameras", list_file)
    }
    where, cloud = items.path("calibrated-cameras") or file, _points(items)
    views, refused = list[ProjectView](), dict[str, list[str]]()
    listed = [
        (camera, _number(camera, "id", where), _number(camera, "sensor_id", where))
        for camera in _dicts(calibrated, "cameras", where)
    ]
    names, bands = {number: photograph_name(uri) for number, uri in uris.items()}, _bands(items)
    in_color, warnings = color_cameras(
        [(names.get(number, f"camera {number}"), bands.get(sensor, ())) for _, number, sensor in listed]
    )
    for camera, number, sensor in compress(listed, in_color):
        name = names.get(number, f"camera {number}")
        lens = sensors.get(sensor, f"its sensor {sensor} is not calibrated")
        if isinstance(lens, str):
            refused.setdefault(lens, []).append(name)
            continue
        pose = _pose(camera, where, f"camera {number}")
        seen = cloud.shown.get(number)
        views.append(ProjectView(names=(name,), camera_from_world=pose, intrinsics=lens, sightings=seen))
    calibrated_ids = {number for _, number, _ in listed}
    warnings += name_unaligned([name for number, name in names.items() if number not in calibrated_ids])
    rolling = sum(_rolls(camera.get("rolling_shutter")) for camera in calibrated["cameras"])
    if rolling:
        warnings.append(f"the rolling shutter of {rolling} photographs is not modelled.")
    warnings += survey_note(_num_control_points(items), "control points", "")
    unknown = ""
    try:
        system, place, is_metric = _system(items)
    except UnknownSystem as error:
        system, place, is_metric, unknown = None, "", True, error.definition
    return Project(
        format="opf", file=file, views=tuple(views), points=cloud.points, colors=cloud.colors, to_geodetic=system,
        is_metric=is_metric, place=place, warnings=tuple(warnings), refused=refused,
        unknown_system=unknown, remedy="Export COLMAP from PIX4Dmatic, or undistort the photographs",
    )  # fmt: skip


def _num_control_points(items: _Items) -> int:
    """How many control points a project brings (input-control-points)."""
    content = items.document("input-control-points") or {}
    found = content.get("gcps")  # its mtps are marked, not surveyed
    return len(found) if isinstance(found, list) else 0


def _rolls(shutter: Any) -> bool:
    """Whether a camera was calibrated as moving while its rows were read."""
    return isinstance(shutter, list) and any(shutter)


class _Items:
    """The resources of a project: their formats and files."""

    def __init__(self, file: Path) -> None:
        self.file = file
        content = read_capture_json(file)
        self.resources = [
            (str(item.get("type")), str(each.get("format")), str(each.get("uri")))
            for item in _dicts(content, "items", file)
            for each in item.get("resources") or ()
            if isinstance(each, dict)
        ]

    def path(self, what: str) -> Path | None:
        """The file of a format, of the first item that has one."""
        return next(iter(self.paths(_FORMAT.format(what))), None)

    def paths(self, form: str, item: str | None = None) -> list[Path]:
        uris = [uri for kind, each, uri in self.resources if each == form and item in (None, kind)]
        return [
            self.file.parent / safe_name(photograph_name(uri), self.file, "resource", self.file.parent) for uri in uris
        ]

    def document(self, what: str) -> JsonObject | None:
        path = self.path(what)
        return read_capture_json(path) if path is not None else None


def photograph_name(uri: str) -> str:
    """The path that a URI means, without the page of a TIFF."""
    path = urlsplit(uri).path if uri.lower().startswith("file:") else uri.partition("#")[0]
    return unquote(path)


def _dicts(content: JsonObject, key: str, file: Path) -> list[JsonObject]:
    found = content.get(key)
    if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
        raise CaptureError(f"{file}: has no list {key!r}. {_AGAIN}")
    return found


def _number(content: JsonObject, key: str, file: Path) -> int:
    """A number by which things are told apart; drafts of the format write it in hexadecimal digits."""
    value = content.get(key)
    try:
        return int(value, 0) if isinstance(value, str) else int(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise CaptureError(f"{file}: {key!r} must be a number, not {str(value)[:40]!r}. {_AGAIN}") from None


def _sensors(items: _Items, calibrated: JsonObject, file: Path) -> dict[int, Intrinsics | str]:
    """The lenses by the numbers of the sensors, or why one cannot be used."""
    input_file = items.path("input-cameras")
    if input_file is None:
        raise CaptureError(f"{items.file}: names no input cameras, which have the sizes of the photographs. {_AGAIN}")
    sizes = {
        _number(each, "id", input_file): parse_vector(each.get("image_size_px"), 2, input_file, "'image_size_px'")
        for each in _dicts(read_capture_json(input_file), "sensors", input_file)
    }
    found: dict[int, Intrinsics | str] = {}
    for sensor in _dicts(calibrated, "sensors", file):
        number, inside = _number(sensor, "id", file), sensor.get("internals")
        if not isinstance(inside, dict) or number not in sizes:
            found[number] = f"its sensor {number} has no calibration or no size"
        elif inside.get("type") == "fisheye":
            found[number] = _fisheye(inside, sizes[number], file, f"sensor {number}")
        elif inside.get("type") != "perspective":
            found[number] = f"the lens {inside.get('type')!r} of its sensor {number} is not supported"
        else:
            found[number] = _perspective(inside, sizes[number], file, f"sensor {number}")
    return found


def _bands(items: _Items) -> dict[int, tuple[str, ...]]:
    """The names of the bands that sensors show, by the numbers of the sensors, where the project says them."""
    file = items.path("input-cameras")
    sensors = _dicts(read_capture_json(file), "sensors", file) if file is not None else []
    listed = {_number(each, "id", file or items.file): each.get("bands") for each in sensors}
    return {
        number: tuple(str(band.get("name", "")) for band in bands if isinstance(band, dict))
        for number, bands in listed.items()
        if isinstance(bands, list)
    }


def _perspective(inside: JsonObject, size: np.ndarray, file: Path, label: str) -> Intrinsics:
    focal = parse_number(inside, "focal_length_px", file) or 0.0
    center = parse_vector(inside.get("principal_point_px"), 2, file, f"{label}: 'principal_point_px'")
    radial = parse_vector(inside.get("radial_distortion", [0, 0, 0]), 3, file, f"{label}: 'radial_distortion'")
    bent = parse_vector(inside.get("tangential_distortion", [0, 0]), 2, file, f"{label}: 'tangential_distortion'")
    width, height = map(int, size.clip(0, 1e9))
    lens = brown_intrinsics(
        (focal, focal), (float(center[0]), float(center[1])), (width, height), radial=radial.tolist(),
        tangential=(float(bent[0]), float(bent[1])),
    )  # fmt: skip
    return check_intrinsics(lens, file, label)


def _fisheye(inside: JsonObject, size: np.ndarray, file: Path, label: str) -> Intrinsics | str:
    """Pix4D's fisheye: angles in quarter turns, a polynomial from the zeroth power on, and an affine matrix."""
    center = parse_vector(inside.get("principal_point_px"), 2, file, f"{label}: 'principal_point_px'")
    affine = parse_vector(inside.get("affine"), 4, file, f"{label}: 'affine'").tolist()
    listed: Any = inside.get("polynomial")
    count = max(2, len(listed)) if isinstance(listed, list) else 2
    polynomial = parse_vector(listed, count, file, f"{label}: 'polynomial'").tolist()
    width, height = map(int, size.clip(0, 1e9))
    lens = quarter_turn_fisheye(affine, (float(center[0]), float(center[1])), (width, height), polynomial)
    if lens is None:
        return f"the fisheye's polynomial {polynomial[:MAX_POWERS]} of its {label} is not supported"
    return check_intrinsics(lens, file, label)


def _pose(camera: JsonObject, file: Path, label: str) -> np.ndarray:
    angles = parse_vector(camera.get("orientation_deg"), 3, file, f"{label}: 'orientation_deg'")
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = axis_rotation(0, angles[0]) @ axis_rotation(1, angles[1]) @ axis_rotation(2, angles[2])
    world_from_camera[:3, 3] = parse_vector(camera.get("position"), 3, file, f"{label}: 'position'")
    return np.linalg.inv(world_from_camera @ OPENGL_FROM_OPENCV)


def _points(items: _Items) -> GltfPoints:
    """The points of the calibration; those of a cloud where it has none."""
    for item in ("calibration", "point_cloud"):
        clouds = [read_gltf_points(path) for path in items.paths("model/gltf+json", item)]
        if any(len(cloud.points) for cloud in clouds):
            return join_points(clouds)
    return join_points([])


def _system(items: _Items) -> tuple[ToGeodetic | None, str, bool]:
    """What brings processing coordinates to latitude, longitude and height, words about it, and whether they are metres
    where nothing does: the project has no system, or one of its own (a building site)."""
    file = items.path("scene-reference-frame")
    content: Any = read_capture_json(file) if file is not None else {}
    crs, change = content.get("crs"), content.get("base_to_canonical")
    if file is None or not isinstance(crs, dict) or not isinstance(change, dict):
        return None, "", False
    definition = str(crs.get("definition", ""))
    if is_local_system(definition) or not definition.strip():
        is_metric = bool(definition.strip()) and "foot" not in definition.lower()
        return None, "OPF, metres of a system of its own" if is_metric else "", is_metric
    shift = parse_vector(change.get("shift"), 3, file, "'shift'")
    scale = parse_vector(change.get("scale", [1, 1, 1]), 3, file, "'scale'")
    if (scale <= 0).any():
        raise CaptureError(f"{file}: 'scale' must be positive. {_AGAIN}")
    geoid, swapped = parse_number(crs, "geoid_height", file), bool(change.get("swap_xy"))
    # Where x and y change places the system is left-handed (north, east; south, west), and told with its own axes.
    known, name = to_geodetic(definition, file, "'definition'", heights_as_xy=True, own_axes=swapped)
    order = [1, 0, 2] if swapped else [0, 1, 2]
    by_geoid = height_unit(definition) if geoid is not None and has_heights(definition) else None

    def to_earth(points: np.ndarray) -> np.ndarray:
        base = (points - shift)[:, order] / scale
        # The geoid's height above the ellipsoid has the unit of the system's heights, and stands in the place of the
        # model of the geoid that these are told by.
        raised = base + np.array([0.0, 0.0, geoid or 0.0])
        return known(raised) if by_geoid is None else np.column_stack([known(base)[:, :2], by_geoid * raised[:, 2]])

    return to_earth, f"OPF, {name if by_geoid is None else name.replace(WITHOUT_GEOID, '')}", False
