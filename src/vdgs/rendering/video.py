"""Films: frames to an MP4 file, one at a time, in a codec that browsers play.

H.264 (yuv420p) through the first of imageio-ffmpeg, PyAV and an `ffmpeg` with libx264 on the PATH; else VP9 through
OpenCV, which Chromium, Firefox and Safari from 17 play, but not QuickTime nor the player of Windows; where OpenCV has
no VP9 either, MPEG-4, which no browser plays. A finished film is looked at before it takes the place of another of
ours, which a last box of kind `free` marks: players skip such boxes. Other files keep their place.

H.264 is encoded by BT.709 in the limited range and says so: players read films that say nothing by their size, and not
all alike. OpenCV can neither choose nor say the matrix (BT.601).
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import struct
import subprocess
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import is_disk_full, process_mark
from vdgs.system.scratch import check_takes_files, remove_leftovers

Encoder = Literal["ffmpeg", "av", "vp9", "mpeg4"]
#: What a person should know of a film by its encoder.
CODECS = {"ffmpeg": "H.264", "av": "H.264", "vp9": "VP9", "mpeg4": "MPEG-4"}
#: Quality of H.264: 18 is hardly told from the original, 23 is ffmpeg's own.
CRF = "20"
#: Code of BT.709 in a stream, for its matrix, primaries and transfer alike, and of the limited range (ITU-T H.273).
_BT709, _LIMITED_RANGE = 1, 1
#: The same in the words of ffmpeg: frames converted, then marked, which marks the stream.
_FFMPEG_COLORS = (
    "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
)
#: The box that ends films of ours, whichever encoder wrote them.
_MARK = b"vdgs render"
_BOX = struct.pack(">I4s", 8 + len(_MARK), b"free") + _MARK
_FOURCC = {"vp9": "vp09", "mpeg4": "mp4v"}
_REMEDY = "Install an encoder with `pip install imageio-ffmpeg`, or render single images instead."


def default_encoder() -> Encoder:
    """The encoder that `VideoWriter` uses unless told otherwise."""
    if importlib.util.find_spec("imageio_ffmpeg"):
        return "ffmpeg"
    if importlib.util.find_spec("av"):
        return "av"
    if _ffmpeg_on_path() is not None:
        return "ffmpeg"
    return "vp9" if _has_vp9() else "mpeg4"


def caution(encoder: Encoder) -> str | None:
    """Which players do not play films of an encoder; None for H.264, which all do."""
    if encoder in ("ffmpeg", "av"):
        return None
    where = (
        "browsers play it, QuickTime and the player of Windows do not" if encoder == "vp9" else "no browser plays it"
    )
    return f"the film is {CODECS[encoder]}: {where}. For H.264, which all play: pip install imageio-ffmpeg"


@lru_cache(maxsize=1)
def _ffmpeg_on_path() -> str | None:
    """An ffmpeg of the system that encodes H.264."""
    found = shutil.which("ffmpeg")
    if found is None:
        return None
    try:
        listed = subprocess.run([found, "-hide_banner", "-encoders"], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return None
    return found if "libx264" in listed.stdout else None


@lru_cache(maxsize=1)
def _has_vp9() -> bool:
    """Whether OpenCV encodes VP9 here: a film of one frame is tried."""
    with tempfile.TemporaryDirectory() as folder:
        writer = cv2.VideoWriter(str(Path(folder) / "try.mp4"), cv2.VideoWriter.fourcc(*_FOURCC["vp9"]), 30, (16, 16))
        can = writer.isOpened()
        writer.release()
    return can


class _Pen(ABC):
    """Something that encodes frames of one size into a file."""

    @abstractmethod
    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a frame. OSError where it cannot."""

    @abstractmethod
    def close(self) -> None:
        """End the film. OSError where it is not whole."""

    def abandon(self) -> None:
        """End without a film."""
        with suppress(OSError):
            self.close()


