"""Dense stereo: pairs turned into rows, depths that are true, points where others confirm them and nowhere else."""

from __future__ import annotations

import errno
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.initialization.stereo import (
    FusionCell,
    StereoInputs,
    StereoView,
    compute_dense_points,
    fusion,
    pair_depth,
    select_source_views,
)
from vdgs.model.initialization.stereo.fusion import CELL_SCALES, MIN_SPACING
from vdgs.model.initialization.stereo.rectification import RectifiedPair

pytestmark = [pytest.mark.xdist_group("stereo"), pytest.mark.slow]

HEIGHT, ROOF, HALF = 20.0, 4.0, 5.0  # of the flight, of a roof about the origin, and half its edge
SLOPE = 0.05


def camera(x: float, y: float, tilt: float = 0.0, turn: float = 0.0, focal: float = 150.0) -> Camera:
    """160 x 120 pixels from HEIGHT, looking down but for a tilt about x, turned about the vertical (radians)."""
    down = np.diag([1.0, -1.0, -1.0])
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    about_x = np.array([[1.0, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    pose = np.eye(4)
    pose[:3, :3] = about_x @ down @ about_z
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, y, HEIGHT])
    return Camera(camera_from_world=pose, fx=focal, fy=focal, cx=80.0, cy=60.0, width=160, height=120)


def texture() -> np.ndarray:
    """Spots of several sizes, 0 to 255."""
    rng, total = np.random.default_rng(3), np.zeros((512, 512), np.float32)
    for size in (2, 4, 8, 16):
        total += cv2.GaussianBlur(rng.normal(0, size, (512, 512)).astype(np.float32), (0, 0), size / 2)
    return np.clip(128 + 60 * total / total.std(), 0, 255).astype(np.uint8)


TEXTURE = texture()


def true_depth(of: Camera) -> np.ndarray:
    """Depth [h, w] of a slope with a level roof on it."""
    rays = of.unproject(np.ones((of.height, of.width))) - of.position
    slope = (SLOPE * of.position[0] - of.position[2]) / (rays[..., 2] - SLOPE * rays[..., 0])
    roof = (ROOF - of.position[2]) / rays[..., 2]
    on_roof = (np.abs(of.position[:2] + roof[..., None] * rays[..., :2]) < HALF).all(-1)
    return np.where(on_roof, roof, slope)


def photograph(of: Camera) -> np.ndarray:
    """What it shows, RGB: places are painted alike from wherever one looks."""
    places = of.unproject(true_depth(of))
    column, row = (((places[..., axis] + 25.0) * 10.0).astype(np.float32) for axis in (0, 1))
    gray = cv2.remap(TEXTURE, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.stack([gray, gray // 2, 255 - gray], -1)


def view(of: Camera) -> StereoView:
    return StereoView(of, cv2.cvtColor(photograph(of), cv2.COLOR_RGB2GRAY), 12.0, 26.0)


def sparse() -> np.ndarray:
    flat = np.random.default_rng(0).uniform(-12, 12, (300, 2))
    roof = (np.abs(flat) < HALF).all(1)
    return np.column_stack([flat, np.where(roof, ROOF, SLOPE * flat[:, 0])])


def flight() -> list[Camera]:
    return [camera(x, y, tilt=0.05 * x, turn=0.4 * y) for y in (-4.0, 0.0, 4.0) for x in (-4.0, 0.0, 4.0)]


def points_of(cameras: list[Camera], tmp_path, threads: int = 1, read=None, cell: float = 0.6, pixels: float = 0.0):
    read = read or (lambda index: (photograph(cameras[index]), None))
    inputs = StereoInputs(cameras, sparse(), sparse(), read)
    return compute_dense_points(inputs, FusionCell(cell, pixels), tmp_path, lambda done, of: None, threads)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory):
    """The points of the flight, what was told meanwhile, and what is left behind."""
    cameras, folder = flight(), tmp_path_factory.mktemp("flight")
    told: list[tuple[int, int]] = []
    inputs = StereoInputs(cameras, sparse(), sparse(), lambda index: (photograph(cameras[index]), None))
    found = compute_dense_points(inputs, FusionCell(0.6, 0.0), folder, lambda done, of: told.append((done, of)))
    return found, told, list(folder.iterdir())


def height_at(points: np.ndarray) -> np.ndarray:
    """How far points [n, 3] lie from the slope, the roof or its walls."""
    on_slope = np.abs(points[:, 2] - SLOPE * points[:, 0])
    within = (np.abs(points[:, :2]) < HALF + 0.3).all(1)
    on_roof = np.where(within, np.abs(points[:, 2] - ROOF), np.inf)
    at_wall = np.where(np.abs(np.abs(points[:, :2]).max(1) - HALF) < 0.6, 0.0, np.inf)
    return np.minimum(np.minimum(on_slope, on_roof), at_wall)


@settings(max_examples=50)
@given(
    x=st.floats(-6, 6), y=st.floats(-6, 6), tilt=st.floats(-0.3, 0.3), turn=st.floats(-3.1, 3.1),
    focal=st.floats(100, 200), place=st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-2, 6)),
)  # fmt: skip
def test_a_place_lies_in_the_same_row_and_as_far_left_as_its_depth_says(x, y, tilt, turn, focal, place):
    assume(np.hypot(x, y) > 0.5)
    pair = camera(0.0, 0.0, 0.1, 0.3), camera(x, y, tilt, turn, focal)
    common = RectifiedPair.of(*pair)
    assume(common is not None)
    found = []
    for which, each in enumerate(pair):
        pixel, _ = each.project(np.array([place]))
        there = np.linalg.inv(common.homography_to_image(each, which)) @ [*(pixel[0] - 0.5), 1.0]
        found.append(there[:2] / there[2])
    depth = float(common.rotation[2] @ (np.array(place) - pair[0].position))
    assert found[0][1] == pytest.approx(found[1][1], abs=1e-6)
    assert found[0][0] - found[1][0] == pytest.approx(common.disparity(depth), abs=1e-6)
    assert common.depth(np.array([[common.disparity(depth)]]))[0, 0] == pytest.approx(depth, rel=1e-9)


@pytest.mark.parametrize("second", [(4.0, 0.0, 0.0, 0.0), (0.0, 4.0, 0.1, 0.0), (-3.0, 3.0, -0.1, 2.0)])
def test_the_depth_of_a_pair_is_the_true_one(second):
    first = camera(0.0, 0.0, 0.05)
    found, true = pair_depth(view(first), view(camera(*second))), true_depth(first)
    assert found is not None
    known = found > 0
    assert known.mean() > 0.5
    baseline = np.linalg.norm(np.array(second[:2]))
    columns = first.fx * baseline * np.abs(1 / found[known] - 1 / true[known])
    assert np.median(columns) < 0.25
    assert (columns < 1).mean() > 0.85  # edges of the roof and of the picture apart


def test_pairs_without_a_common_plane_have_no_depth():
    first = view(camera(0.0, 0.0))
    assert pair_depth(first, first) is None  # no baseline
    behind = camera(0.0, 0.0)
    pose = behind.camera_from_world.copy()
    pose[2, 3] += 8.0  # 8 further up: along the line of sight
    assert pair_depth(first, view(replace(behind, camera_from_world=pose))) is None


def test_points_lie_on_the_ground_and_cover_it(whole):
    found, told, left = whole
    off = height_at(found.points)
    assert np.quantile(off, 0.95) < 0.02 * HEIGHT
    roof = found.points[(np.abs(found.points[:, :2]) < HALF - 0.6).all(1)]
    assert abs(np.median(roof[:, 2]) - ROOF) < 0.05
    cells = {tuple(cell) for cell in np.floor(found.points[:, :2] / 0.6).astype(int)}
    wanted = {(i, j) for i in range(-10, 10) for j in range(-10, 10)}
    assert len(wanted & cells) > 0.85 * len(wanted)
    assert np.abs(found.colors[:, 2].astype(int) + found.colors[:, 0] - 255).max() <= 2  # as painted
    assert told == [(step, 18) for step in range(1, 19)]
    assert not left


def test_cells_are_as_large_as_pixels_are(tmp_path):
    """Photographs with a long lens to the left, whose pixels are half as wide as those of the others."""
    left = [camera(x, y, focal=300.0) for x in (-9.0, -7.0, -5.0) for y in (-2.0, 0.0, 2.0)]
    right = [camera(x, y) for x in (3.0, 6.0, 9.0) for y in (-3.0, 0.0, 3.0)]
    points = points_of([*left, *right], tmp_path, cell=0.4, pixels=6.0).points
    spacing = cKDTree(points).query(points, k=2)[0][:, 1]
    assert spacing.min() > MIN_SPACING * 0.4 - 1e-9
    fine, coarse = (np.abs(points[:, 1]) < 2) & (points[:, 0] < -6), points[:, 0] > 6
    assert np.median(spacing[fine]) < 0.5
    assert np.median(spacing[coarse]) > MIN_SPACING * 0.8 - 1e-9
    assert np.quantile(height_at(points[coarse]), 0.95) < 0.02 * HEIGHT
    wanted = np.array([(x, y) for x in np.arange(7.0, 10.0, 0.5) for y in np.arange(-3.0, 3.0, 0.5)])
    assert (cKDTree(points[:, :2]).query(wanted)[0] < 0.8).mean() > 0.9


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=20), st.floats(0.01, 10), st.floats(0, 10))
def test_a_cell_is_hardly_larger_or_smaller_than_its_pixels_ask_for(widths, least, pixels):
    asked, edges = (
        pixels * np.array(widths),
        least * CELL_SCALES[FusionCell(least, pixels).scale_index(np.array(widths))],
    )
    assert (edges >= least).all()
    assert (edges <= np.maximum(least, 1.42 * asked)).all()
    assert (edges >= np.minimum(least * CELL_SCALES[-1], 0.7 * asked)).all()


