"""A run that still trains: its last saved model, put together from what every block has so far, and how far it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from vdgs.config.commands import ModelName
from vdgs.errors import RunError, VdgsError
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.scale_bounds import photograph_pixel
from vdgs.partition.merging import merge_blocks
from vdgs.runs.lod_folder import has_lod
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import (
    OpenedRun,
    all_block_cameras,
    load_run_blocks,
    locate_model,
    open_capture,
    open_mapped,
    open_run,
    with_capture,
)
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import get_run_status
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.checkpoints import sidecars
from vdgs.system.quoting import shell_word
from vdgs.training.session.trainer import model_from_checkpoint

#: What a model is called that no stage has finished yet.
UNFINISHED_MODEL = "training"


def open_run_or_checkpoint(path: Path, which: ModelName = "best", device: str = "cpu") -> OpenedRun:
    """A run with its finished model or, of `best`, with what its training has saved last where that is further.

    Raises RunError where nothing is saved yet, and what `open_run` raises.
    """
    run = RunFolder(path)
    if which != "best":
        return open_run(path, which, device)
    keys = run.keys()
    if run.merged.is_done(keys.merge):
        location = locate_model(run, "merged")
        if device == "cpu" and has_lod(run, location):
            return with_capture(open_mapped(run, location), open_capture(run))
        return open_run(path, "merged", device)
    if run.coarse.is_done(keys.coarse):
        coarse = open_run(path, "coarse", device)
        return _with_trained_blocks(coarse) or coarse
    return _coarse_from_checkpoint(run, device)


def run_status_markdown(run: RunFolder) -> str:
    """How far every stage and block is, in Markdown."""
    from vdgs.report.status_cli import (  # brings what draws charts: not before the first picture
        next_line,
        progress_text,
    )

    standing = get_run_status(run)
    lines = [
        f"**{stage.name}** {stage.state}" + (f": {progress_text(stage.status)}" if progress_text(stage.status) else "")
        for stage in standing.stages
    ]
    return "\n\n".join([*lines, next_line(standing)])


def run_file_times(run: RunFolder) -> tuple[tuple[str, int], ...]:
    """What tells the present models and checkpoints of a run from later ones: files, and when they were written."""
    trained = [run.coarse, *run.block_folders()]
    files = [folder.model for folder in (*trained, run.merged)]
    files += [file for folder in trained for file in sidecars(folder.checkpoints)]
    files += [run.partition / "blocks.geojson", run.merged.status_file, run.coarse.status_file]
    found = []
    for file in files:
        try:
            found.append((file.relative_to(run.path).as_posix(), file.stat().st_mtime_ns))
        except OSError:  # not there, or replaced while we look
            continue
    return tuple(sorted(found))


def _coarse_from_checkpoint(run: RunFolder, device: str) -> OpenedRun:
    """The coarse model as its training saved it last."""
    key = run.keys().coarse
    saved = model_from_checkpoint(run.coarse, key)
    if saved is None:
        raise RunError(
            f"{run.path}: has no model and no checkpoint yet. Wait for the first one, or look how far it is: "
            f"vdgs status {shell_word(run.path)}"
        )
    capture = open_capture(run)
    colors = capture.point_colors.mean(axis=0) / 255 if len(capture.points) else np.zeros(3)
    background = (float(colors[0]), float(colors[1]), float(colors[2]))
    config, cameras = run.method().training.model, [view.camera for view in capture.train_views]
    pixel = photograph_pixel(saved.anchors.positions, cameras) if config.photograph_blur else 0.0
    model = AnchorModel(
        anchors=saved.anchors, decoder=saved.decoder, voxel_size=1.0, background=background, photograph_pixel=pixel
    ).to(torch.device(device))
    why = f"this is the coarse model after {saved.iteration:,} iterations; its background is not known yet"
    return OpenedRun(
        folder=run, model=model, model_path=saved.file, name=UNFINISHED_MODEL, status=run.coarse.status(), key=key,
        warning=why, capture=capture,
    )  # fmt: skip


def _with_trained_blocks(coarse: OpenedRun) -> OpenedRun | None:
    """The coarse model with the anchors of every block that has saved some; None where none has."""
    run, keys = coarse.folder, coarse.folder.keys()
    try:
        blocks = load_run_blocks(run)
    except VdgsError:
        return None
    own = run.method().block.decoder != "frozen"
    trained: list[AnchorModel | None] = []
    for index in range(len(blocks)):
        trained.append(_load_block_so_far(coarse, run.block(index), keys.blocks, index, own))
    if not any(trained):
        return None
    cameras = all_block_cameras(run, coarse.capture)
    model = coarse.model.to(torch.device("cpu"))
    merged, _ = merge_blocks(model, trained, blocks, cameras, run.method().merge, allow_missing=True)
    missing = tuple(index for index, each in enumerate(trained) if each is None)
    shown = len(trained) - len(missing)
    why = f"this is the scene as {shown} of {len(blocks)} blocks have it so far; elsewhere it is the coarse model"
    model = merged.to(coarse.device)
    return replace(coarse, model=model, name=UNFINISHED_MODEL, warning=why, missing_blocks=missing)


def _load_block_so_far(
    coarse: OpenedRun, folder: StageFolder, key: str, index: int, own_decoder: bool
) -> AnchorModel | None:
    try:
        if folder.is_done(key):
            return load_verified(folder, key, index)
        saved = model_from_checkpoint(folder, key)
    except VdgsError:
        return None
    if saved is None:
        return None
    metadata = ModelMetadata(decoder="own" if own_decoder else None)
    return replace(coarse.model, anchors=saved.anchors, decoder=saved.decoder, metadata=metadata)
