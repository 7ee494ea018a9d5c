"""The generated town: what is written is true, repeatable, and worth looking at."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("embreex")
import pycolmap

from vdgs.captures.ground_truth import load_ground_truth
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import input_folders
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import VdgsError
from vdgs.evaluation.evaluate_model import evaluate_model
from vdgs.evaluation.evaluate_run import (
    cached_reference_views,
    make_evaluation_settings,
    make_true_depth,
    with_off_path_truth,
)
from vdgs.evaluation.renderable_model import RenderableModel
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.synth import SynthOptions, generate
from vdgs.synth.image_renderer import pixel_sample_offsets, radiance
from vdgs.synth.lighting import SkyMap
from vdgs.synth.mesh import Material
from vdgs.synth.moving_objects import make_moving_objects, place_moving_objects
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.streets import make_street_plan
from vdgs.synth.town import Town, build_town
from vdgs.synth.true_visibility import view_ground_truth
from vdgs.synth.zones import LandUse

pytestmark = [pytest.mark.xdist_group("synth"), pytest.mark.slow]

TINY = SynthOptions(
    seed=3, num_images=6, num_test_images=2, num_validation_images=1, width=96, height=72, extent_m=50.0,
    num_points=400, noise_px=0.3, truth=True, samples_per_pixel=2,
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def coarse_sky_map() -> Iterator[None]:
    """Cells of a meter, as on large maps: rays into the sky would take longer than all else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vdgs.synth.lighting._CELL", 1.0)
        yield


@pytest.fixture(scope="module")
def town() -> Town:
    return build_town(TINY.seed, TINY.extent_m)


@pytest.fixture(scope="module")
def tracer(town: Town) -> RayTracer:
    return RayTracer(town.mesh)


@pytest.fixture(scope="module")
def capture(town: Town, tracer: RayTracer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synth") / "capture"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vdgs.synth.generation.build_town", lambda seed, extent_m, pond_within: town)
        patch.setattr("vdgs.synth.generation.RayTracer", lambda mesh: tracer)
        generate(folder, TINY)
    return folder


@pytest.fixture(scope="module")
def model(capture: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(capture / "sparse" / "0"))


def camera_of(image: pycolmap.Image) -> Camera:
    rigid = np.eye(4)
    rigid[:3] = image.cam_from_world().matrix()
    fx, fy, cx, cy = image.camera.params
    return Camera(
        camera_from_world=rigid, fx=fx, fy=fy, cx=cx, cy=cy, width=image.camera.width, height=image.camera.height
    )


def observations(
    model: pycolmap.Reconstruction,
) -> list[tuple[Camera, str, np.ndarray, np.ndarray, np.ndarray]]:
    """Per image: camera, name, observed pixels [n, 2], points [n, 3], rows of the points [n]."""
    found = []
    for image in model.images.values():
        seen = [(point.xy, point.point3D_id) for point in image.points2D if point.has_point3D()]
        if not seen:  # test and validation photographs
            continue
        ids = np.array([identity for _, identity in seen])
        points = np.array([model.points3D[identity].xyz for identity in ids])
        found.append((camera_of(image), image.name, np.array([xy for xy, _ in seen]), points, ids - 1))
    return found


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_off_path_views_are_apart_and_true(capture: Path, town: Town) -> None:
    chosen = {kind: load_capture(capture, CaptureOptions(validation=kind)).off_path_views for kind in (False, True)}
    sets = [f"{name}/{name}_{number:04d}.jpg" for name in ("low_oblique", "outside", "street") for number in (1, 2)]
    assert [[view.name for view in chosen[kind]] for kind in (False, True)] == [sets[::2], sets[1::2]]
    truth = load_ground_truth(capture / "off_path")
    read = load_capture(capture)
    assert not any(view.name.startswith(("low", "out", "street")) for view in read.views)
    depth = make_true_depth(read, read.off_path_views)
    assert depth is not None
    assert {capture / "off_path" / name for name in ("low_oblique", "outside", "street")} < set(input_folders(read))
    for view in read.off_path_views:
        assert depth(view).shape == (72, 96)
        assert (truth.visibility_map(view) >= 3).mean() > 0.1
    low, _, street = read.off_path_views
    assert np.degrees(np.arccos(-low.camera.forward[2])) == pytest.approx(60, abs=2)
    assert np.degrees(np.arccos(-street.camera.forward[2])) > 80
    for image in pycolmap.Reconstruction(str(capture / "off_path" / "sparse" / "0")).images.values():
        x, y, z = image.projection_center()
        if image.name.startswith("street"):  # as held by a person, in metres
            assert 1.5 < z - float(town.terrain.height_without_ponds(x, y)) < 3


