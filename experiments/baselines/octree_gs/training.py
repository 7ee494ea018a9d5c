"""Training of anchors with levels: the loop of `vdgs.training` with two of its steps replaced.

A step draws the anchors that the view's distances ask for (`Octree.shown`), and a decision grows anchors level by level
(Octree-GS section 4.3). With one level both are those of Scaffold-GS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from experiments.baselines.octree_gs.levels import Octree, octree_starts, shown_anywhere
from experiments.baselines.octree_gs.settings import FORK, OctreeConfig
from vdgs.captures.camera_height import offset_rate_factor
from vdgs.captures.capture import Capture
from vdgs.geometry.camera import Camera
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.training import TrainingImages, TrainingProblem, TrainingState, initial_state
from vdgs.training.densification import GrowthMask, Parents, decide_densification, fill_cells, mean_gradient
from vdgs.training.densification_step import densify
from vdgs.training.per_anchor_tensors import TensorGroup, index_anchors
from vdgs.training.training_loop import REFERENCE_HEIGHT


@dataclass(kw_only=True)
class OctreeState(TrainingState):
    """A training state whose anchors have a level and a bias, by which they are shown from farther away."""

    levels: Int32[Tensor, " n"]
    bias: Float[Tensor, " n"]

    def groups(self) -> dict[str, TensorGroup]:
        return super().groups() | {"octree": {"levels": self.levels, "bias": self.bias}}

    def put_groups(self, groups: dict[str, TensorGroup]) -> None:
        super().put_groups(groups)
        self.levels, self.bias = groups["octree"]["levels"], groups["octree"]["bias"]


def start_state(
    anchors: Anchors, decoder: Decoder, problem: TrainingProblem, levels: Tensor | None = None
) -> OctreeState:
    """As `initial_state`; without `levels` all are 0 (of a checkpoint they are put there afterwards)."""
    plain = initial_state(anchors, decoder, problem)
    bias = torch.zeros_like(anchors.positions[:, 0])
    levels = torch.zeros_like(bias, dtype=torch.int32) if levels is None else levels
    return OctreeState(**vars(plain), levels=levels, bias=bias)


def random_decoder(problem: TrainingProblem) -> Decoder:
    """The first decoder, from the seed."""
    generator = torch.Generator().manual_seed(problem.config.seed)
    return Decoder.init_random(problem.config.model.num_offsets, False, 0, problem.num_images, generator)


def octree_problem(
    capture: Capture,
    config: OctreeConfig,
    octree: Octree,
    images: TrainingImages,
    cameras: Sequence[Camera],
    levels_at: Callable[[int], int] | None = None,
    device: str = "cpu",
) -> TrainingProblem:
    """What training works on; `cameras` are those of the images. `levels_at`: how many levels an iteration draws, of
    those that are open."""

    def select(state: TrainingState, rows: Tensor, camera: Camera) -> Tensor:
        assert isinstance(state, OctreeState)
        if octree.num_levels == 1:
            return rows
        num_open = octree.open_levels(state.iteration, config)
        if levels_at is not None:
            num_open = min(num_open, levels_at(state.iteration))
        shown = octree.shown(
            state.anchors.positions[rows], state.levels[rows], state.bias[rows], camera, num_open
        )  # fmt: skip
        return rows[shown]

    def grow(state: TrainingState, problem: TrainingProblem) -> dict[str, Any]:
        assert isinstance(state, OctreeState)
        done = densify(state, problem) if octree.num_levels == 1 else _grow(state, problem, config, octree, cameras)
        state.anchors.log_scales[:, 3:].clamp_(max=config.max_log_scale + float(torch.tensor(scale).log()))
        return dict(done)

    scale = capture.ground.scale
    return TrainingProblem(
        config=config.training, images=images, num_images=len(cameras), voxel_size=octree.voxel,
        # The volume term is of the capture's own unit, whose cube the loss divides by.
        camera_height=REFERENCE_HEIGHT * scale,
        offset_rate_factor=offset_rate_factor(capture, config.training),
        select_rows=select, grow=grow, device=torch.device(device),
    )  # fmt: skip


def octree_state(
    points: Float[np.ndarray, "p 3"], cameras: Sequence[Camera], problem: TrainingProblem, octree: Octree
) -> OctreeState:
    """The state before the first step, with anchors at the sparse points."""
    anchors, levels = octree_starts(points, cameras, octree, problem.config.model.num_offsets)
    there = problem.device
    return start_state(anchors.to(there), random_decoder(problem).to(there), problem, levels.to(there))


@torch.no_grad()
def _grow(
    state: OctreeState, problem: TrainingProblem, config: OctreeConfig, octree: Octree, cameras: Sequence[Camera]
) -> dict[str, Any]:
    """One decision: new anchors at each level, biases, pruning; moments and statistics follow."""
    growth = problem.config.densify
    judged = state.statistics.drawn > growth.min_draw_fraction * growth.every
    gradient = torch.where(judged, mean_gradient(state.statistics), 0.0)
    deepen = octree.open_levels(state.iteration, config) == octree.num_levels
    added, levels = grow_levels(
        state.anchors, state.levels, gradient, octree, config, cameras, deepen=deepen, growth_mask=problem.growth_mask
    )
    if deepen:
        state.bias += config.bias_step * _asks_for_bias(state.levels, gradient, judged, config)
    # What is left of a decision of Scaffold-GS: statistics begin again where judged, faint anchors go.
    decision = decide_densification(
        state.anchors, state.statistics, octree.voxel, replace(growth, num_levels=0), torch.Generator()
    )
    kept = torch.cat([decision.keep_mask, decision.keep_mask.new_ones(len(added))])
    new = {
        "anchors": added.tensors(), "largest": {"log_scale": problem.max_log_scale_at(added.positions)},
        "octree": {"levels": levels, "bias": torch.zeros_like(added.positions[:, 0])},
    }  # fmt: skip
    index_anchors(state, new, len(added), kept)
    return {"grown": len(added), "pruned": decision.pruned, "cycle": {}}


def _threshold(config: OctreeConfig, levels: Tensor) -> Tensor:
    """The gradient from which anchors of these levels grow."""
    return config.training.densify.grad_threshold * FORK ** (config.threshold_power * levels)


def _asks_for_bias(
    levels: Int32[Tensor, " n"], gradient: Float[Tensor, "n k"], judged: Bool[Tensor, "n k"], config: OctreeConfig
) -> Bool[Tensor, " n"]:
    """Anchors whose offsets that were judged have a mean gradient above a share of their level's threshold."""
    mean = gradient.sum(dim=1) / (judged.sum(dim=1) + 1e-6)
    return mean >= config.bias_threshold * _threshold(config, levels)


