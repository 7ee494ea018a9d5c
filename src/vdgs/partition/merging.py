"""Trained blocks become one scene: every place takes its anchors from exactly one block.

Merging is a selection by place: no anchor is changed, averaged or added. A block's training moves, grows and prunes
only what its cameras see; where they see nothing, its anchors are the coarse ones still, and so is the merged scene.

Symbols: V_i, the number of cameras that hold anchor i in their frustum (section IV-B of the paper).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.config.method import MergeConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel, DecoderSpan
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.partition.block_records import MergedBlockRecord
from vdgs.partition.blocks import Blocks, xy_positions
from vdgs.visibility.visibility_counts import count_visibility


def merge_blocks(
    coarse: AnchorModel,
    block_models: Sequence[AnchorModel | Callable[[], AnchorModel] | None],
    blocks: Blocks,
    cameras_of_block: Sequence[Sequence[Camera]],
    config: MergeConfig,
    *,
    allow_missing: bool = False,
) -> tuple[AnchorModel, list[MergedBlockRecord]]:
    """One model from the trained blocks, and what became of the anchors of each block.

    A trained model holds the anchors that its block was free to move: those that it owns, and those of its ring unless
    that was frozen. The result keeps, block after block and in their order, the anchors of each block at the places
    that the rule gives to it. With `allow_missing` the coarse anchors stand in at places whose owner is None.
    Memory: the coarse anchors, the merged ones, and half of those again while they are put together. Trained ones may
    be given by what opens them: one block at a time is then open.

    Raises VdgsError for a missing block (unless allowed), and for a block that shows that it was not trained from
    `coarse`: by its grid, or by other bits of a frozen decoder.
    """
    if not len(block_models) == len(cameras_of_block) == len(blocks):
        raise ValueError(
            f"{len(block_models)} models and {len(cameras_of_block)} camera lists for {len(blocks)} blocks"
        )
    missing = [index for index, model in enumerate(block_models) if model is None]
    if missing and not allow_missing:
        raise VdgsError(_missing_message(missing))
    coarse_owner = blocks.owner(xy_positions(coarse.anchors.positions)) if missing else None
    selected, pieces, became, own = [], [], [], False
    for index, given in enumerate(block_models):
        model = given() if callable(given) else given
        if model is None:
            assert coarse_owner is not None
            piece = coarse.anchors.select(torch.from_numpy(coarse_owner == index))
            trained_here, kept, from_coarse = 0, 0, len(piece)
        else:
            _check_coarse_model(index, model, coarse)
            givers = block_of_points(model.anchors.positions, blocks, cameras_of_block, config, missing)
            piece = model.anchors.select(torch.from_numpy(givers == index))
            trained_here, kept, from_coarse = len(model.anchors), len(piece), 0
            own = own or has_own_decoder(model)
        unseen = int((count_visibility(piece.positions, cameras_of_block[index]) == 0).sum())
        # A copy: a tensor of a file keeps all of the file in memory.
        pieces.append(DecoderSpan(len(piece), coarse.decoder if model is None else model.decoder.copy()))
        selected.append(piece.tensors())
        became.append(
            MergedBlockRecord(
                block=index,
                trained=trained_here,
                kept=kept,
                dropped=trained_here - kept,
                coarse_fallback=from_coarse,
                unseen=unseen,
            )
        )
    return replace(coarse, anchors=_concatenate(selected), decoder_spans=tuple(pieces) if own else ()), became


def has_own_decoder(model: AnchorModel) -> bool:
    """Whether a block moved the decoder too, rather than anchors alone."""
    return model.metadata.decoder == "own"


def block_of_points(
    positions: Float[Tensor, "n 3"],
    blocks: Blocks,
    cameras_of_block: Sequence[Sequence[Camera]],
    config: MergeConfig,
    missing: Sequence[int] = (),
) -> Int64[np.ndarray, " n"]:
    """The block whose anchors stay at each place: a function of the place alone, so that blocks never overlap.

    `owner`: the owner. `best_seen`: among the blocks that reach the place, the one whose cameras see it most; of equals
    the owner, else the first. What a `missing` block owns stays with it, and it is given nothing more.
    O(n) memory; `best_seen` costs a count of visibility for each block.
    """
    places = xy_positions(positions)
    owner = blocks.owner(places)
    if config.rule == "owner":
        return owner
    giver = owner.copy()
    most = np.full(len(places), -1, np.int64)
    # The owner is counted first and others must see strictly more: of equals it keeps the place.
    for index in range(len(blocks)):
        rows = np.flatnonzero(owner == index)
        most[rows] = _visibility(positions, rows, cameras_of_block[index])
    for index in (each for each in range(len(blocks)) if each not in missing):
        rows = np.flatnonzero(blocks.in_expanded(index, places, owner) & (owner != index) & ~np.isin(owner, missing))
        visibility = _visibility(positions, rows, cameras_of_block[index])
        better = visibility > most[rows]
        giver[rows[better]], most[rows[better]] = index, visibility[better]
    return giver


def _visibility(positions: Float[Tensor, "n 3"], rows: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """V_i of the given rows over these cameras."""
    return count_visibility(positions[torch.from_numpy(rows)], cameras).numpy()


def _concatenate(pieces: Sequence[dict[str, Tensor]]) -> Anchors:
    """One behind the other. Takes the tensors out of the pieces: only those of one name are in memory twice."""
    return Anchors(**{name: torch.cat([piece.pop(name) for piece in pieces]) for name in list(pieces[0])})


def _check_coarse_model(index: int, model: AnchorModel, coarse: AnchorModel) -> None:
    """Where blocks leave the decoder as it is, other bits are another coarse model."""
    same = has_own_decoder(model) or _decoder_bytes(model.decoder) == _decoder_bytes(coarse.decoder)
    if (
        not same
        or model.anchors.offsets.shape[1] != coarse.anchors.offsets.shape[1]
        or model.voxel_size != coarse.voxel_size
    ):
        raise VdgsError(
            f"block {index} was trained from another coarse model: its decoder or its grid differs. "
            f"Train it again: vdgs train-blocks RUN --block {index}"
        )


def _decoder_bytes(decoder: Decoder) -> dict[str, tuple[tuple[int, ...], bytes]]:
    return {name: (tuple(t.shape), t.detach().numpy().tobytes()) for name, t in decoder.tensors().items()}


def _missing_message(missing: Sequence[int]) -> str:
    which = f"block {missing[0]} is" if len(missing) == 1 else f"blocks {', '.join(map(str, missing))} are"
    commands = "".join(f"\n  vdgs train-blocks RUN --block {index}" for index in missing)
    return (
        f"{which} not trained to the end. Train what is missing:{commands}\n"
        "or merge with --allow-missing-blocks: there the coarse anchors stand in."
    )
