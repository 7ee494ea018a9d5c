"""Labels, borders, errors by block and at seams, and the files that show them."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.console import Console

from support.captures import render_plane
from support.hand_made_models import camera_above, opaque_plane, quadrant_of, quadrants
from vdgs.captures.capture import View
from vdgs.config.method import MergeConfig
from vdgs.errors import RunError
from vdgs.evaluation.block_seams import MAX_SEAM_VIEWS, BlockInputs, evaluate_blocks, make_block_table
from vdgs.evaluation.by_block import (
    NO_BLOCK,
    BlockMetrics,
    SeamMetrics,
    block_label_map,
    border_lines,
    border_pixels,
    visible_blocks,
)
from vdgs.evaluation.renderable_model import ReferenceViews
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.renderer import render
from vdgs.partition.blocks import xy_positions
from vdgs.partition.merging import block_of_points

CAMERAS = [
    camera_above(0.3, -0.2),
    camera_above(-1.0, 0.5, tilt_deg=25, yaw_deg=40),
    camera_above(0.0, 1.0, tilt_deg=70, yaw_deg=200),  # the horizon is in sight
    Camera(
        camera_from_world=camera_above(0.2, 0.1).camera_from_world,
        fx=9.0,
        fy=11.0,
        cx=30.0,
        cy=25.0,
        width=64,
        height=48,
        model="orthographic",
    ),
]


def quadrant_at(positions: torch.Tensor) -> np.ndarray:
    """The owner of each place, as merge rule `owner` has it."""
    return quadrants().owner(xy_positions(positions))


def plane_depth(camera: Camera, alpha: float = 1.0) -> Raster:
    """The plane z = 0 as a renderer draws it: depth times alpha; nothing above the horizon."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1)
    up = camera.camera_from_world[:3, 2]  # the world's z axis in the camera
    height = camera.position[2]
    flat = local @ up[:2]
    with np.errstate(divide="ignore"):
        depth = -height / (flat + up[2]) if camera.model == "pinhole" else -(height + flat) / up[2]
    seen = (depth > 0) & (depth < 1e3)
    as_tensor = lambda array: torch.from_numpy(array.astype(np.float32))  # noqa: E731
    image = render_plane(camera) / 255
    median = as_tensor(np.where(seen & (alpha > 0.5), depth, 0))
    return Raster(as_tensor(image), as_tensor(alpha * seen), as_tensor(np.where(seen, alpha * depth, 0)), median)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("alpha", [1.0, 0.6])
def test_labels_are_those_of_the_places_seen(camera: Camera, alpha: float):
    """Places projected by the camera fall on pixels with the label of their own block."""
    labels = block_label_map(plane_depth(camera, alpha), camera, quadrant_at)
    places = np.random.default_rng(0).uniform(-4, 4, (4000, 2))
    pixels, depth = camera.project(np.column_stack([places, np.zeros(len(places))]))
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    column, row = pixels[inside].astype(int).T
    found, expected = labels[row, column], quadrant_of(places[inside])
    on_border = border_lines(labels)[row, column]
    assert (~on_border).sum() > 100
    assert (found == expected)[~on_border].all()
    assert len(set(expected)) > 1


def test_a_pixel_shows_what_lies_at_its_center():
    quarter = 0.25 * 4.0 / 60.0  # of a pixel, on the ground
    camera = camera_above(-quarter, quarter)
    labels = block_label_map(plane_depth(camera), camera, quadrant_at)
    right, top = np.arange(64) >= 32, np.arange(48) < 24
    assert (labels == 2 * right[None, :] + top[:, None]).all()


def test_the_sky_has_no_label():
    camera = CAMERAS[2]
    drawn = plane_depth(camera)
    labels = block_label_map(drawn, camera, quadrant_at)
    assert ((labels == NO_BLOCK) == (drawn.alpha.numpy() == 0)).all()
    assert (labels == NO_BLOCK).any()
    assert (block_label_map(plane_depth(camera, 0.4), camera, quadrant_at) == NO_BLOCK).all()


def test_labels_of_a_render():
    camera, model = camera_above(0.3, -0.2, tilt_deg=8, yaw_deg=30), opaque_plane()
    drawn = block_label_map(render(model, camera, depth=True), camera, quadrant_at)
    exact = block_label_map(plane_depth(camera), camera, quadrant_at)
    seen = drawn >= 0
    assert seen.mean() > 0.9
    assert (drawn == exact)[seen].mean() > 0.98
    assert set(np.unique(drawn[seen])) == {0, 1, 2, 3}