def test_visibility_off_the_path_is_that_of_each_pixel(
    capture: Path, model: pycolmap.Reconstruction, tracer: RayTracer
) -> None:
    truth, read = load_ground_truth(capture / "off_path"), load_capture(capture)
    visibility = {view.name: truth.visibility_map(view) for view in read.off_path_views}
    training = {view.name for view in load_capture(capture, CaptureOptions(validation=True)).train_views}
    seeing = [camera_of(image) for image in model.images.values() if image.name in training]
    for image in pycolmap.Reconstruction(str(capture / "off_path" / "sparse" / "0")).images.values():
        if (found := visibility.get(image.name)) is not None:
            _, exact = view_ground_truth(tracer, camera_of(image), seeing)
            assert (np.nan_to_num(found) == exact).mean() > 0.999  # NaN: the sky


def test_off_path_figures_count_what_three_photographs_see(capture: Path, tmp_path: Path) -> None:
    """Of a model that is nearly right there and wrong elsewhere, but hangs before half of the sky."""
    read, truth = load_capture(capture), load_ground_truth(capture / "off_path")
    by_pose = {view.camera.camera_from_world.tobytes(): view for view in read.off_path_views}
    depth_of = make_true_depth(read, read.off_path_views)
    assert depth_of is not None

    def draw(camera: Camera) -> Raster:
        view = by_pose[camera.camera_from_world.tobytes()]
        with Image.open(view.image_path) as photograph:
            right = np.asarray(photograph, np.float32) / 255
        seen, depth = truth.visibility_map(view) >= 3, depth_of(view).copy()
        depth[:, :48] = np.where(np.isinf(depth[:, :48]), 1.0, depth[:, :48])
        right += np.where(right > 0.5, -0.1, 0.1).astype(np.float32)
        image = torch.from_numpy(np.where(seen[..., None], right, 1 - right))
        alpha = torch.from_numpy(np.isfinite(depth).astype(np.float32))
        shown = torch.from_numpy(np.where(np.isfinite(depth), depth, 0.0))
        return Raster(image, alpha, shown, shown)

    model = RenderableModel(
        render=draw, render_depth=draw, camera_height=30.0,
        training_cameras=[view.camera for view in read.train_views],
    )  # fmt: skip
    model, settings = with_off_path_truth(model, read), make_evaluation_settings(3, "off-path")
    with cached_reference_views(read.off_path_views) as photographs:
        result = evaluate_model(photographs, model, tmp_path, settings=settings)
    assert result["off_path_views"] == 3
    assert result["sets"] is not None
    assert [*result["sets"]] == ["low_oblique", "outside", "street"]
    for figures in result["sets"].values():
        assert figures["psnr"] == pytest.approx(20, abs=0.1)
        assert figures["depth_within_2_percent_median"] == 1.0
    sky = [np.isinf(depth_of(view)[:, :48]).sum() / (72 * 96) for view in read.off_path_views]
    assert result["floaters"] == pytest.approx(np.mean(sky))
    assert result["floaters"] > 0
    by_angle = result["by_angle"]
    assert by_angle is not None
    assert sum(each["pixels"] for each in by_angle) == sum(
        (truth.visibility_map(view) >= 3).sum() for view in read.off_path_views
    )


def test_points_reproject_to_within_the_noise(model: pycolmap.Reconstruction) -> None:
    residuals = []
    for camera, _, pixels, points, _ in observations(model):
        projected, depth = camera.project(points)
        assert (depth > 0).all()
        residuals.append(projected - pixels)
    rms = np.sqrt(np.mean(np.concatenate(residuals) ** 2))
    # a fitted point takes up part of the noise, never adds to it
    assert 0.3 * TINY.noise_px < rms <= 1.05 * TINY.noise_px


def test_every_track_is_truly_seen(capture: Path, model: pycolmap.Reconstruction) -> None:
    with np.load(capture / "truth" / "points.npz", allow_pickle=False) as points:
        visibility = points["visibility"]
    assert visibility.shape == (model.num_points3D(), TINY.num_images)
    assert model.num_points3D() > 0.5 * TINY.num_points
    for point_id, point in model.points3D.items():
        seen_by = [element.image_id - 1 for element in point.track.elements]
        assert len(set(seen_by)) == len(seen_by) >= 2
        assert visibility[point_id - 1, seen_by].all()


