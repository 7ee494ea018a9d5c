"""The coarse stage: one global anchor model from a whole capture, resumable at every moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.camera_height import camera_height, offset_rate_factor
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.photometric_gains import collect_point_colors
from vdgs.captures.validation import print_doubts
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import TrainConfig
from vdgs.model.anchor_model import ModelMetadata
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import zero_exposures
from vdgs.model.initialization.initialize import initialize_anchors
from vdgs.model.initialization.sky_masks import SkyMask
from vdgs.model.initialization.stereo import DensePoints
from vdgs.model.levels import add_coarser_levels, describe_levels, fit_levels
from vdgs.model.scale_bounds import max_log_scales, photograph_pixel
from vdgs.pipeline.dense_points import find_dense_points, max_dense_points
from vdgs.runs.open_run import check_has_anchors
from vdgs.runs.run_cameras import save_run_cameras
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.system.checkpoints import save_checkpoint
from vdgs.system.console import show_share
from vdgs.system.step_progress import StepProgress
from vdgs.training import TrainingProblem, TrainingState, initial_state, mean_image_color, to_checkpoint
from vdgs.training.exposure_centering import with_local_exposure
from vdgs.training.schedule import view_sampling_weights
from vdgs.training.session.trainer import (
    finish_stage,
    image_cache_bytes,
    resume_or_start,
    train_with_checkpoints,
    warn_without_densification,
)
from vdgs.training.sky_background import photographed_envmap, view_sky_masks, view_skylines


def train_coarse(context: RunContext, options: CheckpointOptions, console: Console, device: str = "cpu") -> None:
    """Train, or continue, the coarse model of a run on a device; nothing if it is finished.

    Raises CaptureError for a capture that cannot become a scene or damaged photographs, Stopped after Ctrl-C or SIGTERM
    (state saved), TrainingDiverged (last good state kept), RunError where training leaves no anchors.
    """
    options.check()
    run = context.run
    folder, key = run.coarse, run.keys().coarse
    if folder.needs_no_work(key):  # its blocks may be at work
        check_has_anchors(run, folder.status().anchors)
        console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
        return
    with run.locked():
        capture = context.capture
        print_doubts(context.find_doubts(), console)
        config = run.method().training
        warn_without_densification(config, console)
        write_json(run.capture_file, capture_metadata(capture))
        save_run_cameras(run, capture)
        folder.reset_unless(key)
        _train(run, capture, config, options, console, torch.device(device))


def _train(
    run: RunFolder,
    capture: Capture,
    config: TrainConfig,
    options: CheckpointOptions,
    console: Console,
    device: torch.device,
) -> None:
    folder = run.coarse
    with open_training_images(capture, config, image_cache_bytes(options)) as images:
        dense = _dense_points(run, capture, images, config, console)
        stage, anchors = build_coarse_problem(capture, config, images, device, dense)

        def start() -> TrainingState:
            spread, fitted = fits_exposures(images, config, console, run)
            counts = {
                "sparse_points": len(capture.points),
                "dense_points": None if dense is None else len(dense.points),
            }
            write_json(folder.initialization_file, {**counts, "brightness_differs": spread, "exposures": fitted})
            return initial_coarse_state(anchors, stage, fitted)

        state = resume_or_start(folder, stage, start, console)
        camera = capture.train_views[0].camera
        console.print(
            f"{capture.root} ({capture.images}): {len(capture.train_views)} training and {len(capture.test_views)} "
            f"test views of {camera.width}x{camera.height}, {len(capture.points):,} points, {len(state.anchors):,} "
            f"anchors, {config.iterations:,} iterations",
            highlight=False,
        )
        if stage.max_pixels:
            console.print(describe_levels(state.anchors), highlight=False)
        if stage.sky_masks is not None:
            shown = sum(mask is not None for mask in stage.sky_masks)
            console.print(
                f"sky: {shown} photographs show it or what is far away; an environment map is trained behind the scene",
                highlight=False,
            )
        train_with_checkpoints(folder, state, stage, options, console)
    if not len(state.anchors):  # not done, but kept: to come this far again would not help
        save_checkpoint(folder.checkpoints, to_checkpoint(state))
        reason = "training has removed all anchors"
        folder.set_status(StatusRecord(state="failed", iteration=state.iteration, reason=reason))
    check_has_anchors(run, len(state.anchors))
    metadata = ModelMetadata(
        capture=capture_metadata(capture), version=__version__, iterations=state.iteration, key=run.keys().coarse
    )
    with show_progress("colors of the photographs", console, run) as on_progress:
        cameras = [view.camera for view in capture.train_views]
        model = with_local_exposure(state.model(stage, metadata), cameras, on_progress)
    finish_stage(folder, state, model, console)


def open_training_images(capture: Capture, config: TrainConfig, budget_bytes: int) -> ImageCache:
    """The training photographs in the sizes that the coarse stage needs; in full for stereo."""
    factors = tuple(sorted({1, *(factor for _, factor in config.resolution_schedule)}))
    return ImageCache(capture.train_views, budget_bytes, downscales=factors)


def _dense_points(
    run: RunFolder, capture: Capture, images: ImageCache, config: TrainConfig, console: Console
) -> DensePoints | None:
    """The points that stereo adds to the sparse ones, computed now or before; prints how many."""
    start = time.monotonic()
    with show_progress("looking for ground by stereo", console, run) as on_progress:
        dense = find_dense_points(run, capture, images, config.init, on_progress, torch.get_num_threads())
    if dense is not None:
        if len(dense.points):
            found = f"{len(dense.points):,} points beside the sparse ones, {time.monotonic() - start:.0f} s"
        elif max_dense_points(capture) == 0:
            found = "not used: the sparse points are as many as images of this size need"
        else:
            found = "no points added: no surface matches between the photographs beside the sparse points"
        console.print(f"stereo: {found}", highlight=False)
    return dense


@contextmanager
def show_progress(label: str, console: Console, run: RunFolder | None = None) -> Iterator[Callable[[int, int], None]]:
    """As `show_share`; the progress is also recorded in the folder of a run, for `vdgs status`."""
    progress: StepProgress | None = None
    with show_share(console, label) as show:

        def on_progress(done: int, total: int) -> None:
            nonlocal progress
            show(done, total)
            if run is not None:
                progress = progress or run.begin_step("coarse", label, "steps", total)
                progress(done)

        yield on_progress


def fits_exposures(
    images: ImageCache, config: TrainConfig, console: Console, run: RunFolder | None = None
) -> tuple[float | None, bool]:
    """By what share images of the same places differ in brightness (None where nothing depends on it, or the capture
    does not tell), and whether an exposure is fitted to each. Prints what follows."""
    spread = _brightness_spread(images, config, console, run)
    return spread, config.exposure_compensation and (spread is None or spread >= config.exposure_min_spread)


def _brightness_spread(
    images: ImageCache, config: TrainConfig, console: Console, run: RunFolder | None
) -> float | None:
    if not (config.exposure_compensation and config.exposure_min_spread):
        return None
    with show_progress("comparing the photographs' brightness", console, run) as on_progress:
        colors = collect_point_colors(images, on_progress)
    if colors is None:
        console.print(
            "exposure: one is fitted to each photograph; whether they differ in brightness is not known, for the "
            "capture does not say which of them show the same points", highlight=False,
        )  # fmt: skip
        return None
    spread, limit = colors.gain_spread(), config.exposure_min_spread
    result = "one is fitted to each" if spread >= limit else f"less than {limit:.2%}, so none is fitted"
    console.print(
        f"exposure: photographs of the same places differ in brightness by {spread:.2%}; {result}", highlight=False
    )
    return spread


def build_coarse_problem(
    capture: Capture,
    config: TrainConfig,
    images: ImageCache,
    device: torch.device | str,
    dense: DensePoints | None = None,
) -> tuple[TrainingProblem, Anchors]:
    """The problem of the coarse stage, and the anchors that it starts from: at the sparse and the `dense` points."""
    cameras = [view.camera for view in capture.train_views]
    # The voxel follows from the capture: recomputed when a run continues.
    anchors, voxel = initialize_anchors(
        capture.points, capture.point_colors, cameras, config.init, config.model.num_offsets, dense
    )
    background, max_pixels = (0.0, 0.0, 0.0), fit_levels(capture.points, cameras, config.model.levels)
    if config.loss.background != "black":
        smallest = max(factor for _, factor in config.resolution_schedule)
        background = mean_image_color(images, len(cameras), smallest)
    stage = TrainingProblem(
        config=config,
        images=images,
        num_images=len(cameras),
        voxel_size=voxel,
        max_pixels=max_pixels,
        camera_height=camera_height(capture),
        offset_rate_factor=offset_rate_factor(capture, config),
        background=background,
        view_weights=view_sampling_weights(config, anchors, cameras),
        sky_masks=_sky_masks(capture, config, images, background),
        device=torch.device(device),
        max_log_scale=(lambda positions: max_log_scales(positions, cameras)) if config.model.bound_scales else None,
        photograph_pixel=photograph_pixel(anchors.positions, cameras) if config.model.photograph_blur else 0.0,
    )
    return stage, add_coarser_levels(anchors, voxel, max_pixels) if max_pixels else anchors


def _sky_masks(
    capture: Capture, config: TrainConfig, images: ImageCache, background: tuple[float, float, float]
) -> tuple[SkyMask | None, ...] | None:
    """Those of the training photographs; None where no environment map is trained."""
    if config.model.background_model == "off":
        return None
    skylines, show_sky = view_skylines(capture, capture.train_views)
    if not show_sky and config.model.background_model != "envmap":
        return None
    return view_sky_masks(capture, images, config, skylines, None, background)


def initial_coarse_state(anchors: Anchors, stage: TrainingProblem, fit_exposures: bool) -> TrainingState:
    """The state before the first step, with or without exposures that are fitted."""
    config, generator = stage.config.model, torch.Generator().manual_seed(stage.config.seed)
    decoder = Decoder.init_random(
        config.num_offsets, config.view_distance, config.appearance_dim, stage.num_images, generator
    )
    if fit_exposures:
        decoder = replace(decoder, exposure=zero_exposures(stage.num_images))
    if stage.sky_masks is not None:
        skies = [None if mask is None else mask.sky_at for mask in stage.sky_masks]
        decoder = replace(decoder, envmap=photographed_envmap(stage.images, stage.config, skies, stage.background))
    return initial_state(anchors.to(stage.device), decoder.to(stage.device), stage)
