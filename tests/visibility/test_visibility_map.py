"""The map of V: what the colors end with, and what lies on top."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from support.captures import camera_at
from vdgs.visibility import visibility_map
from vdgs.visibility.visibility_map import CameraMarks, VisibilityMapData, plot_visibility_map, visibility_color_norm


def test_colors_end_at_what_one_in_a_hundred_exceeds() -> None:
    top, norm = visibility_color_norm(np.append(np.arange(100), 5000))
    assert top == 99
    assert norm(98) < norm(99)
    assert visibility_color_norm(np.array([1, 2, 3]))[0] == 10  # never less: few cameras look like few


def test_what_few_cameras_see_is_drawn_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = list[tuple[Any, ...]]()
    monkeypatch.setattr(Axes, "scatter", lambda _, *given, **named: drawn.append(given))
    monkeypatch.setattr(visibility_map.style, "write_png", lambda *_: None)
    places, counts = np.random.default_rng(0).uniform(-5, 5, (200, 3)), np.arange(200) % 7
    data = VisibilityMapData(
        points=places, visibility=counts, low=np.full(2, -5.0), high=np.full(2, 5.0), ground=0.0,
        marks=[CameraMarks("cameras", [camera_at(0.0, 0.0)], "white", "black")], x_label="x", y_label="y",
        noun="an anchor", titles=("V", "", ""),
    )  # fmt: skip
    plot_visibility_map(tmp_path / "map.png", data)
    x, y, _, colors = drawn[0]
    assert (np.diff(colors) <= 0).all()
    order = np.lexsort((places[:, 0], counts))
    again = np.lexsort((x, colors))
    np.testing.assert_array_equal(np.column_stack([x, y])[again], places[order, :2])
