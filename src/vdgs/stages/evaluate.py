"""Measuring a run: its test views, and for a merged scene also its blocks and their seams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from vdgs.anchors import AnchorModel
from vdgs.cameras import Camera
from vdgs.captures.capture import View
from vdgs.captures.images import ImageCache
from vdgs.evaluation.of_run import EVALUATION_IMAGES_BYTES, evaluate_run
from vdgs.evaluation.seams import block_table, evaluate_blocks
from vdgs.kernels.types import Raster
from vdgs.render import render
from vdgs.run import RunFolder
from vdgs.stages.block import blocks_of, split_anchors
from vdgs.stages.opening import ModelName, TrainedRun


def evaluate_stage(path: Path, which: ModelName, lpips_weights: Path | None, bins: int, console: Console) -> None:
    """Measure a model of a run; of the merged one also block by block and at the seams."""
    opened = evaluate_run(path, lpips_weights, bins, console, which)
    if opened.name == "merged" and len(blocks_of(opened.folder)) > 1:
        console.print(block_table(_evaluate_blocks(opened)))


def _evaluate_blocks(opened: TrainedRun) -> dict[str, Any]:
    run, views = opened.folder, opened.capture.test_views
    coarse, blocks = AnchorModel.load(run.coarse.model), blocks_of(run)
    alone = _BlocksAlone(run, coarse)
    index = {view.name: i for i, view in enumerate(views)}
    with ImageCache(views, EVALUATION_IMAGES_BYTES) as images:

        def load_mask(view: View) -> np.ndarray | None:
            mask = images.get(index[view.name]).mask
            return None if mask is None else mask.numpy() > 0

        return evaluate_blocks(
            views,
            load_image=lambda view: images.get(index[view.name]).image.numpy(),
            load_mask=load_mask,
            render_coarse=lambda camera: render(coarse, camera, depth=True),
            render_merged=lambda camera: render(opened.model, camera, depth=True),
            render_block=alone.render,
            blocks=blocks,
            output=run.evaluation,
        )


class _BlocksAlone:
    """Blocks as they were trained, before the merge: their own anchors among frozen coarse ones. One in memory."""

    def __init__(self, run: RunFolder, coarse: AnchorModel):
        self._run, self._coarse = run, coarse
        self._blocks, self._config = blocks_of(run), run.method().block
        self._held: tuple[int, AnchorModel] | None = None

    def render(self, index: int, camera: Camera) -> Raster | None:
        if not self._run.block(index).is_done(self._run.keys().blocks):  # merged with --incomplete
            return None
        if self._held is None or self._held[0] != index:
            self._held = (index, self._assemble(index))
        return render(self._held[1], camera)

    def _assemble(self, index: int) -> AnchorModel:
        own = AnchorModel.load(self._run.block(index).model)
        _, around = split_anchors(self._coarse.anchors, self._blocks, index, self._config)
        return replace(own, anchors=own.anchors.extended(self._coarse.anchors.select(around)))
