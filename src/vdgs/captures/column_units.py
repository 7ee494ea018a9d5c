"""Units of x, y and heights in tables: what their headings say, beside the unit of the coordinate system."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from vdgs.captures.coordinate_systems import HEIGHTS_IN_METERS, is_in_degrees, meters_outside_area
from vdgs.captures.system_names import pyproj_name
from vdgs.errors import CaptureError

#: Units that differ by less (share) are one: feet and metres of one system are of the survey, of a law, or not.
_SAME_UNIT = 5e-5


class UnitsAcross(NamedTuple):
    """The units of columns of x and y."""

    meters: tuple[float | None, float | None]
    """Metres in one of x and of y; None for the unit of the system."""
    note: str = ""
    """What is said of them, where headings and system may both be meant."""


def believed_units(
    header: str, across: tuple[float | None, float | None], places: Float[np.ndarray, "n 2"], file: Path
) -> UnitsAcross:
    """The units of x and y [n, 2], whose headings say `across`, under a system that `to_geodetic` knows.

    Programs write [m] behind x and y of any system. Where headings say metres and the system counts in another length,
    the place decides: if only as numbers of the system they lie where it is used, they are that; else the headings
    count, with a note where the place does not confirm them. Raises CaptureError as `in_units_of` does.
    """
    known = places[np.isfinite(places).all(axis=1)]
    factors = [in_units_of(header, unit, file) for unit in across]
    if not len(known) or not any(unit == 1 != factor for unit, factor in zip(across, factors, strict=True)):
        return UnitsAcross(across)
    x, y = map(float, np.median(known, axis=0))
    as_said = meters_outside_area(header, x * factors[0], y * factors[1])
    as_system = meters_outside_area(header, x, y)
    unit = f"the unit of {header[:60]} ({_axis(header).unit_name})"
    if as_system == 0 < as_said:
        away = f"{as_said / 1000:,.0f} km outside of" if math.isfinite(as_said) else "nowhere near"
        note = (
            f"x and y are read in {unit}: as metres, as their headings say, they would lie {away} the area that it is "
            "made for."
        )
        return UnitsAcross((None, None), note)
    if as_said == 0 < as_system:
        return UnitsAcross(across)
    return UnitsAcross(across, f"x and y are read as metres, as their headings say, and not in {unit}.")


def in_units_of(header: str, meters: float | None, file: Path) -> float:
    """Units of x and y of a system that `to_geodetic` knows in one of a column whose name says so many `meters`; 1 for
    a column that says nothing (None). Raises CaptureError for a system in degrees, but of metres: programs write these
    behind the names of x and y whatever they are."""
    if meters is None:
        return 1.0
    if is_in_degrees(header):
        if meters == 1:
            return 1.0
        raise CaptureError(f"{file}: its columns name a unit of length, but {header[:60]} counts in degrees.")
    factor = meters / float(_axis(header).unit_conversion_factor)
    return 1.0 if abs(factor - 1) < _SAME_UNIT else factor


def named_in_units(system: str, across: Sequence[float | None], up: float | None) -> str:
    """The name of a system by `to_geodetic` without what is assumed of feet, where headings say (metres in one) another
    unit of heights than metres, or metres of x and y."""
    return system.removesuffix(HEIGHTS_IN_METERS) if up not in (None, 1) or 1 in across else system


def _axis(header: str) -> Any:
    """The first axis of a system, as pyproj describes it."""
    import pyproj

    return pyproj.CRS.from_user_input(pyproj_name(header)).axis_info[0]
