"""What drones write into the subtitles of a film: where the drone was, how high, where the camera looked.

Dialects differ by drone and firmware: `[latitude: 47.1] [longitude: 8.2] [rel_alt: 10.0 abs_alt: 400.0]` (also
`longtitude`, blanks before the colon, all within <font>), `GPS(8.2,47.1,15) BAROMETER:10.2`, `GPS (8.2, 47.1, 15), D
24.02m, H 10.20m, G.PRY (-90.0°, 0.0°, 12.1°)`, `GPS(E: 8.2, N: 47.1, 412.00m)`.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from vdgs.captures.angles import LIMITS, side_of

#: Between records that are farther apart than this (seconds) nothing is known.
MAX_GAP_S = 3.0
#: Before the first record and after the last these count for so many seconds: as far as firmwares' records are apart.
MAX_OUTSIDE_S = 1.0
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_TIMES = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_TAGS = re.compile(r"<[^>]{0,200}>")
_MOMENT = re.compile(r"(\d{4})[-.:/](\d\d)[-.:/](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,3}))?")
_FIX = re.compile(r"\b(?:GPS|RTK)\s*\(([^)]{1,100})\)")
_GIMBAL = re.compile(rf"G\.PRY\s*\(\s*{_NUMBER}°?\s*,\s*{_NUMBER}°?\s*,\s*{_NUMBER}")
_HEIGHT = re.compile(rf"(?:\bBAROMETER\s*:?|\bH)\s*{_NUMBER}\s*m?\b", re.IGNORECASE)
_KEYED = {
    name: re.compile(rf"(?<![\w.])(?:{words})\s*:\s*{_NUMBER}", re.IGNORECASE)
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


def read_subtitles(text: str) -> list[tuple[float, str]]:
    """The blocks of a file of subtitles (.SRT): when each begins, in seconds, and its words."""
    marks = list(_TIMES.finditer(text))
    ends = ([mark.start() for mark in marks] + [len(text)])[1:]
    return [
        (3600 * int(mark[1]) + 60 * int(mark[2]) + int(mark[3]) + int(mark[4].ljust(3, "0")) / 1000,
         text[mark.end() : end])
        for mark, end in zip(marks, ends, strict=True)
    ]  # fmt: skip


def read_telemetry(
    blocks: Sequence[tuple[float, str]], place: tuple[float, float] | None = None
) -> tuple[Telemetry, ...]:
    """What the blocks say, in order of time; empty where no block has anything of it. `place` (latitude, longitude) is
    what the film says of where it was begun: it decides the order of two numbers without names."""
    found = [_read(seconds, _TAGS.sub(" ", words)) for seconds, words in blocks]
    unnamed = [pair for _, pair in found if pair is not None]
    latitude_first = _latitude_first(unnamed, place)
    records = []
    for record, pair in found:
        if pair is not None:
            record = replace(record, lat_lon=_place(*(pair if latitude_first else pair[::-1])))
        if any(value is not None for name, value in vars(record).items() if name != "seconds"):
            records.append(record)
    return tuple(sorted(records, key=lambda record: record.seconds))


def telemetry_at(records: Sequence[Telemetry], seconds: float) -> Telemetry:
    """What is known at a moment: positions and heights between those of the records around it, all else as the record
    before it has."""
    if not records:
        return Telemetry(seconds=seconds)
    after = bisect_right([record.seconds for record in records], seconds)
    one, other = records[max(0, after - 1)], records[min(after, len(records) - 1)]
    outside = max(records[0].seconds - seconds, seconds - records[-1].seconds)
    if abs(one.seconds - seconds) > MAX_GAP_S or outside > MAX_OUTSIDE_S:
        return Telemetry(seconds=seconds)
    span = other.seconds - one.seconds
    share = (seconds - one.seconds) / span if 0 < span <= MAX_GAP_S else 0.0
    place = one.lat_lon
    if one.lat_lon is not None and other.lat_lon is not None:
        (latitude, longitude), (next_latitude, next_longitude) = one.lat_lon, other.lat_lon
        east = _wrapped(next_longitude - longitude)
        place = latitude + share * (next_latitude - latitude), _wrapped(longitude + share * east)
    return replace(
        one,
        seconds=seconds,
        lat_lon=place,
        altitude=_between(one.altitude, other.altitude, share),
        relative_altitude=_between(one.relative_altitude, other.relative_altitude, share),
        moment=one.moment and one.moment + timedelta(seconds=seconds - one.seconds),
    )


def _wrapped(degrees: float) -> float:
    """Brought into the range from -180 to 180; the same bits where it is there."""
    return degrees - 360 * round(degrees / 360)


def _between(one: float | None, other: float | None, share: float) -> float | None:
    return one if one is None or other is None else one + share * (other - one)


def _read(seconds: float, words: str) -> tuple[Telemetry, tuple[float, float] | None]:
    """What a block says, and two numbers that are latitude and longitude in an order that is not said."""
    values = {name: float(match[1]) for name, pattern in _KEYED.items() if (match := pattern.search(words))}
    place = _place(values["latitude"], values["longitude"]) if {"latitude", "longitude"} <= values.keys() else None
    sided, unnamed, altitude = _fix(words) if place is None else (None, None, None)
    height = _HEIGHT.search(words)
    relative = values.get("relative", float(height[1]) if height else None)
    angles = _GIMBAL.search(words)
    gimbal = (float(angles[3]), float(angles[1]), float(angles[2])) if angles else None
    if {"yaw", "pitch", "roll"} <= values.keys():
        gimbal = values["yaw"], values["pitch"], values["roll"]
    record = Telemetry(
        seconds=seconds,
        lat_lon=place or sided,
        altitude=values.get("absolute", altitude),
        relative_altitude=relative,
        focal_35mm=_focal(words, values),
        gimbal=gimbal,
        moment=_moment(words),
    )
    return record, unnamed


def _fix(words: str) -> tuple[tuple[float, float] | None, tuple[float, float] | None, float | None]:
    """Of `GPS(...)`: the place by sides (E: 8.2, N: 47.1), two numbers without, and the altitude where it has a unit:
    without one the third number counts satellites."""
    found = _FIX.search(words)
    if found is None:
        return None, None, None
    parts = [part.strip() for part in found[1].split(",")]
    altitude = next((float(part[:-1]) for part in parts[2:] if re.fullmatch(rf"{_NUMBER}m", part)), None)
    sides, plain = dict[str, float](), list[float]()
    for part in parts[:2]:
        match = re.fullmatch(rf"(?:([NSEW])\s*:\s*)?{_NUMBER}", part, re.IGNORECASE)
        if match is None:
            return None, None, None
        axis = "latitude" if (match[1] or "").upper() in ("N", "S") else "longitude"
        if match[1]:
            sides[axis] = (side_of(match[1], axis) or 1.0) * float(match[2])
        plain.append(float(match[2]))
    if len(sides) == 2:
        return _place(sides["latitude"], sides["longitude"]), None, altitude
    return None, (plain[0], plain[1]) if len(plain) == 2 and any(plain) else None, altitude


def _latitude_first(pairs: Sequence[tuple[float, float]], place: tuple[float, float] | None) -> bool:
    """DJI writes the longitude first; old firmware does not. Numbers beyond 90 decide, then where the film began."""
    if any(abs(first) > LIMITS["latitude"] for first, _ in pairs):
        return False
    if any(abs(second) > LIMITS["latitude"] for _, second in pairs):
        return True
    if place is None or not pairs:
        return False
    first, second = pairs[0]
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
    focal = focal if written is None or "." in written[1] else focal / _FOCAL_UNIT
    return focal * max(zoom, 1.0) if 5 <= focal <= 2000 else None


def _moment(words: str) -> datetime | None:
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
