"""Reading a project of another program, and holding what was read against the flight that wrote it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from support.known_flight import (
    ORIGIN,
    KnownFlight,
    centers_of,
    ecef,
    poses_of,
)
from vdgs.captures.format_dispatch import read_source
from vdgs.captures.formats.lens_projection import ray_pixels
from vdgs.captures.formats.source_capture import SourceCapture
from vdgs.captures.project_formats import find_projects
from vdgs.config.capture_options import CaptureOptions
from vdgs.geometry.geodesy import geodetic_from_enu

OPTIONS = CaptureOptions()


def read(root: Path, name: str) -> SourceCapture:
    [(found, _)] = find_projects(root)
    assert found == name
    return read_source(root, OPTIONS, needs_points=False)


def check_numbers(source: SourceCapture, flight: KnownFlight, *, placed: bool = True, seen_px: float = 0.01) -> None:
    """Cameras within a millimetre of where they were, and points in pictures where the true lens shows them."""
    poses = poses_of(source, flight)
    if placed:
        assert source.georef is not None
        assert source.georef.origin is not None
        there, true = ecef(centers_of(poses), source.georef.origin), ecef(flight.centers)
        assert np.abs(there - true).max() < 1e-3
        points = known_points(flight, source.georef.origin)
    else:
        assert np.abs(centers_of(poses) - flight.centers).max() < 1e-3
        points = flight.points
    lenses = {view.name.rsplit("/", 1)[-1]: view.intrinsics for view in source.views}
    for index, (name, pose) in enumerate(zip(flight.names, poses, strict=True)):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        pixels, true_px = ray_pixels(lenses[name], local[:, :2] / local[:, 2:]), flight.pixels(index)
        inside = flight.shows(index)
        assert inside.sum() > 20
        assert np.abs(pixels - true_px)[inside].max() < seen_px
        if source.views[index].observations is not None:
            seen = source.views[index].observations
            shown = seen.points @ pose[:3, :3].T + pose[:3, 3]
            assert np.abs(shown[:, :2] / shown[:, 2:] - seen.rays).max() < 1e-5


def known_points(flight: KnownFlight, origin: tuple[float, float, float]) -> np.ndarray:
    from vdgs.geometry.geodesy import enu_from_geodetic

    return enu_from_geodetic(geodetic_from_enu(flight.points, ORIGIN), origin)


def check_tie_points(source: SourceCapture, flight: KnownFlight) -> None:
    check_numbers(source, flight, placed=False)
    assert np.abs(source.points - flight.points).max() < 1e-9
    assert (source.colors == flight.colors).all()
    assert all(view.observations is not None and len(view.observations.points) > 20 for view in source.views)
