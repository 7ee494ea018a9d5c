"""Cameras of MVSNet and of what follows its layout (BlendedMVS, DTU and Tanks and Temples as MVSNet has them): of each
photograph a text file, `cams/00000000_cam.txt`.

    extrinsic
    4 rows of 4: camera from world, OpenCV's axes of the camera
    <empty line>
    intrinsic
    3 rows of 3: fx 0 cx / 0 fy cy / 0 0 1, in pixels of the photographs beside it
    <empty line>
    DEPTH_MIN DEPTH_INTERVAL (DEPTH_NUM DEPTH_MAX), which is not used and may lack

(README of MVSNet, github.com/YoYo000/MVSNet.) Its colmap2mvsnet.py copies cx and cy of COLMAP's models as they are, so
they count from the corner of the photograph, as COLMAP's and ours do. Altizure, which made BlendedMVS, does not say
where it counts from; the same is assumed, which is half a pixel off at most. World, unit and up are those of whatever
reconstructed the photographs: unknown. `pair.txt`, depth maps and lists of scenes are not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np

from vdgs.captures.formats.center_sizes import told_size
from vdgs.captures.formats.json_poses import parse_matrix
from vdgs.captures.formats.source_capture import (
    BadPose,
    Intrinsics,
    SourceCapture,
    SourceView,
    check_intrinsics,
    leave_out_bad_poses,
    one_view_each,
    refuse_many_missing,
    to_rigid,
)
from vdgs.captures.formats.sparse_points import find_sparse_points
from vdgs.captures.image_files import find_images, read_header, readable_images, readable_suffixes
from vdgs.captures.name_resolution import ImageNameIndex, largest_shrunk
from vdgs.captures.text_tables import decode_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

#: Folders of cameras, in lower case, in the order in which they are taken: those of Tanks and Temples with narrower
#: depths are called cams_1 and have the same poses.
CAMERA_FOLDERS = ("cams", "cameras", "cams_1", "cams_hr")
#: Folders of the photographs, in lower case, in the order in which they are looked into.
IMAGE_FOLDERS = ("images", "blended_images", "rectified", "image", "imgs")
CAMERA_END = "_cam.txt"
#: A lens whose axes are not upright on each other by more than this many pixels is none that is read.
_MAX_SKEW_PX = 0.01
_AGAIN = "Copy it again."
_OF_THAT_SIZE = "Give the photographs that the cameras were made for (--images)."


def is_mvsnet(root: Path) -> bool:
    """Whether a folder holds one of cameras as MVSNet writes them."""
    return bool(_camera_folders(root))


def camera_files(folder: Path) -> list[Path]:
    """The cameras in a folder, by name."""
    return sorted(file for file in folder.glob(f"*{CAMERA_END}") if not file.name.startswith("."))


def read_mvsnet(root: Path, options: CaptureOptions, needs_points: bool = True) -> SourceCapture:
    """The capture in MVSNet's layout. Photographs are found by the names of the cameras, else by their numbers
    or their order.

    Raises `CaptureError` for missing photographs and cameras that are damaged, `NoTiePoints` where no points are
    beside it, unless nothing `needs_points`.
    """
    cameras, *others = _camera_folders(root)
    files = camera_files(cameras)
    beside = _find_images(root, files, cameras)
    folder = root / options.images if options.images is not None else beside
    if folder is None:
        raise CaptureError(
            f"{root}: no folder of the photographs that {cameras.name}/{files[0].name} and the others are of (looked "
            f"into {', '.join(IMAGE_FOLDERS)}). Name it: --images FOLDER"
        )
    labels = [file.name.removesuffix(CAMERA_END) for file in files]
    photographs, notes = _Photographs(folder).pair(labels, cameras)
    _refuse_without_any(photographs, labels, folder)
    originals = _originals(beside, labels, cameras)
    views, missing, bad = list[SourceView](), list[str](), dict[str, CaptureError]()
    for file, label in zip(files, labels, strict=True):
        image = photographs.get(label)
        if image is None:
            missing.append(label)
            continue
        try:
            views.append(_read_view(file, image, originals.get(label, image)))
        except CaptureError as error:
            bad[image.name] = error
    warnings = notes + refuse_many_missing(missing, len(files), folder, options.strict)
    views = one_view_each(views, cameras, bad)
    warnings += leave_out_bad_poses(bad, len(files) - len(missing), cameras, options.strict)
    if others:
        names = ", ".join(other.name for other in others)
        warnings.append(f"the cameras in {cameras.name} are read; those in {names} beside it are not.")
    poses = {view.name: view.camera_from_world for view in views}
    points, colors = find_sparse_points(
        root, poses, "MVSNet's layout", option=" and give --format mvsnet", images=options.images,
        needs_points=needs_points,
    )  # fmt: skip
    return SourceCapture(
        source="mvsnet",
        images=(folder.relative_to(root) if folder.is_relative_to(root) else folder).as_posix(),
        views=tuple(views),
        points=points,
        colors=colors,
        image_folders=(folder,),
        warnings=tuple(warnings),
    )


class _Photographs:
    """The photographs in a folder, by the names of cameras."""

    def __init__(self, folder: Path) -> None:
        files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
        self._index = ImageNameIndex({file.name: file for file in readable_images(files)})
        self._numbered: dict[int, list[Path]] = {}
        for file in self._index.images.values():
            if file.stem.isdecimal():
                self._numbered.setdefault(int(file.stem), []).append(file)

    def find(self, label: str) -> Path | None:
        """The photograph of a camera: by its name, with its extension or without, else the only one of its number."""
        named = PurePosixPath(label).suffix.lower() in readable_suffixes()
        found = self._index.find(label if named else f"{label}.jpg")
        if found is not None:
            return self._index.images[found]
        alike = self._numbered.get(int(label), []) if label.isdecimal() else []
        return alike[0] if len(alike) == 1 else None

    def pair(self, labels: Sequence[str], cameras: Path) -> tuple[dict[str, Path], list[str]]:
        """Of each camera, by its label, the photograph that is there, and a note where they are paired by their order.

        Cameras are counted from 0, and photographs often from 1 (Tanks and Temples): where all of both are numbered
        without gaps, equally many and apart by 1, their numbers mean their order. Raises `CaptureError` where that may
        be so and cannot be told.
        """
        found = self._find_each(labels)
        if len(found) == len(labels):
            return found, []
        numbers = sorted(int(label) for label in labels if label.isdecimal())
        theirs = self._single_numbers()
        if not theirs or len(numbers) != len(labels) or (numbers[0] == theirs[0] and numbers[-1] == theirs[-1]):
            return found, []
        by_name = any(label == image.stem for label, image in found.items())
        is_shifted = len(numbers) == len(theirs) and _without_gaps(numbers) and _without_gaps(theirs)
        if is_shifted and not by_name and theirs[0] - numbers[0] == 1:
            note = (
                f"cameras in {cameras.name} are counted from {numbers[0]} and photographs from {theirs[0]}: paired in "
                "their order."
            )
            return self._in_order(labels, numbers, theirs), [note]
        if is_shifted or (found and not by_name and _may_be_shifted(numbers, theirs)):
            raise self._cannot_be_told(labels, cameras, numbers, theirs)
        return found, []

    def _find_each(self, labels: Sequence[str]) -> dict[str, Path]:
        return {label: image for label in labels if (image := self.find(label)) is not None}

    def _single_numbers(self) -> list[int]:
        """The numbers that one photograph alone has."""
        return sorted(number for number, files in self._numbered.items() if len(files) == 1)

    def _in_order(self, labels: Sequence[str], numbers: Sequence[int], theirs: Sequence[int]) -> dict[str, Path]:
        pairs = dict(zip(numbers, theirs, strict=True))
        return {label: self._numbered[pairs[int(label)]][0] for label in labels}

    def _cannot_be_told(
        self, labels: Sequence[str], cameras: Path, numbers: Sequence[int], theirs: Sequence[int]
    ) -> CaptureError:
        file = self._numbered[theirs[0]][0]
        return CaptureError(
            f"{file.parent}: the {len(theirs)} photographs are numbered from {theirs[0]} to {theirs[-1]}, and the "
            f"{len(numbers)} cameras in {cameras} from {numbers[0]} to {numbers[-1]}: which belong together cannot "
            f"be told, for {numbers[0]} may be the camera of {file.name}. Rename the photographs as the cameras "
            f"are named ({labels[0]}{file.suffix} for {labels[0]}{CAMERA_END}), or take cameras and photographs "
            "that have no partner out of the folders."
        )


def _may_be_shifted(numbers: Sequence[int], theirs: Sequence[int]) -> bool:
    """Whether cameras of these numbers lack photographs of theirs in a way that a count from another number leaves."""
    without_photograph, without_camera = set(numbers) - set(theirs), set(theirs) - set(numbers)
    return bool(without_photograph) and (bool(without_camera) or theirs[0] > numbers[0])


def _without_gaps(numbers: Sequence[int]) -> bool:
    return numbers[-1] - numbers[0] == len(numbers) - 1


def _originals(folder: Path | None, labels: Sequence[str], cameras: Path) -> dict[str, Path]:
    """The photographs beside the cameras, whose pixels the lenses are told in; none where they cannot be told."""
    with suppress(CaptureError):
        return {} if folder is None else _Photographs(folder).pair(labels, cameras)[0]
    return {}


def _refuse_without_any(photographs: dict[str, Path], labels: Sequence[str], folder: Path) -> None:
    """Raise `CaptureError` where no photograph has the name of a camera, as in DTU's Rectified."""
    if not photographs and (there := list(find_images(folder).values())):
        raise CaptureError(
            f"{folder}: none of the {len(there)} photographs ({there[0].name}, ...) is named as one of the "
            f"{len(labels)} cameras. Copy them under the names of their cameras, {labels[0]}{there[0].suffix} for "
            f"{labels[0]}{CAMERA_END}. DTU counts its photographs from 1 and their light last: rect_001_3_r5000.png is "
            "of camera 00000000."
        )


