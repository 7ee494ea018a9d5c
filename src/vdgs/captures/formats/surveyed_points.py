"""Surveyed points of a project, which are not used: how many there are, and how far its poses are from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vdgs.captures.coordinate_systems import ToGeodetic
from vdgs.captures.formats.lens_projection import pixel_rays
from vdgs.captures.formats.project import ProjectView
from vdgs.geometry.camera import camera_center
from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.geometry.ray_intersection import intersect_rays

#: Poses that put surveyed points no farther off are taken for adjusted to them (metres, median; choice).
AGREEING_M = 0.2


class SurveyedPoint(NamedTuple):
    """A point with the place that was surveyed, and where photographs show it."""

    geodetic: np.ndarray
    """Latitude, longitude and height [3]."""
    marks: Sequence[tuple[ProjectView, tuple[float, float]]]
    """Views, and the pixel in each."""


def survey_note(
    count: int, what: str, remedy: str, points: Sequence[SurveyedPoint] = (), to_geodetic: ToGeodetic | None = None
) -> list[str]:
    """What to say of `count` surveyed points of a project (`what` they are called there), of which those in `points`
    can be compared with its poses by what leads from its world `to_geodetic`; nothing where there are none."""
    if not count:
        return []
    said = f"{count} {what} {'is' if count == 1 else 'are'} in the project and not used"
    offs = np.array([off for each in points if (off := _off(each, to_geodetic)) is not None]).reshape(-1, 3)
    if not len(offs):
        return [f"{said}: the poses are taken as they are."]
    east, north, up = (float(each) for each in np.median(offs, axis=0))
    if np.linalg.norm((east, north, up)) <= AGREEING_M:
        rms = float(np.sqrt((offs**2).sum(axis=1).mean()))
        return [f"{said}; its poses agree with {len(offs)} of them (RMS {rms:.2g} m)."]
    where = (
        f"{abs(east):.2f} m {'east' if east > 0 else 'west'}, {abs(north):.2f} m {'north' if north > 0 else 'south'}"
    )
    return [
        f"{said}. Its poses put them {where} and {abs(up):.2f} m {'above' if up > 0 else 'below'} where they were "
        f"surveyed (median of {len(offs)}), and so the whole scene. {remedy}"
    ]


def _off(point: SurveyedPoint, to_geodetic: ToGeodetic | None) -> np.ndarray | None:
    """Metres east, north and up [3] from where a point was surveyed to where its marks meet; None where they do not."""
    centers, rays = [], []
    for view, pixel in point.marks:
        pose = view.camera_from_world
        ray = np.append(pixel_rays(view.intrinsics, np.array([pixel]))[0], 1.0) @ pose[:3, :3]
        if np.isfinite(ray).all():
            centers.append(camera_center(pose))
            rays.append(ray)
    if to_geodetic is None or len(rays) < 2:
        return None
    found = intersect_rays(np.array(centers) - centers[0], np.array(rays))
    if found is None:
        return None
    off = enu_from_geodetic(to_geodetic((found + centers[0])[None]), tuple(point.geodetic.tolist()))[0]
    return off if np.isfinite(off).all() else None
