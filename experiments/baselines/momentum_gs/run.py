"""Block training of Momentum-GS as a stage of a run, in place of `vdgs train-blocks`: RUN/momentum holds the joint
state, RUN/blocks what came of it, and `merge` and `eval` work as for any run."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import torch
from rich.console import Console

from experiments.baselines.momentum_gs.blocks import MomentumTraining, restore
from experiments.baselines.momentum_gs.guidance import MomentumConfig
from experiments.baselines.turns import train_in_turns
from vdgs import __version__
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.config.executor_options import CheckpointOptions
from vdgs.errors import RunError
from vdgs.model.anchor_model import ModelMetadata
from vdgs.pipeline.train_block import BlockPlan, keep_coarse_block, plan_block
from vdgs.runs.motion_masks import with_motion_masks
from vdgs.runs.open_run import block_view_indices, load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.stage_folder import StageFolder
from vdgs.training import TrainingProblem, initial_state
from vdgs.training.session.trainer import finish_stage, image_cache_bytes
from vdgs.training.session.training_session import restore_or_start


def train_momentum_blocks(context: RunContext, console: Console, device: str = "cpu") -> None:
    """Train, or continue, all blocks of a run that is cut, on a device; nothing if they are finished.

    Raises RunError where no block has anchors and photographs, and what `run_session` raises.
    """
    config, options, run = MomentumConfig(), CheckpointOptions(), context.run
    with run.locked():
        blocks, key, method = load_run_blocks(run), run.keys().blocks, run.method()
        folders = [run.block(index) for index in range(len(blocks))]
        if all(folder.is_done(key) for folder in folders):
            console.print(f"{run.path}/blocks: all {len(blocks)} trained; nothing to do", highlight=False)
            return
        opened = context.open_model("coarse", device)
        capture, coarse = with_motion_masks(run, opened.capture), opened.model
        plans = [
            plan_block(coarse, capture, blocks, index, block_view_indices(run, capture, index), method)
            for index in range(len(blocks))
        ]
        joint, able = StageFolder(run.path / "momentum"), [plan for plan in plans if plan.can_train]
        if not able:
            raise RunError(f"{run.path}: no block has anchors and photographs. Give fewer --blocks.")
        joint.reset_unless(key)
        for folder in folders:
            folder.reset_unless(key)
        with ExitStack() as opened_images:
            budget = image_cache_bytes(options) // len(able)
            problems = [
                plan.problem(
                    capture, blocks, method, opened_images.enter_context(plan.open_images(budget)), torch.device(device)
                )
                for plan in able
            ]
            training = _train(joint, able, problems, config, options, console)
        own = capture_metadata(opened.capture)  # with its own masks
        metadata = ModelMetadata(capture=own, version=__version__, key=key, decoder="own")
        for plan in plans:
            index = plan.index
            of_block = replace(metadata, block=index, views=len(plan.views))
            if plan not in able:
                unmoved = replace(of_block, decoder="frozen")
                keep_coarse_block(
                    folders[index], replace(coarse, anchors=plan.anchors, metadata=unmoved), len(plan.views), console
                )
                continue
            state = training.states[able.index(plan)]
            model = state.model(problems[able.index(plan)], replace(of_block, iterations=state.iteration))
            finish_stage(folders[index], state, model, console, plan.mean_area)


def _train(
    folder: StageFolder,
    plans: Sequence[BlockPlan],
    problems: Sequence[TrainingProblem],
    config: MomentumConfig,
    options: CheckpointOptions,
    console: Console,
) -> MomentumTraining:
    """All blocks to the end."""
    decoder = plans[0].coarse.decoder.copy()

    def start() -> MomentumTraining:
        states = [initial_state(plan.anchors, decoder, problem) for plan, problem in zip(plans, problems, strict=True)]
        return MomentumTraining(states, problems, config)

    steps = problems[0].config.iterations * len(plans)
    training = restore_or_start(
        folder, steps, start, lambda saved: restore(saved, problems, config), "Start a new --output.", console
    )
    console.print(
        f"{len(plans)} blocks with one decoder, {problems[0].config.iterations:,} iterations each in turns of "
        f"{training.interval:,}",
        highlight=False,
    )
    train_in_turns(folder, training, options, console)
    return training
