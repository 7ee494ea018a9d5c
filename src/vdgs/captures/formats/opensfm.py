"""OpenSfM's reconstruction.json, alone or in the folder of an ODM project.

Lengths in a picture count in its longer side, from the middle. Poses are camera from world, with the rotation as an
axis times an angle. The world is metres east, north and up of the place in reference_lla.json. ODM writes a second
world over it, UTM minus an offset, and keeps this one as reconstruction.topocentric.json.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vdgs.captures.coordinate_systems import ToGeodetic, to_geodetic
from vdgs.captures.formats.json_poses import parse_number, parse_vector, read_capture_json, read_json_text
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.gps_tables import check_geodetic
from vdgs.captures.table_columns import number_of
from vdgs.captures.text_tables import read_head
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_centers
from vdgs.geometry.crs import utm_epsg
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu, median_place
from vdgs.geometry.similarity import rotation_about
from vdgs.system.documents import JsonObject
from vdgs.system.units import some_names

RECONSTRUCTION, TOPOCENTRIC, REFERENCE = "reconstruction.json", "reconstruction.topocentric.json", "reference_lla.json"
TRACKS = "tracks.csv"
#: The report of an ODM project, with its poses, and the file of its lenses.
REPORT, CAMERAS = "shots.geojson", "cameras.json"
_HEAD_BYTES = 2048
#: Positions that are told twice differ by less (about a metre on Earth, and in one system).
_SAME_PLACE_DEG, _SAME_PLACE_M = 1e-5, 0.01
_AGAIN = "Export it again."
#: What other lists of cameras hold: what vdgs writes, the cameras of a trained 3DGS scene, and UAVScenes.
_OTHER_LISTS = ("matrix_world", '"img_name"', '"OriginalImageName"')
_UNDISTORT = "Undistort the photographs (opensfm undistort), and give the undistorted folder"
#: COLMAP's model of each projection, and its distortion in COLMAP's order; with one focal length or two.
_ONE_FOCAL = {"perspective": ("RADIAL", ("k1", "k2")), "fisheye": ("RADIAL_FISHEYE", ("k1", "k2"))}
_TWO_FOCALS = {
    "simple_radial": ("OPENCV", ("k1", "", "", "")),
    "radial": ("OPENCV", ("k1", "k2", "", "")),
    "brown": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "", "", "")),
    "fisheye_opencv": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
#: Names of distortion: radial, tangential, of thin prisms.
_TERM = re.compile(r"[kps]\d+")


def find_files(root: Path) -> list[Path]:
    """The reconstruction of OpenSfM in a folder, or of the ODM project that the folder is, metres east and north before
    UTM; else the report of the project."""
    files = [folder / name for folder in (root / "opensfm", root) for name in (TOPOCENTRIC, RECONSTRUCTION)]
    report = [folder / REPORT for folder in (root / "odm_report", root)]
    return [file for file in (*files, *report) if is_file(file)][:1]


def is_file(file: Path) -> bool:
    """Whether a file is a reconstruction, which is a list, as others are that are none (`_OTHER_LISTS`), or the report
    of an ODM project."""
    if file.suffix not in (".json", ".geojson"):
        return False
    head = read_head(file, _HEAD_BYTES).lstrip()
    if file.suffix == ".geojson":
        return "FeatureCollection" in head
    return head.startswith("[") and "{" in head and not any(text in head for text in _OTHER_LISTS)


def read(file: Path, options: CaptureOptions) -> Project:
    """The project of a reconstruction, or of the report of an ODM project. Raises `CaptureError` for damaged files."""
    return _read_report(file) if file.suffix == ".geojson" else _read_reconstruction(file)


def _read_reconstruction(file: Path) -> Project:
    reconstruction, warnings = _biggest(file)
    views, refused = _views(reconstruction, _read_cameras(reconstruction.get("cameras"), file), file)
    points, colors = _points(reconstruction, file)
    views = _with_tracks(views, list(reconstruction.get("points") or ()), file.parent / TRACKS)
    system, place = _system(reconstruction, file, warnings)
    return Project(
        format="opensfm", file=file, views=views, points=points, colors=colors, to_geodetic=system, place=place,
        warnings=tuple(warnings), refused=refused, remedy=_UNDISTORT,
    )  # fmt: skip


def _system(reconstruction: JsonObject, file: Path, warnings: list[str]) -> tuple[ToGeodetic | None, str]:
    """What brings the world to latitude, longitude and height, and words about it."""
    folder = file.parent.parent if (file.parent.parent / TOPOCENTRIC).is_file() else file.parent
    origin = _reference(reconstruction, file.parent)
    enu = None if origin is None else (lambda points: geodetic_from_enu(points, origin))
    found = (each / "odm_georeferencing" / "coords.txt" for each in folder.parents[:2])
    coordinates = next((each for each in found if each.is_file()), None)
    if file.name != TOPOCENTRIC and coordinates is not None:
        offset = _read_offset(coordinates)
        if folder != file.parent or _is_shifted(reconstruction, file, offset, enu, warnings):
            return offset.to_geodetic, offset.place
    return enu, "OpenSfM, metres about its reference" if enu is not None else ""


@dataclass(frozen=True, eq=False)
class _Offset:
    """What coords.txt of an ODM project tells: the system, what ODM takes off its coordinates, and where the
    photographs were taken by their GPS [n, 3], in the system without the offset."""

    file: Path
    shift: np.ndarray
    to_geodetic: ToGeodetic
    place: str
    positions: np.ndarray


def _read_offset(file: Path) -> _Offset:
    try:
        header, offset, *lines = file.read_text(encoding="utf-8-sig").split("\n")
        shift = np.array([*map(float, offset.split()), 0.0])
    except (OSError, ValueError):
        shift, header, lines = np.zeros(0), "", []
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise CaptureError(f"{file}: must hold a system and an offset of two numbers. Copy it from the project again.")
    change, name = to_geodetic(header, file)
    positions = np.array([[number_of(word) for word in line.split()] for line in lines if len(line.split()) == 3])
    positions = positions.reshape(-1, 3)
    known = positions[np.isfinite(positions).all(axis=1)]
    return _Offset(file, shift, lambda points: change(points + shift), f"ODM, {name}", known)


def _is_shifted(
    reconstruction: JsonObject, file: Path, offset: _Offset, enu: ToGeodetic | None, warnings: list[str]
) -> bool:
    """Whether an ODM project that has lost its topocentric reconstruction has this one in UTM: by its report, else by
    the GPS of its photographs; a warning where nothing tells."""
    report = offset.file.parent.parent / "odm_report" / REPORT
    content = read_capture_json(report) if report.is_file() else {}
    for feature in content.get("features") or ():
        told = feature.get("properties", {}) if isinstance(feature, dict) else {}
        shot = reconstruction["shots"].get(told.get("filename"))
        if isinstance(shot, dict):
            place = parse_vector(told.get("translation"), 3, report, "a photograph")
            return bool(np.abs(_center(shot, report) + offset.shift - place).max() < _SAME_PLACE_M)
    if enu is None:
        return False
    nearer = _is_nearer_in_utm(reconstruction, offset, enu, file)
    if nearer is None:
        warnings.append(
            f"{RECONSTRUCTION} of an ODM project may be in {offset.place.removeprefix('ODM, ')} or in metres about "
            f"{REFERENCE}, and nothing tells which: it is taken for the latter. Copy {TOPOCENTRIC} or odm_report/"
            f"{REPORT} of the project beside it, or give the place: --gps TABLE."
        )
    return bool(nearer)


def _is_nearer_in_utm(reconstruction: JsonObject, offset: _Offset, enu: ToGeodetic, file: Path) -> bool | None:
    """Whether the cameras are nearer to the GPS of their photographs (which shots have in metres about the reference,
    coords.txt of all photographs in UTM) if they are in UTM; None where neither file has these."""
    shots = [shot for shot in reconstruction["shots"].values() if isinstance(shot, dict)]
    told = [shot for shot in shots if any(shot.get("gps_position") or ())]
    if not shots or not (told or len(offset.positions)):
        return None
    centers = np.array([_center(shot, file) for shot in told or shots])
    if told:
        gps = enu(np.array([parse_vector(shot["gps_position"], 3, file, "'gps_position'") for shot in told]))
    else:
        gps = offset.to_geodetic(offset.positions)
    origin = median_place(gps)
    known = enu_from_geodetic(gps, origin)

    def distance(system: ToGeodetic) -> float:
        places = enu_from_geodetic(system(centers), origin)
        away = np.linalg.norm(places - known, axis=1) if told else cKDTree(known).query(places)[0]
        return float(np.median(away))  # some of the GPS may be wild

    return distance(offset.to_geodetic) < distance(enu)


def _center(shot: JsonObject, file: Path) -> np.ndarray:
    """Where a camera is."""
    keys = ("rotation", "translation")
    turn, move = (parse_vector(shot.get(key), 3, file, f"{key!r} of a photograph") for key in keys)
    return -rotation_about(turn).T @ move


def _biggest(file: Path) -> tuple[JsonObject, list[str]]:
    """The reconstruction of most photographs in a file, and a warning that names the photographs of the others."""
    content = read_json_text(file, _AGAIN)
    found = [each for each in content if isinstance(each, dict) and isinstance(each.get("shots"), dict)]
    found = [each for each in found if each["shots"]]
    if not found:
        raise CaptureError(f"{file}: holds no reconstruction with photographs ('shots'). Run the reconstruction again.")
    best = max(found, key=lambda each: len(each["shots"]))
    others = [name for each in found if each is not best for name in each["shots"]]
    if not others:
        return best, []
    shown = some_names(sorted(others))
    note = f"{file.name} holds {len(found)} reconstructions; the one of {len(best['shots'])} photographs is used"
    return best, [f"{note}, the other {len(others)} photographs are not ({shown})."]


def _read_cameras(cameras: object, file: Path) -> dict[str, Intrinsics | str]:
    """The cameras by their names, or why one cannot be used."""
    if not isinstance(cameras, dict) or not all(isinstance(each, dict) for each in cameras.values()):
        raise CaptureError(f"{file}: has no 'cameras'. {_AGAIN}")
    return {name: _intrinsics(camera, name, file) for name, camera in cameras.items()}


def _intrinsics(camera: JsonObject, name: str, file: Path) -> Intrinsics | str:
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _ONE_FOCAL and kind not in _TWO_FOCALS:
        return f"the projection {kind!r} of the camera {name!r} is not supported"

    def get(key: str) -> float:
        value = parse_number(camera, key, file) if key else None
        return 0.0 if value is None else value

    width, height = get("width"), get("height")
    if not (0 < width < 1e6 and 0 < height < 1e6):
        raise CaptureError(f"{file}: the camera {name!r} has an image size of {width:g}x{height:g}. {_AGAIN}")
    longer = max(width, height)
    model, keys = _ONE_FOCAL.get(kind) or _TWO_FOCALS[kind]
    others = [key for key in camera if _TERM.fullmatch(key) and key not in keys and get(key)]
    if others:
        return f"the lens parameter {others[0]} of the camera {name!r}, of a projection {kind!r}, is not supported"
    focal = (get("focal"),) if kind in _ONE_FOCAL else (get("focal_x") or get("focal"), get("focal_y") or get("focal"))
    center = (get("c_x") * longer + width / 2, get("c_y") * longer + height / 2)
    params = (*(longer * each for each in focal), *center, *map(get, keys))
    return check_intrinsics(Intrinsics(model, params, int(width), int(height)), file, f"the camera {name!r}")


def _views(
    reconstruction: JsonObject, known: Mapping[str, Intrinsics | str], file: Path
) -> tuple[tuple[ProjectView, ...], dict[str, list[str]]]:
    """The photographs in name order, and those of lenses that are not supported. Raises `CaptureError` for poses that
    are none."""
    views, refused = list[ProjectView](), dict[str, list[str]]()
    for name, shot in sorted(reconstruction["shots"].items()):
        label = f"the photograph {name!r}"
        if not isinstance(shot, dict) or shot.get("camera") not in known:
            raise CaptureError(f"{file}: {label} has no camera that the file describes. {_AGAIN}")
        intrinsics = known[shot["camera"]]
        if isinstance(intrinsics, str):
            refused.setdefault(intrinsics, []).append(name)
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(parse_vector(shot.get("rotation"), 3, file, f"{label}: 'rotation'"))
        pose[:3, 3] = parse_vector(shot.get("translation"), 3, file, f"{label}: 'translation'")
        views.append(ProjectView(names=(name,), camera_from_world=to_rigid(pose, file, label), intrinsics=intrinsics))
    return tuple(views), refused


def _points(reconstruction: JsonObject, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float64 and colors [n, 3] uint8; none where the file has none."""
    listed: Any = reconstruction.get("points") or {}
    try:
        points = np.array([each["coordinates"] for each in listed.values()], dtype=np.float64).reshape(-1, 3)
        colors = np.array([each["color"] for each in listed.values()], dtype=np.float64).reshape(-1, 3)
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise CaptureError(f"{file}: 'points' must have three 'coordinates' and a 'color' each. {_AGAIN}") from None
    return points, np.nan_to_num(colors).clip(0, 255).astype(np.uint8)


