"""How bright photographs are beside each other: known from points that several show, before anything is trained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from captures_support import TinyScene, render_plane, tiny_scene, write_colmap
from cli_support import vdgs
from vdgs.captures.brightness import LEAST_LIGHT, deviation, gains_of
from vdgs.captures.capture import View
from vdgs.captures.formats.colmap_records import SIGHTINGS, some_of
from vdgs.captures.sightings import Sightings
from vdgs.model.anchor_model import AnchorModel
from vdgs.settings.presets import PRESETS

SCENE = tiny_scene(columns=5, rows=4)
CAMERAS = list(SCENE.cameras.values())
SPREAD = PRESETS["laptop"].training.exposure_spread


def views_of(scene: TinyScene) -> list[View]:
    """Views that know all points in their pictures."""
    views = []
    for name, camera in scene.cameras.items():
        numbers = np.flatnonzero(camera.sees(scene.points))
        pixels, _ = camera.project(scene.points[numbers])
        rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        views.append(View(name, camera, Path(name), None, "train", Sightings(scene.points[numbers], rays, numbers)))
    return views


VIEWS = views_of(SCENE)


def photographed(gains: np.ndarray) -> Callable[[int], np.ndarray]:
    """Photographs whose colours + LEAST_LIGHT are multiplied by exp(gains) [n, 3]; darkened, so that none saturates."""

    def read(index: int) -> np.ndarray:
        light = 0.5 * (render_plane(CAMERAS[index]) + LEAST_LIGHT) * np.exp(gains[index])
        return (light - LEAST_LIGHT).round().clip(0, 255).astype(np.uint8)

    return read


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), size=st.floats(0.0, 0.3))
def test_gains_are_found_whatever_the_place_looks_like(seed, size):
    gains = size * np.random.default_rng(seed).uniform(-1, 1, (len(CAMERAS), 3))
    gains -= gains.mean(axis=0)
    found = gains_of(VIEWS, photographed(gains))
    assert found is not None
    # Drawn to nothing by NEUTRAL_POINTS beside some two hundred sightings, and points lie beside pixels' middles.
    assert np.abs(found - gains).max() < 0.02 + 0.1 * size
    assert deviation(found) == pytest.approx(np.sqrt((gains**2).mean()), abs=0.01 + 0.1 * size)


def test_photographs_of_one_exposure_are_equally_bright():
    found = gains_of(VIEWS, photographed(np.zeros((len(CAMERAS), 3))))
    assert found is not None
    assert deviation(found) < 0.01 < SPREAD


def test_what_moves_before_a_photograph_hardly_makes_it_brighter():
    """A quarter of a photograph is white: the mean of its colours is brighter by more than 0.25."""
    read = photographed(np.zeros((len(CAMERAS), 3)))

    def hidden(index: int) -> np.ndarray:
        picture = read(index).copy()
        if index == 3:
            picture[:, : picture.shape[1] // 4] = 255
        return picture

    assert np.log(hidden(3) + LEAST_LIGHT).mean() > 0.25 + np.log(read(3) + LEAST_LIGHT).mean()
    found = gains_of(VIEWS, hidden)
    assert found is not None
    assert np.abs(found[3]).max() < 0.1


def test_photographs_at_another_size_are_as_bright():
    gains = 0.2 * np.random.default_rng(0).uniform(-1, 1, (len(CAMERAS), 3))
    gains -= gains.mean(axis=0)
    small = [replace(view, camera=view.camera.resized(32, 24)) for view in VIEWS]
    full = photographed(gains)
    found = gains_of(small, lambda index: cv2.resize(full(index), (32, 24), interpolation=cv2.INTER_AREA))
    assert found is not None
    assert np.abs(found - gains).max() < 0.05


def test_without_points_nothing_is_known():
    blind = [replace(view, sightings=None) for view in VIEWS]
    assert gains_of(blind, photographed(np.zeros((len(CAMERAS), 3)))) is None
    found = gains_of([blind[0], *VIEWS[1:]], photographed(np.zeros((len(CAMERAS), 3))))
    assert found is not None
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1:]).all()
    assert deviation(found) < SPREAD
    assert deviation(np.full((3, 3), np.nan)) == 0


@given(seed=st.integers(0, 1000), count=st.integers(1, 3 * SIGHTINGS))
def test_photographs_remember_the_same_of_the_points_that_they_share(seed, count):
    """What a photograph remembers of the many points of a region, one of fewer of them remembers too."""
    generator = np.random.default_rng(seed)
    numbers = generator.choice(2**40, 3 * SIGHTINGS, replace=False)
    pixels = generator.uniform(0, 100, (len(numbers), 2))
    fewer = np.sort(generator.choice(len(numbers), count, replace=False))
    of_all, places = some_of(numbers, pixels)
    of_some, _ = some_of(numbers[fewer], pixels[fewer])
    assert len(of_all) == SIGHTINGS
    assert len(of_some) == min(SIGHTINGS, count)
    assert set(of_all) & set(numbers[fewer]) <= set(of_some)
    where = [int(np.flatnonzero(numbers == number)[0]) for number in of_all]
    assert where == sorted(where)
    assert (pixels[where] == places).all()


def test_points_that_are_remembered_lie_all_over_a_photograph():
    numbers = np.arange(1, 20_001)  # as a matcher numbers them: along the picture
    pixels = np.column_stack([numbers / 20_000, np.zeros(len(numbers))])
    _, places = some_of(numbers, pixels)
    shares, _ = np.histogram(places[:, 0], bins=4, range=(0, 1))
    assert (shares > 0.6 * SIGHTINGS / 4).all()


SETTINGS = ("--preset", "laptop", "--iterations", "20", "--anchors.offsets", "3", "--up", "z")


@pytest.mark.parametrize(
    ("gains", "tracks", "said", "fitted"),
    [
        ((1.0,), True, "so none is fitted", False),
        ((0.6, 1.0), True, "one is fitted to each photograph", True),
        ((1.0,), False, None, True),  # nothing tells
    ],
)
def test_exposures_are_fitted_where_photographs_differ(
    tmp_path: Path, gains: Sequence[float], tracks: bool, said: str | None, fitted: bool
):
    capture, run = tmp_path / "capture", tmp_path / "run"
    write_colmap(capture, SCENE, tracks=tracks)
    for index, name in enumerate(SCENE.cameras):
        picture = 0.8 * gains[index % len(gains)] * render_plane(CAMERAS[index])[:, :, ::-1]
        assert cv2.imwrite(str(capture / "images" / name), picture.astype(np.uint8))
    done = vdgs("coarse", capture, "--output", run, *SETTINGS)
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stdout.split())
    assert ("exposure: the photographs differ in brightness" in told) == (said is not None)
    assert said is None or said in told
    model = AnchorModel.load(run / "coarse/model.safetensors")
    assert (model.decoder.exposure is not None) == fitted
