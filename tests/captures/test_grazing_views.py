"""What of the ground is seen at grazing angles alone, the heights of flights, and what a pixel shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.captures import look_down
from support.flown_captures import camera, capture_of, facade, nadir, plane
from vdgs.captures.camera_height import height_range
from vdgs.captures.capture import Capture
from vdgs.captures.grazing_views import grazing_note, grazing_share
from vdgs.captures.place_facts import measure_place
from vdgs.captures.place_record import place_rows
from vdgs.captures.reconstruction import flying_height


def rings(*radii_heights: tuple[float, float], half: float = 120) -> Capture:
    """Rings around a place on level ground, at which all cameras look."""
    cameras = []
    for radius, height in radii_heights:
        for heading in range(0, 360, 15):
            away = radius * np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))])
            tilt = np.degrees(np.arctan2(radius, height))
            cameras.append(camera((*-away, height), tilt, heading))
    return capture_of(cameras, plane(half, half) - [0, 0, 2])


def row(capture: Capture, what: str) -> str:
    return dict(place_rows(measure_place(capture)))[what]


@pytest.mark.parametrize(
    ("flown", "low", "high"),
    [(nadir(), 0, 0), (rings((60, 10)), 0.99, 1), (rings((60, 60), half=30), 0, 0.1), (rings((60, 60)), 0.6, 0.9)],
)
def test_ground_that_is_seen_flat_alone_is_told(flown: Capture, low: float, high: float):
    share = grazing_share(flown)
    assert low <= share <= high
    assert (f"{share:.0%} of the ground" in grazing_note(share)) is (share >= 0.2)


def test_a_wall_is_no_ground_and_no_points_are_none():
    assert grazing_share(capture_of([camera((0, 0, 50), 0, 0)], np.zeros((0, 3)))) == 0
    assert 0 <= grazing_share(facade()) <= 1


def test_several_heights_are_said_and_one_along_a_slope_is_one():
    assert "median; 28 m to" not in row(nadir(), "Height of the cameras")
    assert row(nadir(), "Height of the cameras").endswith("units")
    both = row(rings((60, 20), (40, 60)), "Height of the cameras")
    assert "(median; 19" in both
    assert "to 60" in both
    flight = nadir()
    slope = flight.points + np.outer(flight.points[:, 0], [0, 0, 0.5])
    poses = [look_down(np.add(v.camera.position, (0, 0, 0.5 * v.camera.position[0])), 0, 0) for v in flight.views]
    views = [replace(v.camera, camera_from_world=pose) for v, pose in zip(flight.views, poses, strict=True)]
    assert "median" not in row(capture_of(views, slope), "Height of the cameras")


def test_a_pixel_is_that_of_what_photographs_look_at():
    """From 71 away on the ground behind the place too, which is the most of what they show."""
    assert row(rings((66, 26)), "Pixel of the photographs").startswith("0.236 units on what all of them look at")
    assert " on the ground " in row(nadir(), "Pixel of the photographs")
    assert " on what they show (median) " in row(facade(), "Pixel of the photographs")


def test_rings_at_two_heights_are_said_before_and_after_the_reconstruction():
    assert height_range([28.0] * 20 + [62.0] * 14) == (28, 62)
    assert height_range([45.0, 46.5, 44.0, 50.0]) is None
    assert height_range([60.0] * 39 + [2.0]) is None  # one on the ground
    assert flying_height(27.7, (27.6, 61.8)) == "27.7 m (median; 27.6 to 61.8 m)"
    assert flying_height(45.0, None) == "45.0 m"
