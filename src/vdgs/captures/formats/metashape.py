"""Metashape's cameras.xml (File > Export > Export Cameras, Agisoft XML), and the chunks of its projects: sensors,
cameras, and where the chunk lies.

A camera's `transform` is camera to chunk, OpenCV's axes; that of a slave is its master's, times where its sensor is in
the master's axes. The transform of the component, or of the chunk, leads on to Earth-centred metres of the datum of the
chunk's coordinate system, or to local metres. An export holds no tie points. What it says of masks, regions and
depth maps is not used, and markers are only compared with the poses.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic, UnknownSystem, geocentric_to_geodetic, to_geodetic
from vdgs.captures.formats.brown_lens import brown_intrinsics, fisheye_intrinsics
from vdgs.captures.formats.camera_bands import color_cameras
from vdgs.captures.formats.metashape_markers import marker_note
from vdgs.captures.formats.metashape_project import (
    ALIGNED,
    PROJECTS,
    StoredChunk,
    exported_chunk,
    is_aligned,
    read_chunks,
)
from vdgs.captures.formats.metashape_transforms import ChunkTransforms, is_on_globe
from vdgs.captures.formats.project import CloudFrame, Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import files_ending, holds, read_xml, root_element, xml_number, xml_numbers
from vdgs.captures.system_names import is_local_system
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center
from vdgs.geometry.similarity import Similarity

#: Kinds of lenses that are read, by `type` of a sensor or its calibration.
_PERSPECTIVE, _EQUISOLID = "frame", "equisolid_fisheye"
_FISHEYES = ("fisheye", "equidistant_fisheye", _EQUISOLID)
#: Parts of an export that no reader needs, dropped as they come: they may be long.
_UNUSED = ("shapes", "region", "depth_maps_sets")
_FALSE = ("0", "false")
#: Why cameras are left out, in the order in which they are named.
_UNALIGNED, _OTHER_BANDS, _NO_OFFSET, _DISABLED = _LEFT_OUT = (
    "are not aligned",
    "show other bands than the masters of their multi-camera systems",
    "belong to a multi-camera system whose file does not say where their sensors are",
    "are disabled",
)


def is_file(file: Path) -> bool:
    if file.suffix.lower() in PROJECTS:
        return root_element(file) == "document"
    return file.suffix.lower() == ".xml" and root_element(file) == "document"


def find_files(root: Path) -> list[Path]:
    """The whole project of aligned photographs in a folder, which has tie points; else the exports of aligned cameras;
    of several projects without any, all. An export also says which of several chunks is meant, where the project does
    not."""
    projects, exports = _projects_in(root), _exports_in(root)
    is_clear = len(projects) == 1 and (not exports or _tells_chunk(projects[0]))
    return projects if is_clear else exports or projects


def _tells_chunk(project: Path) -> bool:
    """Whether a project can be read, and says which of its chunks is meant."""
    try:
        _chosen_chunk(read_chunks(project), project)
    except CaptureError:
        return False
    return True


def _projects_in(folder: Path) -> list[Path]:
    return [file for file in files_ending(folder, *PROJECTS) if is_file(file) and is_aligned(file)]


def _exports_in(folder: Path) -> list[Path]:
    """Exports of cameras; those of markers and of references hold none that are aligned."""
    return [file for file in files_ending(folder, ".xml") if is_file(file) and holds(file, *ALIGNED)]


def read(file: Path, options: CaptureOptions) -> Project:
    """The aligned cameras of the chunk that has them. Raises `CaptureError` for damaged files and several chunks with
    cameras."""
    if file.suffix.lower() in PROJECTS:
        chunks = read_chunks(file)
    else:
        root = read_xml(file, {name: lambda _: None for name in _UNUSED})
        chunks = [exported_chunk(chunk) for chunk in root.iter("chunk")]
    chunk, notes = _chosen_chunk(chunks, file)
    if file.suffix.lower() in PROJECTS:
        unread = _exports_in(file.parent)
        notes += [f"of {file.name} and {_names(unread)} beside it the project is read."] if unread else []
        return _Chunk(chunk, file, notes).project()
    unread = _projects_in(file.parent)
    notes += [f"{file.name} is read, not {_names(unread)} beside it, which may be newer."] if unread else []
    return replace(_Chunk(chunk, file, notes).project(), with_points=tuple(filter(_tells_chunk, unread)))


def _chosen_chunk(chunks: Sequence[StoredChunk], file: Path) -> tuple[StoredChunk, list[str]]:
    """The chunk with aligned cameras that is meant, and a note on others. Raises CaptureError where there is none, or
    where nothing tells which."""
    aligned = [chunk for chunk in chunks if chunk.element.find(".//camera/transform") is not None]
    if not aligned:
        raise CaptureError(
            f"{file}: no camera of it has a pose. It must be an export of cameras (File > Export > Export Cameras, "
            "Agisoft XML) or a project of photographs that are aligned."
        )
    enabled = [chunk for chunk in aligned if chunk.element.get("enabled", "1") not in _FALSE] or aligned
    active = [chunk for chunk in enabled if chunk.is_active] or enabled
    if len(active) > 1:
        raise CaptureError(
            f"{file}: {len(active)} chunks have cameras ({_labels(active)}). Merge them, or export one alone."
        )
    others = [chunk for chunk in enabled if chunk is not active[0]]
    notes = [f"the active chunk {_labels(active)} is read; {_labels(others)} is not."] if others else []
    return active[0], notes


def _names(files: Sequence[Path]) -> str:
    return ", ".join(file.name for file in files)


def _labels(chunks: Sequence[StoredChunk]) -> str:
    return ", ".join(repr(chunk.element.get("label", "?")) for chunk in chunks)


@dataclass(frozen=True, eq=False)
class _Camera:
    """A camera as the file has it, with the labels of the groups that it is in, its photograph's path where that is
    known, and its master where it is a slave."""

    element: Element
    groups: tuple[str, ...]
    path: str = ""
    master: _Camera | None = None

    @property
    def label(self) -> str:
        return self.element.get("label") or f"camera {self.element.get('id', '?')}"

    @property
    def sensor(self) -> str:
        return self.element.get("sensor_id", "")

    @property
    def is_aligned(self) -> bool:
        return self.element.find("transform") is not None or (self.master is not None and self.master.is_aligned)

    @property
    def component(self) -> str:
        return self.element.get("component_id") or (self.master.component if self.master is not None else "")

    @property
    def names(self) -> tuple[str, ...]:
        """The path; the label with its groups, which often are the folders of the photographs, and alone."""
        named = ("/".join((*self.groups, self.label)), self.label)
        return tuple(dict.fromkeys((self.path, *named) if self.path else named))


class _Chunk:
    def __init__(self, stored: StoredChunk, file: Path, warnings: list[str]) -> None:
        self._element, self._file, self._stored, self._warnings = stored.element, file, stored, warnings
        self._sensors = {sensor.get("id", ""): sensor for sensor in self._element.iter("sensor")}
        self._unknown, self._transforms = "", ChunkTransforms(stored.element, file)
        warnings += self._transforms.warnings

    def project(self) -> Project:
        cameras, place, is_metric = self._placed(self._used(self._cameras()))
        lenses = self._lenses({camera.sensor for camera in cameras})
        ties = self._stored.tie_points()
        refused: dict[str, list[str]] = {}
        views: list[ProjectView] = []
        by_number: dict[str, ProjectView] = {}
        for camera in cameras:
            lens = lenses[camera.sensor]
            try:
                if isinstance(lens, str):
                    raise CaptureError(lens)
                pose = self._pose(camera, self._transform_of(camera))
            except CaptureError as error:
                refused.setdefault(_why(error, self._file), []).append(camera.label)
                continue
            shown = ties.shown.get(camera.element.get("id", ""))
            views.append(ProjectView(names=camera.names, intrinsics=lens, camera_from_world=pose, sightings=shown))
            by_number[camera.element.get("id", "")] = views[-1]
        geodetic, words, frames = (
            self._system(place, views) if is_metric else (None, "", (("of the chunk", place.apply),))
        )
        markers, marks = self._element.iterfind("markers//marker"), self._stored.marks
        self._warnings += marker_note(markers, marks, by_number, self._transforms.wkt, geodetic, self._file)
        return Project(
            format="metashape", file=self._file, views=tuple(views), colors=ties.colors,
            points=place.apply(ties.points), to_geodetic=geodetic,
            is_metric=is_metric, place=words, cloud_frames=frames, warnings=tuple(self._warnings),
            refused=refused, unknown_system=self._unknown,
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------- cameras

    def _cameras(self) -> list[_Camera]:
        found: list[_Camera] = []

        def collect(parent: Element, groups: tuple[str, ...]) -> None:
            for child in parent:
                if child.tag == "camera":
                    path = self._stored.photographs.get(child.get("id", ""), "")
                    found.append(_Camera(child, groups, path))
                elif child.tag == "group":
                    collect(child, (*groups, child.get("label") or ""))

        for parent in self._element.iter("cameras"):
            collect(parent, ())
        masters = {camera.element.get("id"): camera for camera in found}
        return [
            replace(camera, master=masters.get(number))
            if (number := camera.element.get("master_id")) != camera.element.get("id")
            else camera
            for camera in found
        ]

    def _used(self, cameras: list[_Camera]) -> list[_Camera]:
        """Cameras that are aligned, enabled and in color; the others are named."""
        kinds: dict[str, list[_Camera]] = {why: [] for why in ("", *_LEFT_OUT)}
        for camera in cameras:
            kinds[self._why_left_out(camera)].append(camera)
        for why in _LEFT_OUT:
            if some := kinds[why]:
                names = ", ".join(camera.label for camera in some)
                self._warnings.append(f"{len(some)} cameras {why} and are left out ({names}).")
        in_color, warnings = color_cameras([(camera.label, self._bands(camera)) for camera in kinds[""]])
        self._warnings += warnings
        return list(compress(kinds[""], in_color))

    def _bands(self, camera: _Camera) -> tuple[str, ...]:
        sensor = self._sensors.get(camera.sensor)
        return () if sensor is None else tuple(band.get("label") or "" for band in sensor.iterfind("bands/band"))

    def _why_left_out(self, camera: _Camera) -> str:
        """One of `_LEFT_OUT`, or nothing for a camera that is used."""
        if camera.element.get("enabled", "1") in _FALSE:
            return _DISABLED
        is_slave = camera.element.find("transform") is None and camera.master is not None
        if is_slave and not self._shows_what_its_master_does(camera):
            return _OTHER_BANDS
        if not camera.is_aligned:
            return _UNALIGNED
        return _NO_OFFSET if is_slave and not self._offset(camera) else ""

    def _shows_what_its_master_does(self, camera: _Camera) -> bool:
        """Not so for the bands of a multispectral camera, which are no photographs of the scene as people see it."""
        assert camera.master is not None
        own, masters = self._bands(camera), self._bands(camera.master)
        return not own or not masters or own == masters

    def _offset(self, camera: _Camera) -> tuple[str, str] | None:
        """The texts of a slave's rotation and place in its master's axes."""
        sensor = self._sensors.get(camera.sensor)
        found = [sensor.findtext(name) if sensor is not None else None for name in ("rotation", "location")]
        return (found[0], found[1]) if found[0] and found[1] else None

    def _pose(self, camera: _Camera, chunk: Similarity) -> np.ndarray:
        pose = self._camera_to_chunk(camera)
        pose[:3, 3] = chunk.apply(pose[:3, 3])
        pose[:3, :3] = chunk.rotation @ pose[:3, :3]
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = pose[:3, :3].T, camera_center(pose)
        return inverse

    def _camera_to_chunk(self, camera: _Camera) -> np.ndarray:
        element, label = camera.element.find("transform"), f"camera {camera.label!r}"
        if element is not None:
            numbers = xml_numbers(element.text, 16, self._file, f"the transform of {label}")
            if not any(numbers):
                raise CaptureError("its transform is all zeros: align the photographs, and export again")
            return to_rigid(np.array(numbers).reshape(4, 4), self._file, label)
        offset = self._offset(camera)
        assert camera.master is not None
        assert offset is not None
        turn, place = (
            xml_numbers(text, count, self._file, f"the sensor of {label}")
            for text, count in zip(offset, (9, 3), strict=True)
        )
        moved = to_rigid(np.column_stack([np.reshape(turn, (3, 3)), place]), self._file, f"the sensor of {label}")
        return self._camera_to_chunk(camera.master) @ moved

    # -------------------------------------------------------------------------------------------- lenses

    def _lenses(self, used: set[str]) -> dict[str, Intrinsics | str]:
        """The lenses of the sensors that are used, or why one cannot be."""
        lenses: dict[str, Intrinsics | str] = {}
        for number in sorted(used):
            sensor = self._sensors.get(number)
            label = f"sensor {number}" + (f" ({sensor.get('label')})" if sensor is not None else "")
            try:
                if sensor is None:
                    raise CaptureError(f"{self._file}: {label} is missing.")
                lenses[number] = self._lens(sensor, label)
            except CaptureError as error:
                lenses[number] = _why(error, self._file)
        return lenses

    def _lens(self, sensor: Element, label: str) -> Intrinsics:
        calibration = _calibration(sensor)
        kind = (calibration.get("type") if calibration is not None else None) or sensor.get("type") or _PERSPECTIVE
        if kind not in (_PERSPECTIVE, *_FISHEYES):
            raise CaptureError(f"{label} is {kind!r}; {_PERSPECTIVE} and {', '.join(_FISHEYES)} are read.")
        if calibration is None:
            raise CaptureError(f"{label} has no calibration. Export the cameras again after they are aligned.")
        rolling = [sensor.findtext("rolling_shutter") or ""]
        rolling += [each.get("value", "") for each in sensor.iterfind("property[@name='rolling_shutter']")]
        if any(text.strip().lower() not in ("", *_FALSE) for text in rolling):
            self._warnings.append(f"{label}: its rolling shutter is not modelled; poses are those of the middle row.")
        if calibration.find("corrections") is not None:
            self._warnings.append(
                f"{label}: the additional corrections of its lens are not applied, which may be off by some pixels. To "
                "have it exact optimize the cameras without them, and export again."
            )

        def value(name: str, default: float | None = 0.0) -> float:
            return xml_number(calibration, name, self._file, f"the calibration of {label}", default)

        width, height = self._size(sensor, calibration, label)
        radial = tuple(value(f"k{k}") for k in range(1, 5))
        if calibration.find("f") is None:  # PhotoScan before 1.2: from the corner, p1 and p2 as OpenCV's
            focal, skew, growth = (value("fx", None), value("fy", None)), value("skew"), (0.0, 0.0)
            center, tangential = (value("cx", width / 2), value("cy", height / 2)), (value("p1"), value("p2"))
        else:
            focal, skew = (value("f", None) + value("b1"), value("f", None)), value("b2")
            growth = value("p3"), value("p4")
            center, tangential = (width / 2 + value("cx"), height / 2 + value("cy")), (value("p2"), value("p1"))
        if kind == _PERSPECTIVE:
            lens = brown_intrinsics(focal, center, (width, height), radial, tangential, skew, growth)
        elif any(growth):
            raise CaptureError(f"{label} is a fisheye with p3, p4, which are not read: fit the lens without.")
        else:
            powers = [power for k in radial for power in (0.0, k)]
            affine = (focal[0], skew, 0.0, focal[1])
            lens = fisheye_intrinsics(affine, center, (width, height), powers, tangential, equisolid=kind == _EQUISOLID)
        return check_intrinsics(lens, self._file, label)

    def _size(self, sensor: Element, calibration: Element, label: str) -> tuple[int, int]:
        for parent in (calibration, sensor):
            size = parent.find("resolution")
            if size is not None:
                text = f"{size.get('width', '')} {size.get('height', '')}"
                width, height = xml_numbers(text, 2, self._file, f"the resolution of {label}")
                return int(width), int(height)
        raise CaptureError(f"{label} has no resolution. Export the cameras again.")

    # --------------------------------------------------------------------------------------------- place

    def _component(self, camera: _Camera, transforms: Mapping[str, Similarity]) -> str:
        number = camera.component
        if not number and "" not in transforms and len(transforms) == 1:
            return next(iter(transforms))  # older files have one component, which cameras do not name
        return number if number in transforms else ""

    def _transform_of(self, camera: _Camera) -> Similarity:
        """What leads on from the component of a camera; nothing where the file has no transform of it."""
        for transforms in (self._transforms.metric, self._transforms.turns):
            if (found := transforms.get(self._component(camera, transforms))) is not None:
                return found
        return Similarity(1.0, np.eye(3), np.zeros(3))

    def _placed(self, cameras: list[_Camera]) -> tuple[list[_Camera], Similarity, bool]:
        """Cameras of one world, those of most cameras where components hold together by nothing, what leads from it on,
        and whether that is to metres."""
        if not cameras:
            return [], Similarity(1.0, np.eye(3), np.zeros(3)), False
        metric = self._transforms.metric
        components = Counter(camera.component for camera in cameras)
        largest = max(components, key=lambda number: components[number])
        placed = [camera for camera in cameras if self._component(camera, metric) in metric]
        if len(components) > 1:
            kept = placed or [camera for camera in cameras if camera.component == largest]
            known = set(kept)
            lost = [camera.label for camera in cameras if camera not in known]
            if lost:
                self._warnings.append(
                    f"{len(lost)} cameras of other components have no place in the same world and are left out "
                    f"({', '.join(lost)})."
                )
            cameras = kept
        return cameras, self._transform_of(cameras[0]), bool(placed)

    def _system(
        self, chunk: Similarity, views: Sequence[ProjectView]
    ) -> tuple[ToGeodetic | None, str, tuple[CloudFrame, ...]]:
        """What brings the world to latitude, longitude and height, how that is called, and what a point cloud beside
        the export may be in."""
        wkt, centers = self._transforms.wkt, [camera_center(view.camera_from_world) for view in views]
        on_globe = any(map(is_on_globe, (chunk.translation, *centers)))
        if (not wkt and not on_globe) or is_local_system(wkt):
            return None, "Metashape, local coordinates", (("of the chunk", chunk.apply),)
        if not wkt:
            self._warnings.append(
                "the export names no coordinate system; its transform is Earth-centred, as of WGS 84."
            )
            wkt = "EPSG:4326"
        crs, name = None, "WGS 84"
        try:
            geodetic = geocentric_to_geodetic(wkt, self._file)
            if wkt != "EPSG:4326":
                crs, name = to_geodetic(wkt, self._file, "the chunk's reference")
        except UnknownSystem:
            self._unknown = wkt
            if not on_globe:
                return None, "", (("of the chunk", chunk.apply),)
            geodetic = geocentric_to_geodetic("EPSG:4326", self._file)
            frame: CloudFrame = ("of the chunk", lambda points: geodetic(chunk.apply(points)))
            return geodetic, "Metashape, Earth-centred metres, taken for those of WGS 84", (frame,)
        if not on_globe:
            self._warnings.append(
                f"its transform leads to no place on Earth, though the chunk is of {name}: the scene has metres and no "
                "place; --gps TABLE gives one, or references in Metashape, Update Transform, and another export."
            )
            return None, "Metashape, no place on Earth", (("of the chunk", chunk.apply),)
        frames: list[CloudFrame] = [("of the chunk", lambda points: geodetic(chunk.apply(points)))]
        if crs is not None:
            frames.append((f"of {name}", crs))
        return geodetic, f"Metashape, {name}", tuple(frames)


def _why(error: CaptureError, file: Path) -> str:
    return str(error).removeprefix(f"{file}: ").rstrip(".")


def _calibration(sensor: Element) -> Element | None:
    """The adjusted calibration of a sensor, else the only or the initial one; None where none has a focal length."""
    found = [
        each for each in sensor.findall("calibration") if each.find("f") is not None or each.find("fx") is not None
    ]
    rank = {"adjusted": 0, None: 1}
    return min(found, key=lambda each: rank.get(each.get("class"), 2), default=None)
