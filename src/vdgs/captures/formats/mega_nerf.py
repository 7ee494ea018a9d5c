"""Mega-NeRF's layout (Mill 19, UrbanScene3D): train/ and val/ with rgbs/*.jpg and metadata/*.pt.

Each metadata file holds H, W, intrinsics [fx, fy, cx, cy] (pixels) and c2w [3, 4]. The world's axes are down,
right, back (DRB), moved by `origin_drb` and divided by `pose_scale_factor` from coordinates.pt, which its
README gives in metres; the camera's axes are NeRF's right, up, back. The `distortion` in the files
describes the originals: the images are already undistorted.
"""

from __future__ import annotations

import filecmp
from pathlib import Path, PurePosixPath

import numpy as np

from vdgs.captures.capture import Split
from vdgs.captures.formats.cloud_worlds import CloudFrame, Eye, in_world_of
from vdgs.captures.formats.json_poses import OPENGL_FROM_OPENCV
from vdgs.captures.formats.source_capture import (
    Intrinsics,
    SourceCapture,
    SourceView,
    WorldPrior,
    check_intrinsics,
    points_command,
    refuse_lost_tests,
    refuse_many_missing,
    to_rigid,
    without_tested,
)
from vdgs.captures.formats.sparse_points import find_sparse_points
from vdgs.captures.image_files import find_images
from vdgs.captures.name_resolution import to_nfc
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.documents import JsonObject
from vdgs.system.permissions import refusal
from vdgs.system.quoting import shell_word

#: Ground axes (right, forward, up) from DRB axes.
GROUND_FROM_DRB = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
TEST_FOLDER = "val"
SPLIT_FOLDERS: tuple[tuple[str, Split], ...] = (("train", "train"), (TEST_FOLDER, "test"))


def is_mega_nerf(root: Path) -> bool:
    return (root / "train" / "metadata").is_dir()


def read_mega_nerf(root: Path, options: CaptureOptions, needs_points: bool = True) -> SourceCapture:
    """The capture in Mega-NeRF's layout; its world is that of coordinates.pt, in metres, axes DRB.

    Points come from points3D.ply (in the same world, or in that of its poses) or a COLMAP model in sparse/.
    `options.images` names another image folder than rgbs. Raises `CaptureError` for missing or damaged files.
    """
    file = root / "coordinates.pt"
    coordinates = _load(file)
    origin, scale = (
        _array(coordinates, "origin_drb", (3,), file),
        float(_array(coordinates, "pose_scale_factor", (), file)),
    )
    if not scale > 0:
        raise CaptureError(f"{file}: pose_scale_factor {scale} must be positive.")
    images = options.images or "rgbs"
    views, missing = list[SourceView](), list[str]()
    for folder, split in SPLIT_FOLDERS:
        views += _read_folder(root, folder, images, split, origin, scale, missing)
    try:
        warnings = refuse_many_missing(missing, len(views) + len(missing), root, options.strict)
    except CaptureError as error:
        raise CaptureError(
            f"{error}\n(For UrbanScene3D, Mega-NeRF's copy_images.py makes them of the raw photographs: python "
            f"scripts/copy_images.py --image_path PHOTOGRAPHS --dataset_path {shell_word(root)})"
        ) from None
    lost = [name for name in missing if name.startswith(f"{TEST_FOLDER}/")]
    tests = [view for view in views if view.split == "test"]
    warnings += refuse_lost_tests(lost, len(tests) + len(lost), root / TEST_FOLDER, root, options)
    views, both = without_tested(views, _also_tested(views, tests))
    warnings += both
    poses = {view.name: view.camera_from_world for view in views}
    eyes, remedy = [Eye(view.camera_from_world, view.intrinsics) for view in views], _remedy(root, options)
    points, colors = find_sparse_points(
        root, poses, "Mega-NeRF's layout", _aliases(root, views), images=options.images, needs_points=needs_points,
        placed=lambda points, cloud: in_world_of(points, cloud, eyes, _cloud_frames(origin, scale), warnings, remedy),
    )  # fmt: skip
    world = WorldPrior(GROUND_FROM_DRB, 1.0, True, "Mega-NeRF: x is down, metres by pose_scale_factor")
    folders = tuple(root / folder / images for folder, _ in SPLIT_FOLDERS)
    return SourceCapture(
        source="mega-nerf",
        images=images,
        views=tuple(views),
        points=points,
        colors=colors,
        world=world,
        image_folders=folders,
        warnings=tuple(warnings),
    )


def _cloud_frames(origin: np.ndarray, scale: float) -> list[CloudFrame]:
    """Coordinates other than metres DRB that a PLY may have."""
    return [
        ("in the world of its poses (origin_drb and pose_scale_factor not undone)", lambda p: p * scale + origin),
        ("in metres from origin_drb", lambda p: p + origin),
        ("divided by pose_scale_factor", lambda p: p * scale),
    ]


