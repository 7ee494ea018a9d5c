"""Which positions are none of the flight, and how many places the others lie at."""

from __future__ import annotations

import time

import numpy as np

from vdgs.captures.odd_positions import are_far_off, places_apart


def test_strays_among_many_positions_are_found_at_once():
    """A survey of 20000 photographs, three of them a degree off: a step for each group, not for each position."""
    rng, count = np.random.default_rng(0), 20_000
    geodetic = np.column_stack([rng.normal(45, 0.002, count), rng.normal(7, 0.002, count), np.full(count, 100.0)])
    geodetic[:3, 0] += 1
    began = time.process_time()
    far = are_far_off(geodetic, np.ones(count, bool))
    assert time.process_time() - began < 3
    assert np.flatnonzero(far).tolist() == [0, 1, 2]


def test_places_are_apart_by_many_times_the_steps_within_them():
    grid = np.array([[10.0 * k, 30.0 * strip, 0] for strip in range(5) for k in range(8)])
    assert not places_apart(np.vstack([grid, grid + np.array([500, 0, 0])])).any()
    assert not places_apart(1000 * grid).any()  # from high up
    apart = places_apart(np.vstack([grid[:12] - [30_000, 0, 0], grid, grid[:20] + np.array([0, 5000, 0])]))
    assert apart.tolist() == 12 * [2] + 40 * [0] + 20 * [1]
    assert places_apart(np.zeros((0, 3))).tolist() == []