def test_depth_maps_agree_with_the_tracks(capture: Path, model: pycolmap.Reconstruction) -> None:
    with np.load(capture / "truth" / "points.npz", allow_pickle=False) as points:
        places = points["places"]
    truth = load_ground_truth(capture)
    agreeing, total = 0, 0
    for camera, name, _, _, rows in observations(model):
        depth = truth.depth(name)
        assert depth.shape == (camera.height, camera.width)
        assert np.isfinite(depth).all(), "the drone never looks above the horizon"
        pixels, true_depth = camera.project(places[rows])
        column, row = np.floor(pixels).astype(int).T
        around = [
            depth[np.clip(row + dy, 0, camera.height - 1), np.clip(column + dx, 0, camera.width - 1)]
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        ]
        # a place lies between the depths of the pixels around it, give or take a steep surface
        inside = (true_depth > np.min(around, 0) - 0.15) & (true_depth < np.max(around, 0) + 0.15)
        agreeing, total = agreeing + inside.sum(), total + len(inside)
    assert agreeing > 0.97 * total


def test_true_depth_is_in_units_of_the_ground_frame(capture: Path) -> None:
    """Sparse points, which loading brings into the ground frame, lie at the true depth of the pixels that show them."""
    loaded = load_capture(capture, CaptureOptions())
    assert abs(loaded.ground.scale - 1.0) > 0.1, "or metres and units would be the same"
    depth_of = make_true_depth(loaded, loaded.views)
    assert depth_of is not None
    for view in loaded.test_views:
        pixels, depths = view.camera.project(loaded.points[view.camera.in_frustum(loaded.points)])
        column, row = np.floor(pixels).astype(int).T
        error = np.abs(depths - depth_of(view)[row, column]) / depths
        assert np.median(error) < 0.01  # some are hidden in this view
    smaller = replace(loaded.test_views[0], camera=loaded.test_views[0].camera.resized(48, 36))
    assert depth_of(smaller).shape == (36, 48)


def test_there_is_no_true_depth_of_what_was_not_written(capture: Path, tmp_path: Path) -> None:
    loaded = load_capture(capture, CaptureOptions())
    assert make_true_depth(loaded, [replace(loaded.views[0], name="stranger.jpg")]) is None
    assert make_true_depth(replace(loaded, root=tmp_path), loaded.views) is None


def test_the_same_options_give_the_same_bytes_but_for_what_moves_and_what_a_killed_command_left_goes(
    capture: Path, tmp_path: Path
) -> None:
    left = tmp_path / ".again.abc.scratch"
    left.mkdir()
    (left / ".lock").touch()
    generate(tmp_path / "again", replace(TINY, workers=1, num_moving_objects=30))
    assert [path.name for path in tmp_path.iterdir()] == ["again"]
    first, second = files(capture), files(tmp_path / "again")
    masks = sorted(second.keys() - first.keys())
    assert masks == [f"truth/masks/drone_{number:04d}.png" for number in range(1, TINY.num_images + 1)]
    changed = [name for name in first if first[name] != second[name]]
    assert changed == ["capture.md", *(f"images/{Path(name).stem}.jpg" for name in masks)]
    black = []
    for name in masks:
        before, after = (
            np.asarray(Image.open(folder / "images" / f"{Path(name).stem}.jpg"), np.int16)
            for folder in (capture, tmp_path / "again")
        )
        moves = np.asarray(Image.open(tmp_path / "again" / name)) == 0
        assert np.abs(after - before)[~moves].mean() < 1.0  # but for what JPEG spreads about
        assert not moves.any() or np.abs(after - before)[moves].mean() > 10
        black.append(moves.mean())
    assert 0.005 < np.mean(black) < 0.2
    assert len(set(black)) > 3  # elsewhere in each


def test_pictures_show_something_everywhere(capture: Path) -> None:
    for path in sorted((capture / "images").glob("*.jpg")):
        image = np.asarray(Image.open(path), np.float64) / 255
        assert image.shape == (TINY.height, TINY.width, 3)
        assert 0.2 < image.mean() < 0.7
        assert image.std() > 0.08
        tiles = image[:72, :96].mean(2).reshape(3, 24, 4, 24).swapaxes(1, 2).reshape(12, -1)
        assert (tiles.std(1) > 0.015).all(), f"{path.name} has an empty corner"
        saturation = image.max(2) - image.min(2)
        assert saturation.mean() > 0.04


