"""The coarse stage: one global anchor model from a whole capture, resumable at every moment."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_facts
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.photometric_gains import point_colours
from vdgs.captures.validation import refuse_unworkable
from vdgs.config.checkpointing import WatchOptions
from vdgs.config.method import TrainConfig
from vdgs.model.anchor_model import ModelMetadata
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import neutral_exposures
from vdgs.model.initialization.initialize import initial_anchors
from vdgs.model.initialization.stereo import DensePoints
from vdgs.model.scale_bounds import largest_log_scales
from vdgs.pipeline.dense_points import find_points
from vdgs.runs.open_run import refuse_empty
from vdgs.runs.run_cameras import keep_flight
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import Status
from vdgs.system.atomic_files import write_json
from vdgs.system.checkpoints import save_state
from vdgs.system.stop_signals import stop_if_asked
from vdgs.training import Stage, TrainingState, mean_colour, start_state, to_saved
from vdgs.training.schedule import shares_for
from vdgs.training.session.trainer import continue_or_start, finish, image_budget, note_without_growth, train_watched


def train_coarse(context: RunContext, options: WatchOptions, console: Console, device: str = "cpu") -> None:
    """Train, or continue, the coarse model of a run on a device; nothing if it is finished.

    Raises CaptureError for a capture that cannot become a scene or damaged photographs, Stopped after Ctrl-C or SIGTERM
    (state saved), TrainingDiverged (last good state kept), RunError where training leaves no anchors.
    """
    options.check()
    run = context.run
    folder, key = run.coarse, run.keys().coarse
    if folder.is_done(key):  # its blocks may be at work
        refuse_empty(run, folder.status().anchors)
        console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
        return
    with run.locked():
        capture = context.capture
        refuse_unworkable(capture, console)
        config = run.method().training
        note_without_growth(config, console)
        write_json(run.capture_file, capture_facts(capture))
        keep_flight(run, capture)
        folder.discard_unless(key)
        _train(run, capture, config, options, console, torch.device(device))


def _train(
    run: RunFolder, capture: Capture, config: TrainConfig, options: WatchOptions, console: Console, device: torch.device
) -> None:
    folder = run.coarse
    factors = tuple(sorted({1, *(factor for _, factor in config.resolutions)}))  # 1: stereo sees them in full
    with ImageCache(capture.train_views, image_budget(options), downscales=factors) as images:
        dense = _dense_points(run, capture, images, config, console)
        stage, anchors = open_stage(capture, config, images, device, dense)

        def begun() -> TrainingState:
            differ = _brightness(images, config, console)
            fitted = config.exposure and (differ is None or differ >= config.exposure_spread)
            found = {"sparse_points": len(capture.points), "dense_points": None if dense is None else len(dense.points)}
            write_json(folder.start_file, {**found, "brightness_differs": differ, "exposures": fitted})
            return start(anchors, stage, fitted)

        state = continue_or_start(folder, stage, begun, console)
        _announce(capture, state, config, console)
        train_watched(folder, state, stage, options, console)
    _refuse_empty(run, state)
    metadata = ModelMetadata(
        capture=capture_facts(capture), version=__version__, iterations=state.iteration, key=run.keys().coarse
    )
    finish(folder, state, state.model(stage.voxel, stage.background, metadata), console)


def _refuse_empty(run: RunFolder, state: TrainingState) -> None:
    """Raise RunError for a state without anchors, before its stage counts as done. It is kept: to come this far again
    would not help."""
    if not len(state.anchors):
        save_state(run.coarse.checkpoints, to_saved(state))
        run.coarse.set_status(Status(state="failed", iteration=state.iteration, why="training has removed all anchors"))
    refuse_empty(run, len(state.anchors))


def _dense_points(
    run: RunFolder, capture: Capture, images: ImageCache, config: TrainConfig, console: Console
) -> DensePoints | None:
    """What stereo adds to the sparse points, found now or before; what it found is said."""
    began = time.monotonic()
    wait = console.status("looking for ground by stereo")

    def tell(done: int, of: int) -> None:
        stop_if_asked()
        wait.update(f"looking for ground by stereo, {done / of:.0%}")

    with wait:
        dense = find_points(run, capture, images, config.anchors, tell, torch.get_num_threads())
    if dense is not None:
        added = f"{len(dense.points):,} points beside the sparse ones, {time.monotonic() - began:.0f} s"
        console.print(
            f"stereo: {added if len(dense.points) else 'no points added: the sparse ones suffice, or nothing matches'}",
            highlight=False,
        )
    return dense


def _brightness(images: ImageCache, config: TrainConfig, console: Console) -> float | None:
    """By what share photographs of the same places differ in brightness; None where nothing depends on it, or the
    capture does not tell. Says what follows."""
    if not (config.exposure and config.exposure_spread):
        return None
    wait = console.status("comparing the photographs' brightness")

    def tell(done: int, of: int) -> None:
        stop_if_asked()
        wait.update(f"comparing the photographs' brightness, {done / of:.0%}")

    with wait:
        colours = point_colours(images, tell)
    if colours is None:
        console.print(
            "exposure: one is fitted to each photograph; whether they differ in brightness is not known, for the "
            "capture does not say which of them show the same points", highlight=False,
        )  # fmt: skip
        return None
    found, spread = colours.difference(), config.exposure_spread
    said = "one is fitted to each" if found >= spread else f"less than {spread:.2%}, so none is fitted"
    console.print(
        f"exposure: photographs of the same places differ in brightness by {found:.2%}; {said}", highlight=False
    )
    return found


def open_stage(
    capture: Capture,
    config: TrainConfig,
    images: ImageCache,
    device: torch.device | str,
    dense: DensePoints | None = None,
) -> tuple[Stage, Anchors]:
    """What the coarse stage works with, and the anchors that it starts from: at the sparse points, and the `dense`
    ones."""
    cameras = [view.camera for view in capture.train_views]
    # The voxel follows from the capture: recomputed when a run continues.
    anchors, voxel = initial_anchors(capture.points, capture.point_colours, cameras, config.anchors, dense)
    background = (0.0, 0.0, 0.0)
    if config.loss.background != "black":
        smallest = max(factor for _, factor in config.resolutions)
        background = mean_colour(images, len(cameras), smallest)
    stage = Stage(
        config=config, images=images, image_count=len(cameras), voxel=voxel, camera_height=camera_height(capture),
        background=background, shares=shares_for(config, anchors, cameras), device=torch.device(device),
        largest=(lambda positions: largest_log_scales(positions, cameras)) if config.anchors.bound_sizes else None,
    )  # fmt: skip
    return stage, anchors


def start(anchors: Anchors, stage: Stage, exposures: bool) -> TrainingState:
    """The state before the first step, in which photographs have exposures to be fitted or have none."""
    config = stage.config
    generator = torch.Generator().manual_seed(config.seed)
    decoder = Decoder.initial(
        config.anchors.offsets, config.anchors.distance, config.anchors.appearance, stage.image_count, generator
    )
    if exposures:
        decoder = replace(decoder, exposure=neutral_exposures(stage.image_count))
    return start_state(anchors.to(stage.device), decoder.to(stage.device), stage)


def _announce(capture: Capture, state: TrainingState, config: TrainConfig, console: Console) -> None:
    camera = capture.train_views[0].camera
    console.print(
        f"{capture.root} ({capture.images}): {len(capture.train_views)} training and {len(capture.test_views)} test "
        f"views of {camera.width}x{camera.height}, {len(capture.points):,} points, {len(state.anchors):,} anchors, "
        f"{config.iterations:,} iterations",
        highlight=False,
    )
