"""The training loop: one for the coarse stage and for blocks; what differs is data (`TrainingProblem`).

Each step is a function of the state and the iteration number, and everything random is drawn from (seed, iteration).
A run that is stopped and continued is therefore the run that was not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.errors import TrainingDiverged
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import DecoderWeights, IsFinite, OrderedSplats, Raster, SplatGradients
from vdgs.kernels.transfer import is_host
from vdgs.model.renderer import cull_anchors, decode_anchors_for_training
from vdgs.model.scale_bounds import MAX_OFFSET_FACTOR
from vdgs.training.densification_step import densify, sort_morton
from vdgs.training.depth_agreement import EVERY as AGREEMENT_EVERY
from vdgs.training.depth_agreement import DepthAgreement, depth_agreement, is_agreement_due
from vdgs.training.exposure_centering import center_exposures, count_exposure
from vdgs.training.gradient_roi import crop_to_gradient_support
from vdgs.training.optimizer import learning_rates_at
from vdgs.training.pseudo_views import is_pseudo_view_due, pseudo_camera, warp_photograph
from vdgs.training.schedule import downscale_at, view_at
from vdgs.training.sky_background import with_sky
from vdgs.training.target import (
    TrainingTarget,
    background_at,
    crop_box,
    crop_camera,
    levels_at,
    make_target,
    opacity_factors_at,
)
from vdgs.training.training_state import StepReport, TrainingProblem, TrainingState
from vdgs.training.training_step import (
    RenderedTrainingView,
    backward_and_step,
    compute_loss,
    render_for_training,
    step_unseen_anchors,
)
from vdgs.training.weight_averaging import ModelAverage, is_averaged_step

#: How much of the value before is kept at each step.
LOSS_DECAY, PSNR_DECAY = 0.98, 0.9


#: Camera height above the ground to which volumes are referred, so that the volume term means the same in any unit.
REFERENCE_HEIGHT = 10.0
#: Every so many iterations anchors are put into Morton order, so that neighbors in space are neighbors in memory.
SORT_INTERVAL = 1000
#: Every so many iterations sizes are clamped to their bounds, and whenever a model is averaged or complete.
BOUND_INTERVAL = 10
#: The stream of random numbers from which pseudo views are drawn.
PSEUDO_STREAM = 77
#: Every so many iterations the PSNR of the training view is computed, for the log.
PSNR_LOG_INTERVAL = 10


def exponential_mean(before: float, value: float, decay: float) -> float:
    """The exponential mean after one more value; NaN before the first."""
    return value if math.isnan(before) else decay * before + (1 - decay) * value


def training_psnr(
    image: Float[Tensor, "h w 3"], target: UInt8[Tensor, "h w 3"], mask: UInt8[Tensor, "h w"] | None
) -> float | None:
    """PSNR of a training view in dB; None where the mask keeps nothing."""
    squared = (image.clamp(0, 1) - target.float() / 255.0) ** 2
    counted = squared if mask is None else squared[mask > 0]
    return -10.0 * math.log10(max(float(counted.mean()), 1e-10)) if counted.numel() else None


def train_step(state: TrainingState, stage: TrainingProblem) -> StepReport:
    """One step: render a training view, compare, move what was visible, count, perhaps grow.

    Changes `state` in place. Raises TrainingDiverged if the loss or a gradient is not finite.
    """
    config, iteration = stage.config, state.iteration
    downscale = downscale_at(iteration, config)
    view = view_at(iteration, stage.num_images, config.seed, stage.view_weights)
    box = crop_box(stage, view, downscale, iteration)
    camera = crop_camera(stage.images.camera(view, downscale), box)

    rows = cull_anchors(levels_at(state.anchors, config.seed, iteration), camera)
    rows = rows if stage.select_rows is None else stage.select_rows(state, rows, camera)
    weights = state.decoder.weights_for_image(image_index_at(stage, view))
    background, with_pseudo_view = background_at(stage, iteration), is_pseudo_view_due(config, iteration)
    with torch.no_grad():
        splats = decode_anchors_for_training(state.anchors, rows, weights, camera)
        factors = opacity_factors_at(stage, iteration, splats)
        if not with_pseudo_view:  # which begins at any place of the box, on any device
            box = crop_to_gradient_support(stage, splats, camera, box, factors)
        target = make_target(stage, view, downscale, box)
        frozen = _frozen_splats(stage, view, camera, target.camera, iteration)
        drawn = render_for_training(
            splats, target.camera, background, frozen, depth=with_pseudo_view or is_agreement_due(config, iteration),
            opacity_factors=factors,
        )  # fmt: skip
    drawn = with_sky(drawn, stage, view, state.decoder, target, background)
    weight = stage.loss_weight
    compared = compute_loss(drawn, target, state.decoder, image_index_at(stage, view), config, weight)
    volume_weight, loss = _volume_weight(stage), compared.loss
    if volume_weight and len(drawn.source):
        loss = loss + volume_weight * drawn.volume
    if (agreement := _weighted_agreement(drawn, stage, iteration, target)) is not None:
        loss = loss + agreement.loss
    values = torch.stack([loss, compared.l1, compared.ssim])
    if is_host(values):  # before anything moves
        _read_values(values, True, iteration)
    gradients = drawn.backward(compared.image, weight * volume_weight, agreement)
    measured = (iteration + 1) % PSNR_LOG_INTERVAL == 0
    psnr = training_psnr(compared.shown, target.image, target.mask) if measured else None
    state.is_consistent = False
    finite = _move(state, stage, rows, gradients, weights, camera)
    _count_exposure(state, stage, view, target, drawn)
    if with_pseudo_view:
        finite = pseudo_step(state, stage, view, target, drawn.raster) & finite

    growing = iteration + 1 <= config.densify.stop_fraction * config.iterations
    if growing and iteration + 1 > config.densify.stats_start:
        _count_view(state, rows, camera, drawn, gradients)
    value, l1, ssim = _read_values(values, finite, iteration)
    state.iteration += 1
    report = StepReport(loss=value, l1=l1, ssim=ssim, visible=len(rows), splats=len(drawn.source))
    if growing and state.iteration >= config.densify.start and state.iteration % config.densify.every == 0:
        report = replace(report, **(stage.grow or densify)(state, stage))
    _sort_bound_and_average(state, config)
    _smooth(state, value, psnr)
    state.is_consistent = True
    return report


def _count_exposure(
    state: TrainingState, stage: TrainingProblem, view: int, target: TrainingTarget, drawn: RenderedTrainingView
) -> None:
    """Count the exposure of a photograph, and after each pass over all of them center the exposures; not after the last
    step, which the colors of the scene could not follow."""
    if (moments := state.exposure_moments) is None or (departures := state.decoder.exposure) is None:
        return
    departure = departures[image_index_at(stage, view)]
    count_exposure(moments, departure, drawn.image, drawn.raster.alpha, target.mask)
    made = state.iteration + 1
    if made % stage.num_images == 0 and made < stage.config.iterations:
        center_exposures(departures.detach(), moments)


def _sort_bound_and_average(state: TrainingState, config: TrainConfig) -> None:
    """What is due after a step, whatever it drew."""
    if state.iteration % SORT_INTERVAL == 0:
        sort_morton(state)
    last, averaged = state.iteration == config.iterations, is_averaged_step(state.iteration, config)
    if state.iteration % BOUND_INTERVAL == 0 or averaged or last:
        _bound_sizes(state)
    if averaged:
        _average(state)


def pseudo_step(
    state: TrainingState, stage: TrainingProblem, view: int, target: TrainingTarget, shown: Raster
) -> IsFinite:
    """Draw a pseudo view near a view that was drawn with depth, compare it with the view's photograph where both show
    the same places, and move what it shows: whether all gradients were finite. Nothing where there are too few such
    places."""
    config, iteration = stage.config, state.iteration
    rng = np.random.default_rng((config.seed, PSEUDO_STREAM, iteration))
    camera = pseudo_camera(target.camera, shown, rng)
    rows = None if camera is None else cull_anchors(levels_at(state.anchors, config.seed, iteration), camera)
    if camera is None or rows is None or not len(rows):
        return True
    rows = rows if stage.select_rows is None else stage.select_rows(state, rows, camera)
    weights = state.decoder.weights_for_image(image_index_at(stage, view))
    with torch.no_grad():
        splats = decode_anchors_for_training(state.anchors, rows, weights, camera)
        frozen = _frozen_splats(stage, view, camera, camera, iteration)
        drawn = render_for_training(splats, camera, background_at(stage, iteration), frozen, depth=True)
    wanted = warp_photograph(target, shown, camera, drawn.raster, stage.camera_height)
    if wanted is None or not len(drawn.source):
        return True
    weight = stage.loss_weight * config.loss.pseudo_views
    compared = compute_loss(drawn, wanted, state.decoder, image_index_at(stage, view), config, weight)
    return _move(state, stage, rows, drawn.backward(compared.image, 0.0), weights, camera)


def _read_values(values: Float[Tensor, "3"], finite: IsFinite, iteration: int) -> tuple[float, float, float]:
    """Loss, L1 and SSIM of a step as numbers. Raises TrainingDiverged where the loss or a gradient is not finite: what
    has no finite gradient has not moved.

    On a GPU to read waits for everything before: once in a step, at its end.
    """
    if isinstance(finite, Tensor):
        values = torch.cat([values, finite.reshape(1).to(values)])
    loss, l1, ssim, *whole = values.tolist()
    if not math.isfinite(loss):
        raise TrainingDiverged(f"The loss is {loss} at iteration {iteration + 1}.")
    if not (all(whole) if isinstance(finite, Tensor) else finite):
        raise TrainingDiverged(f"A gradient is not a finite number at iteration {iteration + 1}.")
    return loss, l1, ssim


def _count_view(
    state: TrainingState, rows: Tensor, camera: Camera, drawn: RenderedTrainingView, gradients: SplatGradients
) -> None:
    """Add a view to the statistics of growth. Seen is what V counts: an anchor whose center lies outside the image is
    not pruned for showing nothing there."""
    positions = state.anchors.positions[rows]
    kernels = get_backend(positions.device)
    kernels.add_view_statistics(
        state.statistics, rows, kernels.mark_visible(positions, camera), drawn.source, drawn.opacities,
        gradients.means_px, *camera.full_size,
    )  # fmt: skip


@torch.no_grad()
def _frozen_splats(
    stage: TrainingProblem, view: int, camera: Camera, part: Camera, iteration: int
) -> OrderedSplats | None:
    """The splats of the frozen anchors around a block in a part of a view, without autograd."""
    frozen = stage.frozen_anchors
    if frozen is None or not len(frozen.anchors):
        return None
    weights = frozen.decoder.weights_for_image(image_index_at(stage, view))
    # Culled by the whole view: an anchor outside the part may have Gaussians in it.
    rows = cull_anchors(levels_at(frozen.anchors, stage.config.seed, iteration), camera)
    return decode_anchors_for_training(frozen.anchors, rows, weights, part)


def image_index_at(stage: TrainingProblem, view: int) -> int:
    """The number of a view among all training images of the capture."""
    return view if stage.image_indices is None else stage.image_indices[view]


def _weighted_agreement(
    drawn: RenderedTrainingView, stage: TrainingProblem, iteration: int, target: TrainingTarget
) -> DepthAgreement | None:
    """The loss of depths, and its gradients scaled to the whole photograph and by the weight of the step, as
    `compute_loss` has them of the image; None where none is due."""
    of_loss = AGREEMENT_EVERY * stage.config.loss.depth_agreement
    weight = AGREEMENT_EVERY * stage.loss_weight * stage.config.loss.depth_agreement * target.valid_fraction
    if not (weight and is_agreement_due(stage.config, iteration) and len(drawn.source)):
        return None
    found = depth_agreement(drawn.raster, stage.camera_height, target.mask)
    return DepthAgreement(of_loss * found.loss, weight * found.alpha, weight * found.depth)


def _volume_weight(stage: TrainingProblem) -> float:
    """Weight of the mean volume in the loss, for the unit of this scene."""
    return stage.config.loss.volume_reg / (stage.camera_height / REFERENCE_HEIGHT) ** 3


def _move(
    state: TrainingState,
    stage: TrainingProblem,
    rows: Tensor,
    gradients: SplatGradients,
    weights: DecoderWeights,
    camera: Camera,
) -> IsFinite:
    """One step of Adam for the visible anchors (where it is dense, for all) and the decoder: whether all gradients were
    finite."""
    config, step = stage.config, state.iteration + 1
    rates = learning_rates_at(config.lr, state.iteration / config.iterations)
    rates["offsets"] *= stage.offset_rate_factor
    states, updates = state.optimizer.anchor_states(state.anchors, rates, config.lr_warm_boost), state.optimizer.updates
    dense = config.optimizer == "adam"
    if dense:
        updates.fill_(state.iteration)
    # Before the anchors move.
    guided = (
        {} if stage.guidance is None else stage.guidance.decoder_gradients(state.anchors, rows, state.decoder, camera)
    )
    finite = backward_and_step(state.anchors, rows, gradients, weights, camera, states, updates, stage.lr_mask)
    for name, gradient in guided.items():
        tensor = state.decoder.tensors()[name]
        tensor.grad = gradient if tensor.grad is None else tensor.grad + gradient
    if dense:
        step_unseen_anchors(state.anchors, rows, states, step, stage.lr_mask)
        updates.fill_(step)
    return state.optimizer.update_decoder(state.decoder, rates, step) & finite


def _average(state: TrainingState) -> None:
    """Add the present model to the mean."""
    if state.model_average is not None:
        state.model_average.add(state.anchors, state.decoder)
    else:
        state.model_average = ModelAverage.of(state.anchors, state.decoder)


@torch.no_grad()
def _bound_sizes(state: TrainingState) -> None:
    """Clamp the scales of Gaussians (the decoder only makes them smaller) and the unit of their offsets."""
    offsets, sizes = state.anchors.log_scales[:, :3], state.anchors.log_scales[:, 3:]
    torch.minimum(sizes, state.max_log_scale[:, None], out=sizes)
    torch.minimum(offsets, state.max_log_scale[:, None] + math.log(MAX_OFFSET_FACTOR), out=offsets)


def _smooth(state: TrainingState, loss: float, psnr: float | None) -> None:
    """Update the smoothed loss and PSNR. Raises TrainingDiverged where the loss rose far above its minimum."""
    state.loss = exponential_mean(state.loss, loss, LOSS_DECAY)
    if psnr is not None:
        state.psnr = exponential_mean(state.psnr, psnr, PSNR_DECAY)
    if state.iteration > 100:
        state.best_loss = min(state.best_loss, state.loss)
        if state.loss > 0.3 and state.loss > 4 * state.best_loss:
            raise TrainingDiverged(
                f"The smoothed loss rose to {state.loss:.3f} from {state.best_loss:.3f} by iteration {state.iteration}."
            )


def train(
    state: TrainingState,
    stage: TrainingProblem,
    *,
    stop: Callable[[], bool],
    after_step: Callable[[TrainingState, StepReport], None],
    prefetch: int = 4,
) -> bool:
    """Step until the stage is complete (True) or `stop()` is true; `after_step` is called after every step."""
    config = stage.config
    while state.iteration < config.iterations:
        if stop():
            return False
        ahead = range(state.iteration + 1, min(state.iteration + 1 + prefetch, config.iterations))
        for iteration in ahead:
            view = view_at(iteration, stage.num_images, config.seed, stage.view_weights)
            stage.images.prefetch([view], downscale_at(iteration, config))
        after_step(state, train_step(state, stage))
    return True
