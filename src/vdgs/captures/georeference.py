"""What a capture says about its place on Earth: georef.json and GPS tables."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path, PurePosixPath

import numpy as np

from vdgs.errors import CaptureError


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


def read_gps(file: Path) -> dict[str, tuple[float, float, float]]:
    """Positions (lat deg, lon deg, alt m) by image stem in lower case; rows without a position are left out.

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
    positions: dict[str, tuple[float, float, float]] = {}
    for number, row in enumerate(rows, 2):
        words = [(row[key] or "").strip() for key in ("lat", "lon", "alt")]
        if not all(words) or not row["name"]:
            continue
        try:
            latitude, longitude, altitude = map(float, words)
        except ValueError:
            raise CaptureError(f"{file}: line {number}: {words} are not numbers. Mend the row.") from None
        _check_geodetic((latitude, longitude, altitude), file, f"line {number}: ")
        positions[stem_of(row["name"])] = (latitude, longitude, altitude)
    return positions


def stem_of(name: str) -> str:
    """The key by which photographs are matched across folders and extensions: file stem, lower case."""
    return PurePosixPath(name.replace("\\", "/")).stem.lower()


def match_gps(
    names: list[str], gps: dict[str, tuple[float, float, float]], file: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Indices [m] of the images with a GPS position, and the positions [m, 3] (lat, lon, alt).

    Raises `CaptureError` if no name matches: then it is another flight's table.
    """
    indices = [index for index, name in enumerate(names) if stem_of(name) in gps]
    if not indices:
        raise CaptureError(
            f"{file}: none of its {len(gps)} rows names one of the capture's {len(names)} images "
            f"(for example {names[0]!r}). Give the table of this flight, or leave --gps out."
        )
    return np.array(indices), np.array([gps[stem_of(names[index])] for index in indices])


def _check_geodetic(position: tuple[float, ...], file: Path, where: str = "") -> None:
    latitude, longitude, altitude = position
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and math.isfinite(altitude) and abs(altitude) < 1e5):
        raise CaptureError(
            f"{file}: {where}latitude {latitude}, longitude {longitude}, altitude {altitude} is no place "
            "on Earth. Degrees and metres are expected."
        )
