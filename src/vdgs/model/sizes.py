"""How large a Gaussian may be: no larger than the pictures that train it can show.

A Gaussian that spans a whole picture and reaches beyond it is held in place by nothing: its edges lie outside of all
photographs, and seen from between the cameras it hangs as a veil in front of everything. Rule (choice): in the picture
of any training camera that holds the anchor's place, the ellipse within which one of its Gaussians is drawn at all
(alpha of at least 1/255, at full opacity) is no longer than `SPAN` of the longer side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.cameras import NEAR, Camera
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.model.frustum import project

#: Length of a Gaussian over the longer side of the picture, at most (choice: a Gaussian may lie nearer to a camera than
#: its anchor, and a view nearer than all cameras. With larger bounds, views of a town held some that were larger than
#: the picture: docs/findings.md).
SPAN = 0.25
#: From the middle of a Gaussian of opacity 1 to where it is no longer drawn, in standard deviations.
REACH = math.sqrt(-2.0 * math.log(ALPHA_MIN))


def largest_log_scales(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """The logarithm of the largest standard deviation that Gaussians of anchors at these places may have, in units of
    the ground frame: what the nearest of the cameras (pinholes) that hold the place allows; where none holds it, the
    nearest of all. Infinite without cameras. O(n · cameras) time, O(n) memory."""
    held = torch.full_like(positions[:, 0], math.inf)
    near = held.clone()
    for camera in cameras:
        seen = project(positions, camera)
        # What the longer side of the picture spans at the unit of depth.
        span = max(camera.width, camera.height) / max(camera.fx, camera.fy)
        held = torch.where(seen.inside, torch.minimum(held, span * seen.depth), held)
        # An anchor in a camera's very centre would get a size of zero, whose logarithm is no number to train.
        near = torch.minimum(near, span * seen.distance.clamp(min=NEAR))
    return (torch.where(held.isfinite(), held, near) * (SPAN / (2.0 * REACH))).log()
