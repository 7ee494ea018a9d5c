"""What both forms of a COLMAP model hold: cameras by number, images, points by number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.captures.formats.source_capture import MODEL_PARAMETERS, Intrinsics, check_intrinsics, say_of_panoramas
from vdgs.errors import CaptureError

#: So many of the points that a photograph shows are remembered: enough to see whether cameras and points agree, and
#: whether photographs are equally bright.
MAX_OBSERVATIONS = 400


#: Cameras by number; of those that cannot be used the error, which concerns who uses one: models hold unused ones.
Cameras = dict[int, Intrinsics | CaptureError]


class ColmapPoints(NamedTuple):
    """Points [n, 3] float64 and colors [n, 3] uint8 with the numbers [n] by which images name them."""

    point_ids: np.ndarray
    positions: np.ndarray
    colors: np.ndarray


def empty_points() -> ColmapPoints:
    return ColmapPoints(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True, eq=False)
class ColmapImage:
    quaternion: tuple[float, ...]  # wxyz
    translation: tuple[float, ...]
    camera: int
    name: str
    #: Some of the points that it shows: their numbers [m], and the pixels [m, 2] where.
    observations: tuple[np.ndarray, np.ndarray]


def sample_observations(numbers: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `MAX_OBSERVATIONS` of an image's points that are points of the model, at random; copies. A point that one
    image remembers is likely to be remembered by others that show it: chance depends on its number alone."""
    matched = np.flatnonzero((numbers >= 0) & (numbers < 2**63) & np.isfinite(pixels).all(axis=1))
    few = np.sort(matched[np.argsort(_chance(numbers[matched].astype(np.int64)), kind="stable")[:MAX_OBSERVATIONS]])
    return numbers[few].astype(np.int64), pixels[few]


def _chance(numbers: np.ndarray) -> np.ndarray:
    """A number at random for each, uint64: the finaliser of splitmix64 (Steele et al. 2014)."""
    mixed = numbers.view(np.uint64).copy()
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return mixed ^ (mixed >> np.uint64(31))


def unsupported_model(file: Path, where: str, model: str) -> CaptureError:
    """The error of a camera model that is not read."""
    return CaptureError(
        f"{file}: {where}: {model} is no camera model that is supported. Supported: {', '.join(MODEL_PARAMETERS)}."
        f"{say_of_panoramas(model)}"
    )


def add_camera(cameras: Cameras, identifier: int, camera: Intrinsics | CaptureError, file: Path) -> None:
    """Add a camera, or why it cannot be used. Raises `CaptureError` for a second one of a number."""
    if identifier in cameras:
        raise CaptureError(f"{file}: camera {identifier} occurs twice. Export the COLMAP model again.")
    if isinstance(camera, Intrinsics):
        try:
            check_intrinsics(camera, file, f"camera {identifier}")
        except CaptureError as error:
            camera = error
    cameras[identifier] = camera
