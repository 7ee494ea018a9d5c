"""A model brought to metres, east, north and up: by positions, and by recorded attitudes where they do not do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from vdgs.captures.ground_estimation import rotation_to_z
from vdgs.captures.up_axis import estimate_up
from vdgs.geometry.similarity import Similarity, disagreement, fit_similarity_robust, is_collinear
from vdgs.sfm.gps_priors import LEAST_POSITIONS, Positions
from vdgs.sfm.image_metadata import Photograph

#: Attitudes that agree on which way a world lies, at least.
LEAST_ATTITUDES = 3
#: Directions of flight tell a tilt from how a camera hangs if they spread so far: a ratio of singular values.
SEVERAL_WAYS = 0.3
#: Positions fix a turn about a line if they spread across it this many times their standard deviation.
WRONG_TIMES = 3.0
WRITE_GPS = "let the drone write GPS into the photographs: metres, north, maps."
BETTER_POSITIONS = (
    "take photographs over many times more than positions are wrong by, or give better positions: a receiver with RTK, "
    "a table (--gps) or surveyed points (--gcp)."
)


@dataclass(frozen=True, eq=False)
class Placed:
    """How a model was brought to its place on Earth."""

    similarity: Similarity
    """From the model's own world to metres east, north, up of the positions' origin."""
    how: str
    rows: np.ndarray
    """Which positions have a placed photograph, [m] rows of `Positions`."""
    residuals: np.ndarray
    """Of them, placed minus recorded, metres [m, 3]."""
    inliers: np.ndarray
    """Which of them the placing trusts, [m] bool."""


@dataclass(frozen=True)
class Unplaced:
    """Why a model was not brought to a place on Earth, and what to do about it."""

    why: str
    remedy: str


def place(model: pycolmap.Reconstruction, photographs: Sequence[Photograph], positions: Positions) -> Placed | Unplaced:
    """The similarity that brings the model to its positions, or why they do not tell one: they are too few, or wrong by
    too much of how far they spread. Does not change the model."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centres, targets = _matched(images, photographs, positions)
    if not positions.usable or len(rows) < LEAST_POSITIONS:
        few = f"{len(positions)} positions, of placed photographs, are too few"
        return Unplaced(few if len(positions) else "no positions that can be used", WRITE_GPS)
    if not is_collinear(centres) and not is_line(targets, positions.deviations[rows]):
        similarity, inliers = fit_similarity_robust(centres, targets)
        how = f"positions of {int(inliers.sum())} photographs ({positions.source})"
    else:
        rotation, by = _level(model, images, photographs, centres, targets)
        similarity, inliers = _scaled(rotation, centres, targets), np.ones(len(rows), bool)
        how = f"positions of {len(rows)} photographs along one line ({positions.source}), up by {by}"
    residuals = similarity.apply(centres) - targets
    how_far = disagreement(residuals, targets[inliers], inliers)
    if how_far:
        why = f"the positions ({positions.source}) and where the photographs were placed disagree: {how_far}"
        return Unplaced(why, BETTER_POSITIONS)
    return Placed(similarity, how, rows, residuals, inliers)


def as_it_lies(
    model: pycolmap.Reconstruction, photographs: Sequence[Photograph], positions: Positions, how: str
) -> Placed:
    """A model that was brought to its place by other things than positions, and how far those are from it."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centres, targets = _matched(images, photographs, positions)
    stays = Similarity(1.0, np.eye(3), np.zeros(3))
    return Placed(stays, how, rows, centres - targets, np.ones(len(rows), bool))


def is_line(places: np.ndarray, deviations: np.ndarray) -> bool:
    """Whether places [n, 3] leave a turn about a line open: they spread across it no more than they may be wrong."""
    if is_collinear(places):
        return True
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(places))
    return bool(spread < WRONG_TIMES * np.sqrt(np.median((deviations**2).mean(axis=1))))


def move(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Bring a model into another world, in place."""
    rotation = pycolmap.Rotation3d(np.ascontiguousarray(similarity.rotation))
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))


def points_of(model: pycolmap.Reconstruction) -> np.ndarray:
    """Places of all points, [n, 3]."""
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def tilt_against_attitudes(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> float | None:
    """Angle in degrees between down as the placed model has it and as the drone recorded it.

    Recorded down in the camera is down of the model, turned by a tilt of the world and by how the camera hangs on the
    drone, which is the same in all photographs. Flown in several directions the two are told apart, by least squares
    for small angles; in one, all is taken for a tilt.
    """
    gravity = {photo.name: photo.attitude.gravity for photo in photographs if photo.attitude}
    images = [image for image in model.images.values() if image.has_pose and image.name in gravity]
    if len(images) < LEAST_ATTITUDES:
        return None
    rotations = np.array([_rotation(image) for image in images])
    off = np.array([gravity[image.name] for image in images]) + rotations[:, :, 2]
    hangs = np.broadcast_to(np.eye(3)[:, :2], (len(images), 3, 2))
    for unknown in (np.concatenate([rotations[:, :, :2], hangs], axis=2), rotations[:, :, :2]):
        flat = unknown.reshape(-1, unknown.shape[2])
        singular = np.linalg.svd(flat, compute_uv=False)
        if singular[-1] > SEVERAL_WAYS * singular[0]:
            break
    tilt = np.linalg.lstsq(flat, off.ravel(), rcond=None)[0][:2]
    return float(np.degrees(np.linalg.norm(tilt)))


def _matched(
    images: Mapping[str, pycolmap.Image], photographs: Sequence[Photograph], positions: Positions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [m] of the positions whose photographs are placed, where those were placed [m, 3], and the positions."""
    rows = np.array([row for row, i in enumerate(positions.index) if photographs[int(i)].name in images], int)
    names = [photographs[int(positions.index[row])].name for row in rows]
    centres = np.array([images[name].projection_center() for name in names]).reshape(-1, 3)
    return rows, centres, positions.enu[rows]


def _rotation(image: pycolmap.Image) -> np.ndarray:
    return np.asarray(image.cam_from_world().rotation.matrix())


def _level(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    photographs: Sequence[Photograph],
    centres: np.ndarray,
    targets: np.ndarray,
) -> tuple[np.ndarray, str]:
    """The rotation into east, north, up where positions along a line leave a turn about it open."""
    found = [
        photo.attitude.camera_from_enu.T @ _rotation(images[photo.name])
        for photo in photographs
        if photo.attitude is not None and photo.name in images
    ]
    if len(found) >= LEAST_ATTITUDES:
        left, _, right = np.linalg.svd(np.sum(found, axis=0))
        mean = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        return _along(mean, centres, targets) @ mean, "the recorded attitudes"
    rotations = np.array([_rotation(image) for image in images.values()])
    up, _ = estimate_up(centres, rotations, points_of(model), [])
    level = rotation_to_z(up)
    return _along(level, centres, targets) @ level, "the views"


def _along(rotation: np.ndarray, centres: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The turn about up that brings the line of the cameras onto that of the positions."""
    one, other = (centres - centres.mean(axis=0)) @ rotation.T, targets - targets.mean(axis=0)
    angle = np.arctan2((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum(), (one[:, :2] * other[:, :2]).sum())
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def _scaled(rotation: np.ndarray, centres: np.ndarray, targets: np.ndarray) -> Similarity:
    """Scale and translation by least squares, the rotation as it is."""
    turned = centres @ rotation.T
    one, other = turned - turned.mean(axis=0), targets - targets.mean(axis=0)
    scale = float((one * other).sum() / (one**2).sum())
    return Similarity(scale, rotation, targets.mean(axis=0) - scale * turned.mean(axis=0))
