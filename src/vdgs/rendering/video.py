"""Films: frames to an MP4 file, one at a time.

H.264 through imageio-ffmpeg where that is installed (it plays everywhere, browsers included), else
MPEG-4 through OpenCV.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from vdgs.errors import VdgsError

Encoder = Literal["h264", "mpeg4"]


def default_encoder() -> Encoder:
    """The encoder that `VideoWriter` uses unless told otherwise."""
    return "h264" if importlib.util.find_spec("imageio_ffmpeg") else "mpeg4"


class VideoWriter:
    """A context manager: `with VideoWriter(path, 30) as film: film.write(frame)`.

    The file appears under its name when the block ends without an error, and not otherwise. Frames are
    uint8 [h, w, 3], all of the first one's size; an odd last row or column, which the codecs cannot
    hold, is cut off. Raises VdgsError where the film cannot be encoded or written.
    """

    def __init__(self, path: Path, fps: float, encoder: Encoder | None = None) -> None:
        if path.suffix.lower() != ".mp4":
            raise VdgsError(f"{path}: films are written as MP4; give a name that ends in .mp4.")
        self.path, self.fps, self.encoder = path, fps, encoder or default_encoder()
        self._partial = path.with_name(f".{path.stem}.{os.getpid()}.partial.mp4")
        self._shape: tuple[int, ...] | None = None
        self._opencv: Any = None
        self._ffmpeg: Generator[None, bytes | None, None] | None = None

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, frame: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a frame. Raises ValueError where it differs in size from the first."""
        if self._shape is None:
            self._open(frame.shape)
        if frame.dtype != np.uint8 or frame.shape != self._shape:
            raise ValueError(f"a frame of {frame.dtype} {list(frame.shape)} in a film of {self._shape}")
        even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
        if self._ffmpeg is not None:
            try:
                self._ffmpeg.send(np.ascontiguousarray(even).tobytes())
            except (OSError, StopIteration) as error:
                raise self._failure(str(error)) from error
        else:
            self._opencv.write(np.ascontiguousarray(even[..., ::-1]))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ffmpeg is not None:
            self._ffmpeg.close()
        if self._opencv is not None:
            self._opencv.release()
        if kind is not None:
            self._partial.unlink(missing_ok=True)
            return
        if self._shape is None:
            raise VdgsError(f"{self.path}: the film has no frames.")
        if not self._partial.is_file() or self._partial.stat().st_size == 0:
            self._partial.unlink(missing_ok=True)
            raise self._failure("the encoder wrote nothing")
        os.replace(self._partial, self.path)

    def _open(self, shape: tuple[int, ...]) -> None:
        height, width = shape[0] // 2 * 2, shape[1] // 2 * 2
        if height == 0 or width == 0:
            raise VdgsError(f"{self.path}: a film needs at least 2 x 2 pixels, not {shape[1]} x {shape[0]}.")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.encoder == "h264":
            self._open_h264(width, height)
        else:
            writer = cv2.VideoWriter(str(self._partial), cv2.VideoWriter.fourcc(*"mp4v"), self.fps, (width, height))
            if not writer.isOpened():
                raise self._failure(f"OpenCV encodes no MPEG-4 of {width}x{height} at {self.fps:g} a second")
            self._opencv = writer
        self._shape = shape

    def _open_h264(self, width: int, height: int) -> None:
        try:
            ffmpeg: Any = importlib.import_module("imageio_ffmpeg")  # optional
            self._ffmpeg = ffmpeg.write_frames(
                str(self._partial),
                (width, height),
                fps=self.fps,
                codec="libx264",
                quality=8,
                macro_block_size=2,
            )
            assert self._ffmpeg is not None
            self._ffmpeg.send(None)
        except (ImportError, OSError, RuntimeError) as error:
            raise self._failure(str(error)) from error

    def _failure(self, why: str) -> VdgsError:
        return VdgsError(
            f"{self.path} cannot be encoded ({why}). Install an encoder with `pip install imageio-ffmpeg`, "
            "or render single images instead."
        )
