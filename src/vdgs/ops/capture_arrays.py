"""A capture of pictures and cameras that a program has in memory: as the folder that every verb and function reads."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from vdgs.captures.formats.colmap_writing import write_model_files
from vdgs.captures.formats.ply_reader import GRAY
from vdgs.captures.image_files import MIN_SIDE_PX
from vdgs.captures.output_guard import check_no_link, check_output
from vdgs.config.typed_paths import home_path
from vdgs.errors import VdgsError, check_kind
from vdgs.geometry.camera import Camera, check_cameras
from vdgs.ops.arrays import Array, as_tensor, check_finite_points
from vdgs.sfm.capture_writer import MASK_FOLDER
from vdgs.sfm.mask_files import encode_mask
from vdgs.system.atomic_files import explain_disk_errors, write_bytes, write_json
from vdgs.system.lazy_pycolmap import pycolmap

#: Says that `write_capture` wrote a folder, which it may then replace.
MARK = "arrays.json"
_WRITTEN = {MARK, "images", MASK_FOLDER, "sparse"}


def write_capture(
    folder: str | Path,
    images: Iterable[Array],
    cameras: Sequence[Camera],
    *,
    points: Array | None = None,
    point_colors: Array | None = None,
    masks: Iterable[Array | None] | None = None,
    names: Sequence[str] | None = None,
) -> Path:
    """Write pictures and cameras as a capture, which `vdgs.load_capture`, `vdgs.train` and the verbs read; returns it.

    `images` are RGB, [h, w, 3] uint8 each, of any sizes, without lens distortion, each of the size of its camera (a
    generator is written picture by picture); `cameras` those of `cameras_from` or of another capture, pinhole, in one
    world of any unit, which `load_capture` brings into the ground frame (`capture.ground`). `points` [n, 3] are places
    in that world that pictures show, which a scene starts from, `point_colors` [n, 3] uint8; without points the folder
    still needs `vdgs sfm FOLDER --output CAPTURE`, which finds them. `masks` [h, w] bool (or uint8: kept from 128 up)
    keep what is true; None keeps all of a picture. `names` are those of the files, relative and ending in .png;
    pictures are used in the order of their names. Pictures are PNG, pixel by pixel those that were given. Needs
    pycolmap.

    Replaces a capture that it wrote, at the end and as a whole. Raises VdgsError for a folder that holds anything else,
    for cameras that are not pinhole ones, for points that are not finite and for names that are no file's; ValueError
    where shapes or numbers do not fit, TypeError for other kinds and dtypes.
    """
    target = home_path(folder)
    check_cameras(cameras)
    _check_replaceable(target)
    files = _checked_names(names, len(cameras))
    if other := next((each.model for each in cameras if each.model != "pinhole"), None):
        raise VdgsError(f"cameras must be pinhole ones, and one is {other}: photographs of captures are perspective")
    cloud = _cloud(points, point_colors)
    with explain_disk_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
        try:
            part.chmod(0o777 & ~_umask())
            _write_pictures(part, files, images, cameras, masks)
            _write_model(part / "sparse" / "0", files, cameras, cloud)
            write_json(part / MARK, {"written_by": "vdgs.write_capture", "images": len(files)})
            _replace(target, part)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return target


def _check_replaceable(target: Path) -> None:
    check_no_link(target)
    check_output(target)
    if target.exists() and not target.is_dir():
        raise VdgsError(f"{target}: is a file. Give a folder.")
    found = {each.name for each in target.iterdir()} if target.exists() else set()
    if found and (MARK not in found or found - _WRITTEN):
        others = sorted(found - _WRITTEN) or sorted(found)
        raise VdgsError(
            f"{target}: holds files that vdgs.write_capture did not write ({', '.join(others[:3])}). Give a new or an "
            "empty folder."
        )


def _checked_names(names: Sequence[str] | None, count: int) -> list[str]:
    if not count:
        raise ValueError("cameras is empty: there is nothing to write")
    if names is None:
        return [f"{index:06d}.png" for index in range(count)]
    files = list(names)
    if len(files) != count:
        raise ValueError(f"there are {len(files)} names and {count} cameras")
    for name in files:
        check_kind("each of names", name, str)
        path = PurePosixPath(name)
        whole = path.suffix.lower() == ".png" and not path.is_absolute() and ".." not in path.parts
        if not whole or str(path) != name or any(part.startswith(".") for part in path.parts) or "\\" in name:
            raise VdgsError(f"names: {name!r} is no name of a picture here; give relative ones, such as 'a/0001.png'")
    if len(set(map(str.lower, files))) != count:
        raise VdgsError("names: some are equal (capital letters aside); every picture needs a name of its own")
    return files


def _cloud(points: Array | None, colors: Array | None) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float64 and their colors [n, 3] uint8."""
    if points is None:
        if colors is not None:
            raise ValueError("point_colors are those of points, and there are none")
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    places = as_tensor("points", points)
    if places.ndim != 2 or places.shape[1] != 3:
        raise ValueError(f"points must be [n, 3], not {list(places.shape)}")
    check_finite_points(places)
    shown = np.full(places.shape, GRAY, np.uint8) if colors is None else _uint8("point_colors", colors)
    if shown.shape != tuple(places.shape):
        raise ValueError(f"point_colors must be {list(places.shape)}, not {list(shown.shape)}")
    return places.detach().cpu().double().numpy(), shown