class _Ffmpeg(_Pen):
    """H.264 by an ffmpeg of its own process."""

    def __init__(self, file: Path, size: tuple[int, int], fps: float) -> None:
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the film
        self._process = subprocess.Popen(
            [
                _ffmpeg(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
                "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:.6g}", "-i", "-", "-an", "-vf", _FFMPEG_COLORS, "-c:v",
                "libx264", "-crf", CRF, "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(file),
            ],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._said,
        )  # fmt: skip

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(frame.tobytes())
        except OSError as error:
            raise OSError(self._end() or str(error)) from error

    def close(self) -> None:
        said = self._end()
        if self._process.returncode != 0:
            raise OSError(said or f"ffmpeg ended with {self._process.returncode}")

    def abandon(self) -> None:
        self._process.kill()
        self._end()

    def _end(self) -> str:
        """Let it end; returns the last line that it said."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        self._process.wait()
        if self._said.closed:
            return ""
        with self._said:
            self._said.seek(0)
            lines = self._said.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def _ffmpeg() -> str:
    """The ffmpeg to run. OSError where there is none."""
    if importlib.util.find_spec("imageio_ffmpeg"):
        try:
            return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())  # optional
        except (ImportError, RuntimeError, AttributeError) as error:
            raise OSError(str(error)) from error
    found = _ffmpeg_on_path()
    if found is None:
        raise OSError("there is no ffmpeg with libx264")
    return found


class _Av(_Pen):
    """H.264 by PyAV."""

    def __init__(self, file: Path, size: tuple[int, int], fps: float) -> None:
        try:
            self._av: Any = importlib.import_module("av")  # optional
            self._container = self._av.open(str(file), "w", options={"movflags": "faststart"})
            self._stream = self._container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        except (ImportError, ValueError) as error:
            raise OSError(str(error)) from error
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt, self._stream.options = "yuv420p", {"crf": CRF}
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _LIMITED_RANGE

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        self._encode(picture.reformat(format="yuv420p", dst_colorspace=_BT709, dst_color_range=_LIMITED_RANGE))

    def close(self) -> None:
        try:
            self._encode(None)
        finally:
            with self._as_oserror():
                self._container.close()

    def _encode(self, picture: Any) -> None:
        with self._as_oserror():
            self._container.mux(self._stream.encode(picture))

    @contextmanager
    def _as_oserror(self) -> Iterator[None]:
        try:
            yield
        except (self._av.FFmpegError, ValueError) as error:
            raise OSError(str(error)) from error


class _OpenCv(_Pen):
    """VP9 or MPEG-4 by OpenCV, which says nothing of what goes wrong."""

    def __init__(self, file: Path, size: tuple[int, int], fps: float, encoder: Encoder) -> None:
        self._writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*_FOURCC[encoder]), fps, size)
        if not self._writer.isOpened():
            raise OSError(f"OpenCV encodes no {CODECS[encoder]} of {size[0]}x{size[1]} at {fps:g} a second")

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        self._writer.write(np.ascontiguousarray(frame[..., ::-1]))

    def close(self) -> None:
        self._writer.release()


class VideoWriter:
    """A context manager: `with VideoWriter(path, 30) as film: film.write(frame)`.

    The file appears under its name when the block ends without an error and the film is whole, and not otherwise.
    Frames are uint8 [h, w, 3], all of the first one's size; an odd last row or column, which the codecs cannot hold, is
    cut off. Raises VdgsError where the film cannot be encoded or written, or would replace what is no film of ours.
    """

    def __init__(self, path: Path, fps: float, encoder: Encoder | None = None) -> None:
        if path.suffix.lower() != ".mp4":
            raise VdgsError(f"{path}: films are written as MP4; give a name that ends in .mp4.")
        self.path, self.fps, self.encoder = path, fps, encoder or default_encoder()
        # absolute: programs take what stands before a colon in a relative name for a protocol
        self._partial = path.absolute().with_name(f".{path.name}.{process_mark()}.partial.mp4")
        self._shape: tuple[int, ...] | None = None
        self._frames = 0
        self._pen: _Pen | None = None

    def __enter__(self) -> VideoWriter:
        check_takes_files(self.path.parent)
        check_own_film(self.path)
        return self

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a frame. Raises ValueError where it differs in size from the first."""
        if self._pen is None:
            self._open(frame.shape)
        if frame.dtype != np.uint8 or frame.shape != self._shape:
            raise ValueError(f"a frame of {frame.dtype} {list(frame.shape)} in a film of {self._shape}")
        assert self._pen is not None
        try:
            self._pen.write(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
        except OSError as error:
            raise self._failure(str(error)) from error
        self._frames += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pen is None:
            if kind is None:
                raise VdgsError(f"{self.path}: the film has no frames.")
            return
        try:
            if kind is not None:
                self._pen.abandon()
                return
            try:
                self._pen.close()
                check_film(self._partial, self._frames)
                with self._partial.open("ab") as film:
                    film.write(_BOX)
                    film.flush()
                    os.fsync(film.fileno())
                os.replace(self._partial, self.path)
            except OSError as fault:
                raise self._failure(str(fault)) from fault
        finally:
            self._partial.unlink(missing_ok=True)

    def _open(self, shape: tuple[int, ...]) -> None:
        size = shape[1] // 2 * 2, shape[0] // 2 * 2
        if 0 in size:
            raise VdgsError(f"{self.path}: a film needs at least 2 x 2 pixels, not {shape[1]} x {shape[0]}.")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path)
            if self.encoder == "ffmpeg":
                self._pen = _Ffmpeg(self._partial, size, self.fps)
            elif self.encoder == "av":
                self._pen = _Av(self._partial, size, self.fps)
            else:
                self._pen = _OpenCv(self._partial, size, self.fps, self.encoder)
        except OSError as error:
            raise self._failure(str(error)) from error
        self._shape = shape

    def _failure(self, why: str) -> VdgsError:
        if is_disk_full(self.path.parent) or "No space left" in why:
            return VdgsError(
                f"{self.path} cannot be written: the disk is full ({why}). Free some space or choose another "
                "folder, then run the same command again."
            )
        return VdgsError(f"{self.path} cannot be encoded ({why}). {_REMEDY}")


def check_own_film(path: Path) -> None:
    """Raise VdgsError where another file than a film of `VideoWriter`, or an empty one, has the name of a new film."""
    if path.is_file() and path.stat().st_size and not _is_own_film(path):
        raise VdgsError(
            f"{path}: is there already, and no film of `vdgs render`. Nothing was drawn. Choose another name, or "
            "remove the file."
        )


def _is_own_film(file: Path) -> bool:
    """Whether a film ends with our mark; False too where it cannot be read."""
    try:
        with file.open("rb") as film:
            film.seek(-min(len(_BOX), film.seek(0, os.SEEK_END)), os.SEEK_END)
            return film.read() == _BOX
    except OSError:
        return False


def check_film(file: Path, frames: int) -> None:
    """Raise OSError where an MP4 is not whole: its parts end before or beyond the file, frames are missing, or the last
    one cannot be decoded."""
    if not file.is_file() or file.stat().st_size == 0:
        raise OSError("the encoder wrote nothing")
    if not {b"moov", b"mdat"} <= _parts(file):
        raise OSError("the encoder did not finish the file")
    film = cv2.VideoCapture(str(file))
    try:
        found = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
        if abs(found - frames) > 1:  # encoders may count the last one otherwise
            raise OSError(f"{found} of {frames} frames are in it")
        film.set(cv2.CAP_PROP_POS_FRAMES, max(0, found - 1))
        if not film.read()[0]:
            raise OSError("its last frame cannot be decoded")
    finally:
        film.release()


def _parts(file: Path) -> set[bytes]:
    """The kinds of the parts of an MP4. OSError where they do not fill the file."""
    kinds, place, size = set[bytes](), 0, file.stat().st_size
    with file.open("rb") as data:
        while place < size:
            data.seek(place)
            head = data.read(16)
            length = struct.unpack(">I", head[:4])[0] if len(head) >= 8 else 0
            if length == 1 and len(head) == 16:
                length = struct.unpack(">Q", head[8:])[0]
            if length < 8 or place + length > size:
                raise OSError("the file is cut off")
            kinds.add(head[4:8])
            place += length
    return kinds
