"""A model brought to surveyed points, and measured by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import least_squares

from vdgs.captures.reconstruction import GcpReport
from vdgs.errors import CaptureError
from vdgs.geometry.similarity import Similarity, fit_similarity, fit_similarity_robust, is_collinear
from vdgs.sfm.gcp_list import MIN_CONTROL_POINTS, MIN_OBSERVATIONS, GcpList, GroundControlPoint
from vdgs.sfm.georegistration import transform_model
from vdgs.sfm.workspace import call_cancellable

#: With so many points, one that does not fit the others is found and left out.
MIN_POINTS_FOR_OUTLIERS = 6
#: A mark is right to about so many pixels: what is farther off counts less.
MARK_SIGMA_PX = 2.0


@dataclass(frozen=True, eq=False)
class TriangulatedPoint:
    """A surveyed point as a model has it."""

    position: Float[np.ndarray, "3"]
    num_images: int
    error_px: float
    """RMS distance between where photographs show it and where the model puts it there."""


def triangulate(model: pycolmap.Reconstruction, point: GroundControlPoint) -> TriangulatedPoint | None:
    """Where the placed photographs see a point; None where fewer than two show it from different places.

    The point nearest to all rays, then the least sum of its errors in the photographs, robustly.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    seen = [each for each in point.observations if each.image in images]
    if len({each.image for each in seen}) < MIN_OBSERVATIONS:
        return None
    views = [images[each.image] for each in seen]
    cameras = [model.cameras[view.camera_id] for view in views]
    poses = [np.asarray(view.cam_from_world().matrix()) for view in views]
    marked = np.array([each.pixel for each in seen])
    rays = [
        np.append(np.asarray(camera.cam_from_img(pixel)).ravel()[:2], 1) @ pose[:, :3]
        for camera, pose, pixel in zip(cameras, poses, marked, strict=True)
    ]
    start = _intersect_rays(np.array([view.projection_center() for view in views]), np.array(rays))
    if start is None:
        return None

    def errors(place: np.ndarray) -> np.ndarray:
        shown = [
            np.asarray(camera.img_from_cam((pose @ np.append(place, 1))[None])).ravel()
            for camera, pose in zip(cameras, poses, strict=True)
        ]
        return (np.array(shown) - marked).ravel()

    if any((pose @ np.append(start, 1))[2] <= 0 for pose in poses):
        return None  # behind a camera: the marks are of different things
    found = least_squares(errors, start, loss="soft_l1", f_scale=MARK_SIGMA_PX, x_scale="jac").x
    return TriangulatedPoint(found, len(views), float(np.sqrt((errors(found).reshape(-1, 2) ** 2).sum(axis=1).mean())))


def adjust_to_gcps(
    model: pycolmap.Reconstruction, gcps: GcpList, origin: tuple[float, float, float], fix_focal: bool, threads: int
) -> tuple[str, set[str]]:
    """Move a model to the points that are not held out, then bend it by them: a bundle adjustment in which they stay
    where they were surveyed. In place, metres east, north, up of `origin`. Returns how that was done, and
    the names of those that do not fit the others, which were left out.

    Raises CaptureError where fewer than three of the points are seen by placed photographs, or they lie along a line.
    """
    targets = gcps.enu(origin)
    used = [(k, seen) for k, seen in _triangulate_all(model, gcps).items() if not gcps.points[k].is_check_point]
    rows = np.array([k for k, _ in used], int)
    if len(used) < MIN_CONTROL_POINTS or is_collinear(targets[rows]):
        raise CaptureError(
            f"{gcps.source}: {len(used)} of its points are shown by two placed photographs or more, not along one "
            f"line; {MIN_CONTROL_POINTS} are needed. Mark them in more photographs, or hold them out: --check-points all"
        )
    places = np.array([seen.position for _, seen in used])
    similarity, trusted = _fit_to_gcps(places, targets[rows])
    transform_model(model, similarity)
    kept = rows[trusted]
    _bundle_adjust(model, [(gcps.points[k], targets[k]) for k in kept.tolist()], fix_focal, threads)
    doubtful = {gcps.points[k].name for k in rows[~trusted].tolist()}
    return f"{len(kept)} control points ({gcps.source}, {gcps.crs})", doubtful


def measure_gcps(
    model: pycolmap.Reconstruction, gcps: GcpList, origin: tuple[float, float, float], outliers: set[str]
) -> tuple[GcpReport, ...]:
    """What a placed model makes of all points: seen minus surveyed, metres east, north, up."""
    targets, located = gcps.enu(origin), _triangulate_all(model, gcps)
    facts = []
    for k, point in enumerate(gcps.points):
        seen = located.get(k)
        used_as = "check" if point.is_check_point else "not used" if point.name in outliers or not seen else "control"
        if seen is None:
            facts.append(GcpReport(point.name, used_as, 0))
        else:
            off = tuple(float(value) for value in seen.position - targets[k])
            facts.append(GcpReport(point.name, used_as, seen.num_images, off, seen.error_px))
    return tuple(facts)


def _triangulate_all(model: pycolmap.Reconstruction, gcps: GcpList) -> dict[int, TriangulatedPoint]:
    found = ((k, triangulate(model, point)) for k, point in enumerate(gcps.points))
    return {k: seen for k, seen in found if seen is not None}


def _intersect_rays(centers: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """The point with the least sum of squared distances to lines; None where they are parallel."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, centers)))


def _fit_to_gcps(points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"]) -> tuple[Similarity, np.ndarray]:
    if len(points) < MIN_POINTS_FOR_OUTLIERS:
        return fit_similarity(points, targets), np.ones(len(points), bool)
    return fit_similarity_robust(points, targets)


def _bundle_adjust(
    model: pycolmap.Reconstruction,
    points: Sequence[tuple[GroundControlPoint, np.ndarray]],
    fix_focal: bool,
    threads: int,
) -> None:
    """Bundle adjustment with points that stay where they are, which are taken out of the model again."""
    config, images = pycolmap.BundleAdjustmentConfig(), {}
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
            images[image.name] = image
    fixed = [_add_fixed_point(model, images, point, target) for point, target in points]
    for number in fixed:
        config.add_constant_point(number)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, not fix_focal
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    try:
        call_cancellable(lambda cancellation_token: adjuster.solve())
    finally:
        for number in fixed:
            model.delete_point3D(number)
    model.update_point_3d_errors()


def _add_fixed_point(
    model: pycolmap.Reconstruction, images: dict[str, pycolmap.Image], point: GroundControlPoint, target: np.ndarray
) -> int:
    track = pycolmap.Track()
    for sighting in point.observations:
        image = images.get(sighting.image)
        if image is not None:
            image.points2D.append(pycolmap.Point2D(np.array(sighting.pixel)))
            track.add_element(image.image_id, len(image.points2D) - 1)
    return int(model.add_point3D(target, track, np.zeros(3, np.uint8)))
