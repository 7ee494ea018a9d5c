"""The size of photographs that suits a machine: by time, memory and what a person says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture, read_files
from vdgs.cli.common import make_console
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import LossConfig, block_train_config
from vdgs.config.presets import PRESETS
from vdgs.errors import CaptureError, Interrupted, VdgsError
from vdgs.pipeline import dry_run, image_size, run_estimate, time_estimate
from vdgs.pipeline.image_size import ImageSize, choose_image_size, count_views, image_sizes, largest_suitable
from vdgs.pipeline.time_estimate import Growth, StepTimes, measure_textures
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.system.processor_time import Cost

pytestmark = [pytest.mark.xdist_group("image_size"), pytest.mark.slow]  # whole reconstructions, runs or trainings


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


def step_times(fixed: float, per_pixel: float, per_anchor: float = 0.0) -> StepTimes:
    costs = [Cost(seconds / 2, seconds) for seconds in (fixed, per_pixel, per_anchor)]
    return StepTimes(fixed=costs[0], per_pixel=costs[1], per_anchor=costs[2], slowdown=1.0)


def test_steps_of_all_sizes_follow_from_those_of_one():
    """A stage of a schedule in sizes: 30 % of its steps at a quarter of the pixels, 70 % whole."""
    config = replace(
        PRESETS["laptop"].training, iterations=1000, resolution_schedule=((0.0, 2), (0.3, 1)), loss=LossConfig()
    )
    steps = step_times(0.01, 1e-7)
    assert steps.step(1_000_000, 0).processor_seconds == pytest.approx(0.11)
    taken = steps.stage(config, 1_000_000, 1e5, 1.0).processor_seconds
    assert taken == pytest.approx(300 * (0.01 + 0.025) + 700 * 0.11)
    assert steps.stage(config, 0, 1e5, 1.0).processor_seconds == pytest.approx(1000 * 0.01)
    pseudo = replace(config, loss=replace(config.loss, pseudo_views=0.3))
    assert steps.stage(pseudo, 0, 1e5, 1.0).processor_seconds == pytest.approx(1000 * 0.01 * 1.16)
    with_anchors = step_times(0.01, 1e-7, 1e-6).stage(config, 1_000_000, 1e5, 1.0).processor_seconds
    assert with_anchors == pytest.approx(taken + 1000 * 0.1)


def test_steps_are_divided_into_what_pixels_take_and_what_anchors_take(monkeypatch):
    """Of a machine whose steps take 1 ms, 100 ns for each pixel and 1 us for each anchor."""
    cameras = {1: SimpleNamespace(width=1000, height=800), 4: SimpleNamespace(width=250, height=200)}
    stage = SimpleNamespace(images=SimpleNamespace(camera=lambda index, factor: cameras[factor]))

    def cost(stage: object, anchors: torch.Tensor, factor: int, fit: bool) -> tuple[Cost, float]:
        seconds = 1e-3 + 1e-7 * cameras[factor].width * cameras[factor].height + 1e-6 * len(anchors)
        return Cost(seconds / 2, seconds), 1.0

    monkeypatch.setattr(time_estimate, "_step_cost", cost)
    steps = time_estimate.time_steps(stage, Selectable(60_000), False)
    assert steps.step(2_000_000, 100_000).processor_seconds == pytest.approx(1e-3 + 0.2 + 0.1)
    assert steps.step(2_000_000, 100_000).seconds == pytest.approx((1e-3 + 0.2 + 0.1) / 2)


class Selectable(list):
    """Stands for so many anchors."""

    def __init__(self, count: int) -> None:
        super().__init__(range(count))

    def select(self, mask: torch.Tensor) -> Selectable:
        return Selectable(int(mask.sum()))


def growth(texture: float, more: float = 1.0, room: float = np.inf) -> Growth:
    return Growth(texture=texture, more=more, room=room)


def test_anchors_grow_with_the_texture_until_each_has_its_pixel():
    config = replace(PRESETS["laptop"].training, iterations=3000)
    smooth, rough = (growth(texture).coarse(config) for texture in (10.0, 34.0))
    assert 1 < smooth < rough / 1.3
    assert growth(34.0, room=1.0).coarse(config) == 1  # an anchor for each pixel
    assert growth(34.0, room=2.0).coarse(config) == 2
    assert growth(34.0, more=3.0).coarse(config) - 1 == pytest.approx((rough - 1) / 3)  # what stereo adds does not grow
    frozen = replace(config, densify=replace(config.densify, num_levels=0))
    assert growth(34.0).coarse(frozen) == 1


def test_blocks_go_on_growing_where_the_coarse_model_ended():
    method = PRESETS["laptop"]
    coarse, block = replace(method.training, iterations=3000), block_train_config(method, 15)
    first = growth(34.0).coarse(coarse)
    later = growth(34.0).block(coarse, block)
    assert 1 < later < 1.1 < first
    paper = PRESETS["paper"]
    assert growth(34.0).block(coarse, block_train_config(paper, 15)) > 5  # compensated below a fixed threshold


def test_texture_is_measured_at_each_size(capture):
    """A board of single pixels is gray once it is shrunk."""
    views = load_capture(capture).train_views
    board = (np.indices((1200, 1600)).sum(0) % 2 * 255).astype(np.uint8)
    for view in views:
        cv2.imwrite(str(view.image_path), np.repeat(board[..., None], 3, axis=2))
    found = measure_textures(views, [1.0, 2.0])
    assert found[1.0] > 100 > 1 > found[2.0]


def test_photographs_that_are_left_out_take_no_time():
    assert count_views(2000, CaptureOptions()) == (1750, 250)
    assert count_views(2000, CaptureOptions(max_images=50, test_every=10)) == (45, 5)


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
    asked = []
    estimate_at = run_estimate.estimate_at
    monkeypatch.setattr(image_size, "estimate_at", lambda *given: asked.append(given) or estimate_at(*given))
    estimate = dry_run.estimate_run(request(capture, tmp_path / "run"), make_console())
    chosen, *_, whole = (line for line in capsys.readouterr().out.splitlines() if " processor time)" in line)
    assert estimate.text() in chosen
    assert estimate.text() in whole
    assert len(loaded) == 1
    scene, probed, *rest = asked[-1]
    plain, leveled = (run_estimate.estimate_at(scene, replace(probed, has_levels=has), *rest) for has in (False, True))
    assert leveled.anchors == pytest.approx(1.7 * plain.anchors, abs=1)
    assert leveled.coarse_bytes > plain.coarse_bytes
    assert leveled.times["coarse"].seconds == pytest.approx(1.1 * plain.times["coarse"].seconds)


def test_a_dry_run_refuses_and_tells_what_the_run_would(tmp_path, monkeypatch, capsys):
    """Photographs that are damaged, points in one place, an output among the photographs; at the cost of a sample."""
    place, scene = tmp_path / "capture", tiny_scene(points=60)
    write_colmap(place, scene)
    asked = request(place, tmp_path / "run", images="images")
    monkeypatch.setattr(dry_run, "estimate_capture", lambda *_: None)
    monkeypatch.setattr(dry_run, "_print_estimate", lambda *_: None)
    monkeypatch.setattr(dry_run, "SAMPLE", 4)
    dry_run.estimate_run(asked, make_console())
    said = capsys.readouterr().out
    assert f"4 of {len(scene.cameras)} photographs were decoded; the run decodes all" in said
    with pytest.raises(VdgsError, match="Nothing was written"):
        dry_run.estimate_run(replace(asked, output=place / "images" / "run"), make_console())
    photographs = sorted((place / "images").iterdir())
    whole = photographs[0].read_bytes()
    photographs[0].write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaptureError, match=rf"(?s)cannot be used.*{photographs[0].name}"):
        dry_run.estimate_run(asked, make_console())
    photographs[0].write_bytes(whole)
    write_colmap(place, replace(scene, points=np.repeat(scene.points[:1], 60, axis=0)))
    with pytest.raises(CaptureError, match="cannot become a scene"):
        dry_run.estimate_run(asked, make_console())


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
