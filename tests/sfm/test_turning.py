"""Photographs from one place tell no depth, whatever model a mapper makes of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.marked_photographs import write_camera, write_photograph

pycolmap = pytest.importorskip("pycolmap")

from vdgs.errors import CaptureError  # noqa: E402
from vdgs.sfm import reconstruction_report, turning  # noqa: E402
from vdgs.sfm.reconstruction_report import check_enough_placed  # noqa: E402
from vdgs.sfm.turning import only_turns  # noqa: E402
from vdgs.sfm.workspace import Workspace, silence_colmap  # noqa: E402

WIDTH, HEIGHT, FOCAL = 960, 540, 760.0
DOWN = np.diag([1.0, -1.0, -1.0])


def workspace_of(folder: Path, centers: np.ndarray, rotations: np.ndarray, relief: float, focal: float) -> Workspace:
    """Matches of cameras at centers [n, 3] with rotations [n, 3, 3] (from the world) over ground with so much relief
    (both in metres), found within 0.3 px, in a database whose lens has another focal length than the true one."""
    silence_colmap()
    workspace, rng = Workspace(folder), np.random.default_rng(0)
    workspace.images.mkdir(parents=True)
    points = np.column_stack([rng.uniform(-300, 300, (4000, 2)), rng.uniform(0, max(relief, 1e-9), 4000)])
    with workspace.open_database() as database:
        lens = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", focal, WIDTH, HEIGHT)
        number, seen = write_camera(database, lens), {}
        for k, (center, rotation) in enumerate(zip(centers, rotations, strict=True)):
            rays = (points - center) @ rotation.T
            pixels = FOCAL * rays[:, :2] / rays[:, 2:] + [WIDTH / 2, HEIGHT / 2]
            inside = (rays[:, 2] > 1) & (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)
            shown = np.flatnonzero(inside)
            marks = pixels[shown] + rng.normal(0, 0.3, (len(shown), 2))
            image = write_photograph(database, f"{k:02}.jpg", number, marks)
            seen[image] = {point: mark for mark, point in enumerate(shown.tolist())}
        for one in seen:
            for other in [each for each in seen if each > one]:
                common = sorted(seen[one].keys() & seen[other].keys())[:100]
                matches = np.array([(seen[one][each], seen[other][each]) for each in common], np.uint32)
                if len(common) >= 15:
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration(2), matches
                    database.write_two_view_geometry(one, other, geometry)
    return workspace


def turned(degrees: np.ndarray, tilt: float) -> np.ndarray:
    """Rotations [n, 3, 3] of a camera that looks so many degrees away from straight down, turned about the vertical."""
    tilted = Rotation.from_euler("x", tilt, degrees=True).as_matrix() @ DOWN
    return tilted @ Rotation.from_euler("z", degrees[:, None], degrees=True).as_matrix()


@pytest.fixture(autouse=True)
def known_noise(monkeypatch):
    monkeypatch.setattr(turning, "UNKNOWN_PX", 0.3)


def line(count: int, step: float) -> np.ndarray:
    return np.column_stack([step * np.arange(count), np.zeros(count), np.full(count, 60.0)])


@pytest.mark.parametrize("focal", [FOCAL, 1.25 * FOCAL])
def test_a_camera_that_only_turns_tells_no_depth_by_any_lens(tmp_path, focal):
    angles = np.linspace(0, 150, 8)
    still = np.tile([0.0, 0.0, 60.0], (8, 1))
    assert only_turns(workspace_of(tmp_path, still, turned(angles, 40), 10.0, focal))


@pytest.mark.parametrize("relief", [0.0, 10.0])
@pytest.mark.parametrize("step", [2.0, 15.0])
def test_a_flight_is_no_turn_even_straight_down_over_a_plane(tmp_path, relief, step):
    """A homography explains a plane, and small steps look like small turns; a rotation explains neither."""
    assert not only_turns(workspace_of(tmp_path, line(8, step), turned(np.zeros(8), 0), relief, FOCAL))


def test_a_panorama_at_the_end_of_a_flight_leaves_its_depth(tmp_path):
    centers = np.concatenate([line(6, 12.0), np.repeat(line(6, 12.0)[-1:], 8, axis=0)])
    rotations = np.concatenate([turned(np.zeros(6), 20), turned(np.linspace(0, 140, 8), 20)])
    assert not only_turns(workspace_of(tmp_path, centers, rotations, 10.0, FOCAL))


def test_a_flight_of_which_most_photographs_are_a_panorama_leaves_its_depth(tmp_path):
    """Most pairs are of the panorama then, all of whose photographs match."""
    centers = np.concatenate([line(8, 12.0), np.repeat(line(8, 12.0)[-1:], 56, axis=0)])
    rotations = np.concatenate([turned(np.zeros(8), 20), turned(np.linspace(0, 350, 56), 20)])
    assert not only_turns(workspace_of(tmp_path, centers, rotations, 10.0, FOCAL))


def test_two_photographs_without_matches_are_not_called_a_turn(tmp_path):
    assert not only_turns(workspace_of(tmp_path, line(2, 500.0), turned(np.zeros(2), 0), 0.0, FOCAL))


@pytest.mark.parametrize(
    ("points", "turns", "said"),
    [(400, False, ""), (400, True, "from one place"), (1, False, "show only 1 points"), (1, True, "from one place")],
)
def test_a_model_without_depth_or_of_hardly_any_points_is_no_capture(monkeypatch, points, turns, said):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 4, points
    model, asked = pycolmap.synthesize_dataset(options), []

    def answer(_workspace, of):
        asked.append(of)
        return turns

    monkeypatch.setattr(reconstruction_report, "only_turns", answer)
    if said:
        with pytest.raises(CaptureError, match=said):
            check_enough_placed(model, [], SimpleNamespace())
    else:
        check_enough_placed(model, [], SimpleNamespace())
    assert asked == [model if points > 1 else None]  # a poor model says nothing: all that match are asked
