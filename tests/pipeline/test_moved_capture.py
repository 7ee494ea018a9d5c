"""Runs whose capture is read with other options, lies elsewhere, or is gone: what is blamed, and what still works."""

from __future__ import annotations

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from vdgs.cli.advice import Advice
from vdgs.cli.main import main, verb_arguments
from vdgs.cli.result_cmds import view_command
from vdgs.cli.start_settings import start_settings
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RenderRequest
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, ModelConfig, TrainConfig
from vdgs.errors import CaptureError, RunError, VdgsError
from vdgs.export.export_run import make_initial_view
from vdgs.pipeline.finished_run import same_photographs
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.rendering.render_run import render_run
from vdgs.report.status_cli import print_status, status_json
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.open_run import open_capture, open_model, open_run, relocate_capture
from vdgs.runs.run_cameras import load_run_cameras, run_cameras_of_capture, save_run_cameras
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.visibility_store import get_run_visibility
from vdgs.sfm.source_images import SourceImages
from vdgs.system.quoting import shell_line

pytestmark = [pytest.mark.xdist_group("moved_capture"), pytest.mark.slow]

METHOD = MethodConfig(TrainConfig(iterations=3, model=ModelConfig(num_offsets=2)))
UP = CaptureOptions(up="z")
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder with a capture, `place`, and a coarse model of it, `run`."""
    folder = tmp_path_factory.mktemp("moved")
    write_colmap(folder / "place", tiny_scene())
    train_coarse(create_or_resume_run(folder / "place", folder / "run", UP, METHOD), CheckpointOptions(), QUIET)
    return folder


@pytest.fixture
def folder(trained, tmp_path) -> Path:
    """The same to change; the run still knows its capture by its old place, where nothing is."""
    shutil.copytree(trained, tmp_path / "there")
    file = tmp_path / "there" / "run" / "config.yaml"
    file.write_text(file.read_text().replace(str(trained), str(tmp_path / "gone")))
    return tmp_path / "there"


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (replace(UP, downscale=2.0), r"--downscale: 1\.0 -> 2\.0"),
        (replace(UP, test_every=4), "--test-every: 8 -> 4"),
        (replace(UP, up="y"), "--up: z -> y"),
    ],
)
def test_another_option_is_named_and_not_the_capture(trained, options, line):
    for redo in (None, False):
        with pytest.raises(RunError, match=line) as caught:
            create_or_resume_run(trained / "place", trained / "run", options, METHOD, overwrite=redo)
        assert "is not the capture" not in str(caught.value)


def test_redo_takes_another_option(folder):
    context = create_or_resume_run(folder / "place", folder / "run", replace(UP, downscale=2.0), METHOD, overwrite=True)
    run = context.run
    assert not run.coarse.has_output()
    train_coarse(context, CheckpointOptions(), QUIET)
    assert open_run(run.path).capture.views[0].camera.width == 32
    create_or_resume_run(folder / "place", folder / "run", replace(UP, downscale=2.0), METHOD, overwrite=False)


@pytest.mark.parametrize("redo", [None, False])
def test_a_capture_that_moved_is_taken_where_it_is_given(folder, redo):
    run = create_or_resume_run(folder / "place", folder / "run", UP, METHOD, overwrite=redo).run
    assert open_run(run.path).capture.root == folder / "place"
    assert run.coarse.is_done(run.keys().coarse)


@pytest.fixture
def listed(tmp_path) -> Path:
    """A folder with a run whose test photographs a list in the capture names, and the capture, which moved."""
    write_colmap(tmp_path / "place", tiny_scene())
    names = sorted(file.name for file in (tmp_path / "place" / "images").iterdir())
    (tmp_path / "place" / "mine.txt").write_text("\n".join(names[:2]))
    options = replace(UP, test_list=tmp_path / "place" / "mine.txt")
    train_coarse(
        create_or_resume_run(tmp_path / "place", tmp_path / "run", options, METHOD), CheckpointOptions(), QUIET
    )
    (tmp_path / "place").rename(tmp_path / "moved")
    return tmp_path


@pytest.mark.parametrize("redo", [None, False, "named"])
def test_files_in_a_capture_that_moved_moved_with_it(listed, redo):
    run = RunFolder(listed / "run")
    before = run.keys()
    if redo == "named":
        relocate_capture(run, listed / "moved")
    else:
        options = replace(UP, test_list=listed / "moved" / "mine.txt")
        create_or_resume_run(listed / "moved", run.path, options, METHOD, overwrite=redo)
    assert run.settings().capture.test_list == listed / "moved" / "mine.txt"
    assert len(open_run(run.path).capture.test_views) == 2
    assert run.keys() == before
    assert run.coarse.is_done(run.keys().coarse)


@pytest.mark.parametrize("original", ["gone", "there"])
def test_a_command_that_names_the_capture_alone_finds_its_files(listed, original):
    if original == "there":
        shutil.copytree(listed / "moved", listed / "place")
    given = {"output": listed / "run", "capture": listed / "moved"}
    assert start_settings(given).options.test_list == listed / "moved" / "mine.txt"


def test_folders_in_a_capture_that_are_named_whole_move_with_it():
    named = CaptureOptions(images="/a/place/images_4", masks="masks", gps=Path("/a/places/gps.csv"))
    moved = RunSettings.create("/a/place", named, METHOD).moved(Path("/b/place")).capture
    assert (moved.images, moved.masks, moved.gps) == ("/b/place/images_4", "masks", Path("/a/places/gps.csv"))


def test_what_needs_the_capture_says_how_to_name_it(folder):
    run = RunFolder(folder / "run")
    with pytest.raises(CaptureError, match=r"gone/place: the capture of .* is not there.*--capture PATH"):
        open_run(run.path)
    relocate_capture(run, folder / "place")
    assert open_run(run.path).capture.root == folder / "place"


@pytest.fixture
def moved_run(folder, tmp_path) -> RunFolder:
    """A run that made its capture in its own folder, which was moved since."""
    run = RunFolder(folder / "run")
    (folder / "place").rename(run.own_capture)
    for place in (run.path, run.own_capture):
        (place / "reconstruction.json").write_text('{"made": "here"}')
    text = run.config_file.read_text()
    run.config_file.write_text(text.replace(str(tmp_path / "gone" / "place"), str(tmp_path / "gone" / "capture")))
    return run


def test_a_capture_in_the_folder_of_its_run_moves_with_it(moved_run, tmp_path):
    keys, before = moved_run.keys(), moved_run.config_file.read_text()
    assert moved_run.settings().capture_path == str(moved_run.own_capture)
    assert open_run(moved_run.path).capture.root == moved_run.own_capture
    assert moved_run.coarse.is_done(keys.coarse)  # nothing is trained anew for it
    assert moved_run.config_file.read_text() == before
    (tmp_path / "gone").mkdir()
    shutil.copytree(moved_run.own_capture, tmp_path / "gone" / "capture")  # as of a run that was copied
    assert open_run(moved_run.path).capture.root == moved_run.own_capture
    moved_run.change_settings(moved_run.settings(), overwrite=False)
    assert f"path: {moved_run.own_capture}\n" in moved_run.config_file.read_text()  # what continues it writes it down


@pytest.mark.parametrize("other", ["another reconstruction", "none", "another name"])
def test_another_capture_in_the_folder_of_a_run_is_not_taken_for_its_own(moved_run, other, tmp_path):
    if other == "another name":  # the run is of a capture elsewhere
        text = moved_run.config_file.read_text()
        moved_run.config_file.write_text(text.replace(str(tmp_path / "gone" / "capture"), str(tmp_path / "flight")))
    elif other == "none":
        (moved_run.own_capture / "reconstruction.json").unlink()
    else:
        (moved_run.own_capture / "reconstruction.json").write_text('{"made": "anew"}')
    with pytest.raises(CaptureError, match=r"/(gone/capture|flight): the capture of .* is not there"):
        open_run(moved_run.path)


@pytest.mark.parametrize(("verb", "advised"), [("export", "export"), ("eval", "eval"), ("status", "visibility")])
def test_a_missing_capture_is_named_by_the_verb_that_was_typed(folder, verb, advised, tmp_path):
    run = folder / "run"
    text = RunFolder(run).missing_capture()
    assert text.startswith(f"{tmp_path}/gone/place: the capture of {run} is not there.")
    assert Advice(verb, verb_arguments).fit(text).endswith(f"say where to, once: vdgs {advised} {run} --capture PATH")


def test_the_status_says_that_the_capture_is_missing(folder, capsys):
    run = RunFolder(folder / "run")
    text = run.missing_capture()
    print_status(run, Console(soft_wrap=True))
    assert f"to mend: {text}" in capsys.readouterr().out
    assert status_json(run)["problem"] == text
    assert status_json(run)["next_command"] is None
    relocate_capture(run, folder / "place")
    assert status_json(run)["problem"] is None


def test_another_capture_is_not_remembered(folder, tmp_path):
    write_colmap(tmp_path / "other", tiny_scene(points=300))
    with pytest.raises(RunError, match=r"is not the capture that .*changed: .*sparse points.*former version of vdgs"):
        relocate_capture(RunFolder(folder / "run"), tmp_path / "other")
    assert "gone" in (folder / "run" / "config.yaml").read_text()


def test_the_kept_flight_is_that_of_the_capture(trained):
    run = RunFolder(trained / "run")
    kept = load_run_cameras(run, open_model(run).model.metadata.capture)
    assert kept is not None
    read = run_cameras_of_capture(open_capture(run))
    assert [name for name, _ in kept.train + kept.test] == [name for name, _ in read.train + read.test]
    for (_, ours), (_, theirs) in zip(kept.train, read.train, strict=True):
        assert (ours.packed == theirs.packed).all()
    assert (kept.scene_center == read.scene_center).all()
    assert (kept.ground.translation == read.ground.translation).all()


def test_all_of_the_ground_frame_is_kept(trained):
    run = RunFolder(trained / "run")
    capture = open_capture(run)
    ground = replace(
        capture.ground, origin_geo=(47.0, 8.0, 400.0), axes_geo=(47.1, 8.1), accuracy="to 2 m", method="GPS"
    )
    before = run.cameras_file.read_bytes()
    try:
        save_run_cameras(run, replace(capture, ground=ground))
        record = json.loads(run.cameras_file.read_text())
        kept = load_run_cameras(run, {"fingerprint": record["fingerprint"]})
    finally:
        run.cameras_file.write_bytes(before)
    assert kept is not None
    for name, value in vars(ground).items():
        assert (
            np.array_equal(getattr(kept.ground, name), value)
            if isinstance(value, np.ndarray)
            else (getattr(kept.ground, name) == value)
        ), name


def test_views_and_orbits_are_drawn_without_the_photographs(trained, folder, tmp_path):
    for views, extra in (("test", {}), ("orbit", {"seconds": 0.1, "antialiasing": "on"})):
        for run in (trained / "run", folder / "run"):
            render_run(
                RenderRequest(run=run, output=tmp_path / run.parent.name / views, views=views, **extra, device="cpu"),
                QUIET,
            )
        ours, theirs = (sorted((tmp_path / each.name / views).glob("*.png")) for each in (trained, folder))
        assert [file.read_bytes() for file in ours] == [file.read_bytes() for file in theirs]
        assert ours


@pytest.mark.parametrize("mode", ["rgb", "depth"])
def test_frames_that_show_nothing_of_the_scene_are_said(trained, tmp_path, mode):
    away = [{"position": [1e4 + k, 1e4, 50.0], "look_at": [2e4, 2e4, 50.0], "fov_deg": 60.0} for k in range(2)]
    (tmp_path / "away.json").write_text(json.dumps(away), encoding="utf-16")
    console = Console(record=True, width=500)
    request = RenderRequest(run=trained / "run", output=tmp_path / "out", path=tmp_path / "away.json", mode=mode)
    render_run(replace(request, seconds=0.1, fps=20, device="cpu"), console)
    assert "2 frames of 2 (first" in (said := console.export_text())
    assert "show nothing of the scene" in said


def test_films_and_pictures_fade_out_where_few_cameras_see(trained, tmp_path, monkeypatch):
    frames, path = {}, RenderRequest(run=trained / "run", output=tmp_path, views="orbit", seconds=0.1, device="cpu")

    @contextmanager
    def film(output: Path, fps: float):
        yield SimpleNamespace(write=frames.setdefault(output.stem, []).append)

    monkeypatch.setattr("vdgs.rendering.render_run.VideoWriter", film)
    for number in (0, 4, None, 2):
        asked = replace(path, min_visibility=number)
        render_run(replace(asked, output=tmp_path / f"{number}.mp4"), QUIET)
        console = Console(file=StringIO(), record=True, width=500)
        render_run(replace(asked, output=tmp_path / str(number)), console)
        said = console.export_text()
        assert ("fewer than 2 training cameras see is faded out" in said) == (number is None)
        written = json.loads((tmp_path / str(number) / "render.json").read_text())
        assert written.get("min_visibility", 0) == (2 if number is None else number)
        pictures = [cv2.imread(str(file))[..., ::-1] for file in sorted((tmp_path / str(number)).glob("*.png"))]
        assert np.array_equal(pictures, frames[str(number)])
    opened = open_run(trained / "run")
    seen = get_run_visibility(opened, [view.camera for view in opened.capture.train_views])
    assert 0 < (seen >= 4).double().mean() < 1
    assert not np.array_equal(frames["0"], frames["4"])
    assert np.array_equal(frames["None"], frames["2"])


def test_maps_are_drawn_without_the_photographs_too(trained, folder, tmp_path):
    for kind in ("depth", "visibility", "alpha"):
        for run in (trained / "run", folder / "run"):
            render_run(RenderRequest(run=run, output=tmp_path / run.parent.name / kind, mode=kind, device="cpu"), QUIET)
        ours, theirs = (sorted((tmp_path / each.name / kind).glob("*.png")) for each in (trained, folder))
        assert ours
        assert [file.read_bytes() for file in ours] == [file.read_bytes() for file in theirs]


def test_nothing_is_drawn_among_the_photographs_though_they_are_not_read(trained, tmp_path):
    shutil.copytree(trained / "place", tmp_path / "place")
    (tmp_path / "place" / "images").rename(tmp_path / "place" / "photos")
    options = replace(UP, images="photos")
    context = create_or_resume_run(tmp_path / "place", tmp_path / "run", options, METHOD)
    run, capture = context.run, context.capture
    train_coarse(context, CheckpointOptions(), QUIET)
    flight = load_run_cameras(run, open_model(run).model.metadata.capture)
    assert flight is not None
    assert flight.input_folders == run_cameras_of_capture(capture).input_folders
    assert flight.camera_height == run_cameras_of_capture(capture).camera_height
    (tmp_path / "place").rename(tmp_path / "moved")
    relocate_capture(run, tmp_path / "moved")
    for inside in ("", "new", "film.mp4"):
        with pytest.raises(VdgsError, match="photos, which is for inputs of the capture"):
            render_run(RenderRequest(run=run.path, output=tmp_path / "moved" / "photos" / inside, device="cpu"), QUIET)


def test_the_command_that_is_advised_names_the_capture_where_it_lies_now(folder, tmp_path):
    run = RunFolder(folder / "run")
    settings, gone = run.settings(), tmp_path / "gone" / "place"

    def commands(place: Path) -> tuple[str, str]:
        return (
            shell_line(["vdgs", "run", place, "--output", "a run", "--overwrite"]),
            shell_line(["vdgs", "run", place, "--gps", place / "g.csv", "-o", f"{gone}s"]),
        )

    named = zip(commands(gone), commands(folder / "place"), strict=True)
    for command, moved in (*named, ("vdgs run place --output run", None), (None, None)):
        run.config.write(settings, command)
        run.move_capture(gone)  # where it was
        assert run.config.command() == command
        run.move_capture(folder / "place")
        assert run.config.command() == moved


def test_a_run_without_cameras_takes_the_capture_that_is_named(folder, tmp_path):
    (folder / "run" / "cameras.json").unlink()
    asked = RenderRequest(run=folder / "run", output=tmp_path / "o", device="cpu")
    with pytest.raises(CaptureError, match="--capture PATH"):
        render_run(asked, QUIET)
    render_run(replace(asked, capture=folder / "place"), QUIET)
    assert len(list((tmp_path / "o").glob("*.png"))) == 2
    assert "gone" in (folder / "run" / "config.yaml").read_text()  # looking at a run changes nothing in it


@pytest.mark.parametrize("text", ["{}", "[]", '{"fingerprint": 3, "views": 1}', "{"])
def test_damaged_cameras_are_said_or_read_anew(folder, tmp_path, text):
    (folder / "run" / "cameras.json").write_text(text)
    with pytest.raises(VdgsError, match=r"cameras\.json: is damaged|--capture PATH"):
        render_run(RenderRequest(run=folder / "run", output=tmp_path / "o", device="cpu"), QUIET)


def test_pictures_too_large_for_memory_are_refused_before_they_are_drawn(trained, tmp_path, monkeypatch):
    monkeypatch.setattr("vdgs.rendering.render_run.available_memory_bytes", lambda: 1_000_000)
    with pytest.raises(VdgsError, match=r"a picture of 1000x750 takes about \d+ MB.*smaller --width"):
        render_run(RenderRequest(run=trained / "run", output=tmp_path / "o", width=1000, device="cpu"), QUIET)
    with pytest.raises(VdgsError, match=r"pictures of 12000x\d+ are too large|takes about"):
        render_run(RenderRequest(run=trained / "run", output=tmp_path / "o", width=12_000, device="cpu"), QUIET)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("iterations: 3", "iterations: many"), "training.iterations is 'many'; it must be a whole number"),
        (("lambda_vis: 1.0", "lambda_vis: .nan"), "partition.lambda_vis is nan; it must be at least 0"),
        (("test_every: 8", "test_every: often"), "capture.test_every is 'often'; it must be a whole number"),
        (("blocks: 8", "block: 8"), "partition has no 'block'; did you mean 'blocks'?"),
    ],
)
def test_a_setting_in_the_file_that_cannot_be_is_named(folder, change, says, tmp_path, capsys):
    file = folder / "run" / "config.yaml"
    text = file.read_text()
    assert change[0] in text
    file.write_text(text.replace(*change))
    with pytest.raises(SystemExit) as ended:
        main(["eval", str(folder / "run"), "--capture", str(folder / "place")])
    assert ended.value.code == 1
    assert f"config.yaml: {says}" in capsys.readouterr().err


@pytest.mark.parametrize("capture", ["place", "place/images"])
def test_curves_without_their_package_are_refused_before_any_work(trained, tmp_path, capture, capsys, monkeypatch):
    monkeypatch.setattr("vdgs.config.executor_options.find_spec", lambda name: None)
    with pytest.raises(SystemExit) as ended:
        main(["run", str(trained / capture), "--output", str(tmp_path / "new"), "--device", "cpu", "--tensorboard"])
    assert ended.value.code == 1
    assert 'pip install "vdgs[tensorboard]"' in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("verb", ["run", "eval"])
def test_weights_that_are_not_there_are_said_before_any_work(trained, tmp_path, verb, capsys):
    first = [str(trained / "place"), "--output", str(tmp_path / "new")] if verb == "run" else [str(trained / "run")]
    with pytest.raises(SystemExit) as ended:
        main([verb, *first, "--device", "cpu", "--threads", "1", "--lpips-weights", "nowhere.pth"])
    assert ended.value.code == 1
    assert "--lpips-weights nowhere.pth: no such file" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_capture_that_moved_is_named_to_view_too(folder, monkeypatch):
    shown = []
    monkeypatch.setattr("vdgs.viewer.server.view_run", lambda request, console: shown.append(open_run(request.run)))
    view_command([str(folder / "run"), "--capture", str(folder / "place")])
    assert [each.capture.root for each in shown] == [folder / "place"]
    assert RunFolder(folder / "run").settings().capture_path == str(folder / "place")


def test_a_run_of_photographs_is_known_by_these_whatever_else_the_command_says(moved_run):
    """A finished run that was moved, or that is asked for without the options of its method, which it has."""
    moved_run.move_capture(moved_run.own_capture)
    begun = "vdgs run /photos/a --output /before/run --preset laptop --sfm.matching exhaustive --gps /photos/g.csv"
    SourceImages(folders=("/photos/a",), files=(), command=begun).write(moved_run.own_capture)
    same = "vdgs run /photos/a --gps /photos/g.csv --sfm.matching exhaustive --output /now/run --iterations 40"
    others = (
        same.replace("/photos/a", "/photos/b"), same.replace("exhaustive", "sequential"),
        same.replace("--gps /photos/g.csv ", ""), same.replace("/photos/a", "/photos/a /photos/b"),
        f"{same} --config /other/positions.yaml",
    )  # fmt: skip
    assert same_photographs(moved_run, same)
    assert [same_photographs(moved_run, other) for other in others] == [False] * len(others)


def test_a_page_is_named_as_the_report(moved_run):
    shown = open_run(moved_run.path)
    moved_run.place_file.unlink(missing_ok=True)
    assert make_initial_view(shown, 1).title == moved_run.path.name == "run"  # not as its folder, `capture`
    moved_run.place_file.write_text('{"name": "valley"}')
    assert make_initial_view(shown, 1).title == "valley"
