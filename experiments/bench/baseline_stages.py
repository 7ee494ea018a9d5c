"""Methods with a model and a training of their own, each as one stage of a run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.baselines.citygaussian.training import train_citygaussian
from experiments.baselines.dogs.training import train_dogs
from experiments.baselines.gaussian_blocks.training import BlockScene, GaussianBlocksConfig, train_scene
from experiments.baselines.gs2d.run import run_gs2d
from experiments.baselines.gs2d.surface import Gs2dConfig
from experiments.baselines.gs3d.run import evaluate_gs3d, gaussians_folder, run_gs3d
from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.training import Gs3dConfig
from experiments.baselines.hug.run import run_hug
from experiments.baselines.hug.settings import HugConfig, hug_config
from experiments.baselines.mixgs.run import run_mixgs
from experiments.baselines.mixgs.settings import MixConfig, mix_config
from experiments.baselines.octree_gs.run import run_octree
from experiments.baselines.octree_gs.settings import OctreeConfig, octree_config, scaffold_config
from experiments.baselines.vastgaussian.training import train_vastgaussian
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.validation import require_trainable
from vdgs.config.method import MethodConfig
from vdgs.config.serialization import to_dict
from vdgs.model.gaussians import Gaussians
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import write_json


@dataclass(frozen=True)
class BaselineStage:
    """A method that trains into RUN/NAME, whose status.json is that of a stage, and measures into RUN/evaluation.

    A method in blocks also leaves RUN/NAME/costs.json: any of `results.BLOCK_COSTS`.
    """

    #: Its settings, from those of the run: iterations, seed, number of blocks, limit of anchors.
    settings: Callable[[MethodConfig], Any]
    #: Called as run(run folder, capture, settings, console, lpips_weights=..., device=...).
    run: Callable[..., object]
    #: The folder in the run, if it is not that of the stage's name.
    folder: str = ""


def gs3d_config(method: MethodConfig) -> Gs3dConfig:
    """The settings of 3DGS that has the iterations, the seed and the background of a coarse stage, and as many
    Gaussians at most as that may decode from its anchors. Everything else is as published, its schedule in proportion
    to the iterations."""
    training = method.training
    most = training.densify.max_anchors * training.model.num_offsets
    published = Gs3dConfig(seed=training.seed, background=training.loss.background)
    return scale_schedule(training.iterations, published, most)


def _gs2d_config(method: MethodConfig) -> Gs2dConfig:
    return Gs2dConfig(**vars(gs3d_config(method)))


def _anchors(method: MethodConfig, settings: Callable[[int, int, int], OctreeConfig]) -> OctreeConfig:
    training = method.training
    return settings(training.iterations, training.seed, training.densify.max_anchors)


def _hug(method: MethodConfig) -> HugConfig:
    training = method.training
    return hug_config(training.iterations, _num_blocks(method), training.seed, training.densify.max_anchors)


def _mix(method: MethodConfig) -> MixConfig:
    training = method.training
    return mix_config(training.iterations, training.seed, training.densify.max_anchors * training.model.num_offsets)


def _num_blocks(method: MethodConfig) -> int:
    """Tables always say how many."""
    assert isinstance(method.partition.blocks, int)
    return method.partition.blocks


def gaussian_blocks_config(method: MethodConfig) -> GaussianBlocksConfig:
    """Blocks of explicit Gaussians: as many as those of anchors, of as many iterations each."""
    return GaussianBlocksConfig(
        blocks=_num_blocks(method), iterations=method.block.iterations, scene=gs3d_config(method),
        image_size=method.assignment.image_size,
    )  # fmt: skip


def _gaussian_blocks(name: str, train: Callable[[BlockScene], Gaussians]) -> BaselineStage:
    """A method of explicit Gaussians in blocks, in RUN/gaussians."""

    def run_blocks(
        run: RunFolder,
        capture: Capture,
        config: GaussianBlocksConfig,
        console: Console,
        *,
        lpips_weights: Path | None,
        device: str = "cpu",
    ) -> None:
        folder = gaussians_folder(run)
        with run.locked():
            require_trainable(capture, console)
            with folder.locked():
                model = train_scene(capture, config, folder, train, console, device=device).to(device)
            write_json(run.capture_file, capture_metadata(capture))
        evaluate_gs3d(model, capture, run.evaluation, console, lpips_weights=lpips_weights, trained=folder, method=name)

    return BaselineStage(gaussian_blocks_config, run_blocks, "gaussians")


#: By the name of the stage, which is that of its folder in the run.
BASELINES: dict[str, BaselineStage] = {
    "gaussians": BaselineStage(gs3d_config, run_gs3d),
    "gs2d": BaselineStage(_gs2d_config, run_gs2d, "gaussians"),
    "scaffold": BaselineStage(lambda method: _anchors(method, scaffold_config), run_octree),
    "hug": BaselineStage(_hug, run_hug),
    "octree": BaselineStage(lambda method: _anchors(method, octree_config), run_octree),
    "mixgs": BaselineStage(_mix, run_mixgs),
    "citygaussian": _gaussian_blocks("citygaussian", train_citygaussian),
    "vastgaussian": _gaussian_blocks("vastgaussian", train_vastgaussian),
    "dogs": _gaussian_blocks("dogs", train_dogs),
}


def baseline_folder(run: RunFolder, stages: tuple[str, ...]) -> StageFolder | None:
    """Where a run whose one stage is such a method keeps its model; None for other runs."""
    baseline = BASELINES.get(stages[0]) if stages else None
    return StageFolder(run.path / (baseline.folder or stages[0])) if baseline else None


def train_baseline(
    name: str, run: RunFolder, capture: Capture, lpips_weights: Path | None, console: Console, device: str = "cpu"
) -> None:
    """Train, or continue, such a method for the settings of a run on a device, and measure it there. What was trained
    for other settings or on another choice of photographs goes first (that it may go was asked before:
    `RunFolder.change_settings`).

    Raises what its `run` raises.
    """
    baseline = BASELINES[name]
    config = baseline.settings(run.method())
    made_for = json.dumps([name, run.keys().coarse, to_dict(config)], sort_keys=True)
    folder = baseline_folder(run, (name,))
    assert folder is not None
    with run.locked():
        folder.reset_unless(hashlib.sha256(made_for.encode()).hexdigest()[:16])
    baseline.run(run, capture, config, console, lpips_weights=lpips_weights, device=device)
