"""Strips and obliques of a flight, left out as a whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vdgs.captures.capture import View
from vdgs.captures.flight_parts import flight_strips, oblique_views
from vdgs.captures.splits import assign_splits
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import Camera
from vdgs.synth.flight_cameras import pose_from_angles


def view(number: int, x: float, y: float, tilt_degrees: float) -> View:
    pose = pose_from_angles(np.array([x, y, 50.0]), np.radians(tilt_degrees), 0.3 * number, 0.0)
    camera = Camera(camera_from_world=pose, fx=80.0, fy=80.0, cx=50.0, cy=40.0, width=100, height=80)
    return View(name=f"DJI_{number}.jpg", camera=camera, image_path=Path(), mask_path=None, split="train")


def flight(obliques: int = 6) -> list[View]:
    """Five strips of six photographs, there and back, then obliques along a line; names sort unlike numbers."""
    rng = np.random.default_rng(0)
    places = [(10.0 * (k if row % 2 == 0 else 5 - k), 15.0 * row) for row in range(5) for k in range(6)]
    places += [(8.0 * k, -40.0) for k in range(obliques)]
    shaken = np.array(places) + rng.normal(0, 0.5, (len(places), 2))
    return [view(k, x, y, 3.0 if k < 30 else 45.0) for k, (x, y) in enumerate(shaken)]


def sides_of(views: list[View], **options: object) -> tuple[set[int], set[int]]:
    """The numbers of the photographs that test, and that train."""
    settings = CaptureOptions(**options)  # type: ignore[arg-type]
    chosen = assign_splits(Path("flight"), views, dict.fromkeys([v.name for v in views]), settings, [], images="images")
    sides: dict[str, set[int]] = {"test": set(), "train": set()}
    for each in chosen:
        sides[each.split].add(int(each.name[4:-4]))
    return sides["test"], sides["train"]


def test_strips_and_obliques_are_found() -> None:
    views = flight()
    numbers = [[int(views[k].name[4:-4]) for k in strip] for strip in flight_strips(views)]
    assert numbers == [list(range(start, start + 6)) for start in range(0, 36, 6)]
    assert oblique_views(views) == list(range(30, 36))


@pytest.mark.parametrize(("gap", "tilt"), [(50.0, 3.0), (10.0, 45.0)])
def test_a_strip_ends_at_a_jump_and_where_the_camera_tilts(gap: float, tilt: float) -> None:
    views = [view(k, 10.0 * k + (gap - 10.0) * (k > 5), 0.0, tilt if k > 5 else 3.0) for k in range(12)]
    assert flight_strips(views) == [[*range(6)], [*range(6, 12)]]


def test_a_circle_is_no_strip_however_slowly_it_turns() -> None:
    """By 12 degrees each step: by 30 after five."""
    turns = np.radians(12.0 * np.arange(60))
    views = [view(k, 50 * np.cos(turn), 50 * np.sin(turn), 3.0) for k, turn in enumerate(turns)]
    assert max(map(len, flight_strips(views))) < 10


def test_whole_strips_are_left_out() -> None:
    test, train = sides_of(flight(0), split="strips")
    assert test == set(range(12, 18))
    assert train == set(range(30)) - test
    chosen, others = sides_of(flight(0), split="strips", validation=True)
    assert chosen == set(range(6, 12))
    assert others == set(range(30)) - test - chosen


def test_obliques_are_left_out() -> None:
    assert sides_of(flight(), split="obliques") == (set(range(30, 36)), set(range(30)))
    chosen, train = sides_of(flight(), split="obliques", validation=True)
    assert len(chosen) == 3
    assert chosen < set(range(30, 36))
    assert train == set(range(30))


@pytest.mark.parametrize(
    ("split", "message"), [("obliques", "0 of 8 photographs look more than 25"), ("strips", "1 straight")]
)
def test_a_flight_without_them_is_refused(split: str, message: str) -> None:
    views = [view(k, 10.0 * k, 0.0, 2.0) for k in range(8)]
    with pytest.raises(CaptureError, match=message):
        sides_of(views, split=split)
