"""A model bent, after it was moved to where it belongs, by what is known better than a similarity of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vdgs.captures.position_adjustment import Up
from vdgs.geometry.similarity import Similarity, fit_similarity
from vdgs.sfm.gcp_list import GcpObservation
from vdgs.sfm.georegistration import Georegistration, transform_model
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.sfm.image_metadata import EXACT_MODEL, ImageMetadata
from vdgs.sfm.reprojection import drop_unseen_observations, mean_reprojection_error
from vdgs.sfm.up_direction import model_centers, model_points
from vdgs.sfm.workspace import call_cancellable
from vdgs.system.lazy_pycolmap import pycolmap

#: A model that is bent by more than this share of the flying height is torn (choice).
MOST_BENT = 0.1
#: Positions tell how a model is bent where they are good to this share of the flying height (choice), and so many.
GOOD_SHARE, ENOUGH_POSITIONS = 0.01, 6
#: Of two deviations the smaller is plainly better below this share of the larger (choice).
PLAINLY_BETTER = 0.5
#: Points that an image counts with: its center and one along each of its axes.
TRIAD = 4


def bend_to_positions(
    model: pycolmap.Reconstruction,
    photographs: Sequence[ImageMetadata],
    positions: GpsPriors,
    placed: Georegistration,
    hold_focal: bool,
    threads: int,
) -> pycolmap.Reconstruction:
    """A bundle adjustment with positions that were found to be good as priors; the model as it is where they are not,
    and where that would tear it. Positions decide the shape: the bent model lies as the model did (`_laid_back`)."""
    accuracy = placed.accuracy
    if accuracy is None or accuracy.positions_m is None or accuracy.altitude != "used":
        return model
    deviations = np.array(accuracy.positions_m)
    each = placed.deviations if placed.deviations is not None else np.tile(deviations, (len(placed.inliers), 1))
    good = (each[placed.inliers] <= GOOD_SHARE * _height(model)).all(axis=1)
    if good.sum() < ENOUGH_POSITIONS or deviations.max() > GOOD_SHARE * _height(model):
        return model
    bent = pycolmap.Reconstruction(model)
    images = {image.name: image for image in bent.images.values() if image.has_pose}
    priors: list[pycolmap.PosePrior] = []
    used = placed.targets[placed.inliers]
    rows = placed.position_rows[placed.inliers].tolist()
    for row, target, deviation in zip(rows, used, each[placed.inliers], strict=True):
        image = images[photographs[int(positions.image_indices[row])].name]
        priors.append(
            pycolmap.PosePrior(
                pose_prior_id=len(priors) + 1,
                corr_data_id=image.data_id,
                position=target,
                position_covariance=np.diag(deviation**2),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    config = _config(bent, images)
    known = pycolmap.PosePriorBundleAdjustmentOptions()
    known.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(_options(hold_focal, threads), known, config, priors, bent)
    call_cancellable(lambda cancellation_token: adjuster.solve())
    transform_model(bent, _laid_back(model, bent, [prior.corr_data_id.id for prior in priors]))
    bent.update_point_3d_errors()
    if _tears(model, bent) is not None:
        return model
    drop_unseen_observations(bent)
    return bent


def tell_level(placed: Georegistration, up: Up) -> bool:
    """Whether positions alone tell level plainly better than attitudes or views do: not along a line that is straight
    to what they are wrong by, nor where both are about as good."""
    accuracy = placed.accuracy
    if accuracy is None or accuracy.positions_m is None:
        return False
    used = placed.targets[placed.inliers]
    across = float(np.linalg.svd(used - used.mean(axis=0), compute_uv=False)[1])
    return bool(np.degrees(np.arctan2(max(accuracy.positions_m), across)) <= PLAINLY_BETTER * up.deviation_deg)


def bend_to_points(
    model: pycolmap.Reconstruction,
    points: Sequence[tuple[Sequence[GcpObservation], np.ndarray]],
    hold_focal: bool,
    threads: int,
) -> tuple[pycolmap.Reconstruction, tuple[str, ...]]:
    """A bundle adjustment with points that stay where they were surveyed, which are taken out of the model again; the
    model as it is, and a note, where that would tear it."""
    bent = pycolmap.Reconstruction(model)
    images = {image.name: image for image in bent.images.values() if image.has_pose}
    config = _config(bent, images)
    fixed = [_add_fixed(bent, images, sightings, target) for sightings, target in points]
    for number in fixed:
        config.add_constant_point(number)
    adjuster = pycolmap.create_default_bundle_adjuster(_options(hold_focal, threads), config, bent)
    try:
        call_cancellable(lambda cancellation_token: adjuster.solve())
    finally:
        for number in fixed:
            bent.delete_point3D(number)
    bent.update_point_3d_errors()
    moved = _tears(model, bent)
    if moved is not None:
        note = f"the model was moved to the control points but not bent: that would move cameras by {moved:.3g} m."
        return model, (note,)
    drop_unseen_observations(bent)
    return bent, ()


def _config(model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image]) -> pycolmap.BundleAdjustmentConfig:
    """All these images; the lenses and the rigs of views that were cut out of panoramas stay."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in images.values():
        config.add_image(image.image_id)
    exact = {number for number, camera in model.cameras.items() if camera.model_name == EXACT_MODEL}
    for number in exact:
        config.set_constant_cam_intrinsics(number)
    for rig in model.rigs.values():
        if rig.ref_sensor_id.id in exact:
            for sensor in rig.non_ref_sensors:
                config.set_constant_sensor_from_rig_pose(sensor)
    return config


