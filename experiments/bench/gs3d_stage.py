"""3DGS among the methods of a table: its settings, and its training and measuring as a stage of a run."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from rich.console import Console

from experiments.baselines.gs3d.run import gaussians_folder, run_gs3d
from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig
from vdgs.captures.capture import Capture
from vdgs.config.method import MethodConfig
from vdgs.config.serialization import to_dict
from vdgs.runs.run_folder import RunFolder


def gs3d_config(method: MethodConfig) -> Gs3dConfig:
    """The settings of 3DGS that has the iterations, the seed and the background of a coarse stage, and as many
    Gaussians at most as that may decode from its anchors. Everything else is as published, its schedule in proportion
    to the iterations."""
    training = method.training
    most = training.densify.max_anchors * training.model.num_offsets
    published = Gs3dConfig(seed=training.seed, background=training.loss.background)
    return scale_schedule(training.iterations, published, most)


def train_gs3d(run: RunFolder, capture: Capture, lpips_weights: Path | None, console: Console) -> None:
    """Train, or continue, 3DGS for the settings of a run and measure it. What was trained for other settings or on
    another choice of photographs goes first (that it may go was asked before: `RunFolder.change_settings`).

    Raises what `run_gs3d` raises.
    """
    config = gs3d_config(run.method())
    made_for = json.dumps([run.keys().coarse, to_dict(config)], sort_keys=True)
    with run.locked():
        gaussians_folder(run).reset_unless(hashlib.sha256(made_for.encode()).hexdigest()[:16])
    run_gs3d(run, capture, config, console, lpips_weights=lpips_weights)