def test_labels_follow_the_rule_of_the_merge():
    """Where the cameras of a neighbor see more, the neighbor's ring is drawn, and the border is the ring's edge."""
    camera = camera_above(0.0, 1.0)
    cameras: list[list[Camera]] = [[], [camera_above(0, 0, 20.0)], [], []]
    best_seen = MergeConfig("max-visibility")
    at = lambda places: block_of_points(places, quadrants(ring=0.5), cameras, best_seen)  # noqa: E731
    labels = block_label_map(plane_depth(camera), camera, at)
    column, row = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    x, y = (column - 32) / 15, 1.0 - (row - 24) / 15
    expected = np.where((x < 0.5) & (y > -0.5), 1, 2 * (x > 0) + (y > 0))
    assert (labels == expected).mean() > 0.99
    assert (block_label_map(plane_depth(camera), camera, quadrant_at) != expected).mean() > 0.1


def test_labels_need_depth():
    with pytest.raises(ValueError, match="depth"):
        block_label_map(render(opaque_plane(), CAMERAS[0]), CAMERAS[0], quadrant_at)


label_maps = arrays(np.int16, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(-1, 2))


@settings(max_examples=60)
@given(label_maps, st.sampled_from([0.0, 1.0, 1.5, 3.0]))
def test_border_pixels_by_exhaustion(labels: np.ndarray, width_px: float):
    height, width = labels.shape
    lines = [
        (r, c)
        for r in range(height)
        for c in range(width)
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0))
        if 0 <= r + dr < height and 0 <= c + dc < width
        and labels[r, c] >= 0 and labels[r + dr, c + dc] >= 0 and labels[r, c] != labels[r + dr, c + dc]
    ]  # fmt: skip
    assert set(zip(*np.nonzero(border_lines(labels)), strict=True)) == set(lines)
    near = {
        (r, c)
        for r in range(height)
        for c in range(width)
        if labels[r, c] >= 0 and any((r - a) ** 2 + (c - b) ** 2 <= width_px**2 for a, b in lines)
    }
    assert set(zip(*np.nonzero(border_pixels(labels, width_px)), strict=True)) == near


def test_the_edge_of_what_is_drawn_is_no_border():
    labels = np.zeros((20, 20), np.int16)
    labels[:, 10:] = NO_BLOCK
    assert not border_pixels(labels).any()


