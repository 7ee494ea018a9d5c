"""Anchors that come and go between steps, with their moments, statistics and remembered gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from vdgs.kernels import native as kernels
from vdgs.memory.process import return_unused
from vdgs.model.anchors import Anchors
from vdgs.model.visibility import share_in_cycle
from vdgs.training.compensation import begin_cycle, compensate, cycle_facts, low_visibility, update_cache
from vdgs.training.growth import Compensated, Statistics, decide
from vdgs.training.optimiser import rebuild
from vdgs.training.schedule import views_in_cycle
from vdgs.training.state import Stage, TrainingState


def grow(state: TrainingState, stage: Stage) -> dict[str, Any]:
    """Add and remove anchors with their moments and statistics. Returns what StepReport says of it."""
    config = stage.config
    return_unused()
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.iteration)
    compensated, threshold = _compensate(state, stage)
    decision = decide(
        state.anchors, state.statistics, stage.voxel, config.growth, generator,
        compensated=compensated,
        surroundings=None if stage.surroundings is None else stage.surroundings.anchors.positions,
        may_hold=stage.may_hold,
    )  # fmt: skip
    before, added = len(state.anchors), len(decision.added)
    kept = torch.cat([decision.kept, torch.ones(added, dtype=torch.bool)])
    _rebuild(state, decision.added, kept)
    if state.compensation is not None:
        state.compensation = state.compensation.extended(added).select(kept)
        begin_cycle(state.compensation, state.statistics)
    cycle = {} if compensated is None else cycle_facts(compensated, threshold, decision, config.compensation)
    if config.growth.max_anchors:
        cycle["budget_reached"] = before + added >= config.growth.max_anchors
    return {"grown": added, "pruned": decision.pruned, "cycle": cycle}


def _compensate(state: TrainingState, stage: Stage) -> tuple[Compensated | None, float]:
    """Close a cycle of compensated growth (eqs. 8-10): what is added for whom, and the T_low used."""
    if state.compensation is None:
        return None, 0.0
    config = stage.config
    cameras = [stage.images.camera(view) for view in views_in_cycle(state.iteration, stage)]
    share = share_in_cycle(state.anchors.positions, cameras)
    low, threshold = low_visibility(share, config.compensation)
    update_cache(state.compensation, state.statistics, low, config.compensation)
    return compensate(state.compensation, low, threshold, config.growth, config.compensation), threshold


def reorder(state: TrainingState) -> None:
    """Put anchors, moments and statistics into Morton order."""
    order = kernels.morton_order(state.anchors.positions)
    if state.compensation is not None:
        state.compensation = state.compensation.select(order)
    if state.average is not None:
        state.average.reorder(order)
    _rebuild(state, state.anchors.select(order[:0]), order)


def _rebuild(state: TrainingState, added: Anchors, kept: Tensor) -> None:
    """Append anchors, then keep some (mask or order), with moments and statistics; tensor by tensor, for memory."""
    return_unused()
    k = added.offsets.shape[1]
    tensors, state.anchors = state.anchors.tensors(), added
    rebuild(tensors, added.tensors(), kept)
    state.anchors = Anchors(**tensors)
    tensors, state.statistics = state.statistics.tensors(), Statistics.zeros(0, k)
    rebuild(tensors, Statistics.zeros(len(added), k).tensors(), kept)
    state.statistics = Statistics(**tensors)
    state.optimiser.anchors.rebuild(len(added), kept)
    return_unused()
