"""MixGS as a comparator: 3DGS, then mixed training; saved and measured like the method itself.

RUN/mixgs/  coarse/ (3DGS)  checkpoints/  log.jsonl  status.json  model.safetensors
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.baselines.evaluation import BaselineFacts, evaluate_baseline
from experiments.baselines.gs3d.run import train_gs3d
from experiments.baselines.gs3d.session import resume_or_start, train_with_checkpoints
from experiments.baselines.gs3d.training import Gs3dProblem, scene_extent
from experiments.baselines.mixgs.model import MixModel
from experiments.baselines.mixgs.settings import MixConfig
from experiments.baselines.mixgs.training import MixProblem, mixed_state, network_of, train_mixed
from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.config.executor_options import CheckpointOptions
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.training.session.trainer import image_cache_bytes


def run_mixgs(
    run: RunFolder,
    capture: Capture,
    config: MixConfig,
    console: Console,
    *,
    lpips_weights: Path | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Train (or continue) in RUN/mixgs and measure into RUN/evaluation.

    Raises what `train_gs3d` raises, and VdgsError where no coarse Gaussian is opaque enough.
    """
    folder = StageFolder(run.path / "mixgs")
    with run.locked():
        model = train_mixgs(capture, config, folder, console, device)
        write_json(run.capture_file, capture_metadata(capture))
    facts = BaselineFacts(
        name="mixgs", capture=model.metadata.get("capture", {}), trained=folder,
        num_gaussians=2 * len(model.gaussians),  # each with the one that is decoded beside it
    )  # fmt: skip
    return evaluate_baseline(model.to(device), facts, capture, run.evaluation, console, lpips_weights=lpips_weights)


def train_mixgs(
    capture: Capture, config: MixConfig, folder: StageFolder, console: Console, device: str = "cpu"
) -> MixModel:
    """The model of a capture, trained on a device; if it is finished, only read."""
    if folder.is_done():
        console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
        return MixModel.load(folder.model)
    before = StageFolder(folder.path / "coarse")
    before.path.mkdir(parents=True, exist_ok=True)
    coarse = train_gs3d(capture, config.coarse, before.path, console, device=device)
    with folder.locked():
        fresh, scene = mixed_state(coarse.gaussians, config)
        if not len(fresh.gaussians):
            raise VdgsError("MixGS: no coarse Gaussian is opaque enough to be kept. Give more iterations.")
        views = capture.train_views
        length = replace(config.coarse, iterations=config.iterations, resolution_schedule=((0, 1),))
        with ImageCache(views, image_cache_bytes(CheckpointOptions())) as images:
            extent = scene_extent([view.camera for view in views])
            base = Gs3dProblem(length, images, len(views), extent, coarse.background, full_degree=True)
            problem = MixProblem(base, config, scene)
            state = resume_or_start(folder, config.iterations, lambda: fresh, console, device)
            train_with_checkpoints(
                folder, state, base, CheckpointOptions(), console,
                loop=lambda state, _, **hooks: train_mixed(state, problem, **hooks),
            )  # fmt: skip
        metadata = {"capture": capture_metadata(capture), "version": __version__, "iterations": state.iteration}
        model = MixModel(
            gaussians=state.gaussians, offsets=state.extra["offsets"], network=network_of(state), scene=scene,
            background=coarse.background, metadata=metadata,
        )  # fmt: skip
        model.save(folder.model)
        first = before.status()
        status = StatusRecord(
            state="done", iteration=state.iteration + (first.iteration or 0),
            iterations=state.iteration + (first.iteration or 0), seconds=state.seconds + (first.seconds or 0.0),
            peak_memory_bytes=max(state.peak_memory_bytes, first.peak_memory_bytes or 0),
        )  # fmt: skip
        folder.set_status(status)
        console.print(f"mixed: {len(state.gaussians):,} Gaussians and as many decoded\nmodel: {folder.model}",
                      highlight=False)  # fmt: skip
        return model
