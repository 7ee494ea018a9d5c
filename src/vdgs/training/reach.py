"""The part of a view that a block's splats reach: no other pixel can move them, so a step draws no more of it."""

from __future__ import annotations

from vdgs.cameras import Camera
from vdgs.kernels.constants import SSIM_WINDOW_PX
from vdgs.kernels.reach import box_reached
from vdgs.kernels.types import Splats
from vdgs.training.crops import NEARLY_ALL, Box
from vdgs.training.state import Stage

#: A pixel is in windows of SSIM around others, which look as far again.
MARGIN_PX = SSIM_WINDOW_PX - 1


def narrow(stage: Stage, splats: Splats, camera: Camera, box: Box) -> Box:
    """What is to be drawn of a box of a view, which `camera` shows, so that gradients of a stage's splats in it are the
    same but for rounding. The means of the splats, in pixels of the box, become pixels of that, in place.

    What is asked of depth are means over all points that a view shows, so such views are drawn as a whole; and a card
    would be waited for.
    """
    around = stage.surroundings
    if around is None or not len(around.anchors) or stage.draws_depth or stage.device.type != "cpu":
        return box
    part = part_reached(splats, camera)
    if part is None:
        return box
    left, top, right, bottom = part
    splats.means_px.sub_(splats.means_px.new_tensor([left, top]))
    return box[0] + left, box[1] + top, box[0] + right, box[1] + bottom


def part_reached(splats: Splats, camera: Camera) -> Box | None:
    """The part of a picture that splats reach, with what the loss looks at beside it; None: all of it, nearly all, or
    none."""
    reached = box_reached(splats, camera.width, camera.height)
    if reached is None:
        return None
    left, top, right, bottom = reached
    left, top = max(left - MARGIN_PX, 0), max(top - MARGIN_PX, 0)
    right, bottom = min(right + MARGIN_PX, camera.width), min(bottom + MARGIN_PX, camera.height)
    if (right - left) * (bottom - top) >= NEARLY_ALL * camera.width * camera.height:
        return None
    return left, top, right, bottom
