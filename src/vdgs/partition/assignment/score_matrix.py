"""How well each camera shows each block: the score matrix behind camera assignment (section IV-B, eqs. 6-7).

Names and dimensions: c cameras, b blocks, n anchors, m splats of one view.

The anchors of a view are decoded once: each block is rendered from its share of the splats of the whole view, which are
exactly those that the block alone would give. Everything is rendered over black (choice; as the methods do that the
paper builds on), with the mean appearance: missing ground over the model's own background would pass for a match.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend, get_num_threads
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import decode_view, rasterize_splats
from vdgs.partition.blocks import Blocks, xy_positions
from vdgs.visibility.visibility_counts import count_visibility

#: A pixel is drawn where its alpha is above this.
MIN_ALPHA = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoreMatrix:
    """What assignment decides from: rows are cameras, columns blocks."""

    #: The mode that the scores were made in, as in AssignmentConfig.
    mode: str
    #: Higher: the camera belongs more to the block.
    scores: Float[np.ndarray, "c b"]
    #: Anchors of the block's core (those that it owns) in the frustum of the camera.
    visible_anchors: Int32[np.ndarray, "c b"]
    #: Share of the drawn pixels that the block alone draws alike; NaN in mode `frustum`.
    coverage: Float[np.ndarray, "c b"]
    #: Anchors that each block owns.
    anchors: Int64[np.ndarray, " b"]
    #: The block that owns the place beneath each camera.
    nadir_block: Int64[np.ndarray, " c"]


def compute_score_matrix(
    model: AnchorModel,
    blocks: Blocks,
    cameras: Sequence[Camera],
    config: AssignmentConfig,
    on_progress: Callable[[int, int], None] | None = None,
) -> ScoreMatrix:
    """Score every camera for every block; calls `on_progress(done, total)` after each camera, in this thread.

    - `coverage` (choice): |{Δ < τ and alpha of the block > 0.5}| / |{alpha of the scene > 0.5}|; Δ (eq. 6) compares
      the scene with the widened block drawn alone. Pixels empty in both do not count; 0 where the scene is empty.
    - `paper`: the share of *all* pixels with Δ < τ (eq. 7).
    - `leave-one-out`: 1 - SSIM of the scene without the anchors that the block owns against the whole scene, 8 bits.
    - `frustum`: the share of the anchors that the block owns whose center the camera holds; nothing is drawn.

    Pictures are at most `config.image_size` wide and high. The scores of a camera depend on no other camera and on
    no number of threads. Memory: O(n b) bytes, and one view for each thread.
    """
    return CameraScorer(model, blocks, config).scores(cameras, on_progress)


class CameraScorer:
    """Scores cameras in any number of calls (`compute_score_matrix`)."""

    def __init__(self, model: AnchorModel, blocks: Blocks, config: AssignmentConfig):
        self._model, self._blocks, self._config = model, blocks, config
        self._members = _BlockMembers.of(model, blocks)

    def scores(self, cameras: Sequence[Camera], on_progress: Callable[[int, int], None] | None = None) -> ScoreMatrix:
        """The rows of some cameras."""
        shape, members, config = (len(cameras), len(self._blocks)), self._members, self._config
        scores, coverage = np.zeros(shape, np.float32), np.full(shape, np.nan, np.float32)
        visible_anchors = np.zeros(shape, np.int32)
        # Small images keep the threads of one kernel waiting for each other; those of several cameras do not.
        workers = ThreadPoolExecutor(get_num_threads())
        try:
            rows = workers.map(lambda camera: _score_camera(self._model, members, camera, config), cameras)
            for index, row in enumerate(rows):
                visible_anchors[index], scores[index], coverage[index] = row
                if on_progress is not None:
                    on_progress(index + 1, len(cameras))
        finally:
            workers.shutdown(cancel_futures=True)
        positions = np.array([camera.position[:2] for camera in cameras], np.float64).reshape(-1, 2)
        return ScoreMatrix(
            mode=config.mode, scores=scores, visible_anchors=visible_anchors, coverage=coverage,
            anchors=members.counts(), nadir_block=self._blocks.owner(positions),
        )  # fmt: skip


def concatenate_scores(parts: Sequence[ScoreMatrix]) -> ScoreMatrix:
    """The rows of several parts, one below the other; at least one part, all for the same blocks."""
    names = ("scores", "visible_anchors", "coverage", "nadir_block")
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return ScoreMatrix(**(vars(parts[0]) | rows))


def color_difference(block: Raster, full: Raster) -> Float[np.ndarray, "h w"]:
    """Δ(u) of eq. 6: the mean over the channels of the absolute difference."""
    apart = np.abs(block.image.cpu().numpy() - full.image.cpu().numpy())
    return (apart[..., 0] + apart[..., 1] + apart[..., 2]) / 3  # twice as fast as the mean over so short an axis


def drawn_coverage_ratio(block: Raster, full: Raster, tau: float) -> float:
    """Share of the pixels that the scene draws which the block alone draws, and draws alike; 0 where there are none."""
    drawn = full.alpha.cpu().numpy() > MIN_ALPHA
    both = drawn & (block.alpha.cpu().numpy() > MIN_ALPHA)
    if not both.any():
        return 0.0
    return float(np.count_nonzero(both & (color_difference(block, full) < tau)) / np.count_nonzero(drawn))


def coverage_ratio(block: Raster, full: Raster, tau: float) -> float:
    """The coverage ratio of eq. 7 as printed: share of all pixels with Δ < τ, empty ones among them."""
    return float(np.mean(color_difference(block, full) < tau))


def dissimilarity(image: Float[Tensor, "h w 3"], full: Float[Tensor, "h w 3"]) -> float:
    """1 - SSIM of two pictures rounded to 8 bits."""
    rounded, target = ((each.clamp(0, 1) * 255 + 0.5).to(torch.uint8) for each in (image, full))
    return 1.0 - float(get_backend(full.device).photometric_loss(rounded.float() / 255, target, None).ssim)


@dataclass(frozen=True, eq=False)
class _BlockMembers:
    """Which anchors belong to which block, and the anchors sorted for counting."""

    owner: Int64[Tensor, " n"]
    #: As `Blocks.in_expanded`, for all blocks at once.
    reached: Bool[Tensor, "b n"]
    #: Anchor positions by owner, neighbors together: whole groups are then decided by one test each.
    points: Float[Tensor, "n 3"]
    #: Where the points of each block begin and end.
    bounds: list[int]

    @staticmethod
    def of(model: AnchorModel, blocks: Blocks) -> _BlockMembers:
        positions = model.anchors.positions
        points = xy_positions(positions)
        owner = blocks.owner(points)
        reached = np.empty((len(blocks), len(points)), bool)
        for index in range(len(blocks)):
            reached[index] = blocks.in_expanded(index, points, owner)
        near = get_backend(positions.device).morton_order(positions).cpu().numpy()
        order = near[np.argsort(owner[near], kind="stable")]
        bounds = [0, *np.cumsum(np.bincount(owner, minlength=len(blocks))).tolist()]
        return _BlockMembers(
            torch.from_numpy(owner).to(positions.device), torch.from_numpy(reached).to(positions.device),
            positions[order].contiguous(), bounds,
        )  # fmt: skip

    def counts(self) -> Int64[np.ndarray, " b"]:
        """How many anchors every block owns."""
        return np.diff(self.bounds).astype(np.int64)

    def visible(self, camera: Camera) -> np.ndarray:
        """How many anchors of every block are in the frustum, [b] int32."""
        in_frustum = count_visibility(self.points, [camera])
        return np.array([int(in_frustum[a:b].sum()) for a, b in pairwise(self.bounds)], np.int32)


@torch.no_grad()  # holds for the thread that it is entered in
def _score_camera(
    model: AnchorModel, members: _BlockMembers, camera: Camera, config: AssignmentConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Visible anchors, scores and coverage of one camera for every block, [b] each."""
    visible = members.visible(camera)
    if config.mode == "frustum":
        return visible, visible / np.maximum(members.counts(), 1), np.full(len(visible), np.nan)
    scores, coverage = _rendered_scores(model, members, camera.limit_size(config.image_size), config)
    return visible, np.array(scores), np.array(coverage)


