"""Points of a project that has poses and lenses: photographs of a generated town, bent by a known lens."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support import flights, project_writers
from support.captures import TinyScene, write_colmap
from support.dataset_layouts import OPENGL, write_llff, write_mvsnet
from support.flights import ALTITUDE_M, FOCAL, HEIGHT, WIDTH
from support.known_flight import BentLens, KnownFlight, centers_of, ecef
from vdgs.captures.format_dispatch import lacks_points
from vdgs.captures.formats.brown_lens import brown_intrinsics, unproject_pixels
from vdgs.captures.formats.colmap import read_colmap
from vdgs.captures.formats.source_capture import Intrinsics, NoTiePoints, SourceCapture, SourceView, WorldPrior
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import WORK_FOLDER
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import ecef_from_geodetic, geodetic_from_enu
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.pipeline.dry_run import estimate_run
from vdgs.pipeline.run_pipeline import reconstruct_if_needed
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.sfm import feature_extraction, feature_matching, posed_capture, workspace
from vdgs.sfm.posed_capture import make_posed_capture
from vdgs.sfm.posed_photographs import FEATURES, _in_metres, read_posed_photographs
from vdgs.sfm.posed_plan import plan_posed_capture
from vdgs.sfm.random_points import random_points
from vdgs.sfm.run_request import size_apart
from vdgs.sfm.workspace import Workspace
from vdgs.system.atomic_files import write_json

pytestmark = [pytest.mark.xdist_group("sfm"), pytest.mark.slow]  # whole reconstructions, runs or trainings

LENS = BentLens(
    focal=FOCAL, center=(163.0, 118.0), k=(0.08, -0.02, 0.004, 0.003), p=(0.001, -0.0006), size=(WIDTH, HEIGHT)
)


@pytest.fixture(scope="module")
def town_flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, KnownFlight]:
    """Photographs in a folder, bent, and the cameras that took them."""
    root = tmp_path_factory.mktemp("bent")
    flight = flights.fly(root / "straight", flights.grid(2, 4, 9.0))
    lens = brown_intrinsics((FOCAL, FOCAL), LENS.center, LENS.size, LENS.k, LENS.p)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = unproject_pixels(lens, np.stack([x.ravel(), y.ravel()], axis=1))
    grid = (rays * FOCAL + [WIDTH / 2, HEIGHT / 2] - 0.5).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    (root / "images").mkdir()
    for name in flight.names:
        pixels = np.asarray(Image.open(flight.folder / name))
        bent = cv2.remap(pixels, grid[..., 0], grid[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        Image.fromarray(bent).save(root / "images" / name, "JPEG", quality=95, subsampling=0)
    poses = np.stack([camera.camera_from_world for camera in flight.cameras])
    return root, KnownFlight(flight.names, poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), LENS)


def ask(root: Path, output: Path, **changes: object) -> str:
    told = io.StringIO()
    request = SfmRequest(image_folders=(root,), output=output, threads=2, **changes)  # type: ignore[arg-type]
    make_posed_capture(request, CaptureOptions(), Console(file=told, width=200))
    return told.getvalue()


def _from_ground(ground: GroundFrame) -> Callable[[np.ndarray], np.ndarray]:
    return lambda points: (points - ground.translation) @ ground.rotation / ground.scale


def test_points_lie_on_the_ground_and_poses_stay(town_flight: tuple[Path, KnownFlight], tmp_path: Path) -> None:
    root, flight = town_flight
    file = project_writers.write_realityscan_csv(root / "cameras.csv", flight)
    lines = file.read_text().splitlines()  # as by default, every photograph has a lens of its own
    own = [line.replace(",30.6,", f",{30.6 + k * 1e-4},") for k, line in enumerate(lines[1:])]
    file.write_text("\n".join([lines[0], *own]))
    assert lacks_points(root, CaptureOptions())
    told = ask(root, tmp_path / "capture")
    assert "mean reprojection error" in told
    capture = load_capture(tmp_path / "capture", CaptureOptions(up="z"))
    to_world = _from_ground(capture.ground)
    centers = to_world(np.stack([view.camera.position for view in capture.views]))
    assert np.abs(centers - centers_of(flight.poses)).max() < 1e-6
    tracer, points = flights.town_of(60.0)[1], to_world(capture.points)
    middle = centers.mean(axis=0)
    away = (points - middle).astype(np.float32)
    hit = tracer.intersect(np.broadcast_to(middle.astype(np.float32), away.shape).copy(), away)
    off = np.abs(hit.distance - 1) * np.linalg.norm(away, axis=1)
    assert len(points) > 500
    assert np.median(off) < 0.75 * ALTITUDE_M / FOCAL  # three quarters of a pixel
    errors = [view.observations.reprojection_errors_px(view.camera) for view in capture.views]  # type: ignore[union-attr]
    assert np.median(np.concatenate(errors)) < 0.7
    assert len(read_colmap(tmp_path / "capture" / "sparse" / "0").views) == 8
    assert len({view.intrinsics for view in read_colmap(tmp_path / "capture" / "sparse" / "0").views}) == 8
    assert len(np.unique(capture.point_colors, axis=0)) > 100
    assert "nothing to do" in ask(root, tmp_path / "capture")


@pytest.mark.usefixtures("few_features")
def test_damaged_photographs_are_named_before_the_work(town_flight, tmp_path, monkeypatch) -> None:
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_odm_report(root, flight)
    file = root / "images" / flight.names[1]
    file.write_bytes(file.read_bytes()[:300])
    monkeypatch.setattr(posed_capture, "_match", _stop)
    with pytest.raises(CaptureError, match=flight.names[1]):
        ask(root, tmp_path / "capture")


@pytest.mark.usefixtures("few_features")
def test_report_of_odm_becomes_a_capture_that_has_its_place(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path
) -> None:
    """Stopped within the matches, the same command goes on with the features that there are."""
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_odm_report(root, flight)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feature_matching, "match_chunk", _stop)
        with pytest.raises(KeyboardInterrupt):
            ask(root, tmp_path / "capture")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feature_extraction, "_extract", _stop)
        ask(root, tmp_path / "capture")
    capture = load_capture(tmp_path / "capture")
    assert capture.ground.origin_geo is not None
    assert "UTM" in capture.ground.method
    assert json.loads((tmp_path / "capture" / "georef.json").read_text())["method"].startswith("ODM")
    places = geodetic_from_enu(
        np.stack([view.camera.position for view in capture.views]),
        capture.ground.origin_geo,
        capture.ground.axes_origin,
    )
    assert np.abs(ecef_from_geodetic(places) - ecef(flight.centers)).max() < 1e-3
    first = root / "images" / flight.names[0]
    first.touch()
    ask(root, tmp_path / "capture")  # nothing to do
    first.write_bytes(first.read_bytes() + bytes(1))
    with pytest.raises(VdgsError, match="--overwrite"):
        ask(root, tmp_path / "capture")


@pytest.mark.usefixtures("few_features")
def test_run_of_a_project_without_points_finds_them_first(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path
) -> None:
    """The run goes on with the capture in its own folder; asked again, the capture is there."""
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_realityscan_xmp(root / "images", flight)
    request = RunRequest(capture=root, output=tmp_path / "run", threads=2)
    said = Console(file=io.StringIO(), width=200)
    estimate = estimate_run(replace(request, device="cpu"), said)
    assert {"photographs", "coarse", "blocks"} <= {name for name, cost in estimate.times.items() if cost.seconds > 0}
    assert "5 photographs, poses and lenses as they are given: features, about 10 pairs" in said.file.getvalue()  # type: ignore[attr-defined]
    assert not (tmp_path / "run").exists()
    for _ in range(2):
        found = reconstruct_if_needed(request, Console(file=io.StringIO()))
        assert found.capture == tmp_path / "run" / "capture"
    assert len(load_capture(found.capture, found.options).views) == 5


@pytest.mark.parametrize("is_model", [False, True])
def test_captures_without_points_get_them_with_their_poses_and_lists(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path, is_model: bool
) -> None:
    """transforms.json as programs write it that know poses alone, and a model whose points3D.txt is empty."""
    root, flight = town_flight
    root, names, poses = root / "straight", flight.names[:4], flight.poses[:4]
    (tmp_path / "images").mkdir()
    for name in names:
        shutil.copyfile(root / name, tmp_path / "images" / name)
    if is_model:
        cameras = dict(zip(names, flights.grid(2, 4, 9.0)[:4], strict=True))
        empty = TinyScene(cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        write_colmap(tmp_path, empty, text=True, images=None)
    else:
        frames = [
            {"file_path": f"images/{Path(name).stem}", "transform_matrix": (np.linalg.inv(pose) @ OPENGL).tolist()}
            for name, pose in zip(names, poses, strict=True)
        ]
        tests = {"test_filenames": [frames[1]["file_path"]]}
        content = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), **tests, "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(NoTiePoints, match=r"no 3D points.*\. This finds them.*: vdgs sfm .* --output CAPTURE\n"):
        load_capture(tmp_path)
    size = None if is_model else "images_2"  # of what is made
    asked = RunRequest(capture=tmp_path, output=tmp_path / "run", threads=2, options=CaptureOptions(images=size))
    found = reconstruct_if_needed(asked, Console(file=io.StringIO()))
    assert found.options.images == size
    capture = load_capture(found.capture, replace(found.options, up="z"))
    centers = _from_ground(capture.ground)(np.stack([view.camera.position for view in capture.views]))
    assert np.abs(centers - centers_of(poses)).max() < 1e-6
    assert len(capture.points) > 100
    if not is_model:
        assert [Path(view.name).stem for view in capture.test_views] == [Path(names[1]).stem]


@pytest.mark.parametrize("kind", ["mvsnet", "llff"])
def test_points_of_cameras_without_names_or_sizes_fit_the_poses(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path, kind: str
) -> None:
    root, flight = town_flight
    cameras = dict(zip(flight.names[:4], flights.grid(2, 4, 9.0)[:4], strict=True))
    scene = TinyScene(cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    (write_mvsnet if kind == "mvsnet" else write_llff)(tmp_path, scene)
    folder = tmp_path / ("blended_images" if kind == "mvsnet" else "images")
    for k, (name, plane) in enumerate(zip(cameras, sorted(folder.glob("*[0-9].*")), strict=True)):
        plane.unlink()
        shutil.copyfile(root / "straight" / name, folder / (f"{k:08d}.jpg" if kind == "mvsnet" else name))
    told = ask(tmp_path, tmp_path / "capture")
    assert float(told.partition("mean reprojection error ")[2].split()[0]) < 0.7
    capture = load_capture(tmp_path / "capture", CaptureOptions(up="z"))
    centers = _from_ground(capture.ground)(np.stack([view.camera.position for view in capture.views]))
    assert np.abs(centers - centers_of(flight.poses[:4])).max() < 1e-6
    assert len(capture.points) > 100


def _some_photographs(town_flight: tuple[Path, KnownFlight], tmp_path: Path) -> tuple[Path, KnownFlight]:
    """The first five photographs in a folder of their own."""
    root, flight = town_flight
    names = flight.names[:5]
    (tmp_path / "project" / "images").mkdir(parents=True)
    for name in names:
        shutil.copy(root / "images" / name, tmp_path / "project" / "images" / name)
    return tmp_path / "project", replace(flight, names=names, poses=flight.poses[:5])


def _stop(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.usefixtures("few_features")
def test_an_agreement_to_discard_what_was_trained_ends_where_the_old_capture_is_asked_for(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_realityscan_csv(root / "cameras.csv", flight)
    run, said = RunFolder(tmp_path / "run"), Console(file=io.StringIO())
    same = SfmRequest(image_folders=(root,), output=run.own_capture, threads=2)
    anew = replace(same, options=SfmOptions(max_output_size=200))
    make_posed_capture(same, CaptureOptions(), said, run)
    write_json(run.capture_file, {})  # as training leaves it
    monkeypatch.setattr(posed_capture, "_match", _stop)
    for request in (replace(anew, overwrite=True), anew):  # the same command goes on, whose --overwrite is not kept
        with pytest.raises(KeyboardInterrupt):
            make_posed_capture(request, CaptureOptions(), said, run)
    make_posed_capture(same, CaptureOptions(), said, run)  # it is there as it was
    with pytest.raises(VdgsError, match="--overwrite"):
        make_posed_capture(anew, CaptureOptions(), said, run)
    assert run.is_trained


@pytest.mark.usefixtures("few_features")
def test_photographs_of_other_poses_are_refused(town_flight: tuple[Path, KnownFlight], tmp_path: Path) -> None:
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_realityscan_csv(root / "cameras.csv", replace(flight, names=flight.names[::-1]))
    with pytest.raises(CaptureError, match="agree with the poses"):
        ask(root, tmp_path / "capture")


def test_a_look_refuses_an_output_that_the_work_refuses(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, flight = _some_photographs(town_flight, tmp_path)
    project_writers.write_realityscan_csv(root / "cameras.csv", flight)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("three years")
    with pytest.raises(VdgsError, match="holds other things"):
        plan_posed_capture(SfmRequest(image_folders=(root,), output=tmp_path / "full"), CaptureOptions())
    (tmp_path / "full/thesis.txt").rename(tmp_path / "full/digests.json")  # of a run that was killed at once
    request = SfmRequest(image_folders=(root,), output=tmp_path / "full")
    plan_posed_capture(request, CaptureOptions())
    work = Workspace(request.output / WORK_FOLDER)
    with monkeypatch.context() as before:
        before.setattr(workspace, "_VERSION", " by vdgs 0.0")
        work.begin(FEATURES, read_posed_photographs(request, CaptureOptions()).keys[FEATURES])
    plan_posed_capture(request, CaptureOptions())  # of another version: begun anew
    work.begin(FEATURES, "of other photographs")
    with pytest.raises(VdgsError, match="begun with other photographs"):
        plan_posed_capture(request, CaptureOptions())


# ------------------------------------------------------------------------------------- data sets without points


def _frames(flight: KnownFlight, indices: Sequence[int], name: str) -> list[dict]:
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    return [
        {"file_path": name.format(k), "transform_matrix": (np.linalg.inv(flight.poses[k]) @ opengl).tolist()}
        for k in indices
    ]


def test_transforms_without_points_keep_their_poses_and_lists(
    town_flight: tuple[Path, KnownFlight], tmp_path: Path
) -> None:
    """As instant-ngp writes it, with nerfstudio's lists."""
    root, flight = town_flight
    names = [f"./images/{name}" for name in flight.names]
    content = {
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "aabb_scale": 16,
        "frames": [frame | {"file_path": names[k]} for k, frame in enumerate(_frames(flight, range(7), ""))],
        "train_filenames": names[:5], "test_filenames": names[5:6],
    }  # fmt: skip
    shutil.copytree(root / "straight", tmp_path / "set" / "images")
    (tmp_path / "set" / "transforms.json").write_text(json.dumps(content))
    assert lacks_points(tmp_path / "set", CaptureOptions())
    with pytest.raises(CaptureError, match=r"This finds them, with the poses as they are: vdgs sfm"):
        load_capture(tmp_path / "set")
    request = SfmRequest(image_folders=(tmp_path / "set",), output=tmp_path / "capture")
    photographs = read_posed_photographs(request, CaptureOptions())
    assert any("1 of 7 photographs stand in none" in warning for warning in photographs.warnings)
    assert [photographs.views[k].view.name for k in photographs.trained] == flight.names[:5]
    assert [view.view.split for view in photographs.views][5:] == ["test"]
    poses = np.stack([view.view.camera_from_world for view in photographs.views])
    np.testing.assert_allclose(poses, flight.poses[:6], atol=1e-9)
    every = read_posed_photographs(request, CaptureOptions(split="every"))
    assert len(every.trained) == 7
    (tmp_path / "set" / "test.txt").write_text(f"{flight.names[1]}\n{flight.names[2]}\n")
    (tmp_path / "set" / "validation.txt").write_text(f"{flight.names[4]}\n")
    own = read_posed_photographs(request, CaptureOptions())
    assert [own.views[k].view.name for k in own.trained] == [flight.names[k] for k in (0, 3, 5, 6)]
    assert own.validation == {flight.names[4]}
    (tmp_path / "mine.txt").write_text(f"{flight.names[0]}\n")
    mine = read_posed_photographs(request, CaptureOptions(test_list=tmp_path / "mine.txt"))
    assert [mine.views[k].view.name for k in mine.trained] == [flight.names[k] for k in (1, 2, 3, 5, 6)]
    (tmp_path / "set" / "test.txt").write_text(f"{flight.names[2]}\n")
    (tmp_path / "set" / "validation.txt").write_text(f"{flight.names[1]}\n{flight.names[4]}\n")
    moved = read_posed_photographs(request, CaptureOptions())
    assert moved.trained == own.trained
    assert moved.keys["capture"] != own.keys["capture"]


