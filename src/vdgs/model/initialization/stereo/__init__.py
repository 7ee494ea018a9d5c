"""Dense stereo before training: where photographs agree how far the ground is, anchors may start.

Structure-from-motion leaves few points where few photographs look, and what starts at a wrong height there stays there:
two or three photographs are learnt by heart with any surface. Classical stereo needs no more than two photographs, and
knows what training does not: that neighbouring pixels mostly lie on one surface.

    partners(cameras, points)          which photographs each one is compared with
    depth_of_pair(first, second, ...)  a pair, rectified and matched: the depth of the first one's pixels
    dense_points(...)                  the depths of all photographs, those that others confirm, as points

Nothing of it needs a GPU or a network; it is deterministic, for any number of threads.
"""

from vdgs.model.initialization.stereo.fusion import DensePoints, FusionCell, StereoInputs, compute_dense_points
from vdgs.model.initialization.stereo.sgm import StereoView, pair_depth
from vdgs.model.initialization.stereo.view_selection import select_source_views

__all__ = [
    "DensePoints",
    "FusionCell",
    "StereoInputs",
    "StereoView",
    "compute_dense_points",
    "pair_depth",
    "select_source_views",
]