def _camera_folders(root: Path) -> list[Path]:
    """The folders of cameras in a capture, that which is read first."""
    named = _folders(root, CAMERA_FOLDERS)
    return [folder for folder in named if camera_files(folder)]


def _folders(root: Path, names: Sequence[str]) -> list[Path]:
    """The folders in `root` of these names, written in any case, in their order."""
    with suppress(OSError):
        there = [entry for entry in sorted(root.iterdir()) if entry.name.lower() in names and entry.is_dir()]
        return sorted(there, key=lambda entry: names.index(entry.name.lower()))
    return []


def _find_images(root: Path, files: Sequence[Path], cameras: Path) -> Path | None:
    """The folder that has most of the photographs of these cameras, the first of several; None where none has any."""
    shrunk = largest_shrunk(root, "images")
    places = [*_folders(root, IMAGE_FOLDERS), *([root / shrunk] if shrunk else []), cameras, root]
    labels = [file.name.removesuffix(CAMERA_END) for file in files]
    found = {place: sum(map(bool, map(_Photographs(place).find, labels))) for place in places}
    best = max(places, key=lambda place: found[place])
    return best if found[best] else None


def _read_view(file: Path, image: Path, told_for: Path) -> SourceView:
    """A photograph with the camera of a file, whose pixels are those of the photograph `told_for`."""
    matrix, lens = _read_camera(file)
    pose = to_rigid(matrix, file, "extrinsic")
    header, center = read_header(told_for), (float(lens[0, 2]), float(lens[1, 2]))
    size = told_size((header.width, header.height), center, file, told_for.name, _OF_THAT_SIZE)
    intrinsics = Intrinsics("PINHOLE", (float(lens[0, 0]), float(lens[1, 1]), *center), *size)
    return SourceView(
        name=image.name, camera_from_world=pose, image_path=image,
        intrinsics=check_intrinsics(intrinsics, file, image.name),
    )  # fmt: skip


