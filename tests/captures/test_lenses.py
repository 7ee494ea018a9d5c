"""Lenses beyond COLMAP's: Brown's with a fourth radial term and skew, growing tangential terms, fisheyes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from vdgs.captures import pinholes
from vdgs.captures.formats.brown_lens import (
    _bent,
    _slopes,
    brown_intrinsics,
    brown_pinhole,
    fisheye_intrinsics,
    project_rays,
    quarter_turn_fisheye,
    unproject_pixels,
)
from vdgs.captures.formats.lens_projection import fold_radius, pixel_rays, ray_pixels
from vdgs.captures.formats.source_capture import BROWN, GENERAL, GENERAL_FISHEYE, Intrinsics
from vdgs.captures.image_matching import scale_intrinsics
from vdgs.captures.pinholes import fold_notes, undistorted_pinhole
from vdgs.captures.undistortion import sampling_map
from vdgs.errors import CaptureError

SIZE = (5280, 3956)
LENS = brown_intrinsics(
    (3706.0, 3705.47), (2651.7, 1950.3), SIZE, (-0.092, -0.076, 0.116, -0.076), (0.0012, -0.0031), -0.31
)


GROWING = brown_intrinsics((3706.0, 3705.0), (2651.7, 1950.3), SIZE, (-0.092,), (0.0012, -0.0031), 0.2, (0.4, -0.3))
FISHEYE = fisheye_intrinsics(
    (1500.0, 1.5, -0.7, 1498.0), (2651.7, 1950.3), SIZE, (0.01, -0.02, 0.004, 0.001), (0.001, 2e-4)
)


def pixels_of(lens: Intrinsics, count: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, (lens.width, lens.height), (count, 2))


def test_the_plainest_model_that_is_exactly_the_lens():
    focal, center = (900.0, 901.0), (400.0, 300.0)
    for radial, tangential, skew, model in (
        ((), (0, 0), 0, "PINHOLE"),
        ((-0.1, 0.02), (0.001, 0.002), 0, "OPENCV"),
        ((-0.1, 0.02, 0.01), (0.001, 0.002), 0, "FULL_OPENCV"),
        ((-0.1, 0.02, 0.01, 0.002), (0.001, 0.002), 0, BROWN),
        ((), (0, 0), 0.4, BROWN),
    ):
        lens = brown_intrinsics(focal, center, (800, 600), radial, tangential, skew)
        as_brown = Intrinsics(
            BROWN, (*focal, *center, *(*radial, 0, 0)[:2], *tangential, *(*radial, 0, 0, 0, 0)[2:4], skew), 800, 600
        )
        assert lens.model == model
        rays = np.random.default_rng(1).uniform(-0.4, 0.4, (500, 2))
        np.testing.assert_allclose(ray_pixels(lens, rays) if lens.is_distorted else rays * focal + center,
                                   project_rays(as_brown, rays), atol=1e-9)  # fmt: skip
        np.testing.assert_allclose(pixel_rays(lens, project_rays(as_brown, rays)), rays, atol=1e-9)


@pytest.mark.parametrize("lens", [LENS, GROWING, FISHEYE])
def test_unprojecting_undoes_projecting(lens):
    pixels = pixels_of(lens)
    rays = unproject_pixels(lens, pixels)
    known = np.isfinite(rays).all(axis=1)
    # A fisheye's corners look behind the camera.
    assert known.all() or (lens is FISHEYE and known.mean() > 0.7)
    np.testing.assert_allclose(project_rays(lens, rays[known]) / SIZE[0], pixels[known] / SIZE[0], atol=1e-9)
    half = scale_intrinsics(lens, SIZE[0] // 4, SIZE[1] // 4)
    np.testing.assert_allclose(project_rays(half, rays[known]) * 4, pixels[known], atol=1e-5)


def test_general_lenses_are_those_of_colmap_where_it_has_them():
    rays = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 2))
    center, powers, tangential = (400.0, 300.0), (0.0, 0.05, 0.0, -0.01, 0.0, 0.003, 0.0, -0.001), (0.001, -0.002)
    for lens in (
        fisheye_intrinsics((300.0, 0.0, 0.0, 301.0), center, (800, 600), powers),
        fisheye_intrinsics((300.0, 0.0, 0.0, 301.0), center, (800, 600), powers, tangential),
    ):
        assert lens.model in ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE")
        p1, p2 = tangential if lens.model == "THIN_PRISM_FISHEYE" else (0.0, 0.0)
        general = Intrinsics(
            GENERAL_FISHEYE, (300.0, 301.0, *center, 0.05, -0.01, p1, p2, 0.003, -0.001, *[0.0] * 8), 800, 600
        )
        np.testing.assert_allclose(project_rays(general, rays), ray_pixels(lens, rays), atol=1e-8)
    rays /= 3
    opencv = Intrinsics("OPENCV", (500.0, 501.0, 400.0, 300.0, -0.1, 0.03, 0.001, -0.002), 800, 600)
    general = Intrinsics(GENERAL, (*opencv.params, *[0.0] * 10), 800, 600)
    np.testing.assert_allclose(project_rays(general, rays), ray_pixels(opencv, rays), atol=1e-8)


def test_fisheyes_of_pix4d_and_bentley_are_their_formula():
    """Angles in quarter turns, a polynomial, an affine matrix (Pix4D's and Bentley's manuals)."""
    affine, polynomial = (1960.0, 3.0, -2.0, 1950.0), (0.0, 0.99, 0.05, -0.02, 0.004)
    lens = quarter_turn_fisheye(affine, (2000.0, 1500.0), (4000, 3000), polynomial)
    rays = np.random.default_rng(1).uniform(-2, 2, (500, 2))
    radius = np.hypot(*rays.T)
    theta = 2 / np.pi * np.arctan(radius)
    rho = sum(p * theta**power for power, p in enumerate(polynomial))
    expected = (rays * (rho / radius)[:, None]) @ np.reshape(affine, (2, 2)).T + (2000.0, 1500.0)
    np.testing.assert_allclose(ray_pixels(lens, rays), expected, atol=1e-8)
    np.testing.assert_allclose(pixel_rays(lens, expected), rays, atol=1e-8)
    assert quarter_turn_fisheye(affine, (2000.0, 1500.0), (4000, 3000), (0.1, 1.0)) is None
    assert quarter_turn_fisheye(affine, (2000.0, 1500.0), (4000, 3000), (0.0, -1.0)) is None


def test_where_a_lens_folds_over_there_is_no_ray():
    folded = brown_intrinsics((800.0, 800.0), (500.0, 400.0), (1000, 800), (-0.9, 0, 0, 1e-6))
    rays = unproject_pixels(folded, np.array([[500.0, 400.0], [5.0, 5.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


#: Lenses that fold over within their photographs, each with the share of them that is to be left.
FOLDED = [
    (Intrinsics("OPENCV", (60.0, 60.0, 50.0, 37.5, -0.28, 0.03, 0.001, -0.002), 100, 75), 0.75),
    (Intrinsics("FULL_OPENCV", (86.0, 86.0, 90.0, 56.0, -0.28, 0.1, 0.0, 0.0, -0.02, 0.0, 0.0, 0.0), 192, 108), 0.65),
    (Intrinsics("SIMPLE_RADIAL", (60.0, 50.0, 37.5, -0.3), 100, 75), 0.6),
    (Intrinsics("OPENCV_FISHEYE", (36.0, 36.0, 50.0, 37.5, -0.2, 0.0, 0.0, 0.0), 100, 75), 0.3),
    (Intrinsics(BROWN, (60.0, 60.0, 50.0, 37.5, -0.28, 0.03, 0.001, -0.002, 0.0, 0.0, 0.1), 100, 75), 0.75),
    (Intrinsics(GENERAL_FISHEYE, (36.0, 36.0, 50.0, 37.5, -0.2, *[0.0] * 13), 100, 75), 0.3),
]


@pytest.mark.parametrize(("lens", "least"), FOLDED)
def test_a_lens_that_folds_over_within_its_photograph_shows_nothing_twice(lens, least):
    """The picture is upright everywhere, of what is in the photograph, and a note says how much that is."""
    grid = sampling_map(lens, undistorted_pinhole(lens)).astype(float)
    across, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]
    assert (area > 0).mean() > 0.999  # differences of neighbors, and not slopes
    assert grid.min() > -1
    assert (grid < (lens.width, lens.height)).all()
    shown = area.sum() / (lens.width * lens.height)
    assert shown > least
    (note,) = fold_notes([lens, lens])
    told = int(re.search(r"the (\d+)% in the middle", note)[1])
    assert told == pytest.approx(100 * shown, abs=3)
    rays = pixel_rays(lens, pixels_of(lens))  # where features lie, the fold's other side included
    known = np.isfinite(rays).all(axis=1)
    np.testing.assert_allclose(ray_pixels(lens, rays[known]), pixels_of(lens)[known], atol=1e-4)
    assert shown - 0.02 < known.mean() < 1
    assert np.hypot(*rays[known].T).max() <= fold_radius(lens)


def test_what_lies_beyond_the_fold_of_a_lens_lies_outside_its_picture():
    """So that masks leave it out, whatever the pinhole camera is."""
    lens, wide = FOLDED[2][0], Intrinsics("PINHOLE", (20.0, 20.0, 50.0, 37.5), 100, 75)
    rows, columns = np.mgrid[:75, :100] + 0.5
    beyond = np.hypot(columns - 50, rows - 37.5) / 20 > fold_radius(lens)
    grid = sampling_map(lens, wide)
    assert fold_radius(lens) == pytest.approx(1 / np.sqrt(0.9), rel=1e-6)
    assert grid[beyond].max() < -1e5
    assert grid[~beyond].min() > -10


def test_a_lens_that_folds_over_beyond_its_photograph_is_used_in_full():
    for tail in ((-0.28, 0.045, 0.0, 0.0), (-0.1, 0.02, 0.001, -0.001)):
        lens = Intrinsics("OPENCV", (70.0, 70.0, 50.0, 37.5, *tail), 100, 75)
        corners = np.array([[0.0, 0.0], [100.0, 0.0], [100.0, 75.0], [0.0, 75.0]])
        assert np.isfinite(pixel_rays(lens, corners)).all()
        assert fold_notes([lens]) == []
        edges = sampling_map(lens, undistorted_pinhole(lens))
        assert min(edges[0, :, 1].min(), edges[:, 0, 0].min()) < 0.6


def test_a_lens_that_folds_over_near_the_middle_is_refused():
    for lens in (
        Intrinsics("SIMPLE_RADIAL", (80.0, 50.0, 40.0, -4.0), 100, 80),
        brown_intrinsics((80.0, 80.0), (50.0, 40.0), (100, 80), (-4.0,), skew=0.1),
    ):
        with pytest.raises(CaptureError, match=r"folds over 16°.*no more than \d+% of each photograph"):
            undistorted_pinhole(lens)


@pytest.mark.parametrize("center", [(502.5, 372.5), (490.0, 384.0)])
@pytest.mark.parametrize("tail", [(-0.1, 0.03, 0.001, -0.002), (0.05, -0.01, 0.0, 0.0)])
def test_the_undistorted_camera_and_the_way_to_it_are_those_of_colmap(tail, center):
    opencv = Intrinsics("OPENCV", (750.0, 752.5, *center, *tail), 1000, 750)
    brown = Intrinsics(BROWN, (*opencv.params, 0.0, 0.0, 0.0), 1000, 750)
    pinhole = undistorted_pinhole(opencv)
    found = brown_pinhole(brown)
    assert (found.width, found.height) == (pinhole.width, pinhole.height)
    np.testing.assert_allclose(found.params, pinhole.params, atol=1e-9)
    np.testing.assert_allclose(sampling_map(brown, found), sampling_map(opencv, pinhole), atol=2.5e-4)


def test_a_picture_without_distortion_stays_where_it_is():
    lens = Intrinsics("PINHOLE", (75.0, 76.0, 50.25, 37.5), 100, 75)
    rows, columns = np.mgrid[:75, :100]
    np.testing.assert_allclose(sampling_map(lens, lens), np.stack([columns, rows], axis=-1), atol=1e-5)


def test_the_slopes_of_lenses_are_finite_differences():
    """Newton's method finds rays with slopes that are a little off, too, only later."""
    rays, step = np.random.default_rng(2).uniform(-0.6, 0.6, (200, 2)), 1e-6
    for lens in (LENS, GROWING, FISHEYE):
        found = np.stack(_slopes(lens, rays), axis=1).reshape(-1, 2, 2)
        for axis, change in enumerate(np.eye(2) * step):
            slope = (_bent(lens, rays + change) - _bent(lens, rays - change)) / (2 * step)
            np.testing.assert_allclose(found[:, :, axis], slope, atol=1e-8)


