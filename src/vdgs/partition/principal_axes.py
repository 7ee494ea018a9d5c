"""The plane turned into the principal axes of the scene, so that a cut does not depend on how the scene lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

#: The nearest share of the anchors decides about the axes: far outliers would turn them.
INLIER_SHARE = 0.98
NUM_ITERATIONS = 3


@dataclass(frozen=True, eq=False)
class PrincipalPlane:
    """x, y of the ground frame = centre + axes @ (place in the plane); `axes` is orthonormal, columns by variance."""

    center: Float[np.ndarray, "2"]
    axes: Float[np.ndarray, "2 2"]

    def to_plane(self, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Places of the ground frame in the principal axes."""
        return (ground - self.center) @ self.axes

    def to_ground(self, shape: shapely.Polygon) -> shapely.Polygon:
        """A polygon back in the ground frame."""
        return shapely.transform(shape, lambda places: places @ self.axes.T + self.center)


def fit_principal_plane(ground: Float[np.ndarray, "n 2"]) -> PrincipalPlane:
    """The principal axes of places (float64), each signed so that its third moment is positive.

    Choice: the paper clusters on x, y as they are; then the cut would change with the heading of the ground frame,
    which is arbitrary without GPS. Centre and axes turn, move and scale with the places. In a scene that is its own
    mirror image the signs, and so the numbers of the blocks, are decided by rounding.
    """
    center = ground.mean(axis=0)
    kept = ground
    for _ in range(NUM_ITERATIONS):
        distance = np.linalg.norm(ground - center, axis=1)
        kept = ground[distance <= np.quantile(distance, INLIER_SHARE)]
        center = kept.mean(axis=0)
    local = kept - center
    _, axes = np.linalg.eigh(local.T @ local)
    axes = axes[:, ::-1]
    skew = ((local @ axes) ** 3).sum(axis=0)
    return PrincipalPlane(center, axes * np.where(skew < 0, -1.0, 1.0))
