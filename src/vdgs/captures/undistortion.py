"""Lens distortion removed: photographs resampled to pinhole cameras, written once and reused."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from vdgs.captures.options import CaptureOptions
from vdgs.captures.photographs import decode_photograph
from vdgs.captures.source import Intrinsics
from vdgs.errors import CaptureError

JPEG_QUALITY = 95
#: One undistorted photograph: name, file, intrinsics at the file's size.
Photograph = tuple[str, Path, Intrinsics]


def undistort(
    root: Path, photographs: list[Photograph], options: CaptureOptions, warnings: list[str]
) -> list[tuple[Path, Intrinsics]]:
    """Pinhole versions of the photographs: their files and PINHOLE intrinsics.

    Files are written under `options.undistorted_folder` (default `root`/undistorted/<image folder's
    name>), each beside a small JSON that says from which file, of which size and date, and with which
    camera it was made; what matches is reused. Photographs without distortion pass through. Raises
    `CaptureError` if the folder cannot be written or an image cannot be decoded.
    """
    folder = options.undistorted_folder or root / "undistorted" / (options.images or "images")
    bent = [photo for photo in photographs if photo[2].distorted]
    targets = {intrinsics: pinhole_for(intrinsics) for _, _, intrinsics in bent}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(2) as pool:
            files = dict(
                zip(
                    (name for name, _, _ in bent),
                    pool.map(lambda photo: _undistorted_file(folder, photo, targets[photo[2]]), bent),
                    strict=True,
                )
            )
    except OSError as error:
        raise CaptureError(
            f"{folder}: cannot be written ({error.strerror or error}). "
            "Choose a folder for the undistorted photographs with --undistorted-folder."
        ) from error
    warnings.append(f"{len(bent)} photographs were undistorted into {folder}.")
    return [
        (files[name], targets[intrinsics]) if name in files else (path, intrinsics)
        for name, path, intrinsics in photographs
    ]


def pinhole_for(intrinsics: Intrinsics) -> Intrinsics:
    """The pinhole camera whose picture holds no blank pixels (COLMAP's own choice of size and centre)."""
    try:
        camera = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), _colmap(intrinsics))
    except Exception as error:  # pycolmap raises plain ValueError and RuntimeError kinds
        raise CaptureError(
            f"the camera {intrinsics.model} {intrinsics.params} cannot be undistorted ({error}). "
            "Undistort with colmap image_undistorter and use its output folder."
        ) from error
    centre = (camera.principal_point_x, camera.principal_point_y)
    focal = (camera.focal_length_x, camera.focal_length_y)
    return Intrinsics("PINHOLE", (*focal, *centre), camera.width, camera.height)


def sampling_map(distorted: Intrinsics, pinhole: Intrinsics) -> np.ndarray:
    """Where each pixel of the pinhole picture lies in the distorted one, [h, w, 2] float32, OpenCV's
    convention.

    Pixel centres are at 0.5 here and at 0 in `cv2.remap`.
    """
    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal_point
    x = (np.arange(pinhole.width) + 0.5 - cx) / fx
    y = (np.arange(pinhole.height) + 0.5 - cy) / fy
    rays = np.stack([*np.broadcast_arrays(x[None], y[:, None]), np.ones((len(y), len(x)))], axis=-1)
    pixels = np.asarray(_colmap(distorted).img_from_cam(rays.reshape(-1, 3)), dtype=np.float64)
    pixels = np.where(np.isfinite(pixels), pixels, -1e6)  # behind a fisheye's rim: outside
    return (pixels - 0.5).reshape(pinhole.height, pinhole.width, 2).astype(np.float32)


def _undistorted_file(folder: Path, photo: Photograph, pinhole: Intrinsics) -> Path:
    name, path, intrinsics = photo
    target = folder / Path(name).with_suffix(".jpg")
    stamp_file = target.with_suffix(".json")
    status = path.stat()
    stamp = {
        "source": str(path.resolve()), "bytes": status.st_size, "modified_ns": status.st_mtime_ns,
        "camera": [intrinsics.model, *intrinsics.params, intrinsics.width, intrinsics.height],
    }  # fmt: skip
    if target.is_file() and _read_json(stamp_file) == stamp:
        return target
    pixels, _ = decode_photograph(path)
    grid = sampling_map(intrinsics, pinhole)
    straight = cv2.remap(pixels, grid[..., 0], grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    encoded = cv2.imencode(".jpg", cv2.cvtColor(straight, cv2.COLOR_RGB2BGR), settings)[1]
    target.parent.mkdir(parents=True, exist_ok=True)
    _write(target, encoded.tobytes())
    _write(stamp_file, json.dumps(stamp).encode())
    return target


def _read_json(file: Path) -> object:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _write(file: Path, data: bytes) -> None:
    """Write under a temporary name, then rename: a run that is cut off leaves no half image."""
    part = file.with_name(file.name + ".part")
    part.write_bytes(data)
    os.replace(part, file)


def _colmap(intrinsics: Intrinsics) -> pycolmap.Camera:
    return pycolmap.Camera(
        model=intrinsics.model,
        width=intrinsics.width,
        height=intrinsics.height,
        params=list(intrinsics.params),
    )