def test_the_world_is_metric_and_z_is_up(model: pycolmap.Reconstruction) -> None:
    points = np.array([point.xyz for point in model.points3D.values()])
    centers = np.array([camera_of(image).position for image in model.images.values()])
    assert np.abs(np.median(points[:, 2])) < 8
    assert (centers[:, 2] > 25).all()
    assert points[:, 2].max() < centers[:, 2].min()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(VdgsError, match="not empty"):
        generate(tmp_path, TINY)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_a_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path / "capture", TINY, interrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(VdgsError, match=r"vdgs\[synth\]"):
        generate(tmp_path / "capture", TINY)


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_images": 1},
        {"extent_m": 5.0},
        {"samples_per_pixel": 0},
        {"size": "hamlet"},
        {"outlier_fraction": 0.9},
        {"overlap": 1.0},
    ],
)
def test_options_that_make_no_capture_are_refused(wrong: dict, tmp_path: Path) -> None:
    with pytest.raises(VdgsError):
        generate(tmp_path / "capture", replace(TINY, **wrong))
    assert list(tmp_path.iterdir()) == []


def test_options_import_no_numerics() -> None:
    code = "import sys, vdgs.synth.synth_options; sys.exit('numpy' in sys.modules or 'torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_plan_coordinates_invert() -> None:
    plan = make_street_plan(np.random.default_rng(0), 200.0)
    p, q = np.random.default_rng(1).uniform(-150, 150, (2, 200))
    back = plan.to_plan(*plan.to_world(p, q))
    np.testing.assert_allclose(back, (p, q), atol=1e-4)


def test_every_seed_gives_a_town_of_its_own(town: Town, tracer: RayTracer, monkeypatch: pytest.MonkeyPatch) -> None:
    towns = [town, build_town(1, TINY.extent_m, pond_within=True)]
    assert towns[0].mesh.vertices.shape != towns[1].mesh.vertices.shape
    for town in towns:
        square_meters = np.bincount(town.zones.cells.ravel(), minlength=len(LandUse)) * town.zones.cell**2
        assert (square_meters[[LandUse.LAWN, LandUse.BUILDING, LandUse.SQUARE]] > 400).all()
        assert np.isfinite(town.mesh.vertices).all()
        assert np.isfinite(town.mesh.normals).all()
        assert town.mesh.faces.max() < len(town.mesh.vertices)
    away = [np.hypot(each.terrain.ponds[0].x, each.terrain.ponds[0].y) for each in towns]
    assert away[1] < 40 < away[0]  # metres; blocks are 42 apart
    things = make_moving_objects(towns[0], 12, seed=0)
    monkeypatch.setattr("vdgs.synth.moving_objects.RayTracer", lambda mesh: tracer)  # takes long, and nobody asks it
    meshes = [place_moving_objects(towns[0], tracer, things, 0, photograph)[0].mesh for photograph in (3, 3, 4)]
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    assert not np.array_equal(meshes[0].vertices, meshes[2].vertices)


def test_waves_change_what_water_mirrors_and_nothing_else(town: Town, tracer: RayTracer) -> None:
    pond = town.terrain.ponds[0]
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-2, 2, 40)] * 2))
    origins = np.stack([pond.x + pond.rx * x, pond.y + pond.ry * y, np.full(1600, 60.0)], 1).astype(np.float32)
    down = np.broadcast_to(np.float32([-0.2, -0.2, -0.96]), origins.shape)
    sky = SkyMap(np.ones((8, 8), np.float32), 4.0, 1.0)
    light = [radiance(replace(town, waves=at), tracer, sky, origins, down, 1e-3) for at in (None, (1, 2), (400, 9))]
    water = town.mesh.material[light[0][1].triangle] == Material.WATER
    assert 100 < water.sum() < 1500
    for one, other in itertools.combinations([values for values, _ in light], 2):
        assert np.array_equal(one[~water], other[~water])
        assert (np.abs(one - other)[water].max(axis=1) > 0.01).mean() > 0.5


@pytest.mark.parametrize("count", [1, 4, 7, 9])
def test_samples_surround_the_pixel_center(count: int) -> None:
    offsets = pixel_sample_offsets(count)
    assert offsets.shape == (count, 2)
    assert np.abs(offsets).max() < 0.8
    assert np.abs(offsets.mean(0)).max() < 1e-12
