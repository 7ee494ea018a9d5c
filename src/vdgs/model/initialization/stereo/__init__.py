"""Dense stereo before training: anchors may start where photographs agree on the depth of the ground.

Structure-from-motion leaves few points where few photographs look, and two or three photographs fit any surface, so
that anchors which start at a wrong height stay there. Stereo needs two photographs, and assumes that neighboring
pixels mostly lie on one surface. No GPU or network is needed; the result is the same for any number of threads.

    select_source_views(cameras, points)  the photographs that each one is compared with
    pair_depth(first, second)             a pair, rectified and matched: the depth of the first one's pixels
    compute_dense_points(...)             the depths of all photographs that others confirm, as points
"""

from vdgs.model.initialization.stereo.fusion import DensePoints as DensePoints
from vdgs.model.initialization.stereo.fusion import FusionCell as FusionCell
from vdgs.model.initialization.stereo.fusion import StereoInputs as StereoInputs
from vdgs.model.initialization.stereo.fusion import compute_dense_points as compute_dense_points
from vdgs.model.initialization.stereo.sgm import StereoView as StereoView
from vdgs.model.initialization.stereo.sgm import pair_depth as pair_depth
from vdgs.model.initialization.stereo.view_selection import select_source_views as select_source_views
