"""Views for training that nobody photographed: nearer to a place of a photograph, more tilted and turned aside.

A model that shows its photographs well may show anything beside them. In a pseudo view (FSGS's word) each pixel shows a
place; where the photograph of the step sees the same place, by the depth of the model in both views, its color there is
what the pixel should show. No gradient passes through depths.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.kernels.transfer import to_like, upload
from vdgs.training.target import TrainingTarget

#: Every so many steps draw a pseudo view, after this share of the iterations: before it depths are vague.
EVERY, START_FRACTION = 4, 0.3
#: Its width and height, in those of the photograph, which tells no more of a place that is nearer.
SIZE = 0.7
#: In degrees: by how much more a pseudo view is tilted than its photograph, and up to what tilt; how far it is turned
#: about its place to either side, and below what tilt of the photograph by any angle. Then its distance from the place,
#: in those of the photograph. From nearer and with more tilt photographs tell too little (reports/off-path.md).
MORE_TILT, MAX_TILT, TURN, LEVEL_TILT = 35.0, 80.0, 25.0, 15.0
NEARER = (0.4, 1.0)
#: Two depths agree when they differ by less than this share of the camera height; both pixels are at least so opaque.
MAX_DIFFERENCE, MIN_ALPHA = 0.01, 0.9
#: A pseudo view of which the photograph sees less than this share is not used.
MIN_SHARE = 0.05
#: Places of a photograph that are tried as the middle of a pseudo view.
_TRIES = 8


def is_pseudo_view_due(config: TrainConfig, iteration: int) -> bool:
    """Whether iteration (from 0) draws a pseudo view beside its photograph."""
    begun = iteration >= START_FRACTION * config.iterations
    return config.loss.pseudo_views > 0 and begun and iteration % EVERY == 0


def pseudo_camera(camera: Camera, raster: Raster, rng: np.random.Generator) -> Camera | None:
    """A camera about a place that a view, drawn with depth, shows; None where the places tried show nothing."""
    rows, columns = rng.integers(camera.height, size=_TRIES), rng.integers(camera.width, size=_TRIES)
    assert raster.median_depth is not None
    pixels = upload(torch.from_numpy(rows * camera.width + columns), raster.alpha.device)
    depths, alphas = torch.stack([each.flatten()[pixels] for each in (raster.median_depth, raster.alpha)]).tolist()
    tried = zip(rows, columns, depths, alphas, strict=True)
    place = next(((r, c, depth) for r, c, depth, alpha in tried if alpha > MIN_ALPHA and depth > 0), None)
    if place is None:
        return None
    row, column, depth = place
    across = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
    middle = camera.position + depth * across @ camera.camera_from_world[:3, :3]
    back = camera.position - middle
    distance = float(np.linalg.norm(back))
    tilt, heading = math.degrees(math.acos(min(max(back[2] / distance, -1.0), 1.0))), math.atan2(back[1], back[0])
    turn = 180.0 if tilt < LEVEL_TILT else TURN
    heading += math.radians(rng.uniform(-turn, turn))
    tilt = math.radians(min(tilt + rng.uniform(0, MORE_TILT), max(tilt, MAX_TILT)))
    away = np.array([math.cos(heading) * math.sin(tilt), math.sin(heading) * math.sin(tilt), math.cos(tilt)])
    pose = _looking_at(middle + distance * rng.uniform(*NEARER) * away, middle, heading)
    whole = replace(camera, uncropped_size=None)  # a part of a picture is the whole of another
    smaller = whole.resized(*(max(1, round(SIZE * side)) for side in (camera.width, camera.height)))
    return replace(smaller, camera_from_world=pose, cx=smaller.width / 2, cy=smaller.height / 2)


def _looking_at(position: np.ndarray, middle: np.ndarray, heading: float) -> np.ndarray:
    """`camera_from_world` of a camera that looks at a place from the side that `heading` names, the horizon level."""
    forward = (middle - position) / np.linalg.norm(middle - position)
    right = np.array([-math.sin(heading), math.cos(heading), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


@torch.no_grad()
def warp_photograph(
    target: TrainingTarget, shown: Raster, camera: Camera, raster: Raster, camera_height: float
) -> TrainingTarget | None:
    """What a pseudo view, drawn as `raster`, should show by a photograph whose view was drawn as `shown`, both with
    depth; None where the photograph sees too little of it. Near a part of a photograph, gradients are multiplied by the
    part's share of the area: a pixel of a pseudo view weighs as much as near the whole."""
    assert raster.median_depth is not None
    assert shown.median_depth is not None
    depth = raster.median_depth
    places = _places_in(target.camera, camera, depth)
    grid, there = places[:2].permute(1, 2, 0)[None], places[2]
    known = [shown.median_depth, shown.alpha, *([] if target.mask is None else [target.mask.to(depth)])]
    found = grid_sample(torch.stack(known)[None], grid, mode="nearest", align_corners=False)[0]  # 0 outside the picture
    agrees = (found[0] - there).abs() < MAX_DIFFERENCE * camera_height
    counts = agrees & (there > NEAR_PLANE) & (found[1:] > MIN_ALPHA).all(0) & (raster.alpha > MIN_ALPHA) & (depth > 0)
    share = float(counts.float().mean())
    if share < MIN_SHARE:
        return None
    colors = target.image.to(depth).permute(2, 0, 1)[None]
    warped = grid_sample(colors, grid, align_corners=False, padding_mode="border")[0].permute(1, 2, 0)
    image = warped.round_().clamp_(0, 255).to(torch.uint8).contiguous()
    whole_width, whole_height = target.camera.full_size
    part = target.camera.width * target.camera.height / (whole_width * whole_height)
    return TrainingTarget(
        image=image, mask=counts.to(torch.uint8), camera=camera, counted_pixels=round(share * counts.numel()),
        valid_fraction=share * part,
    )  # fmt: skip


def _places_in(seen: Camera, camera: Camera, depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Where the places that the pixels of `camera` show lie in the picture of `seen`, from -1 to 1 in x and y, and in
    which depth. Planes, because `grid_sample` reads these twice as fast as pairs."""
    turn = seen.camera_from_world[:3, :3] @ camera.camera_from_world[:3, :3].T
    shift = seen.camera_from_world[:3, 3] - turn @ camera.camera_from_world[:3, 3]
    columns = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    rows = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    across, down = np.outer(turn[:, 0], columns), np.outer(turn[:, 1], rows) + turn[:, 2:]
    local = to_like(across, depth)[:, None] + to_like(down, depth)[:, :, None]
    local.mul_(depth).add_(to_like(shift, depth)[:, None, None])
    local[:2].div_(local[2])
    local[0].mul_(2 * seen.fx / seen.width).add_(2 * seen.cx / seen.width - 1)
    local[1].mul_(2 * seen.fy / seen.height).add_(2 * seen.cy / seen.height - 1)
    return local
