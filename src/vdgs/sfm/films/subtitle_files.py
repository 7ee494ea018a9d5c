"""Files of subtitles beside a film (.SRT): which are of it, their blocks, and those that a person joined."""

from __future__ import annotations

import re
import statistics
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from vdgs.captures.name_resolution import to_nfc
from vdgs.captures.text_tables import decode_text
from vdgs.errors import CaptureError
from vdgs.sfm.films.telemetry import moment_of
from vdgs.system.units import duration

#: Times that fall by more than this (seconds) begin again: a block out of its order falls by less (choice).
MAX_FALL_S = 1.0
#: The lengths of joined parts add up to that of the film within so many seconds for each part: the last block of a
#: second lasts to its end, also where the film does not.
MAX_OFF_S = 1.0
_TIME = r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})"
_TIMES = re.compile(rf"{_TIME}\s*-->(?:\s*{_TIME})?")


class _Block(NamedTuple):
    """When a subtitle begins and ends, in seconds, and its words."""

    start: float
    end: float
    words: str


def subtitle_files(film: Path) -> list[Path]:
    """The files of subtitles beside a film: of its name in any case, with or without its suffix."""
    names = {to_nfc(name).lower() for name in (film.stem, film.name)}
    return [file for file in _all_beside(film) if to_nfc(file.stem).lower() in names]


def other_subtitle_files(film: Path) -> list[Path]:
    """The files of subtitles beside a film that are of no file there, by their names."""
    stems = {
        to_nfc(name).lower() for each in film.parent.iterdir() if each.suffix.lower() != ".srt"
        for name in (each.stem, each.name)
    }  # fmt: skip
    return [file for file in _all_beside(film) if to_nfc(file.stem).lower() not in stems]


def _all_beside(film: Path) -> list[Path]:
    return sorted(film.parent.glob("*.[sS][rR][tT]"))


def read_subtitle_file(file: Path, film_s: float) -> list[tuple[float, str]]:
    """The blocks of a file: when each begins in a film of so many seconds, and its words. Raises CaptureError."""
    try:
        return read_subtitles(decode_text(file.read_bytes()), film_s)
    except CaptureError as error:
        raise CaptureError(f"{file.name}: {error}") from None


def read_subtitles(text: str, film_s: float = 0.0) -> list[tuple[float, str]]:
    """The blocks of a file of subtitles (.SRT): when each begins, in seconds, and its words.

    Files that were joined, whose times begin again, follow one another where they are as long as the film (`film_s`
    seconds) together. Raises CaptureError where they are not.
    """
    marks = list(_TIMES.finditer(text))
    ends = ([mark.start() for mark in marks] + [len(text)])[1:]
    blocks = [
        _Block(_seconds(mark.groups()[:4]), _seconds(mark.groups()[4:]), text[mark.end() : end])
        for mark, end in zip(marks, ends, strict=True)
    ]
    parts = _parts(blocks)
    starts = [0.0] * len(parts) if _are_apart(parts) else _starts(parts, film_s)
    return [(start + each.start, each.words) for start, part in zip(starts, parts, strict=True) for each in part]


def _seconds(groups: Sequence[str | None]) -> float:
    """Of hours, minutes, seconds and their fraction; 0 where there are none."""
    hours, minutes, seconds, fraction = (each or "0" for each in groups)
    return 3600 * int(hours) + 60 * int(minutes) + int(seconds) + int(fraction.ljust(3, "0")) / 1000


def _parts(blocks: Sequence[_Block]) -> list[list[_Block]]:
    """The blocks in order, parted where their times fall."""
    parts: list[list[_Block]] = []
    for block in blocks:
        if not parts or block.start < parts[-1][-1].start - MAX_FALL_S:
            parts.append([])
        parts[-1].append(block)
    return parts


def _are_apart(parts: Sequence[Sequence[_Block]]) -> bool:
    """Whether parts are of times of their own, so that one clock goes through all in some order."""
    spans = sorted((part[0].start, part[-1].start) for part in parts)
    return all(after[0] > before[1] - MAX_FALL_S for before, after in pairwise(spans))


def _starts(parts: Sequence[Sequence[_Block]], film_s: float) -> list[float]:
    """When joined parts begin in a film of so many seconds. Raises CaptureError where that is not told."""
    lengths = [_length(part) for part in parts]
    clocks = [next(filter(None, (moment_of(block.words) for block in part)), None) for part in parts]
    is_in_order = all(not one or not other or one < other for one, other in pairwise(clocks))
    off = sum(lengths) - film_s
    if not is_in_order or abs(off) > MAX_OFF_S * len(parts):
        why = f"which are not as long as the film together ({duration(film_s)})" if is_in_order else "out of order"
        raise CaptureError(
            f"its times begin again, as of {len(parts)} files that were joined "
            f"({' + '.join(map(duration, lengths))}), {why}; give the subtitles of this film alone"
        )
    share = off / len(parts)
    return [sum(lengths[:k]) - k * share for k in range(len(parts))]


def _length(part: Sequence[_Block]) -> float:
    """Until the last block ends, or else would, being as long as the others."""
    steps = [after.start - before.start for before, after in pairwise(part)]
    last = part[-1]
    return last.end if last.end > last.start else last.start + (statistics.median(steps) if steps else 0.0)
