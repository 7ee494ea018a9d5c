"""The partitions of published methods, to compare with: each cuts the scene and chooses cameras in its own way.

Only what is named in `omissions` differs from the publication; training and merging are ours.

- Lin et al., VastGaussian: Vast 3D Gaussians for Large Scene Reconstruction, CVPR 2024.
- Liu et al., CityGaussian: Real-time High-quality Large-Scale Scene Rendering with Gaussians, ECCV 2024.
- Chen and Lee, DOGS: Distributed-Oriented Gaussian Splatting for Large-Scale 3D Reconstruction via Gaussian Consensus,
  NeurIPS 2024.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import shapely
import shapely.affinity
from jaxtyping import Float, Int

from vdgs.config.method import AssignmentConfig, MethodConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.clustering import fit_principal_plane
from vdgs.partition.partition_scene import choose_block_count, partition_scene
from vdgs.system.memory.memory_estimate import max_image_pixels

#: Outliers beyond these quantiles of the anchors do not decide how large the scene is.
EXTENT_QUANTILES = (0.01, 0.99)
#: Cells are widened to this many times their sides for training (section 4.1: by 20 %).
VASTGAUSSIAN_EXPANSION = 1.2
#: A camera joins where the cell covers this share of its picture (section 5: 25 %).
MIN_VISIBLE_SHARE = 0.25
#: The foreground lies between these quantiles of the cameras; beyond it space is contracted (choice: the publication
#: sets it by hand for each scene).
FOREGROUND_QUANTILES = (0.1, 0.9)
#: Points on each side of a cell: its sides are curves outside the foreground.
POINTS_PER_SIDE = 24
#: A camera joins where leaving the block out changes 1 - SSIM by more (the publication: 0.05 to 0.12).
DISSIMILARITY_THRESHOLD = 0.08
#: A cell is trained this many times as large.
DOGS_EXPANSION = 1.4
#: A camera joins that holds this share of a cell's anchors (choice).
MIN_ANCHOR_SHARE = 0.25


class PartitionStrategy(ABC):
    """A published partition. Blocks own every point, by core or nearest core, as in `Blocks`."""

    citation: ClassVar[str]
    omissions: ClassVar[tuple[str, ...]]

    @abstractmethod
    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """At most `count` blocks from anchors and training cameras, and warnings for people."""

    @abstractmethod
    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        """How cameras are scored and above which score they join; topping up stays as it is."""

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """The scores with what the method adds to, or takes instead of, those of `assignment`."""
        return scores


def grid_shape(count: int, aspect: float) -> tuple[int, int]:
    """Columns and rows with exactly `count` cells, the most nearly square where x is `aspect` times as long as y."""
    shapes = [(columns, count // columns) for columns in range(1, count + 1) if count % columns == 0]
    return min(shapes, key=lambda shape: abs(np.log(shape[0] / shape[1]) - np.log(max(aspect, 1e-9))))


def checked_xy(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """x, y in float64. Raises VdgsError if there is nothing to cut."""
    ground = np.asarray(positions, np.float64)[:, :2]
    if len(ground) == 0 or not np.isfinite(ground).all():
        raise VdgsError("the coarse model holds no anchors, or some at places that are no numbers. Train it again.")
    return ground


def nonempty_cells(cells: Sequence[Block], ground: Float[np.ndarray, "n 2"], count: int) -> tuple[Blocks, list[str]]:
    """The cells that own anchors, as blocks numbered along x."""
    owned = np.bincount(Blocks(tuple(cells)).owner(ground), minlength=len(cells))
    kept = [cell for cell, anchors in zip(cells, owned, strict=True) if anchors > 0]
    kept.sort(key=lambda cell: (cell.core.centroid.x, cell.core.centroid.y))
    warnings = []
    if len(kept) < count:
        warnings.append(f"the scene is cut into {len(kept)} blocks instead of {count}: the other cells hold no anchors")
    return Blocks(tuple(kept)), warnings


def scale_shape(shape: shapely.Polygon, factor: float) -> shapely.Polygon:
    """The shape `factor` times as large about its center."""
    return shapely.affinity.scale(shape, factor, factor, origin="center")


class VastGaussian(PartitionStrategy):
    """Cells with equally many cameras; cameras by the area that a cell takes of their images (section 4.1)."""

    citation = "Lin et al., VastGaussian, CVPR 2024"
    omissions = (
        "coverage-based point selection: a block starts from the coarse anchors, and the rest is frozen context",
        "decoupled appearance modelling",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """Sections with equally many cameras along the longer side, each cut again across it."""
        ground = checked_xy(positions)
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        low = np.minimum(np.quantile(ground, EXTENT_QUANTILES[0], axis=0), centers.min(axis=0))
        high = np.maximum(np.quantile(ground, EXTENT_QUANTILES[1], axis=0), centers.max(axis=0))
        margin = 1e-6 * float((high - low).max()) + 1e-9
        low, high = low - margin, high + margin
        spread = np.ptp(centers, axis=0) + margin
        columns, rows = grid_shape(count, spread[0] / spread[1])
        cells = []
        for x0, x1, section in _equal_camera_splits(centers, 0, columns, low[0], high[0]):
            for y0, y1, _ in _equal_camera_splits(section, 1, rows, low[1], high[1]):
                if x1 > x0 and y1 > y0:
                    core = shapely.box(x0, y0, x1, y1)
                    cells.append(Block(core, scale_shape(core, VASTGAUSSIAN_EXPANSION)))
        return nonempty_cells(cells, ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="frustum", threshold=MIN_VISIBLE_SHARE)

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """The share of the picture that the cell's box covers; a camera in the widened cell always joins."""
        boxes = [_corners(block.core, positions[blocks.owner(checked_xy(positions)) == index, 2])
                 for index, block in enumerate(blocks.items)]  # fmt: skip
        shares = np.array([[box_coverage(box, camera) for box in boxes] for camera in cameras])
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        inside = [shapely.contains_xy(block.expanded, centers[:, 0], centers[:, 1]) for block in blocks.items]
        joined = np.where(np.stack(inside, axis=1), 1.0, shares)
        return replace(scores, scores=joined.astype(scores.scores.dtype))


