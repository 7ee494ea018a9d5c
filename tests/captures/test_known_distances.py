"""Metres by known distances: a capture without a scale gets one, one with a scale is held against them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.formats.source_capture import Intrinsics, SourceView
from vdgs.captures.known_distances import LEAST_SHARE, LocatedPoint, known_scale_of_views, scale_of_distances
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.geometry.camera import Camera

#: Two places of the scene, and how many of its units make a metre in these tests.
ONE, OTHER, UNITS_PER_METER = np.array([-1.0, -0.5, 0.0]), np.array([1.5, 0.8, 0.0]), 0.25
METERS = float(np.linalg.norm(ONE - OTHER)) / UNITS_PER_METER

LENS = Intrinsics("PINHOLE", (3000.0, 3000.0, 2000.0, 1500.0), 4000, 3000)
GROUND = np.random.default_rng(1).uniform([-60, -45, -2], [60, 45, 2], (100, 3))


def mark(kind: str, name: str, place: np.ndarray, photograph: str, camera: Camera) -> str:
    x, y = camera.project(place[None])[0][0]
    if kind == "ray":
        return f"{name} ray {(x - camera.cx) / camera.fx} {(y - camera.cy) / camera.fy} {photograph}"
    return f"{name} {x} {y} {photograph}"


def bars(file: Path, meters: float = METERS, kind: str = "ray", most: int = 4) -> Path:
    lines = ["# a comment"]
    for name, place in (("A", ONE), ("B", OTHER)):
        seen = [each for each in tiny_scene().cameras.items() if each[1].in_frustum(place[None])[0]]
        lines += [mark(kind, name, place, *each) for each in seen[:most]]
    file.write_text("\n".join([*lines, f"A B {meters}", ""]))
    return file


@pytest.fixture
def capture(tmp_path) -> Path:
    write_colmap(tmp_path / "capture", tiny_scene())
    return tmp_path / "capture"


@pytest.mark.parametrize("kind", ["ray", "pixel"])
def test_a_capture_without_scale_gets_metres(capture, tmp_path, kind):
    options = CaptureOptions(up="z", scale_bar=bars(tmp_path / "bars.txt", kind=kind))
    ground = load_capture(capture, options).ground
    assert ground.metric
    assert ground.scale == pytest.approx(1 / UNITS_PER_METER, rel=1e-4)
    apart = np.linalg.norm(np.diff(ground.to_ground(np.stack([ONE, OTHER])), axis=0))
    assert apart == pytest.approx(METERS, rel=1e-4)
    assert ground.accuracy.startswith("scale ±")
    assert "10 units" not in ground.description


def test_marks_in_pixels_are_those_of_the_cameras_whatever_size_is_used(capture, tmp_path):
    options = CaptureOptions(up="z", downscale=2.0, scale_bar=bars(tmp_path / "bars.txt", kind="pixel"))
    assert load_capture(capture, options).ground.scale == pytest.approx(1 / UNITS_PER_METER, rel=1e-4)


def test_a_georeference_keeps_its_place_and_takes_the_scale_unless_that_contradicts_it(capture, tmp_path):
    place = {"frame": "ENU", "origin_lat_deg": 48.0, "origin_lon_deg": 11.0, "origin_alt_m": 500.0}
    (capture / "georef.json").write_text(json.dumps(place))
    length = METERS * UNITS_PER_METER
    before = load_capture(capture)
    after = load_capture(capture, CaptureOptions(scale_bar=bars(tmp_path / "bars.txt", 1.03 * length)))
    assert after.ground.scale == pytest.approx(1.03, rel=1e-4)
    assert after.ground.origin_geo == before.ground.origin_geo
    assert np.median(after.points, axis=0) == pytest.approx(np.median(before.points, axis=0), abs=0.02)
    with pytest.raises(CaptureError, match=r"times as large.*feet"):
        load_capture(capture, CaptureOptions(scale_bar=bars(tmp_path / "bars.txt", length / 0.3048)))


#: What marks are off by in `located`, and how far the ends of a distance are off along it then, in its unit.
OFF_PX, OFF = 5.0, 0.07


def located(pixel: float = 0.01, **places: float) -> dict[str, LocatedPoint]:
    """Points on a line, in units of the world, whose many marks are off by 5 pixels; each so far along the line that
    two are apart by `OFF` more or less, for pixels of 1 cm."""
    spread = np.diag([(pixel / 0.01 * OFF) ** 2 / OFF_PX**2, 0, 0])  # of two ends, marks off by half in x, half in y
    return {name: LocatedPoint(np.array([x, 0.0, 0.0]), OFF_PX, 1000, spread) for name, x in places.items()}


@pytest.mark.parametrize("length", [10.0, 100.0])
def test_two_distances_that_differ_are_as_far_from_their_mean(length):
    points = located(0.001, A=0.0, B=length, C=0.0, D=length)
    scale, share = scale_of_distances([("A", "B", 0.98 * length), ("C", "D", 1.02 * length)], points, 0.001, "bars")
    assert scale == pytest.approx((0.98 * 1.02) ** 0.5)
    assert share == pytest.approx(0.01, rel=0.03)  # half of what the farther is from the mean


def test_distances_count_by_what_their_marks_leave_in_doubt():
    """A share of 0.7 % in 10 units, and of 0.07 % in 100 beside 0.2 % of the tape."""
    points = located(A=0.0, B=100.0, C=0.0, D=10.0)
    scale, share = scale_of_distances([("A", "B", 100.0), ("C", "D", 10.1)], points, 0.01, "bars")
    doubts = np.hypot(LEAST_SHARE, OFF / np.array([100.0, 10.0]))
    weights = doubts**-2 / (doubts**-2).sum()
    assert scale == pytest.approx(1.01 ** weights[1], rel=1e-5)
    assert 1 < scale < 1.001
    alone, doubt = scale_of_distances([("A", "B", 100.0)], points, 0.01, "bars")
    assert (alone, doubt) == (pytest.approx(1.0), pytest.approx(doubts[0], rel=1e-3))
    assert share == pytest.approx(abs(1.01 / scale - 1) / 2)


def seen_from_above(file: Path, ends: np.ndarray, baseline: float, rng: np.random.Generator) -> list[SourceView]:
    """Two views from 100 m down, and a file of a known distance between two points, marked within a pixel."""
    views, lines = [], []
    for number, x in enumerate((-baseline / 2, baseline / 2)):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = [-x, 0.0, 100.0]
        views.append(SourceView(name=f"{number}.jpg", camera_from_world=pose, intrinsics=LENS))
        there = ends @ pose[:3, :3].T + pose[:3, 3]
        marks = 3000 * there[:, :2] / there[:, 2:] + [2000, 1500] + rng.normal(0, 1, (2, 2))
        lines += [f"{name} {px} {py} {number}.jpg" for name, (px, py) in zip("AB", marks, strict=True)]
    file.write_text("\n".join([*lines, f"A B {np.linalg.norm(ends[1] - ends[0])}"]))
    return views


@pytest.mark.parametrize(
    ("end", "said"), [((0, 0, 6), (0.06, 0.11)), ((6, 4, 4), (0.03, 0.05)), ((6, 0, 0), (0.009, 0.015))]
)
def test_what_rays_leave_open_along_the_line_of_sight_is_said(tmp_path, end, said):
    """Twice the deviation holds 95 % of true errors: of a mast as of a level distance."""
    rng, ends = np.random.default_rng(2), np.array([[0, 0, 0], end], float)
    tries = [known_scale_of_views(tmp_path / "bar.txt", seen_from_above(tmp_path / "bar.txt", ends, 25.0, rng), GROUND)
             for _ in range(40)]  # fmt: skip
    scales, shares = np.array(tries).T
    assert np.mean(np.abs(scales - 1) <= 2 * shares) >= 0.9
    assert said[0] < 2 * np.median(shares) < said[1]


def test_a_distance_along_the_line_of_sight_of_near_views_is_refused_unless_others_tell_the_scale(tmp_path):
    file, ends = tmp_path / "bar.txt", np.array([[0.0, 0, 0], [0, 0, 6]])
    views = seen_from_above(file, ends, 4.0, np.random.default_rng(4))
    with pytest.raises(CaptureError, match=r"to ±\d+% only.*from other sides"):
        known_scale_of_views(file, views, GROUND)
    upright = file.read_text()
    seen_from_above(file, np.array([[-30.0, 0, 0], [30, 0, 0]]), 4.0, np.random.default_rng(5))
    file.write_text(f"{upright}\n" + file.read_text().replace("A ", "C ").replace("B ", "D "))
    scale, share = known_scale_of_views(file, views, GROUND)
    assert scale == pytest.approx(1, abs=2 * share)
    assert share < 0.03


def test_marks_that_meet_behind_the_cameras_mark_no_point(capture, tmp_path):
    behind = np.array([0.0, 0.0, 500.0])
    seen = [each for each in tiny_scene().cameras.items() if each[1].project(behind[None])[1][0] < 0]
    lines = [mark("ray", "A", behind, *each) for each in seen[:4]]
    file = bars(tmp_path / "bars.txt")
    file.write_text("\n".join([*lines, *(line for line in file.read_text().splitlines() if line[:5] != "A ray")]))
    with pytest.raises(CaptureError, match="the point A is not shown by two placed photographs that agree"):
        load_capture(capture, CaptureOptions(up="z", scale_bar=file))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("A B\n", r"line 1: 'A B' is not"), ("A B nan\n", "line 1"), ("A B -2\n", "line 1"),
        ("A ray 0.1 x 0.png\nA B 2\n", "line 1"), ("A 1 2 no.png\nA B 2\n", "no photograph 'no.png'"),
        ("# nothing\n", "names no distance"), ("A B 2\n", "A is marked in fewer than two"),
        ("A 1e9 2 00.png\nA B 2\n", "outside"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_said(capture, tmp_path, text, said):
    first = next(iter(tiny_scene().cameras))
    (tmp_path / "bars.txt").write_text(text.replace("00.png", first))
    with pytest.raises(CaptureError, match=said):
        load_capture(capture, CaptureOptions(up="z", scale_bar=tmp_path / "bars.txt"))


def test_a_file_that_is_not_there_and_distances_that_contradict_each_other_are_refused(capture, tmp_path):
    with pytest.raises(CaptureError, match="cannot be read"):
        load_capture(capture, CaptureOptions(up="z", scale_bar=tmp_path / "none.txt"))
    file = bars(tmp_path / "bars.txt")
    file.write_text(file.read_text() + f"B A {1.4 * METERS}\n")
    with pytest.raises(CaptureError, match="contradict each other"):
        load_capture(capture, CaptureOptions(up="z", scale_bar=file))
