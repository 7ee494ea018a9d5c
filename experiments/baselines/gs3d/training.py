"""The training loop of 3DGS. As in `vdgs.training`, state is explicit and everything random is drawn from (seed,
iteration): a run that is stopped and continued is the run that was not, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from experiments.baselines.gs3d.density import DensityConfig, adaptive_density_control, cap_opacity_logits
from vdgs.errors import TrainingDiverged
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState, IsFinite, PhotometricLoss
from vdgs.kernels.transfer import upload
from vdgs.model.gaussians import Gaussians, render_gaussians, visible_gaussian_rows
from vdgs.system.checkpoints import Checkpoint
from vdgs.training import PSNR_LOG_INTERVAL, TrainingImages, view_at
from vdgs.training.optimizer import AdamMoments
from vdgs.training.per_anchor_tensors import TensorGroup, index_anchors, without_rows
from vdgs.training.training_loop import LOSS_DECAY, PSNR_DECAY, exponential_mean, training_psnr


@dataclass(frozen=True)
class Gs3dLearningRates:
    """Learning rates of Adam (values: the authors' program; section 5.1 of 3DGS names the schedule)."""

    means: tuple[float, float] = (1.6e-4, 1.6e-6)
    """Means, times the extent of the scene; decays exponentially from the first to the second value (section 5.1)."""
    sh0: float = 0.0025
    """Constant color."""
    shN: float = 0.0025 / 20
    """The other coefficients of color."""
    opacity_logits: float = 0.05
    """Opacities before the sigmoid."""
    log_scales: float = 0.005
    """Logarithms of the scales."""
    quaternions: float = 0.001
    """Rotations."""


@dataclass(frozen=True)
class Gs3dConfig:
    """3DGS (Kerbl et al. 2023). Sections are those of its paper; "program": the authors' published program."""

    iterations: int = 30_000
    """Number of steps, one photograph each (section 7.1)."""
    seed: int = 0
    """Everything random follows from it: on the CPU the same seed gives the same bits."""
    resolution_schedule: tuple[tuple[int, int], ...] = ((0, 4), (250, 2), (500, 1))
    """From this iteration on, images are shrunk by this factor (section 7.1, "warm-up")."""
    degree: int = 3
    """Degree of the spherical harmonics (section 7.1: four bands)."""
    degree_interval: int = 1000
    """The degree starts at 0 and rises by one after so many iterations (section 7.1)."""
    initial_opacity: float = 0.1
    """Opacity of the Gaussians at the start (program)."""
    ssim_weight: float = 0.2
    """lambda: loss = (1 - lambda) L1 + lambda (1 - SSIM) (eq. 7)."""
    background: Literal["black", "mean"] = "black"
    """Color behind the scene (program: black). `mean` is that of the training photographs, as this project's own
    method has it: to tell what the method gains from what its background does (choice)."""
    rates: Gs3dLearningRates = field(default_factory=Gs3dLearningRates)
    """Learning rates."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Where Gaussians are added and removed."""


@runtime_checkable
class ImageLoss(Protocol):
    """Another loss than that of 3DGS, which may train tensors of its own: those of `Gs3dState.extra`."""

    def __call__(
        self, image: Tensor, target: Tensor, mask: Tensor | None, view: int, extra: Mapping[str, Tensor]
    ) -> PhotometricLoss: ...

    def trained(self, extra: Mapping[str, Tensor]) -> list[Tensor]:
        """The tensors of `extra` that the loss differentiates by."""
        ...

    def move(self, extra: Mapping[str, Tensor], gradients: Sequence[Tensor], step: int) -> None:
        """One step of these, in place; `step` counts from 1."""
        ...


@dataclass(frozen=True)
class Gs3dProblem:
    """What training works on: the same for all iterations."""

    config: Gs3dConfig
    images: TrainingImages
    image_count: int
    #: Size of the scene in units of the ground frame (`scene_extent`).
    extent: float
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _: KW_ONLY
    #: Gaussians that were trained before use their colors in all directions at once.
    full_degree: bool = False
    #: In place of the loss of 3DGS (eq. 7).
    image_loss: ImageLoss | None = None
    #: What else pulls at the Gaussians: gradients of all of them by the names of tensors, added to those of the loss.
    pull: Callable[[Gaussians], Mapping[str, Tensor]] | None = None
    #: What else the loss of a view holds, by the Gaussians that it shows, its camera and the iteration (from 0).
    surface_loss: Callable[[Gaussians, Camera, int], Tensor] | None = None
    #: Keeps the Gaussians as they have to be, in place, after each step.
    constrain: Callable[[Gaussians], None] | None = None
    #: Training ends after so many iterations, where it ends before its schedule does.
    last: int | None = None

    @property
    def end(self) -> int:
        """So many iterations are made."""
        return self.config.iterations if self.last is None else self.last

    def sh_degree_at(self, iteration: int) -> int:
        """Degree of the spherical harmonics at this iteration (from 0)."""
        return self.config.degree if self.full_degree else sh_degree_at(iteration, self.config)


@dataclass
class Gs3dState:
    """All that changes during training. `iteration` steps have been made."""

    iteration: int
    gaussians: Gaussians
    moments: AdamMoments
    #: Since the last decision: sum of the norms of dL/d(mean) in NDC, and in how many views each was visible, [n].
    gradient: Tensor
    views: Tensor
    #: Smoothed loss and PSNR of training views.
    loss: float = math.nan
    psnr: float = math.nan
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    #: False while a step changes tensors: one that is broken off there leaves no state that may be saved.
    is_consistent: bool = True
    #: Zeros between steps, in the shape of each tensor of the Gaussians: where gradients are put. Not saved.
    scratch: dict[str, Tensor] = field(default_factory=dict)
    #: What an `ImageLoss` trains besides.
    extra: dict[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device | str) -> Gs3dState:
        """The same state on a device: photographs come to where it is."""

        def there(group: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: tensor.to(device) for name, tensor in group.items()}

        moments = AdamMoments(there(self.moments.first), there(self.moments.second))
        return replace(
            self, gaussians=self.gaussians.to(device), moments=moments, gradient=self.gradient.to(device),
            views=self.views.to(device), scratch={}, extra=there(self.extra),
        )  # fmt: skip

    def take_groups(self) -> dict[str, TensorGroup]:
        """What is kept per Gaussian and outlives a decision, no longer held here: see
        `per_anchor_tensors.index_anchors`."""
        groups = {"gaussians": self.gaussians.tensors(), "first": self.moments.first, "second": self.moments.second}
        self.put_groups(without_rows(groups))
        return groups

    def put_groups(self, groups: dict[str, TensorGroup]) -> None:
        """The inverse of `take_groups`."""
        self.gaussians = Gaussians(**groups["gaussians"])
        self.moments = AdamMoments(groups["first"], groups["second"])


@dataclass(frozen=True)
class Gs3dStepReport:
    """What one step did, for the log."""

    loss: float
    l1: float
    ssim: float
    visible: int
    cloned: int | None = None
    split: int | None = None
    pruned: int | None = None


def scene_extent(cameras: list[Camera]) -> float:
    """Radius of the cameras about their mean, times 1.1 (program); at least a tiny number."""
    centers = np.array([camera.position for camera in cameras])
    return max(1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()), 1e-6)


