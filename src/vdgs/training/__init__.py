"""Training of anchors: one loop for the coarse stage and for blocks, which differ in data."""

from vdgs.training.schedule import downscale_at as downscale_at
from vdgs.training.schedule import view_at as view_at
from vdgs.training.schedule import views_in_cycle as views_in_cycle
from vdgs.training.target import mean_image_color as mean_image_color
from vdgs.training.training_loop import PSNR_LOG_INTERVAL as PSNR_LOG_INTERVAL
from vdgs.training.training_loop import train as train
from vdgs.training.training_loop import train_step as train_step
from vdgs.training.training_state import FrozenAnchors as FrozenAnchors
from vdgs.training.training_state import StepReport as StepReport
from vdgs.training.training_state import TrainingImages as TrainingImages
from vdgs.training.training_state import TrainingProblem as TrainingProblem
from vdgs.training.training_state import TrainingState as TrainingState
from vdgs.training.training_state import from_checkpoint as from_checkpoint
from vdgs.training.training_state import initial_state as initial_state
from vdgs.training.training_state import result_from_saved as result_from_saved
from vdgs.training.training_state import to_checkpoint as to_checkpoint
