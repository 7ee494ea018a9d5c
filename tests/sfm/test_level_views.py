"""What is foretold of photographs that look level or up: facades, bridges from below, ways around towers."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from support.flights import FOCAL_MM, SENSOR_MM
from support.small_flights import flight
from vdgs.sfm.console_report import print_preflight
from vdgs.sfm.gps_priors import read_gps_priors
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.image_metadata import Attitude, attitude_from_gimbal
from vdgs.sfm.preflight import PreflightReport, make_preflight_report

HEIGHT_M = 40.0
FOCAL_PX = FOCAL_MM / SENSOR_MM * 160


def look(folder: Path, recorded: Sequence[Attitude | None]) -> tuple[PreflightReport, str]:
    """What is foretold of photographs with such attitudes, and what is printed of it."""
    flight(folder, len(recorded))
    kept = collect_images([folder])
    kept = replace(kept, images=tuple(replace(p, attitude=how) for p, how in zip(kept.images, recorded, strict=True)))
    found = make_preflight_report(kept, read_gps_priors(kept.images, None, (1.0, 2.0)))
    console = Console(width=200, record=True, file=io.StringIO())
    print_preflight(found, kept, [], console)
    return found, console.export_text()


@pytest.mark.parametrize("pitch_deg", [-25.0, 0.0, 20.0, 90.0])
def test_level_views_foretell_nothing_of_the_ground(tmp_path, pitch_deg):
    """A wall is as far away as it is, whatever the flying height. Some attitudes are unknown, and one looks down."""
    level = [attitude_from_gimbal(30 * k, pitch_deg, 0) if k % 3 else None for k in range(8)]
    found, said = look(tmp_path, [*level, attitude_from_gimbal(0, -90, 0)])
    assert found.gsd_m is found.forward_overlap is found.views_per_point is None
    assert not any("overlap" in each or "is seen by" in each for each in found.warnings)
    assert "of the ground" not in said
    assert f"level or up: {90 + pitch_deg:.0f}° from straight down (median)" in said
    assert f"about {1000 / FOCAL_PX:.2g} cm of what is 10 m away" in said
    assert found.height_m == HEIGHT_M


def test_oblique_views_show_ground_that_is_farther_away(tmp_path):
    tilts = {name: attitude_from_gimbal(0, pitch, 0) for name, pitch in (("down", -90), ("aslant", -30.01))}
    (down, _), (aslant, said), (untold, _) = (
        look(tmp_path / str(name), [tilts.get(name)] * 9) for name in ("down", "aslant", "untold")
    )
    assert down.gsd_m == pytest.approx(HEIGHT_M / FOCAL_PX)
    assert aslant.gsd_m == pytest.approx(2 * down.gsd_m, rel=1e-3)
    assert 1 - aslant.forward_overlap == pytest.approx((1 - down.forward_overlap) / 2, rel=1e-3)
    assert "of the ground" in said
    assert (untold.gsd_m, untold.forward_overlap) == (down.gsd_m, down.forward_overlap)
    assert untold.views_per_point == down.views_per_point
