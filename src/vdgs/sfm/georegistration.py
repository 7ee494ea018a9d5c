"""A model brought to metres, east, north and up: by positions, and by recorded attitudes where they do not do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from vdgs.captures.ground_estimation import rotation_to_z
from vdgs.captures.up_axis import estimate_up
from vdgs.geometry.similarity import Similarity, describe_disagreement, fit_similarity_robust, is_collinear
from vdgs.sfm.gps_priors import MIN_POSITIONS, GpsPriors
from vdgs.sfm.image_metadata import ImageMetadata

#: Attitudes that agree on which way a world lies, at least.
MIN_ATTITUDES = 3
#: Directions of flight tell a tilt from how a camera hangs if they spread so far: a ratio of singular values.
MIN_HEADING_SPREAD = 0.3
#: Positions fix a turn about a line if they spread across it this many times their standard deviation.
MIN_SPREAD_SIGMAS = 3.0
ADVICE_WRITE_GPS = "let the drone write GPS into the photographs: metres, north, maps."
ADVICE_BETTER_POSITIONS = (
    "take photographs over many times more than positions are wrong by, or give better positions: a receiver with RTK, "
    "a table (--gps) or surveyed points (--gcp)."
)


@dataclass(frozen=True, eq=False)
class Georegistration:
    """How a model was brought to its place on Earth."""

    similarity: Similarity
    """From the model's own world to metres east, north, up of the positions' origin."""
    method: str
    position_rows: np.ndarray
    """Which positions have a placed photograph, [m] rows of `GpsPriors`."""
    residuals: np.ndarray
    """Of them, placed minus recorded, metres [m, 3]."""
    inliers: np.ndarray
    """Which of them the placing trusts, [m] bool."""


@dataclass(frozen=True)
class AlignmentFailure:
    """Why a model was not brought to a place on Earth, and what to do about it."""

    reason: str
    remedy: str


def georegister(
    model: pycolmap.Reconstruction, images_metadata: Sequence[ImageMetadata], positions: GpsPriors
) -> Georegistration | AlignmentFailure:
    """The similarity that brings the model to its positions, or why they do not tell one: they are too few, or wrong by
    too much of how far they spread. Does not change the model."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centers, targets = _match_positions(images, images_metadata, positions)
    if not positions.usable or len(rows) < MIN_POSITIONS:
        few = f"{len(positions)} positions, of placed photographs, are too few"
        return AlignmentFailure(few if len(positions) else "no positions that can be used", ADVICE_WRITE_GPS)
    if not is_collinear(centers) and not is_nearly_collinear(targets, positions.gps_std[rows]):
        similarity, inliers = fit_similarity_robust(centers, targets)
        how = f"positions of {int(inliers.sum())} photographs ({positions.source})"
    else:
        rotation, by = _leveling_rotation(model, images, images_metadata, centers, targets)
        similarity, inliers = _fit_scale(rotation, centers, targets), np.ones(len(rows), bool)
        how = f"positions of {len(rows)} photographs along one line ({positions.source}), up by {by}"
    residuals = similarity.apply(centers) - targets
    how_far = describe_disagreement(residuals, targets[inliers], inliers)
    if how_far:
        why = f"the positions ({positions.source}) and where the photographs were placed disagree: {how_far}"
        return AlignmentFailure(why, ADVICE_BETTER_POSITIONS)
    return Georegistration(similarity, how, rows, residuals, inliers)


def registration_in_place(
    model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata], positions: GpsPriors, method: str
) -> Georegistration:
    """A model that was brought to its place by other things than positions, and how far those are from it."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    rows, centers, targets = _match_positions(images, photographs, positions)
    stays = Similarity(1.0, np.eye(3), np.zeros(3))
    return Georegistration(stays, method, rows, centers - targets, np.ones(len(rows), bool))


def is_nearly_collinear(points: np.ndarray, std: np.ndarray) -> bool:
    """Whether places [n, 3] leave a turn about a line open: they spread across it no more than they may be wrong."""
    if is_collinear(points):
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points))
    return bool(spread < MIN_SPREAD_SIGMAS * np.sqrt(np.median((std**2).mean(axis=1))))


def transform_model(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Bring a model into another world, in place."""
    rotation = pycolmap.Rotation3d(np.ascontiguousarray(similarity.rotation))
    model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))


