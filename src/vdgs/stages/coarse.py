"""The coarse stage: one global anchor model from a whole capture, resumable at every moment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from vdgs import __version__
from vdgs.anchors import AnchorModel, Anchors, initial_anchors
from vdgs.captures.capture import Capture, View
from vdgs.captures.checks import check_images
from vdgs.captures.facts import capture_facts, refuse_another_capture
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.options import CaptureOptions
from vdgs.config import MethodConfig, TrainConfig, to_dict, with_iterations
from vdgs.config_checks import validate
from vdgs.decoder import Decoder
from vdgs.errors import VdgsError
from vdgs.files import read_json, write_json
from vdgs.memory import available_bytes
from vdgs.run import RunFolder
from vdgs.run_options import WatchOptions
from vdgs.stages.anchor_watching import continue_or_start, finish, train_watched
from vdgs.training import Stage, TrainingState, mean_colour, start_state
from vdgs.visibility import shares_of


def begin_run(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    method: MethodConfig,
    *,
    redo: bool | None = None,
) -> tuple[RunFolder, Capture]:
    """Open the capture and a new run of it, or the run that is there if it was started with the same settings.

    `redo` None compares the settings of the coarse stage only and refuses others; True or False is about changing
    them (`RunFolder.change`). Raises CaptureError for a capture that cannot be used, RunError for other settings than
    the run's, VdgsError for settings that do not work.
    """
    problems = validate(method)
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    capture = load_capture(capture_path, capture_options)
    method = replace(method, training=with_iterations(method.training, len(capture.train_views)))
    run = RunFolder(output)
    with run.locked():
        if run.capture_file.exists():
            refuse_another_capture(run.capture_file, read_json(run.capture_file), capture)
        settings = run_settings(capture_path, capture_options, method)
        if redo is None or not run.config_file.exists():
            run.begin(settings, ("capture", "training"))
        else:
            run.change(settings, redo)
    return run, capture


def run_settings(capture_path: Path, capture_options: CaptureOptions, method: MethodConfig) -> dict[str, Any]:
    """What config.yaml holds: everything that the result depends on."""
    plain = to_dict(capture_options)
    absolute = {name: str(value.resolve()) for name, value in vars(capture_options).items() if isinstance(value, Path)}
    capture = {"path": str(capture_path.resolve())} | plain | absolute
    return {"capture": capture} | to_dict(method)


def train_coarse(run: RunFolder, capture: Capture, options: WatchOptions, console: Console) -> None:
    """Train, or continue, the coarse model of a run; nothing if it is finished.

    Raises CaptureError for damaged photographs, Stopped after Ctrl-C or SIGTERM (state saved), TrainingDiverged (last
    good state kept).
    """
    options.check()
    with run.locked():
        folder, key = run.coarse, run.keys().coarse
        if folder.is_done(key):
            console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
            return
        for warning in capture.warnings:
            console.print(f"[yellow]note[/] {warning}")
        check_images(capture)
        config = run.method().training
        note_without_growth(config, console)
        write_json(run.capture_file, capture_facts(capture))
        folder.claim(key)
        _train(run, capture, config, options, console)


def note_without_growth(config: TrainConfig, console: Console, prefix: str = "--") -> None:
    """Say so where growth would begin after it has ended; `prefix` is that of the stage's options."""
    if config.growth.levels and config.growth.until * config.iterations < config.growth.start:
        console.print(
            f"[yellow]note[/] no anchor will grow: growth starts at iteration {config.growth.start} and ends at "
            f"{config.growth.until * config.iterations:.0f}. Give more {prefix}iterations or a smaller "
            f"{prefix}growth.start.",
            highlight=False,
        )


def camera_height(capture: Capture) -> float:
    """Median height of the training cameras above the median sparse point; at least a thousandth of their spread."""
    centres = np.array([view.camera.position for view in capture.train_views])
    height = float(np.median(centres[:, 2]) - np.median(capture.points[:, 2]))
    return max(height, 1e-3 * float(np.ptp(capture.points, axis=0).max()), 1e-9)


def shares_for(config: TrainConfig, anchors: Anchors, views: Sequence[View]) -> tuple[float, ...] | None:
    """How often each training view is used, by the settings, for the anchors that training starts with.

    Roots, because a view with few votes also costs little (`training.crops`): a mean varies least for what it costs
    if strata are drawn in proportion to their weight over the root of their cost (Cochran, 1977, section 5.5).
    """
    if config.sampling == "even":
        return None
    votes = shares_of(anchors.positions, [view.camera for view in views])
    return votes if config.sampling == "shares" else tuple(math.sqrt(share) for share in votes)


def image_budget(options: WatchOptions) -> int:
    """Bytes for decoded photographs."""
    return int(options.image_memory_gb * 1e9) or available_bytes() // 4


def _train(run: RunFolder, capture: Capture, config: TrainConfig, options: WatchOptions, console: Console) -> None:
    folder, views = run.coarse, capture.train_views
    # The voxel follows from the capture: recomputed when a run continues.
    anchors, voxel = initial_anchors(
        capture.points, capture.point_colours, [view.camera for view in views], config.anchors
    )
    factors = tuple(sorted({factor for _, factor in config.resolutions}))
    with ImageCache(views, image_budget(options), downscales=factors) as images:
        background = (0.0, 0.0, 0.0)
        if config.loss.background != "black":
            background = mean_colour(images, len(views), factors[-1])
        stage = Stage(
            config,
            images,
            len(views),
            voxel,
            camera_height(capture),
            background,
            shares=shares_for(config, anchors, views),
        )
        state = continue_or_start(folder, stage, lambda: _start(anchors, stage), console)
        _announce(capture, state, config, console)
        train_watched(folder, state, stage, options, console)
    facts = {"capture": capture_facts(capture), "version": __version__, "iterations": state.iteration}
    finish(folder, state, AnchorModel(*state.result(), voxel, background, facts), console)


def _start(anchors: Anchors, stage: Stage) -> TrainingState:
    config = stage.config
    generator = torch.Generator().manual_seed(config.seed)
    decoder = Decoder.initial(
        config.anchors.offsets, config.anchors.distance, config.anchors.appearance, stage.image_count, generator
    )
    return start_state(anchors, decoder, stage)


def _announce(capture: Capture, state: TrainingState, config: TrainConfig, console: Console) -> None:
    camera = capture.train_views[0].camera
    console.print(
        f"{capture.root} ({capture.images}): {len(capture.train_views)} training and {len(capture.test_views)} test "
        f"views of {camera.width}x{camera.height}, {len(capture.points):,} points, {len(state.anchors):,} anchors, "
        f"{config.iterations:,} iterations",
        highlight=False,
    )
