"""Known distances between points that photographs show: a scale without positions, or better than theirs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vdgs.captures.known_distances import (
    LocatedPoint,
    check_marked,
    read_known_distances,
    scale_of_distances,
    spread_of_marks,
)
from vdgs.sfm.gcp_adjustment import triangulate
from vdgs.sfm.gcp_list import GcpObservation, GroundControlPoint, find_photograph, find_sighting, photographs_by_name
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.up_direction import model_points
from vdgs.system.lazy_pycolmap import pycolmap

#: The distance from a camera to what it sees is the median of those to so many points at most: thousands of photographs
#: times millions of points take half an hour, and the median is the same within a percent.
MAX_POINTS = 10_000
#: Steps by which the change of a pixel is measured, as a share of the depth.
STEP = 1e-5


@dataclass(frozen=True)
class RayMark:
    """Where a photograph shows a point, as x/z and y/z of the camera's ray."""

    name: str
    image: str
    ray: tuple[float, float]


@dataclass(frozen=True, eq=False)
class ScaleBars:
    """Marked points, and known distances between them."""

    points: tuple[GroundControlPoint, ...]
    distances: tuple[tuple[str, str, float], ...]
    """Two names, and metres."""
    source: str
    rays: tuple[RayMark, ...] = ()


def read_scale_bars(file: Path, collection: ImageList) -> ScaleBars:
    """The marks and distances of a text file (`captures.known_distances`); marks in pixels are as in a gcp_list.txt.

    Raises CaptureError, naming the line, for what `read_known_distances` raises it, photographs that are not there,
    and points that fewer than two photographs show.
    """
    known, by_name = read_known_distances(file), photographs_by_name(collection)
    marks: dict[str, list[GcpObservation]] = {mark.name: [] for mark in known.marks}
    rays: list[RayMark] = []
    for mark in known.marks:
        if not mark.is_ray:
            sighting = find_sighting(mark.at, mark.photograph, mark.number, by_name, file)
            marks[mark.name].extend([sighting] if sighting is not None else [])
        elif (photo := find_photograph(mark.photograph, mark.number, by_name, file)) is not None:
            rays.append(RayMark(mark.name, photo.name, mark.at))
    images_of = {name: {each.image for each in seen} for name, seen in marks.items()}
    for ray in rays:
        images_of[ray.name].add(ray.image)
    check_marked(known, images_of, file)
    points = tuple(GroundControlPoint(name, (0.0, 0.0, 0.0), tuple(seen), True) for name, seen in marks.items())
    return ScaleBars(points, known.distances, file.name, tuple(rays))


def known_scale(model: pycolmap.Reconstruction, bars: ScaleBars) -> tuple[float, float]:
    """The factor from the model's world to metres, and its standard deviation as a share.

    Raises CaptureError for points that placed photographs do not show, marks that are wrong, distances that contradict
    each other, and those that photographs do not tell.
    """
    located, images = {}, {image.name: image for image in model.images.values() if image.has_pose}
    for point in bars.points:
        seen = (*point.observations, *_ray_sightings(model, [ray for ray in bars.rays if ray.name == point.name]))
        found = triangulate(model, replace(point, observations=seen))
        if found is not None:
            views = [images[each.image] for each in seen if each.image in images]
            spread = spread_of_marks(np.array([_jacobian(model, view, found.position) for view in views]))
            located[point.name] = LocatedPoint(found.position, found.error_px, len(views), spread)
    return scale_of_distances(bars.distances, located, _pixel(model), bars.source)


def _jacobian(
    model: pycolmap.Reconstruction, view: pycolmap.Image, place: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2 3"]:
    """How the pixel that shows a place changes with the place."""
    pose = np.asarray(view.cam_from_world().matrix())
    there = pose @ np.append(place, 1.0)
    steps = STEP * there[2] * np.concatenate([np.eye(3), -np.eye(3)])
    shown = np.asarray(model.cameras[view.camera_id].img_from_cam(there + steps))
    return (shown[:3] - shown[3:]).T / (2 * STEP * there[2]) @ pose[:, :3]


def _ray_sightings(model: pycolmap.Reconstruction, rays: list[RayMark]) -> list[GcpObservation]:
    """Where the lenses of a model show rays, of placed photographs."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    found = []
    for each in rays:
        if each.image in images:
            lens = model.cameras[images[each.image].camera_id]
            x, y = np.asarray(lens.img_from_cam(np.array([[*each.ray, 1.0]]))).ravel().tolist()
            found.append(GcpObservation(each.image, (x, y)))
    return found


def _pixel(model: pycolmap.Reconstruction) -> float:
    """What a pixel shows of the median point, in the model's world: of points drawn evenly, where there are many."""
    points = model_points(model)
    points = points[:: -(-len(points) // MAX_POINTS)]
    sizes = [
        float(np.median(np.linalg.norm(points - image.projection_center(), axis=1)))
        / model.cameras[image.camera_id].mean_focal_length()
        for image in model.images.values()
        if image.has_pose
    ]
    return float(np.median(sizes))
