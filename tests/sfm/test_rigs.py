"""Rigs of cameras: told by their folders, measured by a first model, held together in a second."""

from __future__ import annotations

import io
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image
from rich.console import Console

from support.flights import write_photograph
from support.known_flight import known_flight
from vdgs.sfm import incremental_mapper, mapping
from vdgs.sfm.camera_rigs import describe_rigs, map_rigs
from vdgs.sfm.feature_extraction import create_database, group_by_camera
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.workspace import Workspace, silence_colmap

pytestmark = pytest.mark.slow

CONSOLE = Console(file=io.StringIO())
#: The second camera from the first: 5 m to the left, turned by 20 degrees about the right vector.
TURN = np.radians(20)
SECOND = np.array([[1, 0, 0, -5], [0, np.cos(TURN), -np.sin(TURN), 0], [0, np.sin(TURN), np.cos(TURN), 0]])


def photographs(folder: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(number).integers(0, 255, (120, 160, 3), np.uint8)
        Image.fromarray(pixels).save(folder / name)


@pytest.mark.parametrize(
    ("folders", "rigs"),
    [
        (("rig1/cam0", "rig1/cam1"), 1), (("left", "right", "nadir"), 1), (("a/Camera_1", "a/Camera_2", "b/cam1"), 1),
        (("100MEDIA", "101MEDIA"), 0), (("cam0",), 0), (("rig1/cam0", "rig2/cam0"), 0),
    ],
)  # fmt: skip
def test_folders_tell_rigs(tmp_path, folders, rigs):
    photographs(tmp_path, [f"{folder}/{k:04d}.jpg" for folder in folders for k in range(4)])
    found = collect_images([tmp_path])
    assert sum("tried as one rig" in note for note in found.notes) == rigs
    sensors = {photo.sensor for photo in found.images if photo.sensor}
    assert sensors == ({f"{each}/" for each in folders if not each.startswith("b/")} if rigs else set())
    assert len(group_by_camera(found.images)) == max(1, len(sensors) + ("b/cam1" in folders))


def test_cameras_that_do_not_release_together_are_no_rig(tmp_path):
    photographs(tmp_path, [f"cam{s}/{10 * s + k:04d}.jpg" for s in range(2) for k in range(5)])
    assert [photo.sensor for photo in collect_images([tmp_path]).images] == [""] * 10


def fly(folder: Path, late_s: float = 0.0, away_m: float = 0.0, pitch: float = -60.0, turns: bool = True) -> None:
    """Eight photographs 12 m apart: two strips, along which a camera that `turns` looks the other way."""
    folder.mkdir(parents=True)
    for k in range(8):
        yaw = 180.0 * (k >= 4) * turns
        pixels = np.random.default_rng([k, *folder.name.encode()]).integers(0, 255, (120, 160, 3), np.uint8)
        xmp = f'drone-dji:GimbalPitchDegree="{pitch}" drone-dji:GimbalYawDegree="{yaw}" drone-dji:GimbalRollDegree="0"'
        place = np.array([12.0 * k + away_m, 0.0, 40.0])
        write_photograph(folder / f"{k:04d}.JPG", pixels, round(5 * k + late_s), place, xmp=xmp)


@pytest.mark.parametrize(
    ("second", "why"),
    [
        pytest.param({"pitch": -90.0}, "", id="a rig"),
        pytest.param({"late_s": 1500, "away_m": 1.0}, "", id="whose clocks are set apart"),
        pytest.param({"away_m": 30.0}, "other places", id="two drones"),
        pytest.param({"late_s": 1500, "away_m": -4.5}, "other moments", id="near the next frame, far from that before"),
        pytest.param({"late_s": 1500, "away_m": 1.0, "turns": False}, "the angle between", id="two flights"),
    ],
)
def test_flights_whose_files_have_the_same_names_are_no_rig(tmp_path, second, why):
    """Each mission counts from 1, and people sort missions by where they look."""
    fly(tmp_path / "front")
    fly(tmp_path / "nadir", **second)
    found = collect_images([tmp_path])
    assert any(photo.sensor for photo in found.images) == (not why)
    assert sum("no rig" in note and why in note for note in found.notes) == bool(why)


@pytest.mark.parametrize("clock", [lambda k: 3000 + 5 * k, lambda k: 9 * k])
def test_moments_alone_tell_flights_from_a_rig(tmp_path, clock):
    """Without places a clock that is set apart is no other than that of a second flight."""
    for folder, seconds in (("left", lambda k: 5 * k), ("right", clock)):
        (tmp_path / folder).mkdir()
        for k in range(6):
            pixels = np.random.default_rng([k, len(folder)]).integers(0, 255, (120, 160, 3), np.uint8)
            write_photograph(tmp_path / folder / f"{k:04d}.jpg", pixels, seconds(k), None)
    found = collect_images([tmp_path])
    assert [photo.sensor for photo in found.images] == [""] * 12
    assert any("other moments" in note for note in found.notes)


def test_cameras_of_a_rig_are_found_beside_a_flight_of_its_names(tmp_path):
    fly(tmp_path / "back", late_s=1500, away_m=40.0)
    fly(tmp_path / "left")
    fly(tmp_path / "right", pitch=-45.0)
    assert {photo.sensor for photo in collect_images([tmp_path]).images} == {"", "left/", "right/"}


def matched(workspace: Workspace, poses: dict[str, np.ndarray], points: np.ndarray) -> None:
    """A database of photographs of known poses [3, 4] and points, all matched with all, in pixels and with noise."""
    rng = np.random.default_rng(2)
    with workspace.open_database() as database:
        camera = {each.camera_id: each for each in database.read_all_cameras()}
        seen = {}
        for name, pose in sorted(poses.items()):
            number = 1 + name.startswith("cam1/")
            local = points @ pose[:, :3].T + pose[:, 3]
            pixels = np.asarray(camera[number].img_from_cam(local)) + rng.normal(0, 0.2, (len(points), 2))
            shown = np.flatnonzero((local[:, 2] > 0) & ((pixels > 0) & (pixels < (800, 600))).all(axis=1))
            image = database.write_image(pycolmap.Image(name=name, camera_id=number))
            frame = pycolmap.Frame(rig_id=number)
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number), image))
            database.write_frame(frame)
            database.write_keypoints(image, pixels[shown].astype(np.float32))
            seen[image] = {point: k for k, point in enumerate(shown.tolist())}
        for one, other in combinations(seen, 2):
            pairs = [(seen[one][p], seen[other][p]) for p in seen[one] if p in seen[other]]
            found = np.array(pairs, np.uint32).reshape(-1, 2)
            database.write_matches(one, other, found)
            geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=found)
            database.write_two_view_geometry(one, other, geometry)


