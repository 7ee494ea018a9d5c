"""What is kept per anchor: everything comes, goes and changes places together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.block_training import CONFIG, block_stage
from vdgs.config.method import BlockConfig, CompensationConfig
from vdgs.system.memory.memory_estimate import bytes_per_anchor
from vdgs.training import TrainingState, to_checkpoint
from vdgs.training.per_anchor_tensors import index_anchors, index_rows
from vdgs.training.weight_averaging import ModelAverage


@pytest.mark.parametrize("pruned", [0, 3])
@pytest.mark.parametrize("added", [0, 4])
def test_rows_of_old_and_new_are_kept(pruned, added):
    generator = torch.Generator().manual_seed(pruned + added)
    before = {"a": torch.randn(10, 2, 3, generator=generator), "b": torch.randn(10, generator=generator)}
    more = {name: torch.randn(added, *t.shape[1:], generator=generator) for name, t in before.items()}
    kept = torch.ones(10 + added, dtype=torch.bool)
    kept[torch.randperm(10 + added, generator=generator)[:pruned]] = False
    order = torch.randperm(10 + added, generator=generator)
    for rows in (kept, order):
        tensors = dict(before)
        index_rows(tensors, more, rows)
        for name, tensor in tensors.items():
            assert torch.equal(tensor, torch.cat([before[name], more[name]])[rows])


def full_state() -> TrainingState:
    """A state of a block that keeps everything there is, every row of everything different."""
    training = replace(CONFIG, compensation=CompensationConfig(enabled=True))
    _, state = block_stage(BlockConfig(), training=training)
    state.model_average = ModelAverage.of(state.anchors, state.decoder)
    for group in state.groups().values():
        for place, tensor in enumerate(group.values()):
            tensor.copy_(torch.arange(tensor.numel()).reshape(tensor.shape) + 0.5 * place)
    return state


def test_nothing_that_has_a_row_for_each_anchor_is_left_out():
    """Found by its shape among all that is saved, so that what is added later is not forgotten here."""
    state = full_state()
    n, known = len(state.anchors), {f"{name}.{key}" for name, group in state.groups().items() for key in group}
    assert n > 50  # more than any dimension of the decoder
    found = {name for name, tensor in to_checkpoint(state).tensors.items() if tensor.ndim and tensor.shape[0] == n}
    assert found == known


def test_all_that_is_kept_moves_with_its_anchor():
    state = full_state()
    n = len(state.anchors)
    before = {name: {key: t.clone() for key, t in group.items()} for name, group in state.groups().items()}
    added = state.anchors.select(torch.tensor([3, 1]))
    order = torch.randperm(n + 2, generator=torch.Generator().manual_seed(0))[:-5]
    index_anchors(state, {"anchors": added.tensors()}, 2, order)
    for name, group in state.groups().items():
        for key, tensor in group.items():
            old = before[name][key]
            new = added.tensors()[key] if name == "anchors" else old.new_zeros(2, *old.shape[1:])
            assert torch.equal(tensor, torch.cat([old, new])[order]), (name, key)
    assert len(state.anchors) == n - 3


def test_nothing_keeps_the_memory_of_tensors_that_were_taken():
    """Else growth and sorting would hold the whole state twice."""
    state = full_state()
    taken = state.take_groups()
    left = [tensor for group in state.groups().values() for tensor in group.values()]
    assert len(left) == sum(len(group) for group in taken.values())
    assert all(tensor.untyped_storage().nbytes() == 0 for tensor in left)
    assert all(len(tensor) for group in taken.values() for tensor in group.values())


def test_the_estimate_counts_what_is_kept_of_an_anchor():
    """And two moments of its position, which never moves and has none."""
    for enabled in (False, True):
        training = replace(CONFIG, compensation=CompensationConfig(enabled=enabled))
        _, state = block_stage(BlockConfig(), training=training)
        kept = sum(tensor.nbytes for group in state.groups().values() for tensor in group.values())
        estimated = len(state.anchors) * bytes_per_anchor(state.anchors.offsets.shape[1], 0.0, enabled)
        assert estimated == kept + len(state.anchors) * 2 * 12
