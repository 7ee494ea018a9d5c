"""Scaffold-GS and Octree-GS as comparators: trained, saved and measured like the method itself.

RUN/octree or RUN/scaffold/   checkpoints/  log.jsonl  status.json  settings.json  model.safetensors  levels.safetensors
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.baselines.evaluation import BaselineFacts, evaluate_baseline
from experiments.baselines.octree_gs.levels import Octree, fit_octree
from experiments.baselines.octree_gs.model import OctreeModel
from experiments.baselines.octree_gs.settings import OctreeConfig
from experiments.baselines.octree_gs.training import OctreeState, octree_problem, octree_state, start_state
from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.validation import require_trainable
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.serialization import to_dict
from vdgs.model.anchor_model import ModelMetadata
from vdgs.pipeline.train_coarse import open_training_images
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import write_json
from vdgs.system.checkpoints import Checkpoint
from vdgs.training import TrainingProblem, from_checkpoint
from vdgs.training.session.trainer import finish_stage, image_cache_bytes, train_with_checkpoints
from vdgs.training.session.training_session import restore_or_start


def run_octree(
    run: RunFolder,
    capture: Capture,
    config: OctreeConfig,
    console: Console,
    *,
    lpips_weights: Path | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Train (or continue) in RUN/octree, with one level in RUN/scaffold, and measure into RUN/evaluation.

    Raises VdgsError for captures that cannot become a scene, Stopped after Ctrl-C or SIGTERM (state saved),
    TrainingDiverged (last good state kept).
    """
    name = "scaffold" if config.levels == 1 else "octree"
    folder = StageFolder(run.path / name)
    with run.locked():
        model = train_octree(capture, config, folder, console, device)
        write_json(run.capture_file, capture_metadata(capture))
    metadata = model.anchors.metadata
    facts = BaselineFacts(
        name=name, capture=dict(metadata.capture or {}), trained=folder, num_anchors=len(model.anchors.anchors)
    )
    return evaluate_baseline(model.to(device), facts, capture, run.evaluation, console, lpips_weights=lpips_weights)


def train_octree(
    capture: Capture, config: OctreeConfig, folder: StageFolder, console: Console, device: str = "cpu"
) -> OctreeModel:
    """The model of a capture, trained on a device; if it is finished, only read."""
    with folder.locked():
        if folder.is_done():
            console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
            return OctreeModel.load(folder.path)
        require_trainable(capture, console)
        cameras = [view.camera for view in capture.train_views]
        octree = fit_octree(capture.points, cameras, config)
        write_json(folder.path / "settings.json", {"settings": to_dict(config), "octree": vars(octree)})
        with open_training_images(capture, config.training, image_cache_bytes(CheckpointOptions())) as images:
            problem = octree_problem(capture, config, octree, images, cameras, device=device)
            start = lambda: octree_state(capture.points, cameras, problem, octree)  # noqa: E731
            return train_levels(folder, capture, octree, problem, start, console)


def train_levels(
    folder: StageFolder, capture: Capture, octree: Octree, problem: TrainingProblem,
    start: Callable[[], OctreeState], console: Console,
) -> OctreeModel:  # fmt: skip
    """Train to the end, from the newest whole checkpoint or from the start, and save the model, which comes to main
    memory."""

    def restore(saved: Checkpoint) -> OctreeState:
        state = from_checkpoint(saved, problem, start_state)
        assert isinstance(state, OctreeState)
        return state

    advice = "Choose another output folder."
    state = restore_or_start(folder, problem.config.iterations, start, restore, advice, console)
    console.print(
        f"{octree.num_levels} level(s), cells from {octree.voxel:.3g} to {octree.cell(octree.num_levels - 1):.3g}, "
        f"{len(state.anchors):,} anchors", highlight=False,
    )  # fmt: skip
    train_with_checkpoints(folder, state, problem, CheckpointOptions(), console)
    metadata = ModelMetadata(capture=capture_metadata(capture), version=__version__, iterations=state.iteration)
    anchors = state.model(problem, metadata)
    model = OctreeModel(anchors, state.levels, state.bias, (octree,)).to("cpu")
    model.save(folder.path)
    finish_stage(folder, state, anchors, console)
    return model
