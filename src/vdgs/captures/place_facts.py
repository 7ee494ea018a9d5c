"""The facts of a place that a person asks for first: where, how large, how fine, how accurate, of which photographs.

A run keeps them in RUN/place.json. The report, `vdgs status` and `vdgs inspect` show the same.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture
from vdgs.captures.capture_dates import date_taken, first_and_last, format_flown
from vdgs.captures.reconstruction import read_reconstruction
from vdgs.captures.scene_points import MIN_SEEN_BY, ground_sampling_distance, scene_points
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.geometry.map_projection import MapProjection
from vdgs.system.units import format_length
from vdgs.visibility.visibility_counts import count_visibility

#: Points by which the place is measured, at most; cells of the longer side of the grid by which its area is; and the
#: share of points left out on every side, as in maps.
_MAX_POINTS, _CELLS, _TRIM_QUANTILE = 100_000, 128, 0.002
#: Photographs that are asked for their date.
_MAX_DATED = 60
#: From this many square metres on areas are in hectares, then in square kilometres.
_HECTARE, _SQUARE_KILOMETER = 10_000.0, 1_000_000.0
#: What a run of photographs alone calls its capture: the run's own name says more.
OWN_CAPTURE = "capture"
UNKNOWN_UNIT = "unknown: no position or known distance gives a scale; lengths are in units of the scene"

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
    """What a pixel of the photographs shows, at the size at which they are used."""
    image_folder: str
    height: float
    """How high the cameras fly above the points, or how far they are from them."""
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


def measure_place(capture: Capture) -> PlaceFacts:
    """The facts of a capture, in a time that hardly depends on its size."""
    ground, points = capture.ground, scene_points(capture, _MAX_POINTS)
    if len(points) >= 10:
        low, high = np.quantile(points, [_TRIM_QUANTILE, 1 - _TRIM_QUANTILE], axis=0)
        extent: Bounds | None = (*low[:2].tolist(), *high[:2].tolist())
        area: float | None = _area(capture, points, low[:2], high[:2])
        corners = np.array([[x, y, np.median(points[:, 2])] for x in (low[0], high[0]) for y in (low[1], high[1])])
    else:
        extent, area, corners = None, None, np.zeros((1, 3))
    latitudes, longitudes, crs_extent, projection = None, None, None, None
    if ground.origin_geo is not None:
        places = geodetic_from_enu(corners, ground.origin_geo, ground.axes_origin)[:, :2]
        (south, west), (north, east) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        latitudes, longitudes = (south, north), (west, east)
        with contextlib.suppress(VdgsError):  # pyproj is not installed, or the zone does not reach
            projection = MapProjection.of(ground)
            projected = projection.project(corners)[:, :2]
            crs_extent = (*projected.min(axis=0).tolist(), *projected.max(axis=0).tolist())
    reconstruction = None
    with contextlib.suppress(CaptureError):  # damaged: the report says so
        reconstruction = read_reconstruction(capture.root)
    used = len(capture.views)
    root = capture.root.resolve()
    return PlaceFacts(
        name=root.parent.name if reconstruction and root.name == OWN_CAPTURE else root.name,
        unit=ground.unit, photographs_used=used, photographs_test=len(capture.test_views),
        photographs_found=max(used, reconstruction.found if reconstruction else used + capture.num_unused_images),
        flown=(reconstruction.flown if reconstruction else ()) or _flown(capture),
        ground_sampling_distance=ground_sampling_distance(capture), image_folder=capture.images,
        height=camera_height(capture), extent=extent, area=area, crs_extent=crs_extent,
        crs_name=projection.name if projection and crs_extent else None,
        crs_unit=projection.unit if projection and crs_extent else None, latitudes=latitudes, longitudes=longitudes,
        accuracy=ground.accuracy,
        accuracy_method=reconstruction.georeferenced if reconstruction else ground.method,
    )  # fmt: skip


def _flown(capture: Capture) -> tuple[str, ...]:
    chosen = np.unique(np.linspace(0, len(capture.views) - 1, _MAX_DATED).round().astype(int))
    return first_and_last(date_taken(capture.views[index].image_path) for index in chosen)


def _area(
    capture: Capture, points: Float[np.ndarray, "n 3"], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> float:
    """Of the cells of a level grid that, at the height of the nearest point, at least two training cameras see."""
    cell = float((high - low).max()) / _CELLS
    if not cell > 0:
        return 0.0
    columns, rows = (max(1, round(float(side) / cell)) for side in high - low)
    x, y = (
        start + (np.arange(number) + 0.5) * side / number
        for start, number, side in zip(low, (columns, rows), high - low, strict=True)
    )
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    heights = points[cKDTree(points[:, :2]).query(places, workers=1)[1], 2]
    cameras = [view.camera for view in capture.train_views]
    seen = count_visibility(torch.from_numpy(np.column_stack([places, heights])), cameras).numpy()
    return float((seen >= min(MIN_SEEN_BY, len(cameras))).mean() * np.prod(high - low))


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
        size = f"{x1 - x0:,.3g} × {y1 - y0:,.3g} {unit}"
        rows.append(("Area", f"{format_area(facts.area, unit)} in at least two training photographs, within {size}"))
    if facts.ground_sampling_distance is not None:
        gsd = format_length(facts.ground_sampling_distance, unit)
        rows.append(("Pixel of the photographs", f"{gsd} on the ground ({facts.image_folder or 'images'}, as used)"))
    rows += more_on_pixels
    rows.append(("Height of the cameras", f"{facts.height:.3g} {unit}"))
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
    if low < 0 and high <= 0:
        low, high, side = -high, -low, names[1]
    else:
        side = names[0]
    return f"{low:.5f}° to {high:.5f}° {side}"


def format_area(area: float | None, unit: str) -> str:
    """An area for people; square units stay what they are."""
    if area is None:
        return "unknown"
    if unit == "m" and area >= _SQUARE_KILOMETER:
        return f"{area / _SQUARE_KILOMETER:.3g} km²"
    if unit == "m" and area >= _HECTARE:
        return f"{area / _HECTARE:.3g} ha"
    amount = f"{area:,.0f}" if area >= 100 else f"{area:.3g}"
    return f"{amount} m²" if unit == "m" else f"{amount} square {unit}"


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
