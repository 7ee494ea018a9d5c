"""The partitions of other methods: every place has one owner, cells are what the publications say."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from support.captures import tiny_scene
from vdgs.config.method import AssignmentConfig
from vdgs.partition.assignment.assign_cameras import assign_cameras
from vdgs.partition.assignment.score_file import load_scores, save_scores
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.strategies import STRATEGIES, box_coverage, contract, expand, grid_shape

SCENE = tiny_scene(6, 4)
CAMERAS = list(SCENE.cameras.values())


def anchors(count: int = 2000) -> np.ndarray:
    generator = np.random.default_rng(0)
    flat = generator.uniform((-4, -4), (25, 16), (count, 2))
    return np.column_stack([flat, generator.normal(0, 0.1, count)])


def scores_of(blocks, mode: str) -> ScoreMatrix:
    shape = (len(CAMERAS), len(blocks))
    beneath = blocks.owner(np.array([camera.position[:2] for camera in CAMERAS]))
    return ScoreMatrix(
        mode=mode, scores=np.zeros(shape, np.float32), visible_anchors=np.ones(shape, np.int32),
        coverage=np.zeros(shape, np.float32), anchors=np.ones(shape[1], np.int64), nadir_block=beneath,
    )  # fmt: skip


@pytest.mark.parametrize("name", STRATEGIES)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_cells_are_disjoint_and_every_anchor_has_a_home(name, count):
    positions = anchors()
    blocks, warnings = STRATEGIES[name].partition(positions, CAMERAS, count)
    assert len(blocks) == count
    assert warnings == []
    cores = [block.core for block in blocks.items]
    assert sum(core.area for core in cores) == pytest.approx(shapely.union_all(cores).area)
    assert all(block.expanded.buffer(1e-6).contains(block.core) for block in blocks.items)
    assert np.bincount(blocks.owner(positions[:, :2]), minlength=count).min() > 0


@pytest.mark.parametrize("name", STRATEGIES)
def test_cells_without_anchors_are_no_blocks(name):
    positions = anchors()
    corner = positions[(positions[:, 0] < 8) & (positions[:, 1] < 4)]
    blocks, warnings = STRATEGIES[name].partition(corner, CAMERAS, 8)
    assert 1 <= len(blocks) <= 8
    assert bool(warnings) == (len(blocks) < 8)
    assert np.bincount(blocks.owner(corner[:, :2]), minlength=len(blocks)).min() > 0


def test_vastgaussian_gives_every_cell_as_many_cameras_and_a_fifth_more_room():
    blocks, _ = STRATEGIES["vastgaussian"].partition(anchors(), CAMERAS, 4)
    centers = np.array([camera.position[:2] for camera in CAMERAS])
    assert np.bincount(blocks.owner(centers)).tolist() == [6, 6, 6, 6]
    for block in blocks.items:
        (x0, y0, x1, y1), (a0, b0, a1, b1) = block.core.bounds, block.expanded.bounds
        assert (a1 - a0, b1 - b0) == pytest.approx((1.2 * (x1 - x0), 1.2 * (y1 - y0)))


def test_vastgaussian_scores_by_the_area_of_the_projected_box():
    camera = CAMERAS[0]
    everywhere = np.array([[x, y, z] for z in (-1.0, 0.0) for y in (-99.0, 99.0) for x in (-99.0, 99.0)])
    assert box_coverage(everywhere, camera) == pytest.approx(1.0)
    assert box_coverage(everywhere + np.array([500, 0, 0]), camera) == pytest.approx(0.0, abs=1e-6)
    assert box_coverage(everywhere + np.array([0, 0, 100]), camera) == 0.0  # behind it
    strategy, positions = STRATEGIES["vastgaussian"], anchors()
    blocks, _ = strategy.partition(positions, CAMERAS, 4)
    scores = strategy.adjust_scores(scores_of(blocks, "frustum"), positions, blocks, CAMERAS)
    rows = np.arange(len(CAMERAS))
    assert (scores.scores[rows, scores.nadir_block] == 1).all()
    assert ((scores.scores >= 0) & (scores.scores <= 1)).all()
    assert len(np.unique(scores.scores)) > 4


def test_citygaussian_cameras_join_the_block_that_they_stand_in():
    strategy, positions = STRATEGIES["citygaussian"], anchors()
    blocks, _ = strategy.partition(positions, CAMERAS, 4)
    config = strategy.assignment(AssignmentConfig(min_cameras=0))
    assert config.mode == "leave-one-out"
    scores = strategy.adjust_scores(scores_of(blocks, config.mode), positions, blocks, CAMERAS)
    assigned = assign_cameras(scores, config).cameras
    assert np.array_equal(assigned, np.eye(len(blocks), dtype=bool)[scores.nadir_block])


def test_dogs_cells_turn_with_the_scene_and_are_equal():
    turn = np.array([[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]])
    positions = anchors()
    turned = np.column_stack([positions[:, :2] @ turn.T, positions[:, 2]])
    for place in (positions, turned):
        blocks, _ = STRATEGIES["dogs"].partition(place, CAMERAS, 4)
        areas = np.array([block.core.area for block in blocks.items])
        assert areas == pytest.approx(np.full(4, areas[0]))
        assert [block.expanded.area for block in blocks.items] == pytest.approx(list(1.96 * areas))
    assert areas.sum() == pytest.approx(29 * 20, rel=0.05)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_contraction_and_its_inverse(x, y):
    place = np.array([[x, y]])
    contracted = contract(place)
    assert np.abs(contracted).max() < 2
    assert expand(contracted) == pytest.approx(place, rel=1e-9, abs=1e-9)


@given(st.integers(1, 64), st.floats(0.05, 20))
def test_a_grid_has_as_many_cells_as_asked_for(count, aspect):
    columns, rows = grid_shape(count, aspect)
    assert columns * rows == count


@pytest.mark.parametrize("name", STRATEGIES)
def test_scores_can_be_saved_and_read(name, tmp_path):
    strategy, positions = STRATEGIES[name], anchors()
    blocks, _ = strategy.partition(positions, CAMERAS, 4)
    config = strategy.assignment(AssignmentConfig())
    scores = strategy.adjust_scores(scores_of(blocks, config.mode), positions, blocks, CAMERAS)
    assignment = assign_cameras(scores, config)
    save_scores(tmp_path / "scores.npz", list(SCENE.cameras), scores, assignment)
    assert np.array_equal(load_scores(tmp_path / "scores.npz").assignment.cameras, assignment.cameras)
