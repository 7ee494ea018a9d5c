"""Metashape's own projects: .psx with its folder of zips, and .psz, a zip of it all.

The chunks in them are those of cameras.xml. The frames name the photographs, and hold the tie points: points by number
in the chunk's coordinates, and for each camera the pixels, from the corner, of the points that it shows.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.formats.metashape_markers import Marks, marks_of
from vdgs.captures.formats.ply_reader import GRAY, read_vertices, vertex_colors
from vdgs.captures.formats.xml_documents import holds, read_xml
from vdgs.errors import CaptureError

PROJECTS = (".psx", ".psz")
#: Longer lists of points are not read.
MAX_BYTES = 1 << 31
#: What an export of the cameras, and a chunk, holds where photographs are aligned.
ALIGNED = (b"<camera ", b"<transform>")
#: Lists the chunks, in the folder of a .psx.
_LIST = "project.zip"
_REMEDY = "Copy it again, or export the cameras (File > Export > Export Cameras, Agisoft XML)."


@dataclass(frozen=True, eq=False)
class TiePoints:
    """Points [n, 3] in the chunk's coordinates, colors [n, 3] uint8, and by camera the points that it shows: indices
    [m] and pixels [m, 2]."""

    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class StoredChunk:
    """A chunk, whether a person worked on it last, the paths of its photographs by camera, what reads its tie points,
    and the marks of its markers in its photographs."""

    element: Element
    is_active: bool = False
    photographs: dict[str, str] = field(default_factory=dict)
    tie_points: Callable[[], TiePoints] = TiePoints
    marks: Marks = field(default_factory=dict)


def is_aligned(file: Path) -> bool:
    """Whether a project has all that is read of it, and photographs that are aligned."""
    if file.suffix.lower() == ".psz":
        return holds(file, *ALIGNED)
    folder = _folder(file)
    return (folder / _LIST).is_file() and any(holds(chunk, *ALIGNED) for chunk in folder.glob("*/chunk.zip"))


def read_chunks(file: Path) -> list[StoredChunk]:
    """The chunks of a project. Raises `CaptureError` for one whose folder of files is not there, and damaged files."""
    if file.suffix.lower() == ".psz":
        root = read_xml(file)
        active = _active(root)
        return [
            _stored(chunk, chunk.get("id") == active, chunk.find("frames/frame"), file) for chunk in root.iter("chunk")
        ]
    folder = _folder(file)
    if not (folder / _LIST).is_file():
        raise CaptureError(
            f"{file}: is only a pointer to {folder.name}, which is not beside it whole. Copy that folder there too, or "
            "export the cameras (File > Export > Export Cameras, Agisoft XML)."
        )
    document, found = read_xml(folder / _LIST), []
    active = _active(document)
    for listed in document.iter("chunk"):
        zipped = folder / _inside(listed.get("path") or f"{listed.get('id')}/chunk.zip", file)
        chunk = read_xml(zipped)
        frame = chunk.find("frames/frame")
        path = zipped.parent / _inside((frame.get("path") if frame is not None else None) or "0/frame.zip", file)
        frame = read_xml(path) if path.is_file() else None
        points = _tie_points(path.parent, frame, file)
        found.append(_stored(chunk, listed.get("id") == active, frame, points))
    return found


def _tie_points(folder: Path, frame: Element | None, file: Path) -> Path | None:
    """The archive of tie points that a frame in a folder names; else by its usual name. None where there is none."""
    cloud = frame.find("point_cloud") if frame is not None else None
    if cloud is not None and cloud.get("path"):
        named = folder / _inside(cloud.get("path", ""), file)
        return named if named.is_file() else None
    return next(iter(sorted(folder.glob("point_cloud*/point_cloud.zip"))), None)


def _folder(file: Path) -> Path:
    return file.with_suffix(".files")


def _inside(path: str, file: Path) -> str:
    parts = Path(path.replace("\\", "/")).parts
    if not parts or ".." in parts or parts[0] == "/" or ":" in parts[0]:
        raise CaptureError(f"{file}: names the file {path!r}, which is not inside the project. {_REMEDY}")
    return "/".join(parts)


def _active(document: Element) -> str | None:
    chunks = next(document.iter("chunks"), None)
    return chunks.get("active_id") if chunks is not None else None


def exported_chunk(chunk: Element) -> StoredChunk:
    """A chunk of an export of cameras."""
    marks = marks_of(chunk.find("frames/frame"))
    _drop_frames(chunk)
    return StoredChunk(chunk, marks=marks)


def _drop_frames(chunk: Element) -> None:
    for frames in chunk.findall("frames"):
        chunk.remove(frames)  # their cameras are those of the chunk once more


def _stored(chunk: Element, is_active: bool, frame: Element | None, archive: Path | None) -> StoredChunk:
    photographs: dict[str, str] = {}
    for camera in frame.iterfind("cameras/camera") if frame is not None else ():
        photo = camera.find("photo")
        if photo is not None and photo.get("path"):
            photographs[camera.get("camera_id", "")] = photo.get("path", "")
    _drop_frames(chunk)
    cloud = frame.find("point_cloud") if frame is not None and archive is not None else None

    def tie_points() -> TiePoints:
        if archive is None:
            return TiePoints()
        manifest = cloud if archive.suffix.lower() == ".psz" else read_xml(archive)
        return TiePoints() if manifest is None else _read_points(archive, manifest)

    return StoredChunk(chunk, is_active, photographs, tie_points, marks_of(frame))


def _read_points(archive: Path, manifest: Element) -> TiePoints:
    """Tie points of all components; those of a file that is not there are left out."""
    try:
        with zipfile.ZipFile(archive) as zipped:

            def table(element: Element, *needs: str) -> tuple[np.ndarray, Mapping[str, str]] | None:
                name = element.get("path", "")
                if name not in zipped.namelist() or zipped.getinfo(name).file_size > MAX_BYTES:
                    return None
                return read_vertices(zipped.read(name), archive, needs)

            def vertices(element: Element, *needs: str) -> np.ndarray | None:
                read = table(element, *needs)
                return None if read is None else read[0]

            clouds = [vertices(each, "x", "y", "z", "id") for each in manifest.findall("points")]
            known = [cloud for cloud in clouds if cloud is not None]
            if not known:
                return TiePoints()
            points = np.concatenate([np.stack([cloud[axis] for axis in "xyz"], axis=1) for cloud in known])
            numbers = np.concatenate([cloud["id"] for cloud in known]).astype(np.int64)
            numbers, first = np.unique(numbers, return_index=True)
            colors = np.full((len(numbers), 3), GRAY, np.uint8)
            tracks = next((table(each, "red", "green", "blue") for each in manifest.findall("tracks")), None)
            if tracks is not None and len(numbers) and numbers[0] >= 0 and numbers[-1] < len(tracks[0]):
                colors = vertex_colors(tracks[0][numbers], tracks[1])
            shown = {}
            for element in manifest.findall("projections"):
                seen = vertices(element, "x", "y", "id")
                if seen is not None and len(numbers):
                    at = np.searchsorted(numbers, seen["id"].astype(np.int64)).clip(0, len(numbers) - 1)
                    good = numbers[at] == seen["id"]
                    pixels = np.stack([seen["x"], seen["y"]], axis=1)[good].astype(np.float64)
                    shown[element.get("camera_id", "")] = (at[good], pixels)
            return TiePoints(points[first].astype(np.float64), colors, shown)
    except (OSError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise CaptureError(f"{archive}: is no zip file that can be read ({error}). {_REMEDY}") from None
