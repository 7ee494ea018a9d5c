"""Flights of several folders and cameras, in parts, on full disks, and stopped at every step."""

from __future__ import annotations

import errno
import io
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

pytest.importorskip("embreex")
import pycolmap

from support.flights import ORIGIN, Flight, copy_folder, write_photograph
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import ReconstructionReport, read_reconstruction
from vdgs.config.commands import RunRequest
from vdgs.config.presets import PRESETS
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.pipeline.run_pipeline import reconstruct_if_needed
from vdgs.sfm import capture_writer, feature_extraction, feature_matching, incremental_mapper
from vdgs.sfm.reconstruct import reconstruct
from vdgs.sfm.workspace import Workspace, call_cancellable
from vdgs.system.step_progress import read_step
from vdgs.system.stop_signals import catch_stop_signals

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("sfm"), pytest.mark.usefixtures("few_features")]


def console() -> Console:
    return Console(file=io.StringIO(), width=500)


@pytest.fixture
def flight(nine) -> Flight:
    return nine


@pytest.fixture
def begun(nine_begun, unestimated) -> dict[str, Path]:
    return nine_begun


def pixels_of(file: Path) -> np.ndarray:
    with Image.open(file) as image:
        return np.array(image)


def whole_capture(output: Path, flight: Flight, facts: ReconstructionReport) -> None:
    """Everything is there, in all sizes, and lies where it was."""
    assert facts.registered == len(flight.cameras)
    capture = load_capture(output)
    assert [view.name for view in capture.views] == flight.names
    shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
    for view, truth in zip(capture.views, flight.cameras, strict=True):
        assert np.linalg.norm(view.camera.position + shift - truth.position) < 0.5
    for folder, _ in capture_writer.IMAGE_SIZES:
        assert sorted(path.name for path in (output / folder).iterdir()) == flight.names
    assert not (output / "work").exists()


# ------------------------------------------------------------------------------------- folders and cameras


def test_two_folders_two_cameras_landscape_and_portrait_become_one_scene(flight, tmp_path):
    """The cards of two drones with the same names on them, one of which lay on its side."""
    for k, name in enumerate(flight.names[:6]):
        pixels, place = pixels_of(flight.folder / name), flight.cameras[k].position
        folder = tmp_path / ("first" if k % 2 else "second")
        folder.mkdir(exist_ok=True)
        if k % 2:
            write_photograph(folder / f"DJI_{k // 2}.JPG", pixels, k, place)
        else:
            turned = np.rot90(pixels, 1 if k % 4 else -1).copy()
            write_photograph(folder / f"DJI_{k // 2}.JPG", turned, k, place, 6 if k % 4 else 8, model="Other")
    request = RunRequest(
        capture=tmp_path / "first", output=tmp_path / "run", preset="laptop", threads=1, device="cpu",
        training=PRESETS["laptop"].training, extra_image_folders=(tmp_path / "second",),
    )  # fmt: skip
    said = console()
    found = reconstruct_if_needed(request, said)
    assert found.capture == tmp_path / "run" / "capture"
    assert found.extra_image_folders == ()
    capture = load_capture(found.capture)
    assert len(capture.views) == 6
    assert {view.name.split("/")[0] for view in capture.views} == {"first", "second"}
    facts = read_reconstruction(found.capture)
    assert [(camera.name, camera.photographs) for camera in facts.cameras] == [("Maker Drone", 3), ("Maker Other", 3)]
    assert "Maker Drone (3)" in said.file.getvalue()
    assert "Maker Other (3)" in said.file.getvalue()
    shift = enu_from_geodetic(np.array([capture.ground.origin_geo]), ORIGIN)[0]
    for view in capture.views:
        card, number = view.name.split("/")[0], int(view.name.split("_")[1].split(".")[0])
        truth = flight.cameras[2 * number + (card == "first")]
        assert np.linalg.norm(view.camera.position + shift - truth.position) < 0.8
    again = reconstruct_if_needed(request, console())  # the same command finds it made, and chooses the size anew
    assert replace(again, options=found.options) == found


def test_more_folders_beside_a_capture_are_refused(flight, tmp_path):
    (tmp_path / "sparse").mkdir()
    request = RunRequest(
        capture=tmp_path, output=tmp_path / "run", preset="laptop", extra_image_folders=(flight.folder,)
    )
    with pytest.raises(VdgsError, match="only folders of photographs alone can be several"):
        reconstruct_if_needed(request, console())


def test_photographs_one_by_one_are_asked_for_their_folder(flight, tmp_path):
    """As a shell writes `vdgs run DCIM/*.JPG`."""
    first, *more = sorted(flight.folder.glob("*.jpg"))
    request = RunRequest(capture=first, output=tmp_path / "run", preset="laptop", extra_image_folders=tuple(more))
    with pytest.raises(VdgsError, match="is a photograph"):
        reconstruct_if_needed(request, console())


