"""Where lines of sight meet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def intersect_rays(centers: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """The point with the least sum of squared distances to lines; None where they are parallel."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, centers)))
