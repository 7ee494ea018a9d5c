"""LLFF's poses_bounds.npy: of each photograph, in the order of their names, 17 numbers without a name.

The first 15 are a matrix [3, 5] by rows: world from camera with the camera's axes down, right, backwards, the camera's
place, and height, width and focal length in pixels of the photographs that the poses were made of. The last 2, the
nearest and the farthest depth, are not used. The principal point is the middle and lenses do not bend: LLFF leaves out
what COLMAP found of both. Folders images_4 and images_8 hold the photographs shrunk, also under other names of the same
order. World and unit are those of COLMAP's reconstruction: unknown. (README of LLFF and its poses/pose_utils.py,
load_colmap_data and save_poses, github.com/Fyusion/LLFF; NeRF's load_llff.py reads the same.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vdgs.captures.formats.source_capture import (
    Intrinsics,
    SourceCapture,
    SourceView,
    check_intrinsics,
    leave_out_bad_poses,
    to_rigid,
)
from vdgs.captures.formats.sparse_points import find_sparse_points
from vdgs.captures.image_files import readable_images
from vdgs.captures.name_resolution import largest_shrunk
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.permissions import refusal

POSES_FILE = "poses_bounds.npy"
#: Numbers of a photograph, with the two depths and without.
_COLUMNS = (17, 15)
#: LLFF's axes of a camera (down, right, back) from OpenCV's (right, down, forward).
LLFF_FROM_OPENCV = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def is_llff(root: Path) -> bool:
    return (root / POSES_FILE).is_file()


def read_llff(root: Path, options: CaptureOptions, needs_points: bool = True) -> SourceCapture:
    """The capture described by `root`/poses_bounds.npy; each photograph of the folder has the pose of its place in the
    order of names.

    Raises `CaptureError` for a damaged file and for more or fewer photographs than poses, `NoTiePoints` where no points
    are beside it, unless nothing `needs_points`.
    """
    file = root / POSES_FILE
    rows = _load(file)
    images, warnings = _image_folder(root, options)
    photographs = _photographs(root / images)
    if len(photographs) != len(rows):
        raise CaptureError(
            f"{file}: has {len(rows)} poses, and {root / images} has {len(photographs)} photographs. The file knows no "
            "names: each pose belongs to the photograph of its place in the order of names, so there must be as many. "
            "Take photographs without a pose (COLMAP did not register them) out of the folder, put back those that are "
            "gone, or choose another folder with --images."
        )
    views, bad = list[SourceView](), dict[str, CaptureError]()
    for row, image in zip(rows, photographs, strict=True):
        try:
            views.append(_read_view(row, image, file))
        except CaptureError as error:
            bad[image.name] = error
    warnings += leave_out_bad_poses(bad, len(rows), file, options.strict)
    poses = {view.name: view.camera_from_world for view in views}
    points, colors = find_sparse_points(
        root, poses, POSES_FILE, _original_names(root, photographs), option=" and give --format llff",
        images=options.images, needs_points=needs_points,
    )  # fmt: skip
    return SourceCapture(
        source="llff", images=images, views=tuple(views), points=points, colors=colors, warnings=tuple(warnings)
    )


def _load(file: Path) -> np.ndarray:
    """The rows of the file, [n, 15] float64. Nothing in the file can run (`allow_pickle`)."""
    try:
        rows = np.load(file, mmap_mode="r", allow_pickle=False)
    except PermissionError as error:
        raise CaptureError(f"{file}: {refusal(file, error)}") from None
    except Exception as error:  # its parser raises many kinds on damaged headers
        if "Python objects" in str(error):  # as numpy says of files that it could only unpickle
            raise CaptureError(
                f"{file}: holds objects of Python, not numbers, and these are not read. Save it anew as an array of "
                "numbers (float64)."
            ) from None
        raise CaptureError(f"{file}: cannot be read as a numpy array (damaged, or cut off?). Copy it again.") from None
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "fiu":
        raise CaptureError(f"{file}: must hold one array of numbers. Copy it again, or export it anew.")
    if rows.ndim != 2 or not len(rows) or rows.shape[1] not in _COLUMNS:
        raise CaptureError(
            f"{file}: has an array of {'x'.join(map(str, rows.shape)) or 'one number'}; LLFF's has 17 numbers of each "
            "photograph. Export it again."
        )
    return np.array(rows[:, :15], dtype=np.float64)


def _image_folder(root: Path, options: CaptureOptions) -> tuple[str, list[str]]:
    """The folder of the photographs: the one asked for, else images, else the largest images_N (which is said), else
    the root."""
    if options.images is not None:
        return options.images, []
    named = [entry.name for entry in sorted(root.iterdir()) if entry.name.lower() == "images" and entry.is_dir()]
    if named:
        return ("images" if "images" in named else named[0]), []
    shrunk = largest_shrunk(root, "images")
    if shrunk is None and _photographs(root):
        return ".", [f"no images/ folder; the photographs in {root} are used (--images chooses)."]
    if shrunk is None:
        raise CaptureError(
            f"{root}: {POSES_FILE} is there, and no folder images of its photographs (nor images_4, images_8, ...), "
            "nor photographs beside it. Name their folder: --images FOLDER"
        )
    return shrunk, [f"no images/ folder; {shrunk} is used instead (--images chooses)."]


def _photographs(folder: Path) -> list[Path]:
    """The photographs right in a folder, in the order in which LLFF has their poses: that of Python's strings."""
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    return sorted(readable_images(files), key=lambda file: file.name)


def _original_names(root: Path, photographs: list[Path]) -> dict[str, str]:
    """The names of shrunk photographs by those of the originals of the same order, which a COLMAP model has."""
    originals = _photographs(root / "images") if (root / "images").is_dir() else []
    if len(originals) != len(photographs):
        return {}
    return {old.name: new.name for old, new in zip(originals, photographs, strict=True)}


def _read_view(row: np.ndarray, image: Path, file: Path) -> SourceView:
    matrix = row.reshape(3, 5)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3], world_from_camera[:3, 3] = matrix[:, :3] @ LLFF_FROM_OPENCV, matrix[:, 3]
    pose = np.linalg.inv(to_rigid(world_from_camera, file, f"the pose of {image.name}"))
    height, width, focal = matrix[:, 4]
    if not np.isfinite(matrix[:, 4]).all():
        raise CaptureError(f"{file}: {image.name} has no height, width and focal length. Export the file again.")
    lens = Intrinsics("PINHOLE", (focal, focal, width / 2, height / 2), round(width), round(height))
    return SourceView(
        name=image.name, camera_from_world=pose, intrinsics=check_intrinsics(lens, file, image.name), image_path=image
    )