def _options(hold_focal: bool, threads: int) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary, options.refine_focal_length = False, not hold_focal
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = threads
    return options


def _height(model: pycolmap.Reconstruction) -> float:
    """Median distance of the cameras to the median point."""
    return float(np.median(np.linalg.norm(model_centers(model) - np.median(model_points(model), axis=0), axis=1)))


def _laid_back(model: pycolmap.Reconstruction, bent: pycolmap.Reconstruction, numbers: Sequence[int]) -> Similarity:
    """The similarity that brings a bent model back to where the model lies, by these of its images.

    The adjustment knows positions alone, neither distances nor up, and begins with a similarity to them, which along a
    line is turned about it by chance: the directions of the cameras say that turn, their centers do not.
    """
    before, after = (_triads(each, numbers) for each in (model, bent))
    rotation = fit_similarity(after, before).rotation
    old, new = before[::TRIAD], after[::TRIAD] @ rotation.T
    middle, moved = old.mean(axis=0), new.mean(axis=0)
    scale = float(((old - middle) * (new - moved)).sum() / ((new - moved) ** 2).sum())
    return Similarity(scale, rotation, middle - scale * moved)


def _triads(model: pycolmap.Reconstruction, numbers: Sequence[int]) -> np.ndarray:
    """Of each of these images its center and a point along each of its axes, as far off as what cameras see."""
    height, rows = _height(model), []
    for number in numbers:
        image = model.image(number)
        center = image.projection_center()
        rows += [center, *(center + height * image.cam_from_world().rotation.matrix())]
    return np.array(rows)


def _tears(model: pycolmap.Reconstruction, bent: pycolmap.Reconstruction) -> float | None:
    """How far cameras moved, metres, where that is more than a bent model allows; None where it is not."""
    numbers = [image.image_id for image in model.images.values() if image.has_pose]
    before, after = (np.array([each.image(k).projection_center() for k in numbers]) for each in (model, bent))
    moved = float(np.sqrt(((after - before) ** 2).sum(axis=1).mean()))
    worse = mean_reprojection_error(bent) > 1 + 2 * mean_reprojection_error(model)
    return moved if worse or moved > MOST_BENT * _height(model) else None


def _add_fixed(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    sightings: Sequence[GcpObservation],
    target: np.ndarray,
) -> int:
    track = pycolmap.Track()
    for sighting in sightings:
        image = images[sighting.image]
        image.points2D.append(pycolmap.Point2D(np.array(sighting.pixel)))
        track.add_element(image.image_id, len(image.points2D) - 1)
    return int(model.add_point3D(target, track, np.zeros(3, np.uint8)))
