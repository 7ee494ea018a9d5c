"""The tilt of a world by recorded attitudes, some of them wrong, told from how cameras hang."""

from __future__ import annotations

import numpy as np

#: Directions of flight tell a tilt from how a camera hangs if they spread so far: a ratio of singular values.
MIN_HEADING_SPREAD = 0.3
#: Attitudes farther from where the others have up than so many medians (some 3.5 standard deviations), and so many
#: degrees, are wrong: there and back, a camera that hangs by 2.5 degrees leaves 5 between the directions (choice).
MEDIANS_AWAY, WRONG_DEG = 3.0, 5.0
#: Rounds of the least sum of distances that tells them, and the distance (radians) from which on it counts.
ROUNDS, LEAST_AWAY = 20, 1e-4


def tilt_of_attitudes(rotations: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, bool, np.ndarray]:
    """Tilt of a world whose up is about z, [2] in radians, whether it was told from how the camera hangs, and which of
    the recorded attitudes agree on it [n] bool: camera_from_world [n, 3, 3] and recorded down in the cameras [n, 3].

    The least sum of distances tells which agree, least squares of these the tilt.
    """
    off = gravity + rotations[:, :, 2]
    hangs = np.broadcast_to(np.eye(3)[:, :2], (len(rotations), 3, 2))
    both = np.concatenate([rotations[:, :, :2], hangs], axis=2)
    several = _tells(both)
    unknown = both if several else rotations[:, :, :2]
    weights = np.ones(len(off))
    for _ in range(ROUNDS):
        away = np.linalg.norm(off - unknown @ _least_squares(unknown, off, weights), axis=1)
        weights = 1 / np.maximum(away, LEAST_AWAY)
    agree = away <= max(MEDIANS_AWAY * float(np.median(away)), np.radians(WRONG_DEG))
    if several and not _tells(both[agree]):
        unknown, several = rotations[:, :, :2], False
    return _least_squares(unknown, off, agree.astype(float))[:2], several, agree


def _tells(unknown: np.ndarray) -> bool:
    """Whether equations [n, 3, 4] tell their unknowns from each other."""
    singular = np.linalg.svd(unknown.reshape(-1, unknown.shape[2]), compute_uv=False)
    return bool(singular[-1] > MIN_HEADING_SPREAD * singular[0])


def _least_squares(unknown: np.ndarray, off: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Of equations [n, 3, k] with right sides [n, 3], each n weighed alike."""
    roots = np.sqrt(weights)[:, None]
    flat = (roots[:, :, None] * unknown).reshape(-1, unknown.shape[2])
    return np.asarray(np.linalg.lstsq(flat, (roots * off).ravel(), rcond=None)[0])
