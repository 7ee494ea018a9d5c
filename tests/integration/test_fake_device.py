"""Training on a device other than the CPU, without one: nothing mixes devices, and the numbers are those of the CPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from support.block_training import CONFIG, coarse
from support.checkerboard import Photographs
from support.cuda_on_host import ORDERS, host_compiler, needs_nvrtc
from support.fake_device import CARD, pretended_card
from support.fake_gsplat import needs_gsplat
from support.gpu_on_host import build, install
from vdgs import kernels
from vdgs.config.method import CompensationConfig, DensifyConfig
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.training import (
    FrozenAnchors,
    TrainingProblem,
    TrainingState,
    initial_state,
    pseudo_views,
    to_checkpoint,
    train_step,
    training_loop,
)

pytestmark = [
    pytest.mark.slow,
    needs_nvrtc, needs_gsplat, pytest.mark.xdist_group("composition"),
    pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler"),
]  # fmt: skip
CPU = torch.device("cpu")
#: Growth, compensation, a new order and the mean of models all happen within few steps.
BUSY = {
    "densify": DensifyConfig(
        every=2, stats_start=0, start=2, grad_threshold=1e-6, min_draw_fraction=0.1, stop_fraction=0.5
    ),
    "compensation": CompensationConfig(enabled=True, t_low=1.0),
    "iterations": 6,
    "swa_fraction": 0.4,
}


def few() -> tuple[Anchors, Decoder]:
    """Kernels that run on the processor take long for each anchor."""
    anchors, decoder = coarse()
    return anchors.select(torch.arange(0, len(anchors), 3)), decoder


def begun(device: torch.device, **changes: Any) -> tuple[TrainingState, TrainingProblem]:
    """A block among frozen surroundings, about to be trained on a device with photographs of half their size."""
    anchors, decoder = few()
    away = replace(anchors, positions=anchors.positions + torch.tensor([3.0, 0.0, 0.0]))
    stage = TrainingProblem(
        config=replace(CONFIG, resolution_schedule=((0.0, 2),), **changes),
        images=Photographs(), num_images=8, voxel_size=0.4, camera_height=5.0,
        kind="block", background=(0.3, 0.4, 0.5), frozen_anchors=FrozenAnchors(away.to(device), decoder.to(device)),
        device=device,
    )  # fmt: skip
    return initial_state(anchors.to(device), decoder.copy().to(device), stage), stage


def trained_on(device: torch.device, steps: int, **changes: Any) -> TrainingState:
    """It after so many steps."""
    state, stage = begun(device, **changes)
    for _ in range(steps):
        train_step(state, stage)
    return state


#: What a step waits for: how many anchors are visible, how many splats they show, how many tiles these reach, and at
#: the end whether the loss and the gradients were numbers.
WAITS = {
    "kernels/cuda/cull.py: cull: _local_scalar_dense": 1,
    "kernels/cuda/decode.py: _decoded: _local_scalar_dense": 1,
    "training/training_loop.py: _read_values: tolist": 1,
}


@pytest.fixture(scope="module")
def drivers(compiled_code):
    return build(compiled_code)


@pytest.fixture(params=["gsplat", "cuda"])
def rasterizer(request, drivers, monkeypatch) -> str:
    """With each of the rasterizers that may draw on a card."""
    install(drivers, monkeypatch, "cuda", request.param)
    return request.param


def test_a_step_on_another_device_makes_the_numbers_of_the_processor(monkeypatch, rasterizer):
    with pretended_card():
        found = to_checkpoint(trained_on(CARD, 1)).tensors
    monkeypatch.setenv(kernels.KERNELS_ENV_VAR, "torch_ref")
    expected = to_checkpoint(trained_on(CPU, 1)).tensors
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, rtol=1e-3, atol=1e-5)


def test_steps_have_the_same_bits_whichever_block_comes_first(monkeypatch, drivers):
    """With the own rasterizer: splats stand in another order, among frozen surroundings too."""
    found = []
    for order in (ORDERS[0], ORDERS[2]):
        install(drivers, monkeypatch, "cuda", "cuda")  # anew: tables are kept for a card
        for driver in drivers.values():
            monkeypatch.setattr(driver, "order", order)
        with pretended_card():
            found.append(to_checkpoint(trained_on(CARD, 2)).tensors)
    one, other = found
    assert all(torch.equal(tensor, other[name]) for name, tensor in one.items())


def test_a_step_waits_for_the_card_only_where_it_must(rasterizer):
    """In the steady state: without growth, and but for every tenth step, in which people are told a PSNR."""
    with pretended_card() as waits:
        state, stage = begun(CARD)
        train_step(state, stage)
        waits.clear()
        train_step(state, stage)
        # gsplat's wait of this kind is in its compiled part.
        tiles = {"kernels/cuda/rasterize.py: _entries: _local_scalar_dense": 1} if rasterizer == "cuda" else {}
        surroundings = {
            "kernels/cuda/cull.py: cull: _local_scalar_dense": 2,
            "kernels/cuda/decode.py: _decoded: _local_scalar_dense": 2,
        }
        assert dict(waits) == WAITS | tiles | surroundings


@pytest.mark.parametrize("rasterizer", ["cuda"], indirect=True)
def test_a_pseudo_view_asks_for_its_place_and_its_share_besides(monkeypatch, rasterizer):
    # A fresh model hides nothing, and so shows no place.
    monkeypatch.setattr(training_loop, "pseudo_camera", lambda *given: pseudo_views.pseudo_camera(*given) or given[0])
    monkeypatch.setattr(pseudo_views, "MIN_SHARE", -1.0)
    loss = replace(CONFIG.loss, depth_agreement=0.05, pseudo_views=0.3)
    with pretended_card() as waits:
        state, stage = begun(CARD, loss=loss, iterations=60)
        state.iteration = 20
        train_step(state, stage)
        state.iteration = 24
        waits.clear()
        train_step(state, stage)
    assert dict(waits) == WAITS | {
        "kernels/cuda/rasterize.py: _entries: _local_scalar_dense": 2,
        "kernels/cuda/cull.py: cull: _local_scalar_dense": 4,
        "kernels/cuda/decode.py: _decoded: _local_scalar_dense": 4,
        "training/pseudo_views.py: pseudo_camera: tolist": 1,
        "training/pseudo_views.py: warp_photograph: _local_scalar_dense": 1,
    }


@pytest.mark.parametrize("rasterizer", ["cuda"], indirect=True)
def test_growth_a_new_order_and_the_mean_stay_on_the_device(monkeypatch, rasterizer):
    monkeypatch.setattr(training_loop, "SORT_INTERVAL", 5)
    with pretended_card():
        state = trained_on(CARD, 6, **BUSY)
        devices = {tensor.device.type for group in state.groups().values() for tensor in group.values()}
        devices |= {tensor.device.type for tensor in to_checkpoint(state).tensors.values()}
    assert devices == {"cuda"}
    assert state.model_average is not None
    assert len(state.anchors) != len(few()[0])  # some have come, others have gone


def test_mixed_devices_are_found(monkeypatch, rasterizer):
    """The check can fail: with a background left in main memory, it does."""
    monkeypatch.setattr(training_loop, "background_at", lambda stage, iteration: torch.zeros(3))
    with (
        pretended_card(),
        pytest.raises((RuntimeError, TypeError), match=r"cuda and of shape|a cuda device, not on cpu|is not on cuda"),
    ):
        trained_on(CARD, 1)


def test_cards_take_the_composed_set_and_the_processor_its_own(monkeypatch):
    assert kernels.get_backend(CARD).__name__ == "vdgs.kernels.gpu"
    assert kernels.get_backend(CPU).__name__ == "vdgs.kernels.cpu"
    for name in ("torch_ref", "gpu"):
        monkeypatch.setenv(kernels.KERNELS_ENV_VAR, name)
        assert kernels.get_backend(CPU).__name__ == f"vdgs.kernels.{name}"