@pytest.mark.usefixtures("few_features")
def test_a_set_of_blender_is_put_on_white(town_flight: tuple[Path, KnownFlight], tmp_path: Path) -> None:
    root, flight = town_flight
    for side, indices in (("train", range(4)), ("test", range(4, 6))):
        (tmp_path / "set" / side).mkdir(parents=True)
        for k in indices:
            pixels = np.asarray(Image.open(root / "straight" / flight.names[k]).convert("RGBA")).copy()
            pixels[:, :100] = 0
            Image.fromarray(pixels).save(tmp_path / "set" / side / f"r_{k}.png", compress_level=1)
        content = {
            "camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL),
            "frames": _frames(flight, indices, f"./{side}/r_{{}}"),
        }
        (tmp_path / "set" / f"transforms_{side}.json").write_text(json.dumps(content))
    said = ask(tmp_path / "set", tmp_path / "capture")
    assert "6 photographs are transparent: what is transparent becomes white" in said
    capture = load_capture(tmp_path / "capture", CaptureOptions(up="z"))
    assert [view.name for view in capture.test_views] == ["test/r_4.png.jpg", "test/r_5.png.jpg"]
    assert all(view.observations is None or not len(view.observations.points) for view in capture.test_views)
    assert not (tmp_path / "capture" / "masks").exists()
    for view in capture.views:
        pixels = np.asarray(Image.open(view.image_path)).astype(int)
        assert pixels[:, :90].min() > 240
        assert pixels[:, 110:].mean() < 200
    to_world = _from_ground(capture.ground)
    centers = to_world(np.stack([view.camera.position for view in capture.train_views]))
    assert np.abs(centers - centers_of(flight.poses[:4])).max() < 1e-6
    heights = to_world(capture.points)[:, 2]
    assert len(heights) > 100
    assert (np.abs(heights - np.median(heights)) < 25).mean() > 0.95