def halves(height: int = 60, width: int = 120) -> np.ndarray:
    labels = np.zeros((height, width), np.int16)
    labels[:, width // 2 :] = 1
    return labels


def test_psnr_by_block_pools_pixels():
    rng = np.random.default_rng(0)
    views = [(halves(), rng.uniform(0, 0.1, (60, 120))) for _ in range(3)]
    views[1][0][:10] = NO_BLOCK
    mask = rng.random((60, 120)) < 0.7
    pooled = BlockMetrics(3, ["coarse", "merged"])
    for labels, errors in views:
        pooled.add(labels, {"coarse": errors, "merged": errors / 4}, mask)
    for index, row in enumerate(pooled.rows()[:2]):
        kept = [(labels == index) & mask for labels, _ in views]
        mean = np.concatenate([errors[k] for k, (_, errors) in zip(kept, views, strict=True)]).mean()
        assert row["pixels"] == sum(k.sum() for k in kept)
        assert row["psnr_coarse"] == pytest.approx(-10 * np.log10(mean))
        assert row["psnr_merged"] == pytest.approx(row["psnr_coarse"] + 10 * np.log10(4))
    assert pooled.rows()[2]["pixels"] == 0
    assert np.isnan(pooled.rows()[2]["psnr_coarse"])
    assert pooled.overall()["pixels"] == sum(row["pixels"] for row in pooled.rows())


def test_slivers_of_a_block_are_left_out():
    labels = halves()
    labels[0, :36], labels[1, :35] = 2, 3  # 0.5 % of 7200 pixels are 36
    assert visible_blocks(labels, 5) == [0, 1, 2]
    pooled = BlockMetrics(5, ["isolated"])
    pooled.add(labels, {"isolated": np.where(labels == 3, np.nan, 0.01)})
    assert [row["pixels"] for row in pooled.rows()] == [3600 - 71, 3600, 36, 0, 0]
    assert pooled.overall()["psnr_isolated"] == pytest.approx(20.0)


def seams_of(coarse: np.ndarray, merged: np.ndarray, labels: np.ndarray, mask: np.ndarray | None = None) -> dict:
    seams = SeamMetrics()
    for _ in range(2):
        seams.add(
            labels,
            {"mae_coarse": coarse, "mae_merged": merged, "mse_coarse": coarse**2, "mse_merged": merged**2},
            mask,
        )
    return seams.figures()


def test_uniform_noise_leaves_no_seam():
    rng = np.random.default_rng(0)
    coarse, merged = np.abs(rng.normal(0, 0.1, (2, 400, 600)))
    figures = seams_of(coarse, 0.5 * merged, halves(400, 600))
    assert figures["border_pixels"] == 2 * 400 * 22
    assert figures["interior_pixels"] == 2 * 400 * 578
    for key in ("mae_coarse", "mae_merged"):
        assert figures[key]["ratio"] == pytest.approx(1, abs=0.03)
    assert figures["seam_mae_ratio"] == pytest.approx(1, abs=0.03)
    assert figures["seam_mse_ratio"] == pytest.approx(1, abs=0.06)
    assert figures["mae_merged"]["interior"] == pytest.approx(0.5 * figures["mae_coarse"]["interior"], rel=0.01)


def test_an_error_along_the_border_is_a_seam():
    labels, noise = halves(), np.full((60, 120), 0.1)
    torn = np.where(border_pixels(labels), 0.3, noise)
    figures = seams_of(noise, torn, labels)
    assert figures["mae_merged"]["ratio"] == pytest.approx(3)
    assert figures["mse_merged"]["ratio"] == pytest.approx(9)
    assert figures["seam_mae_ratio"] == pytest.approx(3)
    assert figures["seam_mse_ratio"] == pytest.approx(9)


def test_a_border_in_a_hard_place_is_no_seam():
    labels = halves()
    hard = np.where(border_pixels(labels), 0.3, 0.1)
    figures = seams_of(hard, hard / 2, labels)
    assert figures["mae_merged"]["ratio"] == pytest.approx(3)
    assert figures["seam_mae_ratio"] == pytest.approx(1)


def test_pixels_that_do_not_count():
    labels, errors = halves(), np.full((60, 120), 0.1)
    labels[:20], errors[:20] = NO_BLOCK, np.nan
    mask = np.ones((60, 120), bool)
    mask[-10:], errors[-10:] = False, np.nan
    figures = seams_of(errors, errors, labels, mask)
    assert figures["border_pixels"] == 2 * 30 * 22
    assert figures["mae_merged"]["interior"] == pytest.approx(0.1)


def test_no_border_no_figure():
    figures = seams_of(np.ones((4, 4)), np.ones((4, 4)), np.zeros((4, 4), np.int16))
    assert figures["border_pixels"] == 0
    assert np.isnan(figures["seam_mae_ratio"])
    assert figures["mae_coarse"]["interior"] == 1.0


class Plane:
    """Test views of the textured plane; the merged render has an error along the borders, block 3 was not trained."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.views = [
            View(name=f"{i}.png", camera=each, image_path=Path(f"{i}.png"), mask_path=None, split="test")
            for i, each in enumerate(cameras)
        ]
        self.asked: list[int] = []
        self.rng = np.random.default_rng(0)

    def load_image(self, which: View) -> np.ndarray:
        return render_plane(which.camera)

    def coarse(self, camera: Camera) -> Raster:
        return self._off(plane_depth(camera), 0.08)

    def merged(self, camera: Camera) -> Raster:
        drawn = self._off(plane_depth(camera), 0.04)
        border = torch.from_numpy(border_pixels(block_label_map(drawn, camera, quadrant_at)))
        return drawn._replace(image=torch.where(border[..., None], 0.5 * drawn.image + 0.2, drawn.image))

    def block(self, index: int, camera: Camera) -> Raster | None:
        self.asked.append(index)
        return None if index == 3 else self._off(plane_depth(camera), 0.02)

    def _off(self, drawn: Raster, amount: float) -> Raster:
        noise = self.rng.normal(0, amount, tuple(drawn.image.shape)).astype(np.float32)
        return drawn._replace(image=drawn.image + torch.from_numpy(noise))

    def evaluate(self, output: Path, mask: np.ndarray | None = None, **more) -> dict:
        photographs = ReferenceViews(self.views, self.load_image, lambda _: mask)
        inputs = BlockInputs(
            reference_views=photographs, render_coarse=self.coarse, render_merged=self.merged, render_block=self.block,
            num_blocks=4, block_at=quadrant_at, **more,
        )  # fmt: skip
        return evaluate_blocks(inputs, output)


ONE_BLOCK = camera_above(-3.5, -3.5, 2.0)


def test_an_evaluation_of_blocks(tmp_path: Path):
    plane = Plane([*CAMERAS[:2], ONE_BLOCK])
    result = plane.evaluate(tmp_path)
    assert result == json.loads((tmp_path / "by_block.json").read_text())
    assert [row["block"] for row in result["blocks"]] == [0, 1, 2, 3]
    for row in result["blocks"][:3]:
        assert row["psnr_isolated"] > row["psnr_merged"] > row["psnr_coarse"] - 10
    assert result["blocks"][3]["psnr_isolated"] is None
    assert result["all"]["psnr_isolated"] is None
    assert result["seams"]["seam_mae_ratio"] > 1.5
    assert result["seams"]["mae_coarse"]["ratio"] == pytest.approx(1, abs=0.1)
    assert plane.asked[-1] == 0
    assert plane.asked.count(3) <= 2  # not for the view that shows block 0 alone
    assert result["views"][2]["border_pixels"] == 0
    assert result["views"][2]["psnr_merged_border"] is None
    assert sorted(file.name for file in (tmp_path / "seams").iterdir()) == ["0.png", "1.png"]


def test_blocks_are_measured_in_the_exposure_of_the_view(tmp_path: Path):
    class Darker(Plane):
        def load_image(self, which: View) -> np.ndarray:
            return np.rint(0.8 * super().load_image(which)).astype(np.uint8)

    neutral = Plane(CAMERAS[:2]).evaluate(tmp_path / "neutral")["all"]
    exposed = Darker(CAMERAS[:2]).evaluate(tmp_path / "exposed", exposure=lambda _: 0.8 * torch.eye(3, 4))
    for name in ("psnr_coarse", "psnr_merged"):
        assert exposed["all"][name] == pytest.approx(neutral[name] - 20 * np.log10(0.8), abs=0.2)
    alone = [row["psnr_isolated"] for row in exposed["blocks"][:3]]
    assert min(alone) > exposed["all"]["psnr_merged"]
    assert Darker(CAMERAS[:2]).evaluate(tmp_path / "as it is")["all"]["psnr_coarse"] < neutral["psnr_coarse"]


def test_pictures_of_the_views_with_most_borders(tmp_path: Path):
    cameras = [camera_above(x, 1.0) for x in np.linspace(0, 2, MAX_SEAM_VIEWS + 2)]
    result = Plane(cameras).evaluate(tmp_path)
    most = sorted(result["views"], key=lambda row: -row["border_pixels"])[:MAX_SEAM_VIEWS]
    names = {file.stem for file in (tmp_path / "seams").iterdir()}
    assert names == {Path(row["name"]).stem for row in most}


def test_masked_pixels_change_nothing(tmp_path: Path):
    mask = np.zeros((48, 64), bool)
    mask[:, :32] = True
    plane = Plane(CAMERAS[:1])
    result = plane.evaluate(tmp_path, mask)
    labels = block_label_map(plane_depth(CAMERAS[0]), CAMERAS[0], quadrant_at)
    assert result["all"]["pixels"] == 48 * 32
    assert result["views"][0]["border_pixels"] == (border_pixels(labels) & mask).sum()
    assert sum(row["pixels"] for row in result["blocks"]) == 48 * 32


def test_the_block_alone_is_measured_where_it_is_shown(tmp_path: Path):
    """A block's own render may be anything elsewhere."""
    camera = CAMERAS[0]
    labels = block_label_map(plane_depth(camera), camera, quadrant_at)
    plane = Plane([camera])

    def own_place_only(index: int, camera: Camera) -> Raster:
        drawn = plane._off(plane_depth(camera), 0.02)
        drawn.image[torch.from_numpy(labels != index)] = 0
        return drawn

    plane.block = own_place_only  # type: ignore[method-assign,assignment]
    result = plane.evaluate(tmp_path)
    assert [row["psnr_isolated"] for row in result["blocks"]] == pytest.approx([-20 * np.log10(0.02)] * 4, abs=0.6)


def test_the_table_says_what_was_found(tmp_path: Path):
    result = Plane(CAMERAS[:2]).evaluate(tmp_path)
    text = StringIO()
    Console(file=text, width=200).print(make_block_table(result))
    assert f"{result['blocks'][1]['psnr_merged']:.2f}" in text.getvalue()
    assert f"merged over coarse {result['seams']['seam_mae_ratio']:.3f}" in text.getvalue()
    lonely = StringIO()
    Console(file=lonely, width=200).print(make_block_table(Plane([ONE_BLOCK]).evaluate(tmp_path)))
    assert "no border" in lonely.getvalue()


def test_without_views(tmp_path: Path):
    with pytest.raises(RunError, match="no test views"):
        Plane([]).evaluate(tmp_path)