# ------------------------------------------------------------------------------------------------- parts


@pytest.mark.usefixtures("unestimated")
def test_of_two_parts_the_larger_is_kept_and_the_other_named(flight, tmp_path):
    """Six photographs, and 90 m beside them four as of another place: mirrored negatives, whose features are others."""
    card, said = tmp_path / "card", console()
    card.mkdir()
    for k, name in enumerate(flight.names[:6]):
        shutil.copy(flight.folder / name, card)
        if k in (0, 1, 4, 5):
            place = flight.cameras[k].position * [-1, 1, 1] + [90, 0, 0]
            write_photograph(card / f"far_{k}.JPG", 255 - pixels_of(flight.folder / name)[:, ::-1], 10 + k, place)
    facts = reconstruct(SfmRequest(image_folders=(card,), output=tmp_path / "capture", threads=1), said)
    assert facts.components == (6, 4)
    assert facts.registered == 6
    why = {photo.name: photo.excluded_reason for photo in facts.photographs if photo.excluded_reason}
    assert sorted(why) == [f"far_{k}.JPG" for k in (0, 1, 4, 5)]
    assert all("belongs to a part of 4 photographs that nothing joins to the rest" in reason for reason in why.values())
    assert "parts that do not hold together: 6, 4" in said.file.getvalue()
    assert [view.name for view in load_capture(tmp_path / "capture").views] == flight.names[:6]


# ------------------------------------------------------------------------------------------------ stopped


class Stopper:
    """Sends a signal once a function was called so many times."""

    def __init__(self, after: int, number: signal.Signals = signal.SIGINT) -> None:
        self.left, self.number = after, number

    def __call__(self) -> None:
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), self.number)


STEPS = {
    "features": (feature_extraction, "_extract", 3, signal.SIGTERM),
    "matching": (feature_matching, "call_cancellable", 2, signal.SIGHUP),
    "mapping": (incremental_mapper, "save_snapshots", 5, signal.SIGTERM),
    "writing": (capture_writer, "write_bytes", 8, signal.SIGINT),
}


@pytest.mark.usefixtures("unestimated")
def test_a_signal_at_each_step_keeps_what_is_done_and_the_same_command_goes_on(flight, tmp_path, monkeypatch):
    """One command, stopped in every step in turn: each goes on from what the one before it did."""
    monkeypatch.setattr(feature_matching, "PAIRS_PER_THREAD", 4)
    monkeypatch.setattr(incremental_mapper, "MIN_SNAPSHOT_INTERVAL", 2)
    output = tmp_path / "capture"
    request = SfmRequest(image_folders=(flight.folder,), output=output, threads=1)
    extracted, matched, mapped = [], [], []

    def counted(called, *arguments, **named):
        if called is pycolmap.extract_features:
            extracted.extend(arguments[2])
        if called is pycolmap.match_image_pairs:
            matched.append(named["pairing_options"].match_list_path)
        if called is pycolmap.incremental_mapping:
            mapped.append(named["input_path"])
        return call_cancellable(called, *arguments, **named)

    for each in (feature_extraction, feature_matching, incremental_mapper):
        monkeypatch.setattr(each, "call_cancellable", counted)
    for step, (room, name, after, number) in STEPS.items():
        for calls in (extracted, matched, mapped):
            calls.clear()
        with monkeypatch.context() as patch:
            patch.setattr(room, name, _then_stopped(getattr(room, name), Stopper(after, number)))
            with pytest.raises(KeyboardInterrupt), catch_stop_signals(interrupts=True):
                reconstruct(request, console())
        with pytest.raises(CaptureError, match="is not finished"):
            load_capture(output)
        reached = read_step(output / "work" / "progress.json")
        assert reached is not None
        assert reached.step == step
        assert len(extracted) == {"features": 6, "matching": 4}.get(step, 0)  # the six of three calls are kept
        assert bool(matched) == (step in ("matching", "mapping"))
        assert bool(mapped) == (step in ("mapping", "writing"))
    assert int(Path(mapped[0]).name) >= 4  # mapping went on from what it had
    for calls in (extracted, matched, mapped):
        calls.clear()
    written = {path: path.stat().st_mtime_ns for path in output.glob("images*/*.JPG")}
    assert len(written) >= 8
    whole_capture(output, flight, reconstruct(request, console()))
    assert all(path.stat().st_mtime_ns == when for path, when in written.items())
    assert extracted + matched + mapped == []


def _then_stopped(function, stop: Stopper):
    def called(*arguments, **named):
        result = function(*arguments, **named)
        stop()
        return result

    return called


