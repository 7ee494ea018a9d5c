"""Anchors that come and go between steps, with their moments, statistics and remembered gradients."""

from __future__ import annotations

from typing import TypedDict

import torch
from torch import Tensor

from vdgs.kernels import choose
from vdgs.kernels.idle_memory import return_unused
from vdgs.training.compensation import begin_cycle, compensate, cycle_facts, low_visibility, update_cache
from vdgs.training.densification import Compensated, decide
from vdgs.training.per_anchor_tensors import remap
from vdgs.training.schedule import views_in_cycle
from vdgs.training.training_state import Stage, TrainingState
from vdgs.visibility.visibility_counts import share_in_cycle


class Growth(TypedDict):
    """What a growth decision did, as `StepReport` says it."""

    grown: int
    pruned: int
    cycle: dict[str, float | None]


def grow(state: TrainingState, stage: Stage) -> Growth:
    """Add and remove anchors with their moments and statistics. Returns what StepReport says of it."""
    config = stage.config
    return_unused()
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.iteration)
    compensated, share, threshold = _compensate(state, stage)
    decision = decide(
        state.anchors, state.statistics, stage.voxel, config.growth, generator,
        compensated=compensated,
        surroundings=None if stage.surroundings is None else stage.surroundings.anchors.positions,
        may_hold=stage.may_hold,
    )  # fmt: skip
    before, added = len(state.anchors), len(decision.added)
    kept = torch.cat([decision.kept, decision.kept.new_ones(added)])
    return_unused()
    largest = stage.largest_at(decision.added.positions)
    new = {"anchors": decision.added.tensors(), "largest": {"log_scale": largest}}
    remap(state, new, added, kept)
    return_unused()
    if state.compensation is not None:
        begin_cycle(state.compensation, state.statistics)
    cycle = {} if compensated is None else cycle_facts(compensated, share, threshold, decision, config.compensation)
    if config.growth.max_anchors:
        cycle["budget_reached"] = before + added >= config.growth.max_anchors
    return {"grown": added, "pruned": decision.pruned, "cycle": cycle}


def _compensate(state: TrainingState, stage: Stage) -> tuple[Compensated | None, Tensor, float]:
    """Close a cycle of compensated growth (eqs. 8-10): what is added for whom, c_k, and the T_low used."""
    if state.compensation is None:
        return None, torch.zeros(0), 0.0
    config = stage.config
    cameras = [stage.images.camera(view) for view in views_in_cycle(state.iteration, stage)]
    share = share_in_cycle(state.anchors.positions, cameras)
    low, threshold = low_visibility(share, config.compensation)
    update_cache(state.compensation, state.statistics, low, config.compensation)
    return compensate(state.compensation, low, threshold, config.growth, config.compensation), share, threshold


def reorder(state: TrainingState) -> None:
    """Put all that is kept per anchor into Morton order."""
    positions = state.anchors.positions
    order = choose(positions.device).morton_order(positions)
    del positions  # else it would be there twice
    return_unused()
    remap(state, {}, 0, order)
    return_unused()
