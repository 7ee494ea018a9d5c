"""Lens distortion removed: photographs resampled to pinhole cameras, written once and reused."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from vdgs.captures.formats.lens_projection import is_valid_ray, ray_pixels
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.image_files import decode_image, decode_mask, verify_image
from vdgs.captures.name_resolution import jpeg_name
from vdgs.captures.pinholes import undistorted_pinhole
from vdgs.errors import CaptureError
from vdgs.system.atomic_files import read_json_or_empty, write_bytes

JPEG_QUALITY = 95
NUM_THREADS = 2
#: Pixels of a sampling map that are made at once.
STRIP_PX = 1 << 18


@dataclass(frozen=True)
class ImageFile:
    """A photograph on disk: name, image, mask where there is one, intrinsics at the image's size."""

    name: str
    path: Path
    mask: Path | None
    intrinsics: Intrinsics


def undistort(folder: Path, photographs: list[ImageFile]) -> list[ImageFile]:
    """Pinhole versions of the photographs and their masks.

    Files are written under `folder`, each image beside a small JSON that says from which files, of which
    size and date, and from which camera to which it was made; what matches is reused. Photographs without
    distortion pass through. Raises `CaptureError` if the folder cannot be written or an image cannot be
    decoded.
    """
    bent = [photo for photo in photographs if photo.intrinsics.is_distorted]
    targets = {lens: undistorted_pinhole(lens) for lens in dict.fromkeys(photo.intrinsics for photo in bent)}
    # Lens by lens, so that few maps are kept at a time, however many lenses there are.
    numbers = {lens: number for number, lens in enumerate(targets)}
    bent.sort(key=lambda photo: numbers[photo.intrinsics])
    lock, kept = threading.Lock(), lru_cache(NUM_THREADS)(sampling_map)

    def map_of(lens: Intrinsics) -> np.ndarray:
        with lock:  # whoever needs the same one waits for it
            return kept(lens, targets[lens])

    def one(photo: ImageFile) -> ImageFile:
        return _undistort_one(folder, photo, targets[photo.intrinsics], map_of)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ThreadPoolExecutor(NUM_THREADS) as pool:
            straight = dict(zip((photo.name for photo in bent), pool.map(one, bent), strict=True))
        return [straight.get(photo.name, photo) for photo in photographs]
    except OSError as error:
        raise CaptureError(
            f"{folder}: cannot be written ({error.strerror or error}). "
            "Choose a folder for the undistorted photographs with --undistorted-folder."
        ) from error


def sampling_map(distorted: Intrinsics, pinhole: Intrinsics, strip_px: int = STRIP_PX) -> np.ndarray:
    """Where each pixel of the pinhole picture lies in the distorted one, [h, w, 2] float32.

    In OpenCV's convention: pixel centers are at 0.5 here and at 0 in `cv2.remap`. Made `strip_px` pixels at a
    time: all at once would take eight times the memory of the map.
    """
    (fx, fy), (cx, cy) = pinhole.focal, pinhole.principal_point
    x = (np.arange(pinhole.width) + 0.5 - cx) / fx
    rows = max(1, strip_px // pinhole.width)
    found = np.empty((pinhole.height, pinhole.width, 2), np.float32)
    for first in range(0, pinhole.height, rows):
        y = (np.arange(first, min(first + rows, pinhole.height)) + 0.5 - cy) / fy
        rays = np.stack(np.broadcast_arrays(x[None], y[:, None]), axis=-1).reshape(-1, 2)
        pixels = ray_pixels(distorted, rays)
        shown = np.isfinite(pixels) & is_valid_ray(distorted, rays)[:, None]
        pixels = np.where(shown, pixels, -1e6)  # behind a fisheye's rim, or where a lens folds over: outside
        found[first : first + rows] = (pixels - 0.5).reshape(len(y), len(x), 2)
    return found


def _undistort_one(
    folder: Path, photo: ImageFile, pinhole: Intrinsics, map_of: Callable[[Intrinsics], np.ndarray]
) -> ImageFile:
    target = folder / jpeg_name(photo.name)
    mask_target, stamp_file = (target.with_name(target.name + suffix) for suffix in (".mask.png", ".json"))
    lens = photo.intrinsics
    stamp: dict[str, object] = {
        kind: [each.model, *each.params, each.width, each.height] for kind, each in (("camera", lens), ("to", pinhole))
    }
    for kind, file in (("image", photo.path), ("mask", photo.mask)):
        status = file.stat() if file else None
        stamp[kind] = status and [str(file), status.st_size, status.st_mtime_ns]
    known = read_json_or_empty(stamp_file)
    if not (target.is_file() and known.get("made_from") == stamp):
        stamp_file.unlink(missing_ok=True)  # before: what is written is of this stamp only once all is
        keep = _write_straight(photo, map_of(lens), target, mask_target)
        write_bytes(stamp_file, json.dumps({"made_from": stamp, "mask": keep}).encode())
        known = {"mask": keep}
    mask = mask_target if known.get("mask") and mask_target.is_file() else None
    return ImageFile(photo.name, target, mask, pinhole)


def _write_straight(photo: ImageFile, grid: np.ndarray, target: Path, mask_target: Path) -> bool:
    """Write the straightened image (`grid` as of `sampling_map`), and its mask if there is one (from a file or from
    transparency). Raises CaptureError for a damaged photograph, whose straightened copy would look sound."""
    verify_image(photo.path)
    pixels, keep = decode_image(photo.path)
    if photo.mask is not None:
        masked = decode_mask(photo.mask, pixels.shape[1], pixels.shape[0])
        keep = masked if keep is None else masked & keep
    x, y = grid[..., 0], grid[..., 1]
    straight = cv2.remap(pixels, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    write_bytes(target, encode_jpeg(straight))
    if keep is None:
        return False
    mask = cv2.remap(keep.astype(np.uint8) * 255, x, y, cv2.INTER_NEAREST, borderValue=(0.0,))
    write_bytes(mask_target, cv2.imencode(".png", mask)[1].tobytes())
    return True


def encode_jpeg(pixels: np.ndarray) -> bytes:
    """A JPEG of RGB pixels [h, w, 3] uint8, with as many samples of color as of brightness."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    return cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), settings)[1].tobytes()
