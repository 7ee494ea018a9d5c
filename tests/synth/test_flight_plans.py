"""Flights over the generated place: each is uneven in its own way, tests lie all over it, the truth is true."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")

from vdgs.captures.ground_truth import load_ground_truth, pack_depth, unpack_depth
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.synth import SynthOptions, generate
from vdgs.synth.flight_cameras import _pose, make_camera, make_flight_cameras, make_test_cameras
from vdgs.synth.flight_plans import FLIGHT_PLANS, FlightArea, altitude_for_overlap
from vdgs.synth.mesh import Material, MeshBuilder
from vdgs.synth.perturbations import add_outliers, exposure_gains, perturb_cameras
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.synth_options import ResolvedOptions
from vdgs.synth.synthetic_points import SparseCloud
from vdgs.synth.town import Town, build_town
from vdgs.synth.true_visibility import (
    compute_flight_stats,
    count_visibility,
    sample_surface_points,
    sample_visible_points,
    view_ground_truth,
)

pytestmark = [pytest.mark.xdist_group("synth_flights"), pytest.mark.slow]

FLIGHTS = ("uneven", "even", "distant", "orbits", "corridor", "heights")
TOY = SynthOptions(
    size="toy", width=64, height=48, samples_per_pixel=1, num_points=300, seed=5, extent_m=120.0, truth=True,
    num_images=12, num_test_images=2, num_validation_images=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def town() -> Town:
    return build_town(5, 120.0)


@pytest.fixture(scope="module")
def tracer(town: Town) -> RayTracer:
    return RayTracer(town.mesh)


@pytest.fixture(scope="module")
def capture(town: Town, tracer: RayTracer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toy") / "capture"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vdgs.synth.generation.build_town", lambda seed, extent_m, pond_within: town)
        patch.setattr("vdgs.synth.generation.RayTracer", lambda mesh: tracer)
        patch.setattr("vdgs.synth.lighting._CELL", 4.0)  # how bright the ground is does not matter here
        generate(folder, replace(TOY, exposure_stops=0.3, outlier_fraction=0.1, pose_noise_px=0.5))
    return folder


def options_of(flight: str, images: int = 60, **more: object) -> ResolvedOptions:
    return replace(SynthOptions(num_images=images, **more), flight=flight).resolved()  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def seen(town: Town, tracer: RayTracer) -> dict[str, tuple[list[Camera], np.ndarray, np.ndarray]]:
    """Of each flight: its cameras, places that they see, and how many of them see each."""
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vdgs.synth.true_visibility._NUM_POINTS", 12_000)
        for flight in FLIGHTS:
            cameras = make_flight_cameras(options_of(flight, width=64, height=48), town)
            places, views = sample_visible_points(tracer, town.mesh, cameras, 60.0, np.random.default_rng(0))
            found[flight] = (cameras, places, views)
    return found


@pytest.mark.parametrize("flight", [*FLIGHTS, "horizon"])
@pytest.mark.parametrize("images", [41, 120])
def test_flights_take_what_was_asked_for_and_hit_nothing(
    flight: str, images: int, town: Town, tracer: RayTracer
) -> None:
    cameras = make_flight_cameras(options_of(flight, images), town)
    assert len(cameras) == images
    places = np.stack([camera.position for camera in cameras])
    down = tracer.intersect(places.astype(np.float32), np.tile(np.float32([0, 0, -1]), (images, 1)))
    assert (down.distance > 5).all(), "a camera is inside a building or right above it"
    steepest = max(camera.forward[2] for camera in cameras)
    limit = {"distant": 70, "orbits": 70, "horizon": 90}.get(flight, 52)
    assert steepest < -np.cos(np.radians(limit)), "too near to the horizon"
    assert (steepest > -np.cos(np.radians(80))) == (flight == "horizon")


def test_each_flight_is_uneven_in_its_own_way(seen) -> None:
    found, share_in_middle, far, heights = {}, {}, {}, {}
    for flight, (cameras, places, views) in seen.items():
        found[flight] = compute_flight_stats(views, len(cameras))
        far[flight] = (np.abs(places[:, :2]).max(1) > 90).sum()
        at = np.array([camera.position[:2] for camera in cameras])
        heights[flight] = [camera.position[2] for camera in cameras]
        share_in_middle[flight] = np.mean(np.abs(at).max(1) < 0.22 * 120)
    assert found["uneven"].gini > found["even"].gini
    assert share_in_middle["uneven"] > 1.2 * share_in_middle["even"]
    assert far["distant"] > 1.3 * max(far["even"], far["uneven"])
    assert np.ptp(heights["heights"]) > 2.5 * np.median(heights["even"])
    assert all(0 < each.gini < 1 and each.quantiles[5] >= 1 for each in found.values())


@pytest.mark.parametrize("flight", FLIGHTS)
def test_test_views_fall_all_over_what_was_seen(flight: str, seen, town: Town, tracer: RayTracer) -> None:
    options, (training, places, views) = options_of(flight, width=64, height=48), seen[flight]
    held = make_test_cameras(tracer, town.terrain, training, places, 8, options, np.random.default_rng(3))
    by_tests = count_visibility(tracer, held, places) > 0
    every_eighth = count_visibility(tracer, training[::8][:8], places) > 0
    poor = views <= np.percentile(views, 25)
    assert by_tests[poor].mean() > every_eighth[poor].mean(), "poorly seen places are tested on less than by n-th"
    shares = [(view_ground_truth(tracer, camera, training)[1] > 0).mean() for camera in held]
    assert np.mean(shares) > 0.85, "tests show what no training photograph saw"


def test_overlap_sets_the_altitude(town: Town) -> None:
    heights = [
        np.median([camera.position[2] for camera in make_flight_cameras(options_of("even", overlap=overlap), town)])
        for overlap in (0.6, 0.8)
    ]
    assert heights[1] / heights[0] == pytest.approx(2.0, rel=0.15)
    with pytest.raises(VdgsError, match=r"--overlap 0\.1 with"):
        make_flight_cameras(options_of("even", overlap=0.1), town)


def test_overlap_is_that_of_an_even_grid() -> None:
    """Pictures of a lens as long as they are wide, of 3 by 4: of the mean side so much is that of the next, too."""
    altitude = altitude_for_overlap(900.0, 100, 0.7, 1.0)
    assert 1 - (900.0 / 10) / (altitude * np.sqrt(0.75)) == pytest.approx(0.7)


def test_orbits_look_at_the_feet_of_their_landmarks(town: Town) -> None:
    landmarks = np.array([[10.0, -20.0], [-60.0, 35.0]])
    area = FlightArea(half=100.0, altitude=50.0, count=24, phase=0.4, plan=town.plan, landmarks=landmarks)
    orbits = FLIGHT_PLANS["orbits"](area)
    reach = area.altitude * orbits.altitude_factor * np.tan(orbits.tilt)
    ahead = np.stack([np.sin(orbits.heading), np.cos(orbits.heading)], axis=1)
    np.testing.assert_allclose(orbits.position_xy + reach[:, None] * ahead, landmarks[np.arange(24) % 2], atol=1e-9)


def test_test_views_look_at_what_they_are_to_show(town: Town) -> None:
    """But for what is drawn: some metres of each, and the ground below."""
    options, rng = options_of("even", width=64, height=48), np.random.default_rng(0)
    training = make_flight_cameras(options, town)
    missed = []
    for x, y in ((0.0, 60.0), (60.0, 0.0), (-60.0, 0.0), (0.0, -60.0)) * 5:
        target = np.array([x, y, float(town.terrain.height_without_ponds(x, y))])
        camera = _pose(town.terrain, training[:3], target, options, rng)
        reach = (target[2] - camera.position[2]) / camera.forward[2]
        missed.append(np.linalg.norm((camera.position + reach * camera.forward - target)[:2]))
    assert np.median(missed) < 20.0


def test_what_stands_in_between_hides() -> None:
    """A wall above flat ground: places behind it are in the frustum and yet not seen."""
    builder = MeshBuilder()
    ground = np.array([(-50, -50, 0), (50, -50, 0), (50, 50, 0), (-50, 50, 0)], float)
    roof = np.array([(-5, -5, 10), (5, -5, 10), (5, 5, 10), (-5, 5, 10)], float)
    for ring in (ground, roof):
        builder.polygon(ring, Material.PLASTER, np.ones(3))
    mesh = builder.build()
    camera = make_camera(np.eye(4), options_of("even", width=64, height=64))
    rigid = np.eye(4)
    rigid[:3, :3] = np.diag([1.0, -1.0, -1.0])
    rigid[:3, 3] = [0, 0, 40]
    above = replace(camera, camera_from_world=rigid)
    places = np.array([(0, 0, 0), (0, 0, 10), (12, 0, 0), (200, 0, 0)], float)
    assert count_visibility(RayTracer(mesh), [above, above], places).tolist() == [0, 2, 2, 0]
    depth, views = view_ground_truth(RayTracer(mesh), above, [above])
    assert set(np.unique(np.round(depth))) == {30.0, 40.0}
    assert (views == 1).all()
    spread = sample_surface_points(mesh, 50.0, 4000, np.random.default_rng(0))
    assert np.mean(spread[:, 2] > 5) == pytest.approx(100 / 10100, abs=0.01)


def test_a_generated_capture_is_split_by_its_own_lists(capture: Path) -> None:
    tested = load_capture(capture, CaptureOptions(up="z"))
    validated = load_capture(capture, CaptureOptions(up="z", validation=True))
    assert {view.name.split("_")[0] for view in tested.train_views} == {"drone"}
    assert {view.name.split("_")[0] for view in tested.test_views} == {"test"}
    assert {view.name.split("_")[0] for view in validated.test_views} == {"validation"}
    assert [view.name for view in tested.train_views] == [view.name for view in validated.train_views]
    assert len(tested.train_views) == TOY.num_images


def test_truth_is_read_back_at_the_size_in_use(capture: Path) -> None:
    truth = load_ground_truth(capture)
    whole = load_capture(capture, CaptureOptions(up="z"))
    half = load_capture(capture, CaptureOptions(up="z", downscale=2))
    for view, small in zip(whole.test_views, half.test_views, strict=True):
        visibility = truth.visibility_map(view)
        assert visibility.shape == (48, 64)
        np.testing.assert_array_equal(np.isnan(visibility), np.isinf(truth.depth(view.name)))
        assert np.nanmax(visibility) <= TOY.num_images
        assert np.nanmean(visibility > 0) > 0.6
        assert truth.visibility_map(small).shape == (24, 32)
    with pytest.raises(VdgsError, match="test and validation"):
        truth.visibility_map(whole.train_views[0])
    with pytest.raises(VdgsError, match="no truth"):
        load_ground_truth(capture / "images")


def test_the_flight_says_how_uneven_it_is(capture: Path) -> None:
    facts = json.loads((capture / "truth" / "flight.json").read_text())
    assert facts["flight"] == "uneven"
    assert facts["photographs"] == TOY.num_images
    assert facts["quantiles"]["5"] <= facts["quantiles"]["95"]


def test_disturbances_are_written_and_known(capture: Path) -> None:
    with np.load(capture / "truth" / "cameras.npz", allow_pickle=False) as cameras:
        assert np.std(np.log2(cameras["gains"])) > 0.05
        assert len(cameras["names"]) == len(cameras["camera_from_world"]) == 12 + 2 + 2
    with np.load(capture / "truth" / "points.npz", allow_pickle=False) as points:
        assert points["outliers"].mean() == pytest.approx(0.1, abs=0.02)


def test_depth_is_kept_to_a_few_thousandths_of_a_percent() -> None:
    depth = np.geomspace(0.5, 20_000, 5000).reshape(50, 100).astype(np.float32)
    depth[0, :7] = np.inf
    back = unpack_depth(*pack_depth(depth))
    np.testing.assert_array_equal(np.isinf(back), np.isinf(depth))
    np.testing.assert_allclose(back[1:], depth[1:], rtol=1.2e-4)
    for constant in (np.full((2, 2), 7.0, np.float32), np.full((2, 2), np.inf, np.float32)):
        np.testing.assert_allclose(unpack_depth(*pack_depth(constant)), constant)


def test_noise_has_the_size_that_was_asked_for(town: Town) -> None:
    cameras = make_flight_cameras(options_of("even", images=120), town)
    shifts = []
    for true, noisy in zip(cameras, perturb_cameras(cameras, 0.8, 60.0, np.random.default_rng(0)), strict=True):
        below = true.position + true.forward * 60.0
        shifts.append((noisy.project(below[None])[0] - true.project(below[None])[0])[0])
    assert np.std(shifts) == pytest.approx(0.8, rel=0.2)
    gains = np.log2(exposure_gains(4000, 0.5, np.random.default_rng(0)))
    assert gains[:, 1].std() == pytest.approx(0.5, rel=0.2)
    assert np.abs(np.diff(gains[:, 1])).mean() < 0.6 * gains[:, 1].std(), "exposure drifts, it does not flicker"
    np.testing.assert_allclose(gains[:, [0, 2]].mean(axis=1), gains[:, 1], atol=1e-9)  # warmth changes no brightness
    assert (exposure_gains(5, 0.0, np.random.default_rng(0)) == 1).all()


def test_outliers_lie_on_a_ray_that_saw_them(town: Town) -> None:
    cameras = make_flight_cameras(options_of("even", images=3), town)
    rng = np.random.default_rng(0)
    places = rng.normal(0, 10, (50, 3))
    point, image = np.repeat(np.arange(50), 3), np.tile(np.arange(3), 50)
    cloud = SparseCloud(
        true_points=places, points=places.copy(), colors=np.zeros((50, 3), np.uint8), errors=np.zeros(50),
        observed_point=point, observed_image=image, observed_px=rng.normal(size=(150, 2)),
        visibility=np.ones((50, 3), bool), outliers=np.zeros(50, bool),
    )  # fmt: skip
    wrong = add_outliers(cloud, cameras, 0.2, rng)
    assert wrong.outliers.sum() == 10
    np.testing.assert_array_equal(wrong.points[~wrong.outliers], places[~wrong.outliers])
    true_ray, ray = (each[wrong.outliers] - cameras[0].position for each in (places, wrong.points))
    np.testing.assert_allclose(np.cross(true_ray, ray), 0, atol=1e-6 * np.abs(ray).max() ** 2)
    lengths = np.bincount(wrong.observed_point)
    assert (lengths[wrong.outliers] == 2).all()
    assert (lengths[~wrong.outliers] == 3).all()
    assert len(wrong.observed_px) == len(wrong.observed_image) == lengths.sum()
