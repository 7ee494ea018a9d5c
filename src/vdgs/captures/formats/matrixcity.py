"""MatrixCity's layout: poses in JSON with OpenGL camera axes, z up, images named 0000.png per block.

Two forms are published. pose/<block>/ holds transforms_train.json and transforms_test.json
(`transform_matrix`, unit 100 m, file_path relative to the dataset). train/<block>/ and test/<block>_test/
hold one transforms.json each (`rot_mat`, `frame_index`; unit 1 m, the rotation to be multiplied by 100).
The capture is the folder pose/<block>, or the one above train/ and test/. The same reader serves other
transforms_train/transforms_test pairs (Blender): then the world's scale is not known.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from vdgs.captures.capture import Split
from vdgs.captures.formats.cloud_worlds import CloudFrame, Eye, in_world_of
from vdgs.captures.formats.frame_photographs import IMAGE_FOLDERS, FramePhotographs
from vdgs.captures.formats.json_poses import (
    camera_motion,
    get_frames,
    mask_of_frame,
    matrix_of_frame,
    parse_intrinsics,
    read_capture_json,
)
from vdgs.captures.formats.source_capture import (
    BadPose,
    SourceCapture,
    SourceView,
    WorldPrior,
    leave_out_bad_poses,
    one_view_each,
    points_command,
    refuse_lost_tests,
    refuse_many_missing,
    without_tested,
)
from vdgs.captures.formats.sparse_points import find_sparse_points
from vdgs.captures.image_files import read_header
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject
from vdgs.system.quoting import shell_word

#: The photographs that do not train.
TEST_FILE, VALIDATION_FILE = "transforms_test.json", "transforms_val.json"
#: Unit of the pose files in metres.
POSE_UNIT_M = 100.0
#: The rotation in per-block files is this times a rotation.
BLOCK_ROTATION = 0.01
#: What its cities and blocks are called in the paths of its images, whose names are numbers (0000.png).
CITY_PATTERN = re.compile(r"(small|big)_city.*|matrix_?city.*", re.IGNORECASE)
BLOCK_PATTERN = re.compile(r"(big_high_)?block_?(all|fusion|\d+|[a-z])(_test|_train)?", re.IGNORECASE)
_NUMBERED = re.compile(r"\d{4,}(\.png)?", re.IGNORECASE)


def pose_files(root: Path) -> list[tuple[Path, Split]]:
    """The pose files of the layout with their split; empty if the folder is of another kind. Where a set has none for
    the test, those for validation are."""
    test = next((file for file in (root / TEST_FILE, root / VALIDATION_FILE) if file.is_file()), root / TEST_FILE)
    pair: list[tuple[Path, Split]] = [(root / "transforms_train.json", "train"), (test, "test")]
    if pair[0][0].is_file():
        return [(file, split) for file, split in pair if file.is_file()]
    blocks: list[tuple[Path, Split]] = [(file, "train") for file in sorted(root.glob("train/*/transforms.json"))]
    if blocks:
        return blocks + [(file, "test") for file in sorted(root.glob("test/*/transforms.json"))]
    return []


@dataclass
class _Frames:
    """What the pose files of a capture say, as it is read."""

    views: list[SourceView] = field(default_factory=list)
    units: set[float] = field(default_factory=set)
    """Of the worlds of the files, in metres if they are MatrixCity's."""
    missing: list[str] = field(default_factory=list)
    """Names of photographs that are not there."""
    missing_tests: list[str] = field(default_factory=list)
    bad: dict[str, CaptureError] = field(default_factory=dict)
    """Photographs whose pose cannot be used."""
    count: int = 0
    tests: int = 0
    is_city: bool = False


def read_matrixcity(root: Path, options: CaptureOptions, needs_points: bool = True) -> SourceCapture:
    """The capture in MatrixCity's layout, its world as in the files (z up).

    Points come from points3D.ply in the same world, or from a COLMAP model in sparse/. Raises
    `CaptureError` for missing images, non-rigid poses and missing points.
    """
    files = pose_files(root)
    read = _read_frames(files, root, options)
    warnings = _missing(read.missing, read.count, root / (options.images or ""), options.strict, read.is_city)
    warnings += refuse_lost_tests(read.missing_tests, read.tests, files[-1][0], root, options)
    views, both = _without_tested_files(read.views)
    views = one_view_each(views, root, read.bad)
    warnings += both
    if any(file.name == VALIDATION_FILE for file, _ in files):
        warnings.append(f"there is no {TEST_FILE}: the photographs of {VALIDATION_FILE} are for the test.")
    warnings += leave_out_bad_poses(read.bad, read.count - len(read.missing), files[0][0], options.strict)
    if read.is_city and len(read.units) > 1:
        raise CaptureError(f"{root}: some poses are in metres and some in units of 100 m. Use one kind of pose file.")
    poses = {view.name: view.camera_from_world for view in views}
    what = "MatrixCity's layout" if read.is_city else files[0][0].name
    points, colors = find_sparse_points(
        root, poses, what, images=options.images, needs_points=needs_points,
        placed=lambda points, cloud: _placed(points, cloud, read.is_city, views, warnings, root, options),
    )  # fmt: skip
    if not read.is_city and needs_points and any(_is_transparent(view.image_path) for view in views[:1]):
        warnings.append(
            "what is transparent is left out of training and figures, as by a mask. Figures of sets of Blender are "
            f"usual on white: without the points beside the set, vdgs sfm {shell_word(root)} --output CAPTURE makes it "
            "white."
        )
    if not read.tests:  # no test files: the split is ours to choose
        views = [replace(view, split=None) for view in views]
    return SourceCapture(
        source="matrixcity",
        images=options.images or "",
        views=tuple(views),
        points=points,
        colors=colors,
        world=_world(read),
        warnings=tuple(warnings),
    )


