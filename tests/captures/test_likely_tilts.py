"""Positions without altitudes: up, scale and north are as good as is stated, whatever shape a flight has."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vdgs.captures.position_adjustment import Problem, Up
from vdgs.captures.position_fit import fit_positions

TRIALS = 5


def flown(shape: str, rng: np.random.Generator) -> np.ndarray:
    if shape == "strip":
        places = np.stack([np.linspace(-100, 100, 30), np.zeros(30), np.full(30, 80.0)], axis=1)
    else:  # a facade, in four rows over each other
        places = np.stack([np.tile(np.linspace(0, 40, 10), 4), np.zeros(40), np.repeat([3.0, 8, 13, 18], 10)], axis=1)
    return places + rng.normal(0, 0.3, places.shape)


def errors(shape: str, up_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """By how much scale (share), north and level (degrees) are off, and what is stated (95 %) [trials, 3]: positions
    good to a metre, up known to so many degrees."""
    off, stated = [], []
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        places = flown(shape, rng)
        askew = Rotation.from_rotvec([*rng.normal(0, np.radians(up_deg), 2), 0]).as_matrix()
        fit = fit_positions(
            Problem(
                centers=places, targets=places + rng.normal(0, 1, places.shape), has_altitudes=False,
                times=np.linspace(0, 1, len(places)), up=Up(askew @ [0.0, 0, 1], up_deg, "the views"),
            )
        )  # fmt: skip
        turn, scale = fit.similarity.rotation, fit.similarity.scale
        north = np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        off.append([max(scale, 1 / scale) - 1, abs(north), np.degrees(np.arccos(turn[2, 2]))])
        stated.append([fit.scale_error, fit.north_error_deg, fit.level_error_deg])
        assert not fit.why_refused("EXIF")
    return np.array(off), np.array(stated)


@pytest.mark.parametrize("up_deg", [12.0])
def test_scale_and_north_of_a_single_strip_are_as_open_as_its_up(up_deg):
    """Up that is off along the strip lengthens it, and nothing shows that."""
    off, stated = errors("strip", up_deg)
    assert (off <= stated).mean(axis=0) == pytest.approx(1.0, abs=0.21)
    assert (np.median(stated[:, 2]) / up_deg) == pytest.approx(2.45, abs=0.1)


@pytest.mark.parametrize("up_deg", [12.0])
def test_rows_over_each_other_tell_level_without_altitudes(up_deg):
    """A metre over a facade of 15 m is some 2 degrees, however little was known of up."""
    off, stated = errors("facade", up_deg)
    assert np.sqrt((off[:, 2] ** 2).mean()) < 3.0
    assert (off <= stated).mean(axis=0) == pytest.approx(1.0, abs=0.21)
    assert np.median(stated[:, 2]) < 6.0
