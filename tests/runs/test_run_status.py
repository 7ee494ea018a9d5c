"""How far a run is: every stage is judged by the settings it was made with, and all that shows results agrees."""

from __future__ import annotations

import errno
import fcntl
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml

from support.hand_made_models import model_at
from support.next_commands import next_commands
from vdgs.captures.capture import Capture
from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import main
from vdgs.cli.run_cmd import RunArguments
from vdgs.cli.start_settings import start_settings
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MergeConfig, MethodConfig
from vdgs.config.presets import PRESETS
from vdgs.errors import RunError
from vdgs.model.anchor_model import ModelMetadata
from vdgs.report.status_cli import EXIT_INCOMPLETE, full_run_status, next_line, status_json
from vdgs.report.write_report import write_report
from vdgs.runs.model_integrity import load_verified, map_verified
from vdgs.runs.open_run import locate_model, open_model, open_run
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.run_status import OTHER_BLOCKS, OTHER_MODEL, OTHER_PARTITION, OTHER_SETTINGS, get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.system.file_locks import is_locked, lock_folder
from vdgs.system.quoting import shell_line, shell_word
from vdgs.system.step_progress import StepRecord, read_step
from vdgs.system.tensors import file_id

pytestmark = pytest.mark.slow

PLACES = [[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]
COMMAND = "vdgs run here --output there"


def trained(folder, key: str, seed: int, block: int | None = None) -> str:
    """A finished stage with a model of its own; what tells the model from others."""
    folder.reset_unless(key)
    replace(model_at(PLACES, seed), metadata=ModelMetadata(key=key, block=block)).save(folder.model)
    folder.set_status(
        StatusRecord(state="done", iteration=40, iterations=40, anchors=2, seconds=3.0, model_id=file_id(folder.model))
    )
    return file_id(folder.model)


def measured(folder: Path, model: str, psnr: float, name: str) -> None:
    write_json(folder / "metrics.json", {"model": name, "psnr": psnr, "ssim": 0.5})
    write_json(folder / "per_view.json", [{"name": f"{name}.jpg", "psnr": psnr}])
    write_json(folder / "status.json", {"model": model, "lpips_weights": "None", "bins": 4})


@pytest.fixture
def run(tmp_path) -> RunFolder:
    """A whole run of two blocks, by hand, with its report."""
    run = RunFolder(tmp_path / "run")
    (tmp_path / "place").mkdir()
    run.create_or_check(RunSettings.create(tmp_path / "place", CaptureOptions(), MethodConfig()), command=COMMAND)
    coarse = trained(run.coarse, run.keys().coarse, 0)
    measured(run.coarse.path / "evaluation", coarse, 21.25, "coarse")
    keys = run.keys()
    write_json(run.visibility / "visibility.json", {"key": keys.visibility, "anchors": 2})
    zeros = dict.fromkeys(("cameras", "above_threshold", "best_block", "topped_up", "anchors_core"), 3)
    rows = [{"block": i, **zeros, "anchors_expanded": 4, "mean_v": 1.0, "std_v": 0.5, "area": 2.0} for i in (0, 1)]
    record = {"key": keys.partition, "assignment_key": keys.assignment, "lambda_vis": 1.0, "blocks": rows}
    write_json(run.partition / "partition.json", record)
    models = [trained(run.block(index), keys.blocks, 1 + index, block=index) for index in (0, 1)]
    merged = trained(run.merged, keys.merge, 5)
    write_json(run.merged.status_file, {"state": "done", "model_id": merged, "block_models": models, "anchors": 2})
    measured(run.evaluation, merged, 24.75, "merged")
    write_report(run)
    return run


def states(run: RunFolder) -> dict[str, str]:
    return {stage.name: stage.state for stage in full_run_status(run).stages if stage.state != "done"}


def change(run: RunFolder, section: str, **settings: object) -> None:
    """Edit config.yaml by hand."""
    config = yaml.safe_load(run.config_file.read_text())
    config[section].update(settings)
    run.config_file.write_text(yaml.safe_dump(config))


def command_line(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_a_whole_run_is_whole(run, capsys):
    assert states(run) == {}
    assert command_line("status", run.path) == 0
    said = capsys.readouterr().out
    assert "10 done" in said
    assert f"report: {run.path / 'report.html'}" in said
    assert next_commands(said) == [f"vdgs view {shell_word(run.path)}"]


@pytest.mark.parametrize(
    ("section", "setting", "stale", "then"),
    [
        ("merge", {"rule": "max-visibility"}, ["merge", "evaluation"], "merge"),
        ("block", {"iterations": 7}, ["block 0", "block 1", "merge", "evaluation"], "train-blocks"),
        ("assignment", {"tau": 0.3}, ["cameras", "block 0", "block 1", "merge", "evaluation"], "partition"),
        ("partition", {"lambda_vis": 0.9}, ["partition", "cameras", "block 0", "block 1", "merge", "evaluation"],
         "partition"),
    ],
)  # fmt: skip
def test_what_other_settings_make_out_of_date_is_shown_nowhere_as_done(run, section, setting, stale, then, capsys):
    change(run, section, **setting)
    assert states(run) == dict.fromkeys([*stale, "report"], "stale")
    assert command_line("status", run.path) == EXIT_INCOMPLETE
    assert f"next: vdgs {then} {shell_word(run.path)}" in capsys.readouterr().out
    page = write_report(run).read_text()
    assert "24.75" not in page  # of the merged model
    assert "merged.jpg" not in page
    assert "Coarse model: PSNR 21.25 dB" in page
    assert f"evaluation: {OTHER_MODEL}; it is left out" in page
    assert (f"out of date: {OTHER_PARTITION}" in page) == ("block 0" in stale)
    assert states(run) == dict.fromkeys(stale, "stale")  # but the report, which says so


def test_other_settings_of_the_coarse_stage_leave_nothing(run):
    change(run, "training", seed=4)
    assert set(states(run)) == {stage.name for stage in full_run_status(run).stages}
    assert get_run_status(run).next_command() == COMMAND
    assert "Nothing is evaluated yet." in write_report(run).read_text()


def test_a_coarse_model_trained_again_makes_all_that_was_built_on_it_out_of_date(run):
    trained(run.coarse, run.keys().coarse, seed=9)
    assert [stage.name for stage in get_run_status(run).stages if stage.state == "done"] == ["coarse"]


def test_a_block_trained_again_makes_the_merged_model_out_of_date(run):
    trained(run.block(1), run.keys().blocks, seed=9, block=1)
    standing = get_run_status(run)
    assert (standing.of("merge").state, standing.of("merge").reason) == ("stale", OTHER_BLOCKS)
    assert standing.of("evaluation").state == "stale"
    assert standing.next_command() == COMMAND  # which merges and measures again


def test_figures_of_another_model_are_out_of_date(run):
    measured(run.evaluation, "12-abc", 30.5, "merged")
    assert states(run) == {"evaluation": "stale", "report": "stale"}
    assert "30.5" not in write_report(run).read_text()


def test_figures_that_nothing_vouches_for_are_shown_with_a_caution(run):
    (run.evaluation / "status.json").unlink()
    assert states(run) == {"evaluation": "unknown", "report": "stale"}
    page = write_report(run).read_text()
    assert "24.75" in page
    assert "It cannot be told whether these were made with the settings of the run: evaluation" in page


def test_what_fails_and_stops_is_said_with_its_reason(run):
    run.block(0).set_status(
        StatusRecord(state="failed", iteration=7, iterations=40, reason="out of memory\nmore of it")
    )
    run.block(1).set_status(StatusRecord(state="running", iteration=9, iterations=40))
    standing = get_run_status(run)
    assert (standing.of("block 0").state, standing.of("block 0").reason) == ("failed", "out of memory")
    assert standing.of("block 1").state == "stopped"  # no process works on it
    assert standing.next_command() == COMMAND  # which takes it to its end
    with run.block(1).locked():
        assert is_locked(run.block(1).path)
        standing = get_run_status(run)
        assert standing.of("block 1").state == "running"
        assert standing.next_command() == ""
        assert "at work" in next_line(standing)


def test_a_run_is_at_work_between_two_stages_too(run):
    run.merged.model.unlink()
    with run.drive_lock():
        assert next_line(full_run_status(run)) == "at work: nothing to type"
        with pytest.raises(RunError, match="another vdgs process"), run.drive_lock():
            pass


def test_looking_changes_nothing_and_survives_damage(run):
    run.coarse.status_file.write_text('{"state": ')
    (run.partition / "partition.json").write_text("[")
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    standing = get_run_status(run)
    assert {standing.of(name).state for name in ("coarse", "partition", "block 0", "merge")} == {"unknown"}
    assert {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_run_is_read_where_no_file_can_be_locked(run, monkeypatch, capsys, number):
    """Lustre without `-o flock`, some of FUSE: finished runs are looked at there, and nothing works on one."""
    run.block(1).set_status(StatusRecord(state="running", iteration=9, iterations=40))
    for folder in (run.block(1).path, run.path / ".run"):
        with lock_folder(folder):
            pass

    def refuse(*_: object) -> None:
        raise OSError(number, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert get_run_status(run).of("block 1").state == "stopped"
    assert not run.is_running()
    assert command_line("status", run.path) == EXIT_INCOMPLETE
    assert command_line("report", run.path) == 0
    assert open_model(run, "coarse").name == "coarse"
    with pytest.raises(OSError, match="not implemented"):
        is_locked(run.path / ".run")
    for held in (run.drive_lock(), run.locked()):
        with pytest.raises(RunError, match=r"file system locks no files \(Function not implemented\)\. Mount"), held:
            pass


def test_a_folder_without_a_run_is_an_error(tmp_path, capsys):
    assert command_line("status", tmp_path / "nowhere") == 1
    assert "is not a run folder" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()


def test_programs_read_the_same(run, capsys):
    change(run, "merge", rule="max-visibility")
    assert command_line("status", run.path, "--json") == EXIT_INCOMPLETE
    facts = json.loads(capsys.readouterr().out)
    assert not facts["complete"]
    assert facts["next_command"] == f"vdgs merge {shell_word(run.path)}"
    assert {row["stage"]: row["state"] for row in facts["stages"]}["merge"] == "stale"


def test_models_that_were_copied_to_where_they_do_not_belong_are_refused(run):
    key, zero, one = run.keys().blocks, run.block(0), run.block(1)
    assert len(load_verified(zero, key, 0).anchors) == len(PLACES)
    own, other = zero.model.read_bytes(), one.model.read_bytes()
    zero.model.write_bytes(other)
    with pytest.raises(RunError, match=r"is the model of block 1\. Put back .* or delete"):
        load_verified(zero, key, 0)
    assert get_run_status(run).of("block 0").state == "stale"
    assert next_commands(next_line(get_run_status(run))) == [
        shell_line(["rm", "-r", zero.path]),
        shell_line(["vdgs", "train-blocks", run.path]),
    ]
    zero.model.write_bytes(own)
    model = model_at(PLACES, seed=8)  # of the right block, but not what was trained here
    replace(model, metadata=ModelMetadata(key=key, block=0)).save(zero.model)
    with pytest.raises(RunError, match=r"not the model that status\.json beside it speaks of"):
        load_verified(zero, key, 0)
    with pytest.raises(RunError, match="of other settings or of another run"):
        load_verified(one, "0123", 1)
    with pytest.raises(RunError, match="a model of the whole scene"):
        load_verified(run.merged, run.keys().merge, 0)


#: What the system answers where a model is not to be read, and what is to be done then.
REFUSALS = [
    (PermissionError(errno.EACCES, "Permission denied"), "Allow it: chmod +r"),
    (OSError(errno.ESTALE, "Stale file handle"), "See to its disk"),
    (OSError(errno.EIO, "Input/output error"), "See to its disk"),
]


@pytest.fixture
def refuse(monkeypatch):
    """Lets the system answer so where a file is opened."""
    opened, refused = Path.open, dict[Path, OSError]()

    def open_or_refuse(path, *arguments, **others):
        if path in refused:
            raise refused[path]
        return opened(path, *arguments, **others)

    monkeypatch.setattr(Path, "open", open_or_refuse)
    return refused.__setitem__


@pytest.mark.parametrize(("error", "remedy"), REFUSALS)
@pytest.mark.parametrize("stage", ["coarse", "block 0", "merge"])
def test_a_model_that_cannot_be_read_puts_nothing_out_of_date(run, refuse, stage, error, remedy):
    """Nothing says that it is another one; what was made of it stands as its record says."""
    model = {"coarse": run.coarse, "block 0": run.block(0), "merge": run.merged}[stage].model
    refuse(model, error)
    assert states(run) == {stage: "unknown"}
    status, facts = get_run_status(run), status_json(run)
    assert status.next_command() == ""
    assert next_line(status).startswith(f"to mend: {model}: cannot be read ({error.strerror}). {remedy}")
    assert (facts["next_command"], facts["problem"]) == (None, status.problem)
    warning = locate_model(run).warning
    assert "gain" not in warning
    assert (str(model) in warning) == (stage == "merge")


@pytest.mark.parametrize(("error", "remedy"), REFUSALS)
def test_a_model_that_cannot_be_read_is_named_and_not_to_be_deleted(run, refuse, error, remedy):
    refuse(run.merged.model, error)
    for read in (load_verified, map_verified):
        with pytest.raises(RunError) as raised:
            read(run.merged, run.keys().merge)
        said = str(raised.value)
        assert said.startswith(f"{run.merged.model}: cannot be read ({error.strerror}). {remedy}")
        assert "elete" not in said


def test_a_run_that_can_be_read_has_no_problem(run):
    assert status_json(run)["problem"] is None


@pytest.fixture
def opened_without_photographs(monkeypatch):
    monkeypatch.setattr("vdgs.runs.open_run.open_capture", lambda run: Mock(Capture, test_views=(), train_views=()))
    monkeypatch.setattr("vdgs.runs.open_run.check_same_capture", lambda *_: None)


def test_the_model_that_is_opened_says_what_it_is(run, opened_without_photographs):
    opened = open_run(run.path)
    assert (opened.name, opened.warning) == ("merged", "")
    assert opened.summary.startswith("merged model (2 anchors, ")
    change(run, "partition", lambda_vis=0.9)
    opened = open_run(run.path)
    assert opened.name == "coarse"
    assert f"this is the coarse model, not the merged one: there is one that was {OTHER_SETTINGS}" in opened.warning
    assert f"vdgs partition {shell_word(run.path)}" in opened.warning
    assert open_run(run.path, "coarse").warning == ""  # as was asked for
    with pytest.raises(RunError, match=f"no merged model of its settings yet .*{OTHER_SETTINGS}.*vdgs partition"):
        open_run(run.path, "merged")
    change(run, "partition", lambda_vis=1.0)
    run.merged.model.unlink()
    assert "there is none yet" in open_run(run.path).warning


def test_a_merged_model_of_other_blocks_is_opened_with_a_caution(run, opened_without_photographs):
    trained(run.block(1), run.keys().blocks, seed=9, block=1)
    opened = open_run(run.path)
    assert opened.name == "merged"
    assert OTHER_BLOCKS in opened.warning
    assert f"vdgs merge {shell_word(run.path)}" in opened.warning


def test_the_command_that_began_a_run_is_advised_while_the_settings_are_its_own(run):
    run.merged.model.unlink()
    assert get_run_status(run).next_command() == COMMAND
    other = replace(run.settings(), merge=MergeConfig("max-visibility"))
    run.change_settings(other, overwrite=True)
    assert run.config.command() is None
    assert get_run_status(run).next_command() == f"vdgs merge {shell_word(run.path)}"
    run.change_settings(replace(run.settings(), merge=MergeConfig()), overwrite=True, command="vdgs run anew")
    assert get_run_status(run).next_command() == "vdgs run anew"


def test_a_copy_of_a_run_is_not_continued_where_the_run_lies(run, tmp_path):
    run.config.write(run.settings(), f"vdgs run place --output {shell_word(run.path)}")
    assert run.config.command() is not None
    copy = RunFolder(tmp_path / "a copy")
    shutil.copytree(run.path, copy.path)
    assert copy.config.command() is None


def test_settings_that_cannot_be_read_are_to_be_mended(run):
    run.config_file.write_text(run.config_file.read_text().replace("iterations: ", "iterations: many #", 1))
    assert get_run_status(run).next_command() == ""
    assert next_line(get_run_status(run)).startswith(f"to mend: correct {run.config_file}")


@pytest.mark.parametrize(
    "changed", [{}, {"partition": {"lambda_vis": 0.3, "blocks": 3}}, {"block": {"draw_outside": False}}]
)
def test_a_run_without_its_command_is_continued_with_its_settings(tmp_path, changed):
    """The options name the settings, whatever shell characters the folders have."""
    run = RunFolder(tmp_path / "it's a run; $HOME")
    method = PRESETS["laptop"]
    method = replace(method, **{name: replace(getattr(method, name), **new) for name, new in changed.items()})
    options = CaptureOptions(images="images_4", test_every=5)
    (tmp_path / "a capture").mkdir()
    run.create_or_check(RunSettings.create(tmp_path / "a capture", options, method))
    line = next_line(get_run_status(run))
    (command,) = next_commands(line)
    words = shlex.split(command)
    assert words[:5] == ["vdgs", "run", str(tmp_path / "a capture"), "--output", str(run.path)]
    given = parse_words(RunArguments, words[2:])
    parsed = given.over(start_settings(given).layer())
    assert (parsed.method(), parsed.options) == (method, options)


def test_what_the_driver_works_on_is_shown_as_running(run, capsys):
    (run.evaluation / "metrics.json").unlink()
    write_json(run.progress_file, {"stage": "evaluation", "step": "test views", "done": 3, "total": 12})
    assert states(run)["evaluation"] == "missing"  # nobody works on it
    with run.drive_lock():
        assert states(run)["evaluation"] == "running"
        assert command_line("status", run.path) == EXIT_INCOMPLETE
    assert "test views: 3 of 12" in capsys.readouterr().out


def test_only_the_driver_of_a_run_records_its_steps(run):
    run.begin_step("report", "maps", "tiles", 9)
    assert not run.progress_file.exists()
    with run.drive_lock():
        RunFolder(run.path).begin_step("report", "maps", "tiles", 9)
    run.begin_step("evaluation", "test views", "", 4)
    assert read_step(run.progress_file) == StepRecord(stage="report", step="maps", unit="tiles", total=9)


def test_a_status_file_that_is_damaged_is_deleted_first(run):
    run.block(1).status_file.write_text("{}")
    commands = next_commands(next_line(get_run_status(run)))
    assert commands == [shell_line(["rm", run.block(1).status_file]), shell_line(["vdgs", "train-blocks", run.path])]


@pytest.mark.parametrize("content", ["", "[1, 2"])
def test_figures_that_are_damaged_are_not_there(run, content):
    (run.evaluation / "metrics.json").write_text(content)
    assert states(run)["evaluation"] == "missing"


def test_the_file_that_is_damaged_is_the_one_to_mend(run):
    run.coarse.status_file.write_text("[]")
    assert get_run_status(run).problem.startswith(f"{run.coarse.status_file}: is damaged")


def test_work_goes_on_where_its_progress_cannot_be_noted(run):
    run.progress_file.mkdir(parents=True)
    progress = run.begin_step("report", "maps", "tiles", 2)
    assert [progress(done).done for done in (1, 2)] == [1, 2]