def _rendered_scores(
    model: AnchorModel, members: _BlockMembers, camera: Camera, config: AssignmentConfig
) -> tuple[list[float], list[float]]:
    """The scores of one camera for every block in a mode that renders, and its coverage."""
    rows, splats = decode_view(model.without_local_exposure(), camera)
    anchor = rows[splats.source.long() // model.anchors.offsets.shape[1]]
    full = rasterize_splats(splats, camera, splats.means_px.new_zeros(3))
    owner, reached = members.owner[anchor], members.reached[:, anchor]
    scores, covered = [], []
    blank = Raster(torch.zeros_like(full.image), torch.zeros_like(full.alpha), None)
    alike_to_blank = coverage_ratio(blank, full, config.tau) if config.mode == "paper" else 0.0
    # Most of many blocks are nowhere in a view: what they give is known.
    for index, shown in enumerate(reached.any(dim=1).tolist()):
        if not shown:
            covered.append(0.0)
            scores.append(alike_to_blank)
            continue
        block = _render_subset(splats, reached[index], full, camera)
        covered.append(drawn_coverage_ratio(block, full, config.tau))
        if config.mode == "paper":
            scores.append(coverage_ratio(block, full, config.tau))
        elif config.mode == "leave-one-out":
            rest = _render_subset(splats, owner != index, full, camera)
            scores.append(0.0 if rest is full else dissimilarity(rest.image, full.image))
        else:
            scores.append(covered[-1])
    return scores, covered


def _render_subset(splats: Splats, chosen: Bool[Tensor, " m"], full: Raster, camera: Camera) -> Raster:
    """The picture of some of the splats over black; `full`, that of all of them, where all are chosen."""
    rows = chosen.nonzero().squeeze(1)
    if len(rows) == len(chosen):
        return full
    if not len(rows):
        return Raster(torch.zeros_like(full.image), torch.zeros_like(full.alpha), None)
    return rasterize_splats(select_splats(splats, rows), camera, splats.means_px.new_zeros(3))


def select_splats(splats: Splats, rows: Int64[Tensor, " some"]) -> Splats:
    """Some of the splats, in the same order: equal depths are blended in that of the rows."""
    return replace(splats, **{field.name: getattr(splats, field.name)[rows] for field in fields(splats)})
