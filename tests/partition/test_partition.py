"""The partition: every place has one owner, and the cut moves with the scene."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from vdgs.config.method import PartitionConfig
from vdgs.errors import VdgsError
from vdgs.partition import boundary, clustering
from vdgs.partition.blocks import Block, Blocks, load_blocks, save_blocks
from vdgs.partition.boundary import alpha_shape, expand_core
from vdgs.partition.partition_scene import partition_scene

pytestmark = pytest.mark.slow


def town(n: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Anchors of an uneven oblong site, and V that falls off from its middle."""
    generator = np.random.default_rng(seed)
    flat = generator.uniform([0, 0], [100, 60], (n, 2))
    flat[: n // 4] = generator.normal([25, 20], 8, (n // 4, 2))
    views = 40 * np.exp(-(((flat - [50, 30]) / [40, 25]) ** 2).sum(axis=1)) + generator.uniform(0, 3, n)
    return np.column_stack([flat, generator.uniform(0, 10, n)]), views.astype(np.int64)


def cut(positions: np.ndarray, views: np.ndarray, count: int = 4, **settings: object) -> Blocks:
    return partition_scene(positions, views, PartitionConfig(blocks=count, **settings), seed=0)[0]


@cache
def cut_town(balanced: bool = False) -> Blocks:
    return cut(*town(), balanced=balanced)


def owners(blocks: Blocks, positions: np.ndarray) -> np.ndarray:
    return blocks.owner(positions[:, :2])


def by_distance(blocks: Blocks, places: np.ndarray) -> np.ndarray:
    points = shapely.points(places)
    return np.stack([shapely.distance(block.core, points) for block in blocks.items], axis=1).argmin(axis=1)


# ------------------------------------------------------------------------------------------- invariance


@settings(max_examples=6)
@given(
    turn=st.floats(0, 2 * np.pi), factor=st.floats(0.01, 100), shift=st.tuples(*[st.floats(-1e3, 1e3)] * 2),
    balanced=st.booleans(),
)  # fmt: skip
def test_the_cut_turns_moves_and_scales_with_the_scene(
    turn: float, factor: float, shift: tuple[float, float], balanced: bool
) -> None:
    positions, views = town()
    c, s = np.cos(turn), np.sin(turn)
    moved = factor * positions @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [*shift, 7]
    expected = owners(cut_town(balanced), positions)
    assert np.array_equal(owners(cut(moved, views, balanced=balanced), moved), expected)


def test_the_order_of_the_anchors_does_not_matter() -> None:
    positions, views = town()
    order = np.random.default_rng(3).permutation(len(positions))
    there, shuffled = cut_town(), cut(positions[order], views[order])
    assert all(a.core.equals(b.core) for a, b in zip(there.items, shuffled.items, strict=True))
    assert np.array_equal(owners(shuffled, positions), owners(there, positions))


def test_on_the_axes_of_the_ground_frame_the_cut_does_not_turn_with_the_scene() -> None:
    """Per axis the oblong site is a square; turned by 45 degrees it is another square."""
    positions, views = town()
    turned = positions @ np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]).T / np.sqrt(2)
    for axes, same in (("principal", True), ("ground", False)):
        before, after = (
            cut(each, views, lambda_vis=0.0, cluster_axes=axes, cluster_smoothing=0.5) for each in (positions, turned)
        )
        assert np.array_equal(owners(after, turned), owners(before, positions)) == same


