"""Films as photographs: which frames are taken, what is known of each, and what is refused."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from support.films import ORIGIN, crops, panorama, relief_film, write_film
from vdgs.captures.loading import load_capture
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.films import take_frames
from vdgs.sfm.films.film_reader import open_film
from vdgs.sfm.films.frame_choice import STEP, FrameChooser, MotionTracker, sharpness
from vdgs.sfm.films.high_dynamic_range import to_standard_range
from vdgs.sfm.films.take_frames import film_changes, temporary_frames, with_frames
from vdgs.sfm.find_images import films_in
from vdgs.sfm.image_list import ImageList, collect_images, is_image_folder
from vdgs.sfm.reconstruct import reconstruct

pytestmark = pytest.mark.slow  # whole reconstructions, runs or trainings

av = pytest.importorskip("av")
#: Stands for 1 s, then moves by 5 of 200 pixels a frame.
LEFTS = [0] * 10 + [5 * k for k in range(40)]


def ask(output: Path, *films: Path, num_frames: int = 300, overwrite: bool = False) -> SfmRequest:
    options = SfmOptions(num_frames=num_frames)
    return SfmRequest(image_folders=films, output=output, options=options, overwrite=overwrite)


def take(request: SfmRequest) -> tuple[ImageList, str]:
    said = io.StringIO()
    return collect_images(with_frames(request, Console(file=said, width=400)).image_folders), said.getvalue()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of 50 frames in 5 s, each frame 1e-5 degrees north of the one before it; two of three are blurred."""
    file = tmp_path_factory.mktemp("card") / "DJI 1.MP4"
    pictures = crops(panorama(), LEFTS)
    blurred = [each if k % 3 == 0 else cv2.blur(each, (9, 5)) for k, each in enumerate(pictures)]
    words = [
        f"<font>FrameCnt: {k}\n2026-06-01 10:00:{k // 10:02d}.{k % 10}00\n[focal_len: 240] [latitude: "
        f"{-33.5 + k * 1e-5:.6f}] [longitude: -70.600000] [rel_alt: {10 + k / 10} abs_alt: -2.5] [gb_yaw: 90.0 "
        "gb_pitch: -80.0 gb_roll: 0.0]</font>"
        for k in range(50)
    ]
    write_film(file, blurred, 10.0, words, {"make": "DJI", "model": "FC3582"})
    return file


@pytest.mark.usefixtures("unestimated")
def test_cameras_of_a_film_lie_where_they_were_within_the_stated_accuracy(tmp_path: Path):
    cameras = relief_film(tmp_path / "DJI_0007.MP4", strips=2, each=4, spacing=1, step=8.0)
    request = ask(tmp_path / "out", tmp_path / "DJI_0007.MP4")
    request = replace(request, threads=1, options=replace(request.options, max_num_features=800))
    facts = reconstruct(request, Console(file=io.StringIO()))
    assert facts.accuracy is not None
    capture = load_capture(tmp_path / "out")
    frames = [int(Path(view.name).stem.rpartition("_")[2]) for view in capture.views]
    assert len(frames) == sum(photo.excluded_reason is None for photo in facts.photographs) >= 8
    assert capture.ground.origin_geo is not None
    places = np.stack([view.camera.position for view in capture.views])
    enu = enu_from_geodetic(geodetic_from_enu(places, capture.ground.origin_geo, capture.ground.axes_origin), ORIGIN)
    off = np.abs(enu - np.stack([cameras[frame].position for frame in frames]))
    assert np.median(off, axis=0).max() < 0.15
    assert facts.accuracy.place_m is not None
    across, up = facts.accuracy.place_m
    assert off[:, :2].max() < across
    assert off[:, 2].max() < up
    assert across < 1


@pytest.fixture(scope="module")
def taken(flight: Path) -> tuple[ImageList, str]:
    return take(ask(flight.parent / "out", flight))


