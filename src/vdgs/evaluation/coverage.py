"""Which pixels of a view show a place that enough training cameras see: those for which a model has to answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from vdgs.evaluation.opacity_coverage import OPAQUE_ALPHA
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.ground import below_horizon
from vdgs.visibility.visibility_counts import count_visibility

#: A pixel is seen if at least so many training cameras see the place that it shows: fewer cannot fix a depth well.
MIN_SEEN_BY = 3
#: At least this opaque, a pixel shows something that may stand before the sky.
MIN_ALPHA = 0.5


def coverage_map(
    draw_depth: Callable[[Camera], Raster], cameras: Sequence[Camera], min_views: int = MIN_SEEN_BY
) -> Callable[[Camera], Bool[np.ndarray, "h w"]]:
    """Camera of a view -> which of its pixels show a place that lies in the pictures of at least `least` of `cameras`
    (the training cameras; nothing hides anything, as in V).

    The place is where the model behind `draw_depth` (a render with depth) is half opaque, in pixels that are solid. All
    others continue the depth of the nearest solid ones, down to the ground but not up into the sky: beyond what cameras
    cover, half-open splats lie at any depth, and by that depth in pictures that never saw the place (against the truth
    of a generated town, reports/solid-ground.md). V as it is drawn from anchors would not do: at the edge of what
    cameras cover, splats reach far beyond the anchors that V is counted for.
    """

    def seen(camera: Camera) -> Bool[np.ndarray, "h w"]:
        with torch.inference_mode():
            raster = draw_depth(camera)
        assert raster.median_depth is not None
        alpha = raster.alpha.cpu().numpy()
        drawn, solid = alpha >= MIN_ALPHA, alpha >= OPAQUE_ALPHA
        if not drawn.any():
            return drawn
        # A scene that is a ghost has no solid pixel: what it half shows has to answer for it.
        depth = fill_depth(raster.median_depth.cpu().numpy(), solid if solid.any() else drawn)
        places = torch.from_numpy(camera.unproject(depth).reshape(-1, 3))
        held = count_visibility(places, cameras).numpy().reshape(drawn.shape) >= min_views
        return held & (drawn | below_horizon(camera, *drawn.shape))

    return seen


def fill_depth(depth: Float[np.ndarray, "h w"], is_drawn: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth where something is drawn, elsewhere that of the nearest such pixel. At least one is drawn."""
    row, column = distance_transform_edt(~is_drawn, return_distances=False, return_indices=True)
    return depth[row, column]
