"""Metashape's cameras.xml (File > Export > Export Cameras, Agisoft XML): sensors, cameras, and where the chunk lies.

A camera's `transform` is camera to chunk, OpenCV's axes; that of its component, or of the chunk, leads on to
Earth-centred metres of the datum of the chunk's coordinate system, or to local metres. The file holds no tie points.
What it says of masks, regions, markers and depth maps is not used.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.coordinate_systems import (
    ToGeodetic,
    UnknownSystem,
    geocentric_to_geodetic,
    is_local_system,
    to_geodetic,
)
from vdgs.captures.formats.brown_lens import brown_intrinsics, fisheye_intrinsics
from vdgs.captures.formats.project import CloudFrame, Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import holds, read_xml, root_element, xml_number, xml_numbers
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import SEMI_MAJOR_M
from vdgs.geometry.similarity import Similarity

#: Kinds of lenses that are read, by `type` of a sensor or its calibration.
_PERSPECTIVE, _FISHEYES = "frame", ("fisheye", "equidistant_fisheye")
#: Parts of an export that no reader needs, dropped as they come: they may be long.
_UNUSED = ("frames", "markers", "shapes", "region", "depth_maps_sets")
#: A chunk without a coordinate system whose origin is so far from that of its transform is on the globe (metres).
_ON_GLOBE_M = (SEMI_MAJOR_M - 60_000, SEMI_MAJOR_M + 60_000)
_FALSE = ("0", "false")


def is_file(file: Path) -> bool:
    return file.suffix.lower() == ".xml" and root_element(file) == "document"


def find_files(root: Path) -> list[Path]:
    """The exports of aligned cameras in a folder; those of markers and of references hold none."""
    files = [file for file in sorted(root.iterdir()) if is_file(file)]
    return [file for file in files if holds(file, b"<camera ", b"<transform>")]


def read(file: Path, options: CaptureOptions) -> Project:
    """The aligned cameras of the chunk that has them. Raises `CaptureError` for damaged files and several chunks with
    cameras."""
    root = read_xml(file, {name: lambda _: None for name in _UNUSED})
    aligned = [chunk for chunk in root.iter("chunk") if chunk.find(".//camera/transform") is not None]
    if not aligned:
        raise CaptureError(
            f"{file}: no camera of it has a pose. It must be an export of cameras (File > Export > Export Cameras, "
            "Agisoft XML) of photographs that are aligned."
        )
    enabled = [chunk for chunk in aligned if chunk.get("enabled", "1") not in _FALSE] or aligned
    if len(enabled) > 1:
        labels = ", ".join(repr(chunk.get("label", "?")) for chunk in enabled)
        raise CaptureError(f"{file}: {len(enabled)} chunks have cameras ({labels}). Merge them, or export one alone.")
    return _Chunk(enabled[0], file).project()


@dataclass(frozen=True, eq=False)
class _Camera:
    """A camera as the file has it, with the labels of the groups that it is in."""

    element: Element
    groups: tuple[str, ...]

    @property
    def label(self) -> str:
        return self.element.get("label") or f"camera {self.element.get('id', '?')}"

    @property
    def sensor(self) -> str:
        return self.element.get("sensor_id", "")

    @property
    def names(self) -> tuple[str, ...]:
        """The label with its groups, which often are the folders of the photographs, and alone."""
        return tuple(dict.fromkeys(("/".join((*self.groups, self.label)), self.label)))


class _Chunk:
    def __init__(self, element: Element, file: Path) -> None:
        self._element, self._file = element, file
        self._warnings: list[str] = []
        self._unknown = ""

    def project(self) -> Project:
        cameras, place = self._placed(self._used(self._cameras()))
        lenses = self._lenses({camera.sensor for camera in cameras})
        refused: dict[str, list[str]] = {}
        for camera in cameras:
            if isinstance(why := lenses[camera.sensor], str):
                refused.setdefault(why, []).append(camera.label)
        views = [
            ProjectView(
                names=camera.names, intrinsics=lens,
                camera_from_world=self._pose(camera, self._transforms.get(self._component(camera))),
            )
            for camera in cameras if not isinstance(lens := lenses[camera.sensor], str)
        ]  # fmt: skip
        geodetic, words, frames = self._system(place) if place is not None else (None, "", ())
        return Project(
            format="metashape", file=self._file, views=tuple(views), points=np.zeros((0, 3)),
            colors=np.zeros((0, 3), np.uint8), to_geodetic=geodetic, is_metric=place is not None, place=words,
            cloud_frames=frames, warnings=tuple(self._warnings), refused=refused,
            unknown_system=self._unknown,
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------- cameras

    def _cameras(self) -> list[_Camera]:
        found: list[_Camera] = []

        def collect(parent: Element, groups: tuple[str, ...]) -> None:
            for child in parent:
                if child.tag == "camera":
                    found.append(_Camera(child, groups))
                elif child.tag == "group":
                    collect(child, (*groups, child.get("label") or ""))

        for parent in self._element.iter("cameras"):
            collect(parent, ())
        return found

    def _used(self, cameras: list[_Camera]) -> list[_Camera]:
        """Cameras that are aligned and enabled; the others are named."""
        on: list[_Camera] = []
        off: list[_Camera] = []
        for camera in cameras:
            (off if camera.element.get("enabled", "1") in _FALSE else on).append(camera)
        bare = [camera for camera in on if camera.element.find("transform") is None]
        slaves = {camera for camera in bare if camera.element.get("master_id") not in (None, camera.element.get("id"))}
        for some, what in (
            ([camera for camera in bare if camera not in slaves], "are not aligned"),
            (slaves, "belong to a multi-camera system and have no pose here (Metashape's COLMAP export has it),"),
            (off, "are disabled"),
        ):
            if some:
                names = ", ".join(camera.label for camera in some)
                self._warnings.append(f"{len(some)} cameras {what} and are left out ({names}).")
        return [camera for camera in on if camera.element.find("transform") is not None]

    def _pose(self, camera: _Camera, chunk: Similarity | None) -> np.ndarray:
        element = camera.element.find("transform")
        assert element is not None
        label = f"camera {camera.label!r}"
        numbers = xml_numbers(element.text, 16, self._file, f"the transform of {label}")
        pose = to_rigid(np.array(numbers).reshape(4, 4), self._file, label)
        if chunk is not None:
            pose[:3, 3] = chunk.apply(pose[:3, 3])
            pose[:3, :3] = chunk.rotation @ pose[:3, :3]
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        return inverse

    # -------------------------------------------------------------------------------------------- lenses

    def _lenses(self, used: set[str]) -> dict[str, Intrinsics | str]:
        """The lenses of the sensors that are used, or why one cannot be."""
        sensors = {sensor.get("id", ""): sensor for sensor in self._element.iter("sensor")}
        lenses: dict[str, Intrinsics | str] = {}
        for number in sorted(used):
            sensor = sensors.get(number)
            label = f"sensor {number}" + (f" ({sensor.get('label')})" if sensor is not None else "")
            try:
                if sensor is None:
                    raise CaptureError(f"{self._file}: {label} is missing.")
                lenses[number] = self._lens(sensor, label)
            except CaptureError as error:
                lenses[number] = str(error).removeprefix(f"{self._file}: ").rstrip(".")
        return lenses

    def _lens(self, sensor: Element, label: str) -> Intrinsics:
        calibration = _calibration(sensor)
        kind = (calibration.get("type") if calibration is not None else None) or sensor.get("type") or _PERSPECTIVE
        if kind not in (_PERSPECTIVE, *_FISHEYES):
            raise CaptureError(f"{label} is {kind!r}; {_PERSPECTIVE} and {', '.join(_FISHEYES)} are read.")
        if calibration is None:
            raise CaptureError(f"{label} has no calibration. Export the cameras again after they are aligned.")
        rolling = sensor.find("rolling_shutter")
        if rolling is not None and (rolling.text or "").strip().lower() not in ("", *_FALSE):
            self._warnings.append(f"{label}: its rolling shutter is not modelled; poses are those of the middle row.")

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
            lens = fisheye_intrinsics((focal[0], skew, 0.0, focal[1]), center, (width, height), powers, tangential)
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

    @cached_property
    def _transforms(self) -> dict[str, Similarity]:
        """From each component to the world, and from the chunk ("") in files of versions that know no components."""
        found = {}
        for component in [*self._element.iter("component"), self._element]:
            transform = component.find("transform")
            if transform is not None:
                found[component.get("id", "") if component is not self._element else ""] = self._similarity(transform)
        return found

    def _component(self, camera: _Camera) -> str:
        number = camera.element.get("component_id", "")
        if not number and "" not in self._transforms and len(self._transforms) == 1:
            return next(iter(self._transforms))  # older files have one component, which cameras do not name
        return number if number in self._transforms else ""

    def _placed(self, cameras: list[_Camera]) -> tuple[list[_Camera], Similarity | None]:
        """Cameras of one world, those of most cameras where components hold together by nothing, and what leads from
        it to metres, None where nothing does."""
        if not cameras:
            return [], None
        components = Counter(camera.element.get("component_id", "") for camera in cameras)
        largest = max(components, key=lambda number: components[number])
        placed = [camera for camera in cameras if self._component(camera) in self._transforms]
        if len(components) > 1:
            kept = placed or [camera for camera in cameras if camera.element.get("component_id", "") == largest]
            known = set(kept)
            lost = [camera.label for camera in cameras if camera not in known]
            if lost:
                self._warnings.append(
                    f"{len(lost)} cameras of other components have no place in the same world and are left out "
                    f"({', '.join(lost)})."
                )
            cameras = kept
        return cameras, self._transforms[self._component(cameras[0])] if placed else None

    def _similarity(self, transform: Element) -> Similarity:
        label = "the transform of the chunk"
        if transform.find("rotation") is None and (transform.text or "").strip():
            matrix = np.array(xml_numbers(transform.text, 16, self._file, label)).reshape(4, 4)
            scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
            rotation, translation = matrix[:3, :3] / (scale or 1.0), matrix[:3, 3]
        else:
            texts = {name: transform.findtext(name) for name in ("rotation", "translation", "scale")}
            rotation = np.array(xml_numbers(texts["rotation"] or "1 0 0 0 1 0 0 0 1", 9, self._file, label))
            translation = np.array(xml_numbers(texts["translation"] or "0 0 0", 3, self._file, label))
            scale = xml_numbers(texts["scale"] or "1", 1, self._file, label)[0]
        if not 1e-12 < scale < 1e12:
            raise CaptureError(f"{self._file}: {label} has the scale {scale}. The file is damaged; export it again.")
        rigid = to_rigid(np.column_stack([rotation.reshape(3, 3), np.zeros(3)]), self._file, label)
        return Similarity(scale, rigid[:3, :3], translation)

    def _system(self, chunk: Similarity) -> tuple[ToGeodetic | None, str, tuple[CloudFrame, ...]]:
        """What brings the world to latitude, longitude and height, how that is called, and what a point cloud beside
        the export may be in."""
        reference = next((each for each in self._element.findall("reference") if (each.text or "").strip()), None)
        wkt = (reference.text or "").strip() if reference is not None else ""
        on_globe = _ON_GLOBE_M[0] < float(np.linalg.norm(chunk.translation)) < _ON_GLOBE_M[1]
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
        frames: list[CloudFrame] = [("of the chunk", lambda points: geodetic(chunk.apply(points)))]
        if crs is not None:
            frames.append((f"of {name}", crs))
        return geodetic, f"Metashape, {name}", tuple(frames)


def _calibration(sensor: Element) -> Element | None:
    """The adjusted calibration of a sensor, else the only or the initial one; None where none has a focal length."""
    found = [
        each for each in sensor.findall("calibration") if each.find("f") is not None or each.find("fx") is not None
    ]
    rank = {"adjusted": 0, None: 1}
    return min(found, key=lambda each: rank.get(each.get("class"), 2), default=None)
