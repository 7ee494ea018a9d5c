"""RealityScan (RealityCapture): its table of registered cameras, and the XMP that it writes beside each photograph.

Lengths in a picture count in its longer side: the focal length in 36ths of it, the principal point from the middle.
Heading, pitch and roll turn a camera that looks down with its top to the north: world from camera, in axes right, up,
back, is Rz(-heading) Rx(pitch) Ry(roll). The XMP, and the table for OpenCV, have the rotation camera from world, in
axes right, down, forward. Of the tangential terms t1 goes with r² + 2x²: it is OpenCV's p2, and so the table for OpenCV
writes t2 before t1.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic, is_in_degrees, to_geodetic
from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.center_sizes import told_size
from vdgs.captures.formats.json_poses import OPENGL_FROM_OPENCV, axis_rotation
from vdgs.captures.formats.photograph_sizes import GIVE_ALIGNED, name_unaligned, photograph_sizes
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import read_xml, xml_numbers
from vdgs.captures.text_tables import decode_text, read_head
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center, camera_centers
from vdgs.geometry.geodesy import geodetic_from_ecef, is_earth_centered
from vdgs.system.units import first_names

#: Columns that say where a camera is; with them a table is one of registered cameras.
_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_MATRIX = ("tx", "ty", "tz", *(f"r{row}{column}" for row in range(3) for column in range(3)))
_LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
#: Columns of the focal length; those that a camera needs, and the terms of its lens, by that which a table has.
_FOCAL = {"f", "fpix"}
_NEEDED = {"f": ("name", "f", *_POSE), "fpix": ("name", "fpix", *_MATRIX)}
_TERMS = {
    "f": {key: key for key in _LENS},
    "fpix": {"px": "pxpix", "py": "pypix", **{key: key for key in _LENS[2:]}},
}
#: What people's own templates call the columns.
_ALIASES = {
    "file": "name", "filename": "name", "image": "name", "imagename": "name", "label": "name",
    "east": "x", "easting": "x", "north": "y", "northing": "y",
    "z": "alt", "altitude": "alt", "height": "alt", "yaw": "heading",
    "focal": "f", "focallength": "f", "focallength35mm": "f", "f35mm": "f",
    "ppx": "px", "principalpointu": "px", "pxnorm": "px", "ppy": "py", "principalpointv": "py", "pynorm": "py",
}  # fmt: skip
#: The models of the XMP that are Brown's, all in the order k1, k2, k3, k4, t1, t2.
_BROWN_MODELS = {"", "perspective", "brown3", "brown4", "brown3t2", "brown4t2"}
#: Bytes in which the line that names the columns is looked for, and the namespace of the XMP.
_HEAD_BYTES, _NAMESPACE = 1024, "capturingreality.com/ns/xcr"
#: No camera of a survey has a longer focal length, in millimetres as of 35 mm film.
_LONGEST_35MM = 1500.0
#: XMP files that are looked at to tell whether they are RealityScan's: other programs write thousands.
_XMP_LOOKED_AT = 20
#: Cameras of one flight are no farther apart in degrees, and have coordinates as large only in a projected system.
_DEGREES_APART, _PROJECTED_FROM = 0.2, 20_000.0
#: In degrees a flight is so many times farther from 0, 0 than it is wide, and so many times as high in metres; a world
#: without scale lies about its own origin (choice).
_FAR_IN_DEGREES, _HIGH_IN_METERS = 100.0, 50.0
#: What RealityScan writes beside the points and models that it exports, and the system that it names there.
_INFO, _SYSTEM = "*.[rR][cCsS][iI]nfo", re.compile(r'globalCoordinateSystemName="\s*epsg:(\d+)', re.IGNORECASE)
#: Axes of cameras are so near the vertical, in degrees, only where a table in degrees has spoiled them.
_SPOILED_DEG = 0.05
_AGAIN = "Export the registration again."


@dataclass(frozen=True, eq=False, kw_only=True)
class RegisteredCamera:
    """A photograph that RealityScan has placed; its lens is told in shares of the picture, whose size is not."""

    name: str
    camera_from_world: np.ndarray
    focal_35mm: float
    lens: Mapping[str, float] = field(default_factory=dict)
    in_pixels: bool = False
    """Whether focal length and principal point are told in pixels, from the corner, of the photograph."""
    component: str = ""
    """Which part of the project it was aligned in, where the file says that."""

    def intrinsics(self, size: tuple[int, int], file: Path) -> Intrinsics:
        """The lens at the size of the photograph, or at that which its pixels are told for."""
        (width, height), longer = size, max(size)
        px, py, k1, k2, k3, k4, t1, t2 = (self.lens.get(key, 0.0) for key in _LENS)
        focal, center = self.focal_35mm * longer / 36, (px * longer + width / 2, py * longer + height / 2)
        if self.in_pixels:
            focal, center = self.focal_35mm, (px, py)
            size = told_size(size, center, file, self.name, GIVE_ALIGNED)
        lens = brown_intrinsics(
            (focal, focal * self.lens.get("aspect", 1.0)), center, size,
            radial=(k1, k2, k3, k4), tangential=(t2, t1), skew=self.lens.get("skew", 0.0) * longer,
        )  # fmt: skip
        return check_intrinsics(lens, file, f"the photograph {self.name!r}")


def find_files(root: Path) -> list[Path]:
    """The tables of registered cameras in a folder, without those of positions and angles alone; else the first XMP
    beside its photographs, for all of them."""
    tables = [file for file in sorted(root.glob("*.csv")) if _is_table(file, with_lens=True)]
    beside = (file for folder in (root, root / "images") for file in _xmp_below(folder, folder != root))
    return tables or [file for file in islice(beside, _XMP_LOOKED_AT) if _is_xmp(file)][:1]


def is_file(file: Path) -> bool:
    return _is_xmp(file) if file.suffix.lower() == ".xmp" else _is_table(file)


def read(file: Path, options: CaptureOptions) -> Project:
    """The project of a table, or of all XMP files in the folder of one. Raises `CaptureError` for damaged files."""
    refused, unaligned = dict[str, list[str]](), list[str]()
    if file.suffix.lower() != ".xmp":
        cameras, root = read_camera_table(file), file.parent
    else:
        above = next((folder for folder in file.parents if folder.name == "images"), file.parent)
        files = [each for each in _xmp_below(above) if _is_xmp(each)]
        read_all = [(each.relative_to(above).with_suffix("").as_posix(), read_xmp(each)) for each in files]
        cameras = [replace(each, name=name) for name, each in read_all if not isinstance(each, str)]
        unaligned = [name for name, why in read_all if why == ""]
        for name, why in read_all:
            if isinstance(why, str) and why:
                refused.setdefault(why, []).append(name)
        root = above.parent if above.name == "images" else above
    cameras, warnings = _of_one_world(cameras)
    warnings += name_unaligned(unaligned)
    if file.suffix.lower() != ".xmp" and _may_be_division(cameras):
        warnings.append(
            f"{file.name}: of the lens only k1 is set, and is taken for Brown's. If the lens model was Division, align "
            "with Brown3 and export again."
        )
    names = [camera.name for camera in cameras]
    sizes = photograph_sizes(root, options, names, file) if names else []
    views = tuple(
        ProjectView(
            names=(camera.name,), camera_from_world=camera.camera_from_world, intrinsics=camera.intrinsics(size, file)
        )
        for camera, size in zip(cameras, sizes, strict=True)
    )  # fmt: skip
    system, in_degrees, is_metric, place = _world(views, file)
    return Project(
        format="realityscan", file=file, views=views, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8),
        to_geodetic=system, in_degrees=in_degrees, is_metric=is_metric, place=place, warnings=tuple(warnings),
        refused=refused, remedy="Align with Brown3 or Brown4, or export COLMAP",
    )  # fmt: skip


def _of_one_world(cameras: list[RegisteredCamera]) -> tuple[list[RegisteredCamera], list[str]]:
    """Cameras that share a world, and what to say of the others: those of the component of most cameras, for each
    component has coordinates of its own; all of them in a projected system."""
    components = Counter(camera.component for camera in cameras)
    centers = np.array([camera_center(each.camera_from_world) for each in cameras])
    if len(components) < 2 or np.abs(np.median(centers[:, :2], axis=0)).max() > _PROJECTED_FROM:
        return cameras, []
    largest = components.most_common(1)[0][0]
    lost = [camera.name for camera in cameras if camera.component != largest]
    said = f"{len(lost)} cameras of other components have no place in the same world and are left out"
    return [camera for camera in cameras if camera.component == largest], [f"{said} ({first_names(lost)})."]


def _may_be_division(cameras: list[RegisteredCamera]) -> bool:
    """Whether the table may be of the Division model, which it does not say: k1 alone."""
    set_terms = {key for camera in cameras for key, value in camera.lens.items() if value and key[0] in "kt"}
    return set_terms == {"k1"}


def _world(views: tuple[ProjectView, ...], file: Path) -> tuple[ToGeodetic | None, bool, bool, str]:
    """What the coordinates are, which neither file says: degrees, metres of a projected system (which the information
    beside a point cloud names), or of no scale. What brings them to latitude, longitude and height, whether they are
    degrees, whether they are metres, and words about them."""
    if not views:
        return None, False, False, ""
    poses = np.stack([view.camera_from_world for view in views])
    centers = camera_centers(poses)
    middle, spread = np.abs(np.median(centers, axis=0)), np.ptp(centers, axis=0)
    wide = spread[:2].max()
    if (
        0 < wide < _DEGREES_APART
        and middle[0] <= 180
        and middle[1] <= 90
        and middle[:2].max() > _FAR_IN_DEGREES * wide
        and max(middle[2], spread[2]) > _HIGH_IN_METERS * wide
    ):
        spoiled = np.degrees(np.arccos(np.abs(poses[:, 0, 2]).clip(0, 1))) < _SPOILED_DEG
        if spoiled.mean() > 0.5:
            raise CaptureError(
                f"{file}: the angles of its cameras mean nothing: RealityScan spoils them where it writes longitude "
                "and latitude. Export the table again with the coordinate system 'Local Euclidean', or in a projected "
                "system (UTM); --gps TABLE gives a local one its place."
            )
        return lambda points: points[:, [1, 0, 2]], True, True, "RealityScan, longitude and latitude"
    if middle[:2].max() > _PROJECTED_FROM:
        if (named := _named_system(file)) is not None:
            return named[0], False, True, f"RealityScan, {named[1]}"
        if is_earth_centered(centers):
            return geodetic_from_ecef, False, True, "RealityScan, Earth-centred metres, taken as of WGS 84"
        return None, False, True, "RealityScan, metres of a projected system that it does not name"
    return None, False, False, ""


def _named_system(file: Path) -> tuple[ToGeodetic, str] | None:
    """The projected system that the information beside a point cloud or a model in the folder names; none where it
    names degrees, which the coordinates are not."""
    for info in sorted(file.parent.glob(_INFO)):
        try:
            found = _SYSTEM.search(decode_text(info.read_bytes()))
        except OSError as error:
            raise CaptureError(
                f"{info}: names the coordinate system of the export, and cannot be read ({error.strerror or error}). "
                "Copy it again."
            ) from error
        if found is not None:
            known = to_geodetic(f"EPSG:{found[1]}", info, "globalCoordinateSystemName")
            if not is_in_degrees(f"EPSG:{found[1]}"):
                return known
    return None


def _is_table(file: Path, *, with_lens: bool = False) -> bool:
    """Whether a file begins with the columns of registered cameras, their focal lengths among them or not."""
    head = read_head(file, _HEAD_BYTES).splitlines()[:3]
    found = [columns for columns in map(_column_names, head) if columns is not None]
    return any(not with_lens or not _FOCAL.isdisjoint(names) for _, names in found)


def _column_names(line: str) -> tuple[str, list[str]] | None:
    """What parts the columns of a line, and their names, if they are those of registered cameras."""
    for delimiter in (",", ";", "\t"):
        words = [
            word.strip().strip('"').lower().lstrip("#").replace(" ", "").replace("_", "")
            for word in line.split(delimiter)
        ]
        names = [_ALIASES.get(word, word) for word in words]
        if "name" in names and ({*_POSE} <= {*names} or {*_MATRIX} <= {*names}):
            return delimiter, names
    return None


def read_camera_table(file: Path) -> list[RegisteredCamera]:
    """Raises `CaptureError` for a row with too few columns or with what is no number, and for one without a focal
    length; all such rows at once."""
    try:
        lines = decode_text(file.read_bytes()).splitlines()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error}). {_AGAIN}") from None
    start, found = next(
        ((k, each) for k, each in enumerate(map(_column_names, lines[:3])) if each is not None), (0, None)
    )
    if found is None:
        raise CaptureError(f"{file}: names no columns name, {', '.join(_POSE)}. {_AGAIN}")
    delimiter, names = found
    if _FOCAL.isdisjoint(names):
        raise CaptureError(
            f"{file}: has no column f, the focal length. Export 'Internal/External camera parameters' instead; a table "
            "of positions is given beside the photographs, as --gps."
        )
    focal = _focal_column(names, file)
    rows = list(enumerate(csv.reader(io.StringIO("\n".join(lines[start + 1 :])), delimiter=delimiter), start + 2))
    rows = [(number, row) for number, row in rows if "".join(row).strip() and not row[0].startswith("#")]
    told = {name for _, row in rows for name, word in zip(names, row, strict=False) if word.strip()}
    read = {*_NEEDED[focal], *(told & {*_TERMS[focal].values()})}
    cameras, problems = [], []
    for number, row in rows:
        try:
            if missing := [name for name in names[len(row) :] if name in read]:
                raise ValueError(f"ends before {', '.join(missing)}")
            cameras.append(_row_camera(dict(zip(names, row, strict=False)), focal, delimiter, file))
        except ValueError as error:
            problems.append(f"line {number}: {error}")
    if problems:
        listed = "".join(f"\n  {each}" for each in problems[:10])
        raise CaptureError(f"{file}: {len(problems)} of its rows cannot be read. {_AGAIN}{listed}")
    if cameras and focal == "f" and np.median([camera.focal_35mm for camera in cameras]) > _LONGEST_35MM:
        raise CaptureError(
            f"{file}: has focal lengths of {cameras[0].focal_35mm:g} mm as of 35 mm film. Are they in pixels? Export "
            "'Internal/External camera parameters' as RealityScan has them."
        )
    return cameras


def _focal_column(names: list[str], file: Path) -> str:
    """Which focal length of a table is read: in pixels with a matrix, else in millimetres with angles."""
    lacking = {focal: [name for name in _NEEDED[focal] if name not in names] for focal in ("fpix", "f")}
    complete = [focal for focal, missing in lacking.items() if not missing]
    if not complete:
        missing = lacking["fpix" if "fpix" in names else "f"]
        raise CaptureError(f"{file}: has no column {', '.join(missing)}. {_AGAIN}")
    return complete[0]


def _row_camera(row: dict[str, str], focal: str, delimiter: str, file: Path) -> RegisteredCamera:
    """The camera of a row that has all columns that are needed. Raises ValueError for what is no number."""

    def number(key: str) -> float:
        value = float(row[key].replace(",", ".") if delimiter == ";" else row[key])
        if not np.isfinite(value):
            raise ValueError(f"{key} is {row[key].strip()}")
        return value

    if focal == "fpix":
        values = list(map(number, _MATRIX))
        pose = to_rigid(np.column_stack([np.reshape(values[3:], (3, 3)), values[:3]]), file, row["name"].strip())
    else:
        east, north, up, heading, pitch, roll = map(number, _POSE)
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = axis_rotation(2, -heading) @ axis_rotation(0, pitch) @ axis_rotation(1, roll)
        world_from_camera[:3, 3] = east, north, up
        pose = np.linalg.inv(world_from_camera @ OPENGL_FROM_OPENCV)
    lens = {key: number(column) for key, column in _TERMS[focal].items() if row.get(column, "").strip()}
    return RegisteredCamera(
        name=row["name"].strip(), camera_from_world=pose, focal_35mm=number(focal), lens=lens,
        in_pixels=focal == "fpix",
    )  # fmt: skip


def _xmp_below(folder: Path, deep: bool = True) -> list[Path]:
    """The XMP files in a folder, and in those below it."""
    return sorted((folder.rglob if deep else folder.glob)("*.[xX][mM][pP]"))


def _is_xmp(file: Path) -> bool:
    return _NAMESPACE in read_head(file, 4 * _HEAD_BYTES)


def read_xmp(file: Path) -> RegisteredCamera | str:
    """The camera in an XMP, named without a suffix; why there is none where it cannot be used, and nothing ("") where
    the photograph was not aligned."""
    found = {key: value for element in read_xml(file).iter() for key, value in _properties(element)}
    model = found.get("DistortionModel", "").lower()
    if "Rotation" not in found or "Position" not in found:
        return ""
    projection = found.get("ProjectionModel", "perspective").lower()
    if projection not in ("", "perspective"):
        return f"the projection {projection!r} is not supported"

    def numbers(key: str, count: int | None) -> list[float]:
        return xml_numbers(found[key], count, file, f"xcr:{key}")

    terms = numbers("DistortionCoeficients", None) if "DistortionCoeficients" in found else []
    if model not in _BROWN_MODELS and any(terms):
        return f"the lens model {model!r} is not supported"
    if len(terms) > len(_LENS[2:]):
        raise CaptureError(f"{file}: xcr:DistortionCoeficients has {len(terms)} numbers. {_AGAIN}")

    def number(key: str, default: float) -> float:
        return numbers(key, 1)[0] if key in found else default

    if "FocalLength35mm" not in found:
        raise CaptureError(f"{file}: has no xcr:FocalLength35mm. Export the XMP with the camera's calibration.")
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(numbers("Rotation", 9), (3, 3))
    pose[:3, 3] = -pose[:3, :3] @ numbers("Position", 3)
    bent = terms if model != "perspective" else []  # other programs leave out those at the end
    lens = dict(zip(_LENS[2:], [*bent, *[0.0] * 6], strict=False))
    lens |= {"px": number("PrincipalPointU", 0.0), "py": number("PrincipalPointV", 0.0)}
    lens |= {"aspect": number("AspectRatio", 1.0), "skew": number("Skew", 0.0)}
    pose = to_rigid(pose, file, "xcr:Rotation")
    return RegisteredCamera(
        name=file.stem, camera_from_world=pose, focal_35mm=number("FocalLength35mm", 0.0), lens=lens,
        component=found.get("ComponentId", ""),
    )  # fmt: skip


def _properties(element: Element) -> list[tuple[str, str]]:
    """What an element says as attributes, and as its own text: RealityScan writes either."""
    said = [(key.rpartition(":")[2], value) for key, value in element.attrib.items()]
    return [*said, (element.tag.rpartition(":")[2], element.text)] if element.text and element.text.strip() else said