def _reference(reconstruction: JsonObject, folder: Path) -> tuple[float, float, float] | None:
    """Latitude, longitude (degrees) and height of the world's origin; None where it has no place on Earth."""
    files = [each / REFERENCE for each in (folder, folder.parent) if (each / REFERENCE).is_file()]
    content = read_capture_json(files[0]) if files else reconstruction.get("reference_lla")
    if not isinstance(content, dict):
        return None
    where = files[0] if files else folder / RECONSTRUCTION
    place = [parse_number(content, key, where) for key in ("latitude", "longitude", "altitude")]
    if place[0] is None or place[1] is None or (place[0] == 0 and place[1] == 0):  # OpenSfM's word for "no GPS"
        return None
    check_geodetic(found := (place[0], place[1], place[2] or 0.0), where)
    return found


def _with_tracks(views: tuple[ProjectView, ...], numbers: Sequence[str], file: Path) -> tuple[ProjectView, ...]:
    """The views with the points that they show, whose names are `numbers`, where tracks.csv is there. Lines that are
    none are passed over: what they say is a check, and no part of the scene."""
    index_of = {number: index for index, number in enumerate(numbers)}
    found: dict[str, tuple[array[int], array[float]]] = {view.names[0]: (array("q"), array("d")) for view in views}
    try:
        with file.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                words = line.split("\t", 5)
                if len(words) > 4 and words[1] in index_of and words[0] in found:
                    with suppress(ValueError):
                        place = float(words[3]), float(words[4])
                        found[words[0]][0].append(index_of[words[1]])
                        found[words[0]][1].extend(place)
    except OSError:
        return views
    return tuple(_with_sightings(view, *map(np.array, found[view.names[0]])) for view in views)


