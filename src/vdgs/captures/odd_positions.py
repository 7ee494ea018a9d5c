"""Positions that are none of the flight: a receiver without satellites, another flight, one that never moved."""

from __future__ import annotations

import numpy as np

from vdgs.geometry.geodesy import enu_from_geodetic, median_place

#: Positions nearer than this to 0, 0 (degrees) are a receiver without satellites.
NULL_POSITION_DEG = 0.01
#: A position so many times farther from the middle than the median one, and so many metres, is another flight's.
OUTLIER_FACTOR, OUTLIER_DISTANCE_M = 10.0, 1000.0
#: So many positions beside each other out there are a part of the capture all the same: a road, another site (choice).
LEAST_GROUP = 10
#: Positions that spread less than this (metres) say nothing: the receiver kept the first, or nobody moved.
MIN_SPREAD_M = 2.0


def are_nowhere(geodetic: np.ndarray) -> np.ndarray:
    """Which positions [n, 3] (degrees, metres) are 0, 0, [n] bool."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(geodetic[:, :2]) < NULL_POSITION_DEG).all(axis=1))


def are_far_off(geodetic: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which positions [n, 3] (degrees, metres) cannot be of the flight of the `known` ones [n] bool, [n] bool: far from
    most, and few or all at one place there."""
    level = geodetic.copy()
    heights = geodetic[known & np.isfinite(geodetic[:, 2]), 2]
    level[:, 2] = np.where(np.isfinite(geodetic[:, 2]), geodetic[:, 2], np.median(heights) if len(heights) else 0.0)
    altitudes = level[known, 2]
    enu = enu_from_geodetic(level, median_place(level[known]))
    across = np.linalg.norm(enu[:, :2], axis=1)
    up = np.abs(level[:, 2] - np.median(altitudes))
    with np.errstate(invalid="ignore"):
        far = known & (across > max(OUTLIER_DISTANCE_M, OUTLIER_FACTOR * float(np.median(across[known]))))
        high = up > max(OUTLIER_DISTANCE_M, OUTLIER_FACTOR * float(np.median(up[known])))
    if far.any():
        places = enu[known, :2]
        far[known] &= ~_are_flown(places, _groups(places, OUTLIER_DISTANCE_M))
    return far | high


def places_apart(enu: np.ndarray) -> np.ndarray:
    """For each position [n, 2 or more] in metres the number of the place that it lies at, that of most positions first:
    between places are many times the distances from one position to the next."""
    places = enu[:, :2]
    if len(places) < 2 or np.ptp(places, axis=0).max() <= OUTLIER_DISTANCE_M:
        return np.zeros(len(places), int)
    from scipy.spatial import cKDTree

    step = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
    groups = _groups(places, max(OUTLIER_DISTANCE_M, OUTLIER_FACTOR * step))
    rank = np.argsort(np.argsort(-np.bincount(groups), kind="stable"))
    return np.asarray(rank[groups])


def _are_flown(places: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Which places [n, 2] are many in their groups [n], and not all one, [n] bool."""
    counts = np.bincount(groups)
    least, most = np.full((len(counts), 2), np.inf), np.full((len(counts), 2), -np.inf)
    np.minimum.at(least, groups, places)
    np.maximum.at(most, groups, places)
    flown = (counts >= LEAST_GROUP) & ((most - least).max(axis=1) >= MIN_SPREAD_M)
    return np.asarray(flown[groups])


def _groups(places: np.ndarray, width_m: float) -> np.ndarray:
    """A number for each place [n, 2] of those that lie in squares beside each other, so many metres wide."""
    from scipy.sparse.csgraph import connected_components  # slow to load, and few captures have strays
    from scipy.spatial import cKDTree

    squares, number = np.unique(np.floor(places / width_m), axis=0, return_inverse=True)
    tree = cKDTree(squares)
    beside = tree.sparse_distance_matrix(tree, 1.0, p=np.inf)
    return np.asarray(connected_components(beside)[1][number.ravel()])


def do_not_spread(enu: np.ndarray) -> bool:
    """Whether positions [n, 3] in metres are all one and the same across."""
    return not len(enu) or bool(np.ptp(enu[:, :2], axis=0).max() < MIN_SPREAD_M)
