"""Which reading of recorded angles holds, where their names leave several open: told by the reconstructed model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.units import two_digits

#: Another reading is plainly better that leaves so small a share of the residual, and so many degrees less; fewer
#: photographs tell none (choice).
SHARE_LEFT, GAIN_DEG, MIN_PHOTOGRAPHS = 0.5, 3.0, 10
#: Rounds of the least sum of angles, the angle (radians) from which on one counts, and the degrees that the farthest
#: count as: those of a minority that is wrong (choice).
ROUNDS, LEAST_ANGLE, FARTHEST_DEG = 20, 1e-4, 20.0


def confirmed_by_model(
    model: pycolmap.Reconstruction, photographs: Sequence[ImageMetadata]
) -> tuple[tuple[ImageMetadata, ...], tuple[str, ...]]:
    """The photographs, the angles of each camera by the reading that the model confirms, and notes of the cameras whose
    reading changed."""
    groups: dict[tuple[str, ...], list[ImageMetadata]] = {}
    for photo in photographs:
        now = next((name for name, attitude in photo.attitudes.items() if attitude is photo.attitude), None)
        if now is not None:
            groups.setdefault((now, photo.camera, photo.sensor, *photo.attitudes), []).append(photo)
    images = {image.name: image for image in model.images.values() if image.has_pose} if groups else {}
    changed, notes = dict[str, ImageMetadata](), []
    for (now, camera, *_), group in groups.items():
        seen = [photo for photo in group if photo.name in images]
        if len(seen) < MIN_PHOTOGRAPHS:
            continue
        rotations = np.array([images[photo.name].cam_from_world().rotation.matrix() for photo in seen])
        names = group[0].attitudes
        recorded = {name: np.array([photo.attitudes[name].camera_from_enu for photo in seen]) for name in names}
        holds, off = reading_that_holds(rotations, recorded, now)
        if holds != now:
            changed |= {photo.name: replace(photo, attitude=photo.attitudes[holds]) for photo in group}
            notes.append(
                f"the recorded angles of {camera} are read as {holds}: the photographs differ from these by "
                f"{two_digits(off[holds])}° on average, from {now} by {two_digits(off[now])}°."
            )
    return tuple(changed.get(photo.name, photo) for photo in photographs), tuple(notes)


def reading_that_holds(
    rotations: np.ndarray, recorded: Mapping[str, np.ndarray], now: str
) -> tuple[str, dict[str, float]]:
    """The present reading, or another that is plainly better; and the residual of each, the mean angle in degrees that
    is left by one turn of the world from recorded attitudes to camera_from_world, all [n, 3, 3].

    Not the median: where the wind rolls a wing to one side mostly, a turn explains these photographs by either sign.
    """
    off = {
        name: _mean_residual_deg(Rotation.from_matrix(attitudes.transpose(0, 2, 1) @ rotations))
        for name, attitudes in recorded.items()
    }
    best = min(off, key=lambda name: off[name])
    return best if off[best] < min(SHARE_LEFT * off[now], off[now] - GAIN_DEG) else now, off


def _mean_residual_deg(turns: Rotation) -> float:
    """Of turns about the one of the least sum of angles."""
    weights = np.ones(len(turns))
    for _ in range(ROUNDS):
        away = (turns.mean(weights).inv() * turns).magnitude()
        weights = 1 / np.maximum(away, LEAST_ANGLE)
    return float(np.minimum(np.degrees(away), FARTHEST_DEG).mean())
