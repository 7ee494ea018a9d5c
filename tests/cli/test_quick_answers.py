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
from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import COMMANDS, main, verb_arguments
from vdgs.config.commands import RunRequest
from vdgs.config.method import MergeConfig
from vdgs.pipeline.finished_run import nothing_to_do
from vdgs.report.status_cli import full_run_status
from vdgs.runs.open_run import open_capture
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_inputs import are_inputs_unchanged, note_inputs
from vdgs.system.similar_paths import suggest_path

pytestmark = [pytest.mark.xdist_group("quick_answers"), pytest.mark.slow]

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


def request_of(run: Path, capture: Path) -> RunRequest:
    """The command that made a run of a capture, without maps."""
    own = RunFolder(run).settings()
    return RunRequest(capture=capture, output=run, ortho=False, options=own.capture, **vars(own.method))


def note(asked: RunRequest, began_ns: int | None = None) -> None:
    """Record of what the run of a request is made, as the command does once it has read that."""
    run = RunFolder(asked.output)
    note_inputs(run, asked, open_capture(run), time.time_ns() if began_ns is None else began_ns)


def test_a_finished_run_is_answered_at_once(native_small: NativeRun, tmp_path):
    run = shutil.copytree(native_small.whole, tmp_path / "run")
    vdgs("report", run)
    note(request_of(run, native_small.capture))
    again = ("run", native_small.capture, "--output", run, "--no-ortho")
    answers = answers_of(tmp_path, again, ("status", run))
    assert answers[0][1].startswith(f"nothing to do: {run} is whole\n")
    for code, out, _ in answers:
        assert code == 0
        assert "next: " in out


def test_a_run_is_looked_at_closely_where_anything_differs(native_small: NativeRun, tmp_path):
    run = shutil.copytree(native_small.whole, tmp_path / "run")
    own, asked = RunFolder(run).settings(), request_of(run, native_small.capture)
    note(asked)
    assert nothing_to_do(asked, "") == ""  # without a report
    vdgs("report", run)
    assert nothing_to_do(asked, "").startswith("nothing to do")
    others = (
        replace(asked, visibility_bins=5),
        replace(asked, capture=tmp_path),
        replace(asked, options=replace(own.capture, downscale=2.0)),
        replace(asked, merge=MergeConfig(rule="max-visibility")),
        replace(asked, output=tmp_path / "new"),
    )
    assert [nothing_to_do(other, "") for other in others] == [""] * len(others)
    bars = tmp_path / "bars.txt"
    bars.touch()
    options = replace(own.capture, scale_bar=bars)  # of photographs: the capture that was made of them has it already
    of_photographs = replace(asked, capture=native_small.capture / "images", options=options)
    RunFolder(run).config.write(own, "vdgs run DCIM")
    note(of_photographs)
    assert nothing_to_do(of_photographs, "vdgs run DCIM").startswith("nothing to do")
    assert nothing_to_do(of_photographs, "vdgs run OTHERS") == ""
    for record in ("{}", '{"named": 1, "files": {}}', "no JSON"):  # nothing says of what the run was made
        (run / "inputs.json").write_text(record)
        assert nothing_to_do(of_photographs, "vdgs run DCIM") == ""


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


def test_ctrl_c_while_modules_are_imported_ends_quietly(monkeypatch, capsys):
    def interrupted(*_args):
        raise KeyboardInterrupt

    monkeypatch.setattr("vdgs.cli.main._run_command", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["status", "R"])
    assert ended.value.code == 130
    assert capsys.readouterr() == ("", "")


def test_choices_are_taken_in_the_letters_of_other_programs():
    given = parse_words(verb_arguments()["sfm"], ["DCIM", "--output", "C", "--camera-model", "SIMPLE_RADIAL"])
    assert "simple-radial" in given.values.values()


def test_a_path_is_suggested_where_a_part_of_it_is_mistyped(tmp_path):
    (tmp_path / "card" / "DCIM").mkdir(parents=True)
    assert suggest_path(tmp_path / "crad" / "DCIM") == f"; did you mean {tmp_path / 'card' / 'DCIM'}?"
    assert suggest_path(tmp_path / "card" / "dcim") == f"; did you mean {tmp_path / 'card' / 'DCIM'}?"
    assert suggest_path(tmp_path / "card" / "quite another") == ""


def put_older(file: Path, content: bytes) -> None:
    """Another file in the place of one, of the same size, written long before the run, as `cp -p` and `rsync -t` put
    it."""
    file.write_bytes(content)
    os.utime(file, ns=(10**18, 10**18))


@pytest.fixture
def whole(native_small: NativeRun, tmp_path: Path) -> RunRequest:
    """A finished run of a capture of its own, of which nothing is recorded."""
    capture = shutil.copytree(native_small.capture, tmp_path / "place")
    run = RunFolder(shutil.copytree(native_small.whole, tmp_path / "run"))
    run.move_capture(capture)
    vdgs("report", run.path)
    return request_of(run.path, capture)


@pytest.mark.parametrize("what", ["photograph", "model", "mask", "added", "gone", "folder"])
def test_what_changed_in_a_capture_is_seen_whatever_its_time(whole, what):
    capture = whole.capture
    (capture / "masks").mkdir()
    photograph = min((capture / "images").iterdir())
    mask = Path(shutil.copy(photograph, capture / "masks" / f"{photograph.stem}.png"))
    note(whole)
    assert nothing_to_do(whole, "").startswith("nothing to do")
    shutil.copytree(capture, capture.with_name("copy"))
    if what == "photograph":
        put_older(photograph, photograph.read_bytes())
    elif what == "model":
        model = capture / "sparse" / "0" / "images.bin"
        put_older(model, model.read_bytes())
    elif what == "mask":
        put_older(mask, mask.read_bytes())
    elif what == "added":
        put_older(capture / "masks" / "another.png", b"")
    elif what == "gone":
        mask.unlink()
    else:  # an older folder in the place of the former one
        capture.rename(capture.with_name("before"))
        capture.with_name("copy").rename(capture)
    assert nothing_to_do(whole, "") == ""


