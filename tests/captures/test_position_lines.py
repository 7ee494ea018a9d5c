"""Whether positions are along one line, by what is stated of them and what they were found good for."""

from __future__ import annotations

import numpy as np
import pytest

from vdgs.captures.position_lines import are_along_a_line

TURN = np.linspace(0, 2 * np.pi, 31)
ORBIT = np.stack([28 * np.cos(TURN), 33 * np.sin(TURN), 0 * TURN], axis=1)
CORRIDOR = np.stack([100 * np.cos(TURN), 3 * np.sin(TURN), 0 * TURN], axis=1)


@pytest.mark.parametrize(
    ("places", "stated_m", "found_m", "expected"),
    [
        pytest.param(ORBIT, 12.0, 0.5, False, id="a phone's orbit, which errs by the same all along"),
        pytest.param(ORBIT, 12.0, 12.0, True, id="an orbit no larger than its errors"),
        pytest.param(ORBIT, 1.0, 12.0, False, id="as stated"),
        pytest.param(CORRIDOR, 5.0, 0.5, True, id="narrow, whatever its errors"),
        pytest.param(CORRIDOR * [1, 0, 0], 5.0, 0.5, True, id="a line"),
    ],
)
def test_a_line_is_told_by_what_positions_are_found_good_for(places, stated_m, found_m, expected):
    stated, found = (np.full(places.shape, each) for each in (stated_m, found_m))
    assert are_along_a_line(places, stated, found) == expected
