"""Training on a device other than the CPU, without one: nothing mixes devices, and the numbers are those of the CPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from block_support import CONFIG, coarse
from checkerboard import Photographs
from pretended_device import CARD, pretended_card
from vdgs import kernels
from vdgs.settings.method import CompensationConfig, GrowthConfig
from vdgs.training import Stage, Surroundings, TrainingState, loop, start_state, to_saved, train_step

CPU = torch.device("cpu")
#: Growth, compensation, a new order and the mean of models all happen within few steps.
BUSY = {
    "growth": GrowthConfig(interval=2, statistics_from=0, start=2, threshold=1e-6, gate=0.1, until=0.5),
    "compensation": CompensationConfig(enabled=True, t_low=1.0),
    "iterations": 8,
    "average": 0.4,
}


def trained_on(device: torch.device, steps: int, **changes: Any) -> TrainingState:
    """A block among frozen surroundings after so many steps on a device."""
    anchors, decoder = coarse()
    away = replace(anchors, positions=anchors.positions + torch.tensor([3.0, 0.0, 0.0]))
    stage = Stage(
        replace(CONFIG, **changes), Photographs(), 8, 0.4, 5.0, kind="block", background=(0.3, 0.4, 0.5),
        surroundings=Surroundings(away.to(device), decoder.to(device)), device=device,
    )  # fmt: skip
    state = start_state(anchors.to(device), decoder.copy().to(device), stage)
    for _ in range(steps):
        train_step(state, stage)
    return state


def test_a_step_on_another_device_makes_the_numbers_of_the_processor(monkeypatch):
    monkeypatch.setenv(kernels.VARIABLE, "reference")
    expected = to_saved(trained_on(CPU, 1)).tensors
    with pretended_card() as waits:
        found = to_saved(trained_on(CARD, 1)).tensors
    assert waits.total() > 0
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, rtol=1e-4, atol=1e-6)


def test_growth_a_new_order_and_the_mean_stay_on_the_device(monkeypatch):
    monkeypatch.setattr(loop, "REORDER_INTERVAL", 5)
    with pretended_card():
        state = trained_on(CARD, 8, **BUSY)
        devices = {tensor.device.type for group in state.groups().values() for tensor in group.values()}
        devices |= {tensor.device.type for tensor in to_saved(state).tensors.values()}
    assert devices == {"cuda"}
    assert state.average is not None
    assert len(state.anchors) != len(coarse()[0])  # some have come, others have gone


def test_mixed_devices_are_found(monkeypatch):
    """The check can fail: with a background left in main memory, it does."""
    monkeypatch.setattr(loop, "background_at", lambda stage, iteration: torch.zeros(3))
    with pretended_card(), pytest.raises(RuntimeError, match="cuda and of shape"):
        trained_on(CARD, 1)


def test_cards_take_the_reference_and_the_processor_its_own(monkeypatch):
    assert kernels.choose(CARD).__name__ == "vdgs.kernels.reference"
    assert kernels.choose(CPU).__name__ == "vdgs.kernels.native"
    monkeypatch.setenv(kernels.VARIABLE, "reference")
    assert kernels.choose(CPU).__name__ == "vdgs.kernels.reference"
