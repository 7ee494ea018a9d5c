"""What needs no computation is answered before anything heavy is imported; words that are mistyped get a suggestion."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from support.commands import PATIENCE_SECONDS
from support.small_pipeline import NativeRun, vdgs
from vdgs.captures.reconstruction import read_digests
from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import COMMANDS, main, verb_arguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import MergeConfig
from vdgs.pipeline.finished_run import _input_times, nothing_to_do
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.source_images import SourceFile, SourceImages
from vdgs.system.atomic_files import write_json
from vdgs.system.similar_paths import suggest_path

pytestmark = pytest.mark.slow

HEAVY = ("torch", "numpy", "matplotlib", "pycolmap", "cv2", "scipy", "sklearn", "shapely", "rasterio", "PIL")
#: A command line of each verb with an input that is mistyped: the folder `DCIM` or the run `flight`.
MISTYPED = {
    "inspect": ["DICM", "-o", "looks"],
    "run": ["DCMI", "-o", "new"],
    "sfm": ["DCIM", "dcin", "--out", "place"],
    "train-coarse": ["DCI", "--output", "new"],
    "config": ["--config", "flihgt"],
    **{verb: ["fligth"] for verb in ("status", "visibility", "partition", "train-blocks", "merge", "eval", "report")},
    **{verb: ["fligth"] for verb in ("view", "ortho", "lod")},
    "render": ["fligth", "-o", "film.mp4"],
    "export": ["fligth", "-o", "scene.ply"],
    "bench": ["toy", "-o", "bench", "--data", "dicm"],
}


#: Command lines one after the other in one process: exit code, output, errors, and what heavy is imported after each.
ANSWERS = """\
import contextlib, io, json, sys
from vdgs.captures.reconstruction import read_digests
from vdgs.cli.main import main
commands, heavy = json.loads(sys.argv[1])
answers = []
for words in commands:
    code, out, errors = 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            main(words)
        except SystemExit as ended:
            code = ended.code or 0
    answers.append((code, out.getvalue(), errors.getvalue(), [each for each in heavy if each in sys.modules]))
