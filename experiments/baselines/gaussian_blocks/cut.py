"""Where a scene of explicit Gaussians is cut, and which cameras train which block.

The cuts are those of `partition.strategies`. Dimensions: n points or Gaussians, c training cameras, b blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.model.gaussians import Gaussians, render_gaussians, visible_gaussian_rows
from vdgs.partition.assignment.assign_cameras import assign_cameras
from vdgs.partition.assignment.score_matrix import ScoreMatrix, dissimilarity
from vdgs.partition.blocks import Blocks, load_blocks, save_blocks, xy_positions
from vdgs.partition.strategies import STRATEGIES
from vdgs.system.atomic_files import read_json, write_json

#: A block that no camera is chosen for gets the best one that shows it, and nothing else is added to what the methods
#: choose (choice).
ASSIGNMENT = AssignmentConfig(always_best=False, min_cameras=1)


@dataclass(frozen=True, eq=False)
class GaussianCut:
    """Blocks and, for each, the numbers of the training views that serve it."""

    blocks: Blocks
    views: tuple[tuple[int, ...], ...]
    warnings: tuple[str, ...] = ()

    def save(self, folder: Path) -> None:
        """Write blocks.geojson and cut.json."""
        save_blocks(folder / "blocks.geojson", self.blocks, [{"cameras": len(views)} for views in self.views])
        write_json(folder / "cut.json", {"views": self.views, "warnings": self.warnings})  # last: the rest is complete

    @staticmethod
    def of(blocks: Blocks, joined: Bool[np.ndarray, "c b"], warnings: Sequence[str]) -> GaussianCut:
        """The cut in which these cameras train these blocks. A single block is the scene: it has all cameras."""
        if len(blocks) == 1:
            joined = np.ones_like(joined)
        empty = [f"block {index}: no camera shows it" for index in np.flatnonzero(~joined.any(axis=0)).tolist()]
        views = tuple(tuple(np.flatnonzero(column).tolist()) for column in joined.T)
        return GaussianCut(blocks, views, (*warnings, *empty))

    @staticmethod
    def load(folder: Path) -> GaussianCut | None:
        """What `save` wrote; None where there is none."""
        if not (folder / "cut.json").exists():
            return None
        saved = read_json(folder / "cut.json")
        views = tuple(tuple(map(int, each)) for each in saved["views"])
        return GaussianCut(load_blocks(folder / "blocks.geojson"), views, tuple(saved["warnings"]))


def cut_points(strategy: str, points: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int) -> GaussianCut:
    """The cut of a strategy that asks for points and cameras alone: the share of a block's points that a camera holds
    is its score, unless the strategy has another."""
    blocks, warnings = STRATEGIES[strategy].partition(points, cameras, count)
    owner = blocks.owner(xy_positions(points))
    held = points_held(points, owner, len(blocks), cameras)
    shares = held / np.maximum(np.bincount(owner, minlength=len(blocks)), 1)
    return choose_cameras(strategy, shares, held, blocks, points, cameras, warnings)


def cut_by_removal(
    strategy: str, gaussians: Gaussians, cameras: Sequence[Camera], count: int, image_size: int
) -> GaussianCut:
    """The cut of a strategy that asks what a trained scene looks like without a block: 1 - SSIM is its score. Pictures
    are at most `image_size` wide and high, drawn on the device of the Gaussians."""
    points = gaussians.means.cpu().numpy()
    blocks, warnings = STRATEGIES[strategy].partition(points, cameras, count)
    owner = blocks.owner(xy_positions(points))
    held = points_held(points, owner, len(blocks), cameras)
    scores = np.stack([_removal_scores(gaussians, owner, len(blocks), camera, image_size) for camera in cameras])
    return choose_cameras(strategy, scores, held, blocks, points, cameras, warnings)


def points_held(
    points: Float[np.ndarray, "n 3"], owner: Int64[np.ndarray, " n"], count: int, cameras: Sequence[Camera]
) -> Float[np.ndarray, "c b"]:
    """How many points of every block each camera holds in its frustum."""
    places = torch.from_numpy(points.astype(np.float32))
    return np.stack([np.bincount(owner[holds(places, camera)], minlength=count) for camera in cameras]).astype(float)


def holds(points: Float[Tensor, "n 3"], camera: Camera) -> Bool[np.ndarray, " n"]:
    """Which points lie in the frustum of a camera."""
    held: np.ndarray = get_backend(points.device).mark_visible(points, camera).cpu().numpy()
    return held


@torch.no_grad()
def _removal_scores(
    gaussians: Gaussians, owner: Int64[np.ndarray, " n"], count: int, camera: Camera, image_size: int
) -> Float[np.ndarray, " b"]:
    """1 - SSIM of a view, over black, without the Gaussians of each block against the whole view."""
    small = camera.limit_size(image_size)
    rows = visible_gaussian_rows(gaussians, small)
    seen, of_block = gaussians.select(rows), torch.from_numpy(owner).to(rows.device)[rows]
    black = seen.means.new_zeros(3)

    def picture(shown: Gaussians) -> Tensor:
        return render_gaussians(shown, small, black, shown.sh_degree)[0].image.cpu()

    full, scores = picture(seen), np.zeros(count)
    for block in of_block.unique().tolist():
        scores[block] = dissimilarity(picture(seen.select(of_block != block)), full)
    return scores


def choose_cameras(
    strategy: str,
    scores: Float[np.ndarray, "c b"],
    held: Float[np.ndarray, "c b"],
    blocks: Blocks,
    points: Float[np.ndarray, "n 3"],
    cameras: Sequence[Camera],
    warnings: Sequence[str],
) -> GaussianCut:
    """The cameras of every block by the strategy, from its scores and from how many points of a block each holds."""
    chosen, config = STRATEGIES[strategy], STRATEGIES[strategy].assignment(ASSIGNMENT)
    owner, centers = blocks.owner(xy_positions(points)), np.array([camera.position[:2] for camera in cameras])
    matrix = ScoreMatrix(
        mode=config.mode, scores=scores.astype(np.float32), visible_anchors=held.astype(np.int32),
        coverage=np.full(scores.shape, np.nan, np.float32),
        anchors=np.bincount(owner, minlength=len(blocks)).astype(np.int64), nadir_block=blocks.owner(centers),
    )  # fmt: skip
    joined = assign_cameras(chosen.adjust_scores(matrix, points, blocks, cameras), config).cameras
    return GaussianCut.of(blocks, joined, warnings)


def load_or_cut(folder: Path, cut: Callable[[], GaussianCut]) -> GaussianCut:
    """The cut in a folder, or a new one, which is saved there."""
    saved = GaussianCut.load(folder)
    if saved is None:
        saved = cut()
        saved.save(folder)
    return saved


def merge_cells(blocks: Blocks, parts: Sequence[Gaussians]) -> Gaussians:
    """Of the Gaussians of each block those in its own cell, block after block; cells at the border are open to
    infinity."""
    kept = [part.select(torch.from_numpy(blocks.owner(xy_positions(part.means)) == i)) for i, part in enumerate(parts)]
    whole = kept[0]
    for part in kept[1:]:
        whole = whole.concat(part)
    return whole
