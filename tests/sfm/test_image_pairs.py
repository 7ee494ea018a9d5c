"""Which photographs are matched with which, by where they were taken and where they look."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vdgs.sfm.pair_selection import SHARED_NEIGHBOR_FACTOR, spatial_pairs

pytestmark = pytest.mark.slow

NEIGHBORS = 16


def strips(count: int, each: int, step: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 3] of a level flight, every other strip flown back; and the strip of each."""
    along = np.concatenate([np.arange(each) if k % 2 == 0 else np.arange(each)[::-1] for k in range(count)])
    of = np.repeat(np.arange(count), each)
    return np.stack([step * along, apart * of, np.full(len(of), 100.0)], axis=1), of


def nearest_in_the_plane(places: np.ndarray) -> set[tuple[int, int]]:
    found = cKDTree(places[:, :2]).query(places[:, :2], k=NEIGHBORS + 1)[1]
    return {(min(i, j), max(i, j)) for i, row in enumerate(found.tolist()) for j in row if i != j}


def rig() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Five lenses: straight down, ahead, back, right and left; every other strip looks the other way round."""
    places, of = strips(6, 12, 20.0, 45.0)
    lenses = np.array([[0, 0, -1.0], [1, 0, -1], [-1, 0, -1], [0, 1, -1], [0, -1, -1]])
    lenses /= np.linalg.norm(lenses, axis=1, keepdims=True)
    turned = np.where(of % 2, -1, 1)[:, None, None] * [1, 1, 0] + [0, 0, 1]
    return np.repeat(places, 5, axis=0), (lenses * turned).reshape(-1, 3), np.repeat(of, 5)


@pytest.mark.parametrize("wrong_m", [0.0, 0.3, 1.0])
def test_a_facade_flown_in_columns_is_matched_across_columns(wrong_m):
    column, row = (each.ravel() for each in np.meshgrid(range(10), range(20), indexing="ij"))
    truth = np.stack([5.0 * column, 0.0 * row, 4.0 * row], axis=1)
    chosen = spatial_pairs(truth + np.random.default_rng(0).normal(0, wrong_m, truth.shape), NEIGHBORS)
    beside = {
        (i, j) for i in range(200) for j in range(i) if abs(column[i] - column[j]) == 1 and abs(row[i] - row[j]) <= 1
    }
    assert len(beside) == 522
    assert sum((j, i) in chosen for i, j in beside) > 0.95 * len(beside)
    assert len(chosen) < 200 * NEIGHBORS * 1.1


def test_a_rig_of_five_lenses_is_matched_across_strips_with_those_that_look_the_same_way():
    places, views, of = rig()
    chosen = np.array(sorted(spatial_pairs(places, NEIGHBORS, views)))
    one, other = chosen.T
    across = (np.abs(of[one] - of[other]) == 1) & (np.einsum("ni,ni->n", views[one], views[other]) > 0.99)
    for inner in np.flatnonzero((of > 0) & (of < 5)):  # with both strips beside
        strips_met = {int(of[k]) for pair in chosen[across] if inner in pair for k in pair}
        assert {of[inner] - 1, of[inner] + 1} <= strips_met
    assert len(chosen) <= len(places) * NEIGHBORS * 2


def test_a_rig_that_records_no_views_is_matched_across_strips_by_place():
    places, _, of = rig()
    chosen = np.array(sorted(spatial_pairs(places, NEIGHBORS)))
    one, other = chosen.T
    across = chosen[np.abs(of[one] - of[other]) == 1]
    assert set(across.ravel().tolist()) == set(range(len(places)))
    assert len(chosen) <= len(places) * NEIGHBORS * SHARED_NEIGHBOR_FACTOR


@pytest.mark.parametrize("wrong_m", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("known", [True, False])
def test_flights_straight_down_get_the_nearest_in_the_plane_and_no_more(wrong_m, known):
    rng = np.random.default_rng(1)
    places, _ = strips(8, 12, 10.0, 22.0)
    places += rng.normal(0, wrong_m, places.shape)
    two_heights = np.concatenate([places, places + np.array([5.0, 5.0, 40.0])])
    hillside = places + np.outer(0.3 * places[:, 0], [0, 0, 1])
    three_days = np.concatenate([places + rng.normal(0, 0.3, places.shape) for _ in range(3)])
    for each in (places, two_heights, hillside, three_days):
        each = each + rng.normal(0, 1e-6, each.shape)  # no two equally far
        looks = np.array([0, 0, -1.0]) + rng.normal(0, 0.08, each.shape)
        looks /= np.linalg.norm(looks, axis=1, keepdims=True)
        assert spatial_pairs(each, NEIGHBORS, looks if known else None) == nearest_in_the_plane(each)
    assert spatial_pairs(places[:5], NEIGHBORS) == {(i, j) for j in range(5) for i in range(j)}


def test_pairs_of_before_are_all_kept_where_more_come():
    places, views, _ = rig()
    places = places + np.random.default_rng(2).normal(0, 0.5, places.shape)
    for looks in (views, None):
        assert nearest_in_the_plane(places) < spatial_pairs(places, NEIGHBORS, looks)
