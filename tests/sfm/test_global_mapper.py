"""Parts of a flight that the incremental mapper cannot join, and all photographs at once."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from tests.support.marked_photographs import write_camera, write_photograph

pycolmap = pytest.importorskip("pycolmap")

from vdgs.config.sfm_options import SfmOptions  # noqa: E402
from vdgs.errors import VdgsError  # noqa: E402
from vdgs.geometry.similarity import fit_similarity  # noqa: E402
from vdgs.sfm import focal_decision, global_mapper, incremental_mapper, mapping  # noqa: E402
from vdgs.sfm.feature_matching import count_verified_matches  # noqa: E402
from vdgs.sfm.workspace import Workspace, silence_colmap  # noqa: E402

pytestmark = [pytest.mark.xdist_group("global_mapper"), pytest.mark.slow]

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
        number, seen = write_camera(database, camera), {}
        for index, center in enumerate(cameras):
            away = points - center
            pixels = np.c_[WIDTH / 2 + FOCAL * away[:, 0] / -away[:, 2], HEIGHT / 2 - FOCAL * away[:, 1] / -away[:, 2]]
            shown = np.flatnonzero(((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1))
            marks = pixels[shown] + rng.normal(0, 0.2, (len(shown), 2))
            image = write_photograph(database, f"{index:02d}.jpg", number, marks)
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


def join(workspace: Workspace) -> str:
    """What is said of it."""
    said = Console(record=True, width=200, file=io.StringIO())
    incremental_mapper.set_models_aside(workspace)
    global_mapper.place_left_out(workspace, 16, True, 1, said)
    return said.export_text()


def test_parts_that_few_points_join_become_one_model(tmp_path):
    workspace = workspace_of(tmp_path / "work", 24)
    incremental_mapper.run_mapper(workspace, 16, True, 1, CONSOLE)
    assert len(count_verified_matches(workspace)) == 16
    assert sizes(workspace) == [8, 8]
    assert global_mapper.leaves_photographs_out(workspace)
    assert "end in parts of 8, 8; all at once 16 are placed" in join(workspace)
    assert sizes(workspace) == [16]
    assert not global_mapper.leaves_photographs_out(workspace)
    model = incremental_mapper.read_models(workspace)[0]
    assert model.compute_mean_reprojection_error() < 0.5
    truth = flight(24)[0]
    found = {int(image.name[:2]): image.projection_center() for image in model.images.values()}
    centers = np.array([found[k] for k in range(16)])
    off = fit_similarity(centers, truth).apply(centers) - truth
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.02 * ALTITUDE


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    """The work folder of such a flight in two parts. Not to be changed: `copied`."""
    workspace = workspace_of(tmp_path_factory.mktemp("mapped") / "work", 24)
    incremental_mapper.run_mapper(workspace, 16, True, 1, CONSOLE)
    assert sizes(workspace) == [8, 8]
    return workspace.path


@pytest.fixture
def copied(mapped, tmp_path) -> Workspace:
    shutil.copytree(mapped, tmp_path / "work")
    workspace = Workspace(tmp_path / "work")
    workspace.begin("model", "key")
    workspace.finish("model", "key")
    return workspace


def models_of(workspace: Workspace, key: str = "key") -> list[int]:
    """As `vdgs sfm` makes them, or goes on with them."""
    plan = SimpleNamespace(image_list=SimpleNamespace(images=[]), threads=1)
    return [len(model.images) for model in mapping.make_models(plan, workspace, key, 16, True, CONSOLE)]


def python_that(folder: Path, script: str) -> str:
    """A program that a shell script stands for; $1 is where the models of the global mapper belong."""
    program = folder / "python"
    program.write_text(f"#!/bin/sh\nshift $(($# - 3))\n{script}\n")
    program.chmod(0o755)
    return str(program)


@pytest.mark.parametrize("why", ["no model", "another shape"])
def test_parts_stay_where_all_at_once_is_no_better(copied, monkeypatch, tmp_path, why):
    if why == "no model":
        monkeypatch.setattr(sys, "executable", python_that(tmp_path, "touch $1/begun; exit 1"))
    else:
        monkeypatch.setattr(global_mapper, "MAX_MOVED_SHARE", 0.0)
    said = join(copied)
    assert sizes(copied) == [8, 8]
    assert (
        f"all photographs at once: the {'mapper ended without a model' if why == 'no model' else 'part of 8'}" in said
    )
    assert not list(copied.path.glob("global-*"))


def test_a_mapper_that_cannot_start_is_an_error_of_the_machine_and_work_goes_on_after_it(copied, monkeypatch, tmp_path):
    with monkeypatch.context() as broken:
        broken.setattr(sys, "executable", python_that(tmp_path, "echo no torch >&2; exit 1"))
        with pytest.raises(VdgsError, match=r"cannot be started .*\(exit code 1 no torch\)"):
            models_of(copied)
    assert not list(copied.path.glob("global-*"))
    assert models_of(copied) == [16]


def interrupt(*_: object) -> str:
    raise KeyboardInterrupt


def test_work_that_stops_while_parts_are_joined_goes_on(copied, monkeypatch):
    incremental_mapper.set_models_aside(copied)  # killed before the step is noted
    assert sizes(copied) == [8, 8]
    with monkeypatch.context() as stopped:
        stopped.setattr(global_mapper, "_take", interrupt)
        with pytest.raises(KeyboardInterrupt):
            models_of(copied)
    assert copied.is_begun("joined", "key")
    assert models_of(copied) == [16]
    assert copied.is_done("joined", "key")
    copied.forget("joined")
    assert not copied.is_begun("joined", "key")
    assert copied.is_done("model", "key")


def test_a_focal_length_that_the_photographs_contradict_is_fitted_anew_and_work_goes_on_there(copied, monkeypatch):
    """The models of the wrong one are made once, also where the work stops after them."""
    plan = SimpleNamespace(
        image_list=SimpleNamespace(images=[]), threads=1, gps_priors=None,
        request=SimpleNamespace(options=SfmOptions(focal="fixed")),
    )  # fmt: skip
    made = []

    def map_with(_plan, workspace, key, _count, fix_focal, _console):
        workspace.begin("model", key)
        made.append(fix_focal)
        if made == [True, False]:
            raise KeyboardInterrupt
        return [None]

    monkeypatch.setattr(mapping, "make_models", map_with)
    monkeypatch.setattr(focal_decision, "is_contradicted", lambda *_: True)
    with pytest.raises(KeyboardInterrupt):
        mapping.map_photographs(plan, copied, [], "key", 16, CONSOLE)
    assert mapping.map_photographs(plan, copied, [], "key", 16, CONSOLE)[1] == (False, focal_decision.CONTRADICTED)
    assert made == [True, False, False]


def test_models_that_are_deleted_to_be_made_anew_are_not_taken_for_done(copied, monkeypatch):
    assert models_of(copied) == [16]
    monkeypatch.setattr(incremental_mapper, "delete_models", interrupt)
    with pytest.raises(KeyboardInterrupt):
        models_of(copied, "other")
    assert not copied.is_done("model", "key")


def test_models_that_are_made_anew_are_joined_anew(copied):
    assert models_of(copied) == [16]
    copied.begin("model", "other")  # another focal length was asked for, and the work was stopped
    assert models_of(copied) == [16]
    assert copied.is_done("joined", "key")


def test_a_model_that_the_disk_cut_off_is_not_taken(copied, tmp_path):
    """COLMAP says nothing where it can write a part of a model only."""
    program = python_that(tmp_path, f"cp -r {copied.models}/0 $1/0\ntruncate -s 100 $1/0/points3D.bin")
    incremental_mapper.set_models_aside(copied)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "executable", program)
        with pytest.raises(VdgsError, match="could write a part only"):
            global_mapper.place_left_out(copied, 16, True, 1, CONSOLE)
    assert not list(copied.saved_snapshots.glob("*"))
    global_mapper.place_left_out(copied, 16, True, 1, CONSOLE)
    assert sizes(copied) == [16]


@pytest.mark.parametrize("bent", [False, True])
def test_a_part_on_one_line_keeps_its_shape_but_where_it_is_bent(copied, bent):
    part, joined = (incremental_mapper.read_models(copied)[0] for _ in range(2))
    for model in (part, joined):  # one strip of the two
        for image in list(model.images.values()):
            if int(image.name[:2]) % 2:
                model.deregister_frame(image.frame_id)
    if bent:
        image = next(image for image in joined.images.values() if image.has_pose)
        pose = image.frame.rig_from_world
        pose.translation = pose.translation + 0.2 * incremental_mapper.height_over_points(image, joined) * np.eye(3)[2]
        image.frame.rig_from_world = pose
    assert global_mapper._keeps_shape(part, joined) is not bent
