"""The size of photographs that suits a machine: by time, memory and what a person says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture, read_files
from vdgs.cli.common import make_console
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.errors import Interrupted
from vdgs.pipeline import dry_run, image_size, time_estimate
from vdgs.pipeline.image_size import ImageSize, choose_image_size, image_sizes, largest_suitable
from vdgs.pipeline.time_estimate import StepTimes, measure_textures
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.system.processor_time import Cost


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


def step_times(fixed: float, per_pixel: float) -> StepTimes:
    return StepTimes(
        fixed=Cost(fixed / 2, fixed), per_pixel=Cost(per_pixel / 2, per_pixel), anchor_share=0.5, slowdown=1.0
    )  # fmt: skip


def test_steps_of_all_sizes_follow_from_those_of_one():
    """A stage of a schedule in sizes: 30 % of its steps at a quarter of the pixels, 70 % whole."""
    config = replace(
        PRESETS["laptop"].training, iterations=1000, resolution_schedule=((0.0, 2), (0.3, 1)),
        densify=replace(PRESETS["laptop"].training.densify, num_levels=0),
    )  # fmt: skip
    steps = step_times(0.01, 1e-7)
    assert steps.step(1_000_000).processor_seconds == pytest.approx(0.11)
    taken = steps.stage(config, 1_000_000, 17.0, np.inf).processor_seconds
    assert taken == pytest.approx(300 * (0.01 + 0.025) + 700 * 0.11)
    assert steps.stage(config, 0, 17.0, np.inf).processor_seconds == pytest.approx(1000 * 0.01)
    twice = steps.stage(config, 1_000_000, 17.0, np.inf, start=2.0).processor_seconds
    assert twice == pytest.approx(1.5 * taken)  # half of a step goes with the anchors


def test_textured_photographs_take_longer():
    config = replace(PRESETS["laptop"].training, iterations=3000)
    steps = step_times(0.01, 1e-7)
    smooth, rough = (steps.stage(config, 100_000, texture, np.inf).seconds for texture in (10.0, 34.0))
    assert rough > 1.3 * smooth
    full = steps.stage(config, 100_000, 34.0, room=1.0).seconds
    assert full < smooth  # an anchor for each pixel: no growth


def test_texture_is_measured_at_each_size(capture):
    """A board of single pixels is gray once it is shrunk."""
    views = load_capture(capture).train_views
    board = (np.indices((1200, 1600)).sum(0) % 2 * 255).astype(np.uint8)
    for view in views:
        cv2.imwrite(str(view.image_path), np.repeat(board[..., None], 3, axis=2))
    found = measure_textures(views, [1.0, 2.0])
    assert found[1.0] > 100 > 1 > found[2.0]


def test_the_largest_that_time_and_memory_allow_is_taken():
    sizes = [ImageSize(images="images", downscale=n, width=8000 // n, height=6000 // n) for n in (1, 2, 4, 8, 16, 32)]
    hours = dict(zip(sizes, (64e3, 16e3, 4e3, 1e3, 250, 60), strict=True))
    assert largest_suitable(hours, 10**12, on_gpu=False).downscale == 8
    assert largest_suitable(hours, 4 * 10**8, on_gpu=False).downscale == 16
    assert largest_suitable(hours, 10**12, on_gpu=True).downscale == 8  # 1600 pixels would be 5
    slow = {size: 100 * value for size, value in hours.items()}
    assert largest_suitable(slow, 10**12, on_gpu=False).width == 500  # smaller ones show too little


def of_pixels(seconds: float):
    """Estimates by which training takes so many seconds for each megapixel."""

    def estimates(scene: object, sizes: list[ImageSize], asked: object) -> dict[ImageSize, SimpleNamespace]:
        return {
            size: SimpleNamespace(total=Cost(seconds * size.pixels / 1e6, 0.0), text=lambda: "about 5 min")
            for size in sizes
        }

    return estimates


def test_a_new_run_takes_it_and_says_so_in_a_line(capture, tmp_path, monkeypatch, capsys):
    asked = request(capture, tmp_path / "run")
    monkeypatch.setattr(image_size, "_estimates", of_pixels(600.0))
    choice = choose_image_size(asked, make_console())
    assert choice.request == asked
    assert choice.capture is not None  # a run of it need not read it again
    assert capsys.readouterr().out.count("\n") == 1
    monkeypatch.setattr(image_size, "_estimates", of_pixels(6000.0))
    choice = choose_image_size(asked, make_console())
    assert choice.request == replace(asked, options=CaptureOptions(images="images_2"))
    said = capsys.readouterr().out
    assert said == (
        "photographs: images_2 (800x600), not images (1600x1200); training takes about 5 min; --images overrides\n"
    )


def test_the_choice_and_the_dry_run_have_one_estimate(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(time_estimate, "MAX_TIMED_SECONDS", 0.0)
    monkeypatch.setattr(image_size, "MAX_SECONDS", 1e9)
    loaded = []
    monkeypatch.setattr(image_size, "read_files", lambda *given: loaded.append(given) or read_files(*given))
    monkeypatch.setattr(dry_run, "load_capture", lambda *given: pytest.fail("read twice"))
    estimate = dry_run.estimate_run(request(capture, tmp_path / "run"), make_console())
    chosen, *_, whole = (line for line in capsys.readouterr().out.splitlines() if " processor time)" in line)
    assert estimate.text() in chosen
    assert estimate.text() in whole
    assert len(loaded) == 1


@pytest.mark.parametrize(("seconds", "size"), [(6000.0, 800), (24000.0, 400)])
def test_the_capture_of_the_size_that_is_taken_is_that_of_its_options(capture, tmp_path, monkeypatch, seconds, size):
    monkeypatch.setattr(image_size, "_estimates", of_pixels(seconds))
    (capture / "images").rename(capture / "images_1")  # the choice leaves no note about it
    try:
        choice = choose_image_size(request(capture, tmp_path / "run"), make_console())
        opened, again = choice.capture, load_capture(capture, choice.request.options)
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
    monkeypatch.setattr(image_size, "_estimates", of_pixels(1e6))
    for options in ({"images": "images"}, {"downscale": 1.5}):
        asked = request(capture, tmp_path / "run", **options)
        assert choose_image_size(asked, make_console()).request == asked
    asked = request(capture, tmp_path / "run")
    RunFolder(tmp_path / "run").create_or_check(RunSettings.create(capture, CaptureOptions(), PRESETS["laptop"]))
    assert choose_image_size(asked, make_console()).request == asked
    assert capsys.readouterr().out == ""


def test_a_request_to_stop_ends_the_probe_of_stereo(capture, monkeypatch):
    def stopped(*_: object) -> None:
        raise Interrupted("stop")

    monkeypatch.setattr(time_estimate, "compute_dense_points", stopped)
    with pytest.raises(Interrupted):
        time_estimate.time_stereo(load_capture(capture), SimpleNamespace(), PRESETS["laptop"].training.init)
