"""What drones write into the subtitles of a film: where the drone was, how high, where the camera looked.

Dialects differ by drone and firmware: `[latitude: 47.1] [longitude: 8.2] [rel_alt: 10.0 abs_alt: 400.0]` (also
`longtitude`, blanks before the colon, all within <font>), `GPS(8.2,47.1,15) BAROMETER:10.2`, `GPS (8.2, 47.1, 15), D
24.02m, H 10.20m, G.PRY (-90.0°, 0.0°, 12.1°)`, `GPS(E: 8.2, N: 47.1, 412.00m)`; and with the latitude first
`GPS(47.1,8.2,0.0M) BAROMETER:10.2M` (Matrice 300, XT2).
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import pairwise

from vdgs.captures.angles import LIMITS, degrees_of_text, side_of
from vdgs.captures.table_columns import FOOT_M

#: Between records that are farther apart than this (seconds) nothing is interpolated.
MAX_GAP_S = 3.0
#: Before the first record, after the last and at the ends of a longer gap these count for so many seconds: as far as
#: firmwares' records are apart.
MAX_OUTSIDE_S = 1.0
#: Clocks that lose or gain more against the film (seconds; share of its time) do not run as it does. Whole seconds are
#: cut off (choice).
MAX_DRIFT_S, MAX_DRIFT = 1.0, 0.05
#: A number of a list; one that stands alone, whose comma is that of decimals; and one with its unit.
_NUMBER = r"([-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)"
_ALONE = r"([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)(?![.,]?\d)"
_LENGTH = rf"{_ALONE}\s*(m|ft|feet)?\b"
_TAGS = re.compile(r"<[^>]{0,200}>")
_MOMENT = re.compile(r"(\d{4})[-.:/](\d\d)[-.:/](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,3}))?")
#: Where the drone took off, not where it is.
_HOME = re.compile(r"\bHOME\s*:?\s*(?:\([^)]*\)|\[[^\]]*\]|\{[^}]*\})", re.IGNORECASE)
#: What may follow a number in an angle: minutes and seconds, their signs, and a side.
_REST_OF_ANGLE = re.compile(r"[ \t\d.°º'′’\"″”]*(?:[NSEW](?![\w:]))?", re.IGNORECASE)
_FIX = re.compile(r"\b(?:GPS|RTK)\s*\(([^)]{1,100})\)")
_GIMBAL = re.compile(r"G\.PRY\s*\(([^)]{1,100})")
_HEIGHT = re.compile(rf"(?:\bBAROMETER\s*:?|\bH)\s*{_LENGTH}", re.IGNORECASE)
_KEYED = {
    name: re.compile(rf"(?<![\w.])(?:{words})\s*:\s*{_ALONE}(?:\s*(ft|feet)\b)?", re.IGNORECASE)
    for name, words in {
        "latitude": "latitude|lat", "longitude": "longitude|longtitude|lon", "relative": "rel_alt",
        "absolute": "abs_alt|altitude", "focal": "focal_len", "zoom": "dzoom_ratio|dzoom",
        "yaw": "gb_yaw", "pitch": "gb_pitch", "roll": "gb_roll",
    }.items()
}  # fmt: skip
#: Digital zoom is written as 1.00, or as 10000; focal lengths as 24.00, or as 240.
_ZOOM_UNIT, _FOCAL_UNIT = 10_000.0, 10.0


@dataclass(frozen=True, kw_only=True)
class Telemetry:
    """What is known at one moment of a film."""

    seconds: float
    lat_lon: tuple[float, float] | None = None
    altitude: float | None = None
    """As the drone states it, in metres."""
    relative_altitude: float | None = None
    """Above the take-off."""
    focal_35mm: float | None = None
    """35 mm equivalent with the digital zoom."""
    gimbal: tuple[float, float, float] | None = None
    """Yaw, pitch and roll in degrees, as DJI counts them."""
    moment: datetime | None = None


@dataclass(frozen=True)
class _Pair:
    """A latitude and a longitude in an order that is not said."""

    numbers: tuple[float, float]
    in_capital_m: bool
    """Whether an altitude in M is the third, as drones write it that write the latitude first (Matrice 300, XT2)."""


def read_telemetry(
    blocks: Sequence[tuple[float, str]], place: tuple[float, float] | None = None
) -> tuple[Telemetry, ...]:
    """What the blocks say, in order of time; empty where no block has anything of it. `place` (latitude, longitude) is
    what the film says of where it was begun: it decides the order of two numbers without names."""
    found = [_read(seconds, _TAGS.sub(" ", words)) for seconds, words in blocks]
    latitude_first = _latitude_first([pair for _, pair in found if pair is not None], place)
    records = list[Telemetry]()
    for record, pair in found:
        if pair is not None:
            numbers = pair.numbers if latitude_first else pair.numbers[::-1]
            record = replace(record, lat_lon=_place(*numbers))
        if any(value is not None for name, value in vars(record).items() if name != "seconds"):
            records.append(record)
    records.sort(key=lambda record: record.seconds)
    return _on_one_clock(records)


def _on_one_clock(records: Sequence[Telemetry]) -> tuple[Telemetry, ...]:
    """The records, with the moments of one clock that runs as the film does where their own do not rise from record to
    record: of those that are written in whole seconds on each frame, the frames of a second have no order. Clocks that
    run otherwise than the film (slow motion, hyperlapses, films that were joined) are left alone."""
    clocked = [record for record in records if record.moment is not None]
    moments = [record.moment for record in clocked if record.moment is not None]
    if all(one < other for one, other in pairwise(moments)):
        return tuple(records)
    lasted, shown = (moments[-1] - moments[0]).total_seconds(), clocked[-1].seconds - clocked[0].seconds
    if abs(lasted - shown) > max(MAX_DRIFT_S, MAX_DRIFT * shown):
        return tuple(records)
    starts = sorted(moment - timedelta(seconds=record.seconds) for moment, record in zip(moments, clocked, strict=True))
    cut_off = timedelta(seconds=0 if any(moment.microsecond for moment in moments) else 0.5)  # what is, in the median
    start = starts[len(starts) // 2] + cut_off
    return tuple(
        record if record.moment is None else replace(record, moment=start + timedelta(seconds=record.seconds))
        for record in records
    )


def telemetry_at(records: Sequence[Telemetry], seconds: float) -> Telemetry:
    """What is known at a moment: positions and heights between those of the records around it, all else as the record
    before it has. Where any record has a place, those without one (the drone had no fix) say no height either."""
    around = _around(records, seconds)
    known = Telemetry(seconds=seconds, moment=_moment_at(records, seconds))
    if around is None:
        return known
    known = replace(known, focal_35mm=around[0].focal_35mm, gimbal=around[0].gimbal)
    placed = _around([record for record in records if record.lat_lon is not None] or records, seconds)
    if placed is None:
        return known
    one, other, share = placed
    return replace(
        known,
        lat_lon=_place_between(one.lat_lon, other.lat_lon, share),
        altitude=_between(one.altitude, other.altitude, share),
        relative_altitude=_between(one.relative_altitude, other.relative_altitude, share),
    )


def _around(records: Sequence[Telemetry], seconds: float) -> tuple[Telemetry, Telemetry, float] | None:
    """The records before and after a moment, and the share of the way between them; in a longer gap and outside of all
    twice the nearest, None where that is far."""
    if not records:
        return None
    after = bisect_right(records, seconds, key=lambda record: record.seconds)
    one, other = records[max(0, after - 1)], records[min(after, len(records) - 1)]
    span = other.seconds - one.seconds
    if 0 < span <= MAX_GAP_S:
        return one, other, (seconds - one.seconds) / span
    nearest = min(one, other, key=lambda record: abs(record.seconds - seconds))
    return (nearest, nearest, 0.0) if abs(nearest.seconds - seconds) <= MAX_OUTSIDE_S else None


def _moment_at(records: Sequence[Telemetry], seconds: float) -> datetime | None:
    """By the clock of the last record with one before the moment, else of the first: the film runs on in gaps."""
    clocked = [record for record in records if record.moment is not None]
    if not clocked:
        return None
    record = clocked[max(0, bisect_right(clocked, seconds, key=lambda record: record.seconds) - 1)]
    return record.moment and record.moment + timedelta(seconds=seconds - record.seconds)


def _place_between(
    one: tuple[float, float] | None, other: tuple[float, float] | None, share: float
) -> tuple[float, float] | None:
    if one is None or other is None:
        return None
    east = _wrapped(other[1] - one[1])
    return one[0] + share * (other[0] - one[0]), _wrapped(one[1] + share * east)


def _wrapped(degrees: float) -> float:
    """Brought into the range from -180 to 180; the same bits where it is there."""
    return degrees - 360 * round(degrees / 360)


def _between(one: float | None, other: float | None, share: float) -> float | None:
    return one if one is None or other is None else one + share * (other - one)


def _read(seconds: float, words: str) -> tuple[Telemetry, _Pair | None]:
    """What a block says, and two numbers that are latitude and longitude in an order that is not said."""
    words = _HOME.sub(" ", words)
    values = {name: _quantity(match) for name, pattern in _KEYED.items() if (match := pattern.search(words))}
    is_named = {"latitude", "longitude"} <= values.keys()
    latitude, longitude = (_angle(words, axis) for axis in LIMITS) if is_named else (None, None)
    place = None if latitude is None or longitude is None else _place(latitude, longitude)
    sided, unnamed, altitude = _fix(words) if place is None else (None, None, None)
    height = _HEIGHT.search(words)
    relative = values.get("relative", _quantity(height) if height else None)
    gimbal = _gimbal(words)
    if {"yaw", "pitch", "roll"} <= values.keys():
        gimbal = values["yaw"], values["pitch"], values["roll"]
    record = Telemetry(
        seconds=seconds,
        lat_lon=place or sided,
        altitude=values.get("absolute", altitude),
        relative_altitude=relative,
        focal_35mm=_focal(words, values),
        gimbal=gimbal,
        moment=moment_of(words),
    )
    return record, unnamed


def _quantity(match: re.Match[str]) -> float:
    """A number and what follows it: as it is, in metres where it is in feet."""
    return float(match[1].replace(",", ".")) * (FOOT_M if (match[2] or "").lower().startswith("f") else 1.0)


def _angle(words: str, axis: str) -> float | None:
    """The latitude or longitude that words name: decimal, or with minutes, and with a side or a sign; None for what is
    no such angle."""
    match = _KEYED[axis].search(words)
    if match is None:
        return None
    number, rest = match[1].replace(",", "."), _REST_OF_ANGLE.match(words, match.end(1))
    behind = rest[0].strip() if rest else ""
    if not behind or ("." in number and behind[0].isdigit()):  # another number
        return float(number)
    found = degrees_of_text(f"{number.lstrip('+-')} {behind}", axis)
    return None if found is None else _signed(found[0], is_negative=number.startswith("-"))


def _signed(angle: float, *, is_negative: bool) -> float:
    """An angle whose side may be written twice, as a letter and as a sign."""
    return -abs(angle) if is_negative else angle


def _parts(listed: str) -> list[str]:
    """The parts of a list; without a period in it, more than three are numbers with decimal commas."""
    parts = [part.strip() for part in listed.split(",")]
    if "." in listed or len(parts) <= 3:
        return parts
    return [".".join(parts[k : k + 2]) for k in range(0, len(parts), 2)]


def _gimbal(words: str) -> tuple[float, float, float] | None:
    """Of `G.PRY (pitch, roll, yaw)`: yaw, pitch and roll in degrees."""
    found = _GIMBAL.search(words)
    angles = [re.fullmatch(rf"{_NUMBER}\s*°?", part) for part in _parts(found[1])] if found else []
    if len(angles) != 3 or any(angle is None for angle in angles):
        return None
    pitch, roll, yaw = (float(angle[1]) for angle in angles if angle is not None)
    return yaw, pitch, roll


def _fix(words: str) -> tuple[tuple[float, float] | None, _Pair | None, float | None]:
    """Of `GPS(...)`: the place by sides (E: 8.2, N: 47.1), two numbers without, and the altitude where it has a unit:
    without one the third number counts satellites, and in M it is always 0."""
    found = _FIX.search(words)
    if found is None:
        return None, None, None
    parts = _parts(found[1])
    lengths = (re.fullmatch(rf"{_NUMBER}\s*(m|ft|feet)", part) for part in parts[2:])
    altitude = next((_quantity(length) for length in lengths if length), None)
    sides, plain = dict[str, float](), list[float]()
    for part in parts[:2]:
        match = re.fullmatch(rf"(?:([NSEW])\s*:\s*)?{_NUMBER}", part, re.IGNORECASE)
        if match is None:
            return None, None, None
        axis = "latitude" if (match[1] or "").upper() in ("N", "S") else "longitude"
        if match[1]:
            side = (side_of(match[1], axis) or 1.0) * abs(float(match[2]))
            sides[axis] = _signed(side, is_negative=float(match[2]) < 0)
        plain.append(float(match[2]))
    if len(sides) == 2:
        return _place(sides["latitude"], sides["longitude"]), None, altitude
    if len(plain) != 2 or not any(plain):
        return None, None, altitude
    in_capital_m = any(re.fullmatch(rf"{_NUMBER}\s*M", part) for part in parts[2:])
    return None, _Pair((plain[0], plain[1]), in_capital_m), altitude


def _latitude_first(pairs: Sequence[_Pair], place: tuple[float, float] | None) -> bool:
    """DJI writes the longitude first; old firmware and the Matrice 300 do not. Numbers beyond 90 decide, then where the
    film began, then an altitude in M."""
    if any(abs(pair.numbers[0]) > LIMITS["latitude"] for pair in pairs):
        return False
    if any(abs(pair.numbers[1]) > LIMITS["latitude"] for pair in pairs):
        return True
    if place is None or not pairs:
        return any(pair.in_capital_m for pair in pairs)
    first, second = pairs[0].numbers
    return _away((first, second), place) < _away((second, first), place)


def _away(one: tuple[float, float], other: tuple[float, float]) -> float:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def _place(latitude: float, longitude: float) -> tuple[float, float] | None:
    """None for 0, 0, which drones write without a fix, and for what is no place."""
    known = abs(latitude) <= LIMITS["latitude"] and abs(longitude) <= LIMITS["longitude"] and (latitude or longitude)
    return (latitude, longitude) if known else None


def _focal(words: str, values: dict[str, float]) -> float | None:
    focal, zoom = values.get("focal"), values.get("zoom") or 1.0
    if not focal:
        return None
    zoom = zoom / _ZOOM_UNIT if zoom >= _ZOOM_UNIT / 10 else zoom
    written = _KEYED["focal"].search(words)
    focal = focal if written is None or re.search("[.,]", written[1]) else focal / _FOCAL_UNIT
    return focal * max(zoom, 1.0) if 5 <= focal <= 2000 else None


def moment_of(words: str) -> datetime | None:
    """The moment that words state, by a clock of their own."""
    found = _MOMENT.search(words)
    if found is None:
        return None
    try:
        year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
        return datetime(year, month, day, hour, minute, second, int((found[7] or "0").ljust(3, "0")) * 1000)
    except ValueError:
        return None


def places(records: Sequence[Telemetry]) -> Iterator[tuple[float, float]]:
    """The positions of all records that have one."""
    return (record.lat_lon for record in records if record.lat_lon is not None)
