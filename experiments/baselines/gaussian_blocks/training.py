"""Blocks of explicit Gaussians, trained one after the other, each as 3DGS is.

FOLDER/cut.json  blocks.geojson  coarse/  blocks/00/  blocks/01/  ...  model.safetensors  status.json
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from experiments.baselines.gaussian_blocks.cut import GaussianCut, load_or_cut
from experiments.baselines.gs3d.model import GaussianModel
from experiments.baselines.gs3d.schedule import scale_schedule
from experiments.baselines.gs3d.session import finish_training, resume_or_start, train_with_checkpoints
from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dProblem, Gs3dState, scene_extent
from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.config.executor_options import CheckpointOptions
from vdgs.geometry.camera import Camera
from vdgs.model.gaussians import Gaussians
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.training import TrainingImages, mean_image_color
from vdgs.training.session.trainer import image_cache_bytes


@dataclass(frozen=True, kw_only=True)
class GaussianBlocksConfig:
    """What the methods are given alike."""

    blocks: int
    """Into how many the scene is cut."""
    iterations: int
    """Of each block."""
    scene: Gs3dConfig
    """Seed, background, and the limit of Gaussians of the whole scene; iterations and schedule of a coarse stage."""
    image_size: int = 320
    """Cameras are chosen by pictures of this size, where they are chosen by pictures."""


@dataclass(frozen=True)
class ViewSubset:
    """Some of the training images, numbered anew."""

    images: TrainingImages
    views: Sequence[int]

    def get(self, index: int, downscale: int = 1) -> tuple[Tensor, Tensor | None]:
        return self.images.get(self.views[index], downscale)

    def camera(self, index: int, downscale: int = 1) -> Camera:
        return self.images.camera(self.views[index], downscale)

    def prefetch(self, indices: Sequence[int], downscale: int = 1) -> None:
        self.images.prefetch([self.views[index] for index in indices], downscale)


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockScene:
    """A scene that is being trained in blocks."""

    capture: Capture
    config: GaussianBlocksConfig
    images: TrainingImages
    background: tuple[float, float, float]
    folder: StageFolder
    options: CheckpointOptions
    console: Console
    #: Where blocks are trained; what is kept of them is in main memory.
    device: str = "cpu"

    @property
    def cameras(self) -> list[Camera]:
        return [view.camera for view in self.capture.train_views]

    def block_folder(self, index: int) -> StageFolder:
        return StageFolder(self.folder.path / "blocks" / f"{index:02d}")

    def cut(self, make: Callable[[], GaussianCut]) -> GaussianCut:
        """The blocks, found now or before; says how many cameras each has."""
        cut = load_or_cut(self.folder.path, make)
        for warning in cut.warnings:
            self.console.print(f"[yellow]note[/] {warning}", highlight=False)
        counts = ", ".join(str(len(views)) for views in cut.views)
        self.console.print(f"{len(cut.blocks)} blocks with {counts} of {len(self.cameras)} cameras", highlight=False)
        return cut

    def block_config(self, own: int, total: int, held: int) -> Gs3dConfig:
        """3DGS for one block that owns `own` of `total` Gaussians at the start and holds `held`. It may grow by its
        share of the scene's limit."""
        scene, most = self.config.scene, self.config.scene.density.max_gaussians
        limit = max(1, most * own // max(total, 1)) + held - own if most else 0
        plain = Gs3dConfig(seed=scene.seed, background=scene.background)
        return scale_schedule(self.config.iterations, plain, limit)

    def problem(self, views: Sequence[int], config: Gs3dConfig) -> Gs3dProblem:
        """What a block with these views trains on. Its extent is that of its own cameras, as in the programs of the
        methods; one camera has none: the scene's then."""
        used = [self.cameras[view] for view in (views if len(views) > 1 else range(len(self.cameras)))]
        return Gs3dProblem(config, ViewSubset(self.images, views), len(views), scene_extent(used), self.background)

    def train(self, index: int, problem: Gs3dProblem, start: Callable[[], Gs3dState]) -> Gaussians:
        """One block to the end, or what is there of it. Raises what `run_session` raises."""
        folder = self.block_folder(index)
        if folder.is_done():
            return GaussianModel.load(folder.model).gaussians
        self.console.print(
            f"block {index}: {problem.image_count} training views, {problem.end:,} iterations", highlight=False
        )
        state = resume_or_start(folder, problem.end, start, self.console, self.device)
        train_with_checkpoints(folder, state, problem, self.options, self.console)
        trained = state.gaussians.to("cpu")
        finish_training(folder, state, self.model(trained), self.console)
        return trained

    def keep(self, index: int, gaussians: Gaussians, reason: str) -> Gaussians:
        """A block that cannot be trained stays as it is."""
        folder = self.block_folder(index)
        self.model(gaussians).save(folder.model)
        folder.set_status(StatusRecord(state="done", iteration=0, iterations=0, seconds=0.0, reason=reason))
        self.console.print(f"[yellow]note[/] block {index} is not trained: {reason}", highlight=False)
        return gaussians

    def model(self, gaussians: Gaussians) -> GaussianModel:
        metadata = {"capture": capture_metadata(self.capture), "version": __version__}
        return GaussianModel(gaussians, self.background, metadata)


def train_scene(
    capture: Capture,
    config: GaussianBlocksConfig,
    folder: StageFolder,
    method: Callable[[BlockScene], Gaussians],
    console: Console,
    options: CheckpointOptions | None = None,
    device: str = "cpu",
) -> GaussianModel:
    """Train, or continue, a scene by a method, on a device; if it is finished, only read the model."""
    if folder.is_done():
        console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
        return GaussianModel.load(folder.model)
    options, views = options or CheckpointOptions(), capture.train_views
    factors = tuple(sorted({factor for _, factor in config.scene.resolution_schedule}))
    with ExitStack() as opened:
        images = opened.enter_context(ImageCache(views, image_cache_bytes(options), downscales=factors))
        background = (0.0, 0.0, 0.0)
        if config.scene.background == "mean":
            background = mean_image_color(images, len(views), factors[-1])
        scene = BlockScene(
            capture=capture, config=config, images=images, background=background, folder=folder, options=options,
            console=console, device=device,
        )  # fmt: skip
        model = scene.model(method(scene))
    model.save(folder.model)
    folder.set_status(_sum([*block_statuses(folder.path), StageFolder(folder.path / "coarse").status()]))
    console.print(f"merged: {len(model.gaussians):,} Gaussians\nmodel: {folder.model}", highlight=False)
    return model


def block_statuses(folder: Path) -> list[StatusRecord]:
    """Where the blocks stand, in order."""
    return [StageFolder(path).status() for path in sorted((folder / "blocks").glob("[0-9]*"))]


def _sum(stages: Sequence[StatusRecord]) -> StatusRecord:
    """All stages as one."""
    steps = sum(each.iteration or 0 for each in stages)
    return StatusRecord(
        state="done", iteration=steps, iterations=steps, seconds=sum(each.seconds or 0.0 for each in stages),
        peak_memory_bytes=max(each.peak_memory_bytes or 0 for each in stages),
    )  # fmt: skip


def copies(gaussians: Gaussians) -> Gaussians:
    """The Gaussians in tensors of their own."""
    return gaussians.select(torch.arange(len(gaussians)))
