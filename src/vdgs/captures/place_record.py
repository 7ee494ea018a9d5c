"""The record of the facts of a place, and its text. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vdgs.system.units import format_length, three_digits

#: From this many square metres on areas are in hectares, then in square kilometres.
_HECTARE, _SQUARE_KILOMETER = 10_000.0, 1_000_000.0
UNKNOWN_UNIT = "unknown: no position or known distance gives a scale; lengths are in units of the scene"
#: What pixels are measured on: where photographs look down; where they look at walls; where their views converge.
ON_GROUND, ON_SHOWN, ON_CONVERGENCE = "on the ground", "on what they show (median)", "on what all of them look at"

Bounds = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class PlaceFacts:
    """Lengths are in `unit`, `m` or `units` of unknown size."""

    name: str
    unit: str
    photographs_used: int
    photographs_test: int
    """Of those used."""
    photographs_found: int
    flown: tuple[str, ...]
    """When the first and the last photograph were taken; empty where they do not say it."""
    ground_sampling_distance: float | None
    """What a pixel of the photographs shows of what `pixel_shows` says, at the size at which they are used."""
    image_folder: str
    downscale: float = 1.0
    """By what `--downscale` shrinks the photographs of that folder."""
    height: float
    """How high the cameras fly above the points, or how far they are from them; their median."""
    heights: Bounds | None = None
    """The lowest and the highest over what is below them, where cameras fly at several heights."""
    extent: Bounds | None
    """x0, y0, x1, y1 in the ground frame of what at least two training photographs show; None: too few points."""
    area: float | None
    """Of the ground in it that they show, seen from above."""
    crs_name: str | None
    """The map coordinates of `crs_extent`, in `crs_unit`; None where the place on Earth is not known."""
    crs_unit: str | None
    crs_extent: Bounds | None
    latitudes: Bounds | None
    """South and north, in degrees (WGS 84)."""
    longitudes: Bounds | None
    """West and east."""
    accuracy: str
    accuracy_method: str
    pixel_shows: str = ON_GROUND

    @property
    def image_source(self) -> str:
        """The folder of the photographs, and how they are shrunk."""
        shrunk = f" with --downscale {self.downscale:g}" if self.downscale > 1 else ""
        return f"{self.image_folder or 'images'}{shrunk}"


def format_flown(flown: tuple[str, ...]) -> str:
    """The date of a flight, or the first and the last day."""
    days = [each[:10] for each in flown]
    if not days:
        return ""
    if days[0] == days[-1]:
        return f"{days[0]}, {flown[0][11:]} to {flown[-1][11:]} by the camera's clock"
    return f"{days[0]} to {days[-1]}"


def place_rows(facts: PlaceFacts, more_on_pixels: Sequence[tuple[str, str]] = ()) -> list[tuple[str, str]]:
    """The facts as pairs of what and how much, for tables; `more_on_pixels` follows the pixel of the photographs."""
    unit = facts.unit
    training, test = facts.photographs_used - facts.photographs_test, facts.photographs_test
    used = f"{facts.photographs_used} of {facts.photographs_found} used"
    rows = [
        ("Photographs", f"{used} ({training} for training, {test} for tests)"),
        ("Flown", format_flown(facts.flown) or "not said by the photographs"),
        *_where(facts),
    ]
    if facts.extent is not None:
        x0, y0, x1, y1 = facts.extent
        size = f"{three_digits(x1 - x0)} × {three_digits(y1 - y0)} {unit}"
        rows.append(("Area", f"{format_area(facts.area, unit)} in at least two training photographs, within {size}"))
    if facts.ground_sampling_distance is not None:
        gsd = format_length(facts.ground_sampling_distance, unit)
        rows.append(("Pixel of the photographs", f"{gsd} {facts.pixel_shows} ({facts.image_source}, as used)"))
    rows += more_on_pixels
    heights = " to ".join(three_digits(each) for each in facts.heights or ())
    apart = f" (median; {heights} {unit} over what is below)" if heights else ""
    rows.append(("Height of the cameras", f"{three_digits(facts.height)} {unit}{apart}"))
    if unit == "m":
        rows.append(("Accuracy", facts.accuracy or "not stated by the capture"))
        rows += [("Placed by", facts.accuracy_method)] if facts.accuracy_method else []
    rows.append(("Unit", "metres" if unit == "m" else UNKNOWN_UNIT))
    return rows


def _where(facts: PlaceFacts) -> list[tuple[str, str]]:
    if facts.latitudes is None or facts.longitudes is None:
        return [("Place on Earth", "unknown: the capture is not georeferenced")]
    (south, north), (west, east) = facts.latitudes, facts.longitudes
    rows = [("Latitude, longitude", f"{_degrees(south, north, 'NS')}, {_degrees(west, east, 'EW')} (WGS 84)")]
    if facts.crs_extent is None or facts.crs_name is None:
        return [*rows, ("Map coordinates", "unknown: pip install 'vdgs[geo]' computes them")]
    x0, y0, x1, y1 = (f"{value:,.1f}".replace(",", "\N{NARROW NO-BREAK SPACE}") for value in facts.crs_extent)
    return [("Extent", f"east {x0} to {x1}, north {y0} to {y1} {facts.crs_unit}, {facts.crs_name}"), *rows]


def _degrees(low: float, high: float, names: str) -> str:
    """Two angles of an axis of which `names` are the sides, each with its own where these differ: longitudes run on
    past 180 degrees."""
    low, high = (value - 360 if value > 180 else value + 360 if value < -180 else value for value in (low, high))
    if low >= 0 and high >= 0:
        return f"{low:.5f}° to {high:.5f}° {names[0]}"
    if low < 0 and high <= 0:
        return f"{-high:.5f}° to {-low:.5f}° {names[1]}"
    sides = (f"{abs(value):.5f}° {names[value < 0]}" for value in (low, high))
    return " to ".join(sides)


def format_area(area: float | None, unit: str) -> str:
    """An area in m², ha or km²; in square units where the unit is unknown."""
    if area is None:
        return "unknown"
    if unit == "m" and area >= _SQUARE_KILOMETER:
        return f"{three_digits(area / _SQUARE_KILOMETER)} km²"
    if unit == "m" and area >= _HECTARE:
        return f"{three_digits(area / _HECTARE)} ha"
    return f"{three_digits(area)} m²" if unit == "m" else f"{three_digits(area)} square {unit}"


def place_summary(facts: PlaceFacts) -> str:
    """The facts in a line."""
    unit, parts = facts.unit, [f"{facts.photographs_used} of {facts.photographs_found} photographs"]
    parts += [flown] if (flown := format_flown(facts.flown)) else []
    parts += [format_area(facts.area, unit)] if facts.area is not None else []
    if facts.ground_sampling_distance is not None:
        parts.append(f"pixels of {format_length(facts.ground_sampling_distance, unit)}")
    parts.append((facts.crs_name or "place on Earth unknown") if unit == "m" else "unit unknown")
    parts += [facts.accuracy] if facts.accuracy and unit == "m" else []
    return f"{facts.name}: {', '.join(parts)}"
