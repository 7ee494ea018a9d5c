"""How the axes of a file stand: which of them is up, and whether it is read as right-handed or left-handed.

Each format has axes that its readers expect; `vdgs export --axes` and `--for` ask for others. A file says how its axes
stand, in its header or in FILE.json, so that a reader of ours finds the way back to the ground frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from vdgs.model.gaussian_transform import transform_gaussians
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import read_json_or_empty


@dataclass(frozen=True, eq=False)
class Axes:
    """What the coordinates of a file mean."""

    name: str
    #: As files of scenes with a place on Earth say it.
    description: str
    #: From the ground frame (x east, y north, z up) to these axes: a rotation, or one with a reflection.
    turn: Float[np.ndarray, "3 3"]

    @property
    def without_compass(self) -> str:
        """As files of other scenes say it, which know up alone: the axes of the ground frame that x, y and z are."""
        along = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in self.turn]
        return f"{', '.join(along)} of the ground frame (its z is up; north is not known)"

    def words(self, has_compass: bool) -> str:
        """What a file says of its axes."""
        return self.description if has_compass or self is EARTH_CENTERED else self.without_compass

    def of_ground(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the ground frame along these axes."""
        return gaussians if self is Z_UP else reoriented(gaussians, self.turn)

    def to_ground(self, gaussians: Gaussians) -> Gaussians:
        """The inverse of `of_ground`."""
        return gaussians if self is Z_UP else reoriented(gaussians, self.turn.T)


Z_UP = Axes("z-up", "x east, y north, z up", np.eye(3))
#: glTF's, SPZ's, three.js'.
Y_UP = Axes("y-up", "x east, y up, z south", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
#: What viewers of PlayCanvas' and of `.splat` files turn by half a turn about z, so that it stands upright.
Y_DOWN = Axes("y-down", "x west, y down, z south", np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]]))
#: Left-handed: Unity's.
Y_UP_LEFT = Axes("y-up-left", "x east, y up, z north", np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]))
#: Of points in Earth-centered coordinates, which no program stands upright.
EARTH_CENTERED = Axes(
    "earth-centered", "x to latitude 0 longitude 0, y to latitude 0 longitude 90 east, z to the north pole", np.eye(3)
)
ALL = (Z_UP, Y_UP, Y_DOWN, Y_UP_LEFT)
BY_NAME = {axes.name: axes for axes in ALL}


def reoriented(gaussians: Gaussians, turn: Float[np.ndarray, "3 3"]) -> Gaussians:
    """Gaussians under an orthogonal matrix: turned, and mirrored where its determinant is negative."""
    if np.linalg.det(turn) < 0:
        gaussians, turn = _mirrored(gaussians), turn @ np.diag([1.0, 1.0, -1.0])
    return transform_gaussians(gaussians, 1.0, turn, np.zeros(3))


def _mirrored(gaussians: Gaussians) -> Gaussians:
    """Gaussians under z -> -z. Of the spherical harmonics those change their sign whose degree and order add up to an
    odd number."""
    degree = math.isqrt(gaussians.shN.shape[1] + 1) - 1
    signs = [(-1.0) ** (band + order) for band in range(1, degree + 1) for order in range(-band, band + 1)]
    return replace(
        gaussians,
        means=gaussians.means * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float32, device="cpu"),
        quaternions=gaussians.quaternions * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float32, device="cpu"),
        shN=gaussians.shN * torch.tensor(signs, dtype=torch.float32, device="cpu").reshape(1, -1, 1),
    )


def axes_named(words: object, usual: Axes) -> Axes:
    """The axes that a file describes by these words; the usual ones of its format where it says nothing."""
    return next((axes for axes in ALL if words in (axes.description, axes.without_compass)), usual)


def axes_beside(path: Path, usual: Axes) -> Axes:
    """The axes that FILE.json names; the usual ones where there is none."""
    return axes_named(read_json_or_empty(path.with_name(path.name + ".json")).get("axes"), usual)


def in_ground(pieces: Iterator[Gaussians], axes: Axes) -> Iterator[Gaussians]:
    """Pieces of a file along these axes, in the ground frame."""
    return map(axes.to_ground, pieces)
