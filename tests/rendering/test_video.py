"""Films: what one holds, which encoders write it, and what a failure leaves."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from vdgs.config.commands import RenderRequest
from vdgs.errors import VdgsError
from vdgs.rendering import video
from vdgs.rendering.render_run import render_run
from vdgs.rendering.video import Encoder, VideoWriter, caution, check_film, default_encoder
from vdgs.system.atomic_files import host_mark, process_mark


def test_a_film_holds_its_frames(tmp_path: Path):
    file = tmp_path / "films" / "film.mp4"
    levels = (40, 120, 200)
    with VideoWriter(file, 30.0, encoder="mpeg4") as film:
        for level in levels:
            film.write(np.full((49, 65, 3), (level, level // 2, 30), np.uint8))
        assert not file.exists()
    assert [path.name for path in file.parent.iterdir()] == ["film.mp4"]
    reader = cv2.VideoCapture(str(file))
    for level in levels:
        done, frame = reader.read()
        assert done
        assert frame.shape == (48, 64, 3)
        np.testing.assert_allclose(frame[24, 32, ::-1], (level, level // 2, 30), atol=12)
    assert not reader.read()[0]
    reader.release()


def interrupted() -> np.ndarray:
    raise KeyboardInterrupt


def test_a_film_that_fails_leaves_nothing(tmp_path: Path):
    file = tmp_path / "film.mp4"
    frame = np.zeros((32, 32, 3), np.uint8)
    with VideoWriter(tmp_path / "good.mp4", 30.0, encoder="mpeg4") as film:
        film.write(frame)
        with pytest.raises(ValueError, match="in a film of"):
            film.write(frame[:16])
    with (
        pytest.raises(KeyboardInterrupt),
        VideoWriter(file, 30.0, encoder="mpeg4") as film,
    ):
        film.write(frame + interrupted())
    with pytest.raises(VdgsError, match="no frames"), VideoWriter(file, 30.0):
        pass
    with pytest.raises(VdgsError, match=r"\.mp4"):
        VideoWriter(tmp_path / "film.avi", 30.0)
    assert [path.name for path in tmp_path.iterdir()] == ["good.mp4"]


@pytest.mark.parametrize("content", [b"x", b"flight over the field" * 1000], ids=["a byte", "a film"])
def test_a_film_of_others_is_not_replaced(tmp_path: Path, content: bytes):
    """It may be the one that the run was made of; it is refused before the model is looked for."""
    file = tmp_path / "DJI_0042.MP4"
    file.write_bytes(content)
    with pytest.raises(VdgsError, match=r"DJI_0042\.MP4: is there already, and no film of `vdgs render`"):
        render_run(RenderRequest(run=tmp_path / "run", output=file), Console())
    with pytest.raises(VdgsError, match="Choose another name"), VideoWriter(file, 30.0, encoder="mpeg4") as film:
        film.write(np.zeros((32, 32, 3), np.uint8))
    assert file.read_bytes() == content


@pytest.mark.parametrize("held", [False, True], ids=["an empty file", "an earlier film"])
def test_an_earlier_film_is_replaced(tmp_path: Path, held: bool):
    file = tmp_path / "film.mp4"
    file.touch()
    for frames in (1, 3) if held else (3,):
        with VideoWriter(file, 30.0, encoder="mpeg4") as film:
            for _ in range(frames):
                film.write(np.zeros((32, 32, 3), np.uint8))
    check_film(file, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_a_folder_that_takes_no_files_is_said_before_frames_are_drawn(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(VdgsError, match=r"file: cannot be written \(Not a directory\)\. Move away"):
        VideoWriter(tmp_path / "file" / "film.mp4", 30).__enter__()


def test_a_missing_encoder_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("vdgs.rendering.video.importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr("vdgs.rendering.video._ffmpeg_on_path", lambda: None)
    assert default_encoder() in ("vp9", "mpeg4")
    monkeypatch.setattr("vdgs.rendering.video._has_vp9", lambda: False)
    assert default_encoder() == "mpeg4"
    monkeypatch.setattr("vdgs.rendering.video._ffmpeg_on_path", lambda: "ffmpeg")
    assert default_encoder() == "ffmpeg"
    monkeypatch.setattr("vdgs.rendering.video._ffmpeg_on_path", lambda: None)
    monkeypatch.setattr("vdgs.rendering.video.cv2.VideoWriter.fourcc", lambda *letters: 0, raising=False)

    class Closed:
        fourcc = staticmethod(lambda *letters: 0)

        def __init__(self, *arguments) -> None: ...

        def isOpened(self) -> bool:
            return False

    monkeypatch.setattr("vdgs.rendering.video.cv2.VideoWriter", Closed)
    with (
        pytest.raises(VdgsError, match="pip install imageio-ffmpeg"),
        VideoWriter(tmp_path / "film.mp4", 30.0) as film,
    ):
        film.write(np.zeros((8, 8, 3), np.uint8))


@pytest.mark.parametrize("encoder", ["ffmpeg", "av", "vp9", "mpeg4"])
def test_every_encoder_writes_a_whole_film(tmp_path: Path, encoder: Encoder):
    needed = {"ffmpeg": ffmpeg_is_there(), "av": importlib.util.find_spec("av"), "vp9": video._has_vp9(), "mpeg4": True}
    if not needed[encoder]:
        pytest.skip(f"nothing here encodes with {encoder} (pip install imageio-ffmpeg or av)")
    file = tmp_path / "film.mp4"
    with VideoWriter(file, 25.0, encoder=encoder) as film:
        for level in range(40, 200, 20):
            film.write(np.full((49, 65, 3), (level, level // 2, 30), np.uint8))
    check_film(file, 8)
    reader = cv2.VideoCapture(str(file))
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(25)
    done, frame = reader.read()
    assert done
    np.testing.assert_allclose(frame[24, 32, ::-1], (40, 20, 30), atol=12)
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (caution(encoder) is None) == (encoder in ("ffmpeg", "av"))


@pytest.mark.parametrize("encoder", ["ffmpeg", "av", "mpeg4"])
def test_a_relative_name_may_have_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoder: Encoder):
    needed = {"ffmpeg": ffmpeg_is_there(), "av": importlib.util.find_spec("av"), "mpeg4": True}
    if not needed[encoder]:
        pytest.skip(f"nothing here encodes with {encoder}")
    monkeypatch.chdir(tmp_path)
    with VideoWriter(Path("2026-11-29T10:30:00.mp4"), 25.0, encoder=encoder) as film:
        film.write(np.zeros((32, 32, 3), np.uint8))
    assert [path.name for path in tmp_path.iterdir()] == ["2026-11-29T10:30:00.mp4"]


@pytest.mark.parametrize("encoder", ["ffmpeg", "av"])
@pytest.mark.parametrize("size", [(48, 64), (720, 1280)])
def test_h264_has_its_colors_by_bt709_and_says_so(tmp_path: Path, encoder: Encoder, size: tuple[int, int]):
    """Players take a large film that says nothing to be of BT.709, and a small one of BT.601."""
    av = pytest.importorskip("av")
    if encoder == "ffmpeg" and not ffmpeg_is_there():
        pytest.skip("there is no ffmpeg here")
    file, grass = tmp_path / "film.mp4", (60, 140, 40)
    with VideoWriter(file, 25.0, encoder=encoder) as film:
        for _ in range(3):
            film.write(np.full((*size, 3), grass, np.uint8))
    with av.open(str(file)) as container:
        frame = next(container.decode(video=0))
        said = container.streams.video[0].codec_context
        tags = [said.colorspace, said.color_primaries, said.color_trc, said.color_range]
    assert [int(tag) for tag in tags] == [1, 1, 1, 1]  # BT.709, limited range
    decoded = frame.reformat(format="rgb24", src_colorspace="ITU709", src_color_range="MPEG").to_ndarray()
    np.testing.assert_allclose(decoded[20, 20], grass, atol=3)


def ffmpeg_is_there() -> bool:
    return bool(importlib.util.find_spec("imageio_ffmpeg")) or video._ffmpeg_on_path() is not None


def test_a_film_on_a_full_disk_is_an_error_and_the_good_one_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file, noise = tmp_path / "film.mp4", np.random.default_rng(0)
    with VideoWriter(file, 30.0) as film:
        film.write(np.zeros((64, 64, 3), np.uint8))
    good = file.read_bytes()

    def write_and_lose(encoder: Encoder, lost: float) -> None:
        """A film of which the disk held only a part: as OpenCV leaves it, which says nothing."""
        with VideoWriter(file, 30.0, encoder) as film:
            for _ in range(10):
                film.write(noise.integers(0, 255, (64, 64, 3), np.uint8))
            assert film._pen is not None
            film._pen.close()
            partial = film._partial
            with partial.open("r+b") as held:
                held.truncate(int(partial.stat().st_size * (1 - lost)))

    for lost in (0.02, 0.5, 1.0):
        with pytest.raises(VdgsError, match="cannot be encoded"):
            write_and_lose("mpeg4", lost)
        assert file.read_bytes() == good
        assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    monkeypatch.setattr("vdgs.system.atomic_files.FULL_DISK_BYTES", 1 << 60)
    with pytest.raises(VdgsError, match="the disk is full"):
        write_and_lose("mpeg4", 0.5)
    assert file.read_bytes() == good


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root mounts a small disk")
def test_a_film_on_a_small_disk(tmp_path: Path):
    """For real: a tmpfs of 160 kB, with each encoder that is here."""
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        for encoder in dict.fromkeys((default_encoder(), "mpeg4")):
            film_of_noise(tmp_path / "film.mp4", 1, encoder)
            good = (tmp_path / "film.mp4").read_bytes()
            with pytest.raises(VdgsError, match="disk is full"):
                film_of_noise(tmp_path / "film.mp4", 100, encoder)
            assert (tmp_path / "film.mp4").read_bytes() == good
            assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    finally:
        subprocess.run(["umount", tmp_path], check=True)


def film_of_noise(file: Path, frames: int, encoder: Encoder) -> None:
    noise = np.random.default_rng(0)
    with VideoWriter(file, 30.0, encoder) as film:
        for _ in range(frames):
            film.write(noise.integers(0, 255, (128, 128, 3), np.uint8))


def test_what_a_killed_film_left_goes(tmp_path: Path):
    left = tmp_path / f".film.mp4.{host_mark()}-999999999.partial.mp4"
    left.write_bytes(b"half")
    mine = tmp_path / f".film.mp4.{process_mark()}.partial.png"
    mine.write_bytes(b"mine")
    with VideoWriter(tmp_path / "film.mp4", 30.0, "mpeg4") as film:
        film.write(np.zeros((8, 8, 3), np.uint8))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["film.mp4", mine.name])