def mapped(folder: Path, lost: str | None = None, shaken_m: float = 0.0, mixed: bool = False):
    """A flight of two cameras, the number of its photographs, the models without rigs and after `map_rigs`, and what is
    said; in the folders photos and work. The second camera is off its place on the rig by `shaken_m` (standard
    deviation), or flies in a `mixed` order."""
    flight, rng, console = known_flight(strips=2, each=4), np.random.default_rng(0), Console(file=io.StringIO())
    names = [f"cam{s}/{k:04d}.jpg" for s in range(2) for k in range(8)]
    photographs(folder / "photos", names)
    images = collect_images([folder / "photos"]).images
    images = [type(photo)(**{**vars(photo), "width": 800, "height": 600}) for photo in images]
    workspace = Workspace(folder / "work")
    create_database(workspace, group_by_camera(images))
    poses = {f"cam0/{k:04d}.jpg": pose[:3] for k, pose in enumerate(flight.poses)}
    firsts = list(poses.items())
    for (name, _), number in zip(firsts, rng.permutation(8) if mixed else range(8), strict=True):
        pose = firsts[number][1]
        place = SECOND[:, :3] @ pose[:, 3:] + SECOND[:, 3:] + rng.normal(0, shaken_m, (3, 1))
        poses[f"cam1/{name[5:]}"] = np.hstack([SECOND[:, :3] @ pose[:, :3], place])
    poses.pop(lost, None)
    matched(workspace, poses, flight.points)
    workspace.images.mkdir()
    silence_colmap()
    incremental_mapper.run_mapper(workspace, 16, True, 1, CONSOLE)
    incremental_mapper.set_models_aside(workspace)
    map_rigs(workspace, images, 16, True, 1, console)
    places = workspace.models_aside, workspace.models
    loose, model = (incremental_mapper.read_models(workspace, place)[0] for place in places)
    return flight, len(poses), loose, model, " ".join(console.file.getvalue().split())


