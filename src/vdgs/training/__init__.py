"""Training of anchors: one loop for the coarse stage and for blocks; what differs is data."""

from vdgs.training.schedule import downscale_at, view_at, views_in_cycle
from vdgs.training.target import mean_colour
from vdgs.training.training_loop import PSNR_INTERVAL, train, train_step
from vdgs.training.training_state import (
    Stage,
    StepReport,
    Surroundings,
    TrainingImages,
    TrainingState,
    from_saved,
    result_from_saved,
    start_state,
    to_saved,
)

__all__ = [
    "PSNR_INTERVAL", "Stage", "StepReport", "Surroundings", "TrainingImages", "TrainingState", "downscale_at",
    "from_saved", "mean_colour", "result_from_saved", "start_state", "to_saved", "train", "train_step", "view_at",
    "views_in_cycle",
]  # fmt: skip
