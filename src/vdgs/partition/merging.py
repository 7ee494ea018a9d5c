"""Merges trained blocks into one scene: every point of the plane takes its anchors from exactly one block.

No anchor is changed, averaged or added. Where the cameras of a block see nothing, its anchors stay the coarse ones.

Symbols: V_i, the number of cameras that hold anchor i in their frustum (section IV-B of the paper).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

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
from vdgs.partition.merge_checks import AnchorOrigins
from vdgs.system.quoting import shell_word
from vdgs.visibility.visibility_counts import count_visibility

#: The block [n] int64 that a scene has its anchors from at each of some points [n, 3].
BlockLookup = Callable[[Float[Tensor, "n 3"]], Int64[np.ndarray, " n"]]


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

    A trained model holds the anchors that its block was free to move: its own, and those of its ring unless frozen. The
    result holds, block after block, the anchors of each block at the points that the rule gives to it. With
    `allow_missing` the coarse anchors stand in for a block that is None. A model may be given by a function that loads
    it: then one block at a time is in memory. Memory: coarse and merged anchors, and half of the merged ones again.
    Blocks that trained one decoder together share it.

    Raises VdgsError for a missing block (unless allowed), for a model that says that it is of another block, for one
    that shows that it was not trained from `coarse`: by its grid, or by other bits of a frozen decoder; and for models
    of another cut, whose anchors would be lost (`AnchorOrigins`).
    """
    if not len(block_models) == len(cameras_of_block) == len(blocks):
        raise ValueError(
            f"{len(block_models)} models and {len(cameras_of_block)} camera lists for {len(blocks)} blocks"
        )
    missing = [index for index, model in enumerate(block_models) if model is None]
    if missing and not allow_missing:
        raise VdgsError(
            missing_message(missing) + "\nor merge with --allow-missing-blocks: there the coarse anchors stand in."
        )
    coarse_owner = blocks.owner(xy_positions(coarse.anchors.positions)) if missing else None
    selected, spans, records, own_decoder = [], [], [], False
    origins = AnchorOrigins(coarse.anchors.positions, blocks)
    for index, given in enumerate(block_models):
        model = given() if callable(given) else given
        if model is None:
            assert coarse_owner is not None
            anchors = coarse.anchors.select(torch.from_numpy(coarse_owner == index))
            origins.stand_in(anchors.positions)
            trained, kept = 0, 0
        else:
            _check_block_model(index, model, coarse)
            sources = block_of_points(model.anchors.positions, blocks, cameras_of_block, config, missing)
            anchors = model.anchors.select(torch.from_numpy(sources == index))
            origins.add(index, model.anchors.positions, sources == index)
            trained, kept = len(model.anchors), len(anchors)
            own_decoder = own_decoder or has_own_decoder(model)
        unseen = int((count_visibility(anchors.positions, cameras_of_block[index]) == 0).sum())
        # A copy: a tensor of a file keeps all of the file in memory.
        # Nor the environment map again, which is the same in all blocks.
        decoder = coarse.decoder if model is None else replace(model.decoder, envmap=None).copy()
        spans.append(DecoderSpan(len(anchors), decoder))
        selected.append(anchors.tensors())
        records.append(
            MergedBlockRecord(
                block=index, trained=trained, kept=kept, dropped=trained - kept,
                coarse_fallback=len(anchors) if model is None else 0, unseen=unseen,
            )
        )  # fmt: skip
    origins.check(config.rule)
    del origins
    merged = replace(coarse, anchors=_concatenate(selected))
    if config.reference_exposure == "global":
        merged = merged.without_local_exposure()
    if own_decoder and all(_decoder_bytes(each.decoder) == _decoder_bytes(spans[0].decoder) for each in spans):
        return replace(merged, decoder=replace(spans[0].decoder, envmap=coarse.decoder.envmap)), records
    return replace(merged, decoder_spans=tuple(spans) if own_decoder else ()), records


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
    """The block whose anchors stay at each point: a function of the point alone, so that blocks never overlap.

    `owner`: the owner. `max-visibility`: among the blocks that reach the point, the one whose cameras see it most; of
    equals the owner, else the first. A `missing` block keeps what it owns, and gets nothing more. O(n) memory.
    Cameras are counted only where more than one block reaches: elsewhere the owner stays.
    """
    points = xy_positions(positions)
    owner = blocks.owner(points)
    if config.rule == "owner":
        return owner
    source, open_to_others = owner.copy(), ~np.isin(owner, missing)
    reached_by = {
        index: np.flatnonzero(blocks.in_expanded(index, points, owner) & (owner != index) & open_to_others)
        for index in range(len(blocks))
        if index not in missing
    }
    contested = np.unique(np.concatenate([np.zeros(0, np.int64), *reached_by.values()]))
    most = np.full(len(points), -1, np.int64)
    # The owner is counted first and others must see strictly more: of equals it keeps the place.
    for index in np.unique(owner[contested]).tolist():
        rows = contested[owner[contested] == index]
        most[rows] = _visibility(positions, rows, cameras_of_block[index])
    for index, rows in reached_by.items():
        visibility = _visibility(positions, rows, cameras_of_block[index])
        better = visibility > most[rows]
        source[rows[better]], most[rows[better]] = index, visibility[better]
    return source


def _visibility(positions: Float[Tensor, "n 3"], rows: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """V_i of the given rows over these cameras."""
    return count_visibility(positions[torch.from_numpy(rows)], cameras).cpu().numpy()


def _concatenate(parts: Sequence[dict[str, Tensor]]) -> Anchors:
    """All anchors in one. Takes the tensors out of the parts: only those of one name are in memory twice."""
    return Anchors(**{name: torch.cat([part.pop(name) for part in parts]) for name in list(parts[0])})


def _check_block_model(index: int, model: AnchorModel, coarse: AnchorModel) -> None:
    """Where blocks leave the decoder as it is, other bits are another coarse model. A model may say its block."""
    if model.metadata.block not in (None, index):
        raise VdgsError(
            f"the model at place {index} is of block {model.metadata.block}: give the models in the order of the blocks"
        )
    same_decoder = has_own_decoder(model) or _decoder_bytes(model.decoder) == _decoder_bytes(coarse.decoder)
    same_offsets = model.anchors.offsets.shape[1] == coarse.anchors.offsets.shape[1]
    if not (same_decoder and same_offsets and model.voxel_size == coarse.voxel_size):
        raise VdgsError(
            f"block {index} was trained from another coarse model: its decoder or its grid differs. "
            f"Train it again: vdgs train-blocks RUN --block {index}"
        )


def _decoder_bytes(decoder: Decoder) -> dict[str, tuple[tuple[int, ...], bytes]]:
    return {name: (tuple(t.shape), t.detach().numpy().tobytes()) for name, t in decoder.tensors().items()}


def missing_message(missing: Sequence[int], run: str | Path = "RUN") -> str:
    """Which blocks are not trained, and the commands that train them."""
    which = f"block {missing[0]} is" if len(missing) == 1 else f"blocks {', '.join(map(str, missing))} are"
    commands = "".join(f"\n  vdgs train-blocks {shell_word(run)} --block {index}" for index in missing)
    return f"{which} not trained to the end. Train what is missing:{commands}"