def _placed(
    points: np.ndarray, cloud: Path, is_city: bool, views: Sequence[SourceView], notes: list[str], root: Path,
    options: CaptureOptions,
) -> np.ndarray:  # fmt: skip
    """The points of a cloud in the world of the poses, which are in metres or in units of 100 m in a city."""
    eyes = [Eye(view.camera_from_world, view.intrinsics) for view in views]
    others: list[CloudFrame] = [("in metres", lambda p: p / 100), ("in units of 100 m", lambda p: p * 100)]
    remedy = (
        f"Write it in the world of the poses, or move it away and find points: {points_command(root, options.images)}"
    )
    return in_world_of(points, cloud, eyes, others if is_city else [], notes, remedy)


def _read_frames(files: Sequence[tuple[Path, Split]], root: Path, options: CaptureOptions) -> _Frames:
    read = _Frames()
    photographs = FramePhotographs(root, options.images)
    for file, split in files:
        content = read_capture_json(file)
        if split == "test" and content.get("frames") == []:
            continue  # as programs write that hold no photograph out: no test file
        for frame in get_frames(content, file):
            read.count, read.is_city = read.count + 1, read.is_city or _of_a_city(frame)
            image = photographs.find(frame, file, split)
            read.tests += split == "test"
            if isinstance(image, str):
                read.missing.append(image)
                read.missing_tests += [image] if split == "test" else []
                continue
            try:
                view, unit = _read_frame(image, frame, content, file, split, root)
            except BadPose as error:
                read.bad[image[0]] = error
                continue
            read.views.append(view)
            read.units.add(unit)
    return read


def _without_tested_files(views: list[SourceView]) -> tuple[list[SourceView], list[str]]:
    """`without_tested` by the files of the photographs, whatever their names."""
    tested = {view.image_path for view in views if view.split == "test"}
    return without_tested(views, {view.name for view in views if view.image_path in tested})


def _world(read: _Frames) -> WorldPrior:
    if not read.is_city:
        return WorldPrior(np.eye(3), 1.0, False, "z is up by the format")
    (unit,) = read.units
    return WorldPrior(np.eye(3), unit, True, f"MatrixCity: z is up, unit {unit:.0f} m")


def _is_transparent(image: Path | None) -> bool:
    return image is not None and read_header(image).mode in ("RGBA", "LA", "PA")


def _of_a_city(frame: JsonObject) -> bool:
    """Whether a frame says that it is of MatrixCity: by its keys, or a path through one of its cities, or to a numbered
    photograph of a block in train/ or test/. A folder block_3 alone is also that of a part of any survey."""
    if "rot_mat" in frame or "frame_index" in frame:
        return True
    parts = PurePosixPath(str(frame.get("file_path", "")).replace("\\", "/")).parts
    if any(map(CITY_PATTERN.fullmatch, parts)):
        return True
    folders = [part.lower() for part in parts[:-1] if part not in IMAGE_FOLDERS]
    in_block = len(folders) > 1 and folders[-2] in ("train", "test") and BLOCK_PATTERN.fullmatch(folders[-1])
    return bool(in_block and _NUMBERED.fullmatch(parts[-1]))


def _missing(missing: list[str], count: int, folder: Path, strict: bool, is_city: bool) -> list[str]:
    try:
        return [*refuse_many_missing(missing, count, folder, strict)]
    except CaptureError as error:
        if not is_city:
            raise
        raise CaptureError(f"{error}\n(Unpack the .tar of each block into the block's folder.)") from None


def _read_frame(
    found: tuple[str, Path], frame: JsonObject, content: JsonObject, file: Path, split: Split, root: Path
) -> tuple[SourceView, float]:
    """A view, and the unit of its world in metres if the file is MatrixCity's."""
    label = str(frame.get("file_path", frame.get("frame_index", "?")))
    matrix = matrix_of_frame(frame, file, f"frame {label}", "transform_matrix", "rot_mat")
    norm = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    scaled = abs(norm / BLOCK_ROTATION - 1) < 0.01
    if scaled:
        matrix[:3, :3] /= BLOCK_ROTATION
    name, image = found
    pose = np.linalg.inv(camera_motion(matrix, file, f"frame {label}"))
    common = {key: value for key, value in content.items() if key != "frames"}
    intrinsics, mask = parse_intrinsics(frame, common, image, file), mask_of_frame(frame, file, root)
    return SourceView(
        name=name, camera_from_world=pose, intrinsics=intrinsics, split=split, image_path=image, mask_path=mask
    ), 1.0 if scaled else POSE_UNIT_M
