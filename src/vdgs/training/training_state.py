"""What training works on (`TrainingProblem`) and what changes (`TrainingState`, which is saved and loaded bit for
bit)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.transfer import DeviceCopies
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import EXPOSURE, OLD_EXPOSURE, Decoder
from vdgs.model.initialization.sky_masks import SkyMask
from vdgs.system.checkpoints import Checkpoint
from vdgs.training.compensation import CompensationState
from vdgs.training.crops import Crop
from vdgs.training.exposure_centering import ExposureMoments, zero_moments
from vdgs.training.optimizer import AdamMoments, AnchorOptimizer
from vdgs.training.per_anchor_tensors import TensorGroup, without_rows
from vdgs.training.weight_averaging import ModelAverage

#: What is trained: the whole scene, or one block of it.
StageKind = Literal["coarse", "block"]
#: How the names of the decoder's tensors begin that no block moves: the mean appearance and neutral colors, in which
#: other photographs are drawn, must stay the same in all blocks, and so must what is behind all of them.
SHARED_TENSORS = ("appearance", "exposure", "envmap")


@runtime_checkable
class TrainingImages(Protocol):
    """Photographs on demand. Index i is the i-th training view."""

    def get(self, index: int, downscale: int = 1) -> tuple[Tensor, Tensor | None]: ...
    def camera(self, index: int, downscale: int = 1) -> Camera: ...
    def prefetch(self, indices: Sequence[int], downscale: int = 1) -> None: ...


@runtime_checkable
class LossGuidance(Protocol):
    """What a method in which several blocks train one decoder adds to the loss of each of them."""

    def weight(self) -> float:
        """What the whole loss of the next step is multiplied by."""
        ...

    def decoder_gradients(
        self, anchors: Anchors, rows: Tensor, decoder: Decoder, camera: Camera
    ) -> Mapping[str, Tensor]:
        """What is added to the gradients of the decoder's tensors, by name, for the anchors of the given rows."""
        ...


@dataclass(kw_only=True)
class TrainingState:
    """All that changes during training. `iteration` steps have been made."""

    iteration: int
    anchors: Anchors
    decoder: Decoder
    statistics: DensificationStats
    optimizer: AnchorOptimizer
    #: Largest log-scale that Gaussians of each anchor may have, [n] (`model.scale_bounds`): anchors never move.
    max_log_scale: Tensor
    #: Remembered gradients of compensated growth; None where growth is plain.
    compensation: CompensationState | None = None
    #: Mean of the last models, once it has begun (`is_averaged_step`).
    model_average: ModelAverage | None = None
    #: Of the photographs of this pass; None where no exposure is trained.
    exposure_moments: ExposureMoments | None = None
    #: Smoothed loss, its minimum, and smoothed PSNR of training views.
    loss: float = math.nan
    best_loss: float = math.inf
    psnr: float = math.nan
    #: Time spent and peak memory so far, over all processes that worked on this state.
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    #: False while a step changes tensors: an interrupted step leaves no state that may be saved.
    is_consistent: bool = True

    def groups(self) -> dict[str, TensorGroup]:
        """All that is kept per anchor, by the names under which it is saved."""
        moments = self.optimizer.anchors
        groups = {
            "anchors": self.anchors.tensors(), "statistics": self.statistics.tensors(),
            "first.anchors": moments.first, "second.anchors": moments.second,
            "updates": {"anchors": self.optimizer.updates}, "largest": {"log_scale": self.max_log_scale},
        }  # fmt: skip
        if self.compensation is not None:
            groups["compensation"] = self.compensation.tensors()
        if self.model_average is not None:
            groups["average.anchors"] = self.model_average.anchors
        return groups

    def take_groups(self) -> dict[str, TensorGroup]:
        """`groups`, which the state no longer holds: see `index_anchors`."""
        groups = {name: dict(group) for name, group in self.groups().items()}
        self.put_groups(without_rows(groups))
        return groups

    def put_groups(self, groups: dict[str, TensorGroup]) -> None:
        """The inverse of `take_groups`."""
        self.anchors, self.statistics = Anchors(**groups["anchors"]), DensificationStats(**groups["statistics"])
        self.optimizer.anchors = AdamMoments(groups["first.anchors"], groups["second.anchors"])
        self.optimizer.updates = groups["updates"]["anchors"]
        self.max_log_scale = groups["largest"]["log_scale"]
        if self.compensation is not None:
            self.compensation = CompensationState(**groups["compensation"])
        if self.model_average is not None:
            self.model_average.anchors = groups["average.anchors"]

    def result(self) -> tuple[Anchors, Decoder]:
        """What training has arrived at: the mean of the last models where there is one, else the last one."""
        if self.model_average is None:
            return self.anchors, self.decoder
        anchors = replace(self.anchors, **self.model_average.anchors)
        return anchors, Decoder.from_tensors(self.model_average.decoder)

    def model(self, stage: TrainingProblem, metadata: ModelMetadata | None = None) -> AnchorModel:
        """The model of `result`."""
        anchors, decoder = self.result()
        return AnchorModel(
            anchors=anchors, decoder=decoder, voxel_size=stage.voxel_size, background=stage.background,
            photograph_pixel=stage.photograph_pixel, metadata=metadata or ModelMetadata(),
        )  # fmt: skip


