"""Lenses beyond COLMAP's: Brown's with a fourth radial term and skew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vdgs.captures.formats.brown_lens import brown_intrinsics, brown_pinhole, project_rays, unproject_pixels
from vdgs.captures.formats.lens_projection import pixel_rays, ray_pixels
from vdgs.captures.formats.source_capture import BROWN, Intrinsics
from vdgs.captures.image_matching import scale_intrinsics
from vdgs.captures.undistortion import sampling_map, undistorted_pinhole
from vdgs.errors import CaptureError

SIZE = (5280, 3956)
LENS = brown_intrinsics(
    (3706.0, 3705.47), (2651.7, 1950.3), SIZE, (-0.092, -0.076, 0.116, -0.076), (0.0012, -0.0031), -0.31
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


def test_unprojecting_undoes_projecting():
    pixels = pixels_of(LENS)
    rays = unproject_pixels(LENS, pixels)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(project_rays(LENS, rays) / SIZE[0], pixels / SIZE[0], atol=1e-9)


def test_where_a_lens_folds_over_there_is_no_ray():
    folded = brown_intrinsics((800.0, 800.0), (500.0, 400.0), (1000, 800), (-0.9, 0, 0, 1e-6))
    rays = unproject_pixels(folded, np.array([[500.0, 400.0], [5.0, 5.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()
    with pytest.raises(CaptureError, match="folds over"):
        undistorted_pinhole(folded)


@pytest.mark.parametrize("tail", [(-0.1, 0.03, 0.001, -0.002), (0.05, -0.01, 0.0, 0.0)])
def test_the_undistorted_camera_and_the_way_to_it_are_those_of_colmap(tail):
    opencv = Intrinsics("OPENCV", (3000.0, 3010.0, 2010.0, 1490.0, *tail), 4000, 3000)
    brown = Intrinsics(BROWN, (*opencv.params, 0.0, 0.0, 0.0), 4000, 3000)
    pinhole = undistorted_pinhole(opencv)
    found = brown_pinhole(brown)
    assert (found.width, found.height) == (pinhole.width, pinhole.height)
    np.testing.assert_allclose(found.params, pinhole.params, atol=1e-9)
    np.testing.assert_allclose(sampling_map(brown, found), sampling_map(opencv, pinhole), atol=1e-3)


def test_the_undistorted_picture_has_no_blank_pixel():
    pinhole = undistorted_pinhole(LENS)
    grid = sampling_map(LENS, pinhole)
    assert grid.min() >= -1
    assert grid[..., 0].max() <= SIZE[0]
    assert grid[..., 1].max() <= SIZE[1]
    assert pinhole.width > 0.9 * SIZE[0]


def test_a_picture_shrunk_evenly_shows_the_same_rays():
    half = scale_intrinsics(LENS, SIZE[0] // 4, SIZE[1] // 4)
    rays = unproject_pixels(LENS, pixels_of(LENS, 200))
    np.testing.assert_allclose(project_rays(half, rays) * 4, project_rays(LENS, rays), atol=1e-6)


def test_colmap_models_know_no_such_lens(tmp_path: Path):
    from vdgs.captures.formats.colmap import read_colmap

    (tmp_path / "cameras.txt").write_text("1 BROWN 640 480 500 500 320 240 0 0 0 0 0 0 0\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(CaptureError, match="BROWN"):
        read_colmap(tmp_path)
