"""BlocksExchange XML, by which ContextCapture (iTwin Capture) and DJI Terra hand on aligned photographs.

Bentley's description is followed: pixels count from the center of the first one; rotations lead from the world to the
camera's axes, which CameraOrientation names; P1 and P2 are OpenCV's p2 and p1; the second focal length is the first
times AspectRatio; fisheyes count angles in quarter turns; poses and points are in the coordinate system of the block, x
east or longitude.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic, UnknownSystem, is_in_degrees, to_geodetic, unit_without_heights
from vdgs.captures.formats.block_rotations import ASK_FOR_MATRIX, TwoWays, block_rotation, has_roll, told_by_points
from vdgs.captures.formats.brown_lens import brown_intrinsics, quarter_turn_fisheye
from vdgs.captures.formats.camera_bands import color_cameras
from vdgs.captures.formats.project import CloudFrame, Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.surveyed_points import survey_note
from vdgs.captures.formats.terra import local_origin, original_names, warn_of_undistorted
from vdgs.captures.formats.xml_documents import files_ending, holds, read_xml, root_element, xml_number, xml_numbers
from vdgs.captures.system_names import is_local_system
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center, camera_centers
from vdgs.geometry.geodesy import geodetic_from_enu

#: Camera axes (right, down, forward) from those that CameraOrientation names: where its x and y point in the picture.
_DIRECTIONS = {"Right": (1, 0), "Left": (-1, 0), "Down": (0, 1), "Up": (0, -1)}
#: Where DJI Terra puts its files in a project.
_TERRA_FOLDER = "AT"
_WITHOUT_POINTS = "_withouttiepoints"
#: Terms of the distortion of a lens that is no fisheye.
_TERMS = ("K1", "K2", "K3", "P1", "P2")
#: Measurements of tie points that are kept, of each photograph: more than are looked at afterwards.
_MEASUREMENTS = 4000


def is_file(file: Path) -> bool:
    return file.suffix.lower() in (".xml", ".xmlz") and root_element(file) == "BlocksExchange"


def find_files(root: Path) -> list[Path]:
    """The files in a folder, and where DJI Terra puts them below it; without those that another holds with points."""
    folders = [folder for folder in (root, root / _TERRA_FOLDER) if folder.is_dir()]
    files = [file for folder in folders for file in files_ending(folder, ".xml", ".xmlz") if is_file(file)]
    found = [file for file in files if holds(file, b"<Rotation>")]
    whole = {file.with_suffix("").as_posix().lower() for file in found}
    return [
        file for file in found
        if not (stem := file.with_suffix("").as_posix().lower()).endswith(_WITHOUT_POINTS)
        or stem.removesuffix(_WITHOUT_POINTS) not in whole
    ]  # fmt: skip


def read(file: Path, options: CaptureOptions) -> Project:
    """The photographs of a block that have whole poses, and its tie points. Raises `CaptureError` for damaged files,
    lenses and systems that are not read, and several blocks."""
    return _Block(file).project(original_names(file, options))


@dataclass(frozen=True, eq=False)
class _Photo:
    name: str
    intrinsics: Intrinsics
    pose: np.ndarray
    bands: tuple[str, ...]
    """What the file calls them; none where it says nothing."""
    other_roll: np.ndarray | None = None
    """Its pose with the roll turned the other way, where the file has one."""
    sightings: tuple[list[int], list[tuple[float, float]]] = field(default_factory=lambda: ([], []))


class _Block:
    """A file, read in one go: photographs come before tie points, which are dropped as they are read."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._photos: dict[str, _Photo] = {}
        self._without_pose: list[str] = []
        self._refused: dict[str, list[str]] = {}
        self._masks, self._control_points, self._unknown = 0, 0, ""
        self._points, self._colors = array("d"), array("d")
        self._systems: set[str] = set()
        handlers = {"Photogroup": self._photogroup, "TiePoint": self._tie_point, "ControlPoint": self._control_point}
        self._root = read_xml(file, handlers)
        for path in self._root.iterfind("Block/TiePoints/Path"):
            points = PurePosixPath((path.text or "").strip().replace("\\", "/")).name
            read_xml(file.parent / points, handlers, fragment=True)

    def project(self, originals: dict[str, str]) -> Project:
        blocks = self._root.findall("Block")
        if len(blocks) > 1:
            raise CaptureError(f"{self._file}: holds {len(blocks)} blocks. Export one alone.")
        warnings = self._leave_out_bands() + self._settle_roll()
        geodetic, in_degrees, place, frames = self._system(blocks[0] if blocks else None)
        self._without_pose += map(_path, self._root.iterfind("Block/BulkPhotos/Photo"))
        if self._without_pose:
            names = ", ".join(self._without_pose)
            warnings.append(f"{len(self._without_pose)} photographs are not oriented and are left out ({names}).")
        views = tuple(self._view(photo, originals) for photo in self._photos.values())
        if self._masks:
            warnings.append(f"{self._masks} masks that the file names are not read; those in masks/ are (--masks).")
        warnings += warn_of_undistorted(self._file, views, originals)
        warnings += survey_note(self._control_points, "control points", "")
        return Project(
            format="blocks-exchange", file=self._file, views=views,
            points=np.array(self._points).reshape(-1, 3),
            colors=np.clip(np.round(255 * np.array(self._colors).reshape(-1, 3)), 0, 255).astype(np.uint8),
            to_geodetic=geodetic, in_degrees=in_degrees, is_metric=True, place=place, cloud_frames=frames,
            warnings=tuple(warnings), refused=self._refused, unknown_system=self._unknown,
        )  # fmt: skip

    def _leave_out_bands(self) -> list[str]:
        """Keep the photographs in color; what is to be said of the others."""
        in_color, warnings = color_cameras([(photo.name, photo.bands) for photo in self._photos.values()])
        self._photos = dict(compress(self._photos.items(), in_color))
        return warnings

    def _refuse(self, error: CaptureError, photos: Iterable[Element]) -> None:
        why = str(error).removeprefix(f"{self._file}: ").rstrip(".")
        self._refused.setdefault(why, []).extend(map(_path, photos))

    def _view(self, photo: _Photo, originals: dict[str, str]) -> ProjectView:
        numbers, pixels = photo.sightings
        original = originals.get(PurePosixPath(photo.name.replace("\\", "/")).stem.lower())
        return ProjectView(
            names=(photo.name, original) if original else (photo.name,), camera_from_world=photo.pose,
            intrinsics=photo.intrinsics,
            sightings=(np.array(numbers, np.int64), np.array(pixels, np.float64).reshape(-1, 2)) if numbers else None,
        )  # fmt: skip

    def _control_point(self, _: Element) -> None:
        """Only counted: poses are mostly adjusted to them already."""
        self._control_points += 1

    # ------------------------------------------------------------------------------------- photographs

    def _photogroup(self, group: Element) -> None:
        label = f"photogroup {(group.findtext('Name') or '').strip()!r}"
        self._note_system(group)
        posed: list[Element] = []
        is_used = not _is_false(group, "ManualPose")
        for photo in group.findall("Photo"):
            if is_used and _is_posed(photo):
                posed.append(photo)
            else:
                self._without_pose.append(_path(photo))
        if not posed:
            return
        try:
            intrinsics = self._lens(group, label)
        except CaptureError as error:
            self._refuse(error, posed)
            return
        axes, band = self._axes(group, label), (group.findtext("CameraModelBand") or "").strip()
        for photo in posed:
            self._photo(photo, intrinsics, axes, (band,) if band else ())

    def _photo(self, photo: Element, intrinsics: Intrinsics, axes: np.ndarray, bands: tuple[str, ...]) -> None:
        name = _path(photo)
        self._masks += photo.find("MaskPath") is not None
        number = (photo.findtext("Id") or f"#{len(self._photos)}").strip()
        if number in self._photos:
            raise CaptureError(f"{self._file}: two photographs have the number {number}. Export the block again.")
        element: Element = photo.find("Pose/Rotation")  # type: ignore[assignment]
        center = self._place(photo.find("Pose/Center"), f"the center of {name}")
        try:
            rotations = [axes @ block_rotation(element, self._file, roll) for roll in (1, -1)]
        except CaptureError as error:
            self._refuse(error, [photo])
            return
        poses = [to_rigid(np.column_stack([each, np.zeros(3)]), self._file, name) for each in rotations]
        for pose in poses:
            pose[:3, 3] = -pose[:3, :3] @ center
        other_roll = poses[1] if has_roll(element, self._file) else None
        self._photos[number] = _Photo(name, intrinsics, poses[0], bands, other_roll)

    def _place(self, element: Element | None, label: str) -> list[float]:
        if element is None:
            raise CaptureError(f"{self._file}: {label} is missing. Export the block again.")
        return [xml_number(element, axis, self._file, label) for axis in "xyz"]

    def _settle_roll(self) -> list[str]:
        """Give rolled photographs the pose that tie points agree with, or refuse them; what is to be said of it."""
        points = np.array(self._points).reshape(-1, 3)
        rolled = {number: photo for number, photo in self._photos.items() if photo.other_roll is not None}
        way, errors = told_by_points(
            TwoWays(photo.intrinsics, (photo.pose, photo.other_roll), (points[photo.sightings[0]],) * 2,  # type: ignore[arg-type]
                    np.reshape(photo.sightings[1], (-1, 2)))
            for photo in rolled.values()
        )  # fmt: skip
        for number, photo in rolled.items():
            if way is None:
                why = f"the rotation has a Roll, {ASK_FOR_MATRIX}; or export it with its tie points, which tell"
                self._refused.setdefault(why, []).append(self._photos.pop(number).name)
            elif way == 1 and photo.other_roll is not None:
                self._photos[number] = replace(photo, pose=photo.other_roll)
        if way is None or not rolled:
            return []
        turns = ("clockwise", "counter-clockwise")[way]
        return [
            f"Roll is taken to turn cameras {turns}, seen from behind: tie points are {errors[way]:.2f} px off, and "
            f"{errors[1 - way]:.2f} px the other way."
        ]

    # ------------------------------------------------------------------------------------------ lenses

    def _lens(self, group: Element, label: str) -> Intrinsics:
        if _is_false(group, "ManualOpticalParams"):
            raise CaptureError(
                f"{label} leaves its lens to the program (ManualOpticalParams false): export it aligned."
            )
        kind = (group.findtext("CameraModelType") or "Perspective").strip()
        if kind not in ("Perspective", "Fisheye"):
            raise CaptureError(f"{label} is {kind!r}; Perspective and Fisheye are read.")
        size = group.find("ImageDimensions")
        if size is None:
            raise CaptureError(f"{label} has no ImageDimensions.")
        width, height = (int(xml_number(size, side, self._file, label)) for side in ("Width", "Height"))
        longer = max(width, height, 1)
        pixel = xml_number(group, "PixelSize", self._file, label, 0.0)
        pixel = pixel or xml_number(group, "SensorSize", self._file, label, 0.0) / longer
        focal = xml_number(group, "FocalLengthPixels", self._file, label, 0.0)
        if not focal and (kind == "Perspective" or group.find("FisheyeFocalMatrix") is None):
            if not pixel > 0:
                raise CaptureError(f"{label} has neither FocalLengthPixels nor FocalLength with SensorSize.")
            focal = xml_number(group, "FocalLength", self._file, label) / pixel
        aspect = xml_number(group, "AspectRatio", self._file, label, 1.0)
        center = self._center(group, (width, height), pixel, label)
        if kind == "Fisheye":
            lens = self._fisheye(group, focal, center, (width, height), label)
            return check_intrinsics(lens, self._file, label)
        bends = group.find("Distortion")
        k1, k2, k3, p1, p2 = (
            0.0 if bends is None else xml_number(bends, name, self._file, label, 0.0) for name in _TERMS
        )
        others = [each.tag for each in (() if bends is None else bends) if each.tag not in _TERMS]
        if bends is not None and any(xml_number(bends, name, self._file, label, 0.0) for name in others):
            raise CaptureError(f"{label} has distortion that is not known ({', '.join(others)}).")
        skew = xml_number(group, "Skew", self._file, label, 0.0)
        lens = brown_intrinsics((focal, focal * aspect), center, (width, height), (k1, k2, k3), (p2, p1), skew)
        return check_intrinsics(lens, self._file, label)

    def _fisheye(
        self, group: Element, focal: float, center: tuple[float, float], size: tuple[int, int], label: str
    ) -> Intrinsics:
        """A matrix counts in pixels per quarter turn; a focal length is that of an equidistant lens, per radian."""
        matrix, bends = group.find("FisheyeFocalMatrix"), group.find("FisheyeDistortion")
        quarter = focal * np.pi / 2
        affine, polynomial = [quarter, 0.0, 0.0, quarter], [0.0, 1.0, 0.0, 0.0, 0.0]
        if matrix is not None:
            affine = [xml_number(matrix, f"M_{at}", self._file, label) for at in ("00", "01", "10", "11")]
        if bends is not None:
            polynomial = [
                xml_number(bends, f"P{power}", self._file, label, default) for power, default in enumerate(polynomial)
            ]
        lens = quarter_turn_fisheye(affine, center, size, polynomial)
        if lens is None:
            raise CaptureError(f"{label} is a fisheye with P0 = {polynomial[0]:g} and P1 = {polynomial[1]:g}.")
        return lens

    def _center(
        self, group: Element, size: tuple[int, int], pixel: float, label: str
    ) -> tuple[float, float]:  # fmt: skip
        """The principal point, from the corner of the picture."""
        element, (width, height) = group.find("PrincipalPoint"), size
        if element is None:
            return width / 2, height / 2
        if element.find("xmm") is not None:
            if not pixel > 0:
                raise CaptureError(f"{label} has a principal point in millimetres, and no SensorSize.")
            across = [xml_number(element, name, self._file, label) / pixel for name in ("xmm", "ymm")]
            x, y = self._axes(group, label)[:2, :2] @ across
            return width / 2 + x, height / 2 + y
        x, y = (xml_number(element, name, self._file, label) for name in "xy")
        return x + 0.5, y + 0.5

    def _axes(self, group: Element, label: str) -> np.ndarray:
        """Right, down, forward [3, 3] from the axes that CameraOrientation names."""
        name = (group.findtext("CameraOrientation") or "XRightYDown").strip()
        x, _, y = name.removeprefix("X").partition("Y")
        if x not in _DIRECTIONS or y not in _DIRECTIONS or np.dot(_DIRECTIONS[x], _DIRECTIONS[y]):
            raise CaptureError(f"{self._file}: {label} has the CameraOrientation {name!r}, which is none.")
        across = np.column_stack([(*_DIRECTIONS[x], 0.0), (*_DIRECTIONS[y], 0.0)])
        return np.column_stack([across, np.cross(across[:, 0], across[:, 1])])

    # -------------------------------------------------------------------------------------- tie points

    def _tie_point(self, element: Element) -> None:
        self._note_system(element)
        place = element.find("Position")
        if place is None:
            return
        number = len(self._points) // 3
        self._points.extend(self._place(place, f"tie point {number}"))
        color = element.find("Color")
        self._colors.extend(
            [0.5] * 3 if color is None
            else [xml_number(color, name, self._file, "a color", 0.5) for name in ("Red", "Green", "Blue")]
        )  # fmt: skip
        for seen in element.findall("Measurement"):
            photo = self._photos.get((seen.findtext("PhotoId") or "").strip())
            if photo is not None and seen.find("x") is not None and len(photo.sightings[0]) < _MEASUREMENTS:
                pixel = [xml_number(seen, axis, self._file, f"tie point {number}") + 0.5 for axis in "xy"]
                photo.sightings[0].append(number)
                photo.sightings[1].append((pixel[0], pixel[1]))

    # ------------------------------------------------------------------------------------------- place

    def _note_system(self, element: Element) -> None:
        if (found := element.findtext("SRSId")) is not None:
            self._systems.add(found.strip())

    def _system(self, block: Element | None) -> tuple[ToGeodetic | None, bool, str, tuple[CloudFrame, ...]]:
        """What brings coordinates to latitude, longitude and height, whether they are degrees, how the system is called
        and what points beside the file may be in."""
        for element in [] if block is None else [block, *block.findall("TiePoints"), *block.findall("Photogroups")]:
            self._note_system(element)
        if len(self._systems) > 1:
            raise CaptureError(
                f"{self._file}: mixes the coordinate systems {', '.join(sorted(self._systems))}. Export it in one."
            )
        number = next(iter(self._systems), None)
        defined = {
            (srs.findtext("Id") or "").strip(): (srs.findtext("Definition") or srs.findtext("Name") or "").strip()
            for srs in self._root.iter("SRS")
        }
        definition = defined.get(number or "", "")
        if number is not None and not definition:
            raise CaptureError(f"{self._file}: the coordinate system {number} is not defined. Export it again.")
        if number is None or is_local_system(definition):
            return None, False, "BlocksExchange, local coordinates", ()
        if definition.upper().startswith("ENU:"):
            return self._enu(definition)
        try:
            geodetic, name = to_geodetic(definition, self._file, "its SRS")
            if self._has_heights_as_xy(unit_without_heights(definition)):
                geodetic, name = to_geodetic(definition, self._file, "its SRS", heights_as_xy=True)
        except UnknownSystem:
            if self._seems_degrees():
                raise
            self._unknown = definition
            return None, False, "", ()
        origin = local_origin(self._file)
        frames: tuple[CloudFrame, ...] = ()
        if origin is not None:
            frames = ((f"of {name}, about SRSOrigin", lambda points: geodetic(points + origin)),)
        return geodetic, is_in_degrees(definition), f"BlocksExchange, {name}", frames

    def _has_heights_as_xy(self, unit: float) -> bool:
        """Whether tie points tell that z is in the `unit` (metres) of x and y, and not in metres."""
        if unit == 1:
            return False
        to_meters, points = np.array([unit, unit, 1.0]), np.array(self._points).reshape(-1, 3)
        ways = []
        for photo in self._photos.values():
            in_meters, shown = photo.pose.copy(), points[photo.sightings[0]]
            turn, center = photo.pose[:3, :3], camera_center(photo.pose)
            in_meters[:3, 3] = -turn @ (center * to_meters)
            pixels = np.reshape(photo.sightings[1], (-1, 2))
            ways.append(TwoWays(photo.intrinsics, (in_meters, photo.pose), (shown * to_meters, shown), pixels))
        return told_by_points(ways)[0] == 1

    def _seems_degrees(self) -> bool:
        poses = np.array([photo.pose for photo in self._photos.values()]).reshape(-1, 4, 4)
        centers = camera_centers(poses)
        return bool(
            len(centers) and (np.abs(centers[:, :2]) <= (180, 90)).all() and (np.ptp(centers, axis=0)[:2] < 1).all()
        )

    def _enu(self, definition: str) -> tuple[ToGeodetic, bool, str, tuple[CloudFrame, ...]]:
        """Metres about a place that the definition gives: `ENU:latitude,longitude`, at times with a height."""
        numbers = [*xml_numbers(definition[4:], None, self._file, f"the system {definition!r}"), 0.0]
        if len(numbers) not in (3, 4) or abs(numbers[0]) > 90:
            raise CaptureError(f"{self._file}: the system {definition!r} must give latitude and longitude.")
        origin = (numbers[0], numbers[1], numbers[2])
        return (lambda points: geodetic_from_enu(points, origin)), False, f"BlocksExchange, {definition}", ()


def _path(photo: Element) -> str:
    return (photo.findtext("ImagePath") or f"photograph {photo.findtext('Id') or '?'}").strip()


def _is_posed(photo: Element) -> bool:
    """Whether a photograph is oriented: in the main component, with a rotation and a center that are no guesses."""
    if (photo.findtext("Component") or "1").strip() != "1":
        return False
    rotation, center = photo.find("Pose/Rotation"), photo.find("Pose/Center")
    if rotation is None or center is None:
        return False
    if _is_false(rotation, "Accurate") or _is_false(center, "Accurate"):
        return False
    return all((center.findtext(axis) or "").strip() for axis in "xyz")


def _is_false(element: Element, tag: str) -> bool:
    return (element.findtext(tag) or "").strip().lower() == "false"
