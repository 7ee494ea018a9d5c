"""A survey of seven places that nine photographs show, and its list of control points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj

from support.flights import ORIGIN, Flight
from vdgs.geometry.geodesy import geodetic_from_enu

PLACES = np.array([[-8.0, -8], [9, -7], [8, 9], [-9, 8], [0, 0], [-4, 5], [5, -2]])
NAMES = ("north_west", "north_east", "gate", "barn", "well", "fence", "stone")
#: The survey is of another height system and a little beside what GPS says.
SURVEY_OFF = np.array([3.0, -2.0, 12.0])


def projected(enu: np.ndarray, system: str) -> np.ndarray:
    """Metres about ORIGIN to x, y of a system and the height as it is."""
    latitude, longitude, height = geodetic_from_enu(enu[None], ORIGIN)[0]
    x, y = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True).transform(longitude, latitude)
    return np.array([x, y, height])


def write_list(file: Path, flight: Flight, points, header="EPSG:32719", system=None, off=SURVEY_OFF) -> Path:
    lines = [header, "# surveyed with care", ""]
    for name, seen in zip(NAMES, points, strict=True):
        place = projected(seen[-1] + off, system or header)
        for k, pixel in seen.items():
            if k >= 0:
                words = [f"{place[0]:.9f}", f"{place[1]:.9f}", f"{place[2]:.4f}", *(f"{v:.3f}" for v in pixel)]
                lines.append(" ".join([*words, flight.names[k], name]))
    file.write_text("\n".join(lines) + "\n")
    return file
