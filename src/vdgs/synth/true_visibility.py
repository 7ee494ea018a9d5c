"""Who truly sees what: lines of sight from cameras to places on the true surface, by ray casting.

This is visibility with occlusion, the truth that V_i (frusta only, section IV-B of the paper) stands in for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.image_renderer import pixel_centers, pixel_rays
from vdgs.synth.mesh import Mesh
from vdgs.synth.ray_tracing import RayTracer
from vdgs.visibility.visibility_counts import visibility_stats

#: An occluder this near to a place (m, or as a share of the distance) is its own surface.
_OWN_SURFACE, _OWN_SHARE = 0.03, 1e-4
#: Places drawn on the surface.
_NUM_POINTS = 40_000
#: The place reaches this far from the middle, in halves of the flown extent: what lies beyond is backdrop.
_AREA_FACTOR = 2.0


def visible_point_indices(tracer: RayTracer, camera: Camera, points: np.ndarray) -> np.ndarray:
    """Which places [n, 3] a camera sees: inside its frame and with nothing in between; their indices."""
    inside = np.flatnonzero(camera.in_frustum(points))
    ray = points[inside] - camera.position
    length = np.linalg.norm(ray, axis=1)
    origins = np.broadcast_to(camera.position, ray.shape)
    reach = length - np.maximum(_OWN_SURFACE, _OWN_SHARE * length)
    return inside[~tracer.occluded(origins, ray / length[:, None], reach)]


def visibility_matrix(tracer: RayTracer, cameras: list[Camera], points: np.ndarray) -> np.ndarray:
    """Which places [n, 3] each camera truly sees, [n, cameras] bool."""
    visible = np.zeros((len(points), len(cameras)), bool)
    for k, camera in enumerate(cameras):
        visible[visible_point_indices(tracer, camera, points), k] = True
    return visible


def _about(cameras: list[Camera], places: np.ndarray) -> list[Camera]:
    """The cameras whose frustum can hold any of the places, by the ball about them: few of many for a single view."""
    if len(places) == 0 or not cameras:
        return []
    low, high = places.min(axis=0), places.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    poses = np.stack([camera.camera_from_world for camera in cameras])
    x, y, z = (poses[:, :3, :3] @ middle + poses[:, :3, 3]).T
    fx, fy, cx, cy, width, height = np.array(
        [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras], np.float64
    ).T
    reach = radius * (1 + 1e-9) + 1e-6
    held = z > -reach
    for focal, side, along in ((fx, cx, x), (-fx, width - cx, x), (fy, cy, y), (-fy, height - cy, y)):
        held &= (focal * along + side * z) / np.hypot(focal, side) > -reach
    return [camera for camera, near in zip(cameras, held.tolist(), strict=True) if near]


def count_visibility(tracer: RayTracer, cameras: list[Camera], points: np.ndarray) -> np.ndarray:
    """How many of the cameras truly see each place [n, 3], [n] uint16."""
    count = np.zeros(len(points), np.uint16)
    for camera in _about(cameras, points):
        count[visible_point_indices(tracer, camera, points)] += 1
    return count


def view_ground_truth(
    tracer: RayTracer, camera: Camera, training: list[Camera], step: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Per pixel center of a view (every `step`-th pixel): depth along the viewing axis, float32 m, inf for sky; and how
    many training cameras truly see the place met, uint16, 0 for sky. Both [height / step, width / step]."""
    shape = -(-camera.height // step), -(-camera.width // step)
    pixels = pixel_centers(camera).reshape(camera.height, camera.width, 2)[::step, ::step].reshape(-1, 2)
    origins, directions = pixel_rays(camera, pixels)
    hits = tracer.intersect(origins, directions)
    met = np.flatnonzero(hits.triangle >= 0)
    depth = np.full(len(pixels), np.inf, np.float32)
    depth[met] = hits.distance[met] * (directions[met] @ camera.forward.astype(np.float32))
    count = np.zeros(len(pixels), np.uint16)
    places = camera.position + directions[met].astype(np.float64) * hits.distance[met, None]
    count[met] = count_visibility(tracer, training, places)
    return depth.reshape(shape), count.reshape(shape)


def sample_surface_points(mesh: Mesh, half_size: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """About `count` places [n, 3] spread evenly by area over all surfaces, inside and out, of a square around the
    origin; a place that nobody can see is among them like any other."""
    corners = mesh.vertices[mesh.faces]
    center = corners[..., :2].mean(1)
    near = np.flatnonzero((np.abs(center) < half_size).all(1))
    corners = corners[near].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(near), count, p=area / area.sum())]
    u, v = rng.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return chosen[:, 0] + u * (chosen[:, 1] - chosen[:, 0]) + v * (chosen[:, 2] - chosen[:, 0])


@dataclass(frozen=True)
class FlightStats:
    """V over places spread evenly by area on the surface that at least one training photograph truly sees.

    V by percentile; Gini coefficient (0: all seen alike); share of the area with V below a limit.
    """

    photographs: int
    mean: float
    quantiles: dict[int, float]
    gini: float
    share_below: dict[int, float]

    @property
    def summary(self) -> str:
        """For people, in one line."""
        quantiles = ", ".join(f"{share} %: {value:g}" for share, value in self.quantiles.items())
        return (
            f"photographs that truly see a place (V), of {self.photographs}, by quantile of the visible surface: "
            f"{quantiles}; Gini {self.gini:.2f}"
        )


def sample_visible_points(
    tracer: RayTracer, mesh: Mesh, training: list[Camera], half_extent: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 3] (m) of the surface that training truly sees, evenly by area, and V [n] of each (at least 1)."""
    places = sample_surface_points(mesh, _AREA_FACTOR * half_extent, _NUM_POINTS, rng)
    views = count_visibility(tracer, training, places)
    seen = views > 0
    return places[seen], views[seen]


def compute_flight_stats(views: np.ndarray, photographs: int) -> FlightStats:
    """The distribution of V [n] in numbers."""
    found = visibility_stats(views.astype(np.int64))
    return FlightStats(photographs, found.mean, found.quantiles, found.gini, found.fraction_below)
