"""PIX4Dmapper's parameters (1_initial/params): *_calibrated_camera_parameters.txt with lenses and poses of all cameras.

Ten lines for each photograph: its name and size, the camera matrix (3), R1 to R3, T1 and T2 (OpenCV's p1 and p2), the
position t and the rotation R camera from world (3), in axes right, down, forward. *_offset.xyz beside it was taken off
the coordinates of the system that *_wkt.prj names.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic, UnknownSystem, false_origin, to_geodetic
from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.project import CloudFrame, Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import xml_numbers
from vdgs.captures.system_names import is_local_system
from vdgs.captures.text_tables import read_head, read_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center

_ENDING, _HEADER = "_calibrated_camera_parameters.txt", "fileName imageWidth imageHeight"
#: Where PIX4Dmapper puts the file in the folder of a project, which lies beside its .p4d.
_FOLDERS = ("params", "1_initial/params")
_LINES = 10
#: What was taken off positions. Without the file, those nearer to zero than the first are differences where the system
#: has a false origin beyond the second (choice; metres or feet).
_OFFSET, _NEAR, _FALSE_ORIGIN = "_offset.xyz", 20_000.0, 100_000.0


def find_files(root: Path) -> list[Path]:
    with os.scandir(root) as entries:
        inside = sorted(each.name for each in entries if each.is_dir() and os.path.isdir(f"{each.path}/{_FOLDERS[-1]}"))
    folders = [root, *(root / each for each in _FOLDERS), *(root / each / _FOLDERS[-1] for each in inside)]
    return [file for folder in folders for file in sorted(folder.glob(f"*{_ENDING}")) if is_file(file)]


def is_file(file: Path) -> bool:
    return file.suffix.lower() == ".txt" and read_head(file, 4 * len(_HEADER)).startswith(_HEADER)


def read(file: Path, options: CaptureOptions) -> Project:
    """The calibrated cameras of a project. Raises `CaptureError` for damaged files and fisheyes."""
    lines = read_text(file).splitlines()
    head = next((index for index, line in enumerate(lines) if line.startswith("camera model")), None)
    rows = [line.strip() for line in lines[(0 if head is None else head) + 1 :] if line.strip()]
    if head is None or len(rows) % _LINES:
        raise CaptureError(
            f"{file}: does not hold {_LINES} lines for each photograph after its header: it is cut off, or of a "
            "fisheye, which is read from OPF (PIX4Dmatic). Copy or export it again."
        )
    views = tuple(_view(rows[first : first + _LINES], file) for first in range(0, len(rows), _LINES))
    unknown, warnings = "", tuple[str, ...]()
    try:
        system, place, is_metric, frames = _system(file)
    except UnknownSystem as error:
        system, place, is_metric, frames, unknown = None, "", True, (), error.definition
    if system is not None and _is_offset_lost(file, views):
        system, place, is_metric, frames = None, "", False, ()
        warnings = (
            f"{_beside(file, _OFFSET).name} is missing, from which the positions in {file.name} are counted: the scene "
            "has no place on Earth. Copy the file there too.",
        )
    return Project(
        format="pix4d", file=file, views=views, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8),
        to_geodetic=system, is_metric=is_metric, place=place, cloud_frames=frames,
        unknown_system=unknown, warnings=warnings,
    )  # fmt: skip


def _view(block: list[str], file: Path) -> ProjectView:
    name, *size = block[0].rsplit(None, 2)
    label = f"the photograph {name!r}"
    width, height = map(int, xml_numbers(" ".join(size), 2, file, f"the size of {label}"))

    def numbers(first: int, last: int, count: int, what: str) -> list[float]:
        return xml_numbers(" ".join(block[first:last]), count, file, f"{what} of {label}")

    matrix = np.reshape(numbers(1, 4, 9, "the camera matrix"), (3, 3))
    t1, t2 = numbers(5, 6, 2, "the tangential distortion")
    lens = brown_intrinsics(
        (float(matrix[0, 0]), float(matrix[1, 1])), (float(matrix[0, 2]), float(matrix[1, 2])), (width, height),
        numbers(4, 5, 3, "the radial distortion"), (t1, t2), float(matrix[0, 1]),
    )  # fmt: skip
    rotation = np.reshape(numbers(7, 10, 9, "the rotation"), (3, 3))
    pose = to_rigid(np.column_stack([rotation, np.zeros(3)]), file, label)
    pose[:3, 3] = -pose[:3, :3] @ numbers(6, 7, 3, "the position")
    intrinsics: Intrinsics = check_intrinsics(lens, file, label)
    return ProjectView(names=(name,), camera_from_world=pose, intrinsics=intrinsics)


def _system(file: Path) -> tuple[ToGeodetic | None, str, bool, tuple[CloudFrame, ...]]:
    """What brings coordinates to latitude, longitude and height, words about it, whether they are metres, and what a
    point cloud beside them may be in."""
    offset_file, system_file = _beside(file, _OFFSET), _beside(file, "_wkt.prj")
    offset = np.zeros(3)
    if offset_file.is_file():
        offset = np.array(xml_numbers(read_text(offset_file), 3, offset_file, "the offset"))
    wkt = read_text(system_file).strip() if system_file.is_file() else ""
    if not wkt or is_local_system(wkt):
        is_metric = bool(wkt) or bool(offset.any())
        return None, "Pix4D, metres of a system of its own" if is_metric else "", is_metric, ()
    # One camera model holds for x, y and z, which so have one unit.
    change, name = to_geodetic(wkt, system_file, "the file", heights_as_xy=True)
    return lambda points: change(points + offset), f"Pix4D, {name}", False, ((f"of {name}", change),)


def _beside(file: Path, ending: str) -> Path:
    """The file of the same project with another ending."""
    return file.with_name(f"{file.name.removesuffix(_ENDING)}{ending}")


def _is_offset_lost(file: Path, views: Sequence[ProjectView]) -> bool:
    """Whether positions are as near to zero as no place of their system is, without the file that says what they are
    counted from: systems with a false origin are made so that eastings and northings are large."""
    if not views or _beside(file, _OFFSET).is_file():
        return False
    centers = np.stack([camera_center(view.camera_from_world) for view in views])
    if np.abs(np.median(centers[:, :2], axis=0)).max() >= _NEAR:
        return False
    return max(map(abs, false_origin(read_text(_beside(file, "_wkt.prj")).strip()))) >= _FALSE_ORIGIN
