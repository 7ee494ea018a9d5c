"""What the nodes of a level-of-detail tree draw: baked anchors in its leaves, and ever coarser merges of them above.

A leaf is baked by itself, from the few training cameras that show it best from as many sides as possible, and from
views all around it: opacities, shapes and colors are what is seen there of its anchors. All Gaussians whose centers
share a cell of space then become one (`merge_by_moments`). The side of a cell is a fixed part of the side of the node,
so that it doubles from level to level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from vdgs.captures.camera_height import pixel_at_camera_height
from vdgs.export.bake import BakeViews, fit_gaussians, gaussian_count, view_contributions
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.constants import DILATION_PX2
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.gaussian_merging import gaussian_weights, merge_by_moments, single_members
from vdgs.model.gaussians import Gaussians, NodeGaussians
from vdgs.model.lod_nodes import NodeRecord

#: Cells along the side of a node.
CELLS_PER_EDGE = 64
#: Training cameras that a leaf is baked from, and of how many of the nearest they are chosen.
CAMERAS_PER_LEAF, MAX_CANDIDATES = 8, 64
#: And so many views that nobody photographed, all around it and so many degrees above the horizon: visitors look from
#: there (choice, reports/levels-of-detail.md).
PSEUDO_VIEWS, PSEUDO_ELEVATION = 4, 35.0
#: They draw a leaf at most so wide and high (pixels): eight for each cell.
MAX_WINDOW_PX = 512
#: Anchors by which it is told how much of a leaf a camera shows.
SAMPLES = 128
#: Steps of k-means by which the Gaussians of cells join (choice, reports/levels-of-detail.md).
KMEANS_STEPS = 2
#: Degree of the spherical harmonics of merged Gaussians.
SH_DEGREE = 1
#: A leaf's Gaussians are off by at least this part of a cell: they are no anchors, which change with the view.
MIN_LEAF_ERROR = 0.1
#: No color counts for less or for more, in parts of its weight: half precision holds as much.
COLOR_WEIGHTS = 1e-3, 1e3


def bake_leaf(model: AnchorModel, cameras: CameraTable) -> tuple[Gaussians, Float[np.ndarray, " n"]]:
    """The Gaussians that the best training cameras and views all around see of a few anchors, and how many pixels each
    makes there."""
    positions = model.anchors.positions.numpy()
    chosen = cameras.choose(positions)
    chosen += _pseudo_views(chosen, np.median(positions, axis=0))
    windows = [window for camera in chosen if (window := _turned(camera, positions)) is not None]
    shown = [view_contributions(model, window) for window in windows]
    pixels = np.zeros(gaussian_count(model))
    for view in shown:
        pixels[view.gaussians.numpy()] += view.pixels.numpy()
    wanted = np.flatnonzero(pixels)
    if not len(wanted):
        return empty_gaussians(SH_DEGREE), pixels[wanted]
    return fit_gaussians(BakeViews(model, windows, shown), wanted, SH_DEGREE), pixels[wanted]


def with_learnt_blur(gaussians: Gaussians, pixel: float) -> Gaussians:
    """Gaussians as large as they were drawn in training, where every pixel showed so much: what has learnt to be drawn
    larger by 0.3 px² covers too little without."""
    variances = (2 * gaussians.log_scales).exp() + DILATION_PX2 * pixel**2
    return replace(gaussians, log_scales=variances.log() / 2)


def empty_gaussians(degree: int) -> Gaussians:
    """None, with room for colors of a degree."""
    wide = torch.zeros(0, 3, dtype=torch.float32, device="cpu")
    return Gaussians(
        means=wide, log_scales=wide, quaternions=wide.new_zeros(0, 4), opacity_logits=wide.new_zeros(0), sh0=wide,
        shN=wide.new_zeros(0, (degree + 1) ** 2 - 1, 3),
    )  # fmt: skip


def merge_cells(gaussians: NodeGaussians, cell: float, errors: Float[np.ndarray, " n"]) -> tuple[NodeGaussians, float]:
    """As many Gaussians as cells of space hold some, each for those that are nearest to what one cell holds, apart from
    those larger than a cell; and how far they then are from their true places: the root mean square by weight, on top
    of the `errors` that they had."""
    if not len(gaussians):
        return gaussians, 0.0
    means = gaussians.means.double().numpy()
    index = np.floor((means - means.min(0)) / cell).astype(np.int64)
    large = gaussians.log_scales.amax(1).numpy() > np.log(cell)
    sizes = index.max(0) + 1
    keys = ((index[:, 0] * sizes[1] + index[:, 1]) * sizes[2] + index[:, 2]) * 2 + large
    weights = gaussian_weights(gaussians)
    groups = _nearest_means(means, np.unique(keys, return_inverse=True)[1], large, weights)
    # Larger ones would blur: what they cover less than their members they keep as `covers`.
    merged = merge_by_moments(gaussians, groups, weights, enlarge=1.0)
    apart = means - merged.means.double().numpy()[groups]
    square = np.average(errors**2 + (apart * apart).sum(1), weights=weights)
    # In the order of a curve, for the kernels skip sixteen at once that a view does not show, or that have faded out.
    return merged.select(get_backend(merged.means.device).morton_order(merged.means)), float(np.sqrt(square))


def _nearest_means(
    means: Float[np.ndarray, "n 3"], groups: Int[np.ndarray, " n"], large: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
) -> Int[np.ndarray, " n"]:  # fmt: skip
    """The group whose mean is nearest to each, of those of its kind (`KMEANS_STEPS` of k-means): borders of cells cut
    through what belongs together."""
    found = np.empty_like(groups)
    for kind in (False, True):
        rows = np.flatnonzero(large == kind)
        if len(rows):
            numbers = np.unique(groups[rows], return_inverse=True)[1]
            for _ in range(KMEANS_STEPS):
                numbers = _kmeans_step(means[rows], numbers, weights[rows])
            found[rows] = 2 * numbers + kind
    return np.unique(found, return_inverse=True)[1]


def _kmeans_step(
    means: Float[np.ndarray, "n 3"], groups: Int[np.ndarray, " n"], weights: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """The group whose mean by weight is nearest to each, and groups are numbered anew, without those that lose all."""
    sums = np.stack([np.bincount(groups, weights * axis) for axis in means.T], 1)
    nearest = cKDTree(sums / np.bincount(groups, weights)[:, None]).query(means)[1]
    return np.unique(nearest, return_inverse=True)[1]


def node_record(
    gaussians: Gaussians, error: float, anchors: AnchorModel | None, children: Sequence[NodeRecord]
) -> NodeRecord:
    """What the tree says of a node: boxes hold those of the children, errors are not less than theirs."""
    boxes = [np.array(child.bounds) for child in children if np.isfinite(child.bounds).all()]
    reach = [child.reach for child in children]
    if anchors is not None:
        boxes.append(_box(anchors.anchors.positions.numpy()))
        reach.append(float(anchors.anchors.log_scales[:, :3].max().exp()))
    if len(gaussians):
        boxes.append(_box(gaussians.means.numpy()))
        reach.append(float(gaussians.log_scales.max().exp()))
    low = np.min([box[:3] for box in boxes], axis=0)
    high = np.max([box[3:] for box in boxes], axis=0)
    return NodeRecord(
        error=max([error, *(child.error for child in children)]), bounds=(*low.tolist(), *high.tolist()),
        reach=max(reach), gaussians=len(gaussians), anchors=0 if anchors is None else len(anchors.anchors),
    )  # fmt: skip


def _box(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "6"]:
    return np.concatenate([points.min(0), points.max(0)]).astype(np.float64)


def _pseudo_views(cameras: Sequence[Camera], center: Float[np.ndarray, "3"]) -> list[Camera]:
    """Cameras all around a place, as far from it as some cameras are. They have yet to be turned towards it."""
    distance = np.median([np.linalg.norm(camera.position - center) for camera in cameras])
    azimuths, up = 2 * np.pi * np.arange(PSEUDO_VIEWS) / PSEUDO_VIEWS, np.radians(PSEUDO_ELEVATION)
    views = list[Camera]()
    for azimuth in azimuths:
        away = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        pose = np.array(cameras[0].camera_from_world)
        pose[:3, 3] = -pose[:3, :3] @ (center + distance * away)
        views.append(replace(cameras[0], camera_from_world=pose))
    return views


def _turned(camera: Camera, positions: Float[np.ndarray, "n 3"]) -> Camera | None:
    """The camera turned towards some places, with a picture of just these, at most `MAX_WINDOW_PX` wide and high: what
    anchors show depends on where the camera is, not on where it looks. None where it is among them."""
    center = np.median(positions, axis=0)
    forward = center - camera.position
    distance = float(np.linalg.norm(forward))
    forward = forward / max(distance, 1e-9)
    right = np.cross(forward, [0, 0, 1] if abs(forward[2]) < 0.99 else [0, 1, 0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ camera.position
    local = positions @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > 0.2 * distance]
    if not len(local):
        return None
    slopes = local[:, :2] / local[:, 2:]
    low, high = slopes.min(0), slopes.max(0)
    focal = min(max(camera.fx, camera.fy), (MAX_WINDOW_PX - 8) / max(float((high - low).max()), 1e-9))
    left, top = 4 - focal * low
    width, height = (int(side) + 8 for side in focal * (high - low))
    whole = 2 * int(np.ceil(focal * max(np.abs(low).max(), np.abs(high).max()))) + 16
    return Camera(
        camera_from_world=pose, fx=focal, fy=focal, cx=float(left), cy=float(top), width=width, height=height,
        uncropped_size=(whole, whole),
    )  # fmt: skip


class CameraTable:
    """The training cameras, of which a few are chosen for each leaf."""

    def __init__(self, cameras: Sequence[Camera], height: float) -> None:
        """`height`: how far they are from what they see (`captures.camera_height`)."""
        self._cameras, self.pixel = cameras, pixel_at_camera_height(height, cameras)
        self._places = np.stack([camera.position for camera in cameras])

    def choose(self, positions: Float[np.ndarray, "n 3"]) -> list[Camera]:
        """The cameras that show most of some places from near, from as many sides as possible."""
        sample = positions[:: max(1, len(positions) // SAMPLES)].astype(np.float64)
        rays = self._places - np.median(sample, axis=0)
        distance = np.linalg.norm(rays, axis=1)
        near = np.argsort(distance, kind="stable")[:MAX_CANDIDATES]
        # A camera that looks elsewhere is better than none.
        share = np.array([self._cameras[i].in_frustum(sample).mean() for i in near.tolist()]) + 0.02
        directions = rays[near] / np.maximum(distance[near], 1e-9)[:, None]
        score = share * (distance[near].min() / np.maximum(distance[near], 1e-9)) ** 0.5
        chosen = [int(score.argmax())]
        apart = 1 - directions @ directions[chosen[0]]
        while len(chosen) < min(CAMERAS_PER_LEAF, len(near)):
            value = score * (apart + 0.01)
            value[chosen] = -1
            chosen.append(int(value.argmax()))
            apart = np.minimum(apart, 1 - directions @ directions[chosen[-1]])
        return [self._cameras[near[i]] for i in sorted(chosen)]


def leaf_gaussians(model: AnchorModel, cameras: CameraTable, edge: float) -> tuple[NodeGaussians, float]:
    """What a leaf draws instead of its anchors, and how far off it is."""
    baked, pixels = bake_leaf(model, cameras)
    baked, cell = with_learnt_blur(baked, max(cameras.pixel, model.photograph_pixel)), edge / CELLS_PER_EDGE
    members = single_members(baked, _color_weights(baked, pixels))
    merged, error = merge_cells(members, cell, np.zeros(len(baked)))
    return merged, max(error, MIN_LEAF_ERROR * cell)


def _color_weights(baked: Gaussians, pixels: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """By how much colors count beside the weights of a leaf's Gaussians: the root of what views show of each, in parts
    of its weight (choice, reports/levels-of-detail.md). What is hidden from all cameras may show from elsewhere."""
    weights = gaussian_weights(baked)
    seen = pixels * weights.sum() / np.maximum(weights * pixels.sum(), 1e-300)
    return np.clip(np.sqrt(seen), *COLOR_WEIGHTS)


def parent_gaussians(
    children: Sequence[NodeGaussians], records: Sequence[NodeRecord], edge: float
) -> tuple[NodeGaussians, float]:
    """What a node draws instead of its children, and how far off it is."""
    together = NodeGaussians(
        **{name: torch.cat([child.tensors()[name] for child in children]) for name in children[0].tensors()}
    )
    errors = np.repeat([record.error for record in records], [len(child) for child in children])
    return merge_cells(together, edge / CELLS_PER_EDGE, errors)