def test_frames_are_apart_sharp_and_know_their_place(taken: tuple[ImageList, str]):
    images, said = taken
    numbers = [int(photo.path.stem.rpartition("_")[2]) for photo in images.images]
    assert sum(number < 10 for number in numbers) <= 1, "one of where it stands"
    assert all(number % 3 == 0 for number in numbers), "none of the blurred"
    lefts = np.array([LEFTS[number] for number in numbers])
    assert (np.diff(lefts) > 0.5 * STEP * 200).all()
    assert (np.diff(lefts) < 1.6 * STEP * 200).all()
    assert lefts[-1] > LEFTS[-1] - STEP * 200
    for number, photo in zip(numbers, images.images, strict=True):
        assert photo.lat_lon == pytest.approx((-33.5 + number * 1e-5, -70.6), abs=2e-7)
        assert photo.altitude == pytest.approx(-2.5)
        assert photo.relative_altitude == pytest.approx(10 + number / 10, abs=1e-3)
        assert photo.datetime == f"2026:06:01 10:00:{number // 10:02d}"
        assert photo.camera == "DJI FC3582 no. DJI_1"
        assert photo.attitude is not None
        assert photo.attitude.tilt_deg == pytest.approx(10)
        assert photo.lens is not None
        assert photo.lens.focal == pytest.approx(24 / 43.27 * 1.25 * 1.0, rel=0.03)
    assert f"{len(numbers)} of 50 frames" in said
    assert "positions of its subtitles" in said


def test_a_bound_on_frames_is_kept_and_spreads_them(flight: Path, tmp_path: Path):
    images, _ = take(ask(tmp_path / "out", flight, num_frames=4))
    lefts = [LEFTS[int(photo.path.stem.rpartition("_")[2])] for photo in images.images]
    assert 3 <= len(lefts) <= 4
    assert max(lefts) - min(lefts) > 0.7 * LEFTS[-1]


def test_the_step_grows_where_a_film_goes_far():
    written = set[Path]()

    def keep(place: float) -> Path:
        written.add(Path(str(place)))
        return Path(str(place))

    chooser = FrameChooser[float](10, keep, written.remove)
    for k in range(2000):
        chooser.offer(k * STEP / 4, 1.0, k * STEP / 4)
        assert len(written) <= 21
    chosen = np.array([float(str(each)) for each in chooser.finish()])
    assert {Path(str(place)) for place in chosen} == written
    assert len(chosen) == 10
    assert np.diff(chosen).max() <= 2 * chosen[-1] / 9


@pytest.mark.parametrize("most", [3, 4, 10, 25])
def test_no_mark_is_taken_twice_where_the_step_grows(most: int):
    """Of frames of one sharpness those on the marks are taken, which in the end are two steps apart."""
    written = set[Path]()

    def keep(place: float) -> Path:
        written.add(Path(f"{place:.1f}"))
        return Path(f"{place:.1f}")

    chooser = FrameChooser[float](most, keep, written.remove)
    for k in range(10 * (2 * most + 4)):
        chooser.offer(k * STEP / 10, 1.0, k / 10)
    assert sorted(float(str(place)) for place in written) == [2.0 * mark for mark in range(most + 2)]


def test_motion_is_measured_also_after_cuts_and_over_water():
    gray = panorama(seed=2)[..., 0]
    tracker = MotionTracker()
    moved = [tracker.travel(np.ascontiguousarray(gray[:160, 3 * k : 3 * k + 320]), k / 10) for k in range(40)]
    assert moved[-1] == pytest.approx(3 * 39 / 320, rel=0.1)
    jump = tracker.travel(np.ascontiguousarray(panorama(seed=9)[:160, :320, 0]), 4.0)
    assert jump >= moved[-1] + STEP
    blind = MotionTracker()
    water = [blind.travel(np.full((160, 320), 80, np.uint8), k / 10) for k in range(21)]
    assert water[-1] == pytest.approx(2 * STEP, rel=0.01)
    assert sharpness(gray) > 4 * sharpness(cv2.blur(gray, (9, 5)))