@pytest.mark.parametrize("lens", [LENS, GROWING])
def test_the_undistorted_picture_has_no_blank_pixel(lens):
    small = scale_intrinsics(lens, SIZE[0] // 4, SIZE[1] // 4)
    pinhole = undistorted_pinhole(small)
    grid = sampling_map(small, pinhole)
    assert grid.min() >= -1
    assert grid[..., 0].max() <= small.width
    assert grid[..., 1].max() <= small.height
    assert pinhole.width > 0.9 * small.width


def test_a_fisheye_that_sees_behind_itself_becomes_a_pinhole():
    small = scale_intrinsics(FISHEYE, 528, 396)
    pinhole = undistorted_pinhole(small)
    assert 0 < pinhole.width <= 2 * small.width
    assert np.isfinite(sampling_map(small, pinhole)).all()


def test_what_a_lens_does_not_take_lies_outside_its_picture():
    """So that it is blank, and not the color of a corner."""
    lens = Intrinsics("SIMPLE_DIVISION", (40.0, 40.0, 30.0, 0.1), 80, 60)
    wide = Intrinsics("PINHOLE", (8.0, 8.0, 40.0, 30.0), 80, 60)
    rows, columns = np.mgrid[:60, :80] + 0.5
    rays = np.stack([(columns - 40) / 8, (rows - 30) / 8], axis=-1).reshape(-1, 2)
    taken = np.isfinite(ray_pixels(lens, rays)).all(axis=1).reshape(60, 80)
    grid = sampling_map(lens, wide)
    assert 0 < taken.mean() < 1
    assert np.isfinite(grid).all()
    assert grid[~taken].max() < -1


def test_colmap_models_know_no_such_lens(tmp_path: Path):
    from vdgs.captures.formats.colmap import read_colmap

    (tmp_path / "cameras.txt").write_text("1 BROWN 640 480 500 500 320 240 0 0 0 0 0 0 0\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(CaptureError, match="BROWN"):
        read_colmap(tmp_path)


def test_pinholes_of_a_capture_with_a_lens_for_each_photograph_are_found_once(monkeypatch):
    """Notes, files and masks go through all lenses one after the other."""
    found = []
    lenses = [Intrinsics("RADIAL", (900.0 + k / 10, 500.0, 400.0, -0.01, 0.0), 1000, 800) for k in range(2000)]
    monkeypatch.setattr(pinholes, "_colmap_pinhole", lambda lens: found.append(lens) or lens)
    monkeypatch.setattr(pinholes, "is_valid_ray", lambda _lens, rays: [True] * len(rays))
    monkeypatch.setattr(pinholes, "_valid_share", lambda _lens: 1.0)
    assert pinholes.fold_notes(lenses) == []
    assert [pinholes.undistorted_pinhole(lens) for lens in lenses] == lenses
    assert len(found) == len(lenses)
    pinholes._pinhole_and_shown.cache_clear()  # they are none
