"""Measuring a run: its test views, and for a merged scene also its blocks and their seams."""

from __future__ import annotations

import shutil
import time
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from vdgs.cameras import Camera
from vdgs.evaluation.of_run import Views, cached_photographs, evaluate_run, evaluation_folder
from vdgs.evaluation.seams import block_table, evaluate_blocks
from vdgs.kernels.types import Raster
from vdgs.memory.process import forget_peak, peak_memory_bytes
from vdgs.model.anchor_model import AnchorModel, Part
from vdgs.model.render import render
from vdgs.partition.regions import split_anchors
from vdgs.runs.cut import blocks_of
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.runs.vouching import load_vouched
from vdgs.settings.requests import ModelName
from vdgs.storage.files import read_record, write_json

#: Blocks are held assembled among their surroundings up to so many bytes (at least one): views show them in turn.
HELD_BYTES = 2_000_000_000


def evaluate_stage(
    path: Path,
    which: ModelName,
    lpips_weights: Path | None,
    bins: int,
    console: Console,
    views: Views = "test",
    device: str = "cpu",
) -> None:
    """Measure a model of a run; of the merged one, on test views, also block by block and at the seams."""
    opened = open_run(path, which, device)
    output = evaluation_folder(opened.folder, opened.name, views)
    if opened.caution:
        console.print(f"[yellow]warning[/] {opened.caution}", highlight=False)
    of_views = opened.capture.test_views if views == "test" else opened.capture.train_views
    console.print(f"measuring the {opened.line} on {len(of_views)} {views} views", highlight=False)
    _forget(output)
    forget_peak()
    began = time.monotonic()
    evaluate_run(opened, lpips_weights, bins, console, views)
    if views == "test" and opened.name == "merged" and len(blocks_of(opened.folder)) > 1:
        console.print(block_table(_evaluate_blocks(opened)))
    record = _record_of(opened.folder, opened.name, lpips_weights, bins)
    write_json(
        output / "status.json",
        record | {"seconds": time.monotonic() - began, "peak_memory_bytes": peak_memory_bytes()},
    )  # fmt: skip


def is_measured(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> bool:
    """Whether the figures that are there are those of the model that is there, measured in this way."""
    wanted = _record_of(run, name, lpips_weights, bins)
    wanted.pop("key")  # the model says it; older figures do not mention it
    record = read_record(evaluation_folder(run, name) / "status.json")
    return {key: record.get(key) for key in wanted} == wanted


def _record_of(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> dict[str, Any]:
    stage = run.merged if name == "merged" else run.coarse
    keys = run.keys()
    key = keys.merge if name == "merged" else keys.coarse
    return {"key": key, "model": stage.status().model, "lpips_weights": str(lpips_weights), "bins": bins}


def _forget(output: Path) -> None:
    """Delete what vouches for figures that are about to change, and what another cut may have left."""
    for stale in ("status.json", "metrics.json", "by_block.json"):
        (output / stale).unlink(missing_ok=True)
    shutil.rmtree(output / "seams", ignore_errors=True)


def _evaluate_blocks(opened: TrainedRun) -> dict[str, Any]:
    run = opened.folder
    coarse, blocks = AnchorModel.load(run.coarse.model).to(opened.device), blocks_of(run)
    alone = BlocksAlone(run, coarse)
    with cached_photographs(opened.capture.test_views) as photographs:
        return evaluate_blocks(
            photographs,
            render_coarse=lambda camera: render(coarse, camera, depth=True),
            render_merged=lambda camera: render(opened.model, camera, depth=True),
            render_block=alone.render,
            blocks=blocks,
            output=run.evaluation,
        )


class BlocksAlone:
    """Blocks as they were trained, before the merge: their own anchors among frozen coarse ones."""

    def __init__(self, run: RunFolder, coarse: AnchorModel):
        self._run, self._coarse = run, coarse
        blocks, config, key = blocks_of(run), run.method().block, run.keys().blocks
        self._key = key
        self._around = [split_anchors(coarse.anchors, blocks, index, config)[1] for index in range(len(blocks))]
        self._done = [run.block(index).is_done(key) for index in range(len(blocks))]
        self._held: OrderedDict[int, AnchorModel] = OrderedDict()

    def render(self, index: int, camera: Camera) -> Raster | None:
        """The block's own picture; None if it was not trained (merged with --incomplete)."""
        if not self._done[index]:
            return None
        if index not in self._held:
            self._held[index] = self.assembled(index)
            while len(self._held) > 1 and sum(_bytes(model) for model in self._held.values()) > HELD_BYTES:
                self._held.popitem(last=False)
        self._held.move_to_end(index)
        return render(self._held[index], camera)

    def assembled(self, index: int) -> AnchorModel:
        """A block's own anchors and what stood around them in its training, each with its decoder."""
        own = load_vouched(self._run.block(index), self._key, index).to(self._coarse.anchors.positions.device)
        around = self._coarse.anchors.select(self._around[index])
        parts = Part(len(own.anchors), own.decoder), Part(len(around), self._coarse.decoder)
        return replace(own, anchors=own.anchors.extended(around), parts=parts)


def _bytes(model: AnchorModel) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in model.anchors.tensors().values())
