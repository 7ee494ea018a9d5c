"""Adding, removing and sorting anchors between steps, with their moments, statistics and cached gradients."""

from __future__ import annotations

from typing import TypedDict

import torch
from torch import Tensor

from vdgs.kernels import get_backend
from vdgs.kernels.idle_memory import trim_heap
from vdgs.training.compensation import begin_cycle, close_cycle, cycle_log, low_visibility_mask
from vdgs.training.densification import CompensatedGradient, decide_densification
from vdgs.training.per_anchor_tensors import index_anchors
from vdgs.training.schedule import views_in_cycle
from vdgs.training.training_state import TrainingProblem, TrainingState
from vdgs.visibility.visibility_counts import visibility_ratio


class Growth(TypedDict):
    """Fields of `StepReport`: what a growth decision did."""

    grown: int
    pruned: int
    cycle: dict[str, float | None]


def densify(state: TrainingState, stage: TrainingProblem) -> Growth:
    """Add and remove anchors with their moments and statistics. Returns what StepReport says of it."""
    config = stage.config
    trim_heap()
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.iteration)
    compensated, share, threshold = _compensate(state, stage)
    decision = decide_densification(
        state.anchors, state.statistics, stage.voxel_size, config.densify, generator,
        compensated=compensated,
        frozen=None if stage.frozen_anchors is None else stage.frozen_anchors.anchors,
        growth_mask=stage.growth_mask, max_pixels=stage.max_pixels,
    )  # fmt: skip
    before, added = len(state.anchors), len(decision.added)
    kept = torch.cat([decision.keep_mask, decision.keep_mask.new_ones(added)])
    trim_heap()
    largest = stage.max_log_scale_at(decision.added.positions)
    new = {"anchors": decision.added.tensors(), "largest": {"log_scale": largest}}
    index_anchors(state, new, added, kept)
    trim_heap()
    if state.compensation is not None:
        begin_cycle(state.compensation, state.statistics)
    cycle = {} if compensated is None else cycle_log(compensated, share, threshold, decision, config.compensation)
    if config.densify.max_anchors:
        cycle["budget_reached"] = before + added >= config.densify.max_anchors
    return {"grown": added, "pruned": decision.pruned, "cycle": cycle}


def _compensate(state: TrainingState, stage: TrainingProblem) -> tuple[CompensatedGradient | None, Tensor, float]:
    """Close a cycle of compensated growth (eqs. 8-10): what is added for whom, c_k, and the T_low used."""
    if state.compensation is None:
        return None, torch.zeros(0, dtype=torch.float32, device="cpu"), 0.0
    config = stage.config
    cameras = [stage.images.camera(view) for view in views_in_cycle(state.iteration, stage)]
    share = visibility_ratio(state.anchors.positions, cameras)
    low, threshold = low_visibility_mask(share, config.compensation)
    closed = close_cycle(state.compensation, state.statistics, low, threshold, config.densify, config.compensation)
    return closed, share, threshold


def sort_morton(state: TrainingState) -> None:
    """Put all that is kept per anchor into Morton order."""
    positions = state.anchors.positions
    order = get_backend(positions.device).morton_order(positions)
    del positions  # else it would be there twice
    trim_heap()
    index_anchors(state, {}, 0, order)
    trim_heap()
