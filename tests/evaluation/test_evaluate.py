"""An evaluation from views to files."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from support.photographs import as_render, load_mask, noisy, photograph, psnr, real_photographs, ssim, view
from vdgs.errors import CaptureError, RunError, TrainingDiverged
from vdgs.evaluation import comparison_images, metrics
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.lpips import Lpips, LpipsScores
from vdgs.evaluation.renderable_model import EvaluatedModel, EvaluationSettings, ReferenceViews, RenderableModel
from vdgs.system.atomic_files import to_jsonable, write_json

pytestmark = [pytest.mark.xdist_group("evaluate"), pytest.mark.slow]

NAMES = ["a/b.jpg", "c/b.jpg", "a/b.png", "plain.jpg"]


class City:
    """Four photographs and a poor renderer of them, found by where the camera stands."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.views = [view(name, shift=float(i)) for i, name in enumerate(NAMES)]
        self.photographs = [photograph(rng) for _ in NAMES]
        self.taken = ReferenceViews(self.views, self.load_image, load_mask)
        self.renders = [noisy(each, rng, 0.02 * (i + 1)) for i, each in enumerate(self.photographs)]

    def load_image(self, which):
        return self.photographs[NAMES.index(which.name)]

    def render(self, camera):
        return as_render(self.renders[round(camera.camera_from_world[0, 3])])

    def visibility(self, camera):
        seen = np.tile(np.arange(camera.width, dtype=np.float32), (camera.height, 1))
        seen[:2] = np.nan
        return seen + camera.camera_from_world[0, 3]


@pytest.fixture(scope="module")
def city() -> City:
    return City()


def read(path: Path):
    def refuse(name: str):
        raise AssertionError(f"{path} holds {name}")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_what_is_written_is_what_was_measured(city: City, tmp_path: Path):
    facts = EvaluatedModel(n_anchors=1234, model_bytes=10**6)
    model = RenderableModel(render=city.render, visibility_map=city.visibility, metadata=facts)
    result = evaluate_model(city.taken, model, tmp_path, lpips_note="LPIPS is null: no weights.")
    assert result == read(tmp_path / "metrics.json")
    rows = read(tmp_path / "per_view.json")
    assert [row["name"] for row in rows] == NAMES
    for row, reference in zip(rows, city.photographs, strict=True):
        saved = cv2.imread(str(tmp_path / row["render"]))[..., ::-1]
        assert row["psnr"] == psnr(saved, reference)
        assert row["ssim"] == pytest.approx(ssim(saved, reference), abs=1e-12)
        assert row["psnr_cc"] > row["psnr"] - 0.01
        assert (tmp_path / "comparisons" / Path(row["render"]).name).is_file()
    assert result["psnr"] == pytest.approx(np.mean([row["psnr"] for row in rows]))
    assert result["lpips_vgg"] is None
    assert result["lpips_vgg_01_cc"] is None
    assert result["train_seconds"] is None
    assert (result["n_anchors"], result["model_bytes"], result["test_views"]) == (1234, 10**6, 4)
    assert result["fps"] > 0
    assert (tmp_path / "contact_sheet.png").is_file()
    assert not list(tmp_path.rglob("*.partial"))


def test_quality_by_visibility(city: City, tmp_path: Path):
    result = evaluate_model(city.taken, RenderableModel(render=city.render, visibility_map=city.visibility), tmp_path)
    empty, *bins = result["by_visibility"]
    assert empty["lower"] is None
    assert empty["pixels"] == 4 * 2 * 64
    assert sum(each["pixels"] for each in bins) == 4 * 46 * 64
    pooled = sum(10 ** (-each["psnr"] / 10) * each["pixels"] for each in [empty, *bins])
    direct = sum(metrics.squared_error(a, b).sum() for a, b in zip(city.renders, city.photographs, strict=True))
    assert pooled == pytest.approx(direct, rel=1e-9)
    by_view = result["views_by_visibility"]
    assert [each["views"] for each in by_view] == [1, 1, 1, 1]
    assert [each["lower"] for each in by_view] == pytest.approx([31.5, 32.5, 33.5, 34.5])
    assert [each["psnr"] for each in by_view] == sorted((each["psnr"] for each in by_view), reverse=True)


