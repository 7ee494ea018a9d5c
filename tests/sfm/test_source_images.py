"""A run of photographs is one run: its status names the step, and photographs that are others than before."""

from __future__ import annotations

import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from support.next_commands import next_commands
from vdgs.captures.reconstruction import PROGRESS_FILE, RECONSTRUCTION_FILE, STEPS_FILE, WORK_FOLDER, read_digests
from vdgs.cli.main import main
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig
from vdgs.errors import RunError, VdgsError
from vdgs.report.status_cli import EXIT_INCOMPLETE, full_run_status, next_line, status_json
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.sfm.reconstruction_plan import check_output_folder
from vdgs.sfm.run_request import make_sfm_request
from vdgs.sfm.source_images import SourceImages, check_unchanged
from vdgs.system.atomic_files import write_json
from vdgs.system.content_digests import ContentDigests


@pytest.fixture
def card(tmp_path) -> Path:
    folder = tmp_path / "memory card; $HOME"
    folder.mkdir()
    for k in range(6):
        (folder / f"DJI_{k}.jpg").write_bytes(bytes(100 + k))
    return folder


@pytest.fixture
def run(tmp_path, card) -> RunFolder:
    """A run whose photographs are being searched for features."""
    run = RunFolder(tmp_path / "my run")
    command = shlex.join(["vdgs", "run", str(card), "--output", str(run.path), "--preset", "laptop"])
    digests = read_digests(run.own_capture)
    SourceImages.of([card], digests, command).write(run.own_capture)
    digests.write()
    write_json(run.own_capture / WORK_FOLDER / STEPS_FILE, {"begun": {"features": "1"}, "done": {}})
    progress = {"stage": "photographs", "step": "features", "unit": "photographs", "done": 2, "total": 6}
    times = {"seconds_left": 40.0, "later_seconds": 140.0}
    write_json(run.own_capture / WORK_FOLDER / PROGRESS_FILE, progress | times)
    return run


def finish(run: RunFolder) -> None:
    write_json(run.own_capture / STEPS_FILE, {"begun": {}, "done": {"placed": "1"}})
    write_json(run.own_capture / RECONSTRUCTION_FILE, {})


def change(card: Path) -> None:
    (card / "DJI_9.jpg").write_bytes(b"new")
    (card / "DJI_0.jpg").unlink()
    (card / "DJI_3.jpg").write_bytes(b"other")


def test_status_follows_the_photographs_before_there_is_a_capture(run, capsys):
    with run.drive_lock():
        with pytest.raises(SystemExit) as ended:
            main(["status", str(run.path)])
        assert ended.value.code == EXIT_INCOMPLETE
        assert "features: 2 of 6 photographs" in " ".join(capsys.readouterr().out.split())
        status = full_run_status(run)
        step = status.of("photographs").step
        assert status.of("photographs").state == "running"
        assert step.text() == "features: 2 of 6 photographs, about 40 s left, 3 min with the steps after it"
        assert next_line(status) == "at work: nothing to type"
        stage = status_json(run)["stages"][0]
        assert (stage["step"], stage["iteration"], stage["iterations"], stage["seconds_left"]) == ("features", 2, 6, 40)
    status = full_run_status(run)
    assert status.of("photographs").state == "stopped"
    assert status.of("coarse").state == "missing"
    assert next_commands(next_line(status)) == [SourceImages.read(run.own_capture).command]


def test_photographs_that_are_others_than_before_are_named_with_the_remedy(run, card):
    finish(run)
    assert full_run_status(run).of("photographs").state == "done"
    change(card)
    status = full_run_status(run)
    assert status.of("photographs").state == "stale"
    named = "photographs: 1 added (DJI_9.jpg), 1 removed (DJI_0.jpg), 1 changed (DJI_3.jpg)"
    assert status.of("photographs").reason == named
    (command,) = next_commands(next_line(status))
    assert command.endswith(" --overwrite")
    now = SourceImages.of([card], read_digests(run.own_capture))
    with pytest.raises(VdgsError, match=r"1 added \(DJI_9\.jpg\).*--overwrite"):
        check_unchanged(run.own_capture, now, overwrite=False)
    check_unchanged(run.own_capture, now, overwrite=True)
    for name in card.iterdir():
        name.unlink()
    card.rmdir()  # the card was taken out: that says nothing
    assert full_run_status(run).of("photographs").state == "done"