@dataclass(frozen=True)
class FrozenAnchors:
    """Anchors that do not train, with their decoder."""

    anchors: Anchors
    decoder: Decoder


@dataclass(frozen=True, kw_only=True)
class TrainingProblem:
    """What training works on: the same for all iterations."""

    config: TrainConfig
    images: TrainingImages
    num_images: int
    voxel_size: float
    #: The largest pixel of each level of the anchors, finest first (`model.levels.fit_levels`); empty: no levels.
    max_pixels: tuple[float, ...] = ()
    #: Height of the cameras above the ground, or their distance from the scene (`captures.camera_height`), in units of
    #: the ground frame.
    camera_height: float
    #: What the rates of offsets are multiplied by.
    offset_rate_factor: float = 1.0
    #: Whether the whole scene is trained or one block of it.
    kind: StageKind = "coarse"
    #: Color behind the scene.
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    #: A block may leave the decoder as it is.
    frozen_decoder: bool = False
    #: The largest log-scale of Gaussians of anchors at places [p, 3]; None: any.
    max_log_scale: Callable[[Tensor], Tensor] | None = None
    #: As the model keeps it.
    photograph_pixel: float = 0.0
    #: What is drawn and never moves: ring and context of a block.
    frozen_anchors: FrozenAnchors | None = None
    #: Which places [p, 3] may get new anchors; None: all.
    growth_mask: Callable[[Tensor], Tensor] | None = None
    #: How far the anchors at places [p, 3] move, from 0 to 1 of a full step; None: all of it.
    lr_mask: Callable[[Tensor], Tensor] | None = None
    #: The training image of the whole capture that each view is (for its appearance); None: the same number.
    image_indices: Sequence[int] | None = None
    #: How often each view is used, in proportion; None: all alike.
    view_weights: tuple[float, ...] | None = None
    #: Which of the rows that may touch a view a step draws, in ascending order; None: all. For models with levels.
    select_rows: Callable[[TrainingState, Tensor, Camera], Tensor] | None = None
    #: What adds and removes anchors in place of `densification_step.densify`; returns what that does.
    grow: Callable[[TrainingState, TrainingProblem], Any] | None = None
    #: The part of each view that is drawn, further limited by `gradient_roi`; None: all of it.
    crops: tuple[Crop, ...] | None = None
    #: What is added to the loss by a method of several blocks with one decoder; None: nothing.
    guidance: LossGuidance | None = None
    #: The sky of each view, None for a view without sky; None: no view shows any.
    sky_masks: Sequence[SkyMask | None] | None = None
    #: Where the arithmetic is done. Photographs and places come to it.
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    #: Of photographs, on that device.
    copies: DeviceCopies = field(default_factory=DeviceCopies)

    @property
    def loss_weight(self) -> float:
        """What the loss of the next step is multiplied by."""
        return 1.0 if self.guidance is None else self.guidance.weight()

    def max_log_scale_at(self, positions: Tensor) -> Tensor:
        """The largest log-scale [p] of Gaussians of anchors at places [p, 3]."""
        if self.max_log_scale is None:
            return torch.full_like(positions[:, 0], math.inf)
        return self.max_log_scale(positions)


@dataclass(frozen=True, kw_only=True)
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
    cycle: dict[str, float | None] = field(default_factory=dict)


