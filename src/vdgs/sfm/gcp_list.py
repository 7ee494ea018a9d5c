"""Surveyed points that photographs show: ODM's gcp_list.txt, read and checked before the work."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from vdgs.captures.column_units import believed_units, in_units_of, named_in_units
from vdgs.captures.coordinate_systems import (
    ALL_IN_FEET,
    HEIGHTS_IN_METERS,
    datum_error,
    height_unit,
    outside_area,
    to_geodetic,
    unit_without_heights,
)
from vdgs.captures.known_distances import MIN_OBSERVATIONS
from vdgs.captures.name_resolution import NameLookup, find_one
from vdgs.errors import CaptureError
from vdgs.geometry.geodesy import enu_from_geodetic, median_place
from vdgs.geometry.similarity import is_collinear
from vdgs.sfm.gcp_lines import GcpLine, parse_line, read_rows
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.units import first_names, some_names

#: Fewer points fix no place, scale and directions.
MIN_CONTROL_POINTS = 3
#: Points farther from the photographs than this are in another zone, or east and north have changed places (metres).
MAX_DISTANCE_M = 20_000.0
#: A word for all points of the file, where some are named to be held out.
ALL_POINTS = "all"
#: How the names of check points begin in ODM.
CHECK_PREFIX = "CHK-"
#: Points higher above or below the sea are none (metres).
_MAX_HEIGHT_M = 20_000.0
#: Marks of one point in one photograph that are farther apart are of different things (pixels; choice).
_ONE_MARK_PX = 1.0


@dataclass(frozen=True)
class GcpObservation:
    """Where a photograph shows a point."""

    image: str
    """Its name in the capture."""
    pixel: tuple[float, float]
    """From the upper left corner of the upright photograph; 0.5, 0.5 is the middle of its first pixel."""


@dataclass(frozen=True)
class GroundControlPoint:
    """A surveyed point."""

    name: str
    geodetic: tuple[float, float, float]
    """Latitude and longitude (WGS 84) in degrees, height in metres as the file has it; NaN where it says none."""
    observations: tuple[GcpObservation, ...]
    is_check_point: bool
    """Only measured afterwards (a check point)."""


@dataclass(frozen=True, eq=False)
class GcpList:
    """All surveyed points of a file."""

    points: tuple[GroundControlPoint, ...]
    crs: str
    """The coordinate system that the file names."""
    source: str
    notes: tuple[str, ...]
    datum_error_m: float = 0.0
    """How far all points may be off by the datum of their system."""
    header: str = ""
    """The definition of the system as the file has it."""
    unsaid_height_unit_m: float | None = None
    """Metres in the feet of x and y where nothing says the unit of heights, which are read as metres."""

    @property
    def has_control_points(self) -> bool:
        return any(not point.is_check_point for point in self.points)

    @property
    def has_heights(self) -> bool:
        """Whether control points say how high the place is."""
        return any(not point.is_check_point and math.isfinite(point.geodetic[2]) for point in self.points)

    def with_heights_in(self, unit_m: float) -> GcpList:
        """The list with heights that were read as metres in a unit of so many metres, that of x and y."""
        points = tuple(
            replace(point, geodetic=(*point.geodetic[:2], point.geodetic[2] * unit_m)) for point in self.points
        )
        crs = self.crs.replace(HEIGHTS_IN_METERS, ALL_IN_FEET)
        return replace(self, points=points, crs=crs, unsaid_height_unit_m=None)

    def enu(self, origin: tuple[float, float, float]) -> Float[np.ndarray, "n 3"]:
        """All points in metres east, north, up of an origin; up is NaN of points without a height."""
        geodetic = np.array([point.geodetic for point in self.points])
        flat = np.isnan(geodetic[:, 2])
        enu = enu_from_geodetic(np.where(flat[:, None] & [False, False, True], origin[2], geodetic), origin)
        enu[flat, 2] = np.nan
        return enu

    @property
    def median_origin(self) -> tuple[float, float, float]:
        """An origin, where positions give none."""
        geodetic = np.array([point.geodetic for point in self.points])
        heights = geodetic[np.isfinite(geodetic[:, 2]), 2]
        latitude, longitude, _ = median_place(geodetic)
        return latitude, longitude, float(np.median(heights)) if len(heights) else 0.0


#: A line, and its mark; None in a photograph that was left out.
_Marked = tuple[GcpLine, GcpObservation | None]


def read_gcp_list(file: Path, collection: ImageList, check_points: Sequence[str]) -> GcpList:
    """The points of a gcp_list.txt: a first line with the coordinate system, then x y z px py photograph [name].

    Pixels are those of the file as it is, before EXIF's orientation, as ODM counts them. Points named in
    `check_points` (`all`: every one) are check points. What photographs show that were left out is not used.

    Raises CaptureError for a file that cannot be read, a system that is unknown, lines that are none, photographs that
    are not there, pixels outside them, names that are not there, and points that are too few or along a line.
    """
    header, lines, transform, system, note, unsaid = _listed(file)
    by_name = photographs_by_name(collection)
    lines, strange = _of_photographs(lines, by_name, file)
    found = [(line, find_sighting(line.pixel, line.photograph, line.number, by_name, file)) for line in lines]
    groups = _by_point(found)
    held_out = _held_out(check_points, [name for name, _ in groups], file)
    # Of all points at once first: the operation to WGS 84 is that of their middle.
    transform(np.nan_to_num([group[0][0].place for _, group in groups]))
    points = []
    for name, group in groups:
        geodetic = _geodetic([line for line, _ in group], name, transform, system, file)
        _check_one_mark(group, name, file)
        seen = tuple(sighting for _, sighting in group if sighting is not None)
        is_check_point = ALL_POINTS in held_out or name in held_out or name.startswith(CHECK_PREFIX)
        points.append(GroundControlPoint(name, geodetic, seen, is_check_point))
    strange += [f"{file.name}: {said}" for said in ([note] if note else []) + _said_of_points(points, lines)]
    places = np.array([point.geodetic for point in points])
    strange += [f"{file.name}: {said}" for said in outside_area(header, places)]
    error_m, converted = datum_error(header, places)
    strange += [f"{file.name}: points are {converted}."] if converted else []
    checked = _checked(points, system, file, strange)
    return replace(checked, datum_error_m=error_m, header=header, unsaid_height_unit_m=unsaid)


class _Listed(NamedTuple):
    """What a file has, places in the units of its system."""

    header: str
    lines: list[GcpLine]
    transform: Any
    """From the system to WGS 84."""
    system: str
    note: str
    """What is said of the unit of x and y."""
    unsaid_height_unit_m: float | None
    """Metres in the feet of x and y where nothing says the unit of heights."""


def _listed(file: Path) -> _Listed:
    header, rows, (across, along, up) = read_rows(file)
    transform, system = to_geodetic(header, file)
    height = 1.0 if up is None else up / height_unit(header)
    lines = [parse_line(row, file, height) for row in rows]
    places = np.array([line.place[:2] for line in lines]).reshape(-1, 2)
    units, note = believed_units(header, (across, along), places, file)
    wide, long = (in_units_of(header, unit, file) for unit in units)
    lines = [replace(line, place=(line.place[0] * wide, line.place[1] * long, line.place[2])) for line in lines]
    name = named_in_units(system, units, up)
    unsaid = unit_without_heights(header) if up is None and name.endswith(HEIGHTS_IN_METERS) else None
    return _Listed(header, lines, transform, name, note, unsaid)


def _by_point(found: Sequence[_Marked]) -> list[tuple[str, list[_Marked]]]:
    """Names of points, and the lines of each: those of one name or, without names, of one place. Points without a name
    are called by their number, or by a higher one where another point has that name."""
    groups: dict[tuple[object, ...], list[_Marked]] = {}
    for line, sighting in found:
        groups.setdefault((line.name,) if line.name else line.place, []).append((line, sighting))
    taken = {line.name.casefold() for line, _ in found}

    def free(k: int) -> str:
        return next(name for j in itertools.count(k, len(groups)) if (name := f"point {j}") not in taken)

    return [(group[0][0].name or free(k), group) for k, group in enumerate(groups.values(), 1)]


def _said_of_points(points: Sequence[GroundControlPoint], lines: Sequence[GcpLine]) -> list[str]:
    """What people should know of points that have no height, or 0, and of those that names hold out."""
    said = []
    flat = [point.name for point in points if math.isnan(point.geodetic[2])]
    if flat:
        said.append(f"points without a height ({first_names(flat)}): used in the plane.")
    if len(points) >= MIN_CONTROL_POINTS and not any(line.place[2] for line in lines):
        said.append("all heights are exactly 0 and are used as they are. Where they are not known, write nan.")
    if any(point.name.startswith(CHECK_PREFIX) for point in points):
        said.append(f"points named {CHECK_PREFIX}... are held out as check points, as in ODM.")
    return said


def _of_photographs(
    lines: Sequence[GcpLine], by_name: NameLookup[ImageMetadata | str], file: Path
) -> tuple[list[GcpLine], list[str]]:
    """The lines of photographs that are there, and what to say of the others. CaptureError where none is."""
    there = [line for line in lines if _photographs_of(line.photograph, by_name)]
    names = list(dict.fromkeys(line.photograph for line in lines if line not in there))
    if not names:
        return there, []
    shown = some_names(names)
    if not there:
        raise CaptureError(
            f"{file}: none of its {len(lines)} lines is of a photograph that is there ({shown} are not). Is it the "
            "list of this flight, with the names that the photographs have?"
        )
    lost = len(lines) - len(there)
    return there, [f"{file.name}: {lost} lines are of {len(names)} photographs that are not there; left out ({shown})."]


def _photographs_of(name: str, by_name: NameLookup[ImageMetadata | str]) -> list[ImageMetadata | str]:
    return by_name.find(name)[1] or by_name.find_elsewhere(name)[1]


def _geodetic(
    lines: Sequence[GcpLine], name: str, transform: Any, system: str, file: Path
) -> tuple[float, float, float]:
    """Latitude, longitude and height of a point that lines speak of."""
    first = lines[0]
    other = next((line for line in lines if line.place != first.place), None)
    if other is not None:
        raise CaptureError(
            f"{file}: line {other.number}: the point {name} has another place in line {first.number}. Mend one of them."
        )
    flat = math.isnan(first.place[2])
    place = np.nan_to_num(np.array([first.place]))
    latitude, longitude, height = (float(value) for value in transform(place)[0])
    if not all(map(math.isfinite, (latitude, longitude, height))) or abs(latitude) > 90 or abs(height) > _MAX_HEIGHT_M:
        raise CaptureError(
            f"{file}: line {first.number}: {', '.join(f'{value:.10g}' for value in first.place)} is no place in "
            f"{system}. Is it the right system, and x (east) before y (north)?"
        )
    return latitude, longitude, math.nan if flat else height


def are_along_line(targets: Float[np.ndarray, "n 3"]) -> bool:
    """Whether points of which some have no height (NaN) fix no rotation: those with heights in space, or all in the
    plane, must lie beside one line."""
    known = np.isfinite(targets[:, 2])
    return is_collinear(targets[known]) and (bool(known.all()) or is_collinear(np.nan_to_num(targets) * [1, 1, 0]))


def check_gcps_near(gcps: GcpList, positions: np.ndarray, origin: tuple[float, float, float], file: Path) -> None:
    """Raise CaptureError where the points [n, 3] lie nowhere near the positions [m, 3] of the photographs."""
    if not len(positions):
        return
    away = float(np.median(np.linalg.norm(gcps.enu(origin)[:, :2] - np.median(positions[:, :2], axis=0), axis=1)))
    if away > MAX_DISTANCE_M:
        raise CaptureError(
            f"{file}: its points lie {away / 1000:,.0f} km from the photographs. Is {gcps.crs} the right system "
            "and zone, and x (east) before y (north)?"
        )


def photographs_by_name(collection: ImageList) -> NameLookup[ImageMetadata | str]:
    """Photographs, and names of those left out."""
    left_out: list[tuple[str, ImageMetadata | str]] = [(each.name, each.name) for each in collection.excluded]
    return NameLookup([*((photo.name, photo) for photo in collection.images), *left_out])


def find_photograph(
    photograph: str, number: int, by_name: NameLookup[ImageMetadata | str], file: Path
) -> ImageMetadata | None:
    """The photograph that a line names; None for one that was left out."""
    photo = find_one(
        by_name, photograph, f"{file}: line {number}", lambda each: each if isinstance(each, str) else each.name
    )
    return None if isinstance(photo, str) else photo


def find_sighting(
    pixel: tuple[float, float], photograph: str, number: int, by_name: NameLookup[ImageMetadata | str], file: Path
) -> GcpObservation | None:
    """The mark of a line; None in a photograph that was left out."""
    photo = find_photograph(photograph, number, by_name, file)
    if photo is None:
        return None
    where = f"{file}: line {number}:"
    width, height = photo.stored_size
    if not (0 <= pixel[0] <= width and 0 <= pixel[1] <= height):
        exchanged = 0 <= pixel[1] <= width and 0 <= pixel[0] <= height
        raise CaptureError(
            f"{where} pixel {pixel[0]:g}, {pixel[1]:g} is outside {photo.name}, which has {width} x {height}. "
            f"{'Are px and py exchanged, or was' if exchanged else 'Was'} the photograph made smaller since?"
        )
    return GcpObservation(photo.name, photo.to_upright_pixel(pixel))


def _held_out(held_out: Sequence[str], names: Sequence[str], file: Path) -> list[str]:
    """The names of the file that are meant, without regard to case where that leaves one. Raises CaptureError."""
    found = []
    for name in held_out:
        alike = [each for each in names if each.casefold() == name.casefold()]
        if name not in names and name.casefold() != ALL_POINTS and len(alike) != 1:
            raise CaptureError(f"--check-points {name}: {file} has {', '.join(names[:20])}; or say {ALL_POINTS}.")
        found.append(name if name in names else alike[0] if alike else ALL_POINTS)
    return found


def _check_one_mark(group: Sequence[_Marked], name: str, file: Path) -> None:
    """Raise CaptureError where a photograph shows a point at two places."""
    marked: dict[str, GcpLine] = {}
    for line, sighting in group:
        if sighting is None:
            continue
        first = marked.setdefault(sighting.image, line)
        if math.dist(first.pixel, line.pixel) > _ONE_MARK_PX:
            raise CaptureError(
                f"{file}: line {line.number}: the point {name} has another mark in {sighting.image} in line "
                f"{first.number}. Delete the wrong one, or give one of the points another name."
            )


def _checked(points: list[GroundControlPoint], system: str, file: Path, notes: Sequence[str]) -> GcpList:
    """Without points that too few photographs show. Raises CaptureError where too few are left to place a model."""
    seen = [point for point in points if len({each.image for each in point.observations}) >= MIN_OBSERVATIONS]
    lonely = [point.name for point in points if point not in seen]
    if lonely:
        notes = [*notes, f"{file.name}: only one photograph shows {', '.join(lonely[:5])}; not used."]
    used = [point for point in seen if not point.is_check_point]
    if not seen or (used and len(used) < MIN_CONTROL_POINTS):
        raise CaptureError(
            f"{file}: {len(used)} points that {MIN_OBSERVATIONS} photographs show, and "
            f"{MIN_CONTROL_POINTS} are needed to "
            f"place a scene{' (' + '; '.join(notes) + ')' if notes else ''}. With fewer: --check-points {ALL_POINTS}"
        )
    control = GcpList(tuple(seen), system, file.name, tuple(notes))
    targets = control.enu(control.median_origin)[[not point.is_check_point for point in seen]]
    if used and are_along_line(targets):
        raise CaptureError(
            f"{file}: its points lie along one line, about which a scene could still turn. Survey one beside it, or "
            f"use them as check points: --check-points {ALL_POINTS}"
        )
    return control
