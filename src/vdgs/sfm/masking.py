"""What masks and transparency leave of photographs: upright for the search of features, straight for the capture."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from vdgs.captures.image_files import decode_mask, decode_photograph, read_header, same_shape
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import Photograph
from vdgs.sfm.workspace import Work
from vdgs.system.atomic_files import write_bytes
from vdgs.system.stop_signals import stop_if_asked


def write_upright_masks(work: Work, photographs: Sequence[Photograph], threads: int) -> None:
    """Fill the work folder with masks of upright photographs, for those of which something is left out. What is there
    is kept. Raises CaptureError for a mask that cannot be decoded."""
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(partial(_write_one, work), [photo for photo in photographs if photo.may_be_masked]):
            stop_if_asked()


def kept_of(photo: Photograph) -> np.ndarray | None:
    """What counts of a photograph once it is upright, [h, w] bool; None: all of it.

    A mask is of the file as it is, before EXIF's orientation, unless only the upright photograph has its shape.
    """
    keep = _opaque(photo) if photo.may_be_transparent else None
    if photo.mask is None:
        return keep
    header = read_header(photo.mask)
    if same_shape((header.width, header.height), photo.stored_size):
        masked = upright(decode_mask(photo.mask, *photo.stored_size), photo.orientation)
    else:
        masked = decode_mask(photo.mask, *photo.size)
    return masked if keep is None else masked & keep


def _opaque(photo: Photograph) -> np.ndarray | None:
    try:
        opaque = decode_photograph(photo.path)[1]
    except CaptureError:  # the search of features leaves damaged photographs out
        return None
    return None if opaque is None else upright(opaque, photo.orientation)


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels [h, w] of a file turned and mirrored as EXIF's orientation says."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.T
    down, across = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return pixels[:: -1 if down else 1, :: -1 if across else 1]


def _write_one(work: Work, photo: Photograph) -> None:
    stop_if_asked()
    target = work.mask(photo.name)
    if target.is_file():
        return
    keep = kept_of(photo)
    if keep is not None:
        write_bytes(target, png_of(keep))


def png_of(keep: np.ndarray) -> bytes:
    """A mask [h, w] bool as a file: white is kept."""
    return cv2.imencode(".png", keep.astype(np.uint8) * 255)[1].tobytes()


def straight_mask(mask: Path, grid: np.ndarray, shrunk: tuple[int, int]) -> np.ndarray:
    """A mask as its photograph becomes without distortion, [h, w] bool: of pixels that are shrunk together only those
    of which all is kept, so that what is masked does not bleed in."""
    pixels = decode_photograph(mask)[0][..., 0]
    straight = cv2.remap(pixels, grid[..., 0], grid[..., 1], cv2.INTER_NEAREST, borderValue=(0.0,))
    if straight.shape[1::-1] != shrunk:
        straight = cv2.resize(straight.astype(np.float32), shrunk, interpolation=cv2.INTER_AREA)
    return straight >= 255 * (1 - 1e-4)
