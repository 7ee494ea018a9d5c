"""Which block a model has its anchors from at a point."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from support.hand_made_models import camera_above, capture_at, model_at, quadrants
from vdgs.config.method import MergeConfig
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.blocks import xy_positions
from vdgs.partition.merging import merge_blocks
from vdgs.runs import open_run
from vdgs.runs.open_run import ModelLocation, OpenedRun, block_lookup
from vdgs.runs.stage_folder import StatusRecord

BLOCKS = quadrants()
CAMERAS = [[camera_above(x, y, 5.0)] * count for x, y, count in ((-2, -2, 1), (-2, 2, 3), (2, -2, 1), (2, 2, 4))]


def merged_of(config: MergeConfig, missing: tuple[int, ...]) -> tuple[AnchorModel, np.ndarray]:
    """A merged scene of free margins, and the block that each of its anchors is from."""
    places = np.random.default_rng(0).uniform([-4, -4, -0.5], [4, 4, 0.5], (600, 3))
    coarse = model_at(places)
    keep = [torch.from_numpy(BLOCKS.in_expanded(index, xy_positions(coarse.anchors.positions))) for index in range(4)]
    trained: list[AnchorModel | None] = [replace(coarse, anchors=coarse.anchors.select(each)) for each in keep]
    for index in missing:
        trained[index] = None
    merged, records = merge_blocks(coarse, trained, BLOCKS, CAMERAS, config, allow_missing=True)
    return merged, np.repeat(np.arange(4), [each.kept + each.coarse_fallback for each in records])


@pytest.mark.parametrize("rule", ["owner", "max-visibility"])
@pytest.mark.parametrize("missing", [(), (3,)])
def test_each_merged_anchor_is_found_in_the_block_that_gave_it(rule, missing, monkeypatch):
    config = MergeConfig(rule=rule)
    monkeypatch.setattr(open_run, "all_block_cameras", lambda run, capture: CAMERAS)
    status = StatusRecord(state="done", block_models=tuple(None if i in missing else f"{i}" for i in range(4)))
    stage: Any = SimpleNamespace(status=lambda: status, model=Path("merged.npz"))
    folder: Any = SimpleNamespace(method=lambda: SimpleNamespace(merge=config))
    model, from_block = merged_of(config, missing)
    merged = ModelLocation(stage, "merged", "key", "").opened(folder, model)
    assert merged.missing_blocks == missing
    run = OpenedRun(**vars(merged), capture=capture_at(None))
    at, owner = block_lookup(run, BLOCKS), BLOCKS.owner(xy_positions(model.anchors.positions))
    assert (at(model.anchors.positions) == from_block).all()
    assert (rule == "owner") == (owner == from_block).all()
    coarse = OpenedRun(**vars(ModelLocation(stage, "coarse", "key", "").opened(folder, model)), capture=run.capture)
    assert (block_lookup(coarse, BLOCKS)(model.anchors.positions) == owner).all()  # nothing of it is merged
