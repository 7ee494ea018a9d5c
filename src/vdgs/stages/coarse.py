"""The coarse stage: one global anchor model from a whole capture, resumable at every moment."""

from __future__ import annotations

import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.checks import check_images
from vdgs.captures.facts import capture_facts
from vdgs.captures.heights import camera_height
from vdgs.captures.images import ImageCache
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.ground import solid_cells
from vdgs.model.sizes import largest_log_scales
from vdgs.model.start import initial_anchors
from vdgs.runs.flight import keep_flight
from vdgs.runs.folder import RunFolder
from vdgs.settings.method import TrainConfig
from vdgs.settings.watching import WatchOptions
from vdgs.storage.files import write_json
from vdgs.training import Stage, TrainingState, mean_colour, start_state
from vdgs.training.sampling import shares_for
from vdgs.watching.anchors import continue_or_start, finish, note_without_growth, train_watched
from vdgs.watching.images import image_budget


def train_coarse(
    run: RunFolder, capture: Capture, options: WatchOptions, console: Console, device: str = "cpu"
) -> None:
    """Train, or continue, the coarse model of a run on a device; nothing if it is finished.

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
        keep_flight(run, capture)
        folder.discard_unless(key)
        _train(run, capture, config, options, console, torch.device(device))


def _train(
    run: RunFolder, capture: Capture, config: TrainConfig, options: WatchOptions, console: Console, device: torch.device
) -> None:
    folder, views = run.coarse, capture.train_views
    # The voxel follows from the capture: recomputed when a run continues.
    cameras = [view.camera for view in views]
    anchors, voxel = initial_anchors(capture.points, capture.point_colours, cameras, config.anchors)
    ground = anchors.positions.to(device)
    factors = tuple(sorted({factor for _, factor in config.resolutions}))
    with ImageCache(views, image_budget(options), downscales=factors) as images:
        background = (0.0, 0.0, 0.0)
        if config.loss.background != "black":
            background = mean_colour(images, len(views), factors[-1])
        stage = Stage(
            config, images, len(views), voxel, camera_height(capture), background=background,
            shares=shares_for(config, anchors, cameras), device=device,
            ground=[solid_cells(ground, camera) for camera in cameras],
            largest=lambda positions: largest_log_scales(positions, cameras),
        )  # fmt: skip
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
    return start_state(anchors.to(stage.device), decoder.to(stage.device), stage)


def _announce(capture: Capture, state: TrainingState, config: TrainConfig, console: Console) -> None:
    camera = capture.train_views[0].camera
    console.print(
        f"{capture.root} ({capture.images}): {len(capture.train_views)} training and {len(capture.test_views)} test "
        f"views of {camera.width}x{camera.height}, {len(capture.points):,} points, {len(state.anchors):,} anchors, "
        f"{config.iterations:,} iterations",
        highlight=False,
    )