def initial_state(gaussians: Gaussians) -> Gs3dState:
    """A state before the first step. The tensors are moved in place: give copies of what must stay."""
    zeros = torch.zeros_like(gaussians.opacity_logits)
    return Gs3dState(0, gaussians, AdamMoments.zeros(gaussians.tensors()), zeros, zeros.clone())


def sh_degree_at(iteration: int, config: Gs3dConfig) -> int:
    """Degree of the spherical harmonics at this iteration (from 0)."""
    return min(iteration // config.degree_interval, config.degree)


def downscale_at(iteration: int, config: Gs3dConfig) -> int:
    """Factor by which images are shrunk at this iteration (from 0)."""
    return [factor for start, factor in config.resolution_schedule if iteration >= start][-1]


def learning_rates_at(config: Gs3dConfig, extent: float, iteration: int) -> dict[str, float]:
    """Learning rate of each tensor of `Gaussians` at this iteration (from 0)."""
    first, last = config.rates.means
    means = extent * first * (last / first) ** (iteration / config.iterations)
    return {name: getattr(config.rates, name) for name in Gaussians.__dataclass_fields__} | {"means": means}


def gs3d_train_step(state: Gs3dState, stage: Gs3dProblem) -> Gs3dStepReport:
    """One step: render a training view, compare, move all Gaussians, count, perhaps clone, split and prune.

    Changes `state` in place. Raises TrainingDiverged if the loss or a gradient is not finite.
    """
    config, iteration = stage.config, state.iteration
    downscale, degree = downscale_at(iteration, config), stage.sh_degree_at(iteration)
    view = view_at(iteration, stage.image_count, config.seed)
    target, mask = photograph(stage, view, downscale, state.gaussians.means.device)
    camera = stage.images.camera(view, downscale)

    rows = visible_gaussian_rows(state.gaussians, camera)
    seen = {name: t.index_select(0, rows).requires_grad_() for name, t in state.gaussians.tensors().items()}
    behind = state.gaussians.means.new_tensor(stage.background)
    raster, means_px = render_gaussians(Gaussians(**seen), camera, behind, degree)
    photometric, fitted = _compare(state, stage, raster.image, target, mask, view)
    loss = photometric.loss
    if stage.surface_loss is not None:
        loss = loss + stage.surface_loss(Gaussians(**seen), camera, iteration)
    value = float(loss.detach())
    if not math.isfinite(value):
        raise TrainingDiverged(f"The loss is {value} at iteration {iteration + 1}.")
    of_means_px, *gradients = torch.autograd.grad(loss, [means_px, *seen.values(), *fitted], materialize_grads=True)
    psnr = training_psnr(raster.image.detach(), target, mask) if (iteration + 1) % PSNR_LOG_INTERVAL == 0 else None
    pulled = {} if stage.pull is None else stage.pull(state.gaussians)
    _allocate_gradients(state)
    state.is_consistent = False
    of_seen, rates = dict(zip(seen, gradients, strict=False)), learning_rates_at(config, stage.extent, iteration)
    _adam_step(state, rows, of_seen, pulled, rates, degree)
    if stage.image_loss is not None:
        stage.image_loss.move(state.extra, gradients[len(seen) :], iteration + 1)
    if stage.constrain is not None:
        stage.constrain(state.gaussians)
    state.iteration += 1

    report = Gs3dStepReport(value, float(photometric.l1), float(photometric.ssim), len(rows))
    if state.iteration < config.density.until * config.iterations:  # not at the end itself (program)
        _accumulate_gradients(state, rows, of_means_px, camera)
        report = replace(report, **_densify(state, stage))
    _smooth(state, value, psnr)
    state.is_consistent = True
    return report


def photograph(stage: Gs3dProblem, view: int, downscale: int, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """A training view and its mask, on a device."""
    image, mask = stage.images.get(view, downscale)
    return upload(image, device), None if mask is None else upload(mask, device)


def _compare(
    state: Gs3dState, stage: Gs3dProblem, image: Tensor, target: Tensor, mask: Tensor | None, view: int
) -> tuple[PhotometricLoss, list[Tensor]]:
    """The loss of a view, and what else it differentiates by."""
    if stage.image_loss is not None:
        fitted = [tensor.requires_grad_() for tensor in stage.image_loss.trained(state.extra)]
        return stage.image_loss(image, target, mask, view, state.extra), fitted
    return get_backend(image.device).photometric_loss(image, target, mask, ssim_weight=stage.config.ssim_weight), []


def _allocate_gradients(state: Gs3dState) -> None:
    """Room for gradients, where growth has taken it away: before anything moves, since it is large."""
    for name, tensor in state.gaussians.tensors().items():
        if name not in state.scratch:
            state.scratch[name] = torch.zeros_like(tensor)


def _adam_step(
    state: Gs3dState,
    rows: Int64[Tensor, " v"],
    gradients: Mapping[str, Tensor],
    pulled: Mapping[str, Tensor],
    rates: Mapping[str, float],
    degree: int,
) -> None:
    """One step of Adam for all Gaussians: those that the view does not show move on by their moments (program), and by
    what pulls at them."""
    finite: IsFinite = True
    for name, tensor in state.gaussians.tensors().items():
        if name == "shN" and not degree:
            continue  # gradients and moments are zero: nothing moves
        everywhere = state.scratch[name].index_copy_(0, rows, gradients[name])
        if name in pulled:
            everywhere.add_(pulled[name])
        moved = AdamState(tensor, state.moments.first[name], state.moments.second[name], rates[name])
        finite = get_backend(tensor.device).adam_rows(moved, None, everywhere, state.iteration + 1) & finite
        if name in pulled:
            everywhere.zero_()
        everywhere.index_fill_(0, rows, 0.0)
    if not finite:
        raise TrainingDiverged(f"A gradient is not a finite number at iteration {state.iteration + 1}.")


def _accumulate_gradients(
    state: Gs3dState, rows: Int64[Tensor, " v"], of_px: Float[Tensor, "v 2"], camera: Camera
) -> None:
    """Add the norms of the gradients of the means, in NDC: these run over [-1, 1] across the image."""
    state.gradient[rows] += torch.hypot(of_px[:, 0] * (camera.width / 2), of_px[:, 1] * (camera.height / 2))
    state.views[rows] += 1


def _densify(state: Gs3dState, stage: Gs3dProblem) -> dict[str, Any]:
    """Clone, split and prune, and reset opacities, where it is time. Returns what Gs3dStepReport says of it."""
    config, done = stage.config.density, state.iteration
    counts: dict[str, Any] = {}
    if done > config.start and done % config.interval == 0:
        generator = torch.Generator().manual_seed(stage.config.seed * 1_000_003 + done)
        change = adaptive_density_control(
            state.gaussians, state.gradient / state.views.clamp(min=1), stage.extent, config, generator,
            prune_large=done > config.reset_interval,
        )  # fmt: skip
        _apply(state, change.added, change.kept)
        counts = {"cloned": change.cloned, "split": change.split, "pruned": change.pruned}
    if done % config.reset_interval == 0:
        state.gaussians.opacity_logits.copy_(cap_opacity_logits(state.gaussians.opacity_logits, config.reset_opacity))
        state.moments.first["opacity_logits"].zero_()
        state.moments.second["opacity_logits"].zero_()
    return counts


def _apply(state: Gs3dState, added: Gaussians, kept: Tensor) -> None:
    """Append Gaussians without moments, then keep some of all; the statistics begin again."""
    state.scratch = {}
    index_anchors(state, {"gaussians": added.tensors()}, len(added), kept)
    state.gradient = torch.zeros_like(state.gaussians.opacity_logits)
    state.views = torch.zeros_like(state.gradient)


def _smooth(state: Gs3dState, loss: float, psnr: float | None) -> None:
    state.loss = exponential_mean(state.loss, loss, LOSS_DECAY)
    if psnr is not None:
        state.psnr = exponential_mean(state.psnr, psnr, PSNR_DECAY)


def train(
    state: Gs3dState,
    stage: Gs3dProblem,
    *,
    stop: Callable[[], bool],
    after_step: Callable[[Gs3dState, Gs3dStepReport], None],
    prefetch: int = 4,
) -> bool:
    """Steps until the last iteration or until `stop()` is true. True if complete. `after_step` sees every step."""
    config = stage.config
    while state.iteration < stage.end:
        if stop():
            return False
        for ahead in range(state.iteration + 1, min(state.iteration + 1 + prefetch, stage.end)):
            stage.images.prefetch([view_at(ahead, stage.image_count, config.seed)], downscale_at(ahead, config))
        report = gs3d_train_step(state, stage)
        after_step(state, report)
    return True


def to_checkpoint(state: Gs3dState) -> Checkpoint:
    """The whole state as tensors and metadata."""
    tensors = {f"gaussians.{name}": tensor for name, tensor in state.gaussians.tensors().items()}
    tensors |= {f"first.{name}": tensor for name, tensor in state.moments.first.items()}
    tensors |= {f"second.{name}": tensor for name, tensor in state.moments.second.items()}
    tensors |= {f"extra.{name}": tensor.detach() for name, tensor in state.extra.items()}
    tensors |= {"gradient": state.gradient, "views": state.views}
    metadata = {"loss": repr(state.loss), "psnr": repr(state.psnr), "seconds": state.seconds,
                "peak_memory_bytes": state.peak_memory_bytes}  # fmt: skip
    return Checkpoint(state.iteration, metadata, tensors)


def from_checkpoint(saved: Checkpoint) -> Gs3dState:
    """The inverse of `to_checkpoint`, bit for bit. Raises KeyError or TypeError if something is missing."""

    def part(prefix: str) -> dict[str, Tensor]:
        return {k.removeprefix(prefix): v for k, v in saved.tensors.items() if k.startswith(prefix)}

    return Gs3dState(
        saved.iteration, Gaussians(**part("gaussians.")), AdamMoments(part("first."), part("second.")),
        saved.tensors["gradient"], saved.tensors["views"], float(saved.metadata["loss"]), float(saved.metadata["psnr"]),
        float(saved.metadata["seconds"]), int(saved.metadata["peak_memory_bytes"]),
        extra=part("extra."),
    )  # fmt: skip