def test_the_same_twice(city: City, tmp_path: Path):
    for folder in ("one", "two"):
        evaluate_model(
            city.taken, RenderableModel(render=city.render, visibility_map=city.visibility), tmp_path / folder
        )
    one, two = (read(tmp_path / folder / "metrics.json") for folder in ("one", "two"))
    assert {**one, "fps": 0} == {**two, "fps": 0}
    for file in (tmp_path / "one").rglob("*.png"):
        assert file.read_bytes() == (tmp_path / "two" / file.relative_to(tmp_path / "one")).read_bytes()


def test_masks_are_respected(city: City, tmp_path: Path):
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :32] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = view(NAMES[0], mask=tmp_path / "mask.png")
    result = evaluate_model(replace(city.taken, views=[masked]), RenderableModel(render=city.render), tmp_path / "out")
    left = psnr(city.renders[0][:, :32], city.photographs[0][:, :32])
    assert result["psnr"] == pytest.approx(left, abs=1e-9)
    assert read(tmp_path / "out" / "per_view.json")[0]["unmasked_pixels"] == 48 * 32


def test_a_view_that_is_masked_entirely_leaves_the_means_alone(city: City, tmp_path: Path):
    def load_mask(which):
        return np.full((48, 64), which.name != NAMES[1])

    taken = replace(city.taken, load_mask=load_mask)
    result = evaluate_model(taken, RenderableModel(render=city.render), tmp_path)
    rows = read(tmp_path / "per_view.json")
    assert rows[1]["psnr"] is rows[1]["ssim_cc"] is None
    assert result["psnr"] == pytest.approx(np.mean([rows[i]["psnr"] for i in (0, 2, 3)]))


@pytest.mark.parametrize("exact", [(1,), (0, 1, 2, 3)])
def test_views_equal_to_their_photographs_count_a_hundred_decibels(city: City, tmp_path: Path, exact: tuple[int, ...]):
    """A mean with one of them is a figure, and neither infinite nor unknown."""

    def render(camera):
        index = round(camera.camera_from_world[0, 3])
        return as_render(city.photographs[index]) if index in exact else city.render(camera)

    result = evaluate_model(city.taken, RenderableModel(render=render), tmp_path)
    found = [row["psnr"] for row in read(tmp_path / "per_view.json")]
    expected = [100.0 if i in exact else psnr(city.renders[i], city.photographs[i]) for i in range(4)]
    assert found == pytest.approx(expected)
    assert result["psnr"] == pytest.approx(np.mean(expected))
    assert read(tmp_path / "metrics.json")["psnr"] == result["psnr"]
    assert result["notes"][-1].startswith(
        f"{len(exact)} of 4 views equal their photographs (or all but): PSNR 100 dB each"
    )


def test_lpips_is_measured_raw_and_corrected(city: City, tmp_path: Path):
    class Fake(Lpips):
        def __init__(self) -> None:
            """Without weights."""

        def __call__(self, image, reference):
            error = float(metrics.squared_error(image, reference).mean())
            return LpipsScores(error, 2 * error)

    result = evaluate_model(city.taken, RenderableModel(render=city.render), tmp_path, lpips=Fake())
    rows = read(tmp_path / "per_view.json")
    assert result["lpips_vgg_01"] == pytest.approx(2 * result["lpips_vgg"])
    assert rows[0]["lpips_vgg_cc"] == pytest.approx(10 ** (-rows[0]["psnr_cc"] / 10))
    plain = EvaluationSettings(color_correction=False, comparisons=False, contact_sheet_views=2)
    result = evaluate_model(city.taken, RenderableModel(render=city.render), tmp_path / "plain", settings=plain)
    assert result["psnr_cc"] is None
    assert not (tmp_path / "plain" / "comparisons").exists()