def _with_sightings(view: ProjectView, numbers: np.ndarray, places: np.ndarray) -> ProjectView:
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    pixels = places.reshape(-1, 2) * size.max() + size / 2
    return replace(view, sightings=(numbers.astype(np.int64), pixels))


# ----------------------------------------------------------------------------------------- report of ODM


def _read_report(file: Path) -> Project:
    """The cameras of shots.geojson, with their places in the project's system and rotations camera from world, and the
    lenses of cameras.json."""
    known, lenses_file = _report_cameras(file)
    content = read_capture_json(file)
    features: Any = content.get("features")
    if not isinstance(features, list) or not features:
        raise CaptureError(f"{file}: has no 'features', the photographs. {_AGAIN}")
    views, refused, geodetic, warnings = list[ProjectView](), dict[str, list[str]](), [], list[str]()
    for index, feature in enumerate(features):
        shot: Any = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(shot, dict) or not isinstance(shot.get("filename"), str):
            raise CaptureError(f"{file}: feature {index} names no photograph ('filename'). {_AGAIN}")
        label = f"the photograph {shot['filename']!r}"
        intrinsics = _lens_of(shot, known, lenses_file)
        if isinstance(intrinsics, str):
            refused.setdefault(intrinsics, []).append(shot["filename"])
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(parse_vector(shot.get("rotation"), 3, file, f"{label}: 'rotation'"))
        pose[:3, 3] = -pose[:3, :3] @ parse_vector(shot.get("translation"), 3, file, f"{label}: 'translation'")
        views.append(ProjectView(names=(shot["filename"],), camera_from_world=pose, intrinsics=intrinsics))
        geodetic.append(parse_vector(dict(feature.get("geometry") or {}).get("coordinates"), 3, file, label)[[1, 0, 2]])
    system, place = _report_system(views, np.array(geodetic), file, warnings)
    return Project(
        format="opensfm", file=file, views=tuple(views), points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8),
        to_geodetic=system, place=place, warnings=tuple(warnings), refused=refused, remedy=_UNDISTORT,
    )  # fmt: skip


