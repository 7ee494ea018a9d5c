"""The facts of a place that a person asks for first: where, how large, how fine, how accurate, of which photographs.

A run keeps them in RUN/place.json. The report, `vdgs status` and `vdgs inspect` show the same.
"""

from __future__ import annotations

import contextlib

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from vdgs.captures.camera_height import camera_height, height_range, view_distance
from vdgs.captures.capture import Capture, spread_evenly
from vdgs.captures.capture_dates import date_taken, first_and_last
from vdgs.captures.place_record import ON_CONVERGENCE, ON_GROUND, ON_SHOWN, Bounds, PlaceFacts
from vdgs.captures.reconstruction import place_name, read_reconstruction
from vdgs.captures.scene_points import MIN_SEEN_BY, ground_sampling_distance, scene_points
from vdgs.errors import CaptureError, VdgsError
from vdgs.geometry.geodesy import geodetic_from_enu, wrap_degrees
from vdgs.geometry.map_projection import MapProjection
from vdgs.geometry.similarity import sample_points
from vdgs.geometry.view_convergence import find_convergence
from vdgs.visibility.visibility_counts import count_visibility

#: Points by which the place is measured, at most; cells of the longer side of the grid by which its area is; and the
#: share of points left out on every side, as in maps.
_MAX_POINTS, _CELLS, _TRIM_QUANTILE = 100_000, 128, 0.002
#: The ground below a camera is the median height of so many points, the nearest across.
_POINTS_BELOW = 15
#: Views that look less down than this (degrees from straight down; median) show walls or what is far behind (choice).
_LEVEL_TILT_DEG = 60.0
#: Photographs that are asked for their date.
_MAX_DATED = 60


def measure_place(capture: Capture) -> PlaceFacts:
    """The facts of a capture, from samples of bounded size."""
    ground, points = capture.ground, scene_points(capture, _MAX_POINTS)
    if len(points) >= 10:
        low, high = np.quantile(points, [_TRIM_QUANTILE, 1 - _TRIM_QUANTILE], axis=0)
        extent: Bounds | None = (*low[:2].tolist(), *high[:2].tolist())
        area: float | None = _area(capture, points, low[:2], high[:2])
        corners = np.array([[x, y, np.median(points[:, 2])] for x in (low[0], high[0]) for y in (low[1], high[1])])
    else:
        extent, area, corners = None, None, np.zeros((1, 3))
    latitudes, longitudes, crs_extent, crs_name, crs_unit = None, None, None, None, None
    if ground.origin_geo is not None:
        places = geodetic_from_enu(corners, ground.origin_geo, ground.axes_origin)[:, :2]
        middle = ground.origin_geo[1]
        places[:, 1] = middle + wrap_degrees(places[:, 1] - middle)  # beyond 180 degrees across the antimeridian
        (south, west), (north, east) = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        latitudes, longitudes = (south, north), (west, east)
        with contextlib.suppress(VdgsError):  # pyproj is not installed, or the zone does not reach
            projection = MapProjection.of(ground)
            projected = projection.project(corners)[:, :2]
            crs_extent = (*projected.min(axis=0).tolist(), *projected.max(axis=0).tolist())
            crs_name, crs_unit = projection.name, projection.unit
    reconstruction = None
    with contextlib.suppress(CaptureError):  # damaged: the report says so
        reconstruction = read_reconstruction(capture.root)
    flown = reconstruction.flown if reconstruction else ()
    if not flown:
        flown = first_and_last(date_taken(view.image_path) for view in spread_evenly(capture.views, _MAX_DATED))
    used, root = len(capture.views), capture.root.resolve()
    pixel, pixel_shows = _pixel(capture)
    return PlaceFacts(
        name=place_name(root),
        unit=ground.unit, photographs_used=used, photographs_test=len(capture.test_views),
        photographs_found=max(used, reconstruction.found if reconstruction else used + capture.num_unused_images),
        flown=flown, ground_sampling_distance=pixel, pixel_shows=pixel_shows, image_folder=capture.images,
        downscale=capture.downscale, height=camera_height(capture), heights=_heights(capture), extent=extent, area=area,
        crs_extent=crs_extent,
        crs_name=crs_name, crs_unit=crs_unit, latitudes=latitudes, longitudes=longitudes, accuracy=ground.accuracy,
        accuracy_method=reconstruction.georeferenced if reconstruction else ground.method,
    )  # fmt: skip


def _pixel(capture: Capture) -> tuple[float | None, str]:
    """What a pixel of the training photographs shows, and of what: of the place on which their views converge, or else
    of the points, of which those far behind a thing that stands up are the most."""
    cameras = [view.camera for view in capture.train_views]
    converged = find_convergence(cameras)
    if converged is not None:
        looking = [camera for camera, looks in zip(cameras, converged.looking, strict=True) if looks]
        sizes = [float(np.linalg.norm(camera.position - converged.place)) / camera.fx for camera in looking]
        return float(np.median(sizes)), ON_CONVERGENCE
    tilt_deg = np.degrees(np.arccos(np.clip(np.median([-camera.forward[2] for camera in cameras]), -1, 1)))
    return ground_sampling_distance(capture), ON_GROUND if tilt_deg <= _LEVEL_TILT_DEG else ON_SHOWN


def _heights(capture: Capture) -> Bounds | None:
    """The lowest and the highest of the training cameras over the points below, where they fly at several heights:
    those of a flight along a slope are one."""
    centers, points = np.array([view.camera.position for view in capture.train_views]), capture.points
    if not len(points) or not view_distance(centers, points, np.array([0.0, 0.0, 1.0])).is_height:
        return None
    points = sample_points(points, _MAX_POINTS)
    below = cKDTree(points[:, :2]).query(centers[:, :2], k=min(_POINTS_BELOW, len(points)), workers=1)[1]
    return height_range(centers[:, 2] - np.median(points[below.reshape(len(centers), -1), 2], axis=1))


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