def initial_state(anchors: Anchors, decoder: Decoder, stage: TrainingProblem) -> TrainingState:
    """A state before the first step. The anchors' tensors are moved in place: give copies of what must stay."""
    n, k, device = len(anchors), anchors.offsets.shape[1], anchors.positions.device
    for name, tensor in decoder.tensors().items():
        shared = stage.kind == "block" and name.startswith(SHARED_TENSORS)
        tensor.requires_grad_(not stage.frozen_decoder and not shared)
    compensation = CompensationState.zeros(n, k, device) if stage.config.compensation.enabled else None
    exposed = decoder.exposure is not None and decoder.exposure.requires_grad
    return TrainingState(
        iteration=0,
        anchors=anchors,
        decoder=decoder,
        statistics=DensificationStats.zeros(n, k, device),
        optimizer=AnchorOptimizer.zeros(anchors, decoder),
        max_log_scale=stage.max_log_scale_at(anchors.positions),
        compensation=compensation,
        exposure_moments=zero_moments(device) if exposed else None,
    )


def to_checkpoint(state: TrainingState) -> Checkpoint:
    """The whole state as tensors and metadata."""
    groups: dict[str, Mapping[str, Tensor]] = {**state.groups()}
    groups["decoder"] = {name: tensor.detach() for name, tensor in state.decoder.tensors().items()}
    groups["first.decoder"] = state.optimizer.decoder.first
    groups["second.decoder"] = state.optimizer.decoder.second
    if state.model_average is not None:
        groups["average.decoder"] = state.model_average.decoder
    if state.exposure_moments is not None:
        groups["exposure"] = {"moments": state.exposure_moments}
    tensors = {f"{name}.{key}": tensor for name, group in groups.items() for key, tensor in group.items()}
    metadata = {"loss": repr(state.loss), "best_loss": repr(state.best_loss), "psnr": repr(state.psnr),
             "seconds": state.seconds, "peak_memory_bytes": state.peak_memory_bytes,
             "averaged": 0 if state.model_average is None else state.model_average.count}  # fmt: skip
    return Checkpoint(state.iteration, metadata, tensors)


def result_from_saved(saved: Checkpoint) -> tuple[Anchors, Decoder]:
    """As `TrainingState.result`, of a state that was saved."""
    anchors, averaged = _group(saved, "anchors"), bool(saved.metadata.get("averaged", 0))
    anchors |= _group(saved, "average.anchors") if averaged else {}
    return Anchors(**anchors), Decoder.from_tensors(_group(saved, "average.decoder" if averaged else "decoder"))


def _group(saved: Checkpoint, name: str) -> dict[str, Tensor]:
    """The tensors of one group of a state that was saved, by their own names."""
    start = f"{name}."
    return {key.removeprefix(start): tensor for key, tensor in saved.tensors.items() if key.startswith(start)}


def from_checkpoint(
    saved: Checkpoint, stage: TrainingProblem, start: Callable[..., TrainingState] = initial_state
) -> TrainingState:
    """The inverse of `to_checkpoint`, bit for bit, on the stage's device. Raises KeyError if a tensor is missing, or
    exposures are those of an older version.
    `start` makes a new state, of the kind that was saved, as `initial_state` does."""

    def group(name: str) -> dict[str, Tensor]:
        return {key: tensor.to(stage.device) for key, tensor in _group(saved, name).items()}

    if f"decoder.{OLD_EXPOSURE}" in saved.tensors:
        raise KeyError(f"decoder.{EXPOSURE}")
    state = start(Anchors(**group("anchors")), Decoder.from_tensors(group("decoder")), stage)
    state.optimizer.decoder = AdamMoments(group("first.decoder"), group("second.decoder"))
    if averaged := saved.metadata["averaged"]:
        state.model_average = ModelAverage(averaged, group("average.anchors"), group("average.decoder"))
    if state.exposure_moments is not None:
        state.exposure_moments = group("exposure")["moments"]
    state.put_groups({name: group(name) for name in state.groups()})
    state.iteration = saved.iteration
    state.loss, state.best_loss = float(saved.metadata["loss"]), float(saved.metadata["best_loss"])
    state.psnr, state.seconds = float(saved.metadata["psnr"]), float(saved.metadata["seconds"])
    state.peak_memory_bytes = int(saved.metadata["peak_memory_bytes"])
    return state