def test_films_of_folders_and_of_several_cards(flight: Path, tmp_path: Path):
    for card in ("A", "B"):
        (tmp_path / card).mkdir()
        shutil.copy(flight, tmp_path / card / "DJI 1.MP4")
    (tmp_path / "B" / "DJI 1.MP4").write_bytes(flight.read_bytes() + b"\0\0\0\x08free")
    assert is_image_folder(tmp_path / "A")
    assert is_image_folder(flight)
    images, _ = take(ask(tmp_path / "out", tmp_path / "A", tmp_path / "B", num_frames=8))
    assert {photo.camera for photo in images.images} == {"DJI FC3582 no. DJI_1", "DJI FC3582 no. DJI_1_2"}
    assert len(images.images) <= 8


def test_films_have_cameras_of_their_own_in_any_script(tmp_path: Path):
    for number, name in enumerate(("航拍一", "航拍二", "a&b's_ü", "cafe\u0301")):
        write_film(tmp_path / f"{name}.mp4", crops(panorama(seed=number), [8 * k for k in range(20)]))
    images, _ = take(ask(tmp_path / "out", tmp_path))
    named = {photo.camera for photo in images.images}
    assert named == {f"film no. {name}" for name in ("航拍一", "航拍二", "a&b's_ü", "café")}


def test_copies_of_a_film_are_left_out_and_named(flight: Path, tmp_path: Path):
    card = tmp_path / "card"
    card.mkdir()
    for name in ("A.MP4", "A (1).MP4", "B.MP4"):
        shutil.copy(flight, card / name)
    (card / "B.SRT").write_text("")
    write_film(card / "C.MP4", crops(panorama(seed=5), LEFTS))
    images, said = take(ask(tmp_path / "out", card))
    assert {photo.camera.rpartition(" ")[2] for photo in images.images} == {"B", "C"}
    assert all(f"{card / name}: not used, is a copy of {card / 'B.MP4'}" in said for name in ("A.MP4", "A (1).MP4"))
    (card / "B.SRT").unlink()
    images, _ = take(ask(tmp_path / "other", card))
    assert {photo.camera.rpartition(" ")[2] for photo in images.images} == {"A", "C"}
    assert [photo.name for photo in take(ask(tmp_path / "other", card))[0].images] == [p.name for p in images.images]
    assert film_changes(tmp_path / "other") == ""


def test_films_beside_photographs_are_named_and_used_where_they_are_named(
    flight: Path, taken: tuple[ImageList, str], tmp_path: Path
):
    images, _ = taken
    (tmp_path / "mixed").mkdir()
    for photo in images.images[:4]:
        shutil.copy(photo.path, tmp_path / "mixed")
    film = Path(shutil.copy(flight, tmp_path / "mixed"))
    assert films_in([tmp_path / "mixed"]) == []
    assert any("1 film beside the photographs: not used" in note for note in collect_images([tmp_path / "mixed"]).notes)
    assert films_in([tmp_path / "mixed", film]) == [film]
    both, _ = take(ask(tmp_path / "out", tmp_path / "mixed", film, num_frames=8))
    assert not any("not used" in note for note in both.notes)
    for photo in collect_images([tmp_path / "mixed"]).images[1:]:
        photo.path.unlink()
    with pytest.raises(CaptureError, match=rf"(?s)1 photograph that can.*1 film .*not used \({film.name}\).*name it"):
        collect_images([tmp_path / "mixed"])