def box_coverage(corners: Float[np.ndarray, "8 3"], camera: Camera) -> float:
    """Share of the picture within the convex hull of a projected box; only what lies before the camera counts.

    The box is cut at a near plane, so that one which reaches behind the camera is projected rightly.
    """
    local = corners @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    near = 1e-3 * max(float(np.abs(local).max()), 1e-9)
    before = [point for point in local if point[2] >= near]
    for i in range(8):
        for bit in (1, 2, 4):
            a, b = local[i], local[i ^ bit]
            if a[2] < near <= b[2]:
                before.append(a + (near - a[2]) / (b[2] - a[2]) * (b - a))
    if len(before) < 3:
        return 0.0
    points = np.array(before)
    x = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    y = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    hull = shapely.MultiPoint(np.column_stack([x, y])).convex_hull
    picture = shapely.box(0, 0, camera.width, camera.height)
    return float(hull.intersection(picture).area / picture.area)


def _corners(core: shapely.Polygon, heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, "8 3"]:
    """The box over a cell, from its lowest to its highest anchor; corner i ^ 1, 2, 4 is the neighbor in x, y, z."""
    x0, y0, x1, y1 = core.bounds
    z0, z1 = np.quantile(heights, EXTENT_QUANTILES)
    return np.array([[x0 if i & 1 else x1, y0 if i & 2 else y1, z0 if i & 4 else z1] for i in range(8)])


def _equal_camera_splits(
    centers: Float[np.ndarray, "c 2"], axis: int, parts: int, low: float, high: float
) -> list[tuple[float, float, Float[np.ndarray, "m 2"]]]:
    """From, to and cameras of each part along an axis; parts meet halfway between neighboring cameras."""
    if len(centers) == 0:
        return [(low, high, centers)]
    ordered = centers[np.argsort(centers[:, axis], kind="stable")]
    sections = np.array_split(ordered, min(parts, len(ordered)))
    meets = [(a[-1, axis] + b[0, axis]) / 2 for a, b in itertools.pairwise(sections)]
    edges = [low, *meets, high]
    return [(edges[i], edges[i + 1], section) for i, section in enumerate(sections)]


