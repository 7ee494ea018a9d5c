"""A film as PyAV decodes it: its frames with their moments, its subtitles, and what it says of itself."""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from vdgs.errors import CaptureError
from vdgs.sfm.films.high_dynamic_range import HDR_TRANSFERS, to_standard_range
from vdgs.sfm.films.subtitle_files import read_subtitle_file, subtitle_files
from vdgs.sfm.films.telemetry import Telemetry, places, read_telemetry
from vdgs.sfm.image_metadata import MIN_SIDE_PX
from vdgs.system.quoting import shell_word

#: Films of all directions, which hold no view of one lens.
PANORAMIC_SUFFIXES = {".insv", ".360"}
#: Of films with fewer lines than this, which do not say their colors, these are those of BT.601, else of BT.709.
_HD_LINES = 720
#: FFmpeg's numbers of color spaces: BT.709, BT.2020 (and its kind with constant luminance).
_BT709, _BT2020, _UNSPECIFIED = 1, (9, 10), (2, 0)
#: Codecs of data tracks in which cameras write positions that are not read.
_DATA_TRACKS = {"djmd": "DJI", "dbgi": "DJI", "gpmd": "GoPro", "camm": "Google"}
_ISO6709 = re.compile(r"([+-]\d+(?:\.\d+)?)([+-]\d+(?:\.\d+)?)")
#: How films name who made them.
_MAKE_KEYS = ("make", "com.apple.quicktime.make", "com.android.manufacturer")
_MODEL_KEYS = ("model", "com.apple.quicktime.model", "com.android.model", "encoder")
_PLACE_KEYS = ("location", "com.apple.quicktime.location.ISO6709", "location-eng", "xyz")
_CAMERA = re.compile(r"(DJI|GoPro|Autel|Parrot|Skydio|Insta360)\b.*", re.IGNORECASE)


class FilmFrame(NamedTuple):
    """A decoded frame: the how many-th, its moment in seconds from the film's start, and the picture."""

    number: int
    seconds: float
    picture: Any


class Subtitles(NamedTuple):
    """What subtitles say of the moments of a film."""

    records: tuple[Telemetry, ...]
    source: str
    """Which they are, also where they say nothing; empty where there are none."""
    refused: str = ""
    """Why they cannot be used."""


