"""Training of anchors: one loop for the coarse stage and for blocks; what differs is data."""

from vdgs.training.schedule import downscale_at, view_at, views_in_cycle
from vdgs.training.target import mean_image_color
from vdgs.training.training_loop import PSNR_LOG_INTERVAL, train, train_step
from vdgs.training.training_state import (
    FrozenAnchors,
    StepReport,
    TrainingImages,
    TrainingProblem,
    TrainingState,
    from_checkpoint,
    initial_state,
    result_from_saved,
    to_checkpoint,
)

__all__ = [
    "PSNR_LOG_INTERVAL",
    "FrozenAnchors",
    "StepReport",
    "TrainingImages",
    "TrainingProblem",
    "TrainingState",
    "downscale_at",
    "from_checkpoint",
    "initial_state",
    "mean_image_color",
    "result_from_saved",
    "to_checkpoint",
    "train",
    "train_step",
    "view_at",
    "views_in_cycle",
]
