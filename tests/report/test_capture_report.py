"""Inspection: the numbers are right, the report can be read back, the figures are drawn."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from support.captures import TinyScene, data_folder, tiny_scene, write_colmap
from vdgs.captures.loading import load_capture
from vdgs.captures.place_record import place_rows
from vdgs.captures.validation import validate_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.similarity import sample_points
from vdgs.report.capture_report import inspect_capture, print_report
from vdgs.report.capture_stats import measure_capture
from vdgs.system.units import format_length
from vdgs.visibility.visibility_counts import count_visibility, visibility_stats

pytestmark = pytest.mark.slow


@pytest.fixture
def capture(tmp_path):
    write_colmap(tmp_path / "capture", tiny_scene())
    return load_capture(tmp_path / "capture", CaptureOptions(up="z"))


def test_visibility_is_a_count_of_frusta(capture):
    """V against one projection at a time, written out."""
    visibility = count_visibility(
        torch.from_numpy(capture.points), [view.camera for view in capture.train_views]
    ).numpy()
    for index in range(0, len(capture.points), 17):
        seen = 0
        for view in capture.train_views:
            camera = view.camera
            x, y, z = camera.camera_from_world[:3] @ [*capture.points[index], 1.0]
            if z > 0.01:
                column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
                seen += 0 <= column < camera.width and 0 <= row < camera.height
        assert visibility[index] == seen


def test_the_report_says_what_is_there(capture, tmp_path):
    report = inspect_capture(capture, tmp_path / "out")
    visibility = count_visibility(
        torch.from_numpy(capture.points), [view.camera for view in capture.train_views]
    ).numpy()
    assert (report.num_images, report.train, report.test) == (12, 10, 2)
    assert report.image_sizes == [(64, 48)]
    assert report.image_bytes == 12 * 64 * 48 * 3
    assert report.fraction_below[5] == pytest.approx((visibility < 5).mean())
    assert report.visibility_quantiles[50] == np.median(visibility)
    assert report.camera_height[1] == pytest.approx(10, abs=0.1)
    assert report.place.ground_sampling_distance == pytest.approx(10 / (0.9 * 64), rel=0.2)
    assert not report.metric
    stored = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert stored["points"] == report.points
    assert stored["fraction_below"]["3"] == report.fraction_below[3]
    for name in report.figures:
        pixels = cv2.imread(str(tmp_path / "out" / name))
        assert pixels.shape[1] > 900
        assert pixels.std() > 10


def test_photographs_that_are_shrunk_are_said_to_be(capture, tmp_path):
    shrunk = load_capture(capture.root, CaptureOptions(up="z", downscale=1.5))
    report = inspect_capture(shrunk, tmp_path / "out")
    assert report.place.image_source == "images with --downscale 1.5"
    assert ("Pixel of the photographs", "26.2 cm on the ground (images with --downscale 1.5, as used)") in place_rows(
        replace(report.place, unit="m", ground_sampling_distance=0.262)
    )


def test_the_spacing_is_that_of_all_points_whatever_is_looked_at(capture):
    """A sample lies as much farther apart as it is thinner."""
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    grid = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], axis=1)
    dense = replace(capture, points=grid, point_colors=np.zeros((1600, 3), np.uint8))
    some = grid[::37]
    report = measure_capture(dense, some, np.full(len(some), 5), validate_capture(dense), None)
    assert report.point_spacing == pytest.approx(1.0)


def test_in_a_run_it_gets_a_folder_of_its_own(capture, tmp_path):
    (tmp_path / "config.yaml").write_text("vdgs:\n  version: 1\n")
    before = {"capture", "config.yaml"}
    inspect_capture(capture, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == before | {"inspect"}
    assert (tmp_path / "inspect/report.json").is_file()


def test_the_table_is_printed_with_its_warnings(tmp_path):
    """Photographs of one corner only: most points are seen by hardly any camera, and the report says so."""
    scene = tiny_scene()
    corner = TinyScene(dict(list(scene.cameras.items())[:3]), scene.points, scene.colors)
    write_colmap(tmp_path, corner)
    report = inspect_capture(load_capture(tmp_path, CaptureOptions(up="z")), tmp_path / "out")
    stream = io.StringIO()
    print_report(report, Console(file=stream, width=120))
    printed = stream.getvalue()
    assert "3 of 3 used (2 for training, 1 for tests)" in printed
    assert "Warning: " in printed
    assert "fewer than 3 training cameras" in " ".join(printed.split())


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=60))
def test_gini_is_the_mean_difference(values):
    array = np.array(values)
    found = visibility_stats(array).gini
    if array.sum() == 0:
        assert found == 0
        return
    differences = np.abs(array[:, None] - array[None]).mean()
    assert found == pytest.approx(differences / (2 * array.mean()), abs=1e-9)


def test_samples_are_repeatable_and_lengths_are_for_people():
    points = np.arange(3000.0).reshape(1000, 3)
    np.testing.assert_array_equal(sample_points(points, 100), sample_points(points, 100))
    assert len(np.unique(sample_points(points, 100)[:, 0])) == 100
    assert sample_points(points, 1000) is points
    assert (format_length(0.0567, "m"), format_length(12.3, "m"), format_length(0.05, "units")) == (
        "5.67 cm",
        "12.3 m",
        "0.05 units",
    )
    assert format_length(None, "m") == "unknown"


@pytest.mark.capture
def test_a_real_capture_is_as_its_readme_says(tmp_path):
    """copr: 21.1 m to the surface and 0.99 cm per pixel at full size, so 3.96 at a quarter."""
    report = inspect_capture(load_capture(data_folder("copr", "images_4"), CaptureOptions(images="images_4")), tmp_path)
    assert report.place.ground_sampling_distance == pytest.approx(0.0396, rel=0.05)
    assert report.tilt_deg == pytest.approx(8.2, abs=0.1)
    assert report.warnings == []