def test_photographs_without_features_start_from_random_points_that_are_said(tmp_path: Path) -> None:
    """Cameras on a ring about an object without any feature."""
    (tmp_path / "set" / "train").mkdir(parents=True)
    frames = []
    for k in range(6):
        turn = 2 * np.pi * k / 6
        back = np.array([np.cos(turn), np.sin(turn), 0.5]) / np.sqrt(1.25)
        right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(back, right), back, 4 * back])
        Image.new("RGB", (120, 120), (200, 200, 200)).save(tmp_path / "set" / "train" / f"r_{k}.png")
        frames.append({"file_path": f"./train/r_{k}", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": 0.7, "frames": frames}
    (tmp_path / "set" / "transforms_train.json").write_text(json.dumps(content))
    said = ask(tmp_path / "set", tmp_path / "capture")
    assert "the scene starts from" in said
    assert "random points in the middle of what the cameras see (a box of 2.67 units)" in said
    capture = load_capture(tmp_path / "capture", CaptureOptions(up="z"))
    points = _from_ground(capture.ground)(capture.points)
    assert len(points) > 10_000
    assert np.abs(points).max() <= 4 / 3 + 1e-6
    lens = Intrinsics("PINHOLE", (164.0, 164.0, 60.0, 60.0), 120, 120)
    along = [np.vstack([np.column_stack([np.eye(3), [k, 0, 0]]), [0, 0, 0, 1]]) for k in range(4)]
    with pytest.raises(CaptureError, match="look at no common place"):
        random_points(along, [lens] * 4)


def test_metres_of_mega_nerf_and_the_city_stay() -> None:
    down = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    pose = np.vstack([np.column_stack([np.eye(3), [1.0, 2, 3]]), [0, 0, 0, 1]])
    lens = Intrinsics("PINHOLE", (164.0, 164.0, 60.0, 60.0), 120, 120)
    source = SourceCapture(
        source="matrixcity", images="", views=(SourceView(name="a", camera_from_world=pose, intrinsics=lens),),
        points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8), world=WorldPrior(down, 100.0, True, "the format"),
    )  # fmt: skip
    moved = _in_metres(source)
    point = np.array([0.3, -0.2, 5.0])
    in_camera = pose[:3, :3] @ point + pose[:3, 3]
    [view] = moved.views
    again = view.camera_from_world[:3, :3] @ (100 * down @ point) + view.camera_from_world[:3, 3]
    np.testing.assert_allclose(again, 100 * in_camera, atol=1e-9)
    assert moved.georef is not None


def test_a_size_that_a_run_chose_is_that_of_its_own_capture(tmp_path: Path) -> None:
    """The same command again reads it from the run's settings: no folder of the project is meant."""
    project, run, asked = tmp_path / "project", RunFolder(tmp_path / "run"), CaptureOptions(images="images_2")
    (project / "images_2").mkdir(parents=True)
    request = RunRequest(capture=project, output=run.path, preset="laptop", options=asked)
    assert size_apart(request) == (request, None)
    run.create_or_check(RunSettings.create(run.own_capture.resolve(), asked, PRESETS["laptop"]))
    assert size_apart(request) == (replace(request, options=CaptureOptions()), "images_2")
