"""Adding, removing and permuting the rows of all tensors with one row per anchor: parameters, moments, statistics,
cached gradients, mean of models. New rows of a group are given (parameters) or zero."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

#: Named tensors with one row for each anchor.
TensorGroup = dict[str, Tensor]


class PerAnchorTensors(Protocol):
    """A state with groups of tensors that have one row per anchor."""

    def take_groups(self) -> dict[str, TensorGroup]:
        """All groups by name, no longer referenced by the state."""

    def put_groups(self, groups: dict[str, TensorGroup]) -> None:
        """The inverse of `take_groups`."""


def index_anchors(state: PerAnchorTensors, added: Mapping[str, TensorGroup], count: int, kept: Tensor) -> None:
    """Append `count` rows to everything that the state keeps per anchor, then keep the rows `kept` (mask or order).

    `added` has the new rows of the groups that it names; those of the others are zero. At most one tensor at a time
    exists twice.
    """
    groups = state.take_groups()
    for name, group in groups.items():
        index_rows(group, added.get(name) or {key: t.new_zeros(count, *t.shape[1:]) for key, t in group.items()}, kept)
    state.put_groups(groups)


def without_rows(groups: Mapping[str, TensorGroup]) -> dict[str, TensorGroup]:
    """The same groups of tensors without rows, for a state whose tensors are taken: a slice would keep their memory."""
    return {name: {key: t.new_empty(0, *t.shape[1:]) for key, t in group.items()} for name, group in groups.items()}


def index_rows(group: TensorGroup, added: Mapping[str, Tensor], kept: Tensor) -> None:
    """Append to each tensor the rows of its name in `added`, then keep the `kept` rows (mask or order); in place.

    Each old tensor is let go before the next is made: if nothing else holds it, no more than one is there twice.
    """
    for name in list(group):
        before, more = group.pop(name), added[name]
        if kept.dtype != torch.bool:
            group[name] = (torch.cat([before, more]) if len(more) else before).index_select(0, kept)
            continue
        old, new = kept[: len(before)], kept[len(before) :]
        stays, comes = int(old.sum()), int(new.sum())
        group[name] = before.new_empty(stays + comes, *before.shape[1:])
        torch.index_select(before, 0, old.nonzero()[:, 0], out=group[name][:stays])
        torch.index_select(more, 0, new.nonzero()[:, 0], out=group[name][stays:])
