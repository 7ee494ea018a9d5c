"""How large a Gaussian may be, and how far from its anchor: no larger than the pictures that train it can show.

A Gaussian that spans a whole picture and reaches beyond it is held in place by nothing: its edges lie outside of all
photographs, and seen from between the cameras it hangs as a veil in front of everything. Rule (choice): in the picture
of any training camera that holds the anchor's place, the ellipse within which one of its Gaussians is drawn at all
(alpha of at least 1/255, at full opacity) is no longer than `MAX_IMAGE_FRACTION` of the longer side.

The three scales that are the unit of an anchor's offsets may be `MAX_OFFSET_FACTOR` times that. Nothing else keeps
Gaussians about their anchor, where visibility, blocks, culling and growth take them to be. Unbounded, a few anchors of
every real scene strew theirs over all of it, where they hang as patches in the colours of somewhere else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.visibility.frustum import Frusta, project_points
from vdgs.visibility.spatial_groups import SpatialGroups

#: Length of a Gaussian over the longer side of the picture, at most (choice: a Gaussian may lie nearer to a camera than
#: its anchor, and a view nearer than all cameras. With larger bounds, views of a town held some that were larger than
#: the picture: reports/solid-ground.md).
MAX_IMAGE_FRACTION = 0.25
#: The unit of an anchor's offsets over the largest Gaussian's standard deviation, at most (choice: at 1, ground that
#: few photographs show stays open; reports/solid-ground.md).
MAX_OFFSET_FACTOR = 4.0
#: From the middle of a Gaussian of opacity 1 to where it is no longer drawn, in standard deviations.
MAX_SIGMA = math.sqrt(-2.0 * math.log(ALPHA_MIN))
#: Cameras that a group of places asks at once: what this keeps in memory is small, whatever the flight.
CAMERA_CHUNK = 1024


def max_log_scales(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """The logarithm of the largest standard deviation that Gaussians of anchors at these places may have, in units of
    the ground frame: what the nearest of the cameras (pinholes) that hold the place allows; where none holds it, the
    nearest of all. Infinite without cameras. Time in proportion to what the cameras hold, O(n + c) memory."""
    bound = torch.full_like(positions[:, 0], math.inf)
    if len(positions) == 0 or not cameras:
        return bound.log()
    frusta = Frusta.of(cameras, positions.device)
    for rows, watching in SpatialGroups.of(positions).visible_groups(frusta):
        for some in watching.split(CAMERA_CHUNK):
            asked = frusta.select(some)
            seen = asked.project(positions[rows])
            allowed = torch.where(seen.inside, asked.relative_extent[:, None].to(positions) * seen.depth, math.inf)
            bound[rows] = torch.minimum(bound[rows], allowed.amin(dim=0))
    rows = bound.isinf().nonzero().squeeze(1)
    bound[rows] = _by_nearest(positions[rows], cameras, frusta.relative_extent.cpu().numpy())
    return (bound * (MAX_IMAGE_FRACTION / (2.0 * MAX_SIGMA))).log()


def _by_nearest(
    positions: Float[Tensor, "n 3"], cameras: Sequence[Camera], spans: Float[np.ndarray, " c"]
) -> Float[Tensor, " n"]:
    """The least span · distance over the cameras."""
    near = torch.full_like(positions[:, 0], math.inf)
    if len(positions) == 0:
        return near
    places = torch.nan_to_num(positions.detach()).cpu().numpy()
    # Of cameras that span alike the nearest counts: it is looked up, then measured as the held ones are.
    for span in np.unique(spans):
        alike = np.flatnonzero(spans == span)
        nearest = cKDTree(np.stack([cameras[int(index)].position for index in alike])).query(places, workers=1)[1]
        for chosen in np.unique(nearest):
            rows = torch.from_numpy(np.flatnonzero(nearest == chosen)).to(positions.device)
            # An anchor in a camera's very centre would get a size of zero, whose logarithm is no number to train.
            distance = project_points(positions[rows], cameras[int(alike[chosen])]).distance.clamp(min=NEAR_PLANE)
            near[rows] = torch.minimum(near[rows], span * distance)
    return near