def test_only_whole_snapshots_are_gone_on_from_and_the_largest_of_them(tmp_path, monkeypatch):
    work = Workspace(tmp_path)

    def snapshot(name: str, placed: int) -> None:
        (work.snapshots / name).mkdir(parents=True)
        (work.snapshots / name / "images.bin").write_bytes(placed.to_bytes(8, "little"))

    def check(folder: Path) -> None:
        if folder.name == "half":
            raise OSError("COLMAP could write a part only")

    monkeypatch.setattr(incremental_mapper, "check_whole_model", check)
    incremental_mapper.save_snapshots(work)
    assert incremental_mapper._largest_snapshot(work) is None
    for name, placed, kept in (("1", 7, 7), ("2", 12, 12), ("3", 5, 12), ("half", 50, 12), ("4", 110, 110)):
        snapshot(name, placed)
        incremental_mapper.save_snapshots(work)
        assert [path.name for path in work.saved_snapshots.iterdir()] == [str(kept)]
        assert not any(work.snapshots.iterdir())
    incremental_mapper.delete_models(work)
    assert list(tmp_path.iterdir()) == []


def test_another_focal_length_begins_mapping_anew(flight, begun, tmp_path, monkeypatch):
    output, stop = tmp_path / "capture", Stopper(5)
    copy_folder(begun["mapping"], output)
    monkeypatch.setattr(incremental_mapper, "MIN_SNAPSHOT_INTERVAL", 2)
    keep = incremental_mapper.save_snapshots
    with monkeypatch.context() as patch:
        patch.setattr(incremental_mapper, "save_snapshots", lambda work: (keep(work), stop()))
        with pytest.raises(KeyboardInterrupt), catch_stop_signals(interrupts=True):
            reconstruct(SfmRequest(image_folders=(flight.folder,), output=output, threads=1), console())
    assert any((output / "work" / "kept").iterdir())
    monkeypatch.setattr(
        incremental_mapper,
        "run_mapper",
        lambda work, *_: pytest.fail("kept") if work.saved_snapshots.exists() else done(),
    )

    def done():
        raise CaptureError("begun anew")

    with pytest.raises(CaptureError, match="begun anew"):
        reconstruct(
            SfmRequest(image_folders=(flight.folder,), output=output, threads=1, options=SfmOptions(focal="refine")),
            console(),
        )


# ---------------------------------------------------------------------------------------------- full disks


def test_a_disk_that_fills_while_photographs_are_written_is_said_and_nothing_is_lost(
    flight, begun, tmp_path, monkeypatch
):
    output, written = tmp_path / "capture", []
    copy_folder(begun["writing"], output)
    request = SfmRequest(image_folders=(flight.folder,), output=output, threads=1)
    write = Path.write_bytes

    def until_full(path: Path, content: bytes) -> int:
        if path.name.endswith(".tmp") and "images" in path.parent.name:
            written.append(path)
            if len(written) > 7:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", until_full)
        with pytest.raises(VdgsError, match=r"No space left on device\). Free some space .* same command"):
            reconstruct(request, console())
    assert len(list(output.glob("images*/*.JPG"))) == 7
    for room in (feature_extraction, feature_matching, incremental_mapper):
        monkeypatch.setattr(room, "call_cancellable", lambda *_, **__: pytest.fail("was done already"))
    whole_capture(output, flight, reconstruct(request, console()))


@pytest.mark.usefixtures("unestimated")
def test_a_disk_that_is_full_for_the_database_is_said_and_nothing_is_lost(flight, tmp_path, monkeypatch):
    """First for features, then for matches."""
    request = SfmRequest(image_folders=(flight.folder,), output=tmp_path / "capture", threads=1)
    monkeypatch.setattr(feature_matching, "PAIRS_PER_THREAD", 4)
    calls = {feature_extraction: 0, feature_matching: 0}

    def fail(why: str):
        raise RuntimeError(why)

    def counted(room, full_at=None):
        def call(function, *arguments, **named):
            calls[room] += 1
            if calls[room] == full_at:
                return call_cancellable(lambda _, cancellation_token: fail("SQLite error: disk is full"), arguments[0])
            return call_cancellable(function, *arguments, **named)

        return call

    for room, full_at in ((feature_extraction, 2), (feature_matching, 3)):
        with monkeypatch.context() as patch:
            patch.setattr(room, "call_cancellable", counted(room, full_at))
            with pytest.raises(VdgsError, match=r"the disk is full .* the same command then goes on"):
                reconstruct(request, console())
        calls[room] = 0
        monkeypatch.setattr(room, "call_cancellable", counted(room))
    # That they lead to the same model whatever disk was full: test_full_disks.py; a whole capture: the signals above.
    monkeypatch.setattr(incremental_mapper, "call_cancellable", lambda *_, **__: fail("all of this step is there"))
    with pytest.raises(RuntimeError, match="all of this step is there"):
        reconstruct(request, console())
    assert calls[feature_extraction] < 5  # of five, and nine with the four pairs of each
    assert calls[feature_matching] < 9