def _report_cameras(file: Path) -> tuple[dict[str, Intrinsics | str], Path]:
    """The lenses beside a report, and the file that has them: of the project, or of each part of a divided one."""
    project = file.parent.parent
    for folder, pattern in ((project, CAMERAS), (file.parent, CAMERAS), (project, f"submodels/*/{CAMERAS}")):
        found = {each: _read_cameras(read_capture_json(each), each) for each in sorted(folder.glob(pattern))}
        if len(found) == 1:
            return next(iter(found.values())), next(iter(found))
        if found:  # one camera has another lens in each part, which its focal length tells
            lenses = {f"{each.parent.name}/{name}": lens for each, of in found.items() for name, lens in of.items()}
            return lenses, next(iter(found))
    raise CaptureError(
        f"{file}: has the poses, but {CAMERAS} of the project, with the lenses, is not above it. Copy it there from "
        "the project (in WebODM: Download Assets, Camera Parameters)."
    )


def _lens_of(shot: JsonObject, known: Mapping[str, Intrinsics | str], file: Path) -> Intrinsics | str:
    """The camera of a photograph: by its name, else the one of its shape whose focal length is nearest."""
    called = str(shot.get("camera"))
    for name in (called, called.removeprefix("v2 ")):  # ODM drops the prefix in cameras.json
        if name in known:
            return known[name]
    lenses = [each for each in known.values() if not isinstance(each, str)]
    if not lenses or len(known) == 1:
        return next(iter(known.values()), f"{file.name} has no lens")
    width, height, focal = (parse_number(shot, key, file) or 0.0 for key in ("width", "height", "focal"))
    alike = [each for each in lenses if abs(each.width * height - each.height * width) <= max(width, height)]
    return min(alike or lenses, key=lambda each: abs(each.focal[0] / max(each.width, each.height) - focal))


def _report_system(
    views: list[ProjectView], geodetic: np.ndarray, file: Path, warnings: list[str]
) -> tuple[ToGeodetic | None, str]:
    """The zone of UTM that the positions are in: the one in which they agree with their latitudes and longitudes."""
    if not views:
        return None, ""
    poses = np.stack([view.camera_from_world for view in views])
    places = camera_centers(poses)
    if (np.abs(geodetic[:, 0]) <= 90).all():
        # Mostly that of the middle; of the first photograph, or of a list of control points, beside a border of zones.
        usual = int(utm_epsg(*np.median(geodetic, axis=0)[:2]).removeprefix("EPSG:"))
        for half in (usual // 100, 326 + 327 - usual // 100):
            for aside in (0, -1, 1):
                change, name = to_geodetic(f"EPSG:{100 * half + (usual % 100 - 1 + aside) % 60 + 1}", file)
                if np.abs(change(places)[:, :2] - geodetic[:, :2]).max() < _SAME_PLACE_DEG:
                    return change, f"ODM, {name}"
    warnings.append(f"{file.name}: its positions are not those of a UTM zone; the scene has no place on Earth.")
    return None, ""
