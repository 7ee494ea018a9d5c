"""Merging: every place takes its anchors from exactly one block."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.hand_made_models import camera_above, model_at, opaque_plane, quadrant_of, quadrants
from vdgs.config.method import MergeConfig
from vdgs.errors import VdgsError
from vdgs.kernels import cpu as kernels
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import render
from vdgs.partition.block_records import MergedBlockRecord
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.merging import block_of_points, merge_blocks

OWNER, BEST_SEEN = MergeConfig("owner"), MergeConfig("max-visibility")
NO_CAMERAS = [[]] * 4


def bits(anchors: Anchors) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in anchors.tensors().items()}


def rows(anchors: Anchors) -> list[bytes]:
    """Each anchor as bytes."""
    tensors = [tensor.flatten(1) for tensor in anchors.tensors().values()]
    return [row.numpy().tobytes() for row in torch.cat(tensors, dim=1)]


def part(model: AnchorModel, keep: np.ndarray) -> AnchorModel:
    return replace(model, anchors=model.anchors.select(torch.from_numpy(keep)))


def scattered(n: int = 200, seed: int = 0, spread: float = 6.0) -> AnchorModel:
    return model_at(np.random.default_rng(seed).uniform([-spread, -spread, -0.5], [spread, spread, 0.5], (n, 3)), seed)


def places(model: AnchorModel) -> np.ndarray:
    return model.anchors.positions[:, :2].double().numpy()


@pytest.mark.parametrize("config", [OWNER, BEST_SEEN])
def test_merging_one_block_is_the_identity(config: MergeConfig):
    core = shapely.box(-1, -1, 1, 1)
    blocks, coarse, trained = Blocks((Block(core, core.buffer(0.4)),)), scattered(50), scattered(80, seed=1)
    merged, became = merge_blocks(coarse, [trained], blocks, [[camera_above(0, 0)]], config)
    assert bits(merged.anchors) == bits(trained.anchors)
    assert (merged.voxel_size, merged.background, merged.metadata) == (
        coarse.voxel_size,
        coarse.background,
        coarse.metadata,
    )
    assert replace(became[0], unseen=0) == MergedBlockRecord(
        block=0, trained=80, kept=80, dropped=0, coarse_fallback=0, unseen=0
    )


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([OWNER, BEST_SEEN]))
def test_the_merged_scene_is_a_disjoint_union(seed: int, config: MergeConfig):
    """Whatever the blocks hold, even in each other's places, each gives what lies where it is the giver."""
    rng = np.random.default_rng(seed)
    blocks, coarse = quadrants(), scattered(40, seed)
    trained = [scattered(int(rng.integers(0, 60)), seed + 1 + i) for i in range(4)]
    cameras = [[camera_above(*rng.uniform(-3, 3, 2)) for _ in range(rng.integers(0, 4))] for _ in range(4)]
    merged, became = merge_blocks(coarse, trained, blocks, cameras, config)
    givers = [block_of_points(each.anchors.positions, blocks, cameras, config) for each in trained]
    expected = [
        row
        for i, each in enumerate(trained)
        for row, giver in zip(rows(each.anchors), givers[i], strict=True)
        if giver == i
    ]  # fmt: skip
    assert rows(merged.anchors) == expected
    assert [each.trained for each in became] == [len(each.anchors) for each in trained]
    assert all(each.kept + each.dropped == each.trained for each in became)
    assert sum(each.kept for each in became) == len(merged.anchors)


