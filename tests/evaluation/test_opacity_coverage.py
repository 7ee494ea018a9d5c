"""Whether ground is opaque, how far depth is from the truth, and which splats are larger than the picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from support.photographs import load_mask, photograph, psnr, view
from vdgs.evaluation import metrics
from vdgs.evaluation.depth_errors import METRIC_NAMES, DepthErrors, compute_depth_errors
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.opacity_coverage import COVERED_PSNR_KEYS, RenderedImage, count_oversized_splats, coverage_map
from vdgs.evaluation.renderable_model import ReferenceViews, RenderableModel
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster, Splats

HEIGHT, WIDTH = 48, 64
VIEWS = [view("one.jpg", shift=0.0), view("two.jpg", shift=1.0)]
PHOTOGRAPHS = [photograph(np.random.default_rng(seed)) for seed in range(2)]
TAKEN = ReferenceViews(VIEWS, lambda which: PHOTOGRAPHS[VIEWS.index(which)], load_mask)
BACKGROUND = (0.25, 0.5, 0.75)


def number(camera) -> int:
    return round(camera.camera_from_world[0, 3])


def veil(alpha: float) -> Callable:
    """A renderer of the photographs themselves, a little darker and everywhere so opaque, before BACKGROUND."""

    def render(camera) -> Raster:
        own = torch.from_numpy(PHOTOGRAPHS[number(camera)].astype(np.float32) / 255) * 0.9
        picture = alpha * own + (1 - alpha) * torch.tensor(BACKGROUND)
        return Raster(picture, torch.full((HEIGHT, WIDTH), alpha), None)

    return render


def seen_from(columns: int) -> Callable:
    """So many columns at the left are seen."""

    def seen(camera) -> np.ndarray:
        return np.broadcast_to(np.arange(WIDTH) < columns, (HEIGHT, WIDTH))

    return seen


def read(path: Path):
    return json.loads(path.read_text())


def test_what_is_opaque_everywhere_is_solid_before_any_background(tmp_path: Path):
    model = RenderableModel(render=veil(1.0), coverage_map=seen_from(40), background=BACKGROUND)
    result = evaluate_model(TAKEN, model, tmp_path)
    assert (result["opacity_coverage"], result["covered_pixels"]) == (1.0, 2 * 40 * HEIGHT)
    assert result["psnr_covered_own_background"] == result["psnr_covered_black"] == result["psnr_covered_white"]
    rows = read(tmp_path / "per_view.json")
    for row, taken in zip(rows, PHOTOGRAPHS, strict=True):
        left = np.s_[:, :40]
        saved = cv2.imread(str(tmp_path / row["render"]))[..., ::-1]
        assert row["psnr_covered_own_background"] == pytest.approx(psnr(saved[left], taken[left]))
        assert (cv2.imread(str(tmp_path / row["alpha"])) == 255).all()
    figures = [row["psnr_covered_own_background"] for row in rows]
    assert result["psnr_covered_own_background"] == pytest.approx(np.mean(figures))


def test_a_veil_is_not_solid_and_shows_what_is_behind_it(tmp_path: Path):
    result = evaluate_model(
        TAKEN, RenderableModel(render=veil(0.5), coverage_map=seen_from(40), background=BACKGROUND), tmp_path
    )
    assert result["opacity_coverage"] == 0.0
    expected = []
    for taken in PHOTOGRAPHS:
        before_white = metrics.to_8bit(0.5 * 0.9 * taken.astype(np.float32) / 255 + 0.5)
        expected.append(psnr(before_white[:, :40], taken[:, :40]))
    assert result["psnr_covered_white"] == pytest.approx(np.mean(expected), abs=0.02)
    assert result["psnr_covered_own_background"] > result["psnr_covered_white"]
    assert (cv2.imread(str(tmp_path / "alpha" / "one.png")) == 128).all()


@given(st.floats(0, 1), st.tuples(*[st.floats(0, 1)] * 3))
def test_before_its_own_background_a_picture_is_itself(alpha: float, background: tuple[float, float, float]):
    image = PHOTOGRAPHS[0].astype(np.float32) / 255
    rendered = RenderedImage(image, np.full(image.shape[:2], alpha, np.float32), background)
    assert np.array_equal(rendered.over_background(background), PHOTOGRAPHS[0])


def test_a_background_may_be_a_picture():
    rng = np.random.default_rng(0)
    scene, sky = (rng.random((8, 9, 3)).astype(np.float32) for _ in range(2))
    alpha = rng.random((8, 9)).astype(np.float32)
    over = lambda behind: alpha[..., None] * scene + (1 - alpha[..., None]) * behind  # noqa: E731
    white = RenderedImage(over(sky), alpha, sky).over_background((1.0, 1.0, 1.0))
    assert np.abs(white.astype(int) - metrics.to_8bit(over(np.ones(3, np.float32)))).max() <= 1


def plain_at(depth: float, alpha: np.ndarray) -> Callable:
    """A renderer of a plain square to the axis of any camera."""

    def draw(camera) -> Raster:
        opacity = torch.from_numpy(alpha.astype(np.float32))
        median = torch.where(opacity >= 0.5, depth, 0.0)
        return Raster(torch.zeros(*alpha.shape, 3), opacity, opacity * depth, median)

    return draw


def above(x: float, width: int = WIDTH, pitch: float = 90.0) -> Camera:
    """A camera 10 above the ground that looks down by so many degrees; one pixel is 0.25 wide on the ground."""
    down, up = np.sin(np.radians(pitch)), np.cos(np.radians(pitch))
    rotation = np.array([[1, 0, 0], [0, -down, -up], [0, up, -down]], float)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, -rotation @ np.array([x, 0.0, 10.0])
    return Camera(camera_from_world=rigid, fx=40.0, fy=40.0, cx=width / 2, cy=HEIGHT / 2, width=width, height=HEIGHT)


def test_seen_are_the_places_that_three_cameras_hold_whatever_splats_reach_beyond():
    trained = [above(x) for x in (0.0, 1.0, 2.0)]
    whole = np.ones((HEIGHT, WIDTH))
    seen = coverage_map(plain_at(10.0, whole), trained)(above(4.0))
    # Ground from -8 to 8 lies in the first picture, the right edge of what all three hold; the view begins at -4.
    assert seen[:, :48].all()
    assert not seen[:, 48:].any()
    assert not coverage_map(plain_at(10.0, whole), trained[:2])(above(4.0)).any()


def test_open_pixels_are_at_the_depth_of_their_neighbors_and_sky_is_not_seen():
    trained = [above(0.0)] * 3
    holes = np.ones((HEIGHT, WIDTH))
    holes[20:25, 30:40] = 0.2
    assert coverage_map(plain_at(10.0, holes), trained)(above(0.0)).all()
    assert not coverage_map(plain_at(10.0, np.zeros((HEIGHT, WIDTH))), trained)(above(0.0)).any()
    ahead = above(0.0, pitch=0.0)
    lower = np.repeat(np.arange(HEIGHT)[:, None] >= HEIGHT // 2, WIDTH, axis=1)
    seen = coverage_map(plain_at(10.0, lower * 1.0), [ahead] * 3)(ahead)
    assert np.array_equal(seen, lower)


def test_half_open_splats_beyond_what_cameras_cover_are_not_seen_by_the_depth_at_which_they_float():
    trained, floats = [above(x, width=20) for x in (0.0, 0.1, 0.2)], above(6.0)
    opacity = np.ones((HEIGHT, WIDTH))
    opacity[:, 32:] = 0.6
    deep = np.where(opacity == 1, 10.0, 40.0)

    def draw(camera) -> Raster:
        return plain_at(10.0, opacity)(camera)._replace(median_depth=torch.from_numpy(deep.astype(np.float32)))

    wide = [above(0.0, width=400)] * 3
    assert not coverage_map(draw, trained)(floats)[:, 32:].any()
    assert coverage_map(draw, wide)(floats).all(), "ground that cameras hold has to be solid, however open it is"
    ghost = plain_at(10.0, np.full((HEIGHT, WIDTH), 0.6))
    assert coverage_map(ghost, wide)(floats).all()


def test_masks_in_an_evaluation(tmp_path: Path):
    def half_open(camera) -> Raster:
        """Opaque in the left half only."""
        alpha = torch.ones(HEIGHT, WIDTH)
        alpha[:, 32:] = 0.0
        return veil(1.0)(camera)._replace(alpha=alpha)

    everywhere = RenderableModel(render=half_open, coverage_map=seen_from(WIDTH), background=BACKGROUND)
    assert evaluate_model(TAKEN, everywhere, tmp_path / "whole")["opacity_coverage"] == 0.5
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 32:] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = replace(TAKEN, views=[view("one.jpg", mask=tmp_path / "mask.png")], load_image=lambda _: PHOTOGRAPHS[0])
    assert evaluate_model(masked, everywhere, tmp_path / "masked")["opacity_coverage"] == 0.0


def test_what_is_not_known_is_null(tmp_path: Path):
    opaque = veil(1.0)
    names = ("opacity_coverage", *COVERED_PSNR_KEYS, *METRIC_NAMES, "oversized_splats", "max_oversized_splats")
    result = evaluate_model(TAKEN, RenderableModel(render=opaque, background=BACKGROUND), tmp_path / "no V")
    assert {result[name] for name in names} == {None}
    image_only = RenderableModel(
        render=lambda camera: SimpleNamespace(image=opaque(camera).image), coverage_map=seen_from(40)
    )
    result = evaluate_model(TAKEN, image_only, tmp_path / "no alpha")
    assert result["psnr_covered_own_background"] > 10
    assert {result[name] for name in names if name != "psnr_covered_own_background"} == {None}
    row = read(tmp_path / "no alpha" / "per_view.json")[0]
    assert row["alpha"] is None
    assert row["covered_pixels"] == 40 * HEIGHT
    assert not (tmp_path / "no alpha" / "alpha").exists()
    result = evaluate_model(
        TAKEN, RenderableModel(render=opaque, coverage_map=seen_from(0), background=BACKGROUND), tmp_path / "none seen"
    )
    assert {result[name] for name in names} == {None}


def drawn_at(depth: float, alpha: np.ndarray) -> Raster:
    """A surface at one depth, its median elsewhere: where alpha is above one half, a unit nearer."""
    opacity = torch.from_numpy(alpha.astype(np.float32))
    median = torch.where(opacity > 0.5, depth - 1.0, 0.0)
    return Raster(torch.zeros(*alpha.shape, 3), opacity, opacity * depth, median)


def test_errors_of_depth_are_exact_shares_of_the_camera_height():
    truth = np.array([[10.0, 10.0, 10.0, np.inf]])
    drawn = drawn_at(10.5, np.array([[1.0, 0.75, 0.5, 1.0]]))
    seen = np.ones((1, 4), bool)
    errors = compute_depth_errors(drawn, truth, seen, camera_height=20.0)
    assert errors["expected"].tolist() == [0.025, 0.025, np.inf]  # what is not drawn counts; the sky does not
    assert errors["median"].tolist() == [0.025, 0.025, np.inf]
    assert compute_depth_errors(drawn, truth, ~seen, 20.0)["median"].size == 0
    assert "median" not in compute_depth_errors(drawn._replace(median_depth=None), truth, seen, 20.0)


def test_depth_in_an_evaluation(tmp_path: Path):
    model = RenderableModel(
        render=veil(1.0), coverage_map=seen_from(40), background=BACKGROUND, camera_height=100.0,
        true_depth=lambda which: np.full((HEIGHT, WIDTH), 50.0 if which.name == "one.jpg" else 56.0),
        render_depth=lambda camera: drawn_at(50.5, np.ones((HEIGHT, WIDTH))),
    )  # fmt: skip
    result = evaluate_model(TAKEN, model, tmp_path)
    rows = read(tmp_path / "per_view.json")
    assert [row["depth_error_median_expected"] for row in rows] == pytest.approx([0.005, 0.055], rel=1e-3)
    assert [row["depth_error_median_median"] for row in rows] == pytest.approx([0.005, 0.065], rel=1e-3)
    assert [row["depth_within_1_percent_median"] for row in rows] == [1.0, 0.0]
    assert result["depth_within_1_percent_expected"] == 0.5
    assert result["depth_error_median_expected"] == pytest.approx(0.005, rel=1e-3)
    empty = replace(model, render_depth=lambda camera: drawn_at(50.5, np.zeros((HEIGHT, WIDTH))))
    result = evaluate_model(TAKEN, empty, tmp_path / "empty")
    assert result["depth_error_median_expected"] is None  # infinite
    assert result["depth_within_1_percent_expected"] == 0.0
    with pytest.raises(ValueError, match="camera_height"):
        replace(model, camera_height=None)


def test_depth_near_the_truth_by_the_angle_to_the_nearest_photograph(tmp_path: Path):
    """1 % of the camera height off in the left half and 3 % in the right; of one view, the left quarter alone."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :16] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    depth = torch.from_numpy(np.where(np.arange(WIDTH) < 32, 51.0, 53.0).astype(np.float32)).expand(HEIGHT, WIDTH)
    model = RenderableModel(
        render=veil(1.0), coverage_map=seen_from(WIDTH), background=BACKGROUND, camera_height=100.0,
        training_cameras=[each.camera for each in VIEWS], true_depth=lambda _: np.full((HEIGHT, WIDTH), 50.0),
        render_depth=lambda _: Raster(torch.zeros(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH), depth, depth),
    )  # fmt: skip
    for name, given_mask, columns, near in (("whole", None, WIDTH, 0.5), ("masked", tmp_path / "mask.png", 16, 1.0)):
        taken = replace(TAKEN, views=[view("one.jpg", mask=given_mask)], load_image=lambda _: PHOTOGRAPHS[0])
        bins = evaluate_model(taken, model, tmp_path / name)["by_angle"]
        pixels = sum(each["pixels"] for each in bins)
        assert pixels == columns * HEIGHT
        assert sum(each["depth_within_2_percent"] * each["pixels"] for each in bins) / pixels == pytest.approx(near)


