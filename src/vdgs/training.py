"""The training loop: one for the coarse stage and for blocks; what differs is data.

State is explicit (`TrainingState`), each step is a function of the state and the iteration number, and everything
random is drawn from (seed, iteration). A run that is stopped and continued is therefore the run that was not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from vdgs.anchors import Anchors
from vdgs.cameras import Camera
from vdgs.checkpoints import SavedState
from vdgs.compensation import Compensation, begin_cycle, compensate, cycle_facts, low_visibility, update_cache
from vdgs.config import TrainConfig
from vdgs.decoder import Decoder
from vdgs.errors import TrainingDiverged
from vdgs.growth import Compensated, Statistics, decide
from vdgs.kernels import native as kernels
from vdgs.kernels.decode_types import DecoderWeights, SplatGradients, Splats
from vdgs.memory import return_unused
from vdgs.optimiser import Moments, Optimiser, rates_at, rebuild
from vdgs.render import decode_rows, visible_rows
from vdgs.step import draw_view, move_anchors
from vdgs.visibility import share_in_cycle

#: Camera height above the ground to which volumes are referred, so that the volume term means the same in any unit.
REFERENCE_HEIGHT = 10.0
#: Every so many iterations anchors are put into Morton order, so that neighbours in space are neighbours in memory.
REORDER_INTERVAL = 1000
#: Every so many iterations the PSNR of the training view is taken, for people.
PSNR_INTERVAL = 10


@runtime_checkable
class TrainingImages(Protocol):
    """Photographs on demand. Index i is the i-th training view."""

    def get(self, index: int, downscale: int = 1) -> tuple[Tensor, Tensor | None]: ...
    def camera(self, index: int, downscale: int = 1) -> Camera: ...
    def prefetch(self, indices: Sequence[int], downscale: int = 1) -> None: ...


@dataclass
class TrainingState:
    """All that changes during training. `iteration` steps have been made."""

    iteration: int
    anchors: Anchors
    decoder: Decoder
    statistics: Statistics
    optimiser: Optimiser
    #: Remembered gradients of compensated growth; None where growth is plain.
    compensation: Compensation | None = None
    #: Smoothed loss, the smallest it has been, smoothed PSNR of training views.
    loss: float = math.nan
    best_loss: float = math.inf
    psnr: float = math.nan
    #: Time spent and largest memory used so far, over all processes that worked on this state.
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    #: False while a step changes tensors: one that is broken off there leaves no state that may be saved.
    whole: bool = True


@dataclass(frozen=True)
class Stage:
    """What training works on: the same for all iterations."""

    config: TrainConfig
    images: TrainingImages
    image_count: int
    voxel: float
    #: Median height of the cameras above the ground, in units of the ground frame.
    camera_height: float
    #: Colour behind the scene.
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: A block leaves the decoder as it is.
    frozen_decoder: bool = False
    #: Anchors that are drawn and never move: ring and context of a block.
    surroundings: Anchors | None = None
    #: Which places [p, 3] may get new anchors; None: all.
    may_hold: Callable[[Tensor], Tensor] | None = None
    #: How far the anchors at places [p, 3] move, from 0 to 1 of a full step; None: all of it.
    mobility: Callable[[Tensor], Tensor] | None = None
    #: Which training image of the whole capture each view is (for its appearance); None: the same number.
    appearance_of: Sequence[int] | None = None


@dataclass(frozen=True)
class StepReport:
    """What one step did, for the log."""

    loss: float
    l1: float
    ssim: float
    visible: int
    splats: int
    grown: int | None = None
    pruned: int | None = None
    #: What a growth decision saw and did.
    cycle: dict[str, Any] = field(default_factory=dict)


def start_state(anchors: Anchors, decoder: Decoder, stage: Stage) -> TrainingState:
    """A state before the first step. The anchors' tensors are moved in place: give copies of what must stay."""
    n, k = len(anchors), anchors.offsets.shape[1]
    for tensor in decoder.tensors().values():
        tensor.requires_grad_(not stage.frozen_decoder)
    compensation = Compensation.zeros(n, k) if stage.config.compensation.enabled else None
    optimiser = Optimiser.start(anchors, decoder)
    return TrainingState(0, anchors, decoder, Statistics.zeros(n, k), optimiser, compensation)


def view_at(iteration: int, count: int, seed: int) -> int:
    """Which training view iteration (from 0) uses: a fresh permutation of all views every `count` iterations."""
    epoch, place = divmod(iteration, count)
    return int(_permutation(epoch, count, seed)[place])


