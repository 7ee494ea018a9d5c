"""Rotations of BlocksExchange, and what tie points tell where a file may be read in two ways.

Bentley's description of Yaw, Pitch and Roll leaves open from which end of the axis a roll is seen, and programs differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from vdgs.captures.formats.lens_projection import pixel_rays
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.formats.xml_documents import xml_number
from vdgs.errors import CaptureError

#: Rolls in degrees that are none.
_LEVEL_DEG = 1e-3
#: Tie points agree with a way where the median of their reprojection errors is at most this many pixels (choice).
_AGREES_PX = 3.0
ASK_FOR_MATRIX = "which programs mean in different ways: export it as a matrix, or as Omega, Phi, Kappa"


class TwoWays(NamedTuple):
    """A photograph that may be read in two ways: its pose and the points that it shows in each, and where."""

    intrinsics: Intrinsics
    poses: tuple[np.ndarray, np.ndarray]
    points: tuple[np.ndarray, np.ndarray]
    pixels: np.ndarray


def has_roll(element: Element, file: Path) -> bool:
    return element.find("Yaw") is not None and abs(xml_number(element, "Roll", file, "a rotation")) >= _LEVEL_DEG


def block_rotation(element: Element, file: Path, roll: int = 1) -> np.ndarray:
    """From the world to the axes of the camera; a positive Roll turns the camera clockwise, seen from behind, where
    `roll` is 1, and counter-clockwise where it is -1."""

    def value(tag: str) -> float:
        return xml_number(element, tag, file, "a rotation")

    if element.find("M_00") is not None:
        return np.array([[value(f"M_{row}{column}") for column in range(3)] for row in range(3)])
    if element.find("Omega") is not None:
        omega, phi, kappa = (math.radians(value(tag)) for tag in ("Omega", "Phi", "Kappa"))
        return (_about_x(omega) @ _about_y(phi) @ _about_z(kappa)).T
    if element.find("Yaw") is not None:
        yaw, pitch, turn = (math.radians(value(tag)) for tag in ("Yaw", "Pitch", "Roll"))
        level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y, z is up
        return level @ (_about_z(-yaw) @ _about_x(pitch) @ _about_y(roll * turn)).T
    kinds = ", ".join(child.tag for child in element) or "nothing"
    raise CaptureError(f"the rotation is given by {kinds}, {ASK_FOR_MATRIX}")


def told_by_points(photographs: Iterable[TwoWays]) -> tuple[int | None, list[float]]:
    """Which way the tie points of photographs agree with, or None, and their median reprojection errors."""
    errors: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for photo in photographs:
        seen = pixel_rays(photo.intrinsics, photo.pixels)
        for pose, points, found in zip(photo.poses, photo.points, errors, strict=True):
            across = points @ pose[:3, :3].T + pose[:3, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                gap = np.hypot(*((across[:, :2] / across[:, 2:] - seen) * photo.intrinsics.focal).T)
            found.append(np.where(across[:, 2] > 0, gap, np.inf)[np.isfinite(seen).all(axis=1)])
    medians = [float(np.median(each)) if (each := np.concatenate([np.empty(0), *found])).size else np.inf
               for found in errors]  # fmt: skip
    best = int(np.argmin(medians))
    return best if medians[best] <= _AGREES_PX else None, medians


def _about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


def _about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