@given(st.lists(st.floats(0, 1e3) | st.just(np.inf), min_size=1, max_size=30))
@example([0.01, 0.02])
def test_the_median_of_pooled_errors(values: list[float]):
    pooled = DepthErrors()
    for part in (values[::2], values[1::2]):
        pooled.add(np.array(part))
    exact = sorted(values)[(len(values) - 1) // 2]
    assert pooled.median() == pytest.approx(exact, rel=1e-3, abs=1e-30)
    assert pooled.near_share() == np.mean(np.array(values) <= 0.01)


def splat(sigma_px: float, opacity: float, x: float = 32.0, angle: float = 0.6, aspect: float = 8.0) -> tuple:
    """Mean, conic and opacity of a splat with a standard deviation along its major axis."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    conic = np.linalg.inv(turn @ np.diag([sigma_px**2, (sigma_px / aspect) ** 2]) @ turn.T)
    return (x, 24.0), (conic[0, 0], conic[0, 1], conic[1, 1]), opacity


def splats(*rows: tuple) -> Splats:
    means, conics, opacities = (torch.tensor(column, dtype=torch.float32) for column in zip(*rows, strict=True))
    n = len(rows)
    return Splats(means, conics, torch.ones(n), torch.ones(n, 3), opacities)


def limit(opacity: float) -> float:
    """The standard deviation, in pixels, at which a splat is as long as the picture is wide."""
    return WIDTH / 2 / np.sqrt(2 * np.log(255 * opacity))


@pytest.mark.parametrize("opacity", [0.02, 0.5, 1.0])
@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
@pytest.mark.parametrize("aspect", [1.0, 8.0, 500.0])
def test_a_splat_is_larger_than_the_picture_if_its_ellipse_is_longer(opacity: float, angle: float, aspect: float):
    for factor, expected in ((0.99, 0), (1.01, 1)):
        one = splat(factor * limit(opacity), opacity, angle=angle, aspect=aspect)
        assert count_oversized_splats(splats(one), WIDTH, HEIGHT) == expected


def test_only_splats_that_are_drawn_count_wherever_their_center_lies():
    large = 10 * limit(0.9)
    drawn = splat(large, 0.9), splat(large, 0.9, x=-100.0)
    not_drawn = splat(large, 0.9, x=-1e5), splat(large, 0.0), splat(large, 0.5 / 255)
    broken = ((32.0, 24.0), (1e-6, 1e-3, 1e-6), 0.9), ((32.0, 24.0), (np.nan, 0.0, 1e-6), 0.9)
    small = splat(0.5 * limit(0.9), 0.9)
    assert count_oversized_splats(splats(*drawn, *not_drawn, *broken, small), WIDTH, HEIGHT) == 2


def test_large_splats_of_all_views_and_where_most_are(tmp_path: Path):
    large = splat(10 * limit(0.9), 0.9)

    def splats_of(camera) -> Splats:
        return splats(*[large] * (1 + 2 * number(camera)), splat(1.0, 0.9))

    out = StringIO()
    model = RenderableModel(
        render=veil(1.0), coverage_map=seen_from(40), background=BACKGROUND, decode_splats=splats_of
    )
    result = evaluate_model(TAKEN, model, tmp_path, console=Console(file=out, width=100))
    assert result["oversized_splats"] == 4
    assert (result["max_oversized_splats"], result["max_oversized_splats_view"]) == (3, "two.jpg")
    assert [row["oversized_splats"] for row in read(tmp_path / "per_view.json")] == [1, 3]
    assert "larger than the picture: 4" in out.getvalue()
    assert "100.00%" in out.getvalue()
    none = replace(model, decode_splats=lambda camera: splats(splat(1.0, 0.9)))
    result = evaluate_model(TAKEN, none, tmp_path / "none")
    assert (result["oversized_splats"], result["max_oversized_splats_view"]) == (0, None)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_places_of_pixels_fall_back_onto_them(model):
    camera = replace(above(3.0, pitch=50.0), model=model, cx=30.5, fy=37.0)
    depth = 5.0 + np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) / 100
    pixels, back = camera.project(camera.unproject(depth).reshape(-1, 3))
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    assert np.allclose(pixels, np.column_stack([columns.ravel(), rows.ravel()]))
    assert np.allclose(back, depth.ravel())
