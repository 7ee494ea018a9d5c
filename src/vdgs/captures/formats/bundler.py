"""Bundler's bundle.out with the list of its photographs: cameras, points, and which photograph shows which point.

A camera looks along -z with y up; pixels count from the middle of the image, y up. A focal length of zero is a
photograph that has no place. The size of the photographs is not in the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np

from vdgs.captures.formats.aligned_sizes import aligned_sizes
from vdgs.captures.formats.photograph_sizes import name_unaligned
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.captures.text_tables import parse_numbers
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

#: What a file of Bundler begins with; its versions after 0.1 are alike.
HEADER = b"# Bundle file v0."
_LOOKS_BACK = np.diag([1.0, -1.0, -1.0, 1.0])
_CAMERA_NUMBERS, _POINT_NUMBERS, _SIGHTING_NUMBERS = 15, 6, 4
_AGAIN = "The file is damaged or cut off; export it again."


@dataclass(frozen=True, eq=False)
class BundlerCamera:
    """A placed photograph: its number in the list, focal length in pixels, distortion and pose."""

    number: int
    focal: float
    distortion: tuple[float, float]
    camera_from_world: np.ndarray

    def intrinsics(self, size: tuple[int, int], file: Path) -> Intrinsics:
        """The lens at the size of the photograph."""
        width, height = size
        lens = Intrinsics("RADIAL", (self.focal, width / 2, height / 2, *self.distortion), width, height)
        return check_intrinsics(lens, file, f"camera {self.number}")


@dataclass(frozen=True, eq=False, kw_only=True)
class BundlerModel:
    """What the file says. Sightings: of point `seen_point` by camera `seen_camera` at pixels [m, 2] from the middle of
    the image, y down."""

    num_cameras: int
    cameras: tuple[BundlerCamera, ...]
    points: np.ndarray
    colors: np.ndarray
    seen_point: np.ndarray
    seen_camera: np.ndarray
    seen_px: np.ndarray
    warnings: tuple[str, ...] = ()


def find_files(root: Path) -> list[Path]:
    """Files of Bundler in a folder or the folder bundle in it; of the steps that Bundler itself leaves, the last."""
    for folder in (root, root / "bundle"):
        found = [file for file in sorted(folder.glob("*.out")) if is_file(file)]
        final = [file for file in found if file.name == "bundle.out"]
        if found:
            return final or found
    return []


def is_file(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(HEADER)) == HEADER
    except OSError:
        return False


def read(file: Path, options: CaptureOptions) -> Project:
    """The project of a bundle and the list of its photographs, whose sizes are those of the files.

    Raises `CaptureError` where there is no list, or one of another number of photographs, and as `read_bundle`.
    """
    model, listed = read_bundle(file), find_list(file)
    names = read_list(listed) if listed is not None else []
    if len(names) != model.num_cameras:
        what = (
            f"{listed} names {len(names)}" if listed is not None else "there is no list.txt beside it, which names them"
        )
        raise CaptureError(
            f"{file}: has {model.num_cameras} cameras, but {what}. Put the list of photographs that belongs to it "
            "there (a name in each line, in the order of the cameras)."
        )
    called = [names[camera.number] for camera in model.cameras]
    placed = {camera.number for camera in model.cameras}
    lost = [name for number, name in enumerate(names) if number not in placed]
    root = file.parent.parent if file.parent.name == "bundle" else file.parent
    views = []
    order = np.argsort(model.seen_camera, kind="stable")
    starts = np.searchsorted(model.seen_camera[order], np.arange(model.num_cameras + 1))
    own = [order[starts[camera.number] : starts[camera.number + 1]] for camera in model.cameras]
    seen = [model.seen_px[each] for each in own]
    sizes, notes = aligned_sizes(root, options, called, seen, file) if own else ([], [])
    for camera, name, size, mine in zip(model.cameras, called, sizes, own, strict=True):
        shown = model.seen_point[mine], model.seen_px[mine] + np.array(size) / 2
        lens, pose = camera.intrinsics(size, file), camera.camera_from_world
        views.append(ProjectView(names=(name,), camera_from_world=pose, intrinsics=lens, sightings=shown))
    return Project(
        format="bundler", file=file, views=tuple(views), points=model.points, colors=model.colors,
        warnings=(*model.warnings, *name_unaligned(lost), *notes),
    )  # fmt: skip


def read_bundle(file: Path) -> BundlerModel:
    """The model of a file, without points and cameras that are not finite. Raises `CaptureError` for what is no file of
    Bundler, is cut off, or has counts that it does not keep."""
    try:
        text = file.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from error
    try:
        numbers = parse_numbers(text.partition("\n")[2].split())
    except ValueError as error:
        raise CaptureError(f"{file}: holds what is no number ({error}). {_AGAIN}") from None
    if len(numbers) < 2 or not (0 < numbers[0] < 1e7 and 0 <= numbers[1] < 1e9):
        raise CaptureError(f"{file}: does not begin with the numbers of cameras and points. {_AGAIN}")
    num_cameras, num_points = int(numbers[0]), int(numbers[1])
    start = 2 + _CAMERA_NUMBERS * num_cameras
    if len(numbers) < start + _POINT_NUMBERS * num_points:
        raise CaptureError(f"{file}: ends before its {num_cameras} cameras and {num_points} points do. {_AGAIN}")
    cameras = _cameras(numbers[2:start].reshape(-1, _CAMERA_NUMBERS), file)
    points, lists = _points(numbers, start, num_points, file)
    known = np.isfinite(points).all(axis=1)
    points, lists = points[known], list(compress(lists, known))
    of_point = np.repeat(np.arange(len(points)), [len(each) // _SIGHTING_NUMBERS for each in lists])
    seen = np.concatenate([*lists, np.zeros(0)]).reshape(-1, _SIGHTING_NUMBERS)
    measured = np.isfinite(seen).all(axis=1)
    of_point, seen = of_point[measured], seen[measured]
    colors = points[:, 3:].clip(0, 255).astype(np.uint8)
    lost = num_points - len(points)
    said = f"{file.name}: {lost} of its {num_points} points have coordinates that are not finite, and are left out."
    return BundlerModel(
        num_cameras=num_cameras, cameras=cameras, points=points[:, :3], colors=colors,
        seen_point=of_point, seen_camera=seen[:, 0].astype(np.int64), seen_px=seen[:, 2:] * [1.0, -1.0],
        warnings=(said,) if lost else (),
    )  # fmt: skip


def _cameras(rows: np.ndarray, file: Path) -> tuple[BundlerCamera, ...]:
    found = []
    for number, row in enumerate(rows):
        if not (row[0] > 0 and np.isfinite(row).all()):
            continue
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = row[3:12].reshape(3, 3), row[12:]
        pose = to_rigid(_LOOKS_BACK @ pose, file, f"camera {number}")
        found.append(BundlerCamera(number, float(row[0]), (float(row[1]), float(row[2])), pose))
    return tuple(found)


def _points(numbers: np.ndarray, start: int, count: int, file: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Places and colors [n, 6], and the numbers of each point's sightings."""
    points, lists = np.zeros((count, _POINT_NUMBERS)), []
    for index in range(count):
        points[index] = numbers[start : start + _POINT_NUMBERS]
        length = numbers[start + _POINT_NUMBERS] if start + _POINT_NUMBERS < len(numbers) else -1
        start += _POINT_NUMBERS + 1
        if not 0 <= length <= (len(numbers) - start) / _SIGHTING_NUMBERS:
            raise CaptureError(f"{file}: ends within point {index} of {count}. {_AGAIN}")
        end = start + _SIGHTING_NUMBERS * int(length)
        lists.append(numbers[start:end])
        start = end
    return points, lists


def read_list(file: Path) -> list[str]:
    """Names of the photographs: the first word of a line, or all of it where it ends in the suffix of an image."""
    try:
        lines = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from error
    whole = [line.strip() for line in lines if line.strip()]
    return [
        line if Path(line).suffix.lower() in IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES else line.split()[0]
        for line in whole
    ]


def find_list(bundle: Path) -> Path | None:
    """The list of the photographs of a bundle: list.txt, or as the bundle is called, or the only list beside it
    (RealityScan's .imagelist and .lst)."""
    stem = bundle.name.removesuffix(".out")
    names = ["list.txt", f"{stem.replace('bundle', 'list')}.txt", f"{stem}.list.txt", f"{stem}.txt", f"{stem}_list.txt"]
    folders = [bundle.parent, bundle.parent.parent] if bundle.parent.name == "bundle" else [bundle.parent]
    preferred = [names[1], names[0], *names[2:]]
    named = next((folder / name for folder in folders for name in preferred if (folder / name).is_file()), None)
    lists = [file for file in sorted(bundle.parent.iterdir()) if file.suffix.lower() in (".imagelist", ".lst")]
    return lists[0] if named is None and len(lists) == 1 else named