def test_the_table_shows_the_figures(city: City, tmp_path: Path):
    out = StringIO()
    result = evaluate_model(
        city.taken, RenderableModel(render=city.render, visibility_map=city.visibility), tmp_path,
        lpips_note="LPIPS is null: no weights.", console=Console(file=out, width=100),
    )  # fmt: skip
    text = out.getvalue()
    assert f"{result['psnr']:.2f}" in text
    assert f"{result['ssim_cc']:.4f}" in text
    assert "nothing drawn" in text
    assert "LPIPS is null: no weights." in text


def test_pictures_are_measured_in_the_exposure_that_the_model_knows_beside_neutral_colors(city: City, tmp_path: Path):
    gains = {name: torch.eye(3, 4) * gain for name, gain in zip(NAMES, (0.8, 1.0, 1.1, 0.9), strict=True)}
    photographs = ReferenceViews(
        city.views, lambda v: (city.load_image(v) * float(gains[v.name][0, 0])).clip(0, 255).astype(np.uint8), load_mask
    )
    settings = EvaluationSettings(exposure_note="in the exposure of its neighbors")
    out = StringIO()
    neutral = RenderableModel(render=city.render, visibility_map=city.visibility)
    evaluate_model(photographs, neutral, tmp_path / "plain", settings=settings)
    model = replace(neutral, exposure=lambda v: gains[v.name])
    evaluate_model(photographs, model, tmp_path / "exposed", settings=settings, console=Console(file=out, width=120))
    plain, result = (read(tmp_path / folder / "metrics.json") for folder in ("plain", "exposed"))
    assert plain["psnr_reference_exposure"] is plain["ssim_reference_exposure"] is None
    assert plain["notes"] == []
    assert (result["psnr_reference_exposure"], result["ssim_reference_exposure"]) == (plain["psnr"], plain["ssim"])
    assert result["psnr"] > plain["psnr"] + 1
    assert result["notes"] == [
        "views are drawn and measured in the exposure of its neighbors; 1 of them neutral, for want of training "
        "photographs near by; beside that in neutral colors"
    ]
    rows = read(tmp_path / "exposed" / "per_view.json")
    for row, shown, drawn in zip(rows, city.views, city.renders, strict=True):
        saved = cv2.imread(str(tmp_path / "exposed" / row["render"]))[..., ::-1]
        assert np.abs(saved - (drawn * float(gains[shown.name][0, 0])).clip(0, 255)).max() < 0.51
        assert row["psnr"] == psnr(saved, photographs.load_image(shown))
        assert row["psnr_reference_exposure"] == psnr(drawn, photographs.load_image(shown))
        assert row["exposure"] == gains[shown.name].tolist()
    assert sum(10 ** (-each["psnr"] / 10) * each["pixels"] for each in result["by_visibility"]) == pytest.approx(
        sum(10 ** (-row["psnr"] / 10) * row["unmasked_pixels"] for row in rows)
    )
    text = " ".join(out.getvalue().split())
    assert "neutral colors" in text
    assert f"{result['psnr_reference_exposure']:.2f}" in text
    assert "in the exposure of its neighbors" in text


def test_neutral_colors_may_be_of_another_picture_than_exposures_depart_from(city: City, tmp_path: Path):
    darker = {id(v.camera): as_render(drawn * 0.5) for v, drawn in zip(city.views, city.renders, strict=True)}
    model = RenderableModel(render=city.render, exposure=lambda view: torch.eye(3, 4))
    evaluate_model(city.taken, model, tmp_path / "same")
    evaluate_model(
        city.taken, replace(model, render_neutral=lambda camera: darker[id(camera)]), tmp_path / "other"
    )  # fmt: skip
    same, other = (read(tmp_path / folder / "metrics.json") for folder in ("same", "other"))
    assert (other["psnr"], other["ssim"]) == (same["psnr"], same["ssim"])
    assert other["psnr_reference_exposure"] < same["psnr_reference_exposure"] - 1


