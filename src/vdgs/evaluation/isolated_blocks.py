"""The blocks of a run as they were trained, before the merge, to be measured beside the merged scene."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

from vdgs.evaluation.block_seams import BlockInputs
from vdgs.evaluation.renderable_model import ReferenceViews
from vdgs.evaluation.view_exposures import exposures_of
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel, Part
from vdgs.model.renderer import render
from vdgs.partition.block_regions import split_anchors
from vdgs.runs.model_integrity import load_vouched
from vdgs.runs.open_run import TrainedRun, blocks_of
from vdgs.runs.run_folder import RunFolder

#: Blocks are held assembled among their surroundings up to so many bytes (at least one): views show them in turn.
HELD_BYTES = 2_000_000_000


def block_inputs(opened: TrainedRun, coarse: TrainedRun, photographs: ReferenceViews) -> BlockInputs:
    """Where the pictures of a run's blocks come from; the merged model is the one that was opened."""
    run = opened.folder
    return BlockInputs(
        photographs=photographs,
        render_coarse=lambda camera: render(coarse.model, camera, depth=True),
        render_merged=lambda camera: render(opened.model, camera, depth=True),
        render_block=BlocksAlone(run, coarse.model).render,
        blocks=blocks_of(run),
        exposure=exposures_of(opened.model, opened.capture),
    )  # fmt: skip


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