def test_the_same_command_takes_no_frame_twice_and_other_films_are_refused(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    film, output = Path(shutil.copy(flight, tmp_path / "a.mp4")), tmp_path / "out"
    before = {photo.path: photo.path.stat().st_mtime_ns for photo in take(ask(output, film))[0].images}
    (output / "photographs.json").write_text("{}")
    monkeypatch.setattr(take_frames, "open_film", None)
    assert {photo.path: photo.path.stat().st_mtime_ns for photo in take(ask(output, film))[0].images} == before
    monkeypatch.undo()
    with pytest.raises(VdgsError, match="--num-frames"):
        take(ask(output, film, num_frames=5))
    assert film_changes(output) == ""
    os.utime(film, (1, 1))
    assert film_changes(output) == ""
    film.write_bytes(film.read_bytes() + bytes(1))
    assert film_changes(output) == "films: 1 changed (a.mp4)"
    with pytest.raises(VdgsError, match=r"1 changed \(a.mp4\).*--overwrite"):
        take(ask(output, film))
    again = take(ask(output, film, overwrite=True))[0].images
    assert {photo.path for photo in again} == before.keys()


def test_a_film_that_is_replaced_while_its_frames_are_taken_is_another(flight: Path, tmp_path: Path, monkeypatch):
    film, output = Path(shutil.copy(flight, tmp_path / "a.mp4")), tmp_path / "out"
    taken = take_frames._take_frames

    def replaced(path: Path, *arguments):
        record = taken(path, *arguments)
        path.write_bytes(path.read_bytes() + bytes(1))
        return record

    monkeypatch.setattr(take_frames, "_take_frames", replaced)
    take(ask(output, film))
    assert film_changes(output) == "films: 1 changed (a.mp4)"


def test_a_stop_while_frames_are_taken_leaves_an_output_that_goes_on(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = RunFolder(tmp_path / "run")
    other = tmp_path / "a.mp4"
    other.write_bytes(flight.read_bytes() + b"\0\0\0\x08free")
    request = ask(run.own_capture, other, flight)
    look, left = take_frames._look, [1]

    def stop(*arguments):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return look(*arguments)

    monkeypatch.setattr(take_frames, "_look", stop)
    with pytest.raises(KeyboardInterrupt):
        with_frames(request, Console(file=io.StringIO()), run)
    finished = {file: file.stat().st_ino for file in (run.own_capture / "frames" / "a").iterdir()}
    monkeypatch.undo()
    run.check_output_empty()
    with_frames(request, Console(file=io.StringIO()), run)
    assert {file: file.stat().st_ino for file in (run.own_capture / "frames" / "a").iterdir()} == finished
    assert len([*(run.own_capture / "frames" / "DJI_1").iterdir()]) > 3


def test_a_look_writes_nothing_into_the_output(flight: Path, tmp_path: Path):
    with temporary_frames(ask(tmp_path / "out", flight), Console(file=io.StringIO())) as request:
        [folder] = request.image_folders
        assert len(collect_images([folder]).images) > 3
    assert not folder.exists()
    assert not (tmp_path / "out").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("three years")
    look = temporary_frames(ask(tmp_path / "full", flight), Console(file=io.StringIO()))
    with pytest.raises(VdgsError, match="holds other things"), look:
        pass


def test_a_look_at_what_is_begun_takes_the_frames_that_are_there(flight: Path, tmp_path: Path):
    request, said = ask(tmp_path / "out", flight), Console(file=io.StringIO())
    taken = with_frames(request, said)
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*")}
    with temporary_frames(request, said) as look:
        assert look == taken
    with temporary_frames(replace(request, options=replace(request.options, num_frames=5)), said) as look:
        assert look.image_folders != taken.image_folders
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out").rglob("*")} == before


@pytest.mark.parametrize("coding", ["utf-8", "utf-16", "utf-8-sig"])
def test_sidecar_subtitles_uneven_frames_and_no_positions(tmp_path: Path, coding: str):
    film = tmp_path / "DJI_2.MOV"
    moments = [0.1 * k + (0.7 if k > 15 else 0) for k in range(30)]
    write_film(film, crops(panorama(), [5 * k for k in range(30)]), moments=moments)
    images, said = take(ask(tmp_path / "one", film))
    assert "no positions (drones write them into subtitles" in said
    assert [photo.lat_lon for photo in images.images] == [None] * len(images.images)
    times = [f"00:00:{int(t):02d},{round(1000 * (t % 1)):03d}" for t in moments]
    blocks = [f"{k}\n{at} --> {at}\n[latitude: {47 + k * 1e-5:.6f}] [longitude: 8.2]\n" for k, at in enumerate(times)]
    (tmp_path / "dji_2.SRT").write_text("Signal: 4\n".join(block.partition("[")[0] for block in blocks))
    _, said = take(ask(tmp_path / "none", film))
    assert "no positions: none is understood in dji_2.SRT" in said
    (tmp_path / "dji_2.SRT").write_text("\n".join(blocks), encoding=coding)
    images, said = take(ask(tmp_path / "two", film))
    assert "positions of dji_2.SRT" in said
    for photo in images.images:
        number = int(photo.path.stem.rpartition("_")[2])
        assert photo.lat_lon == pytest.approx((47 + number * 1e-5, 8.2), abs=2e-7)


def test_subtitles_of_other_times_give_no_positions_and_are_named(tmp_path):
    """Of the second part of a flight, counted from the beginning of the first."""
    film = tmp_path / "DJI_2.MP4"
    write_film(film, crops(panorama(), [5 * k for k in range(30)]))
    block = "{n}\n00:05:{n:02d},000 --> 00:05:{n:02d},900\n[latitude: 47.0] [longitude: 8.{n}]\n"
    (tmp_path / "DJI_2.SRT").write_text("\n".join(block.format(n=n) for n in range(3)))
    found, said = take(ask(tmp_path / "out", film))
    assert all(photo.lat_lon is None for photo in found.images)
    assert "no positions: those of DJI_2.SRT are of other times (5 min 00 s to 5 min 02 s)" in said


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_film_that_lies_on_its_side_becomes_upright(tmp_path: Path, quarters: int):
    upright = crops(panorama(), [6 * k for k in range(20)])
    turned = [np.rot90(each, quarters) for each in upright]
    write_film(tmp_path / "a.mp4", turned, rotation={1: -90, 2: 180, 3: 90}[quarters])
    images, said = take(ask(tmp_path / "out", tmp_path / "a.mp4"))
    assert ", 200 x 160; " in said
    assert len(images.images) >= 4
    for photo in images.images:
        number = int(photo.path.stem.rpartition("_")[2])
        pixels = np.asarray(Image.open(photo.path)).astype(float)
        assert pixels.shape == (160, 200, 3)
        assert np.abs(pixels - upright[number]).mean() < 6


def test_what_cannot_become_photographs_is_refused(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = flight.read_bytes()
    files = {
        "cut.mp4": (whole[: whole.index(b"moov") - 4], r"no index \(moov\)"),
        "text.mp4": (b"no film at all" * 20, "is no film that can be read"),
        "note.mp4": (b"", "is no film that can be read"),
        "round.insv": (whole, "is a film of all directions"),
    }
    for name, (content, said) in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=said):
            take(ask(tmp_path / "out", tmp_path / name))
    write_film(tmp_path / "still.mp4", crops(panorama(), [0] * 30))
    with pytest.raises(CaptureError, match="1 frames that differ from each other"):
        take(ask(tmp_path / "out", tmp_path / "still.mp4"))
    with pytest.raises(CaptureError, match="is a film, which becomes a capture first: vdgs sfm"):
        load_capture(flight)
    write_film(tmp_path / "lines.mp4", crops(panorama(), range(6)), x264="tff=1:interlaced=1")
    with pytest.raises(CaptureError, match=r"is interlaced.*-vf bwdif"):
        take(ask(tmp_path / "out", tmp_path / "lines.mp4"))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(CaptureError, match=r"pip install 'vdgs\[video\]'"):
        take(ask(tmp_path / "other", flight))


def test_a_film_that_ends_early_gives_what_it_has(flight: Path, tmp_path: Path):
    content = bytearray(flight.read_bytes())
    start = content.index(b"mdat") + 4
    middle, end = start + (content.index(b"moov") - start) // 2, content.index(b"moov") - 4
    content[middle:end] = bytes(end - middle)
    (tmp_path / "a.mp4").write_bytes(content)
    images, said = take(ask(tmp_path / "out", tmp_path / "a.mp4"))
    assert len(images.images) >= 3
    assert "damaged" in said or "cut off" in said


def test_frames_of_hdr_films_are_converted_and_it_is_said(tmp_path: Path):
    hlg = "transfer=arib-std-b67:colorprim=bt2020:colormatrix=bt2020nc"
    pictures = crops(panorama(), [30 * k for k in range(6)])
    write_film(tmp_path / "plain.mp4", pictures)
    write_film(tmp_path / "hdr.mp4", pictures, x264=hlg, pixels="yuv420p10le")
    (plain, _), (deep, said) = (take(ask(tmp_path / name, tmp_path / f"{name}.mp4")) for name in ("plain", "hdr"))
    assert "is HDR (HLG); its frames are written in the colors of sRGB" in said
    one, other = (np.asarray(Image.open(images.images[2].path)).astype(float) for images in (plain, deep))
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.85


def test_white_of_hdr_is_white_and_order_is_kept():
    ramp = np.linspace(0, 65535, 1001).astype(np.uint16)[None, :, None].repeat(3, 2)
    for transfer, white in ((18, 0.75), (16, 0.58)):
        gray = to_standard_range(ramp, transfer)[0]
        assert (np.diff(gray.astype(int), axis=0) >= 0).all()
        assert gray[0].max() == 0
        assert gray[round(1000 * white)].min() >= 245
        assert gray[round(500 * white)].max() < 160
        assert np.ptp(gray.astype(int), axis=1).max() <= 2, "gray stays gray"


def test_moments_without_a_clock_in_the_film(tmp_path: Path):
    write_film(tmp_path / "a.mp4", crops(panorama(), [5 * k for k in range(30)]),
               metadata={"creation_time": "2026-06-01T10:00:57Z"})  # fmt: skip
    images, _ = take(ask(tmp_path / "out", tmp_path / "a.mp4"))
    moments = [datetime.strptime(photo.datetime, "%Y:%m:%d %H:%M:%S") for photo in images.images]
    assert moments == sorted(moments)
    assert (moments[0], moments[-1]) == (datetime(2026, 6, 1, 10, 0, 57), datetime(2026, 6, 1, 10, 0, 59))


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_positions_are_those_of_frames_also_where_a_film_starts_late(tmp_path: Path, name: str):
    words = [f"[latitude: {47 + k * 1e-5:.6f}] [longitude: 8.2]" for k in range(30)]
    write_film(tmp_path / name, crops(panorama(), [5 * k for k in range(30)]), 10.0, words, start_s=5.0)
    images, said = take(ask(tmp_path / "out", tmp_path / name))
    assert "positions of its subtitles" in said
    assert "cut off" not in said
    for photo in images.images:
        number = int(photo.path.stem.rpartition("_")[2])
        assert photo.lat_lon == pytest.approx((47 + number * 1e-5, 8.2), abs=2e-7)


def test_damaged_frames_are_left_out_up_to_the_next_key_frame(tmp_path: Path):
    pictures = crops(panorama(), [5 * k for k in range(40)])
    write_film(tmp_path / "a.mp4", pictures, x264="keyint=10:min-keyint=10:scenecut=0:bframes=0")
    content = bytearray((tmp_path / "a.mp4").read_bytes())
    with av.open(str(tmp_path / "a.mp4")) as film:
        packet = next(packet for k, packet in enumerate(film.demux(video=0)) if k == 12)
        content[packet.pos + 40 : packet.pos + packet.size] = np.random.default_rng(1).bytes(packet.size - 40)
    (tmp_path / "a.mp4").write_bytes(content)
    images, said = take(ask(tmp_path / "out", tmp_path / "a.mp4"))
    decoded = [int(photo.path.stem.rpartition("_")[2]) for photo in images.images]
    numbers = [number + (number >= 12) for number in decoded]
    assert not {*numbers} & {*range(12, 20)}
    assert max(numbers) > 30
    assert re.search(r"frames of [01]\.\d s are damaged, and left out", said)
    for number, photo in zip(numbers, images.images, strict=True):
        assert np.abs(np.asarray(Image.open(photo.path)).astype(float) - pictures[number]).mean() < 6


def test_what_lies_beside_a_film_without_positions_is_named(tmp_path: Path):
    film = tmp_path / "flight.mp4"
    write_film(film, crops(panorama(), [6 * k for k in range(20)]))
    track = tmp_path / "track.gpx"
    track.write_text('<?xml version="1.0"?>\n<gpx><trkpt lat="1" lon="2"/></gpx>')
    (tmp_path / "DJI_1.SRT").write_text("1\n00:00:00,000 --> 00:00:02,000\n[latitude: 47.0] [longitude: 8.2]\n")
    _, said = take(ask(tmp_path / "out", film))
    assert "DJI_1.SRT beside it: rename it to flight.SRT" in said
    assert "track.gpx beside it has some by time" in said
    assert "exiftool -geotag" in said
    for table, why in ((track, "Films: once the frames are taken"), (tmp_path / "DJI_1.SRT", "Put it beside the film")):
        with pytest.raises(CaptureError, match=why):
            take(replace(ask(tmp_path / "other", film), gps=table))
    assert not (tmp_path / "other").exists(), "before the film is decoded"
    (tmp_path / "DJI_1.SRT").rename(tmp_path / "flight.mp4.SRT")
    assert "positions of flight.mp4.SRT" in take(ask(tmp_path / "named", film))[1]


def test_films_of_other_suffixes_are_read_and_proxies_are_named(tmp_path: Path):
    write_film(tmp_path / "a.mp4", crops(panorama(), [6 * k for k in range(20)]))
    for suffix in (".ts", ".mpg", ".3gp", ".webm"):
        (tmp_path / suffix[1:]).mkdir()
        shutil.copy(tmp_path / "a.mp4", tmp_path / suffix[1:] / f"a{suffix}")
        assert len(films_in([tmp_path / suffix[1:]])) == 1
    (tmp_path / "low").mkdir()
    proxy = shutil.copy(tmp_path / "a.mp4", tmp_path / "low" / "GL01.LRV")
    for path in (proxy, tmp_path / "low"):
        with pytest.raises(CaptureError, match="low resolution"):
            collect_images([path])


def test_focal_lengths_of_subtitles_keep_their_fractions(tmp_path: Path):
    words = ["[focal_len: 24.40] [latitude: 47.0] [longitude: 8.2]"] * 20
    write_film(tmp_path / "a.mp4", crops(panorama(), [6 * k for k in range(20)]), 10.0, words)
    images, _ = take(ask(tmp_path / "out", tmp_path / "a.mp4"))
    lens = images.images[0].lens
    assert lens is not None
    assert lens.focal == pytest.approx(24.4 / np.hypot(36, 24) * np.hypot(200, 160) / 200, rel=1e-4)


def test_frames_after_a_corrupt_one_are_broken_up_to_the_next_key_frame(flight: Path):
    """As decoders hide what is damaged, of a picture and of those that are made of it."""
    with open_film(flight) as film:
        shown = [(4, False, False), (5, True, False), (6, False, False), (7, False, True), (8, False, False)]
        pictures = [SimpleNamespace(pts=pts, is_corrupt=bad, key_frame=key) for pts, bad, key in shown]
        assert [film._is_whole(picture) for picture in pictures] == [True, False, False, True, True]
