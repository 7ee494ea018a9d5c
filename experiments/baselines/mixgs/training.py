"""Mixed training of MixGS (its section 3.4): first the decoder alone, then it and the coarse Gaussians together.

The state is that of 3DGS; what MixGS trains besides lies in its `extra`: offsets, network, and their moments.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.baselines.gs3d.training import (
    Gs3dProblem,
    Gs3dState,
    Gs3dStepReport,
    initial_state,
    photograph,
)
from experiments.baselines.mixgs.model import MixScene, initial_network, mix_scene, render_mixed
from experiments.baselines.mixgs.settings import MixConfig
from vdgs.errors import TrainingDiverged
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState, IsFinite
from vdgs.model.gaussians import Gaussians, visible_gaussian_rows
from vdgs.training import PSNR_LOG_INTERVAL, view_at
from vdgs.training.training_loop import LOSS_DECAY, PSNR_DECAY, exponential_mean, training_psnr

NETWORK, FIRST, SECOND = "network.", "first.", "second."


@dataclass(frozen=True)
class MixProblem:
    """What mixed training works on. `base.config` has its iterations and seed."""

    base: Gs3dProblem
    config: MixConfig
    scene: MixScene


def mixed_state(coarse: Gaussians, config: MixConfig) -> tuple[Gs3dState, MixScene]:
    """The state before the first mixed step: the coarse Gaussians that are opaque enough, a fresh network."""
    kept = coarse.select(coarse.opacity_logits.sigmoid() > config.min_opacity)
    state = initial_state(kept)
    trained = {"offsets": torch.zeros(len(kept), 3)}
    trained |= {NETWORK + name: tensor for name, tensor in initial_network(len(kept), config).items()}
    moments = {prefix + name: torch.zeros_like(t) for prefix in (FIRST, SECOND) for name, t in trained.items()}
    state.extra = trained | moments
    return state, mix_scene(kept, config)


def network_of(state: Gs3dState) -> dict[str, Tensor]:
    return {name.removeprefix(NETWORK): t for name, t in state.extra.items() if name.startswith(NETWORK)}


def mixed_rates(problem: MixProblem, iteration: int) -> dict[str, float]:
    """Learning rate of each tensor of the Gaussians, of offsets, tables and decoder at this iteration (from 0)."""
    config, progress = problem.config, iteration / problem.config.iterations
    decayed = lambda pair: pair[0] * (pair[1] / pair[0]) ** progress  # noqa: E731
    rates = {name: getattr(config.rates, name) for name in Gaussians.__dataclass_fields__}
    return rates | {
        "means": problem.base.extent * decayed(config.rates.means),
        "offsets": problem.base.extent * config.rates.means[0],
        "table": decayed(config.table_rate),
        "decoder": decayed(config.decoder_rate),
    }


def mixed_step(state: Gs3dState, problem: MixProblem) -> Gs3dStepReport:
    """One step: render a training view, compare, move what is trained. Changes `state` in place.

    Raises TrainingDiverged if the loss or a gradient is not finite.
    """
    base, iteration = problem.base, state.iteration
    view = view_at(iteration, base.image_count, base.config.seed)
    target, mask = photograph(base, view, 1, state.gaussians.means.device)
    camera = base.images.camera(view, 1)
    joint = iteration >= problem.config.frozen_iterations
    rows = visible_gaussian_rows(state.gaussians, camera)
    seen = {name: t.index_select(0, rows).requires_grad_(joint) for name, t in state.gaussians.tensors().items()}
    offsets = state.extra["offsets"].index_select(0, rows).requires_grad_()
    network = {name: tensor.detach().requires_grad_() for name, tensor in network_of(state).items()}
    behind = state.gaussians.means.new_tensor(base.background)
    raster = render_mixed(Gaussians(**seen), offsets, network, problem.scene, camera, behind)
    compared = get_backend(raster.image.device).photometric_loss(
        raster.image, target, mask, ssim_weight=base.config.ssim_weight
    )
    value = float(compared.loss.detach())
    if not math.isfinite(value):
        raise TrainingDiverged(f"The loss is {value} at iteration {iteration + 1}.")
    wanted = {"offsets": offsets} | (seen if joint else {})
    found = torch.autograd.grad(compared.loss, [*network.values(), *wanted.values()], materialize_grads=True)
    psnr = training_psnr(raster.image.detach(), target, mask) if (iteration + 1) % PSNR_LOG_INTERVAL == 0 else None
    state.is_consistent = False
    _move(state, problem, rows, dict(zip(network, found, strict=False)),
          dict(zip(wanted, found[len(network) :], strict=True)))  # fmt: skip
    state.iteration += 1
    state.loss = exponential_mean(state.loss, value, LOSS_DECAY)
    state.psnr = state.psnr if psnr is None else exponential_mean(state.psnr, psnr, PSNR_DECAY)
    state.is_consistent = True
    return Gs3dStepReport(value, float(compared.l1), float(compared.ssim), len(rows))


def _move(
    state: Gs3dState, problem: MixProblem, rows: Tensor, of_network: dict[str, Tensor], of_rows: dict[str, Tensor]
) -> None:
    """One step of dense Adam for the network, the offsets and, where they have gradients, the Gaussians."""
    rates, extra, finite = mixed_rates(problem, state.iteration), state.extra, True
    gaussians = state.gaussians.tensors()
    frozen = problem.config.frozen_iterations

    def step(moved: AdamState, gradient: Tensor, count: int) -> IsFinite:
        return get_backend(gradient.device).adam_rows(moved, None, gradient.contiguous(), count)

    for name, gradient in of_network.items():
        rate = rates["table"] if name == "table" else rates["decoder"]
        key = NETWORK + name
        moved = AdamState(extra[key].detach(), extra[FIRST + key], extra[SECOND + key], rate)
        finite = bool(step(moved, gradient, state.iteration + 1)) and finite
    for name, gradient in of_rows.items():
        own = gaussians.get(name)
        tensor = extra["offsets"] if own is None else own
        first, second = (
            (extra[FIRST + name], extra[SECOND + name]) if own is None
            else (state.moments.first[name], state.moments.second[name])
        )  # fmt: skip
        everywhere = torch.zeros_like(tensor).index_copy_(0, rows, gradient)
        count = state.iteration + 1 - (0 if own is None else frozen)
        finite = bool(step(AdamState(tensor, first, second, rates[name]), everywhere, count)) and finite
    if not finite:
        raise TrainingDiverged(f"A gradient is not a finite number at iteration {state.iteration + 1}.")


def train_mixed(
    state: Gs3dState, problem: MixProblem, *, stop: Callable[[], bool], after_step: Callable[..., None]
) -> bool:
    """Steps until the last iteration or until `stop()` is true. True if complete."""
    while state.iteration < problem.config.iterations:
        if stop():
            return False
        report = mixed_step(state, problem)
        after_step(state, report)
    return True