def _uint8(name: str, value: Any) -> np.ndarray:
    check_kind(name, value, np.ndarray, Tensor)
    array = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
    if array.dtype != np.uint8:
        raise TypeError(f"{name} must be uint8, 0 to 255, not {array.dtype}: of 0 to 1 give np.uint8(255 * x + 0.5)")
    return array


def _write_pictures(
    root: Path, files: list[str], images: Iterable[Array], cameras: Sequence[Camera],
    masks: Iterable[Array | None] | None,
) -> None:  # fmt: skip
    end: Any = object()
    kept: Iterable[Any] = [None] * len(files) if masks is None else masks
    rows: Iterable[tuple[Any, Any, Any, Any]] = zip_longest(images, kept, files, cameras, fillvalue=end)
    for index, (image, mask, name, camera) in enumerate(rows):
        if any(each is end for each in (image, mask, name)):
            raise ValueError(f"there must be an image (and a mask, or None) for each of the {len(files)} cameras")
        pixels = _uint8(f"images[{index}]", image)
        size: tuple[int, int] = (camera.height, camera.width)
        if pixels.shape != (*size, 3):
            raise ValueError(f"images[{index}] must be {[*size, 3]}, as its camera, not {list(pixels.shape)}")
        if min(size) < MIN_SIDE_PX:
            raise ValueError(f"images[{index}] is smaller than {MIN_SIDE_PX} pixels")
        encoded = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1]
        _write(root / "images" / name, encoded.tobytes())
        if mask is not None:
            _write(root / MASK_FOLDER / f"{name}.png", encode_mask(_keep(f"masks[{index}]", mask, size)))


def _keep(name: str, mask: Any, size: tuple[int, int]) -> np.ndarray:
    check_kind(name, mask, np.ndarray, Tensor)
    array = mask.detach().cpu().numpy() if isinstance(mask, Tensor) else mask
    if array.dtype not in (np.bool_, np.uint8):
        raise TypeError(f"{name} must be bool or uint8, not {array.dtype}")
    if array.shape != size:
        raise ValueError(f"{name} must be {list(size)}, not {list(array.shape)}")
    return array if array.dtype == np.bool_ else array >= 128


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, content)


def _write_model(
    folder: Path, files: list[str], cameras: Sequence[Camera], cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    """A COLMAP model: one camera for all pictures of the same size and intrinsics."""
    model, numbers = pycolmap.Reconstruction(), dict[tuple[float, ...], int]()
    for index, (name, camera) in enumerate(zip(files, cameras, strict=True), start=1):
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        if lens not in numbers:
            numbers[lens] = len(numbers) + 1
            width, height, *params = lens
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    model="PINHOLE", width=int(width), height=int(height), params=list(map(float, params)),
                    camera_id=numbers[lens],
                )
            )  # fmt: skip
        pose = np.asarray(camera.camera_from_world, np.float64)
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, keypoints=np.empty((0, 2)), camera_id=numbers[lens], image_id=index), motion
        )
    for place, color in zip(*cloud, strict=True):
        model.add_point3D(place, pycolmap.Track(), color)
    write_model_files(model, folder)


def _replace(target: Path, part: Path) -> None:
    """Put a finished folder in the place of another one, or of none."""
    if not target.exists():
        part.rename(target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
    target.rename(old)
    part.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    """Of this process: folders of `mkdtemp` are for their owner alone."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