def _remedy(root: Path, options: CaptureOptions) -> str:
    return (
        "Write it in metres, x down, y right, z back (c2w of the poses, times pose_scale_factor, plus origin_drb), or "
        f"move it away and find points anew: {points_command(root, options.images)}"
    )


def _read_folder(
    root: Path, folder: str, images: str, split: Split, origin: np.ndarray, scale: float, missing: list[str]
) -> list[SourceView]:
    """The views of a folder; those whose image is gone are added to `missing`."""
    metadata = sorted((root / folder / "metadata").glob("*.pt"))
    present = {to_nfc(Path(name).stem): path for name, path in find_images(root / folder / images).items()}
    missing += [f"{folder}/{images}/{file.stem}" for file in metadata if to_nfc(file.stem) not in present]
    there = [file for file in metadata if to_nfc(file.stem) in present]
    return [_read_view(file, present[to_nfc(file.stem)], folder, split, origin, scale) for file in there]


def _read_view(file: Path, image: Path, folder: str, split: Split, origin: np.ndarray, scale: float) -> SourceView:
    content = _load(file)
    fx, fy, cx, cy = (float(value) for value in _array(content, "intrinsics", (4,), file))
    width, height = (int(_array(content, key, (), file)) for key in ("W", "H"))
    world_from_camera = np.eye(4)
    world_from_camera[:3] = _array(content, "c2w", (3, 4), file)
    world_from_camera[:3, 3] = world_from_camera[:3, 3] * scale + origin
    pose = np.linalg.inv(to_rigid(world_from_camera @ OPENGL_FROM_OPENCV, file, "c2w"))
    intrinsics = check_intrinsics(Intrinsics("PINHOLE", (fx, fy, cx, cy), width, height), file, image.name)
    return SourceView(
        name=f"{folder}/{image.name}", camera_from_world=pose, intrinsics=intrinsics, split=split, image_path=image
    )


def _also_tested(views: list[SourceView], tests: list[SourceView]) -> set[str]:
    """The names of training views whose photograph lies in both folders: under one name, with one pose or the same
    bytes (some programs number each folder anew)."""
    tested = {to_nfc(PurePosixPath(view.name).stem): view for view in tests}
    pairs = [(view, tested.get(to_nfc(PurePosixPath(view.name).stem))) for view in views if view.split == "train"]
    return {view.name for view, other in pairs if other is not None and _is_same(view, other)}


def _is_same(one: SourceView, other: SourceView) -> bool:
    if np.allclose(one.camera_from_world, other.camera_from_world, rtol=1e-6, atol=1e-6):
        return True
    a, b = one.image_path, other.image_path
    return a is not None and b is not None and filecmp.cmp(a, b, shallow=False)


def _load(file: Path) -> JsonObject:
    """A dictionary from a torch file; `weights_only`, so that nothing in it can run."""
    import torch  # here: other formats do without it, and it takes seconds

    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CaptureError(f"{file}: no such file; Mega-NeRF's layout needs it.") from None
    except PermissionError as error:
        raise CaptureError(f"{file}: {refusal(file, error)}") from None
    except Exception as error:  # its parsers raise many kinds on damaged files
        if "Unsupported global" in str(error):
            raise CaptureError(
                f"{file}: holds other things than tensors, texts and numbers, such as numbers of numpy, and these are "
                "not read. Save it anew with tensors (torch.as_tensor) and numbers of Python (float)."
            ) from None
        why = error.strerror if isinstance(error, OSError) else None
        # without torch's own words, which advise to load it in a way that lets code in it run
        raise CaptureError(
            f"{file}: cannot be read as a torch file ({why or 'damaged, cut off, or of another kind'}). Copy it again."
        ) from None
    if not isinstance(content, dict):
        raise CaptureError(f"{file}: must hold a dictionary.")
    return content


def _array(content: JsonObject, key: str, shape: tuple[int, ...], file: Path) -> np.ndarray:
    import torch

    try:
        array = torch.as_tensor(content[key], device="cpu").detach().to(torch.float64).numpy().reshape(shape)
    except (KeyError, TypeError, ValueError, RuntimeError):
        raise CaptureError(f"{file}: needs {key!r} of shape {list(shape)}. Copy the file again.") from None
    if not np.isfinite(array).all():
        raise CaptureError(f"{file}: {key!r} is not a finite number. Copy the file again.")
    return array


def _aliases(root: Path, views: list[SourceView]) -> dict[str, str]:
    """Original image names to ours, from mappings.txt ("DJI_0001.JPG,000000.pt")."""
    file = root / "mappings.txt"
    if not file.is_file():
        return {}
    ours = {Path(view.name).stem: view.name for view in views}
    aliases = {}
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        original, _, metadata = line.rpartition(",")
        if original and Path(metadata).stem in ours:
            aliases[original.strip()] = ours[Path(metadata).stem]
    return aliases