def test_the_same_points_for_any_number_of_threads(whole, tmp_path):
    one, many = whole[0], points_of(flight(), tmp_path, threads=4)
    assert all(np.array_equal(a, b) for a, b in zip(one, many, strict=True))


def test_a_place_that_many_photographs_show_takes_no_more_memory(monkeypatch):
    """However often it is shown, as many cells are held as it has, and once more so many; each is the sum of all."""
    rng, shown = np.random.default_rng(0), 200
    photographs = [fusion._Cells(np.sort(rng.permutation(300)[:100]), rng.normal(size=(100, 8))) for _ in range(shown)]
    at_once = fusion._Cells.together(photographs)
    held, of = list[int](), fusion._Cells.of
    monkeypatch.setattr(fusion._Cells, "of", lambda keys, values: held.append(len(keys)) or of(keys, values))
    found = fusion._summed(iter(photographs), most_waiting=150)
    assert max(held) <= 300 + 300 + 100
    assert np.array_equal(found.keys, at_once.keys)
    assert np.array_equal(found.sums, at_once.sums)
    assert len(fusion._summed(iter([])).keys) == 0


def test_two_photographs_are_enough_and_one_is_not(tmp_path):
    two = points_of([camera(-2.0, 0.0), camera(2.0, 0.0)], tmp_path)
    assert len(two.points) > 100
    assert np.quantile(height_at(two.points), 0.9) < 0.02 * HEIGHT
    assert len(points_of([camera(0.0, 0.0)], tmp_path).points) == 0