def model_points(model: pycolmap.Reconstruction) -> np.ndarray:
    """Places of all points, [n, 3]."""
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def tilt_from_attitudes(model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata]) -> float | None:
    """Angle in degrees between down as the placed model has it and as the drone recorded it.

    Recorded down in the camera is down of the model, turned by a tilt of the world and by how the camera hangs on the
    drone, which is the same in all photographs. Flown in several directions the two are told apart, by least squares
    for small angles; in one, all is taken for a tilt.
    """
    gravity = {photo.name: photo.attitude.gravity for photo in photographs if photo.attitude}
    images = [image for image in model.images.values() if image.has_pose and image.name in gravity]
    if len(images) < MIN_ATTITUDES:
        return None
    rotations = np.array([_rotation(image) for image in images])
    off = np.array([gravity[image.name] for image in images]) + rotations[:, :, 2]
    hangs = np.broadcast_to(np.eye(3)[:, :2], (len(images), 3, 2))
    for unknown in (np.concatenate([rotations[:, :, :2], hangs], axis=2), rotations[:, :, :2]):
        flat = unknown.reshape(-1, unknown.shape[2])
        singular = np.linalg.svd(flat, compute_uv=False)
        if singular[-1] > MIN_HEADING_SPREAD * singular[0]:
            break
    tilt = np.linalg.lstsq(flat, off.ravel(), rcond=None)[0][:2]
    return float(np.degrees(np.linalg.norm(tilt)))


def _match_positions(
    images: Mapping[str, pycolmap.Image], photographs: Sequence[ImageMetadata], positions: GpsPriors
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [m] of the positions whose photographs are placed, where those were placed [m, 3], and the positions."""
    rows = np.array([row for row, i in enumerate(positions.image_indices) if photographs[int(i)].name in images], int)
    names = [photographs[int(positions.image_indices[row])].name for row in rows]
    centers = np.array([images[name].projection_center() for name in names]).reshape(-1, 3)
    return rows, centers, positions.enu[rows]


def _rotation(image: pycolmap.Image) -> np.ndarray:
    return np.asarray(image.cam_from_world().rotation.matrix())


def _leveling_rotation(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    photographs: Sequence[ImageMetadata],
    centers: np.ndarray,
    targets: np.ndarray,
) -> tuple[np.ndarray, str]:
    """The rotation into east, north, up where positions along a line leave a turn about it open."""
    found = [
        photo.attitude.camera_from_enu.T @ _rotation(images[photo.name])
        for photo in photographs
        if photo.attitude is not None and photo.name in images
    ]
    if len(found) >= MIN_ATTITUDES:
        left, _, right = np.linalg.svd(np.sum(found, axis=0))
        mean = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        return _heading_rotation(mean, centers, targets) @ mean, "the recorded attitudes"
    rotations = np.array([_rotation(image) for image in images.values()])
    up, _ = estimate_up(centers, rotations, model_points(model), [])
    level = rotation_to_z(up)
    return _heading_rotation(level, centers, targets) @ level, "the views"


def _heading_rotation(rotation: np.ndarray, centers: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The turn about up that brings the line of the cameras onto that of the positions."""
    one, other = (centers - centers.mean(axis=0)) @ rotation.T, targets - targets.mean(axis=0)
    angle = np.arctan2((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).sum(), (one[:, :2] * other[:, :2]).sum())
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def _fit_scale(rotation: np.ndarray, centers: np.ndarray, targets: np.ndarray) -> Similarity:
    """Scale and translation by least squares, the rotation as it is."""
    turned = centers @ rotation.T
    one, other = turned - turned.mean(axis=0), targets - targets.mean(axis=0)
    scale = float((one * other).sum() / (one**2).sum())
    return Similarity(scale, rotation, targets.mean(axis=0) - scale * turned.mean(axis=0))
