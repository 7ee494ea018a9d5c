"""How bright photographs are beside each other: known from points that several show, before anything is trained."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from support.captures import TinyScene, render_plane, tiny_scene, write_colmap
from support.commands import vdgs
from vdgs.captures.capture import Observations, View
from vdgs.captures.formats.colmap_records import MAX_OBSERVATIONS, sample_observations
from vdgs.captures.image_cache import DecodedImage, ImageCache
from vdgs.captures.photometric_gains import LOG_OFFSET, PointColors, collect_point_colors
from vdgs.config.presets import PRESETS
from vdgs.model.anchor_model import AnchorModel

pytestmark = pytest.mark.slow

SCENE = tiny_scene(columns=5, rows=4)
CAMERAS = list(SCENE.cameras.values())
SPREAD = PRESETS["laptop"].training.exposure_min_spread


def views_of(scene: TinyScene) -> list[View]:
    """Views that know all points in their pictures."""
    views = []
    for name, camera in scene.cameras.items():
        numbers = np.flatnonzero(camera.in_frustum(scene.points))
        pixels, _ = camera.project(scene.points[numbers])
        rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        views.append(
            View(
                name=name,
                camera=camera,
                image_path=Path(name),
                mask_path=None,
                split="train",
                observations=Observations(scene.points[numbers], rays, numbers),
            )
        )
    return views


VIEWS = views_of(SCENE)
NONE = np.zeros((len(VIEWS), 3))


class Photographed(ImageCache):
    """Photographs whose colors + LEAST_LIGHT are multiplied by exp(gains) [n, 3], darkened so that none saturates.
    `change` may alter one; which sizes were asked for is in `asked`."""

    def __init__(
        self, gains: np.ndarray, views: Sequence[View] = VIEWS, downscales: Sequence[float] = (1,),
        change: Callable[[int, np.ndarray], DecodedImage] = lambda _, each: DecodedImage(torch.from_numpy(each), None),
    ) -> None:  # fmt: skip
        super().__init__(views, 0, downscales)
        self.gains, self.change, self.asked = gains, change, set[tuple[int, float]]()

    def prefetch(self, indices: Iterable[int], downscale: float = 1) -> None:
        pass

    def get(self, index: int, downscale: float = 1) -> DecodedImage:
        self.asked.add((index, downscale))
        light = 0.5 * (render_plane(self.camera(index, downscale)) + LOG_OFFSET) * np.exp(self.gains[index])
        return self.change(index, (light - LOG_OFFSET).round().clip(0, 255).astype(np.uint8))


def looked_at(images: ImageCache) -> PointColors:
    colors = collect_point_colors(images, lambda _done, _of: None)
    assert colors is not None
    return colors


def gains_of(images: ImageCache) -> np.ndarray:
    return np.stack([gain for _, gain in sorted(looked_at(images).gains().items())])


def some_gains(seed: int, size: float = 0.2, count: int = len(VIEWS)) -> np.ndarray:
    gains: np.ndarray = size * np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return gains - gains.mean(axis=0)


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), size=st.floats(0.0, 0.3))
def test_gains_are_found_whatever_the_place_looks_like(seed, size):
    gains = some_gains(seed, size)
    colors = looked_at(Photographed(gains))
    found = np.stack(list(colors.gains().values()))
    assert np.abs(found - gains).max() < 0.02 + 0.05 * size  # points lie beside the middles of pixels
    of_uniform = size / np.sqrt(3)
    assert 0.6 * of_uniform - 0.01 < colors.gain_spread() < 1.2 * of_uniform + 0.01


def test_gains_are_found_where_pixels_are_not_square():
    cameras = {name: replace(camera, fy=1.4 * camera.fy) for name, camera in SCENE.cameras.items()}
    gains = some_gains(3)
    found = gains_of(Photographed(gains, views_of(replace(SCENE, cameras=cameras))))
    assert np.abs(found - gains).max() < 0.03
    assert looked_at(Photographed(NONE, views_of(replace(SCENE, cameras=cameras)))).gain_spread() < 0.007


def test_photographs_of_one_exposure_are_equally_bright():
    assert looked_at(Photographed(NONE)).gain_spread() < 0.007 < SPREAD


def chain(drift: float, count: int, sees: int = 6, noise: float = 0.02) -> PointColors:
    """A flight of one strip, whose every photograph is brighter than the last by `drift`: new points enter each, 40 of
    them, and stay for the next ones."""
    generator = np.random.default_rng(count)
    first = np.repeat(np.arange(count - sees + 1), 40)
    image = (first[:, None] + np.arange(sees)).reshape(-1)
    point = np.repeat(np.arange(len(first)), sees)
    look = generator.uniform(0, 5, (len(first), 3))[point]
    color = look + (drift * image)[:, None] + generator.normal(0, noise, (len(image), 3))
    order = np.argsort(image, kind="stable")
    return PointColors(image[order], point[order], color[order])


@pytest.mark.parametrize("count", [20, 100, 400])
def test_a_drift_counts_by_what_it_makes_in_one_place_however_long_the_flight(count):
    """Six photographs show a place: 0 to 5 times the drift, whose standard deviation is 1.87 drifts."""
    assert chain(0.02, count).gain_spread() == pytest.approx(0.02 * np.std(range(6), ddof=1), rel=0.1)
    assert chain(0.0, count).gain_spread() < 0.004


def test_what_moves_before_a_photograph_hardly_makes_it_brighter():
    """A quarter of a photograph is white: the mean of its colors is brighter by more than 0.25."""

    def hidden(index: int, picture: np.ndarray) -> DecodedImage:
        if index == 3:
            picture[:, : picture.shape[1] // 4] = 255
        return DecodedImage(torch.from_numpy(picture), None)

    shown = [Photographed(NONE, change=change).get(3).image.numpy() for change in (whole, hidden)]
    before, after = (np.log(each + LOG_OFFSET).mean() for each in shown)
    assert after > before + 0.25
    assert np.abs(gains_of(Photographed(NONE, change=hidden))[3]).max() < 0.08


def whole(_: int, picture: np.ndarray) -> DecodedImage:
    return DecodedImage(torch.from_numpy(picture), None)


def test_what_is_masked_is_not_looked_at():
    """Every second photograph is black but for its right, as undistorted or transparent ones are."""

    def masked(index: int, picture: np.ndarray) -> DecodedImage:
        kept = np.ones(picture.shape[:2], np.uint8)
        kept[:, : picture.shape[1] // 2] = index % 2 == 0
        return DecodedImage(torch.from_numpy(picture * kept[..., None]), torch.from_numpy(kept))

    assert looked_at(Photographed(NONE, change=masked)).gain_spread() < 0.01

    def black(index: int, picture: np.ndarray) -> DecodedImage:
        return masked(index, picture)._replace(mask=None)

    assert looked_at(Photographed(NONE, change=black)).gain_spread() > 0.2, "or the mask would say nothing"


def numbered(change: Callable[[int, np.ndarray], np.ndarray]) -> list[View]:
    """Views whose points have other numbers: `change` of view and numbers."""
    return [
        replace(view, observations=replace(view.observations, point_ids=change(index, view.observations.point_ids)))
        for index, view in enumerate(VIEWS)
        if view.observations is not None
    ]


def test_points_that_one_photograph_shows_say_nothing():
    """Each shows some of the points of the others and many of its own: those of its own tell as much as none."""
    few = [replace(view, observations=part(view.observations, slice(0, 60))) for view in VIEWS]
    lone = numbered(
        lambda index, numbers: np.where(np.arange(len(numbers)) < 60, numbers, numbers + 10**6 * (index + 1))
    )
    gains = some_gains(1)
    assert np.array_equal(gains_of(Photographed(gains, few)), gains_of(Photographed(gains, lone)))


def part(sightings: Observations | None, which: slice) -> Observations:
    assert sightings is not None
    return Observations(sightings.points[which], sightings.rays[which], sightings.point_ids[which])


def test_a_photograph_that_shares_hardly_a_point_is_not_compared():
    """Three of its points, and those in the wrong colors."""
    lost = [*VIEWS[:7], replace(VIEWS[7], observations=part(VIEWS[7].observations, slice(0, 3))), *VIEWS[8:]]
    gains = NONE.copy()
    gains[7] = 0.6
    colors = looked_at(Photographed(gains, lost))
    assert sorted(colors.gains()) == [index for index in range(len(VIEWS)) if index != 7]
    assert colors.gain_spread() < 0.007


def test_points_of_a_photograph_that_is_not_compared_and_of_one_other_say_nothing():
    """Three points that only the first and the last show: too few for the last, and then of the first alone."""
    renumbered = numbered(lambda _, numbers: np.concatenate([10**6 + np.arange(3), numbers[3:]]))
    last = replace(renumbered[7], observations=part(renumbered[7].observations, slice(0, 3)))
    colors = looked_at(Photographed(NONE, [renumbered[0], *VIEWS[1:7], last]))
    assert (np.bincount(colors.point) > 1).all()


@pytest.mark.parametrize(
    "views",
    [
        [replace(view, observations=None) for view in VIEWS],
        numbered(lambda index, numbers: numbers + 10**6 * index),
        [replace(view, observations=replace(view.observations, rays=view.observations.rays + 9)) for view in VIEWS],  # type: ignore[type-var]
        VIEWS[:1],
    ],
    ids=["no points", "none shared", "none inside", "one photograph"],
)
def test_where_no_points_are_shared_nothing_is_known(views):
    assert collect_point_colors(Photographed(NONE, views), lambda _done, _of: None) is None


@pytest.mark.parametrize(("side", "asked"), [(64, 1), (1000, 1), (2000, 2), (4000, 4)])
def test_photographs_are_looked_at_small_and_are_as_bright(side, asked):
    large = [replace(view, camera=view.camera.resized(side, side * 3 // 4)) for view in VIEWS[:8]]
    gains = some_gains(2, count=8)
    images = Photographed(gains, large, downscales=(1, 2, 4))
    assert np.abs(gains_of(images) - gains).max() < 0.02
    assert images.asked == {(index, asked) for index in range(8)}


def test_of_many_photographs_some_are_looked_at():
    told: list[tuple[int, int]] = []
    gains = some_gains(3)
    images = Photographed(gains)
    colors = collect_point_colors(images, lambda done, of: told.append((done, of)), most_images=7)
    assert colors is not None
    assert told == [(done, 7) for done in range(7)]
    found = colors.gains()
    assert set(found) <= {index for index, _ in images.asked} <= set(range(len(VIEWS)))
    assert {0, len(VIEWS) - 1} <= {index for index, _ in images.asked}


@pytest.mark.parametrize("number", [np.inf, -np.inf, np.nan, 1e30, 2.0**63, -1.0])
def test_numbers_of_no_point_are_no_points(number):
    numbers, _ = sample_observations(np.array([5.0, number, 7.0]), np.zeros((3, 2)))
    assert numbers.tolist() == [5, 7]
    assert numbers.dtype == np.int64


@given(seed=st.integers(0, 1000), count=st.integers(1, 3 * MAX_OBSERVATIONS))
def test_photographs_remember_the_same_of_the_points_that_they_share(seed, count):
    """What a photograph remembers of the many points of a region, one of fewer of them remembers too."""
    generator = np.random.default_rng(seed)
    numbers = generator.choice(2**40, 3 * MAX_OBSERVATIONS, replace=False)
    pixels = generator.uniform(0, 100, (len(numbers), 2))
    fewer = np.sort(generator.choice(len(numbers), count, replace=False))
    of_all, places = sample_observations(numbers, pixels)
    of_some, _ = sample_observations(numbers[fewer], pixels[fewer])
    assert len(of_all) == MAX_OBSERVATIONS
    assert len(of_some) == min(MAX_OBSERVATIONS, count)
    assert set(of_all) & set(numbers[fewer]) <= set(of_some)
    where = [int(np.flatnonzero(numbers == number)[0]) for number in of_all]
    assert where == sorted(where)
    assert (pixels[where] == places).all()


def test_points_that_are_remembered_lie_all_over_a_photograph():
    numbers = np.arange(1, 20_001)  # as a matcher numbers them: along the picture
    pixels = np.column_stack([numbers / 20_000, np.zeros(len(numbers))])
    _, places = sample_observations(numbers, pixels)
    shares, _ = np.histogram(places[:, 0], bins=4, range=(0, 1))
    assert (shares > 0.6 * MAX_OBSERVATIONS / 4).all()


SETTINGS = ("--preset", "laptop", "--iterations", "20", "--model.num-offsets", "3", "--up", "z")


@pytest.mark.parametrize(
    ("gains", "tracks", "said", "fitted"),
    [
        ((1.0,), True, "so none is fitted", False),
        ((0.6, 1.0), True, "one is fitted to each", True),
        ((1.0,), False, "whether they differ in brightness is not known", True),
    ],
)
def test_exposures_are_fitted_where_photographs_differ(
    tmp_path: Path, gains: Sequence[float], tracks: bool, said: str, fitted: bool
):
    capture, run = tmp_path / "capture", tmp_path / "run"
    write_colmap(capture, SCENE, tracks=tracks)
    for index, name in enumerate(SCENE.cameras):
        picture = 0.8 * gains[index % len(gains)] * render_plane(CAMERAS[index])[:, :, ::-1]
        assert cv2.imwrite(str(capture / "images" / name), picture.astype(np.uint8))
    done = vdgs("train-coarse", capture, "--output", run, *SETTINGS)
    assert done.returncode == 0, done.stderr
    assert said in " ".join(done.stdout.split())
    model = AnchorModel.load(run / "coarse/model.safetensors")
    assert (model.decoder.exposure is not None) == fitted
    begun = json.loads((run / "coarse/initialization.json").read_text())
    assert begun["exposures"] == fitted
    assert (begun["brightness_differs"] is not None) == tracks
