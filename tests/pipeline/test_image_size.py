"""The size of photographs that suits a machine: by time, memory and what a person says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture
from vdgs.cli.common import make_console
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.pipeline import image_size
from vdgs.pipeline.image_size import (
    ImageSize,
    choose_image_size,
    image_sizes,
    largest_suitable,
    open_at_suitable_size,
    run_seconds,
)
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with photographs of 1600 pixels, and the same of 800."""
    folder = tmp_path_factory.mktemp("sizes") / "capture"
    write_colmap(folder, tiny_scene(columns=3, rows=2, width=1600, height=1200, points=60))
    (folder / "images_2").mkdir()
    (folder / "images_4").mkdir()  # without all photographs: it is none
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(folder / "images_2" / path.name), np.zeros((600, 800, 3), np.uint8))
    return folder


def request(capture: Path, output: Path, **options: object) -> RunRequest:
    method = vars(PRESETS["laptop"])
    return RunRequest(
        capture=capture,
        output=output,
        device="cpu",
        threads=2,
        options=CaptureOptions(**options),
        **method,  # type: ignore[arg-type]
    )


def test_the_sizes_of_a_capture_are_its_folders_and_the_smallest_of_them_shrunk(capture):
    sizes = image_sizes(load_capture(capture), CaptureOptions())
    assert [(each.images, each.downscale) for each in sizes[:4]] == [
        ("images", 1), ("images_2", 1), ("images_2", 2), ("images_2", 3),
    ]  # fmt: skip
    assert [each.width for each in sizes[:3]] == [1600, 800, 400]
    undistorted = image_sizes(load_capture(capture), CaptureOptions(undistort=True))
    assert {each.images for each in undistorted} == {"images"}


def test_time_follows_pixels_photographs_and_cores():
    laptop = PRESETS["laptop"]
    base = run_seconds(laptop, 200, 1_000_000, 4)
    assert run_seconds(laptop, 200, 2_000_000, 4) == pytest.approx(2 * base)
    assert run_seconds(laptop, 200, 1_000_000, 8) == pytest.approx(base / 2)
    assert run_seconds(laptop, 400, 1_000_000, 4) == pytest.approx(2 * base)
    assert run_seconds(PRESETS["default"], 200, 1_000_000, 4) > 10 * base
    # Measured: 166 photographs of 0.12 megapixels took 22 minutes with one thread.
    assert 15 * 60 < run_seconds(laptop, 145, 404 * 301, 1) < 45 * 60


def test_the_largest_that_time_and_memory_allow_is_taken():
    sizes = [ImageSize(images="images", downscale=n, width=8000 // n, height=6000 // n) for n in (1, 2, 4, 8, 16, 32)]
    hours = dict(zip(sizes, (64e3, 16e3, 4e3, 1e3, 250, 60), strict=True))
    assert largest_suitable(hours, 10**12, on_gpu=False).downscale == 8
    assert largest_suitable(hours, 4 * 10**8, on_gpu=False).downscale == 16
    assert largest_suitable(hours, 10**12, on_gpu=True).downscale == 8  # 1600 pixels would be 5
    slow = {size: 100 * value for size, value in hours.items()}
    assert largest_suitable(slow, 10**12, on_gpu=False).width == 500  # smaller ones show too little


def test_a_new_run_takes_it_and_says_so_in_a_line(capture, tmp_path, monkeypatch, capsys):
    asked = request(capture, tmp_path / "run")
    monkeypatch.setattr(image_size, "PIXELS_PER_CORE_SECOND", 1e7)
    assert choose_image_size(asked, make_console()) == asked
    assert capsys.readouterr().out.count("\n") == 1
    monkeypatch.setattr(image_size, "PIXELS_PER_CORE_SECOND", 2e5)
    chosen = choose_image_size(asked, make_console())
    assert chosen == replace(asked, options=CaptureOptions(images="images_2"))
    said = capsys.readouterr().out
    assert said.startswith("photographs: images_2 (800x600), not images (1600x1200), about ")
    assert said.endswith("; --images overrides\n")


@pytest.mark.parametrize(("pixels_per_second", "size"), [(2e5, 800), (5e4, 400)])
def test_the_capture_of_the_size_that_is_taken_is_that_of_its_options(
    capture, tmp_path, monkeypatch, pixels_per_second, size
):
    monkeypatch.setattr(image_size, "PIXELS_PER_CORE_SECOND", pixels_per_second)
    (capture / "images").rename(capture / "images_1")  # the choice leaves no note about it
    try:
        chosen, opened = open_at_suitable_size(request(capture, tmp_path / "run"), make_console())
        again = load_capture(capture, chosen.options)
        assert opened is not None
        assert (opened.warnings, opened.images) == (again.warnings, again.images)
        for one, other in zip(opened.views, again.views, strict=True):
            assert (one.image_path, one.mask_path, one.split) == (other.image_path, other.mask_path, other.split)
            assert one.camera.width == size
            assert np.array_equal(one.camera.packed_float64, other.camera.packed_float64)
        assert np.array_equal(opened.points, again.points)
    finally:
        (capture / "images_1").rename(capture / "images")


def test_what_a_person_says_and_a_run_that_is_there_are_kept(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(image_size, "PIXELS_PER_CORE_SECOND", 1.0)
    for options in ({"images": "images"}, {"downscale": 1.5}):
        asked = request(capture, tmp_path / "run", **options)
        assert choose_image_size(asked, make_console()) == asked
    asked = request(capture, tmp_path / "run")
    RunFolder(tmp_path / "run").create_or_check(RunSettings.create(capture, CaptureOptions(), PRESETS["laptop"]))
    assert choose_image_size(asked, make_console()) == asked
    assert capsys.readouterr().out == ""
