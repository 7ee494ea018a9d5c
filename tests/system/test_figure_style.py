"""Figures with names that people choose: each is drawn as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.position_plots import plot_positions, plot_residuals
from vdgs.system.figure_style import draw_titles, new_figure, write_png

#: Two dollars enclose a formula, and this one is none.
NAME = r"$5_site_$7 \frac"


def test_titles_may_have_dollars(tmp_path: Path):
    figure, _ = new_figure(4.0, 2.0)
    draw_titles(figure, NAME, NAME, NAME)
    write_png(figure, tmp_path / "a.png")
    assert [text.get_text() for text in figure.texts] == [NAME] * 3


@pytest.mark.parametrize("what", ["a title", "a surveyed point"])
def test_positions_may_have_dollars(tmp_path: Path, what: str):
    enu = np.array([[0.0, 0, 5], [4, 1, 5], [8, 0, 5]])
    positions = GpsPriors(
        image_indices=np.arange(3), enu=enu, gps_std=np.ones((3, 3)), origin=(48.0, 11.0, 500.0),
        altitude_reference="", source="", notes=(),
    )  # fmt: skip
    file = tmp_path / "a.png"
    if what == "a title":
        plot_positions(positions, [0, 1, 2], NAME, file)
    else:
        plot_residuals(enu, positions, None, {NAME: enu[1]}, file)
    assert file.stat().st_size > 1000
