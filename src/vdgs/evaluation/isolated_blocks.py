"""The blocks of a run as they were trained, before the merge, to be measured beside the merged scene."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from vdgs.evaluation.block_seams import BlockInputs
from vdgs.evaluation.renderable_model import ReferenceViews
from vdgs.evaluation.view_exposures import make_exposures
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.renderer import render
from vdgs.partition.block_regions import split_trainable_anchors
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import OpenedRun, load_run_blocks
from vdgs.runs.run_folder import RunFolder

#: Blocks are held assembled among their surroundings up to so many bytes (at least one): views show them in turn.
CACHE_BYTES = 2_000_000_000


def make_block_inputs(opened: OpenedRun, coarse: OpenedRun, images: ReferenceViews) -> BlockInputs:
    """Where the pictures of a run's blocks come from; the merged model is the one that was opened."""
    run = opened.folder
    return BlockInputs(
        photographs=images,
        render_coarse=lambda camera: render(coarse.model, camera, depth=True),
        render_merged=lambda camera: render(opened.model, camera, depth=True),
        render_block=IsolatedBlocks(run, coarse.model).render,
        blocks=load_run_blocks(run),
        exposure=make_exposures(opened.model, opened.capture),
    )  # fmt: skip


class IsolatedBlocks:
    """Blocks as they were trained, before the merge: their own anchors among frozen coarse ones."""

    def __init__(self, run: RunFolder, coarse: AnchorModel):
        self._run, self._coarse = run, coarse
        blocks, config, key = load_run_blocks(run), run.method().block, run.keys().blocks
        self._key = key
        self._around = [
            split_trainable_anchors(coarse.anchors, blocks, index, config)[1] for index in range(len(blocks))
        ]
        self._done = [run.block(index).is_done(key) for index in range(len(blocks))]
        self._held: OrderedDict[int, AnchorModel] = OrderedDict()

    def render(self, index: int, camera: Camera) -> Raster | None:
        """The block's own picture; None if it was not trained (merged with --allow-missing-blocks)."""
        if not self._done[index]:
            return None
        if index not in self._held:
            self._held[index] = self.assemble(index)
            while len(self._held) > 1 and sum(_bytes(model) for model in self._held.values()) > CACHE_BYTES:
                self._held.popitem(last=False)
        self._held.move_to_end(index)
        return render(self._held[index], camera)

    def assemble(self, index: int) -> AnchorModel:
        """A block's own anchors and what stood around them in its training, each with its decoder."""
        own = load_verified(self._run.block(index), self._key, index).to(self._coarse.anchors.positions.device)
        around = self._coarse.anchors.select(self._around[index])
        parts = DecoderSpan(len(own.anchors), own.decoder), DecoderSpan(len(around), self._coarse.decoder)
        return replace(own, anchors=own.anchors.concat(around), decoder_spans=parts)


def _bytes(model: AnchorModel) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in model.anchors.tensors().values())