print(json.dumps(answers))
"""


def answers_of(folder: Path, *commands: Sequence[object]) -> list[tuple[int, str, str]]:
    """Exit code, output and errors of commands that must not import anything heavy."""
    words = json.dumps([[[str(word) for word in command] for command in commands], HEAVY])
    done = subprocess.run(
        [sys.executable, "-c", ANSWERS, words], cwd=folder, env=os.environ | {"COLUMNS": "200"}, capture_output=True,
        text=True, timeout=PATIENCE_SECONDS,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found) == len(commands)
    for command, (_, _, _, heavy) in zip(commands, found, strict=True):
        assert heavy == [], f"{command}: imports {heavy}"
    return [(code, out, errors.rstrip("\n")) for code, out, errors, _ in found]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place")
    for name in ("DCIM", "flight"):
        (folder / name).mkdir()
    return folder


def test_help_imports_nothing_heavy(place):
    asked = (["--help"], ["--help-all"], ["run", "--help"], ["train-coarse", "--help-all", "--preset", "paper"])
    for code, out, _ in answers_of(place, *asked, ["eval", "-h"]):
        assert code == 0
        assert "usage: vdgs" in out


def test_no_verb_with_an_input_is_left_out():
    assert set(MISTYPED) == set(COMMANDS) - {"doctor", "synth"}


def test_a_mistyped_path_is_answered_at_once(place):
    answers = answers_of(place, *([verb, *words] for verb, words in MISTYPED.items()))
    for (verb, words), (code, _, errors) in zip(MISTYPED.items(), answers, strict=True):
        assert code == 1, verb
        meant = "flight" if {"fligth", "flihgt"} & set(words) else "DCIM"
        assert errors.endswith(f"; did you mean {meant}?"), verb
    assert sorted(path.name for path in place.iterdir()) == ["DCIM", "flight"]


def test_a_folder_that_is_no_run_is_answered_at_once(place):
    of_runs = ("eval", "ortho", "visibility", "partition", "train-blocks", "merge", "lod", "report")
    commands = [[verb, "flight"] for verb in of_runs]
    commands += [[verb, "flight", "-o", "new"] for verb in ("render", "export")]
    for (verb, *_), (code, _, errors) in zip(commands, answers_of(place, *commands), strict=True):
        assert code == 1, verb
        assert f"flight: {'holds nothing of a run' if verb == 'report' else 'is not a run folder'}" in errors, verb


def test_a_finished_run_is_answered_at_once(native_small: NativeRun, tmp_path):
    run = shutil.copytree(native_small.whole, tmp_path / "run")
    vdgs("report", run)
    again = ("run", native_small.capture, "--output", run, "--no-ortho")
    answers = answers_of(tmp_path, again, ("status", run))
    assert answers[0][1].startswith(f"nothing to do: {run} is whole\n")
    for code, out, _ in answers:
        assert code == 0
        assert "next: " in out


def test_a_run_is_looked_at_closely_where_anything_differs(native_small: NativeRun, tmp_path):
    run = shutil.copytree(native_small.whole, tmp_path / "run")
    own = RunFolder(run).settings()
    asked = RunRequest(capture=native_small.capture, output=run, ortho=False, options=own.capture, **vars(own.method))
    assert nothing_to_do(asked, "") == ""  # without a report
    vdgs("report", run)
    assert nothing_to_do(asked, "").startswith("nothing to do")
    bars = tmp_path / "bars.txt"
    bars.touch()
    os.utime(bars, ns=(0, 0))
    options = replace(own.capture, scale_bar=bars)  # of photographs: the capture that was made of them has it already
    of_photographs = replace(asked, capture=native_small.capture / "images", options=options)
    RunFolder(run).config.write(own, "vdgs run DCIM")
    assert nothing_to_do(of_photographs, "vdgs run DCIM").startswith("nothing to do")
    assert nothing_to_do(of_photographs, "vdgs run OTHERS") == ""
    others = (
        replace(asked, visibility_bins=5),
        replace(asked, capture=tmp_path),
        replace(asked, options=replace(own.capture, downscale=2.0)),
        replace(asked, merge=MergeConfig(rule="max-visibility")),
        replace(asked, output=tmp_path / "new"),
    )
    assert [nothing_to_do(other, "") for other in others] == [""] * len(others)
    newer = tmp_path / "settings.yaml"
    newer.touch()
    assert nothing_to_do(asked, "", [newer]) == ""
    os.utime(run / "capture.json", ns=(0, 0))  # older than the capture
    assert nothing_to_do(asked, "") == ""


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["mrege"], "there is no verb 'mrege'; did you mean 'merge'?"),
        (["run", "C", "--outptu", "R"], "there is no option --outptu; did you mean --output?"),
        (["run", "C", "--out", "R", "--max-anchor", "5"], "did you mean --densify.max-anchors?"),
        (["run", "C", "--out", "R", "--group-that-was.mvs"], "did you mean --init.mvs?"),
        (["export", "R", "--modle=best"], "there is no option --modle; did you mean --model?"),
        (["ortho", "R", "--epsg", "26911"], "there is no option --epsg; did you mean --crs?"),
        (["run", "-s", "C", "-m", "R"], "there is no option -s; CAPTURE is given without one"),
        (["run", "--data", "C", "--output-dir", "R"], "there is no option --data; CAPTURE is given without one"),
        (["run", "C", "--model_path", "R"], "there is no option --model-path; did you mean --output?"),
        (["run", "C", "-o", "R", "-r", "4"], "there is no option -r; did you mean --downscale?"),
        (["run", "C", "-o", "R", "--dry-run", "True"], "--dry-run takes no value"),
        (["--output", "R", "run", "C"], "there is no verb '--output'; the verb comes first: vdgs run ..."),
        (["train", "C"], "there is no verb 'train'; did you mean 'run'?"),
        (["run", "C"], "--output PATH is missing"),
        (["run", "-o"], "--output needs a value: a path"),
        (["run", "C", "-o", ""], "--output needs a value: a path"),
        (["run", "C", "-o", "--seed", "1"], "--output needs a value: a path"),
        (["run", "C", "-o", "--sede", "1"], "--output needs a value: a path"),
        (["run", "C", "-o", "R", "--images", "--sede"], "--images needs a value: text"),
        (["status", "R", "S"], "'S' belongs to no option"),
        (["eval", "R", "--model", "marged"], "--model marged: must be best or coarse or merged"),
        (["eval", "R", "--jobs", "two"], "--jobs two: must be a whole number"),
        (["run", "C", "-o", "R", "--dry-run=yes"], "--dry-run takes no value"),
    ],
)
def test_a_command_line_that_is_not_understood_is_a_usage_error(arguments, says, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


def test_choices_are_taken_in_the_letters_of_other_programs():
    given = parse_words(verb_arguments()["sfm"], ["DCIM", "--output", "C", "--camera-model", "SIMPLE_RADIAL"])
    assert "simple-radial" in given.values.values()


def test_a_path_is_suggested_where_a_part_of_it_is_mistyped(tmp_path):
    (tmp_path / "card" / "DCIM").mkdir(parents=True)
    assert suggest_path(tmp_path / "crad" / "DCIM") == f"; did you mean {tmp_path / 'card' / 'DCIM'}?"
    assert suggest_path(tmp_path / "card" / "dcim") == f"; did you mean {tmp_path / 'card' / 'DCIM'}?"
    assert suggest_path(tmp_path / "card" / "quite another") == ""


def set_time(file: Path, seconds_from_now: int) -> None:
    when = time.time_ns() + seconds_from_now * 10**9
    os.utime(file, ns=(when, when))


@pytest.mark.parametrize("where", ["linked folder", "folder of a project"])
def test_photographs_that_lie_elsewhere_are_looked_at_too(native_small: NativeRun, tmp_path, where):
    run, card = shutil.copytree(native_small.whole, tmp_path / "run"), tmp_path / "card"
    capture = shutil.copytree(native_small.capture, tmp_path / "capture")
    RunFolder(run).move_capture(capture)
    shutil.move(capture / "images", card)
    if where == "linked folder":
        (capture / "images").symlink_to(card)
        (card / "around").symlink_to(tmp_path)
    cameras = json.loads((run / "cameras.json").read_text())
    if where == "folder of a project":
        views = [view | {"file": str(card / Path(view["file"]).name)} for view in cameras["views"]]
        cameras |= {"input_folders": [str(card)], "views": views}
    write_json(run / "cameras.json", cameras)
    own = RunFolder(run).settings()
    asked = RunRequest(capture=capture, output=run, ortho=False, options=own.capture, **vars(own.method))
    vdgs("report", run)
    set_time(run / "capture.json", 100)
    assert nothing_to_do(asked, "").startswith("nothing to do")
    set_time(next(card.glob("*.png")), 200)
    assert nothing_to_do(asked, "") == ""


@pytest.mark.parametrize("capture_is", ["a project file", "the folder"])
def test_a_run_beside_photographs_is_none_of_them(native_small: NativeRun, tmp_path, capture_is):
    """Neither what stages write after capture.json, nor another run or a log beside it, is a change of the capture."""
    place = shutil.copytree(native_small.capture, tmp_path / "place")
    project = place / "project.xml"
    project.touch()
    photographs = [shutil.copy(file, place) for file in (place / "images").iterdir()]
    run = shutil.copytree(native_small.whole, place / "run")
    cameras = json.loads((run / "cameras.json").read_text())
    write_json(run / "cameras.json", cameras | {"input_folders": ["."]})
    capture = project if capture_is == "a project file" else place
    RunFolder(run).move_capture(capture)
    own = RunFolder(run).settings()
    asked = RunRequest(capture=capture, output=run, ortho=False, options=own.capture, **vars(own.method))
    for file in place.rglob("*"):
        set_time(file, -200)
    (run / "capture.json").touch()
    vdgs("report", run)
    shutil.copytree(run, place / "another run")
    if capture_is == "a project file":
        (place / "run.log").touch()
    assert nothing_to_do(asked, "").startswith("nothing to do")
    time.sleep(0.05)
    old = shutil.copy2(photographs[0], place / "added.png")  # with the time of the file that it is a copy of
    assert nothing_to_do(asked, "") == ""
    Path(old).unlink()
    assert nothing_to_do(asked, "").startswith("nothing to do")
    Path(photographs[0]).rename(place / "renamed.png")
    assert nothing_to_do(asked, "") == ""


@pytest.mark.parametrize("run_is_of", ["photographs", "a capture"])
def test_a_photograph_that_is_removed_beside_the_run_is_missed(native_small: NativeRun, tmp_path, run_is_of):
    """The run lies among what it was made of, where the time of the folder tells nothing."""
    place = shutil.copytree(native_small.capture, tmp_path / "DCIM")
    photographs = [Path(shutil.copy(file, place)) for file in sorted((place / "images").iterdir())]
    run = RunFolder(shutil.copytree(native_small.whole, place / "run"))
    own, command = run.settings(), "vdgs run DCIM --output DCIM/run"
    if run_is_of == "photographs":
        digests = read_digests(run.own_capture)
        gone = Path(shutil.copy(photographs[0], place / "of before.png"))
        gone.write_bytes(b"another")
        digests.of(gone)
        gone.unlink()
        files = tuple(SourceFile(file.name, digests.of(file)) for file in photographs)
        SourceImages(folders=(str(place),), files=files, command=command).write(run.own_capture)
        digests.write()
        run.config.write(own, command)
    else:
        run.move_capture(place)
        cameras = json.loads(run.cameras_file.read_text())
        views = [view | {"file": Path(view["file"]).name} for view in cameras["views"]]
        write_json(run.cameras_file, cameras | {"input_folders": ["."], "views": views})
        own = run.settings()
    asked = RunRequest(capture=place, output=run.path, ortho=False, options=own.capture, **vars(own.method))
    for file in place.rglob("*"):
        set_time(file, -200)
    run.capture_file.touch()
    vdgs("report", run.path)
    assert nothing_to_do(asked, command).startswith("nothing to do")
    photographs[0].unlink()
    assert nothing_to_do(asked, command) == ""


def test_photographs_that_were_renamed_or_removed_before_the_capture_was_made_anew_are_not_missed(
    native_small: NativeRun, tmp_path
):
    """Digests of their former names are kept; one of two copies that was used is missed all the same."""
    place, command = tmp_path / "DCIM", "vdgs run DCIM --output DCIM/run"
    shutil.copytree(native_small.capture / "images", place)
    photographs = sorted(place.iterdir())
    photographs.append(Path(shutil.copy(photographs[0], place / "copy.png")))
    run = RunFolder(shutil.copytree(native_small.whole, place / "run"))
    own = run.settings()
    run.config.write(own, command)
    asked = RunRequest(capture=place, output=run.path, ortho=False, options=own.capture, **vars(own.method))
    vdgs("report", run.path)
    set_time(run.capture_file, 100)

    def make_anew():
        digests = read_digests(run.own_capture)
        files = tuple(SourceFile(file.name, digests.of(file), "") for file in photographs)
        SourceImages(folders=(str(place),), files=files, command=command).write(run.own_capture)
        digests.write()

    make_anew()
    assert nothing_to_do(asked, command).startswith("nothing to do")
    photographs.pop().unlink()
    assert nothing_to_do(asked, command) == ""
    make_anew()
    assert nothing_to_do(asked, command).startswith("nothing to do")
    photographs.append(photographs.pop(0).rename(place / "renamed.png"))
    assert nothing_to_do(asked, command) == ""
    make_anew()
    assert nothing_to_do(asked, command).startswith("nothing to do")


def test_a_folder_that_an_option_names_is_looked_at_with_all_below(tmp_path):
    place, mask = tmp_path / "place", tmp_path / "masks" / "below" / "new.png"
    place.mkdir()
    mask.parent.mkdir(parents=True)
    mask.touch()
    set_time(mask, 100)
    request = RunRequest(
        capture=place, output=tmp_path / "run", options=CaptureOptions(masks=str(tmp_path / "masks"))
    )  # fmt: skip
    assert max(_input_times(request, ())) == mask.stat().st_mtime_ns


def test_settings_that_the_coarse_stage_leaves_as_they_are_are_named(native_small: NativeRun, tmp_path, capsys):
    run, file = shutil.copytree(native_small.whole, tmp_path / "run"), tmp_path / "five.yaml"
    file.write_text("partition: {blocks: 5}\nblock: {iterations: 77}\n")
    before = (run / "config.yaml").read_text()
    again = ("train-coarse", native_small.capture, "--output", run)
    vdgs(*again, "--config", file)
    said = " ".join(capsys.readouterr().out.split())
    assert "keeps its settings of later stages (--block.iterations: 10 -> 77, --blocks: 2 -> 5): `vdgs run`" in said
    vdgs(*again)
    assert "later stages" not in capsys.readouterr().out
    assert (run / "config.yaml").read_text() == before
