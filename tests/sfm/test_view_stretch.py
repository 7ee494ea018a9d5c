"""Views that are parallel: no number of heights lets them tell a focal length, and what does is said and used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from support.flown_models import FOCAL, HEIGHT, WIDTH, flown_model
from vdgs.captures.position_adjustment import Problem, Up
from vdgs.captures.reconstruction import OVER_GROUND, OVER_MEDIAN, AccuracyFacts
from vdgs.config.sfm_options import SfmOptions
from vdgs.geometry.similarity import Similarity
from vdgs.sfm import focal_decision
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.focal_decision import (
    ASKED,
    OF_HEIGHTS,
    OF_LENSES,
    OF_ONE_HEIGHT,
    OF_PARALLEL,
    OF_SHAPE,
    adjust,
    release_focal,
)
from vdgs.sfm.focal_information import focal_deviation
from vdgs.sfm.focal_length import Lens
from vdgs.sfm.georeferencing import Georeferenced, georeference
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.image_metadata import attitude_from_gimbal
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.reconstruction_report import _advice, _flown_heights, _relief_explains, focal_reason
from vdgs.sfm.view_stretch import (
    SAID_SHARE,
    Known,
    Stretch,
    _by_heights,
    _Flown,
    factor_of_heights,
    stretched,
    with_stretch,
)
from vdgs.system.lazy_pycolmap import pycolmap

pytestmark = pytest.mark.slow

LOW, HIGH = 45.0, 80.0


def two_heights() -> np.ndarray:
    rows = [(x, y, LOW) for y in (-24, 0, 24) for x in np.linspace(-45, 45, 6)]
    return np.array(rows + [(x, y, HIGH) for y in (-20, 20) for x in np.linspace(-45, 45, 5)])


def one_height() -> np.ndarray:
    return np.array([(x, y, 60.0 + 0.3 * math.sin(x)) for y in (-24, 0, 24) for x in np.linspace(-45, 45, 6)])


def flown(
    places: np.ndarray, sway_deg: float = 0.0, said: float = 1.0, oblique: int = 0, focals: Sequence[float] = (FOCAL,)
) -> tuple[pycolmap.Reconstruction, list[SimpleNamespace]]:
    """A model as it is mapped with the focal length held at so many times the true one, which tags say; the first so
    many photographs are oblique views."""
    rng = np.random.default_rng(1)
    attitudes = [
        attitude_from_gimbal(
            90.0 if k % 12 < 6 else 270.0,
            (-55.0 if k < oblique else -90.0) + rng.normal(0, sway_deg),
            rng.normal(0, sway_deg),
        )
        for k in range(len(places))
    ]
    model, photographs = flown_model(places, rng, attitudes=attitudes, focals=focals)
    for k, photo in enumerate(photographs):
        photo.lens = Lens(said * focals[k % len(focals)] / WIDTH, "EXIF's focal length and sensor", confirmed=True)
    down = np.array([0.0, 0.0, -1.0])
    return stretched(model, Stretch(down, math.log(said), 0.0, ""), 1), photographs


def placed(
    model: pycolmap.Reconstruction, photographs: list[SimpleNamespace], places: np.ndarray, why: str = OF_PARALLEL,
    stated: np.ndarray | None = None, held: bool = True,
) -> Georeferenced:  # fmt: skip
    """By positions good to a centimetre, or to what is stated."""
    count = len(places)
    positions = GpsPriors(
        image_indices=np.arange(count), enu=places + np.random.default_rng(2).normal(0, 0.01, (count, 3)),
        gps_std=np.full((count, 3), 2.0) if stated is None else stated,
        are_stated=np.full(count, stated is not None), origin=(50.0, 8.0, 0.0), altitude_reference="", source="EXIF",
        notes=(),
        flights=(places[:, 2] > 70).astype(int) if stated is None else np.zeros(count, int),
    )  # fmt: skip
    plan = ReconstructionPlan(
        request=SimpleNamespace(options=SfmOptions(), gps=None), image_list=ImageList((), tuple(photographs), (), 0),
        gps_priors=positions, preflight=SimpleNamespace(height_m=None), threads=1, pairs=0,
    )  # fmt: skip
    return georeference(model, plan, (held, why))


def ground_m(found: Georeferenced) -> float:
    """How high the ground lies, which is at 3 m in the median."""
    assert found.origin is not None
    return found.origin[2] - 3.0


def test_how_far_views_differ_says_how_well_photographs_tell_the_focal_length():
    open_ = [focal_deviation(flown(two_heights(), sway)[0]) for sway in (0.0, 0.3, 1.0, 3.0)]
    assert open_[0] > 0.1
    assert all(more > 1.5 * less for more, less in pairwise(open_))
    assert open_[-1] < 0.01


@pytest.mark.parametrize(("sway_deg", "held"), [(0.0, (True, OF_PARALLEL)), (6.0, (False, OF_SHAPE))])
def test_heights_release_no_focal_length_of_parallel_views(sway_deg, held):
    model, _ = flown(two_heights(), sway_deg, 1.03)
    models = [model]
    assert release_focal(models, (True, OF_HEIGHTS), [group_of(1.03 * FOCAL)], 1) == held
    focal = models[0].cameras[1].mean_focal_length()
    assert focal == pytest.approx(1.03 * FOCAL if held[0] else FOCAL, rel=0.01)


def group_of(focal_px: float) -> CameraGroup:
    return CameraGroup(
        camera="", width=WIDTH, height=HEIGHT, focal_px=focal_px, has_focal_prior=True, source="", images=(),
        is_confirmed=True,
    )  # fmt: skip


@pytest.mark.parametrize(("oblique", "is_held"), [(0, True), (2, True), (3, False)])
def test_a_few_oblique_views_from_one_height_release_the_focal_length(oblique, is_held):
    places = np.array([(x, y, 60.0 + 0.3 * math.sin(x)) for y in (-36, -12, 12, 36) for x in np.linspace(-45, 45, 6)])
    models = [flown(places, 0.5, 1.03, oblique)[0]]
    held = release_focal(models, (True, OF_ONE_HEIGHT), [group_of(1.03 * FOCAL)], 1)
    assert held == ((True, OF_ONE_HEIGHT) if is_held else (False, OF_SHAPE))
    focal = models[0].cameras[1].mean_focal_length()
    assert focal == pytest.approx((1.03 if is_held else 1.0) * FOCAL, rel=0.004)


def test_lenses_whose_tags_disagree_are_fitted_and_recorded_heights_tell_how_long_they_are():
    """Held, no factor for both would bring photographs through either to their recorded heights."""
    places, focals, said = two_heights(), (1000.0, 1500.0), (1.025, 0.985)
    model, photographs = flown(places, 0.5, 1.0, focals=focals)
    for number, (focal, factor) in enumerate(zip(focals, said, strict=True), 1):
        model.cameras[number].focal_length = focal * factor
    for k, photo in enumerate(photographs):
        photo.lens = Lens(said[k % 2] * focals[k % 2] / WIDTH, "EXIF's focal length and sensor", confirmed=True)
    adjust(model, 1, hold_focal=True)
    models = [model]
    groups = [group_of(focal * factor) for focal, factor in zip(focals, said, strict=True)]
    held = release_focal(models, (True, OF_HEIGHTS), groups, 1)
    assert held == (False, OF_LENSES)
    found = placed(models[0], photographs, places, held[1], held=False)
    for number, focal in enumerate(focals, 1):
        assert found.model.cameras[number].mean_focal_length() == pytest.approx(focal, rel=0.005)
    assert found.placed.inliers.all()
    assert abs(ground_m(found)) < min(0.5, found.placed.accuracy.place_m[1])


def test_heights_that_are_stated_to_be_worse_do_not_tell_the_focal_length_as_well():
    """Above, the receiver has lost its corrections, says so, and is off by 1.5 m."""
    places = two_heights()
    above = places[:, 2] > 70
    model, photographs = flown(places)
    recorded = places + above[:, None] * [0, 0, 1.5]
    stated = np.where(above[:, None], [0.5, 0.5, 1.0], [0.015, 0.015, 0.03])
    found = placed(model, photographs, recorded, stated=stated)
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(FOCAL, rel=0.02)
    assert abs(ground_m(found)) < found.placed.accuracy.place_m[1]


def test_what_parallel_views_of_a_wall_leave_open_is_how_far_it_is():
    model, _ = flown(one_height())
    accuracy = AccuracyFacts(
        place_m=(0.04, 0.06), scale_percent=0.1, scale_m=0.1, north_deg=0.1, level_deg=0.1, positions_m=None,
        altitude="used",
    )  # fmt: skip
    northwards = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    none = np.zeros((0, 3))
    lies = Georegistration(
        similarity=Similarity(1.0, northwards, np.zeros(3)), method="", position_rows=np.zeros(0, int), targets=none,
        residuals=none, inliers=np.zeros(0, bool), accuracy=accuracy,
    )  # fmt: skip
    found = with_stretch(lies, Stretch(np.array([0.0, 0, -1]), 0.0, SAID_SHARE, "tags"), model)
    assert found.accuracy.place_m == pytest.approx((2 * SAID_SHARE * 60, 0.06), rel=0.1)
    assert any("what they show may lie" in note for note in found.notes)


@pytest.mark.parametrize("said", [1.0, 1.03, 1.1])
def test_recorded_heights_tell_the_focal_length_that_parallel_views_do_not(said):
    places = two_heights()
    found = placed(*flown(places, 0.0, said), places)
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(FOCAL, rel=0.002)
    assert found.placed.inliers.all()
    assert found.placed.accuracy.altitude == "used"
    assert abs(ground_m(found)) < 0.5  # points lie between 0 and 6 m; 3 % of the height are 1.4 m
    assert bool(found.focal_by) == (said != 1)
    assert any("by recorded altitudes it is" in note for note in found.placed.notes) == (said != 1)


def test_a_focal_length_that_was_asked_for_stays_and_what_contradicts_it_is_an_error_of_heights():
    places = two_heights()
    found = placed(*flown(places, 0.0, 1.03), places, ASKED)
    assert found.model.cameras[1].mean_focal_length() == pytest.approx(1.03 * FOCAL)
    assert found.placed.accuracy.place_m[1] > 0.03 * LOW
    assert abs(ground_m(found)) < found.placed.accuracy.place_m[1]


def test_the_height_of_the_ground_is_no_better_than_the_focal_length_of_a_flight_at_one_height():
    places = one_height()
    found = placed(*flown(places), places, "one height, straight down")
    assert found.placed.accuracy.place_m[1] >= 2 * SAID_SHARE * 55
    assert any("the ground may lie" in note for note in found.placed.notes)
    assert not found.focal_by


@pytest.mark.parametrize(
    ("flights", "tilt_deg", "told"), [("one", 1.0, True), ("two", 1.0, False), ("slope", 1.0, False)]
)
def test_heights_tell_the_factor_within_a_flight_and_not_along_a_slope(flights, tilt_deg, told):
    places = two_heights()
    if flights == "slope":
        places[:, 2] = 60 + 0.4 * places[:, 1] + 0.3 * np.sin(places[:, 0])
    number = (places[:, 2] > 70).astype(int) if flights == "two" else np.zeros(len(places), int)
    off = -0.03 / 1.03 * 1.03 * places[:, 2] + np.random.default_rng(0).normal(0, 0.02, len(places))
    known = factor_of_heights(places, off, number, math.tan(math.radians(tilt_deg)), 0.08)
    assert (known.deviation < 0.005) is told
    if told:
        assert known.log == pytest.approx(math.log(0.97), abs=0.002)


def test_what_is_plainly_better_counts_alone_and_others_by_what_they_are_good_for():
    tags = Known(0.0, 0.02, "tags")
    assert tags.joined(Known(0.03, 0.005, "heights")) == Known(0.03, 0.005, "heights")
    both = tags.joined(Known(0.03, 0.02, "heights"))
    assert both.log == pytest.approx(0.015)
    assert both.deviation == pytest.approx(0.02 / math.sqrt(2))
    assert tags.joined(Known(0.3, 0.03, "a drift")) == tags


def test_a_flight_that_follows_a_slope_is_as_high_as_over_the_ground_below():
    slope = np.array([(x, y, 60 + 0.45 * y) for y in np.linspace(-60, 60, 6) for x in (-30.0, 0, 30)])
    model, _ = flown_model(slope, np.random.default_rng(0))
    for point in model.points3D.values():  # a slope under a slope
        point.xyz = [*point.xyz[:2], point.xyz[2] + 0.45 * point.xyz[1]]
    images = list(model.images.values())
    heights, over = _flown_heights(model, images)
    assert over == OVER_GROUND
    assert np.median(heights) == pytest.approx(57, abs=6)
    assert np.ptp(heights) < 30
    assert _relief_explains(model, images, 60 + 0.45 * 60)  # taken off at the foot
    assert not _relief_explains(model, images, 200.0)
    level, _ = flown_model(one_height(), np.random.default_rng(0))
    images = list(level.images.values())
    assert _flown_heights(level, images)[1] == OVER_MEDIAN
    assert not _relief_explains(level, images, 73.0)
    assert not _relief_explains(level, images, None)


def test_a_report_says_once_what_told_the_focal_length():
    said = focal_reason(OF_PARALLEL, "recorded altitudes")
    assert said == f"{OF_PARALLEL}; then by recorded altitudes"
    assert focal_reason(said, "tags") == f"{OF_PARALLEL}; then by tags"
    assert focal_reason(said) == OF_PARALLEL == focal_decision.OF_PARALLEL


def test_the_advice_promises_nothing_of_a_second_height_but_what_recorded_heights_tell():
    look = SimpleNamespace(forward_overlap=None, views_per_point=None, oblique=0)
    [advice] = _advice(look, True, 10, 10)
    assert "oblique views" in advice
    assert "by the recorded heights alone" in advice
    assert not _advice(look, False, 10, 10)


@pytest.mark.parametrize("without", [(), (0,), (3, 4, 9)])
def test_heights_over_the_take_off_of_most_photographs_tell_the_factor(without):
    """Of a model whose heights differ 3 % less than they should."""
    places, up = two_heights(), Up(np.array([0.0, 0.0, 1.0]), 0.3, "")
    taken = [
        SimpleNamespace(name=f"{k}", camera="", datetime="", subsecond=None,
                        relative_altitude=None if k in without else height)
        for k, height in enumerate(places[:, 2].tolist())
    ]  # fmt: skip
    problem = Problem(centers=places, targets=places, times=np.zeros(len(places)), up=up, has_altitudes=False)
    plane = SimpleNamespace(inliers=np.ones(len(places), bool), placed=places * [1, 1, 1 / 1.03])
    zeros = np.zeros(len(places))
    known = _by_heights(_Flown(problem, plane, np.array([0.0, 0.0, -1.0]), taken, zeros, zeros))
    assert known.log == pytest.approx(math.log(1.03), abs=0.003)
    for photo in taken[1:]:
        photo.relative_altitude = None
    assert _by_heights(_Flown(problem, plane, np.array([0.0, 0.0, -1.0]), taken, zeros, zeros)) is None
