"""Points at random where cameras look together: what a scene starts from where photographs share no features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_centers

#: How many points, before those are left out that fewer cameras than `LEAST_CAMERAS` see.
COUNT, LEAST_CAMERAS = 30_000, 3
#: Half the edge of the box over the median distance of the cameras (of sets of Blender: 1.3 of 4, as 3DGS takes).
BOX_SHARE = 1 / 3
#: Lines of view that are closer to parallel than this have no place that they meet in.
LEAST_SPREAD = 1e-3
#: Fewer points than this are no scene.
LEAST_POINTS = 100


def random_points(poses: Sequence[np.ndarray], lenses: Sequence[Intrinsics]) -> tuple[np.ndarray, float]:
    """Points [n, 3] in the box about the place that the cameras look at, and the edge of the box.

    Raises CaptureError for cameras that do not look at one place.
    """
    stack = np.stack(poses)
    rotations, centers = stack[:, :3, :3], camera_centers(stack)
    across = np.eye(3) - rotations[:, 2, :, None] * rotations[:, 2, None, :]
    spread = np.linalg.eigvalsh(across.mean(axis=0))[0]
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]
    half = BOX_SHARE * float(np.median(np.linalg.norm(centers - middle, axis=1)))
    points = middle + half * np.random.default_rng(0).uniform(-1, 1, (COUNT, 3))
    seen = np.zeros(COUNT, int)
    for pose, lens in zip(poses, lenses, strict=True):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        in_front = local[:, 2] > 1e-6 * max(half, 1e-12)
        at = local[:, :2] / np.where(in_front, local[:, 2], 1.0)[:, None] * lens.focal + lens.principal_point
        seen += in_front & ((at >= 0) & (at < [lens.width, lens.height])).all(axis=1)
    points = points[seen >= LEAST_CAMERAS]
    if spread < LEAST_SPREAD or len(points) < LEAST_POINTS:
        raise CaptureError(
            "the photographs share too few features for points, and their cameras look at no common place in which "
            "points could be put at random. Put a point cloud in the same world beside the poses, as points3D.ply."
        )
    return points, 2 * half
