"""All stages from a capture to a scene in this process and its memory: no run folder, no checkpoints, the same bits as
`vdgs run`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.validation import require_trainable
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, TrainConfig, resolve_iterations
from vdgs.config.validation_rules import check_config
from vdgs.errors import VdgsError
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.partition.assignment.assign_cameras import assign_cameras
from vdgs.partition.assignment.score_matrix import compute_score_matrix
from vdgs.partition.blocks import Blocks
from vdgs.partition.merging import merge_blocks
from vdgs.partition.strategies import adjust_scores, assignment_config, cut_scene
from vdgs.pipeline.dense_points import match_dense_points
from vdgs.pipeline.train_block import plan_block
from vdgs.pipeline.train_coarse import (
    build_coarse_problem,
    fits_exposures,
    initial_coarse_state,
    open_training_images,
    show_progress,
)
from vdgs.training import StepReport, TrainingProblem, TrainingState, initial_state, train
from vdgs.training.exposure_centering import with_local_exposure
from vdgs.training.session.trainer import image_cache_bytes
from vdgs.visibility.visibility_counts import count_visibility


@dataclass(frozen=True, kw_only=True)
class TrainingEvent:
    """What a callback is told after a step."""

    #: "coarse", or "block 0" and so on.
    stage: str
    #: Steps made, of so many.
    iteration: int
    iterations: int
    #: Of this step; `psnr` is smoothed, of training views, in dB (NaN before the first).
    loss: float
    psnr: float
    #: Anchors there are now.
    anchors: int


#: Called after every step; True ends the stage with the model as it is.
StepCallback = Callable[[TrainingEvent], object]


def train_in_memory(
    capture: Capture,
    config: MethodConfig | TrainConfig,
    callbacks: tuple[StepCallback, ...] = (),
    console: Console | None = None,
    device: str = "cpu",
) -> AnchorModel:
    """The merged model of a capture; with a `TrainConfig`, the global model of the coarse stage alone.

    Raises CaptureError for a capture that cannot become a scene, VdgsError for settings that do not work and where
    training leaves no anchors, TrainingDiverged.
    """
    console, there = console or Console(quiet=True), torch.device(device)
    method = config if isinstance(config, MethodConfig) else MethodConfig(training=config)
    check_config(method)
    require_trainable(capture, console)
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    coarse = _train_coarse(capture, method.training, callbacks, console, there)
    if isinstance(config, TrainConfig):
        return coarse
    cameras = [view.camera for view in capture.train_views]
    positions = coarse.anchors.positions.cpu().numpy()
    visibility = count_visibility(coarse.anchors.positions, cameras).cpu().numpy()
    blocks, warnings = cut_scene(positions, visibility, cameras, method)
    settings = assignment_config(method)
    scores = compute_score_matrix(coarse, blocks, cameras, settings)
    assignment = assign_cameras(
        adjust_scores(scores, positions, blocks, cameras, method.partition.strategy), settings
    )  # fmt: skip
    for note in warnings + assignment.warnings:
        console.print(f"[yellow]note[/] {note}", highlight=False)
    served = [np.flatnonzero(of_block).tolist() for of_block in assignment.cameras.T]
    trained = [
        _train_block(coarse, capture, blocks, index, served[index], method, callbacks, there)
        for index in range(len(blocks))
    ]
    of_blocks = [[cameras[i] for i in indices] for indices in served]
    return merge_blocks(coarse.to(torch.device("cpu")), trained, blocks, of_blocks, method.merge)[0]


def _train_coarse(
    capture: Capture, config: TrainConfig, callbacks: tuple[StepCallback, ...], console: Console, device: torch.device
) -> AnchorModel:
    with open_training_images(capture, config, image_cache_bytes(CheckpointOptions())) as images:
        dense = None
        if config.init.mvs:
            with tempfile.TemporaryDirectory() as scratch, show_progress("stereo", console) as progress:
                dense = match_dense_points(
                    capture, images, config.init, Path(scratch), progress, torch.get_num_threads()
                )
        problem, anchors = build_coarse_problem(capture, config, images, device, dense)
        state = initial_coarse_state(anchors, problem, fits_exposures(images, config, console)[1])
        _run(state, problem, "coarse", callbacks)
    if not len(state.anchors):
        raise VdgsError(
            "training has taken all anchors for transparent and removed them: give a smaller densify.prune_opacity or "
            "a larger densify.start, and look at the photographs with `vdgs inspect`"
        )
    metadata = ModelMetadata(capture=capture_metadata(capture), version=__version__, iterations=state.iteration)
    return with_local_exposure(_result(state, problem, metadata), [view.camera for view in capture.train_views])


def _train_block(
    coarse: AnchorModel, capture: Capture, blocks: Blocks, index: int, indices: list[int], method: MethodConfig,
    callbacks: tuple[StepCallback, ...], device: torch.device,
) -> AnchorModel:  # fmt: skip
    plan = plan_block(coarse, capture, blocks, index, indices, method)
    if not plan.can_train:
        return replace(coarse, anchors=plan.anchors).to(torch.device("cpu"))
    with plan.open_images(image_cache_bytes(CheckpointOptions())) as images:
        problem = plan.problem(capture, blocks, method, images, device)
        state = initial_state(plan.anchors, coarse.decoder.copy(), problem)
        _run(state, problem, f"block {index}", callbacks)
    return _result(state, problem, ModelMetadata(block=index, decoder=method.block.decoder)).to(torch.device("cpu"))


def _run(state: TrainingState, problem: TrainingProblem, stage: str, callbacks: tuple[StepCallback, ...]) -> None:
    """Train to the end, or until a callback returns True."""
    ends = False

    def after_step(state: TrainingState, report: StepReport) -> None:
        nonlocal ends
        event = TrainingEvent(
            stage=stage, iteration=state.iteration, iterations=problem.config.iterations, loss=report.loss,
            psnr=state.psnr, anchors=len(state.anchors),
        )  # fmt: skip
        for callback in callbacks:
            answer = callback(event)
            ends = (isinstance(answer, bool | np.bool_) and bool(answer)) or ends

    train(state, problem, stop=lambda: ends, after_step=after_step)


def _result(state: TrainingState, problem: TrainingProblem, metadata: ModelMetadata) -> AnchorModel:
    """The model that training has arrived at, which nothing trains any more."""
    model = state.model(problem, metadata)
    return replace(model, decoder=model.decoder.copy())


def train_in_run_folder(
    capture: Path, options: CaptureOptions, config: MethodConfig | TrainConfig, run_dir: Path, console: Console,
    device: str,
) -> None:  # fmt: skip
    """The same stages with a run folder, which the same call continues."""
    from vdgs.pipeline import count_visibility as visibility
    from vdgs.pipeline import find_motion, merge_blocks, partition_stage, train_blocks, train_coarse
    from vdgs.runs.create_or_resume import exclusive_run

    method = config if isinstance(config, MethodConfig) else MethodConfig(training=config)
    saving = CheckpointOptions()
    with exclusive_run(capture, run_dir, options, method, overwrite=False) as context:
        train_coarse.train_coarse(context, saving, console, device)
        if isinstance(config, MethodConfig):
            find_motion.find_run_motion(context, console, device)
            visibility.count_run_visibility(context, console)
            partition_stage.partition_run(context, console, device)
            train_blocks.train_blocks(context, saving, 0, console, device)
            merge_blocks.merge_run_blocks(context, False, console)