def _read_camera(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera from world [4, 4] and the matrix of the lens [3, 3] of a file."""
    try:
        words = decode_text(file.read_bytes()).lower().split()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}). {_AGAIN}") from error
    extrinsic, intrinsic = (_numbers_after(words, word) for word in ("extrinsic", "intrinsic"))
    if len(extrinsic) not in (12, 16) or len(intrinsic) < 9:
        raise BadPose(
            f"{file}: needs 'extrinsic' with 4 rows of 4 numbers and 'intrinsic' with 3 rows of 3, and has "
            f"{len(extrinsic)} and {len(intrinsic)} numbers there. {_AGAIN}"
        )
    lens = np.array(intrinsic[:9]).reshape(3, 3)
    upright = np.array([[lens[0, 0], 0, lens[0, 2]], [0, lens[1, 1], lens[1, 2]], [0, 0, 1]])
    if not np.isfinite(lens).all() or np.abs(lens - upright).max() > _MAX_SKEW_PX:
        raise BadPose(
            f"{file}: 'intrinsic' must be fx 0 cx / 0 fy cy / 0 0 1, in pixels (skew is not supported). Copy it again, "
            "or undistort the photographs first."
        )
    return parse_matrix(np.array(extrinsic).reshape(-1, 4).tolist(), file, "extrinsic"), lens


def _numbers_after(words: Sequence[str], heading: str) -> list[float]:
    """The numbers that follow a heading, up to the next word."""
    numbers = list[float]()
    with suppress(ValueError):
        for word in words[words.index(heading) + 1 :]:
            numbers.append(float(word))
    return numbers