def grow_levels(
    anchors: Anchors, levels: Int32[Tensor, " n"], gradient: Float[Tensor, "n k"], octree: Octree,
    config: OctreeConfig, cameras: Sequence[Camera], *, deepen: bool, growth_mask: GrowthMask | None = None,
) -> tuple[Anchors, Int32[Tensor, " a"]]:  # fmt: skip
    """New anchors and their levels. An offset above its level's threshold asks for one in a cell of that level; above
    the next level's, in a cell of the next, with features of zero (program), if `deepen`."""
    limit = config.training.densify.max_anchors
    added, added_levels = anchors.select(levels[:0].long()), levels[:0]
    for level in range(octree.num_levels):
        own, next_threshold = (levels == level)[:, None], float(_threshold(config, torch.tensor(level + 1.0)))
        same = own & (gradient >= float(_threshold(config, torch.tensor(float(level))))) & (gradient < next_threshold)
        wanted = [(level, same)] + [(level + 1, own & (gradient >= next_threshold))] * (
            deepen and level + 1 < octree.num_levels
        )
        for target, asks in wanted:
            room = None if not limit else max(0, limit - len(anchors) - len(added))
            index = asks.reshape(-1).nonzero()[:, 0]
            if not len(index) or room == 0:
                continue
            taken = [anchors.positions[levels == target], added.positions[added_levels == target]]
            cells_level = levels.new_tensor(target)

            def is_shown(places: Tensor, cells_level: Tensor = cells_level) -> Tensor:
                shown = shown_anywhere(octree, places, cells_level.expand(len(places)), cameras)
                return shown if growth_mask is None else shown & growth_mask(places)

            parents = Parents(index, gradient.reshape(-1)[index], torch.zeros_like(index, dtype=torch.bool))
            more, _ = fill_cells(anchors, parents, taken, octree.cell(target), room, is_shown)
            if target > level:
                more = replace(more, features=torch.zeros_like(more.features))
            added = added.concat(more)
            added_levels = torch.cat([added_levels, cells_level.expand(len(more))])
    return added, added_levels