def test_status_tells_what_changed_by_what_it_holds(whole):
    """Of a capture: copies of the same files are no change, nor are files on which no result depends."""
    run, capture = RunFolder(whole.output), whole.capture
    photograph, table = min((capture / "images").iterdir()), capture / "positions.csv"
    table.write_text("name,lat,lon,alt")
    given = replace(whole, options=replace(whole.options, test_list=table))
    note(given)
    assert full_run_status(run).is_complete
    for file in (photograph, table):
        put_older(file, file.read_bytes())
    (capture / "another.png").touch()
    assert full_run_status(run).is_complete
    put_older(table, b"name,lat,lon,ALT")
    photograph.write_bytes(b"")
    (capture / "masks").mkdir()
    (capture / "masks" / "new.png").touch()
    stage = full_run_status(run).stages[0]
    assert (stage.name, stage.state) == ("capture", "stale")
    assert f"changed since the run read its inputs: {photograph.name}, positions.csv" in stage.reason
    assert "masks added since the run read its inputs: new.png" in stage.reason
    capture.rename(capture.with_name("away"))  # as a card that was taken out
    assert "capture" not in [each.name for each in full_run_status(run).stages]


def test_what_changed_after_the_command_began_is_compared_again(whole):
    note(whole, began_ns=0)
    assert nothing_to_do(whole, "") == ""


@pytest.mark.parametrize("option", ["gcp", "scale_bar", "gps"])
def test_tables_that_place_photographs_are_inputs(whole, option):
    """Of a run of photographs, whose settings do not hold them; also one of the same size and of an older time."""
    run, table = RunFolder(whole.output), whole.capture / "table.txt"
    photographs, command = whole.capture / "images", "vdgs run DCIM"
    table.write_text("before")
    if option == "gps":
        asked = replace(whole, capture=photographs, options=replace(whole.options, gps=table))
    else:
        asked = replace(whole, capture=photographs, sfm=replace(whole.sfm, **{option: table}))
    (photographs / "DJI_1.xmp").write_text("here")
    run.config.write(run.settings(), command)
    note(asked)
    assert nothing_to_do(asked, command).startswith("nothing to do")
    put_older(photographs / "DJI_1.xmp", b"far!")  # a sidecar
    assert nothing_to_do(asked, command) == ""
    note(asked)
    assert nothing_to_do(asked, command).startswith("nothing to do")
    put_older(table, b"after!")
    assert nothing_to_do(asked, command) == ""


@pytest.mark.parametrize("where", ["linked folder", "folder of a project"])
def test_photographs_that_lie_elsewhere_are_looked_at_too(whole, tmp_path, where):
    card, run = tmp_path / "card", RunFolder(whole.output)
    shutil.move(whole.capture / "images", card)
    (whole.capture / "images").symlink_to(card)
    (card / "around").symlink_to(tmp_path)
    read = open_capture(run)
    if where == "folder of a project":
        (whole.capture / "images").unlink()
        views = tuple(replace(view, image_path=card / view.image_path.name) for view in read.views)
        read = replace(read, views=views, images=str(card))
    note_inputs(run, whole, read, time.time_ns())
    assert nothing_to_do(whole, "").startswith("nothing to do")
    put_older(next(card.glob("*.png")), b"")
    assert nothing_to_do(whole, "") == ""


def test_a_run_beside_photographs_is_none_of_them(native_small: NativeRun, tmp_path):
    """Neither what stages write, nor another run or a log beside it, is a change of the capture."""
    place = shutil.copytree(native_small.capture, tmp_path / "place")
    run = shutil.copytree(native_small.whole, place / "run")
    RunFolder(run).move_capture(place)
    asked = request_of(run, place)
    note(asked)
    vdgs("report", run)
    shutil.copytree(run, place / "another run")
    (place / "run.log").touch()
    assert nothing_to_do(asked, "").startswith("nothing to do")
    photograph = min((place / "images").iterdir())
    added = Path(shutil.copy2(photograph, place / "added.png"))  # with the time of the file that it is a copy of
    assert nothing_to_do(asked, "") == ""
    added.unlink()
    assert nothing_to_do(asked, "").startswith("nothing to do")
    photograph.rename(place / "renamed.png")
    assert nothing_to_do(asked, "") == ""


def test_what_is_read_beside_a_film_or_a_folder_is_an_input(whole, tmp_path):
    film, table = tmp_path / "DJI_1.MP4", whole.capture / "geo.txt"
    for asked, beside in ((film, tmp_path / "DJI_1.SRT"), (whole.capture / "images", table)):
        film.touch()
        beside.write_text("before")
        request, run = replace(whole, capture=asked), RunFolder(whole.output)
        note(request)
        assert are_inputs_unchanged(run, request)
        put_older(beside, b"after!")
        assert not are_inputs_unchanged(run, request)


def test_a_run_that_was_moved_still_has_its_inputs(whole, tmp_path):
    note(whole)
    moved = whole.output.rename(tmp_path / "moved")
    assert are_inputs_unchanged(RunFolder(moved), replace(whole, output=moved))


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
