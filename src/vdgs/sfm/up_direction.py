"""Which way is up in a model's world, by recorded attitudes or by the views, and how far a placed model tilts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vdgs.captures.position_adjustment import Up
from vdgs.captures.up_axis import OR_CEILING, up_by_views
from vdgs.geometry.similarity import geometric_median, rotation_to_z
from vdgs.sfm.attitude_tilt import tilt_of_attitudes
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.lazy_pycolmap import pycolmap

#: How up is found where it is by what the drone recorded.
BY_ATTITUDES = "the recorded attitudes"
#: Attitudes that agree on which way a world lies, at least.
MIN_ATTITUDES = 3
#: Recorded attitudes that scatter by more (degrees, median), or that differ so far from what the views say, and by so
#: many standard deviations of it, are no measurements (choice).
SCATTER_DEG, CONTRADICT_DEG, CONTRADICT_SIGMAS = 20.0, 45.0, 3.0
#: So large a share of recorded attitudes that contradict the others is told (choice).
WRONG_ATTITUDES = 0.1
#: What errors about up and about mirror images ask where it is from attitudes, and is down by the views.
LOOKED_UP = (
    " Or are the recorded attitudes wrong, by which the cameras looked up (a pitch of +90° where straight down "
    "is -90°)?"
)
#: How far a camera may hang beside what is recorded, in degrees: flown in several directions, where that cancels, and
#: where all look one way (choice).
HANGS_DEG, HANGS_ALIKE_DEG = 1.0, 2.5


def up_of(model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata]) -> tuple[Up, list[str]]:
    """What attitudes that the drone recorded, or else the views, say of up in the model's world; and notes."""
    poles = {photo.name for photo in photographs if photo.face in ("up", "down")}  # of panoramas, which are upright
    images = {image.name: image for image in model.images.values() if image.has_pose and image.name not in poles}
    rotations = np.array([camera_rotation(image) for image in images.values()])
    centers = np.array([image.projection_center() for image in images.values()])
    seen = up_by_views(centers, rotations, model_points(model))
    views = Up(seen.direction, seen.deviation_deg, "the views", seen.sure, other=seen.other)
    recorded = {photo.name: photo.attitude.gravity for photo in photographs if photo.attitude and photo.name in images}
    if len(recorded) < max(MIN_ATTITUDES, len(images) / 2):
        return views, []
    rotations = np.array([camera_rotation(images[name]) for name in recorded])
    return _up_by_attitudes(rotations, np.array(list(recorded.values())), views)


def _up_by_attitudes(rotations: np.ndarray, down: np.ndarray, views: Up) -> tuple[Up, list[str]]:
    """Up by recorded down [n, 3] in cameras that are turned by camera_from_world [n, 3, 3], or by the views where the
    records contradict each other or these."""
    ups = -np.einsum("nji,nj->ni", rotations, down)
    middle = geometric_median(ups)  # some may be wrong
    mean = middle / max(float(np.linalg.norm(middle)), 1e-12)
    scatter = float(np.median(np.degrees(np.arccos(np.clip(ups @ mean, -1, 1)))))
    apart = _between_deg(mean, views.direction)
    apart_from_other = 180.0 if views.other is None else _between_deg(mean, views.other.direction)
    level = rotation_to_z(mean)
    tilt, several, agree = tilt_of_attitudes(rotations @ level.T, down)
    most = max(CONTRADICT_DEG, CONTRADICT_SIGMAS * views.deviation_deg)
    is_told = views.sure or (views.other is not None and views.other.doubt == OR_CEILING)
    contradicts = is_told and not several and min(apart, apart_from_other) > most
    if scatter > SCATTER_DEG or contradicts:
        return views, ["the recorded attitudes contradict the photographs: up is taken from the views instead."]
    if views.sure and not several and apart > most:  # the positions tell, as far as they can
        return views, []
    found = level.T @ np.append(-tilt, 1.0)
    deviation = float(np.hypot(scatter / np.sqrt(len(down)), HANGS_DEG if several else HANGS_ALIKE_DEG))
    doubt, wrong = LOOKED_UP if apart > 90 else "", int((~agree).sum())
    many = wrong >= WRONG_ATTITUDES * len(down)
    notes = [f"{wrong} of {len(down)} recorded attitudes contradict the others, and are not used."] if many else []
    return Up(found / np.linalg.norm(found), deviation, BY_ATTITUDES, doubt=doubt), notes


def _between_deg(one: np.ndarray, other: np.ndarray) -> float:
    """The angle between unit vectors [3]."""
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


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
    rotations = np.array([camera_rotation(image) for image in images])
    tilt, _, _ = tilt_of_attitudes(rotations, np.array([gravity[image.name] for image in images]))
    return float(np.degrees(np.linalg.norm(tilt)))


def model_centers(model: pycolmap.Reconstruction) -> np.ndarray:
    """Places of the cameras that have one, [n, 3]."""
    return np.array([image.projection_center() for image in model.images.values() if image.has_pose])


def model_points(model: pycolmap.Reconstruction) -> np.ndarray:
    """Places of all points, [n, 3]."""
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def camera_rotation(image: pycolmap.Image) -> np.ndarray:
    """camera_from_world's rotation, [3, 3]."""
    return np.asarray(image.cam_from_world().rotation.matrix())
