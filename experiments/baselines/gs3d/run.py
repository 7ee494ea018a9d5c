"""3DGS (Kerbl et al. 2023) as a comparator: trained, saved and measured like the method itself.

Written from the paper's description, on this project's kernels, captures and evaluation: what differs between two
figures is the method. The constants that the paper leaves open are those of the authors' published program. Left out
or different:

- pruning by footprint in the image (section 5.2); the prune by size in the world is there;
- training stops at the iteration given: rates decay over that length; intervals (degree, decisions, resets) are
  those of the settings, which `schedule.scale_schedule` gives for another length than the published one;
- views come in a new random order every epoch that is drawn from the seed, not from a running generator;
- image formation is that of this project (docs/conventions.md): alpha at most 0.999, near plane at 0.01, extent by
  opacity, exact gradients;
- no exposure compensation, depth regularisation or anti-aliasing: later additions to the program, not in the paper.

    OUTPUT/checkpoints/  log.jsonl  status.json  settings.json  model.safetensors
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from experiments.baselines.evaluation import BaselineFacts, evaluate_baseline
from experiments.baselines.gs3d.model import GaussianModel
from experiments.baselines.gs3d.session import (
    finish_training,
    resume_or_start,
    state_from_points,
    train_with_checkpoints,
)
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dProblem, scene_extent
from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata, check_same_capture
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.validation import require_trainable
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.serialization import diff_settings, to_dict
from vdgs.errors import RunError, VdgsError
from vdgs.evaluation.renderable_model import EvaluationSettings
from vdgs.geometry.camera import Camera
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import read_json, write_json
from vdgs.training import mean_image_color
from vdgs.training.session.trainer import image_cache_bytes

#: What metrics.json calls this method.
METHOD_NAME = "3dgs"

VisibilityMap = Callable[[Camera], Float[np.ndarray, "h w"]]


def gaussians_folder(run: RunFolder) -> StageFolder:
    """Where 3DGS keeps its model, in runs that have it in place of all other stages."""
    return StageFolder(run.path / "gaussians")


def run_gs3d(
    run: RunFolder,
    capture: Capture,
    config: Gs3dConfig,
    console: Console,
    *,
    options: CheckpointOptions | None = None,
    visibility_map: VisibilityMap | None = None,
    lpips_weights: Path | None = None,
    device: str = "cpu",
    method: str = METHOD_NAME,
    adapt: Callable[[Gs3dProblem], Gs3dProblem] | None = None,
) -> dict[str, Any]:
    """Train (or continue) in RUN/gaussians and measure into RUN/evaluation. Returns what metrics.json holds. `method`
    is the name of a method that adds to 3DGS what `adapt` does.

    Raises what `train_gs3d` and `evaluate_gs3d` raise.
    """
    folder = gaussians_folder(run)
    with run.locked():
        model = train_gs3d(
            capture, config, folder.path, console, options=options, device=device, method=method, adapt=adapt
        )
        write_json(run.capture_file, capture_metadata(capture))
    return evaluate_gs3d(
        model.to(device), capture, run.evaluation, console,
        visibility_map=visibility_map, lpips_weights=lpips_weights, trained=folder, method=method,
    )  # fmt: skip


def train_gs3d(
    capture: Capture,
    config: Gs3dConfig,
    output: Path,
    console: Console,
    *,
    options: CheckpointOptions | None = None,
    device: str = "cpu",
    method: str = METHOD_NAME,
    adapt: Callable[[Gs3dProblem], Gs3dProblem] | None = None,
) -> GaussianModel:
    """Train, or continue, 3DGS on the training views of a capture, on a device; if it is finished, only read the model,
    which is in main memory in any case.

    Raises VdgsError for settings that do not work, RunError where `output` holds another run, CaptureError for a
    capture that cannot become a scene or damaged photographs, Stopped after Ctrl-C or SIGTERM (state saved),
    TrainingDiverged (last good state kept).
    """
    options, folder = options or CheckpointOptions(), StageFolder(output)
    options.check()
    _check(config)
    with folder.locked():
        _begin(folder, capture, config, method)
        if folder.is_done():
            console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
            return GaussianModel.load(folder.model)
        require_trainable(capture, console)
        views = capture.train_views
        factors = tuple(sorted({factor for _, factor in config.resolution_schedule}))
        with ImageCache(views, image_cache_bytes(options), downscales=factors) as images:
            extent, background = scene_extent([view.camera for view in views]), (0.0, 0.0, 0.0)
            if config.background == "mean":
                background = mean_image_color(images, len(views), factors[-1])
            stage = Gs3dProblem(config, images, len(views), extent, background)
            stage = stage if adapt is None else adapt(stage)
            start = lambda: state_from_points(capture, config)  # noqa: E731
            state = resume_or_start(folder, config.iterations, start, console, device)
            train_with_checkpoints(folder, state, stage, options, console)
        metadata = {"capture": capture_metadata(capture), "version": __version__, "iterations": state.iteration}
        model = GaussianModel(state.gaussians.to("cpu"), stage.background, metadata)
        finish_training(folder, state, model, console)
        return model


def evaluate_gs3d(
    model: GaussianModel,
    capture: Capture,
    output: Path,
    console: Console | None = None,
    *,
    visibility_map: VisibilityMap | None = None,
    lpips_weights: Path | None = None,
    trained: StageFolder | None = None,
    settings: EvaluationSettings | None = None,
    method: str = METHOD_NAME,
) -> dict[str, Any]:
    """Measure a model on the test views, on its device; writes the evaluation folder `output` and returns what
    metrics.json holds.

    `visibility_map(camera)` is V per pixel, drawn with one model for all methods that are compared; without it there
    are no figures by visibility. `trained` is where the model was trained, for its size, time and memory. Raises
    RunError without test views or for another capture than the model's.
    """
    facts = BaselineFacts(
        name=method, capture=model.metadata.get("capture", {}), trained=trained, num_gaussians=len(model.gaussians)
    )
    return evaluate_baseline(
        model, facts, capture, output, console,
        lpips_weights=lpips_weights, settings=settings, visibility_map=visibility_map,
    )  # fmt: skip


def _check(config: Gs3dConfig) -> None:
    """Raise VdgsError for settings that do not work."""
    starts = [start for start, _ in config.resolution_schedule]
    problems = {
        "iterations must be at least 1": config.iterations >= 1,
        f"degree must be from 0 to {MAX_SH_DEGREE}": 0 <= config.degree <= MAX_SH_DEGREE,
        "degree_interval, density.interval and density.reset_interval must be at least 1": min(
            config.degree_interval, config.density.interval, config.density.reset_interval
        )
        >= 1,
        "initial_opacity and density.reset_opacity must lie between 0 and 1": all(
            0 < value < 1 for value in (config.initial_opacity, config.density.reset_opacity)
        ),
        "resolution_schedule must begin at iteration 0 and ascend": bool(starts)
        and starts[0] == 0
        and starts == sorted(starts),
        "background must be black or mean": config.background in ("black", "mean"),
        "factors of resolution_schedule must be at least 1": all(
            factor >= 1 for _, factor in config.resolution_schedule
        ),
    }
    wrong = [problem for problem, holds in problems.items() if not holds]
    if wrong:
        raise VdgsError("These settings of 3DGS do not work:\n  " + "\n  ".join(wrong))


def _begin(folder: StageFolder, capture: Capture, config: Gs3dConfig, method: str) -> None:
    """Note settings and capture of a new run, or refuse others than those of the run that is there."""
    file = folder.path / "settings.json"
    if not file.exists():
        write_json(file, {"method": method, "settings": to_dict(config), "capture": capture_metadata(capture)})
        return
    known = read_json(file)
    if not isinstance(known, dict) or known.get("method") != method or not isinstance(known.get("settings"), dict):
        raise RunError(f"{file}: is damaged or of another method. Choose another output folder.")
    check_same_capture(file, known.get("capture") or {}, capture)
    changed = diff_settings(known["settings"], to_dict(config))
    if changed:
        raise RunError(
            f"{file}: this run was started with other settings:\n  " + "\n  ".join(changed)
            + "\nGive the old settings to continue it, or another output folder."
        )  # fmt: skip