def test_far_outliers_turn_no_axes() -> None:
    ground = town()[0][:, :2]
    far = np.random.default_rng(9).normal([5000.0, 3500.0], 50.0, (len(ground) // 100, 2))
    there, beside = (clustering.fit_principal_plane(each) for each in (ground, np.concatenate([ground, far])))
    assert np.linalg.norm(beside.center - there.center) < 1.0
    np.testing.assert_allclose(beside.axes, there.axes, atol=0.05)


def test_positions_are_normalized_between_the_outermost_anchors_or_clipped() -> None:
    points = np.array([[0.0, 5.0]] * 50 + [[10.0, 7.0]] * 50 + [[1000.0, 6.0]])
    config = PartitionConfig(lambda_vis=0.5, cluster_clip=0.0)
    features = clustering.clustering_features(points, np.arange(101), config)
    assert np.allclose(features, np.column_stack([points[:, 0] / 1000, (points[:, 1] - 5) / 2, np.arange(101) / 200]))
    clipped = clustering.clustering_features(points, np.arange(101), replace(config, cluster_clip=0.02))
    assert np.allclose(clipped[:, 0], [0.0] * 50 + [1.0] * 51)


@pytest.mark.parametrize("clip", [0.0, 0.02])
def test_positions_have_a_unit_for_each_axis_or_one_in_which_shapes_stay(clip: float) -> None:
    points = np.random.default_rng(1).uniform(0, [400, 100], (500, 2))
    visibility = np.arange(500)
    config = PartitionConfig(cluster_clip=clip)
    low, high = np.quantile(points, (clip, 1 - clip), axis=0)
    by_axis = clustering.clustering_features(points, visibility, config)
    assert np.array_equal(by_axis[:, :2], np.clip((points - low) / (high - low), 0.0, 1.0))  # the default, to the bit
    common = clustering.clustering_features(points, visibility, replace(config, cluster_scale="common"))
    assert np.allclose(common[:, :2], (np.clip(points, low, high) - low) / (high - low).max())
    assert np.array_equal(common[:, 2], by_axis[:, 2])
    line = np.column_stack([points[:, 0], np.full(500, 3.0)])  # a side without extent has no say
    for each in (line, line[:, ::-1], np.full((500, 2), 3.0)):
        assert np.isfinite(
            clustering.clustering_features(each, visibility, replace(config, cluster_scale="common"))
        ).all()


def test_a_long_place_is_cut_otherwise_with_one_scale_and_a_square_one_alike() -> None:
    generator = np.random.default_rng(2)
    unit = generator.uniform(0, 1, (6000, 3))
    unit[:2, :2] = [[0, 0], [1, 1]]
    views = (40 * np.exp(-8 * ((unit[:, :2] - 0.5) ** 2).sum(1))).astype(np.int64)
    plain = {"cluster_axes": "ground", "cluster_clip": 0.0}
    cuts = {
        (shape, scale): cut(unit * [shape, 100, 1], views, 4, cluster_scale=scale, **plain)
        for shape in (100, 400) for scale in ("axis", "common")
    }  # fmt: skip
    places = 100 * generator.uniform(0, 1, (200, 2))
    owners = {(shape, scale): blocks.owner(places * [shape / 100, 1]) for (shape, scale), blocks in cuts.items()}
    assert np.array_equal(owners[100, "axis"], owners[100, "common"])
    # Stretched, the clusters of the default are the same; the cells of the cores are not.
    assert (owners[400, "axis"] == owners[100, "axis"]).mean() > 0.9
    assert (owners[400, "common"] == owners[400, "axis"]).mean() < 0.8


def test_components_are_sought_over_a_clusters_own_cells_or_where_it_is_strongest() -> None:
    """Two clusters that are mixed over all of the site: each component is then the whole of it, or what it leads."""
    generator = np.random.default_rng(5)
    points = generator.uniform(0, 10, (6000, 2))
    labels = (generator.uniform(size=6000) < 0.2 + 0.6 * (points[:, 0] > 5)).astype(np.int64)
    site = shapely.box(0, 0, 10, 10).area
    own = [core for core in boundary.block_cores(points, labels, 2, 0.0) if core is not None]
    assert max(core.area for core in own) > 0.9 * site
    for smoothing in (0.5, 1.5):
        halves = boundary.block_cores(points, labels, 2, smoothing)
        assert all(core is not None and 0.4 * site < core.area < 0.6 * site for core in halves)


def test_a_small_block_is_left_out_or_kept() -> None:
    generator = np.random.default_rng(8)
    site, far = generator.uniform(0, 100, (4000, 3)), generator.normal([160, 50, 0], 1, (40, 3))
    positions, views = np.concatenate([site, far]), np.full(4040, 5)
    kept = cut(positions, views, 3, lambda_vis=0.0, min_block_share=0.0, cluster_clip=0.0)
    assert len(kept) == 3
    assert len(cut(positions, views, 3, lambda_vis=0.0, min_block_share=0.9, cluster_clip=0.0)) < 3


def test_coordinates_as_large_as_utm() -> None:
    positions, views = town()
    far = positions + np.array([4.5e5, 5.4e6, 300])
    blocks = cut(far, views)
    assert np.array_equal(owners(blocks, far), owners(cut_town(), positions))
    assert overlap(blocks) < 1e-6 * sum(block.core.area for block in blocks.items)


# --------------------------------------------------------------------------------------------- ownership


def overlap(blocks: Blocks) -> float:
    cores = [block.core for block in blocks.items]
    return sum(a.intersection(b).area for i, a in enumerate(cores) for b in cores[:i])


@pytest.mark.parametrize(("lambda_vis", "count"), [(0.0, 2), (1.0, 7)])
def test_every_place_has_one_owner_and_cores_are_disjoint_within_their_boundaries(
    lambda_vis: float, count: int
) -> None:
    positions, views = town()
    blocks = cut(positions, views, count, lambda_vis=lambda_vis)
    assert len(blocks) == count
    assert overlap(blocks) < 1e-9 * sum(block.core.area for block in blocks.items)
    for block in blocks.items:
        assert block.core.is_valid
        assert block.expanded.is_valid
        assert block.core.difference(block.expanded).area == 0
        assert block.expanded.area > 1.2 * block.core.area
    generator = np.random.default_rng(4)
    places = np.concatenate(
        [positions[:, :2], generator.uniform(-200, 300, (2000, 2)), generator.normal(0, 1e6, (50, 2))]
    )
    owner = blocks.owner(places)
    assert np.array_equal(owner, by_distance(blocks, places))
    assert set(owner.tolist()) == set(range(count))
    assert np.array_equal(owner[::97], blocks.owner(places[::97])), "an owner depends on its place alone"
    for index, block in enumerate(blocks.items):
        inside = shapely.contains_xy(block.core, places)
        assert (owner[inside] == index).all()
        reached = blocks.in_expanded(index, places)
        assert reached[owner == index].all()
        assert np.array_equal(reached, shapely.contains_xy(block.expanded, places) | (owner == index))


def test_the_first_of_equally_near_cores_owns_a_place_and_no_place_is_no_trouble() -> None:
    boxes = [shapely.box(2, 0, 3, 1), shapely.box(0, 0, 1, 1), shapely.box(3, 0, 4, 1)]
    blocks = Blocks(tuple(Block(box, box) for box in boxes))
    places = np.array([[1.5, 0.5], [3.0, 0.5], [0.5, 0.5], [1.0, 0.2], [9e9, 0.0]])
    assert blocks.owner(places).tolist() == [0, 0, 1, 1, 2]
    assert blocks.owner(np.repeat(places, 2000, axis=0)).tolist() == np.repeat([0, 0, 1, 1, 2], 2000).tolist()
    assert blocks.owner(np.zeros((0, 2))).tolist() == []
    with pytest.raises(ValueError, match="not finite"):
        blocks.owner(np.array([[np.nan, 0.0]]))


def test_one_block_owns_everything() -> None:
    positions, views = town(500)
    blocks, warnings = partition_scene(positions, views, PartitionConfig(blocks=1), seed=0)
    assert len(blocks) == 1
    assert warnings == []
    assert shapely.contains_xy(blocks.items[0].core, positions[:, :2]).all()
    assert blocks.owner(np.random.default_rng(0).normal(0, 1e9, (99, 2))).tolist() == [0] * 99


# ------------------------------------------------------------------------------------ what decides about it


def test_without_weight_visibility_leaves_no_trace() -> None:
    positions, views = town()
    other = np.random.default_rng(5).permutation(views)
    a, b = cut(positions, views, lambda_vis=0.0), cut(positions, other, lambda_vis=0.0)
    assert [block.core.wkb for block in a.items] == [block.core.wkb for block in b.items]


def test_with_weight_the_cut_follows_visibility_across_a_uniform_field() -> None:
    generator = np.random.default_rng(6)
    flat = generator.uniform(0, 100, (6000, 2))
    # Place alone cuts a square along one of its sides; visibility falls off across a diagonal.
    seen = flat.sum(axis=1) > 100
    views = np.where(seen, 40, 5)
    positions = np.column_stack([flat, np.zeros(6000)])
    spread = {}
    for lambda_vis in (0.0, 1.0):
        owner = owners(cut(positions, views, 2, lambda_vis=lambda_vis), positions)
        spread[lambda_vis] = np.array([views[owner == index].std() for index in range(2)])
    assert (spread[1.0] < 0.4 * spread[0.0]).all()
    assert np.mean((owner == owner[flat.sum(axis=1).argmax()]) == seen) > 0.97


def test_an_enclosed_dense_center_keeps_its_place() -> None:
    generator = np.random.default_rng(7)
    outskirts = generator.uniform(-50, 50, (6000, 2)) * [1.2, 1.0]
    center = generator.uniform(-12, 12, (3000, 2))
    flat = np.concatenate([outskirts, center])
    within = (np.abs(flat) < 12).all(axis=1)
    positions = np.column_stack([flat, np.zeros(len(flat))])
    blocks = cut(positions, np.where(within, 60, 4), 2, lambda_vis=3.0)
    owner = owners(blocks, positions)
    inner = int(owner[np.linalg.norm(flat, axis=1).argmin()])
    assert np.mean((owner == inner) == within) > 0.97
    assert len(blocks.items[1 - inner].core.interiors) == 1


def test_balanced_blocks_hold_about_equally_many_anchors() -> None:
    positions, views = town()
    for count in (3, 6):
        sizes = np.bincount(owners(cut(positions, views, count, balanced=True, lambda_vis=0.0), positions))
        assert np.abs(sizes * count / len(positions) - 1).max() < 0.1
        plain = np.bincount(owners(cut(positions, views, count, lambda_vis=0.0), positions))
        assert np.ptp(sizes) < np.ptp(plain)


@pytest.mark.parametrize(("count", "digits"), [(1, 9), (2, 9), (5, 9), (5, 1)])
def test_weights_of_balanced_clusters_are_those_of_a_look_at_all_costs_in_each_step(count: int, digits: int) -> None:
    """Ties too, among features that were rounded."""
    features = np.round(np.random.default_rng(count).normal(size=(60 * count, 3)), digits)
    squares = clustering._squared_distances(features, features[:count])
    share, weights = 60, np.zeros(count)
    for _ in range(clustering.BALANCED_SWEEPS * count):
        costs = squares - weights
        sizes = np.bincount(costs.argmin(axis=1), minlength=count)
        worst = int(np.abs(sizes - share).argmax())
        if abs(sizes[worst] - share) <= 1:
            break
        costs[:, worst] = np.inf
        margins = np.sort(squares[:, worst] - costs.min(axis=1))
        weights[worst] = (margins[share - 1] + margins[share]) / 2
    assert np.array_equal(clustering._balance(squares, np.zeros(count)), weights - weights.mean())


def test_anchors_that_cannot_be_cut_are_refused() -> None:
    three = np.repeat(np.array([[0.0, 0, 0], [5, 1, 0], [9, 0, 0]]), 4, axis=0)
    views = np.full(12, 3)
    with pytest.raises(VdgsError, match=r"^4 blocks: .* only 3 distinct"):
        cut(three, views, 4)
    stacked = np.column_stack([np.ones((12, 2)), np.arange(12.0)])
    with pytest.raises(VdgsError, match=r"^2 blocks: .* only 1 distinct"):
        cut(stacked, np.arange(12), 2)
    with pytest.raises(VdgsError, match="no anchors"):
        cut(np.zeros((0, 3)), np.zeros(0, int))
    with pytest.raises(VdgsError, match="not finite"):
        cut(np.full((5, 3), np.nan), np.zeros(5, int))
    with pytest.raises(VdgsError, match="--blocks 0"):
        cut(three, views, 0)
    with pytest.raises(ValueError, match="choose_block_count"):
        partition_scene(three, views, PartitionConfig(blocks="auto"), 0)


@pytest.mark.parametrize("count", [2, 3])
def test_a_handful_of_anchors_or_a_line_of_them_is_cut(count: int) -> None:
    line = np.column_stack([np.arange(30.0) ** 1.1, np.zeros(30), np.zeros(30)])
    for positions in (line, line[:: 30 // count][:count]):
        blocks = cut(positions, np.full(len(positions), 2), count)
        assert len(blocks) == len(set(owners(blocks, positions).tolist())) == count


def notes(positions: np.ndarray, views: np.ndarray, count: int, **settings: object) -> str:
    """What people are told of a cut."""
    return " ".join(partition_scene(positions, views, PartitionConfig(blocks=count, **settings), seed=0)[1])


def test_fewer_blocks_than_asked_for_are_said_with_the_reason() -> None:
    generator = np.random.default_rng(8)
    site, views = generator.uniform(0, 200, (2000, 3)), generator.integers(5, 20, 4000)
    far_apart = np.concatenate([site, site + np.array([50_000.0, 0, 0])])
    for lambda_vis in (0.0, 0.2):
        said = notes(far_apart, views, 8, lambda_vis=lambda_vis)
        assert "instead of 8: blocks are told apart on cells of 1/512 of the scene's extent" in said
        assert "each is better a run of its own" in said
        assert "lambda" not in said
        assert notes(far_apart, views, 2, lambda_vis=lambda_vis) == ""  # as it advises
        assert notes(site, views[:2000], 4, lambda_vis=lambda_vis) == ""
    place = generator.uniform(0, 100, (4000, 3))
    assert "scattered among those of their neighbors. A smaller --lambda-vis" in notes(place, views, 4, lambda_vis=9.0)
    stray = np.concatenate([place, generator.uniform(0, 5000, (120, 3))])
    said = notes(stray, np.append(views, views[:120]), 8, lambda_vis=0.0)
    assert "the other clusters hold hardly any anchors" in said
    assert "lambda" not in said


# ----------------------------------------------------------------------------------------------- shapes


def test_an_alpha_shape_follows_a_bay_and_widening_follows_the_area() -> None:
    generator = np.random.default_rng(8)
    points = generator.uniform(0, 10, (4000, 2))
    points = points[(points[:, 0] < 4) | (points[:, 1] < 3)]  # an L of area 58
    shape = alpha_shape(points, 0.8)
    assert shape is not None
    assert shape.area == pytest.approx(58, rel=0.05)
    assert shapely.covers(shape, shapely.points(points)).all()
    disc = shapely.Point(3, 4).buffer(5, quad_segs=64)
    assert expand_core(disc, 0.4).area == pytest.approx(1.96 * disc.area, rel=0.01)
    assert expand_core(disc, 0.0) is disc
    assert alpha_shape(np.array([[0.0, 0], [1, 1], [2, 2]]), 1.0) is None
    # Nor do places on a line have one where rounding puts them beside it.
    along = np.linspace(0.0, 100.0, 30)
    beside = np.column_stack([along, along / 3 + np.random.default_rng(0).uniform(-1e-12, 1e-12, 30)])
    assert alpha_shape(beside, 1.0) is None


# ------------------------------------------------------------------------------------------------ files


def test_what_is_read_owns_what_was_written(tmp_path: Path) -> None:
    blocks = cut_town()
    save_blocks(tmp_path / "blocks.geojson", blocks, [{"anchors": index} for index in range(4)])
    read = load_blocks(tmp_path / "blocks.geojson")
    places = np.random.default_rng(9).uniform(-50, 150, (5000, 2))
    assert np.array_equal(read.owner(places), blocks.owner(places))
    assert all(np.array_equal(read.in_expanded(k, places), blocks.in_expanded(k, places)) for k in range(4))
    features = json.loads((tmp_path / "blocks.geojson").read_text())["features"]
    assert [f["properties"]["anchors"] for f in features] == [0, 0, 1, 1, 2, 2, 3, 3]
