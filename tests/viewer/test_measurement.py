"""What is said of distances that were measured in the viewer, without a scene."""

from __future__ import annotations

import re

import numpy as np

from vdgs.viewer.measure_panel import scale_markdown
from vdgs.viewer.measurement import KnownDistance, MeasuredPoint, Ruler


def test_no_metres_are_said_of_a_scene_without_a_scale():
    ruler = Ruler("units")
    for corner in ((0, 0, 0), (2, 0, 0), (2, 3, 0)):
        ruler.add(MeasuredPoint(np.array(corner, float)))
    assert "3.00 square units" in ruler.to_markdown()
    assert re.search(r"\bm\b|m²", ruler.to_markdown()) is None


def test_known_distances_say_how_large_a_unit_is_and_what_contradicts_itself():
    one, other = MeasuredPoint(np.zeros(3)), MeasuredPoint(np.array([0.0, 0.0, 4.0]))
    known = [KnownDistance(one, other, 10.0), KnownDistance(one, other, 10.2)]
    said = scale_markdown(known, "my place")
    assert "**2.525 m**" in said
    assert "vdgs run 'my place' --scale-bar known-distances.txt" in said
    assert "contradict" not in said
    assert "contradict" in scale_markdown([*known, KnownDistance(one, other, 20.0)], "my place")