@lru_cache(maxsize=4)
def _permutation(epoch: int, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def downscale_at(iteration: int, config: TrainConfig) -> int:
    """Factor by which images are shrunk at this iteration (from 0)."""
    share = iteration / config.iterations
    return [factor for start, factor in config.resolutions if share >= start][-1]


def train_step(state: TrainingState, stage: Stage) -> StepReport:
    """One step: render a training view, compare, move what was visible, count, perhaps grow.

    Changes `state` in place. Raises TrainingDiverged if the loss or a gradient is not finite.
    """
    config, iteration = stage.config, state.iteration
    downscale = downscale_at(iteration, config)
    view = view_at(iteration, stage.image_count, config.seed)
    target, mask = stage.images.get(view, downscale)
    camera = stage.images.camera(view, downscale)

    rows = visible_rows(state.anchors, camera)
    weights = state.decoder.for_image(view if stage.appearance_of is None else stage.appearance_of[view])
    around = _surroundings(stage, weights, camera)
    with torch.no_grad():
        drawn = draw_view(
            decode_rows(state.anchors, rows, weights, camera), camera, _background(stage, iteration), around
        )
    image = drawn.image.requires_grad_(True)
    photometric = kernels.photometric_loss(image, target, mask, ssim_weight=config.loss.ssim_weight)
    volume_weight = _volume_weight(stage)
    loss = photometric.loss.detach()
    if volume_weight and len(drawn.source):
        loss = loss + volume_weight * drawn.volume
    value = float(loss)
    if not math.isfinite(value):
        raise TrainingDiverged(f"The loss is {value} at iteration {iteration + 1}.")
    (image_gradient,) = torch.autograd.grad(photometric.loss, image)
    gradients = drawn.backward(image_gradient, volume_weight)
    psnr = _psnr(image.detach(), target, mask) if (iteration + 1) % PSNR_INTERVAL == 0 else None
    state.whole = False
    _move(state, stage, rows, gradients, weights, camera)

    growing = iteration + 1 <= config.growth.until * config.iterations
    if growing and iteration + 1 > config.growth.statistics_from:
        state.statistics.add_view(rows, drawn.source, drawn.opacities, gradients.means_px, camera.width, camera.height)
    state.iteration += 1
    report = StepReport(value, float(photometric.l1), float(photometric.ssim), len(rows), len(drawn.source))
    if growing and state.iteration >= config.growth.start and state.iteration % config.growth.interval == 0:
        report = replace(report, **grow(state, stage))
    if state.iteration % REORDER_INTERVAL == 0:
        reorder(state)
    _smooth(state, value, psnr)
    state.whole = True
    return report


@torch.no_grad()
def _surroundings(stage: Stage, weights: DecoderWeights, camera: Camera) -> Splats | None:
    """The splats of the frozen anchors around a block: drawn, but out of autograd's sight."""
    if stage.surroundings is None or not len(stage.surroundings):
        return None
    return decode_rows(stage.surroundings, visible_rows(stage.surroundings, camera), weights, camera)


def _volume_weight(stage: Stage) -> float:
    """Weight of the mean volume in the loss, for the unit of this scene."""
    return stage.config.loss.volume_weight / (stage.camera_height / REFERENCE_HEIGHT) ** 3


def _move(
    state: TrainingState, stage: Stage, rows: Tensor, gradients: SplatGradients, weights: DecoderWeights, camera: Camera
) -> None:
    """One step of Adam for the visible anchors and the decoder."""
    config, step = stage.config, state.iteration + 1
    rates = rates_at(config.rates, state.iteration / config.iterations)
    finite = move_anchors(state.anchors, rows, gradients, weights, camera, state.optimiser, rates, step, stage.mobility)
    finite &= state.optimiser.update_decoder(state.decoder, rates, step)
    if not finite:
        raise TrainingDiverged(f"A gradient is not a finite number at iteration {step}.")


def grow(state: TrainingState, stage: Stage) -> dict[str, Any]:
    """Add and remove anchors with their moments and statistics. Returns what StepReport says of it."""
    config = stage.config
    return_unused()
    generator = torch.Generator().manual_seed(config.seed * 1_000_003 + state.iteration)
    compensated, threshold = _compensate(state, stage)
    decision = decide(
        state.anchors, state.statistics, stage.voxel, config.growth, generator,
        compensated=compensated,
        surroundings=None if stage.surroundings is None else stage.surroundings.positions,
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


def views_in_cycle(iteration: int, stage: Stage) -> list[int]:
    """The views, each once, that were used in the growth cycle which ends after `iteration` steps.

    A cycle lasts from one growth decision to the next; the first one starts with the statistics.
    """
    growth = stage.config.growth
    begin = iteration - growth.interval
    if begin < growth.start:  # no decision was made before
        begin = growth.statistics_from
    used = range(max(min(begin, iteration - 1), 0), iteration)
    return sorted({view_at(each, stage.image_count, stage.config.seed) for each in used})


def reorder(state: TrainingState) -> None:
    """Put anchors, moments and statistics into Morton order."""
    order = kernels.morton_order(state.anchors.positions)
    if state.compensation is not None:
        state.compensation = state.compensation.select(order)
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


def _background(stage: Stage, iteration: int) -> Tensor:
    colour = torch.tensor(stage.background)
    noise = stage.config.loss.background_noise * (1 - iteration / stage.config.iterations)
    if noise == 0:
        return colour
    generator = torch.Generator().manual_seed(stage.config.seed * 1_000_033 + iteration)
    return colour + noise * (2 * torch.rand(3, generator=generator) - 1)


def mean_colour(images: TrainingImages, count: int, downscale: int, at_most: int = 32) -> tuple[float, float, float]:
    """Mean colour in [0, 1] of the pixels that count, over up to `at_most` evenly chosen training views."""
    total, pixels = np.zeros(3), 0
    for index in np.unique(np.linspace(0, count - 1, min(count, at_most)).astype(int)):
        image, mask = images.get(int(index), downscale)
        colours = image.numpy().reshape(-1, 3) if mask is None else image.numpy()[mask.numpy() > 0]
        total += colours.sum(0, dtype=np.float64)
        pixels += len(colours)
    red, green, blue = (float(np.float32(value)) for value in total / (255.0 * max(pixels, 1)))
    return red, green, blue


def _psnr(image: Tensor, target: Tensor, mask: Tensor | None) -> float | None:
    """PSNR of a training view; None where the mask keeps nothing."""
    squared = (image.clamp(0, 1) - target.float() / 255.0) ** 2
    counted = squared if mask is None else squared[mask > 0]
    return -10.0 * math.log10(max(float(counted.mean()), 1e-10)) if counted.numel() else None


def _smooth(state: TrainingState, loss: float, psnr: float | None) -> None:
    """Update the smoothed loss and, where it was taken, PSNR (for people and for the divergence check)."""
    state.loss = _moving(state.loss, loss, 0.98)
    if psnr is not None:
        state.psnr = _moving(state.psnr, psnr, 0.9)
    if state.iteration > 100:
        state.best_loss = min(state.best_loss, state.loss)
        if state.loss > 0.3 and state.loss > 4 * state.best_loss:
            raise TrainingDiverged(
                f"The smoothed loss rose to {state.loss:.3f} from {state.best_loss:.3f} by iteration {state.iteration}."
            )


def _moving(before: float, value: float, keep: float) -> float:
    return value if math.isnan(before) else keep * before + (1 - keep) * value


def train(
    state: TrainingState,
    stage: Stage,
    *,
    stop: Callable[[], bool],
    after_step: Callable[[TrainingState, StepReport], None],
    prefetch: int = 4,
) -> bool:
    """Steps until the stage is complete or `stop()` is true. True if complete.

    `after_step` sees every step (progress, log, saving).
    """
    config = stage.config
    while state.iteration < config.iterations:
        if stop():
            return False
        ahead = range(state.iteration + 1, min(state.iteration + 1 + prefetch, config.iterations))
        for iteration in ahead:
            view = view_at(iteration, stage.image_count, config.seed)
            stage.images.prefetch([view], downscale_at(iteration, config))
        report = train_step(state, stage)
        after_step(state, report)
    return True


def to_saved(state: TrainingState) -> SavedState:
    """The whole state as tensors and facts."""
    tensors = {f"anchors.{k}": v for k, v in state.anchors.tensors().items()}
    tensors |= {f"decoder.{k}": v.detach() for k, v in state.decoder.tensors().items()}
    tensors |= {f"statistics.{k}": v for k, v in state.statistics.tensors().items()}
    for group, moments in (("anchors", state.optimiser.anchors), ("decoder", state.optimiser.decoder)):
        tensors |= {f"first.{group}.{k}": v for k, v in moments.first.items()}
        tensors |= {f"second.{group}.{k}": v for k, v in moments.second.items()}
    if state.compensation is not None:
        tensors |= {f"compensation.{k}": v for k, v in state.compensation.tensors().items()}
    facts = {"loss": repr(state.loss), "best_loss": repr(state.best_loss), "psnr": repr(state.psnr),
             "seconds": state.seconds, "peak_memory_bytes": state.peak_memory_bytes}  # fmt: skip
    return SavedState(state.iteration, facts, tensors)


def from_saved(saved: SavedState, stage: Stage) -> TrainingState:
    """The inverse of `to_saved`, bit for bit. Raises KeyError if a tensor is missing."""

    def part(prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in saved.tensors.items() if k.startswith(prefix)}

    anchors = Anchors(**part("anchors."))
    decoder = Decoder.from_tensors(part("decoder."))
    state = start_state(anchors, decoder, stage)
    state.statistics = Statistics(**part("statistics."))
    state.optimiser = Optimiser(
        Moments(part("first.anchors."), part("second.anchors.")),
        Moments(part("first.decoder."), part("second.decoder.")),
    )
    if state.compensation is not None:
        state.compensation = Compensation(**part("compensation."))
    state.iteration = saved.iteration
    state.loss, state.best_loss = float(saved.facts["loss"]), float(saved.facts["best_loss"])
    state.psnr, state.seconds = float(saved.facts["psnr"]), float(saved.facts["seconds"])
    state.peak_memory_bytes = int(saved.facts["peak_memory_bytes"])
    return state
