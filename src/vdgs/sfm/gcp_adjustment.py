"""A model brought to surveyed points, and measured by them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import least_squares

from vdgs.captures.reconstruction import SurveyFacts
from vdgs.errors import CaptureError
from vdgs.geometry.similarity import Similarity, fit_similarity, fit_similarity_robust, is_collinear
from vdgs.sfm.gcp_list import LEAST_POINTS, LEAST_SIGHTINGS, Control, ControlPoint
from vdgs.sfm.georegistration import move
from vdgs.sfm.workspace import call

#: With so many points, one that does not fit the others is found and left out.
ENOUGH_TO_DOUBT = 6
#: A mark is right to about so many pixels: what is farther off counts less.
MARK_PX = 2.0


@dataclass(frozen=True, eq=False)
class Seen:
    """A surveyed point as a model has it."""

    place: Float[np.ndarray, "3"]
    photographs: int
    error_px: float
    """RMS distance between where photographs show it and where the model puts it there."""


def locate(model: pycolmap.Reconstruction, point: ControlPoint) -> Seen | None:
    """Where the placed photographs see a point; None where fewer than two show it from different places.

    The point nearest to all rays, then the least sum of its errors in the photographs, robustly.
    """
    images = {image.name: image for image in model.images.values() if image.has_pose}
    seen = [each for each in point.sightings if each.photograph in images]
    if len({each.photograph for each in seen}) < LEAST_SIGHTINGS:
        return None
    views = [images[each.photograph] for each in seen]
    cameras = [model.cameras[view.camera_id] for view in views]
    poses = [np.asarray(view.cam_from_world().matrix()) for view in views]
    marked = np.array([each.pixel for each in seen])
    rays = [
        np.append(np.asarray(camera.cam_from_img(pixel)).ravel()[:2], 1) @ pose[:, :3]
        for camera, pose, pixel in zip(cameras, poses, marked, strict=True)
    ]
    start = _nearest(np.array([view.projection_center() for view in views]), np.array(rays))
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
    found = least_squares(errors, start, loss="soft_l1", f_scale=MARK_PX, x_scale="jac").x
    return Seen(found, len(views), float(np.sqrt((errors(found).reshape(-1, 2) ** 2).sum(axis=1).mean())))


def bring_to_control(
    model: pycolmap.Reconstruction, control: Control, origin: tuple[float, float, float], hold_focal: bool, threads: int
) -> tuple[str, set[str]]:
    """Move a model to the points that are not held out, then bend it by them: a bundle adjustment in which they stay
    where they were surveyed. In place, metres east, north, up of `origin`. Returns how that was done, and
    the names of those that do not fit the others, which were left out.

    Raises CaptureError where fewer than three of the points are seen by placed photographs, or they lie along a line.
    """
    targets = control.enu(origin)
    used = [(k, seen) for k, seen in _located(model, control).items() if not control.points[k].held_out]
    rows = np.array([k for k, _ in used], int)
    if len(used) < LEAST_POINTS or is_collinear(targets[rows]):
        raise CaptureError(
            f"{control.source}: {len(used)} of its points are shown by two placed photographs or more, not along one "
            f"line; {LEAST_POINTS} are needed. Mark them in more photographs, or hold them out: --check-points all"
        )
    places = np.array([seen.place for _, seen in used])
    similarity, trusted = _fit(places, targets[rows])
    move(model, similarity)
    kept = rows[trusted]
    _adjust(model, [(control.points[k], targets[k]) for k in kept.tolist()], hold_focal, threads)
    doubtful = {control.points[k].name for k in rows[~trusted].tolist()}
    return f"{len(kept)} control points ({control.source}, {control.system})", doubtful


def survey(
    model: pycolmap.Reconstruction, control: Control, origin: tuple[float, float, float], doubtful: set[str]
) -> tuple[SurveyFacts, ...]:
    """What a placed model makes of all points: seen minus surveyed, metres east, north, up."""
    targets, located = control.enu(origin), _located(model, control)
    facts = []
    for k, point in enumerate(control.points):
        seen = located.get(k)
        used_as = "check" if point.held_out else "not used" if point.name in doubtful or not seen else "control"
        if seen is None:
            facts.append(SurveyFacts(point.name, used_as, 0))
        else:
            off = tuple(float(value) for value in seen.place - targets[k])
            facts.append(SurveyFacts(point.name, used_as, seen.photographs, off, seen.error_px))
    return tuple(facts)


def _located(model: pycolmap.Reconstruction, control: Control) -> dict[int, Seen]:
    found = ((k, locate(model, point)) for k, point in enumerate(control.points))
    return {k: seen for k, seen in found if seen is not None}


def _nearest(centres: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """The point with the least sum of squared distances to lines; None where they are parallel."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, centres)))


def _fit(places: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"]) -> tuple[Similarity, np.ndarray]:
    if len(places) < ENOUGH_TO_DOUBT:
        return fit_similarity(places, targets), np.ones(len(places), bool)
    return fit_similarity_robust(places, targets)


def _adjust(
    model: pycolmap.Reconstruction,
    points: Sequence[tuple[ControlPoint, np.ndarray]],
    hold_focal: bool,
    threads: int,
) -> None:
    """Bundle adjustment with points that stay where they are, which are taken out of the model again."""
    config, images = pycolmap.BundleAdjustmentConfig(), {}
    for image in model.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
            images[image.name] = image
    fixed = [_add_fixed(model, images, point, target) for point, target in points]
    for number in fixed:
        config.add_constant_point(number)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, not hold_focal
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    try:
        call(lambda cancellation_token: adjuster.solve())
    finally:
        for number in fixed:
            model.delete_point3D(number)
    model.update_point_3d_errors()


def _add_fixed(
    model: pycolmap.Reconstruction, images: dict[str, pycolmap.Image], point: ControlPoint, target: np.ndarray
) -> int:
    track = pycolmap.Track()
    for sighting in point.sightings:
        image = images.get(sighting.photograph)
        if image is not None:
            image.points2D.append(pycolmap.Point2D(np.array(sighting.pixel)))
            track.add_element(image.image_id, len(image.points2D) - 1)
    return int(model.add_point3D(target, track, np.zeros(3, np.uint8)))