def test_photographs_that_were_copied_or_touched_are_the_same(run, card, tmp_path):
    finish(run)
    for file in card.iterdir():
        os.utime(file, (1, 1))
    assert full_run_status(run).of("photographs").state == "done"
    copied = Path(shutil.copytree(card, tmp_path / "from the backup"))
    check_unchanged(run.own_capture, SourceImages.of([copied], read_digests(run.own_capture)), overwrite=False)
    file = copied / "DJI_3.jpg"
    file.write_bytes(bytes(50) + b"1" + bytes(52))  # as many bytes as before
    with pytest.raises(VdgsError, match=r"1 changed \(DJI_3\.jpg\)"):
        check_unchanged(run.own_capture, SourceImages.of([copied], read_digests(run.own_capture)), overwrite=False)


def test_what_cannot_be_read_says_nothing_of_changes(run, card):
    digests = read_digests(run.own_capture)
    before = SourceImages.read(run.own_capture)
    unknown = replace(before, files=tuple(replace(each, digest="") for each in before.files))
    assert SourceImages.of([card], digests).changes_since(unknown) == ""
    assert unknown.changes_since(before) == ""


def test_a_folder_with_nothing_but_digests_is_one_of_a_run_that_was_ended_early(tmp_path):
    (tmp_path / "digests.json").write_text("{}")
    check_output_folder(tmp_path)
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(VdgsError, match="holds other things"):
        check_output_folder(tmp_path)


def test_a_file_is_read_again_only_where_its_size_or_time_is_another(card, tmp_path, monkeypatch):
    record, files = tmp_path / "digests.json", sorted(card.iterdir())
    first = ContentDigests.read(record)
    found = first.of_all(files)
    assert len(set(found.values())) == len(files)
    first.write()
    os.utime(files[0], (1, 1))
    read, opened = list[Path](), Path.open
    monkeypatch.setattr(Path, "open", lambda path, *args, **named: (read.append(path), opened(path, *args, **named))[1])
    again = ContentDigests.read(record)
    assert again.of_all(files) == found
    assert [path for path in read if path in files] == files[:1]
    assert again.of(tmp_path / "none.jpg") == ""
    read.clear()
    assert len(ContentDigests.read(tmp_path / "other.json").of_all(files[:1] * 6)) == 1
    assert read.count(files[0]) == 1


def test_a_run_of_another_capture_has_no_photographs(run, tmp_path):
    finish(run)
    run.create_or_check(RunSettings.create(tmp_path / "elsewhere", CaptureOptions(), MethodConfig()))
    with pytest.raises(KeyError):
        full_run_status(run).of("photographs")


def test_what_the_capture_will_not_have_is_refused_before_the_work(card, tmp_path):
    request = RunRequest(capture=card, output=tmp_path / "new")
    made = make_sfm_request(replace(request, options=CaptureOptions(images="images_4/")))
    assert made.output == tmp_path / "new" / "capture"
    for options, said in (
        (CaptureOptions(images="images_3000"), "images_3000: the capture made of photographs has images, images_2"),
        (CaptureOptions(images="quarter"), "--images quarter"),
        (CaptureOptions(test_list=tmp_path / "none.txt"), "no such file"),
        (CaptureOptions(split="explicit"), "--split explicit"),
        (CaptureOptions(format="transforms"), "--format transforms"),
    ):
        with pytest.raises(VdgsError, match=said):
            make_sfm_request(replace(request, options=options))


def test_training_on_another_capture_is_deleted(run):
    write_json(run.capture_file, {})
    write_json(run.coarse.path / "checkpoints" / "1.json", {})
    assert run.is_trained
    with run.drive_lock(), pytest.raises(RunError), run.drive_lock():
        pass
    run.discard_training()
    assert not run.is_trained
    assert not run.coarse.has_output()