@dataclass(kw_only=True)
class Film:
    """An open film."""

    path: Path
    container: Any
    stream: Any
    seconds: float
    """How long it is; 0 where it does not say that."""
    start: float
    """When its first frame is shown by the clock of its tracks, in seconds."""
    camera: tuple[str, str]
    """Maker and model; empty where the film does not say them."""
    created: datetime | None
    place: tuple[float, float] | None
    """Latitude and longitude at the start."""
    notes: list[str] = field(default_factory=list)
    damaged: int = 0
    """Packets that could not be decoded."""
    damaged_s: float = 0.0
    """How long frames are shown that are damaged, or made of such, and left out."""
    count: int = 0
    """Frames that were read."""
    shown_s: float = 0.0
    """The moment of the last frame that was read."""
    _is_broken: bool = False
    _broken_pts: float = -math.inf
    """Of the last packet that could not be decoded."""
    subtitles: list[tuple[float, str]] = field(default_factory=list)
    """Those that were read on the way."""

    def frames(self) -> Iterator[FilmFrame]:
        """All frames in order, but for damaged ones. Raises CaptureError for what cannot become photographs."""
        whole = 0
        for picture in self._pictures():
            if not self.count:
                _check(self, picture)
            before, self.shown_s = self.shown_s, self.count / float(self.stream.average_rate or 25)
            if picture.time is not None:
                self.shown_s = float(picture.time) - self.start
            if self._is_whole(picture):
                yield FilmFrame(self.count, self.shown_s, picture)
                whole += 1
            else:
                self.damaged_s += max(0.0, self.shown_s - before)
            self.count += 1
        if not whole:
            why = "are whole" if self.count else "can be decoded"
            raise CaptureError(f"{self.path}: none of its frames {why}. Copy the film again.")

    def _is_whole(self, picture: Any) -> bool:
        """Whether nothing is damaged of a picture, and of those that it is made of: up to the next key frame each is
        made of the one before it. Decoders tell of a packet before they give the pictures of those before it."""
        if picture.key_frame and (picture.pts is None or picture.pts > self._broken_pts):
            self._is_broken = False
        self._is_broken |= picture.is_corrupt
        return not self._is_broken

    def _pictures(self) -> Iterator[Any]:
        from av.error import FFmpegError

        tracks = [self.stream, *self.container.streams.subtitles]
        packets = self.container.demux(tracks)
        packet = None
        while True:
            try:
                packet = next(packets, None)
                if packet is None:
                    return
                if packet.stream.type == "subtitle":
                    self._read_subtitle(packet)
                    continue
                yield from packet.decode()
            except FFmpegError:  # what follows may be whole
                self._is_broken = True
                if packet is not None and packet.stream is self.stream and packet.pts is not None:
                    self._broken_pts = packet.pts
                self.damaged += 1
                if self.damaged > 1000:
                    return

    def _read_subtitle(self, packet: Any) -> None:
        words = bytes(packet)
        if packet.stream.codec_context.name == "mov_text":
            words = words[2 : 2 + int.from_bytes(words[:2], "big")]
        if words and packet.pts is not None:
            seconds = float(packet.pts * packet.time_base) - self.start
            self.subtitles.append((seconds, words.decode("utf-8", errors="replace")))

    def telemetry(self) -> Subtitles:
        """What its subtitles say, once its frames were read, or else the file of subtitles beside it."""
        found = [Subtitles(read_telemetry(self.subtitles, self.place), "its subtitles")] if self.subtitles else []
        if not any(any(places(each.records)) for each in found):
            found += [self._telemetry_beside(file) for file in subtitle_files(self.path)]
        found.sort(key=lambda each: (not any(places(each.records)), not each.records))
        return found[0] if found else Subtitles((), "")

    def _telemetry_beside(self, file: Path) -> Subtitles:
        try:
            return Subtitles(
                read_telemetry(read_subtitle_file(file, self.seconds or self.shown_s), self.place), file.name
            )
        except CaptureError as error:
            return Subtitles((), file.name, str(error))


@contextmanager
def open_film(path: Path) -> Iterator[Film]:
    """An open film. Raises CaptureError where PyAV is missing, and for files that are no film or are cut off."""
    av = _pyav(path)
    if path.suffix.lower() in PANORAMIC_SUFFIXES:
        raise CaptureError(
            f"{path}: is a film of all directions. Export views of one direction out of the program of the camera, as "
            "MP4 (reframe), and give these."
        )
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(_cannot_open(path, error)) from None
    with container:
        if not container.streams.video:
            raise CaptureError(f"{path}: holds no pictures (sound alone?).")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        tags = {**stream.metadata, **container.metadata}
        tags = {key.lower(): value for key, value in tags.items()}
        start = float((stream.start_time or 0) * stream.time_base)
        seconds = float((container.duration or 0) / av.time_base)
        if container.format.name.startswith("matroska"):  # which counts until the end, not from the first frame
            seconds = max(0.0, seconds - start)
        yield Film(
            path=path, container=container, stream=stream, seconds=seconds, start=start, camera=_camera(tags),
            created=_created(tags), place=_start_place(tags),
        )  # fmt: skip


def _pyav(path: Path) -> Any:
    try:
        return importlib.import_module("av")  # its log stays off, as by default: it can block threads that decode
    except ImportError:
        frames = f"ffmpeg -i {shell_word(path)} -vf fps=1 -qscale:v 2 frame_%05d.jpg"
        raise CaptureError(
            f"{path}: is a film, and films need PyAV: pip install 'vdgs[video]'. Or take frames out of the film with "
            f"another program, without their positions ({frames}), and give their folder."
        ) from None


def _cannot_open(path: Path, error: BaseException) -> str:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return (
            f"{path}: the film has no index (moov), as where the battery was taken out while it was recorded, or it "
            "was not copied whole. Copy it again; if the card has no more of it, the drone mends it when switched on "
            "with the card in it, or untrunc does."
        )
    why = str(error).splitlines()[0][:120]
    return f"{path}: is no film that can be read ({why}). Copy it again, or convert it to MP4."


