"""What a capture says about its place on Earth: georef.json and GPS tables."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.captures.name_resolution import NameLookup, ambiguity_message
from vdgs.errors import CaptureError

_Find = Callable[[str], tuple[tuple[int, int], list[int]]]


@dataclass(frozen=True)
class GpsRow:
    """A photograph's position in a table."""

    line: int
    name: str
    """As it is written there."""
    position: tuple[float, float, float]
    """Latitude and longitude in degrees, altitude in metres."""


def read_georef(file: Path) -> tuple[float, float, float]:
    """Latitude (deg), longitude (deg), altitude (m) of the origin of a world that already is ENU metres.

    Raises `CaptureError` if the file is missing, is not JSON, or does not promise an ENU frame in metres.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror}).") from error
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{file}: is not JSON ({error}). Mend it, or remove it to do without.") from None
    if not isinstance(content, dict) or "ENU" not in str(content.get("frame", "ENU")):
        raise CaptureError(
            f"{file}: describes no ENU frame (x east, y north, z up, metres). Only ENU worlds are "
            "understood; give --up instead and remove the file."
        )
    keys = ("origin_lat_deg", "origin_lon_deg", "origin_alt_m")
    try:
        origin = tuple(float(content[key]) for key in keys)
    except (KeyError, TypeError, ValueError):
        raise CaptureError(f"{file}: must give numbers for {', '.join(keys)}.") from None
    _check_geodetic(origin, file)
    return origin  # type: ignore[return-value]


def read_gps(file: Path) -> list[GpsRow]:
    """The rows of a table of positions; those without a position are left out.

    Raises `CaptureError` for a missing file or column, or a value that is no position.
    """
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            table = csv.DictReader(stream)
            present, rows = set(table.fieldnames or ()), list(table)
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror}).") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CaptureError(f"{file}: is not a CSV table ({error}).") from None
    needed = {"name", "lat", "lon", "alt"}
    if not needed <= present:
        found = ", ".join(sorted(present)) or "nothing"
        raise CaptureError(f"{file}: needs a first line that names the columns name,lat,lon,alt (found: {found}).")
    if not rows:
        raise CaptureError(f"{file}: names its columns but holds no rows. Write one for each photograph.")
    positions = []
    for number, row in enumerate(rows, 2):
        words = [(row[key] or "").strip() for key in ("lat", "lon", "alt")]
        if not all(words) or not row["name"]:
            continue
        try:
            latitude, longitude, altitude = map(float, words)
        except ValueError:
            raise CaptureError(f"{file}: line {number}: {words} are not numbers. Mend the row.") from None
        _check_geodetic((latitude, longitude, altitude), file, f"line {number}: ")
        positions.append(GpsRow(number, row["name"], (latitude, longitude, altitude)))
    return positions


def match_gps(names: Sequence[str], rows: Sequence[GpsRow], file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Indices [m] of the images with a GPS position, and the positions [m, 3] (lat, lon, alt).

    Names match by their whole path, else by the end of it, else without extension; only where the table's folders are
    not those of the images, by what lies in them. Raises `CaptureError` where a name may be of several images, where
    several rows place one image differently, and if no name matches: then it is another flight's table.
    """
    lookup = NameLookup((name, index) for index, name in enumerate(names))
    found = _best_rows(names, rows, lookup.find, file) or _best_rows(names, rows, lookup.find_elsewhere, file)
    if not found:
        raise CaptureError(
            f"{file}: none of its {len(rows)} rows names one of the capture's {len(names)} images "
            f"(for example {names[0]!r}). Give the table of this flight, or leave --gps out."
        )
    indices = sorted(found)
    return np.array(indices), np.array([found[index].position for index in indices])


def _best_rows(names: Sequence[str], rows: Sequence[GpsRow], find: _Find, file: Path) -> dict[int, GpsRow]:
    """For each image that rows name, by its index, the row that names it best."""
    named: dict[int, list[tuple[tuple[int, int], list[int], GpsRow]]] = {}
    for row in rows:
        rank, which = find(row.name)
        for index in which:
            named.setdefault(index, []).append((rank, which, row))
    found = {}
    for index, claims in named.items():
        best = min(rank for rank, _, _ in claims)
        (which, row), *others = [(which, row) for rank, which, row in claims if rank == best]
        if len(which) > 1:
            raise CaptureError(
                f"{file}: line {row.line}: {ambiguity_message(row.name, names[which[0]], names[which[1]])}"
            )
        other = next((each for _, each in others if each.position != row.position), None)
        if other is not None:
            raise CaptureError(
                f"{file}: lines {row.line} and {other.line} ({row.name!r}, {other.name!r}) give {names[index]} "
                "different positions. Keep its own row only; photographs of one name need their folders, in the table "
                "and on disk."
            )
        found[index] = row
    return found


def _check_geodetic(position: tuple[float, ...], file: Path, where: str = "") -> None:
    latitude, longitude, altitude = position
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and math.isfinite(altitude) and abs(altitude) < 1e5):
        raise CaptureError(
            f"{file}: {where}latitude {latitude}, longitude {longitude}, altitude {altitude} is no place "
            "on Earth. Degrees and metres are expected."
        )
