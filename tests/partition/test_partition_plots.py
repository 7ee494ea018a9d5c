"""The figures of the partition: drawn for every kind of scene, of sane size, and true to what they are given."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from scipy.ndimage import maximum_filter, minimum_filter

from vdgs.config.method import PartitionConfig
from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.plots import block_maps as figures
from vdgs.partition.plots.block_colors import BLOCK_PALETTE, block_color
from vdgs.partition.plots.block_stats import compute_block_stats
from vdgs.partition.plots.score_heatmap import sort_cameras
from vdgs.pipeline.partition_stage import describe_partition
from vdgs.system import figure_style
from vdgs.system.figure_style import DPI, draw_titles
from vdgs.visibility.visibility_map import remove_speckles

pytestmark = pytest.mark.slow

#: Names of x and y.
METERS = ("east (m)", "north (m)")


def grid(count: int, side: float = 100.0) -> Blocks:
    """So many upright boxes side by side."""
    cores = [shapely.box(i * side / count, 0, (i + 1) * side / count, side) for i in range(count)]
    return Blocks(tuple(Block(core, core.buffer(3.0)) for core in cores))


def cameras_above(count: int, side: float = 100.0) -> list[Camera]:
    places = np.random.default_rng(3).uniform(0, side, (count, 2))
    poses = []
    for x, y in places:
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = -pose[:3, :3] @ (x, y, 50.0)
        poses.append(pose)
    return [Camera(camera_from_world=pose, fx=400, fy=400, cx=200, cy=150, width=400, height=300) for pose in poses]


def scene(anchors: int, cameras: int, blocks: int) -> tuple[np.ndarray, np.ndarray, list[Camera], np.ndarray]:
    """Positions, V, cameras and scores."""
    random = np.random.default_rng(5)
    positions = random.uniform(0, 100, (anchors, 3)).astype(np.float32)
    views = random.integers(0, cameras + 1, anchors).astype(np.int32)
    return positions, views, cameras_above(cameras), random.random((cameras, blocks)).astype(np.float32)


@pytest.fixture
def half_as_sharp(monkeypatch: pytest.MonkeyPatch) -> float:
    """Half the resolution, which costs a part of the time: what `check` is told."""
    monkeypatch.setattr(figure_style, "DPI", DPI // 2)
    return 0.5


def check(file: Path, sharpness: float = 1.0) -> np.ndarray:
    """A picture of sane size with something drawn on white."""
    picture = imread(file)[..., :3]
    height, width = (int(side / sharpness) for side in picture.shape[:2])
    assert 250 <= height <= 6000
    assert 600 <= width <= 3000
    assert (picture < 0.9).any(axis=-1).mean() > 0.001
    edge = np.concatenate([picture[:4].reshape(-1, 3), picture[:, -4:].reshape(-1, 3), picture[-4:].reshape(-1, 3)])
    assert (edge == 1).all(), "something is cut off at the edge"
    return picture


SCENES = {
    "one block": (2000, 12, 1),
    "16 blocks": (3000, 40, 16),
    "no cameras": (500, 0, 2),
    "one anchor": (1, 3, 2),
    "3000 cameras": (500, 3000, 4),
}


@pytest.mark.parametrize("name", SCENES)
def test_all_figures_of_all_scenes(tmp_path: Path, name: str, half_as_sharp: float) -> None:
    anchors, count, blocks = SCENES[name]
    positions, views, cameras, scores = scene(anchors, count, blocks)
    cut, assigned = grid(blocks), scores > 0.7
    compare = grid(blocks + 1) if blocks > 1 else None
    file = tmp_path / "figure.png"
    cuts = [("λ_vis = 1", cut)] + ([] if compare is None else [(figures.SPATIAL_ONLY_LABEL, compare)])
    figures.plot_blocks(file, positions, views, cameras, assigned, cuts, METERS)
    check(file, half_as_sharp)
    figures.plot_block_stats(file, positions, views, cut, assigned, "m", compare)
    check(file, half_as_sharp)
    figures.plot_scores(file, scores, assigned)
    check(file, half_as_sharp)
    figures.plot_anchor_visibility(file, positions, views, cameras, ("x (units)", "y (units)"))
    check(file, half_as_sharp)


def test_the_comparison_stands_beside_or_below(tmp_path: Path, half_as_sharp: float) -> None:
    positions, views, cameras, scores = scene(300, 5, 2)
    alone, both, wide = (tmp_path / f"{name}.png" for name in ("alone", "both", "wide"))
    cut, assigned = grid(2), scores > 0.5
    figures.plot_blocks(alone, positions, views, cameras, assigned, [("not cut", cut)], METERS)
    compared = [("λ_vis = 1", cut), (figures.SPATIAL_ONLY_LABEL, grid(2))]
    figures.plot_blocks(both, positions, views, cameras, assigned, compared, METERS)
    stretched = positions * np.float32([10, 1, 1])
    figures.plot_blocks(wide, stretched, views, cameras, assigned, compared, METERS)
    one, two, three = (check(file, half_as_sharp).shape for file in (alone, both, wide))
    assert two[1] > 1.5 * one[1]
    assert two[0] == one[0]
    assert three[1] < 1.2 * one[1]


def test_blocks_have_colors_of_their_own_and_show_them(tmp_path: Path) -> None:
    colors = np.array([to_rgb(color) for color in BLOCK_PALETTE])
    assert len(colors) == 16
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(colors, 2)) > 0.2
    assert block_color(16) == block_color(0) != block_color(1)
    positions, views, _, scores = scene(50, 3, 16)
    file = tmp_path / "facts.png"
    figures.plot_block_stats(file, positions, views, grid(16), scores > 2, "m", None)
    numbered = np.array([65536, 256, 1])
    found, counts = np.unique(np.rint(255 * check(file).reshape(-1, 3)).astype(int) @ numbered, return_counts=True)
    for color in np.rint(255 * colors).astype(int) @ numbered:  # the area of each block is a bar of its color
        assert counts[found == color].sum() > 100


def test_facts_are_those_of_the_anchors_that_a_block_owns() -> None:
    positions = np.array([[10, 5, 0], [20, 5, 0], [30, 5, 9], [90, 5, 0]], np.float32)
    facts = compute_block_stats(positions, np.array([2, 4, 6, 7], np.int32), grid(4))
    assert facts.anchors.tolist() == [2, 1, 0, 1]
    np.testing.assert_allclose(facts.area, 2500)
    np.testing.assert_allclose(facts.mean, [3, 6, np.nan, 7])
    np.testing.assert_allclose(facts.spread, [1, 0, np.nan, 0])
    assert (facts.low[0], facts.high[0]) == pytest.approx((2.1, 3.9))


def test_cameras_are_sorted_by_best_block_then_score() -> None:
    scores = np.array([[0.1, 0.5], [0.9, 0.2], [0, 0], [0.0, 0.8], [0.3, 0.1]], np.float32)
    order, best = sort_cameras(scores)
    assert order.tolist() == [1, 4, 3, 0, 2]
    assert best.tolist() == [0, 0, 1, 1, 2], "the one without any score comes last"


@pytest.mark.parametrize("cameras", [15, 3000])
def test_assigned_cameras_are_marked(tmp_path: Path, cameras: int) -> None:
    wanted = np.random.default_rng(0).random((cameras, 4)) > 0.6

    def red(assigned: np.ndarray) -> float:
        figures.plot_scores(tmp_path / "scores.png", np.full((cameras, 4), 0.9, np.float32), assigned)
        picture = check(tmp_path / "scores.png")[150:-100, :-150]  # without words and the scale
        return float(picture[..., 0].sum() - picture[..., 1].sum())

    nothing, some, everything = red(wanted & False), red(wanted), red(wanted | True)
    assert (some - nothing) / (everything - nothing) == pytest.approx(wanted.mean(), abs=0.04)


def test_many_anchors_are_thinned_and_the_heading_counts_cameras_beyond_the_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    headings = []
    monkeypatch.setattr(figures, "draw_titles", lambda figure, *lines: headings.append(lines))
    positions, views, cameras, _ = scene(figures.MAX_DRAWN_ANCHORS + 1, 3, 1)
    far = cameras[0].camera_from_world.copy()
    far[0, 3] = -500.0
    cameras.append(Camera(camera_from_world=far, fx=400, fy=400, cx=200, cy=150, width=400, height=300))
    assigned = np.ones((4, 1), bool)
    figures.plot_blocks(tmp_path / "blocks.png", positions, views, cameras, assigned, [("not cut", grid(1))], METERS)
    assert headings[0][1] == "60,001 anchors (60,000 drawn)  ·  4 training cameras (1 beyond the map)"


def test_a_map_of_blocks_holds_all_outlines_unless_they_lead_far_away() -> None:
    inner = np.array([[0.0, 0.0], [100.0, 60.0]])
    low, high, whole = figures._frame_of_blocks(inner, [grid(2), widened(40.0)])
    assert whole
    assert (low < [-40, -40]).all()
    assert (high > [140, 140]).all()
    low, high, whole = figures._frame_of_blocks(inner, [widened(5000.0)])
    assert not whole
    assert ((high - low) < 300).all()


def widened(by: float) -> Blocks:
    core = shapely.box(0, 0, 100, 100)
    return Blocks((Block(core, core.buffer(by)),))


def test_the_border_of_coverage_has_no_speckles() -> None:
    covered = np.zeros((200, 200), bool)
    covered[40:160, :120] = True
    speckled = covered.copy()
    speckled[60:62, 60] = speckled[100, 20:90] = speckled[41:120, 80:82] = False  # a hole, a slit, a longer one
    speckled[10:15, 150:155] = speckled[180, 180] = True  # islands
    differs = remove_speckles(speckled) ^ covered
    assert not differs[without_edges(covered)].any()
    speckled[80:120, 30:70] = False  # a hole worth showing
    assert not remove_speckles(speckled)[90:110, 40:60].any()
    for kind in (np.zeros, np.ones):
        np.testing.assert_array_equal(remove_speckles(kind((50, 60), bool)), kind((50, 60), bool))


def without_edges(covered: np.ndarray) -> np.ndarray:
    """Where a cell and its neighbors are alike."""
    return (maximum_filter(covered, 5) == minimum_filter(covered, 5)) & np.ones_like(covered)


@pytest.mark.parametrize("width", [5.0, 12.0])
def test_titles_stay_on_the_figure(width: float) -> None:
    figure = Figure(figsize=(width, 4.0), dpi=DPI)
    FigureCanvasAgg(figure)
    draw_titles(figure, "a name", "facts of all kinds, " * 6, "a note")
    assert all(line.get_window_extent().x1 <= figure.bbox.x1 for line in figure.texts)


def test_axes_are_east_and_north_only_where_the_place_is_known() -> None:
    frame = GroundFrame(scale=1.0, rotation=np.eye(3), translation=np.zeros(3), metric=True, description="")
    assert frame.axis_names == ("x (m)", "y (m)")
    assert replace(frame, origin_geo=(50.8, -0.1, 60.0)).axis_names == METERS
    assert replace(frame, metric=False).axis_names == ("x (units)", "y (units)")


def test_a_cut_is_called_by_its_strategy() -> None:
    assert describe_partition(PartitionConfig(lambda_vis=0.7)) == "λ_vis = 0.7"
    assert describe_partition(PartitionConfig(blocks=1)) == "not cut"
    names = [describe_partition(PartitionConfig(strategy=name)) for name in ("vastgaussian", "citygaussian", "dogs")]
    assert names == ["VastGaussian partition", "CityGaussian partition", "DOGS partition"]