def test_still_water_invents_nothing(whole, tmp_path):
    """One color, and the noise of a sensor."""
    rng = np.random.default_rng(0)
    water = [rng.normal(90, 1.5, (120, 160, 3)).astype(np.uint8) for _ in flight()]
    found = points_of(flight(), tmp_path, read=lambda index: (water[index], None))
    assert len(found.points) < 0.02 * len(whole[0].points)


def test_what_a_mask_leaves_out_starts_nothing(tmp_path):
    cameras = flight()

    def read(index: int):
        left = cameras[index].unproject(true_depth(cameras[index]))[..., 0] < 0.0
        return photograph(cameras[index]), left.astype(np.uint8)

    found = points_of(cameras, tmp_path, read=read)
    assert len(found.points) > 100
    assert found.points[:, 0].max() < 0.6


def test_every_step_may_stop_the_work(tmp_path):
    inputs = StereoInputs(flight(), sparse(), sparse(), lambda index: (photograph(flight()[index]), None))

    def stop(done: int, of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compute_dense_points(inputs, FusionCell(0.6, 0.0), tmp_path, stop)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_said_before_anything_is_matched(tmp_path, monkeypatch):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(VdgsError, match=r"need 1 MB there for a while \(No space left on device\). Free some space"):
        points_of(flight(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_partners_stand_on_all_sides_and_see_the_same_ground():
    grid = [camera(x, y) for y in (-4.0, 0.0, 4.0) for x in (-4.0, 0.0, 4.0)]
    elsewhere = [camera(100.0 + x, 0.0) for x in (-2.0, 2.0)]
    points = np.concatenate([sparse(), sparse() + np.array([100.0, 0, 5.0])])
    found = select_source_views([*grid, *elsewhere], points, count=4)
    middle = np.array([grid[other].position[:2] for other in found[4]])
    assert (middle.min(0) < 0).all()
    assert (middle.max(0) > 0).all()
    assert all(other < 9 for mine in found[:9] for other in mine)
    assert (found[9], found[10]) == ([10], [9])
    assert select_source_views(grid, np.zeros((0, 3))) == [[]] * 9