@pytest.mark.parametrize("config", [OWNER, BEST_SEEN])
def test_untrained_blocks_give_the_coarse_scene_back(config: MergeConfig):
    """Every place has one giver: nothing is lost and nothing is doubled where the blocks overlap."""
    blocks, coarse = quadrants(), scattered(500)
    trained = [part(coarse, blocks.in_expanded(i, places(coarse))) for i in range(4)]
    assert sum(len(each.anchors) for each in trained) > 550  # the rings do overlap
    cameras = [[camera_above(x, y)] for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
    merged, _ = merge_blocks(coarse, trained, blocks, cameras, config)
    assert sorted(rows(merged.anchors)) == sorted(rows(coarse.anchors))


def test_the_owner_gives():
    blocks, coarse = quadrants(), scattered(300)
    trained = [scattered(300, seed=i + 1) for i in range(4)]
    merged, became = merge_blocks(coarse, trained, blocks, NO_CAMERAS, OWNER)
    expected = [
        row for i, each in enumerate(trained) for row in rows(part(each, quadrant_of(places(each)) == i).anchors)
    ]
    assert rows(merged.anchors) == expected
    assert all(each.unseen == each.kept for each in became)


def test_a_merged_plane_is_drawn_as_the_coarse_one():
    coarse = opaque_plane()
    trained = [part(coarse, quadrant_of(places(coarse)) == i) for i in range(4)]
    merged, _ = merge_blocks(coarse, trained, quadrants(), NO_CAMERAS, OWNER)
    camera = camera_above(0.3, -0.2, tilt_deg=10)
    difference = render(merged, camera).image - render(coarse, camera).image
    assert float(render(coarse, camera).alpha.min()) > 0.9
    assert float(difference.abs().mean()) < 0.01  # splats of one depth may be drawn in another order


def test_what_the_owner_did_not_see_is_coarse_still():
    """As block training leaves it: anchors outside all frusta keep their bits."""
    blocks, coarse = quadrants(), scattered(400)
    cameras = [[camera_above(x, y)] for x, y in ((-2, -2), (-2, 2), (2, -2), (2, 2))]
    trained, unseen = [], []
    for i in range(4):
        own = part(coarse, quadrant_of(places(coarse)) == i)
        seen = kernels.count_visibility(own.anchors.positions, cameras[i]) > 0
        features = torch.where(seen[:, None], own.anchors.features + 1, own.anchors.features)
        trained.append(replace(own, anchors=replace(own.anchors, features=features)))
        unseen.append(int((~seen).sum()))
    merged, became = merge_blocks(coarse, trained, blocks, cameras, OWNER)
    assert min(unseen) > 0
    assert [each.unseen for each in became] == unseen
    assert len(set(rows(merged.anchors)) & set(rows(coarse.anchors))) == sum(unseen)


def test_best_seen_prefers_the_cameras_that_see_it_most():
    blocks = quadrants(ring=1.0)
    above = [camera_above(0, -2), camera_above(0.1, -2), camera_above(0, -2.1)]
    shared, owned_by_0, far = [-0.5, -2, 0], [-2.0, -2, 0], [-0.5, -20, 0]
    positions = torch.tensor([shared, owned_by_0, far])

    def giver(*views: int) -> list[int]:
        cameras = [above[:count] for count in views]
        return block_of_points(positions, blocks, cameras, BEST_SEEN).tolist()

    assert giver(1, 0, 2, 0) == [2, 0, 0]  # reached by 0 and 2; the second place by 0 alone
    assert giver(2, 0, 2, 0) == [0, 0, 0]  # of equals the owner
    assert giver(0, 3, 0, 3) == [0, 0, 0]  # those that do not reach it have no say
    corner = torch.tensor([[-0.5, -0.5, 0.0]])
    cameras = [[], [camera_above(0, 0)], [camera_above(0, 0)], []]
    assert block_of_points(corner, blocks, cameras, BEST_SEEN).tolist() == [1]  # else the first


def test_a_missing_block_stops_the_merge():
    coarse = scattered()
    some = [scattered(), None, scattered(), None]
    with pytest.raises(
        VdgsError, match=r"blocks 1, 3 are not trained[^`]*vdgs train-blocks RUN --block 1\n.*--block 3"
    ) as error:
        merge_blocks(coarse, some, quadrants(), NO_CAMERAS, OWNER)
    assert "--allow-missing-blocks" in str(error.value)
    with pytest.raises(VdgsError, match=r"^block 0 is not trained"):
        merge_blocks(coarse, [None, *some[2:3] * 3], quadrants(), NO_CAMERAS, OWNER)


@pytest.mark.parametrize("config", [OWNER, BEST_SEEN])
def test_coarse_anchors_stand_in_for_a_missing_block(config: MergeConfig):
    blocks, coarse = quadrants(), scattered(300)
    trained: list[AnchorModel | None] = [scattered(300, seed=i + 1) for i in range(4)]
    trained[2] = None
    cameras = [[camera_above(0, 0, 8.0)] * (2 if i == 3 else 1) for i in range(4)]
    merged, became = merge_blocks(coarse, trained, blocks, cameras, config, allow_missing=True)
    stood_in = rows(part(coarse, quadrant_of(places(coarse)) == 2).anchors)
    assert set(rows(merged.anchors)) & set(rows(coarse.anchors)) == set(stood_in)
    assert became[2].coarse_fallback == became[2].kept + became[2].coarse_fallback == len(stood_in)
    others = part(merged, quadrant_of(places(merged)) == 2).anchors
    assert sorted(rows(others)) == sorted(stood_in)  # nobody else gives there


def test_a_missing_block_is_given_nothing_of_others():
    """However many of its cameras see its ring: it has no anchors there, and a hole would be left."""
    blocks, coarse = quadrants(), scattered(500)
    trained: list[AnchorModel | None] = [part(coarse, blocks.in_expanded(i, places(coarse))) for i in range(4)]
    trained[2] = None
    cameras = [[camera_above(0, 0, 8.0)] * (3 if i == 2 else 1) for i in range(4)]
    merged, _ = merge_blocks(coarse, trained, blocks, cameras, BEST_SEEN, allow_missing=True)
    assert sorted(rows(merged.anchors)) == sorted(rows(coarse.anchors))


def test_all_blocks_missing_is_the_coarse_scene():
    coarse = scattered()
    merged, became = merge_blocks(coarse, [None] * 4, quadrants(), NO_CAMERAS, OWNER, allow_missing=True)
    assert sorted(rows(merged.anchors)) == sorted(rows(coarse.anchors))
    assert sum(each.coarse_fallback for each in became) == len(coarse.anchors)


def test_a_block_of_another_coarse_model_is_refused():
    coarse, own = scattered(), scattered(seed=1)
    stranger = model_at(np.zeros((3, 3)), decoder_seed=1)
    with pytest.raises(
        VdgsError, match=r"block 2 was trained from another coarse model.*vdgs train-blocks RUN --block 2"
    ):
        merge_blocks(coarse, [own, own, stranger, own], quadrants(), NO_CAMERAS, OWNER)
    with pytest.raises(VdgsError, match="block 0 was trained from another"):
        merge_blocks(coarse, [replace(own, voxel_size=0.2), own, own, own], quadrants(), NO_CAMERAS, OWNER)


def test_as_many_models_as_blocks():
    with pytest.raises(ValueError, match="3 models and 4 camera lists for 4 blocks"):
        merge_blocks(scattered(), [scattered()] * 3, quadrants(), NO_CAMERAS, OWNER)


def turned(blocks: Blocks) -> Blocks:
    """As many blocks, cut along the diagonals."""
    return Blocks(tuple(Block(*(shapely.affinity.rotate(each, 45, (0, 0)) for each in (b.core, b.expanded)))
                        for b in blocks.items))  # fmt: skip


@pytest.mark.parametrize("config", [OWNER, BEST_SEEN])
@pytest.mark.parametrize("margin", ["frozen", "ramp"])
def test_blocks_of_another_cut_are_refused(config: MergeConfig, margin: str):
    """As many blocks, of the same coarse scene: what one owns now is in the model of another."""
    blocks, coarse, rng = quadrants(), scattered(500), np.random.default_rng(0)
    cameras = [[camera_above(0, 0)]] * 4
    reached = [blocks.in_expanded(i, places(coarse)) for i in range(4)]
    own = reached if margin == "ramp" else [quadrant_of(places(coarse)) == i for i in range(4)]
    trained = [part(coarse, mask & (rng.random(500) > 0.3)) for mask in own]  # training has removed a third
    merge_blocks(coarse, trained, blocks, cameras, config)
    with pytest.raises(VdgsError, match=r"trained for another cut of the scene(?s:.)*Give the blocks and the assign"):
        merge_blocks(coarse, trained, turned(blocks), cameras, config)
    trained[1] = None
    merge_blocks(coarse, trained, blocks, cameras, config, allow_missing=True)
    with pytest.raises(VdgsError, match="trained for another cut of the scene"):
        merge_blocks(coarse, trained, turned(blocks), cameras, config, allow_missing=True)


def test_a_rule_that_would_lose_what_only_the_owner_has_is_refused():
    blocks, coarse = quadrants(), scattered(500)
    trained = [part(coarse, quadrant_of(places(coarse)) == i) for i in range(4)]
    cameras = [[camera_above(-2, -2)] * count for count in (3, 1, 1, 1)]
    merge_blocks(coarse, trained, blocks, cameras, OWNER)
    with pytest.raises(VdgsError, match=r"'max-visibility' would lose \d+ anchors.*Merge with rule='owner'"):
        merge_blocks(coarse, trained, blocks, cameras, BEST_SEEN)