class CityGaussian(PartitionStrategy):
    """A uniform grid in contracted space (section 3.2); cameras by 1 - SSIM without the block, or standing in it."""

    citation = "Liu et al., CityGaussian, ECCV 2024"
    omissions = (
        "a block moves the anchors of its own cell; there all Gaussians of the coarse model move, and the cell is kept",
        "levels of detail, compression",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """Equal cells of the contracted square [-2, 2]², as far out as there are anchors."""
        ground = checked_xy(positions)
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        low, high = np.quantile(centers, FOREGROUND_QUANTILES, axis=0)
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
        contracted = contract((ground - middle) / half)
        reach = min(float(np.abs(contracted).max()) + 1e-3, 1.999)
        extent = np.ptp(np.quantile(contracted, (0.01, 0.99), axis=0), axis=0)
        columns, rows = grid_shape(count, float(extent[0] / max(extent[1], 1e-9)))
        across, up = (np.linspace(-2, 2, n + 1).clip(-reach, reach) for n in (columns, rows))
        cells = []
        for x0, x1 in itertools.pairwise(across):
            for y0, y1 in itertools.pairwise(up):
                core = shapely.Polygon(expand(_outline(x0, y0, x1, y1)) * half + middle).buffer(0)
                if isinstance(core, shapely.Polygon) and not core.is_empty:
                    cells.append(Block(core, core))
        return nonempty_cells(cells, ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="leave-one-out", threshold_leave_one_out=DISSIMILARITY_THRESHOLD)

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """A camera also joins the block that it stands in: its score there is the highest possible."""
        changed = scores.scores.copy()
        changed[np.arange(len(changed)), scores.nadir_block] = 1.0
        return replace(scores, scores=changed)


def contract(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """x where |x|∞ <= 1, else (2 - 1 / |x|∞) x / |x|∞: the plane within the square [-2, 2]²."""
    norm = np.maximum(np.abs(points).max(axis=1, keepdims=True), 1.0)
    return (2 - 1 / norm) * points / norm


def expand(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The inverse of `contract`, within the open square (-2, 2)²."""
    norm = np.maximum(np.abs(points).max(axis=1, keepdims=True), 1.0)
    return points / (norm * (2 - norm))


def _outline(x0: float, y0: float, x1: float, y1: float) -> Float[np.ndarray, "m 2"]:
    """Points about a rectangle; neighbors share those on their common side."""
    x, y = _side(x0, x1), _side(y0, y1)
    bottom, right = np.column_stack([x, np.full(len(x), y0)]), np.column_stack([np.full(len(y), x1), y])
    top, left = np.column_stack([x[::-1], np.full(len(x), y1)]), np.column_stack([np.full(len(y), x0), y[::-1]])
    return np.concatenate([bottom[:-1], right[:-1], top[:-1], left[:-1]])


def _side(a: float, b: float) -> Float[np.ndarray, " s"]:
    """Points from a to b, with those among them where contraction begins."""
    return np.union1d(np.linspace(a, b, POINTS_PER_SIDE), [each for each in (-1.0, 1.0) if a < each < b])


class Dogs(PartitionStrategy):
    """The scene's oriented box cut into equal cells, each widened by 1.4, without the consensus of the blocks."""

    citation = "Chen and Lee, DOGS, NeurIPS 2024"
    omissions = (
        "the consensus (ADMM) on what blocks share: each block's own cell is kept, its ring is frozen",
        "splitting by content: cells are equal; cameras join by the share of the cell's anchors that they hold",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        ground = checked_xy(positions)
        plane = fit_principal_plane(ground)
        places = plane.to_plane(ground)
        low, high = np.quantile(places, EXTENT_QUANTILES, axis=0)
        size = np.maximum(high - low, 1e-6 * float(np.abs(places).max()) + 1e-9)
        columns, rows = grid_shape(count, float(size[0] / size[1]))
        across, up = (low[i] + size[i] * np.linspace(0, 1, n + 1) for i, n in enumerate((columns, rows)))
        cores = [
            plane.to_ground(shapely.box(x0, y0, x1, y1))
            for x0, x1 in itertools.pairwise(across)
            for y0, y1 in itertools.pairwise(up)
        ]
        return nonempty_cells([Block(core, scale_shape(core, DOGS_EXPANSION)) for core in cores], ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="frustum", threshold=MIN_ANCHOR_SHARE)


#: By the name in `PartitionConfig.strategy`.
STRATEGIES: dict[str, PartitionStrategy] = {
    "vastgaussian": VastGaussian(),
    "citygaussian": CityGaussian(),
    "dogs": Dogs(),
}


def cut_scene(
    positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], cameras: Sequence[Camera],
    method: MethodConfig,
) -> tuple[Blocks, list[str]]:  # fmt: skip
    """The blocks that the settings ask for, by their strategy, and warnings."""
    config, pixels = method.partition, max_image_pixels(cameras, method.block.resolution_schedule)
    count = choose_block_count(len(visibility), len(cameras), pixels, method)
    if config.strategy != "visibility":
        return STRATEGIES[config.strategy].partition(positions, cameras, count)
    return partition_scene(positions, visibility, replace(config, blocks=count), method.training.seed)


def assignment_config(method: MethodConfig) -> AssignmentConfig:
    """The settings of the assignment, adapted to the strategy of the partition."""
    strategy = method.partition.strategy
    return method.assignment if strategy == "visibility" else STRATEGIES[strategy].assignment(method.assignment)


def adjust_scores(
    scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera], strategy: str
) -> ScoreMatrix:
    """The scores, adapted to the strategy of the partition."""
    if strategy == "visibility":
        return scores
    return STRATEGIES[strategy].adjust_scores(scores, positions, blocks, cameras)