def test_what_cannot_be_evaluated_is_said(city: City, tmp_path: Path):
    model = RenderableModel(render=city.render)
    with pytest.raises(RunError, match="no test views"):
        evaluate_model(replace(city.taken, views=[]), model, tmp_path)
    with pytest.raises(CaptureError, match=r"a/b.jpg is 60 x 48 pixels, its camera 64 x 48"):
        evaluate_model(replace(city.taken, load_image=lambda v: city.load_image(v)[:, :60]), model, tmp_path)
    with pytest.raises(CaptureError, match=r"gone\.png"):
        evaluate_model(replace(city.taken, views=[view(NAMES[0], mask=tmp_path / "gone.png")]), model, tmp_path)
    broken = as_render(city.renders[0])
    broken.image[3, 4, 1] = torch.nan
    with pytest.raises(TrainingDiverged, match="not finite"):
        evaluate_model(city.taken, RenderableModel(render=lambda camera: broken), tmp_path)
    assert not (tmp_path / "metrics.json").exists()


@given(st.lists(st.text("ab/.\\_: é", min_size=1, max_size=8), min_size=1, max_size=8))
def test_every_view_has_its_own_plain_file_name(names: list[str]):
    stems = comparison_images.unique_file_stems(names)
    assert len({stem.casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert not set(stem) & set('/\\:*?"<>|')
        assert not stem.startswith(".")


def test_readable_file_names():
    names = ["a/b.jpg", "c/b.jpg", "a/b.png", "A/B.JPG", "DJI_0018.JPG"]
    assert comparison_images.unique_file_stems(names) == ["a__b", "c__b", "a__b_png", "A__B_JPG", "DJI_0018"]


def test_json_has_no_nan(tmp_path):
    value = {"a": [np.float32("nan"), math.inf, np.int64(3)], "b": (None, "x", True)}
    assert to_jsonable(value) == {"a": [None, None, 3], "b": [None, "x", True]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "strict.json", value["a"][1:2])
    assert not list(tmp_path.iterdir())


def test_the_color_map_grows_with_the_error():
    ramp = comparison_images.colorize(np.linspace(0, 0.3, 64)[None], limit=0.2).astype(int)
    brightness = ramp.sum(axis=2)[0]
    assert (np.diff(brightness) >= 0).all()
    assert brightness[0] < 20
    assert (ramp[0, 45:] == ramp[0, -1]).all()
    assert comparison_images.colorize(np.array([[np.nan]]), 0.2).tolist() == [[[255, 255, 255]]]


@pytest.mark.parametrize("size", [(48, 64), (300, 20), (900, 1400)])
def test_a_comparison_of_any_size(size: tuple[int, int]):
    reference = photograph(np.random.default_rng(1), *size)
    picture = comparison_images.draw_comparison(reference, reference, "a name " * 3, "30.00 dB")
    width, height = comparison_images.panel_size(
        size[1], size[0], comparison_images.PANEL_MIN_PX, comparison_images.PANEL_MAX_PX
    )
    assert picture.width > 3 * width
    assert picture.height > height


@pytest.mark.capture
def test_on_photographs(tmp_path: Path):
    photographs = real_photographs("brighton", 3)
    height, width = photographs[0].shape[:2]
    views = [view(f"{i}.jpg", width, height, float(i)) for i in range(3)]
    rng = np.random.default_rng(2)

    def render(camera):
        index = round(camera.camera_from_world[0, 3])
        return as_render(noisy(cv2.GaussianBlur(photographs[index], (0, 0), 1.0), rng, 0.01))

    taken = ReferenceViews(views, lambda v: photographs[int(v.name[0])], load_mask)
    result = evaluate_model(taken, RenderableModel(render=render), tmp_path)
    assert 20 < result["psnr"] < 40
    assert result["psnr_cc"] >= result["psnr"]
    assert 0.3 < result["ssim"] < 1
