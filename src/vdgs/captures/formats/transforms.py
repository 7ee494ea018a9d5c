"""nerfstudio's transforms.json: camera-to-world matrices with OpenGL camera axes (right, up, back).

Poses and the point cloud named by `ply_file_path` live in the same world. Where the file says that this
world was made from another by `applied_transform` (and `applied_scale`), that is undone: the capture's own
world is the original one, so that georeferences hold.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import starmap
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

from vdgs.captures.capture import Split
from vdgs.captures.formats.cloud_worlds import CloudFrame, Eye, in_world_of
from vdgs.captures.formats.json_poses import (
    camera_motion,
    get_frames,
    mask_of_frame,
    matrix_of_frame,
    parse_intrinsics,
    parse_matrix,
    parse_number,
    read_capture_json,
)
from vdgs.captures.formats.lens_keys import unread_keys
from vdgs.captures.formats.listed_names import find_listed
from vdgs.captures.formats.ply_reader import read_point_cloud
from vdgs.captures.formats.project_photographs import PhotographIndex, images_below, is_of_another
from vdgs.captures.formats.source_capture import (
    BadPose,
    SourceCapture,
    SourceView,
    find_image,
    leave_out_bad_poses,
    one_view_each,
    points_command,
    refuse_lost_tests,
    refuse_many_missing,
    safe_name,
    tested_only,
    to_rigid,
)
from vdgs.captures.formats.sparse_points import find_sparse_points
from vdgs.captures.image_files import find_images
from vdgs.captures.name_resolution import find_in_other_folders, largest_shrunk
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject
from vdgs.system.quoting import shell_word

TRANSFORMS_FILE = "transforms.json"
#: Its lists of photographs, and the side that each is of.
SPLIT_LISTS: tuple[tuple[str, Split], ...] = (
    ("train_filenames", "train"), ("val_filenames", "test"), ("test_filenames", "test"),
)  # fmt: skip

#: Where ScanNet++ has the frames that are for testing, beside those that train.
TEST_FRAMES = "test_frames"


def is_transforms(path: Path) -> bool:
    """Whether a path is the file itself, which stands for its folder."""
    return path.name == TRANSFORMS_FILE and path.is_file()


def exclusive_information(file: Path) -> str:
    """What a transforms.json says that a COLMAP model of its cameras cannot, for people; nothing if it says none of
    that, or cannot be read."""
    try:
        content = read_capture_json(file)
        masked = any(frame.get("mask_path") for frame in get_frames(content, file))
    except CaptureError:
        return ""
    has_lists = any(content.get(key) for key in (TEST_FRAMES, *(key for key, _ in SPLIT_LISTS)))
    lists = "lists of training and test photographs" if has_lists else ""
    return " and ".join(filter(None, (lists, "masks" if masked else "")))


def read_transforms(root: Path, options: CaptureOptions, needs_points: bool = True) -> SourceCapture:
    """The capture described by `root`/transforms.json. Points come from the file that it names, else as
    `find_sparse_points` finds them.

    Raises `CaptureError` for missing images, non-rigid poses, unsafe names, lists of what is no frame, and
    `NoTiePoints` where no point cloud is found, unless nothing `needs_points`.
    """
    file = root / TRANSFORMS_FILE
    content = read_capture_json(file)
    frames = get_frames(content, file)
    held_out = get_frames(content, file, TEST_FRAMES) if content.get(TEST_FRAMES) else []
    count, frames = len(frames), [*frames, *held_out]
    photographs = _find_decoded([_file_path(frame, file) for frame in frames], file, root, options)
    names, chosen, notes = photographs.names, photographs.folder, photographs.notes
    splits = _splits(content, names, count, file, options, notes)
    notes += [f"{file.name}: {note}" for note in unread_keys(content, frames)]
    applied = _parse_applied(content, file)
    views, poses, missing, lost = list[SourceView](), dict[str, np.ndarray](), list[str](), list[str]()
    bad = dict[str, CaptureError]()
    for frame, name, short, image in zip(frames, names, photographs.shorts, photographs.images, strict=True):
        if image is None:
            missing.append(short)
            lost += [short] if splits.get(name) == "test" else []
            continue
        short += image.suffix if image.stem == PurePosixPath(short).name else ""
        try:
            matrix = matrix_of_frame(frame, file, f"frame {name!r}")
            in_file = camera_motion(matrix, file, f"frame {name!r}")
        except BadPose as error:
            bad[short] = error
            continue
        pose, poses[short] = np.linalg.inv(applied.undo_pose(in_file)), np.linalg.inv(in_file)
        intrinsics = parse_intrinsics(frame, content, image, file)
        views.append(
            SourceView(
                name=short,
                camera_from_world=pose,
                intrinsics=intrinsics,
                split=splits.get(name),
                image_path=image,
                mask_path=mask_of_frame(frame, file, root),
            )
        )
    warnings = notes + refuse_many_missing(missing, len(frames), root / chosen, options.strict)
    tests = [splits.get(name) for name in names].count("test")
    warnings += refuse_lost_tests(lost, tests, file, root, options)
    views = one_view_each(views, file, bad)
    warnings += leave_out_bad_poses(bad, len(frames) - len(missing), file, options.strict)
    poses = {view.name: poses[view.name] for view in views}
    eyes = [Eye(poses[view.name], view.intrinsics) for view in views]

    def placed(points: np.ndarray, cloud: Path) -> np.ndarray:
        return in_world_of(points, cloud, eyes, applied.cloud_frames(), warnings, _remedy(root, options))

    points, colors = _points(root, content, file, poses, options.images, needs_points, warnings, placed)
    return SourceCapture(
        source="transforms",
        images=chosen,
        views=tuple(views),
        points=applied.undo_places(points),
        colors=colors,
        image_folders=(root / chosen,) if chosen else (),
        warnings=tuple(warnings),
    )


def _remedy(root: Path, options: CaptureOptions) -> str:
    return (
        "Write it in the world of the poses (or name no ply_file_path and move it away), or find points anew: "
        f"{points_command(root, options.images)}"
    )


def _file_path(frame: JsonObject, file: Path) -> str:
    path = frame.get("file_path")
    if "frame_index" in frame and "file_path" not in frame:
        city = file.absolute().parents[2]
        here = shell_word(city) if file.absolute().parents[1].name == "train" else "CITY, with it as CITY/train/BLOCK"
        raise CaptureError(f"{file}: is one block of MatrixCity. Give the folder above train/: {here}")
    if not isinstance(path, str):
        raise CaptureError(f"{file}: a frame has no 'file_path'. Export the file again.")
    return path


class _Photographs(NamedTuple):
    """Of each frame the name in the capture, that in the folder of the photographs, and the file, if it is there."""

    names: list[str]
    shorts: list[str]
    images: list[Path | None]
    folder: str
    notes: list[str]


def _find_decoded(written: list[str], file: Path, root: Path, options: CaptureOptions) -> _Photographs:
    """As `_find_photographs`, which also raises; paths that are not there as they are may be those of a URI (`%20`)."""
    plain = [unquote(path) for path in written]
    try:
        found = _find_photographs(written, file, root, options)
    except CaptureError:
        if plain == written:
            raise
        return _find_photographs(plain, file, root, options)
    gone = [image is None for image in found.images]
    if plain == written or not any(gone):
        return found
    mixed = [other if is_gone else path for path, other, is_gone in zip(written, plain, gone, strict=True)]
    decoded = _find_photographs(mixed, file, root, options)
    return decoded if decoded.images.count(None) < gone.count(True) else found


def _find_photographs(written: list[str], file: Path, root: Path, options: CaptureOptions) -> _Photographs:
    """By the paths that frames have in the file; where none of these is there, or in the folder that `--images` names,
    by their ends: they may be of another folder or machine. Raises `CaptureError` for paths that leave the capture."""
    outside = None
    try:
        names = [safe_name(path, file, "file_path", root) for path in written]
    except CaptureError as error:
        outside, names = error, []
    folder = _common_folder(names)
    chosen, notes = _image_folder(root, folder, options)
    shorts = [name.removeprefix(folder + "/") if folder else name for name in names]
    images = [find_image(root, f"{chosen}/{short}" if chosen else short) for short in shorts]
    if not any(images):
        elsewhere = _find_elsewhere(written, file, root, options)
        if elsewhere is not None:
            return elsewhere._replace(notes=[*notes, *elsewhere.notes])
    if outside is not None:
        remedy = "Or say which folder they are in: --images FOLDER" if options.images is None else "Mend the paths."
        raise CaptureError(f"{outside} {remedy}") from outside
    return _Photographs(names, shorts, images, chosen, notes)


def _find_elsewhere(written: list[str], file: Path, root: Path, options: CaptureOptions) -> _Photographs | None:
    """By the ends of paths, in the folder that `--images` names, else by file names in the whole capture, which a note
    says; None where no path means one photograph alone there, or all are of another folder of the kind
    (`is_of_another`). Raises `CaptureError` where one may mean several: names that are there twice, such as those of
    train/ and test/, say nothing of the others either."""
    once = list(dict.fromkeys(written))
    if options.images is not None:
        folder, notes = root / options.images, list[str]()
        there = find_images(folder)
        found = dict(zip(once, find_in_other_folders(once, there, folder, notes), strict=True))
        names = [found[path] or path for path in written]
        images = [there.get(name) for name in names]
        return _Photographs(names, names, images, options.images, notes) if any(images) else None
    there = images_below(root, options)
    index = PhotographIndex(there)
    meant = {path: index.find_all((path,)) for path in once}
    single = {path: each[0] for path, each in meant.items() if len(each) == 1}
    several = {path: each for path, each in meant.items() if len(each) > 1}
    if several:
        first, either = next(iter(several.items()))
        raise CaptureError(
            f"{file}: its photographs are not where it says, and there several times elsewhere: {first!r} may be "
            f"{either[0]} or {either[1]}. Give the folder of the right ones with --images."
        )
    if not single or len(set(single.values())) < len(single) or any(starmap(is_of_another, single.items())):
        return None
    first, name = next(iter(single.items()))
    note = f"the photographs are not where {file.name} says, but in other folders: {first} is taken as {name}."
    names = [single.get(path, path) for path in written]
    top = _common_folder(list(single.values()))
    shorts = [name.removeprefix(f"{top}/") for name in names]
    return _Photographs(names, shorts, [there.get(name) for name in names], top, [note])


def _common_folder(names: list[str]) -> str:
    """The first folder of all names ("images"), or nothing where they differ."""
    first = {PurePosixPath(name).parts[0] for name in names if len(PurePosixPath(name).parts) > 1}
    flat = any(len(PurePosixPath(name).parts) == 1 for name in names)
    return first.pop() if len(first) == 1 and not flat else ""


def _image_folder(root: Path, named: str, options: CaptureOptions) -> tuple[str, list[str]]:
    """The folder of the photographs: the one asked for, else the one that all names begin with, else the largest of
    shrunk ones (which is said)."""
    if options.images is not None:
        return options.images, []
    shrunk = largest_shrunk(root, named) if named and not (root / named).is_dir() else None
    return shrunk or named, [f"no {named}/ folder; {shrunk} is used instead (--images chooses)."] if shrunk else []


def _splits(
    content: JsonObject, names: list[str], count: int, file: Path, options: CaptureOptions, notes: list[str]
) -> dict[str, Split]:
    """Splits of frames (`names`) where those behind the first `count` are test_frames, or where train_filenames and
    val_filenames or test_filenames are given.

    Frames in no list have none; where one side has no list at all, it takes them (choice). What is listed on both sides
    is for the test, which the notes say where the lists count. Raises `CaptureError` where a list that is not ignored
    names no frame.
    """
    held_out = set(names[count:])
    listed: dict[Split, set[str]] = {"train": held_out.intersection(names[:count]), "test": held_out}
    sides: set[Split] = {"test"} if held_out else set()
    for key, side in SPLIT_LISTS:
        written = content.get(key) or []
        if not isinstance(written, list):
            raise CaptureError(f"{file}: {key!r} must be a list of names.")
        if written and options.split != "every":
            wanted = [name if name in names else unquote(name) for name in map(str, written)]
            found, unknown = find_listed(wanted, names, f"{file}: {key}", strict=options.strict)
            listed[side] = listed[side] | found
            sides.add(side)
            notes += unknown
    if options.test_list is None and options.split in ("auto", "explicit"):
        notes += tested_only(sorted(listed["train"] & listed["test"]))
    splits = {name: side for side, found in listed.items() for name in found}  # what is in both becomes "test"
    if len(sides) == 1:
        rest: Split = "train" if "test" in sides else "test"
        return {name: splits.get(name, rest) for name in names}
    return splits


class _Applied(NamedTuple):
    """What was done to the original world: a motion, then a scale."""

    original_from_world: np.ndarray
    scale: float

    def undo_pose(self, world_from_camera: np.ndarray) -> np.ndarray:
        """A rigid world-from-camera matrix [4, 4] in the original world."""
        unscaled = world_from_camera.copy()
        unscaled[:3, 3] /= self.scale
        return self.original_from_world @ unscaled

    def cloud_frames(self) -> list[CloudFrame]:
        """Coordinates other than those of the file that a point cloud may have, and what brings them there."""
        turn, shift = self.original_from_world[:3, :3], self.original_from_world[:3, 3]
        if self.scale == 1 and np.allclose(self.original_from_world, np.eye(4)):
            return []
        return [
            (
                "in the world before applied_transform (and applied_scale)",
                lambda points: (points - shift) @ turn * self.scale,
            ),
            ("in the world before applied_scale", lambda points: points * self.scale),
            ("in the world before applied_transform, but scaled", lambda points: (points - self.scale * shift) @ turn),
        ]

    def undo_places(self, places: np.ndarray) -> np.ndarray:
        """Places [n, 3] in the original world."""
        turn, shift = self.original_from_world[:3, :3], self.original_from_world[:3, 3]
        return places / self.scale @ turn.T + shift


def _parse_applied(content: JsonObject, file: Path) -> _Applied:
    applied = np.eye(4)
    if content.get("applied_transform") is not None:
        applied = to_rigid(
            parse_matrix(content["applied_transform"], file, "applied_transform"), file, "applied_transform"
        )
    scale = parse_number(content, "applied_scale", file) or 1.0
    if not 1e-9 < scale < 1e9:
        raise CaptureError(f"{file}: applied_scale {scale} must be a positive factor.")
    return _Applied(np.linalg.inv(applied), scale)


def _points(
    root: Path,
    content: JsonObject,
    file: Path,
    poses: dict[str, np.ndarray],
    images: str | None,
    needs_points: bool,
    notes: list[str],
    placed: Callable[[np.ndarray, Path], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Points and `poses` (camera-from-world by name) in the world of the file, before `applied_transform` is undone."""
    ply = content.get("ply_file_path")
    try:
        cloud = None if ply is None else root / safe_name(str(ply), file, "ply_file_path", root)
    except CaptureError as error:
        raise CaptureError(f"{error} Or put the point cloud beside it, by the same name.") from error
    if cloud is not None and cloud.is_file():
        points, colors = read_point_cloud(cloud)
        return placed(points, cloud), colors
    what = TRANSFORMS_FILE if cloud is None else f"{TRANSFORMS_FILE}, whose ply_file_path {ply} is not there,"
    option = " and give --format transforms"
    found = find_sparse_points(
        root, poses, what, option=option, images=images, needs_points=needs_points, placed=placed
    )
    if cloud is not None and len(found[0]):
        notes.append(
            f"{cloud}: is not there, though {TRANSFORMS_FILE} names it; {len(found[0]):,} points beside it are used."
        )
    return found