def _check(film: Film, picture: Any) -> None:
    if min(picture.width, picture.height) < MIN_SIDE_PX:
        raise CaptureError(f"{film.path}: is {picture.width} x {picture.height} pixels, too small to be matched.")
    if picture.interlaced_frame:
        better = film.path.with_name(f"{film.path.stem}-whole.mp4").name
        raise CaptureError(
            f"{film.path}: is interlaced: each frame holds the lines of two moments. Make whole frames first: ffmpeg "
            f"-i {shell_word(film.path)} -vf bwdif -c:s copy -crf 16 {shell_word(better)}"
        )
    if picture.color_trc in HDR_TRANSFERS:
        film.notes.append(f"is HDR ({HDR_TRANSFERS[picture.color_trc]}); its frames are written in the colors of sRGB")
    others = {_DATA_TRACKS[tag] for tag in map(_codec_tag, film.container.streams) if tag in _DATA_TRACKS}
    if others:
        film.notes.append(f"has a data track of {' and '.join(sorted(others))}, which is not read")


def _codec_tag(stream: Any) -> str:
    context = getattr(stream, "codec_context", None)
    return str(getattr(context, "codec_tag", "") or stream.metadata.get("handler_name", "")).strip().lower()[-4:]


def _camera(tags: dict[str, str]) -> tuple[str, str]:
    make, model = ("".join(tags.get(key, "") for key in keys[:1]) or next(
        (tags[key] for key in keys if key in tags), "") for keys in (_MAKE_KEYS, _MODEL_KEYS))  # fmt: skip
    if not make and not _CAMERA.fullmatch(model):  # an encoder's own name
        return "", ""
    return make.strip(), model.strip()


def _created(tags: dict[str, str]) -> datetime | None:
    try:
        found = datetime.fromisoformat(tags.get("creation_time", "").replace("Z", "+00:00"))
    except ValueError:
        return None
    return found.replace(tzinfo=None) if found.year > 1980 else None


def _start_place(tags: dict[str, str]) -> tuple[float, float] | None:
    """Latitude and longitude in degrees; None where no tag says them, or only 0, 0: without a fix."""
    found = (_ISO6709.match(tags.get(key.lower(), "")) for key in _PLACE_KEYS)
    places = ((float(match[1]), float(match[2])) for match in found if match)
    return next((place for place in places if any(place)), None)


def gray_picture(picture: Any, width: int) -> UInt8[np.ndarray, "h w"]:
    """The picture in gray, at most so wide: quick, for looking at many."""
    width = min(width, picture.width)
    height = max(1, round(picture.height * width / picture.width))
    return picture.reformat(width=width, height=height, format="gray", interpolation="AREA").to_ndarray()


def shrink(gray: UInt8[np.ndarray, "h w"], width: int) -> UInt8[np.ndarray, "h w"]:
    if gray.shape[1] <= width:
        return gray
    return cv2.resize(gray, (width, max(1, round(gray.shape[0] * width / gray.shape[1]))), interpolation=cv2.INTER_AREA)


def upright_size(picture: Any) -> tuple[int, int]:
    """Width and height of the picture once it is turned as the film says."""
    size = picture.width, picture.height
    return size[::-1] if round(picture.rotation / 90) % 2 else size


def color_picture(picture: Any) -> UInt8[np.ndarray, "h w 3"]:
    """The picture in sRGB, upright."""
    space, trc = int(picture.colorspace), int(picture.color_trc)
    if space in _UNSPECIFIED and picture.format.name.startswith("yuv"):
        picture.colorspace = _BT709 if picture.height >= _HD_LINES else 5
    if trc in HDR_TRANSFERS:
        deep = picture.reformat(format="rgb48le").to_ndarray()
        image = to_standard_range(deep, trc, wide_gamut=space in _BT2020)
    else:
        image = picture.reformat(format="rgb24").to_ndarray()
    return np.ascontiguousarray(np.rot90(image, round(picture.rotation / 90)))
