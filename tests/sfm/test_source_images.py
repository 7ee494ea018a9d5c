"""A run of photographs is one run: its status names the step, and photographs that are others than before."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.next_commands import next_commands
from vdgs.captures.reconstruction import PROGRESS_FILE, RECONSTRUCTION_FILE, STEPS_FILE, WORK_FOLDER, read_digests
from vdgs.cli.main import main
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import RunError, VdgsError
from vdgs.report.status_cli import EXIT_INCOMPLETE, full_run_status, next_line, status_json
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.sfm import reconstruct, workspace
from vdgs.sfm.discarding import check_trained_on_this, run_of_capture
from vdgs.sfm.image_list import collect_images
from vdgs.sfm.reconstruction_plan import check_output_folder
from vdgs.sfm.run_request import make_sfm_request
from vdgs.sfm.source_images import SourceImages, check_unchanged, source_changes
from vdgs.sfm.workspace import Workspace
from vdgs.system.atomic_files import write_json
from vdgs.system.content_digests import ContentDigests, find_copies
from vdgs.system.quoting import shell_line


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


def test_folders_in_another_order_are_told(card, tmp_path):
    """Where folders have one name, numbers in their order tell their photographs apart."""
    second = shutil.copytree(card, tmp_path / "second" / card.name)
    (second / "DJI_3.jpg").write_bytes(b"another")
    digests, output = ContentDigests(tmp_path / "digests.json"), tmp_path / "capture"
    SourceImages.of([card, second], digests).write(output)
    swapped = SourceImages.of([second, card], digests)
    as_before = re.escape(shell_line([card, second]))
    with pytest.raises(VdgsError, match=rf"in another order.*as before \({as_before}\)"):
        check_unchanged(output, swapped, overwrite=False)
    check_unchanged(output, swapped, overwrite=True)


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


def test_files_of_one_length_and_the_same_ends_are_no_copies(tmp_path):
    """Pictures without compression all have one length, and often the same border."""
    files = [tmp_path / f"{k}.bmp" for k in range(5)]
    for file, middle in zip(files, (b"a", b"b", b"a", b"a", b"ab"), strict=True):
        file.write_bytes(bytes(1 << 20) + middle + bytes(1 << 20))
    assert find_copies(files) == [[0, 2, 3]]
    assert find_copies([]) == []
    white = tmp_path / "renders"
    white.mkdir()
    for k in range(5):
        picture = np.full((400, 400, 3), 255, np.uint8)
        cv2.circle(picture, (100 + 50 * min(k, 3), 200), 60, (0, 90, 200), -1)
        cv2.imwrite(str(white / f"{k}.bmp"), picture)
    found = collect_images([white])
    assert [photo.name for photo in found.images] == ["0.bmp", "1.bmp", "2.bmp", "3.bmp"]
    assert [each.line for each in found.excluded] == ["4.bmp: is a copy of 3.bmp"]


@pytest.mark.parametrize("beside", [True, False])
def test_masks_that_are_others_than_before_are_named(tmp_path, beside):
    """Masks beside the given folder of photographs, and in it."""
    card, output, digests = tmp_path / "card", tmp_path / "capture", ContentDigests(tmp_path / "digests.json")
    given = card / "images" if beside else card
    for k in range(3):
        for folder in ("images", "masks"):
            (card / folder).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(card / f"{folder}/{k}.png"), np.full((120, 160, 3), 50 * k, np.uint8))
    before = SourceImages.of([given], digests)
    before.write(output)
    assert SourceImages.read(output) == before
    assert source_changes(output) == ""
    cv2.imwrite(str(card / "masks/1.png"), np.zeros((120, 160), np.uint8))
    (card / "masks/2.png").unlink()
    named = (
        "photographs: 2 with another mask, or without (1.png, 2.png)"
        if beside
        else "photographs: 1 mask removed (masks/2.png), 1 mask changed (masks/1.png)"
    )
    assert source_changes(output) == named
    with pytest.raises(VdgsError, match="begun with other photographs"):
        check_unchanged(output, SourceImages.of([given], digests), overwrite=False)
    old = replace(before, files=tuple(replace(each, mask=None) for each in before.files))
    if beside:  # records of before said nothing of these
        assert SourceImages.of([given], digests).changes_since(old) == ""
        assert before.changes_since(old) == old.changes_since(before) == ""


def test_what_another_version_finished_stays_and_what_it_began_is_begun_anew(tmp_path, monkeypatch):
    """After an upgrade a capture is as good as before, and parts that two versions made are not mixed."""
    output = Workspace(tmp_path)
    output.begin("capture", "key")
    output.finish("capture", "key")
    output.begin("placed", "key")
    monkeypatch.setattr(workspace, "_VERSION", " by vdgs 99.0")
    assert output.is_done("capture", "key")
    assert not output.is_begun("placed", "key")
    assert output.is_begun_by_any("placed", "key")
    assert not output.is_begun_by_any("placed", "other")
    assert not output.is_begun_by_any("model", "key")
    output.begin("placed", "key")
    assert output.is_begun("placed", "key")


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


def test_a_trained_capture_in_its_run_is_not_made_otherwise_without_a_word(run):
    """By another command, such as `vdgs sfm --output RUN/capture`."""
    capture, elsewhere = run.own_capture, run.path.parent / "elsewhere" / "capture"
    assert run_of_capture(capture) is None  # no settings yet: the photographs come first
    run.config_file.write_text("vdgs:\n")
    assert run_of_capture(capture) == run
    assert run_of_capture(elsewhere) is run_of_capture(run.path) is None
    request = SfmRequest(image_folders=(), output=capture)
    for folder in (capture, run.path):
        (folder / RECONSTRUCTION_FILE).write_text("{}")
    run.capture_file.touch()
    check_trained_on_this(request, run)
    (capture / RECONSTRUCTION_FILE).write_text('{"placed": "elsewhere"}')
    with pytest.raises(RunError, match="placed anew since the run was trained"):
        check_trained_on_this(request, run)
    check_trained_on_this(replace(request, overwrite=True), run)
    assert not run.is_trained
    check_trained_on_this(request, run)


def test_sfm_in_a_run_is_for_this_run(run, card, monkeypatch):
    """So that it refuses to change what the run was trained on."""
    asked = list[RunFolder | None]()
    monkeypatch.setattr(reconstruct, "reconstruct", lambda _request, _console, of_run: asked.append(of_run))
    run.config_file.write_text("vdgs:\n")
    for output in (run.own_capture, run.path.parent / "another"):
        with pytest.raises(SystemExit) as ended:
            main(["sfm", str(card), "--output", str(output)])
        assert ended.value.code == 0
    assert asked == [run, None]
