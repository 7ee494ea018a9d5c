"""Poses and points from matches alone: COLMAP's incremental mapper."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from vdgs.captures.formats.colmap_writing import check_whole_model, write_model_files
from vdgs.errors import CaptureError
from vdgs.sfm.capture_writer import longest_focal, placed_images
from vdgs.sfm.feature_extraction import CameraGroup
from vdgs.sfm.image_metadata import EXACT_MODEL
from vdgs.sfm.reprojection import drop_unseen_observations
from vdgs.sfm.workspace import Workspace, call_cancellable, report_progress
from vdgs.system.lazy_pycolmap import pycolmap

#: Parts of fewer photographs than this are no model.
MIN_MODEL_SIZE = 3
#: All poses are adjusted whenever the model has grown so far, and at the end. Growth by a tenth, COLMAP's own, takes
#: half as long again and ends at the same model (experiments/reports/photographs.md).
GLOBAL_ADJUSTMENT_RATIO = 1.4
#: What the mapper has is kept so many times on the way, each time by so many photographs more at least.
MAX_SNAPSHOTS, MIN_SNAPSHOT_INTERVAL = 20, 5


def height_over_points(image: pycolmap.Image, model: pycolmap.Reconstruction) -> float:
    """Median distance along the view to the points that an image shows."""
    seen = [model.points3D[each.point3D_id].xyz for each in image.points2D if each.has_point3D()]
    pose = image.cam_from_world().matrix()
    return float(np.median(np.array(seen) @ pose[2, :3] + pose[2, 3]))


def run_mapper(workspace: Workspace, count: int, fix_focal: bool, threads: int, console: Console) -> None:
    """Write all models that the mapper makes of the matches (`read_models`).

    What it has is kept on the way, and goes on where it was stopped (`delete_models` first to begin anew). Raises
    CaptureError where it makes none, VdgsError where the disk does not hold them.
    """
    for folder in (workspace.models, workspace.snapshots):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    options = _options(fix_focal, threads)
    with workspace.open_database() as database:
        cameras = database.read_all_cameras()
        exact = {camera.camera_id for camera in cameras if camera.model_name == EXACT_MODEL}
        rigs = [rig for rig in database.read_all_rigs() if rig.ref_sensor_id.id in exact]
    options.max_focal_length_ratio = longest_focal(cameras)
    options.constant_cameras = options.mapper.constant_cameras = exact
    options.constant_rigs = options.mapper.constant_rigs = {rig.rig_id for rig in rigs}
    options.snapshot_path, options.snapshot_frames_freq = (
        workspace.snapshots,
        max(MIN_SNAPSHOT_INTERVAL, count // MAX_SNAPSHOTS),
    )
    begun = _largest_snapshot(workspace)
    placed = int(begun.name) if begun else 2  # a model begins with two
    note = f"{placed} placed before, " if begun else ""
    with report_progress(workspace, console, "mapping", count, note) as tell:
        tell(placed)

        def one_more() -> None:
            nonlocal placed
            placed += 1
            tell(min(placed, count))
            save_snapshots(workspace)

        try:
            models = call_cancellable(
                pycolmap.incremental_mapping, workspace.database, workspace.images, workspace.models, options,
                input_path=begun or "", next_image_callback=one_more,
            )  # fmt: skip
        except KeyboardInterrupt:
            save_snapshots(workspace)  # the mapper ended by itself: they are whole
            raise
        tell(count)
    for number, model in models.items():  # COLMAP writes no folder for a model that goes on from a snapshot
        write_model_files(model, workspace.models / str(number))
    if not models:
        raise CaptureError(
            "no two photographs could be joined. Either they do not overlap, or they were all taken at one place "
            "(turning alone shows no depth), or they show nothing to hold on to: water, snow, blurred pictures. Fly "
            "with 70 to 80 % overlap, the camera moving between photographs."
        )


def save_snapshots(workspace: Workspace) -> None:
    """Put whole snapshots of the mapper where the same command goes on from, unless a larger one is there.

    To be called where the mapper does not write: then what is there is whole.
    """
    for folder in sorted(workspace.snapshots.iterdir()) if workspace.snapshots.is_dir() else []:
        try:
            check_whole_model(folder)
        except OSError:  # a full disk: what was saved before stays
            shutil.rmtree(folder)
            continue
        before, count = _largest_snapshot(workspace), registered_count(folder)
        if before is None or count > int(before.name):
            workspace.saved_snapshots.mkdir(exist_ok=True)
            os.replace(folder, workspace.saved_snapshots / str(count))
            if before is not None:
                shutil.rmtree(before)
        else:
            shutil.rmtree(folder)


def delete_models(workspace: Workspace) -> None:
    """Remove all models, finished or not."""
    for folder in (workspace.models, workspace.snapshots, workspace.saved_snapshots):
        shutil.rmtree(folder, ignore_errors=True)


def _largest_snapshot(workspace: Workspace) -> Path | None:
    return max(workspace.saved_snapshots.glob("*"), key=lambda folder: int(folder.name), default=None)


def registered_count(folder: Path) -> int:
    """Number of photographs that a written model places: the first eight bytes of its images."""
    with (folder / "images.bin").open("rb") as file:
        return int.from_bytes(file.read(8), "little")


def set_models_aside(workspace: Workspace, place: Path | None = None) -> None:
    """Keep the models of a first run of the mapper, for `read_models` and `take_models_back`, or in another place. They
    stay where they are until the next run begins, for the work may stop in between."""
    place = place or workspace.models_aside
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(workspace.models, place)
    for folder in (workspace.snapshots, workspace.saved_snapshots):
        shutil.rmtree(folder, ignore_errors=True)


def take_models_back(workspace: Workspace) -> None:
    delete_models(workspace)
    shutil.copytree(workspace.models_aside, workspace.models)


def read_models(workspace: Workspace, place: Path | None = None) -> list[pycolmap.Reconstruction]:
    """What `run_mapper` found, or what was set aside in a place, the model of most photographs first."""
    folders = sorted((place or workspace.models).iterdir())
    models = [pycolmap.Reconstruction(folder) for folder in folders if folder.is_dir()]
    for model in models:
        drop_unseen_observations(model)
    return sorted(models, key=lambda model: -model.num_reg_images())


def _options(fix_focal: bool, threads: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    options.min_model_size = MIN_MODEL_SIZE
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not fix_focal
    options.use_prior_position = False  # poses come without trust in positions, which may be off by any amount
    # Its solver takes minutes for each photograph that does not fit, and finds none in overlapping flights.
    options.structure_less_registration_fallback = False
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GLOBAL_ADJUSTMENT_RATIO
    # Points that two photographs see are where the edges of a flight, and few photographs, have any.
    options.triangulation.ignore_two_view_tracks = False
    return options


def refined_cameras(
    model: pycolmap.Reconstruction, camera_groups: Sequence[CameraGroup]
) -> list[pycolmap.Camera | None]:
    """The fitted cameras in the order of the kinds of photographs; None for those without a placed photograph."""
    used = {image.camera_id for image in placed_images(model)}
    return [model.cameras[k] if k in used and k in model.cameras else None for k in range(1, len(camera_groups) + 1)]
