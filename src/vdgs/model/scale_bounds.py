"""Bounds on the scale of a Gaussian and on its distance from its anchor, by what the training images can show.

No photograph constrains a Gaussian that is larger than the image: from between the cameras it is a floater. Rule
(choice): in the image of any training camera that sees the anchor, the ellipse in which a Gaussian is drawn (alpha of
at least 1/255, at full opacity) is no longer than `MAX_IMAGE_FRACTION` of the longer side. The unit of an anchor's
offsets may be `MAX_OFFSET_FACTOR` times that scale: visibility, blocks, culling and growth assume Gaussians near their
anchor.

Nor does a photograph show how thin a Gaussian is that is thinner than its pixels: drawn from nearer it would become a
needle. `photograph_pixel` is their size, which a model keeps for its views.
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

#: Maximum length of a Gaussian over the longer side of the image (choice: a Gaussian may lie nearer to a camera than
#: its anchor, and a view nearer than all cameras).
MAX_IMAGE_FRACTION = 0.25
#: Maximum of the unit of an anchor's offsets over the largest standard deviation (choice: at 1, ground that few
#: photographs show keeps holes).
MAX_OFFSET_FACTOR = 4.0
#: From the middle of a Gaussian of opacity 1 to where it is no longer drawn, in standard deviations.
MAX_SIGMA = math.sqrt(-2.0 * math.log(ALPHA_MIN))
#: Share of the places that photographs show in the smallest pixels: the largest of these is the pixel of a scene.
CLOSEST_SHARE = 0.1
#: Cameras processed at once, to limit memory.
CAMERA_CHUNK = 1024


def max_log_scales(
    positions: Float[Tensor, "n 3"], cameras: Sequence[Camera], side_px: int | None = None
) -> Float[Tensor, " n"]:
    """The logarithm of the largest standard deviation that Gaussians of anchors at these places may have, in units of
    the ground frame: what the nearest of the cameras (pinholes) that hold the place allows; where none holds it, the
    nearest of all. Infinite without cameras. With `side_px` as if the longer side of every picture were so many pixels
    long. Time in proportion to what the cameras hold, O(n + c) memory."""
    bound = torch.full_like(positions[:, 0], math.inf)
    if len(positions) == 0 or not cameras:
        return bound.log()
    frusta = Frusta.of(cameras, positions.device)
    extents = frusta.relative_extent if side_px is None else side_px / torch.maximum(frusta.fx, frusta.fy)
    for rows, cameras_in_view in SpatialGroups.of(positions).visible_groups(frusta):
        for some in cameras_in_view.split(CAMERA_CHUNK):
            selected = frusta.select(some)
            seen = selected.project(positions[rows])
            allowed = torch.where(seen.inside, extents[some][:, None].to(positions) * seen.depth, math.inf)
            bound[rows] = torch.minimum(bound[rows], allowed.amin(dim=0))
    rows = bound.isinf().nonzero().squeeze(1)
    bound[rows] = _by_nearest(positions[rows], cameras, extents.cpu().numpy())
    return (bound * (MAX_IMAGE_FRACTION / (2.0 * MAX_SIGMA))).log()


def photograph_pixel(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> float:
    """The size of a pixel, in units of the ground frame, in the photograph that shows a place in the smallest pixels,
    for the places shown in the smallest (`CLOSEST_SHARE`; choice: one number for a scene, which blurs photographs of
    the few places that are shown in smaller ones). 0 without cameras or places."""
    if len(positions) == 0 or not cameras:
        return 0.0
    longest = max(max(camera.width, camera.height) for camera in cameras)
    spans = max_log_scales(positions, cameras, longest).double().exp() / (MAX_IMAGE_FRACTION / (2.0 * MAX_SIGMA))
    return float(np.quantile(spans.cpu().numpy(), CLOSEST_SHARE)) / longest


def _by_nearest(
    positions: Float[Tensor, "n 3"], cameras: Sequence[Camera], spans: Float[np.ndarray, " c"]
) -> Float[Tensor, " n"]:
    """The least span · distance over the cameras."""
    near = torch.full_like(positions[:, 0], math.inf)
    if len(positions) == 0:
        return near
    points = torch.nan_to_num(positions.detach()).cpu().numpy()
    # Of cameras that span alike the nearest counts: it is looked up, then measured as the held ones are.
    for span in np.unique(spans):
        alike = np.flatnonzero(spans == span)
        nearest = cKDTree(np.stack([cameras[int(index)].position for index in alike])).query(points, workers=1)[1]
        for chosen in np.unique(nearest):
            rows = torch.from_numpy(np.flatnonzero(nearest == chosen)).to(positions.device)
            # An anchor in a camera's very center would get a size of zero, whose logarithm is no number to train.
            distance = project_points(positions[rows], cameras[int(alike[chosen])]).distance.clamp(min=NEAR_PLANE)
            near[rows] = torch.minimum(near[rows], span * distance)
    return near