@pytest.mark.parametrize("lost", [pytest.param(None, id="whole"), "cam0/0003.jpg"])
def test_a_rig_is_measured_and_held_together(tmp_path, lost):
    """Its second camera lies as it truly does, in one frame with the first, of which a photograph may be lost."""
    flight, count, _, model, _ = mapped(tmp_path, lost)
    assert (model.num_reg_images(), model.num_reg_frames()) == (count, 8)
    rig = next(each for each in model.rigs.values() if each.num_sensors() == 2)
    second_from_first = next(iter(rig.non_ref_sensors.values()))
    turned = second_from_first.rotation.matrix()
    turned = turned if rig.ref_sensor_id.id == 1 else turned.T
    assert turned == pytest.approx(SECOND[:, :3], abs=0.01)
    centers = {image.name: image.projection_center() for image in model.images.values()}
    true = np.linalg.norm(flight.centers[7] - flight.centers[0])
    scale = true / np.linalg.norm(centers["cam0/0007.jpg"] - centers["cam0/0000.jpg"])
    assert scale * np.linalg.norm(second_from_first.translation) == pytest.approx(5, abs=0.25)
    assert len(describe_rigs(model, "m")) == 1


@pytest.mark.parametrize(
    ("how", "said"),
    [
        pytest.param({"shaken_m": 0.5}, "px farther off", id="half a metre off"),
        pytest.param({"mixed": True}, "no two of them are", id="another flight"),
    ],
)
def test_cameras_that_are_not_fixed_to_each_other_are_not_held_together(tmp_path, how, said):
    """Where COLMAP places all photographs, too, as a rig."""
    _, _, loose, model, notes = mapped(tmp_path, **how)
    assert (model.num_reg_images(), model.num_reg_frames()) == (16, 16)
    assert model.compute_mean_reprojection_error() == loose.compute_mean_reprojection_error()
    assert said in notes
    assert sensors_of_rigs(Workspace(tmp_path / "work")) == [1, 1]  # nor in what is mapped next


def sensors_of_rigs(workspace: Workspace) -> list[int]:
    """The number of cameras of each rig in the database."""
    with workspace.open_database() as database:
        return [rig.num_sensors() for rig in database.read_all_rigs()]


def test_models_that_are_made_anew_begin_without_rigs(tmp_path, monkeypatch):
    """Where another focal length is asked for, or the photographs contradict the one that was held."""
    mapped(tmp_path)
    workspace, found = Workspace(tmp_path / "work"), []
    assert sensors_of_rigs(workspace) == [2]

    def stopped(*_):
        found.extend(sensors_of_rigs(workspace))
        raise KeyboardInterrupt

    monkeypatch.setattr(incremental_mapper, "run_mapper", stopped)
    plan = SimpleNamespace(image_list=collect_images([tmp_path / "photos"]), threads=1)
    with pytest.raises(KeyboardInterrupt):
        mapping.make_models(plan, workspace, "another key", 16, False, CONSOLE)
    assert found == [1, 1]
