"""What training works on (`Stage`, the same for all iterations) and what changes (`TrainingState`, explicit and whole).

A state that is saved and loaded continues with the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from vdgs.cameras import Camera
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.settings.method import TrainConfig
from vdgs.storage.checkpoints import SavedState
from vdgs.training.averaging import Average
from vdgs.training.compensation import Compensation
from vdgs.training.crops import Crop
from vdgs.training.growth import Statistics
from vdgs.training.optimiser import Moments, Optimiser


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
    #: Mean of the last models, once it has begun (`averaging.counts_in_mean`).
    average: Average | None = None
    #: Smoothed loss, the smallest it has been, smoothed PSNR of training views.
    loss: float = math.nan
    best_loss: float = math.inf
    psnr: float = math.nan
    #: Time spent and largest memory used so far, over all processes that worked on this state.
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    #: False while a step changes tensors: one that is broken off there leaves no state that may be saved.
    whole: bool = True

    def result(self) -> tuple[Anchors, Decoder]:
        """What training has arrived at: the mean of the last models where there is one, else the last one."""
        if self.average is None:
            return self.anchors, self.decoder
        return (
            Anchors(self.anchors.positions, **self.average.anchors),
            Decoder.from_tensors(self.average.decoder),
        )


@dataclass(frozen=True)
class Surroundings:
    """Anchors that stay as they are, with the decoder that they were trained with."""

    anchors: Anchors
    decoder: Decoder


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
    #: A block may leave the decoder as it is.
    frozen_decoder: bool = False
    #: What is drawn and never moves: ring and context of a block.
    surroundings: Surroundings | None = None
    #: Which places [p, 3] may get new anchors; None: all.
    may_hold: Callable[[Tensor], Tensor] | None = None
    #: How far the anchors at places [p, 3] move, from 0 to 1 of a full step; None: all of it.
    mobility: Callable[[Tensor], Tensor] | None = None
    #: Which training image of the whole capture each view is (for its appearance); None: the same number.
    appearance_of: Sequence[int] | None = None
    #: How often each view is used, in proportion; None: all alike.
    shares: tuple[float, ...] | None = None
    #: The part of each view that is drawn; None: all of all.
    crops: tuple[Crop, ...] | None = None


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
    for name, tensor in decoder.tensors().items():
        # A block sees some of the photographs: the mean appearance, in which others are drawn, must not drift apart.
        shared = stage.surroundings is not None and name.startswith("appearance")
        tensor.requires_grad_(not stage.frozen_decoder and not shared)
    compensation = Compensation.zeros(n, k) if stage.config.compensation.enabled else None
    optimiser = Optimiser.start(anchors, decoder)
    return TrainingState(0, anchors, decoder, Statistics.zeros(n, k), optimiser, compensation)


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
    if state.average is not None:
        tensors |= {f"average.anchors.{k}": v for k, v in state.average.anchors.items()}
        tensors |= {f"average.decoder.{k}": v for k, v in state.average.decoder.items()}
    facts = {"loss": repr(state.loss), "best_loss": repr(state.best_loss), "psnr": repr(state.psnr),
             "seconds": state.seconds, "peak_memory_bytes": state.peak_memory_bytes,
             "averaged": 0 if state.average is None else state.average.count}  # fmt: skip
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
    if averaged := saved.facts.get("averaged", 0):
        state.average = Average(averaged, part("average.anchors."), part("average.decoder."))
    state.iteration = saved.iteration
    state.loss, state.best_loss = float(saved.facts["loss"]), float(saved.facts["best_loss"])
    state.psnr, state.seconds = float(saved.facts["psnr"]), float(saved.facts["seconds"])
    state.peak_memory_bytes = int(saved.facts["peak_memory_bytes"])
    return state
