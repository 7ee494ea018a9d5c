"""Pictures that programs stitched of several photographs and gave the tags of one: no lens took them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

from vdgs.sfm.image_metadata import UNKNOWN_CAMERA, ImageMetadata

#: The longer side by the shorter one: longer than this are no photographs of drones' sensors (16:9 is 1.78; choice).
_LONG_SHAPE = 2.2
#: How programs and cameras name them: DJI_0003-Pano.jpg, PANO0001.JPG, roof_panorama-2.jpg.
_NAMED = re.compile(r"(?:^|[\W_]|\d)pano(?:rama)?s?(?:[\W_]|\d|$)", re.IGNORECASE)


def stitched(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """Long pictures among photographs of another shape by their camera, with the reason: those named panoramas, and
    those that are longer than each of these photographs, of which they are no crop."""
    usual, found = _usual_sizes(photographs), dict[str, str]()
    for photo in photographs:
        size = usual[photo.camera]
        if _shape(photo.size) < _LONG_SHAPE or _shape(size) >= _LONG_SHAPE or photo.is_panorama:
            continue
        if photo.is_bare or photo.camera.startswith(UNKNOWN_CAMERA):  # of cameras that nothing tells apart
            continue
        named = _NAMED.search(PurePosixPath(photo.name).stem) is not None
        if named or max(photo.size) > max(size):
            found[photo.name] = (
                f"is stitched of several photographs by its {'name and ' if named else ''}size ({photo.width} x "
                f"{photo.height}; those of its camera {size[0]} x {size[1]}): give the photographs that it was made of"
            )
    return found


def _usual_sizes(photographs: Sequence[ImageMetadata]) -> dict[str, tuple[int, int]]:
    """The size that most photographs of each camera have; of those that are as many, the largest."""
    counts: dict[str, Counter[tuple[int, int]]] = {}
    for photo in photographs:
        counts.setdefault(photo.camera, Counter())[photo.size] += 1
    return {camera: max(sizes, key=lambda size: (sizes[size], size)) for camera, sizes in counts.items()}


def _shape(size: tuple[int, int]) -> float:
    return max(size) / min(size)
