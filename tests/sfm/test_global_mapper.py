"""Parts of a flight that the incremental mapper cannot join, and all photographs at once."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console

pycolmap = pytest.importorskip("pycolmap")

from vdgs.geometry.similarity import fit_similarity  # noqa: E402
from vdgs.sfm import global_mapper, incremental_mapper  # noqa: E402
from vdgs.sfm.feature_matching import count_verified_matches  # noqa: E402
from vdgs.sfm.workspace import Workspace, silence_colmap  # noqa: E402

WIDTH, HEIGHT, FOCAL, ALTITUDE = 1000, 800, 1000.0, 100.0
CONSOLE = Console(quiet=True)


def flight(bridge: int) -> tuple[np.ndarray, np.ndarray]:
    """Cameras [16, 3] that look down, in two parts of two strips, and points [n, 3]: many below each part, and so many
    between them that both parts see."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid([0, 20, 40, 60, 130, 150, 170, 190], [0, 40], indexing="ij")
    cameras = np.stack([x.ravel(), y.ravel(), ALTITUDE + rng.uniform(-3, 3, x.size)], axis=1)
    grounds = [((-50, 75), 500), ((115, 240), 500), ((85, 105), bridge)]
    points = [np.c_[rng.uniform(*across, n), rng.uniform(-30, 70, n), rng.uniform(0, 15, n)] for across, n in grounds]
    return cameras, np.concatenate(points)


def workspace_of(folder, bridge: int) -> Workspace:
    """A work folder with the features and verified pairs of such a flight."""
    silence_colmap()
    workspace, rng = Workspace(folder), np.random.default_rng(1)
    workspace.images.mkdir(parents=True)
    cameras, points = flight(bridge)
    with workspace.open_database() as database:
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
        camera.has_prior_focal_length = True
        number = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
        database.write_rig(rig)
        seen = {}
        for index, center in enumerate(cameras):
            away = points - center
            pixels = np.c_[WIDTH / 2 + FOCAL * away[:, 0] / -away[:, 2], HEIGHT / 2 - FOCAL * away[:, 1] / -away[:, 2]]
            shown = np.flatnonzero(((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1))
            image = database.write_image(pycolmap.Image(name=f"{index:02d}.jpg", camera_id=number))
            frame = pycolmap.Frame()
            frame.rig_id = 1
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number), image))
            database.write_frame(frame)
            database.write_keypoints(image, (pixels[shown] + rng.normal(0, 0.2, (len(shown), 2))).astype(np.float32))
            seen[image] = {point: k for k, point in enumerate(shown.tolist())}
        names = {}
        for one in seen:
            for other in seen:
                common = sorted(seen[one].keys() & seen[other].keys()) if one < other else []
                if len(common) >= 15:
                    pairs = [(seen[one][point], seen[other][point]) for point in common]
                    database.write_matches(one, other, np.array(pairs, np.uint32))
                    names[one, other] = f"{one - 1:02d}.jpg {other - 1:02d}.jpg\n"
    (folder / "pairs.txt").write_text("".join(names.values()))
    pycolmap.verify_matches(workspace.database, folder / "pairs.txt")
    return workspace


def sizes(workspace: Workspace) -> list[int]:
    return [model.num_reg_images() for model in incremental_mapper.read_models(workspace)]


def join(workspace: Workspace) -> None:
    incremental_mapper.set_models_aside(workspace)
    global_mapper.place_left_out(workspace, 16, True, 1, CONSOLE)


def test_parts_that_few_points_join_become_one_model(tmp_path):
    workspace = workspace_of(tmp_path / "work", 24)
    incremental_mapper.run_mapper(workspace, 16, True, 1, CONSOLE)
    assert len(count_verified_matches(workspace)) == 16
    assert sizes(workspace) == [8, 8]
    assert global_mapper.leaves_photographs_out(workspace)
    join(workspace)
    assert sizes(workspace) == [16]
    assert not global_mapper.leaves_photographs_out(workspace)
    model = incremental_mapper.read_models(workspace)[0]
    assert model.compute_mean_reprojection_error() < 0.5
    truth = flight(24)[0]
    found = {int(image.name[:2]): image.projection_center() for image in model.images.values()}
    centers = np.array([found[k] for k in range(16)])
    off = fit_similarity(centers, truth).apply(centers) - truth
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.02 * ALTITUDE


@pytest.mark.parametrize("why", ["no model", "another shape"])
def test_parts_stay_where_all_at_once_is_no_better(tmp_path, monkeypatch, why):
    workspace = workspace_of(tmp_path / "work", 24)
    incremental_mapper.run_mapper(workspace, 16, True, 1, CONSOLE)
    before = sizes(workspace)
    if why == "no model":
        monkeypatch.setattr(global_mapper.sys, "executable", "false")
    else:
        monkeypatch.setattr(global_mapper, "MAX_MOVED_SHARE", 0.0)
    join(workspace)
    assert sizes(workspace) == before == [8, 8]
