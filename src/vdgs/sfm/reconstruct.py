"""`vdgs sfm`: photographs to a capture. Each step keeps what it has done; the same command goes on."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from rich.console import Console

from vdgs import __version__
from vdgs.captures.reconstruction import (
    RECONSTRUCTION_FIGURE,
    RECONSTRUCTION_FILE,
    WORK_FOLDER,
    GcpReport,
    ReconstructionReport,
    is_reconstruction,
    read_reconstruction,
)
from vdgs.config.serialization import to_dict
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import VdgsError
from vdgs.geometry.similarity import Similarity
from vdgs.sfm import (
    capture_writer,
    feature_extraction,
    feature_matching,
    gcp_adjustment,
    georegistration,
    incremental_mapper,
    mask_files,
)
from vdgs.sfm.console_report import print_reconstruction_report
from vdgs.sfm.image_list import ExcludedImage
from vdgs.sfm.position_plots import plot_positions, plot_residuals
from vdgs.sfm.reconstruction_plan import (
    ReconstructionPlan,
    check_disk_space,
    plan_reconstruction,
    print_plan,
    time_order,
)
from vdgs.sfm.reconstruction_report import ReconstructionResult, exclusion_reasons, make_reconstruction_report
from vdgs.sfm.workspace import Workspace, cache_key, silence_colmap
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.file_locks import lock_folder
from vdgs.system.records import record_to_dict

#: Where the positions are shown before the work, inside the output.
POSITIONS_FIGURE = "photographs.png"


def reconstruct(
    request: SfmRequest, console: Console, lock: AbstractContextManager[None] | None = None
) -> ReconstructionReport:
    """Make a capture of photographs in `request.output`, or go on with one that was begun.

    `alone` is held while anything is written; not where all is done already. Raises what it raises, CaptureError for
    photographs that cannot become one, VdgsError for an output that is something else and a disk that is full. What was
    done is kept.
    """
    silence_colmap()
    prepared = plan_reconstruction(request)
    output = request.output
    work, keys = Workspace(output / WORK_FOLDER), _keys(prepared)
    facts = read_reconstruction(output) if _is_finished(output, keys["capture"]) else None
    if facts is not None:
        console.print(f"{output}: made of these photographs already; nothing to do", highlight=False)
        return facts
    _check_output_folder(output)
    print_plan(prepared, console)
    check_disk_space(prepared)
    with lock or nullcontext(), lock_folder(output):
        work.path.mkdir(exist_ok=True)
        plot_positions(
            prepared.gps_priors, time_order(prepared), "Where the photographs were taken", output / POSITIONS_FIGURE
        )
        facts = _steps(prepared, work, keys, console)
        if not request.keep_intermediate:
            work.remove()
    print_reconstruction_report(facts, console)
    return facts


def _keys(plan: ReconstructionPlan) -> dict[str, str]:
    """What each step depends on, each on those before it."""
    options, positions = plan.request.options, plan.gps_priors
    files = [
        (photo.name, photo.file_bytes, photo.path.stat().st_mtime_ns, photo.width, photo.height, photo.orientation)
        for photo in plan.image_list.images
    ]
    lenses = [photo.lens and photo.lens.focal for photo in plan.image_list.images]
    found = cache_key(
        __version__, files, lenses, options.max_image_size, options.max_num_features, *_masked_images(plan)
    )
    placed = [positions.image_indices.tolist(), positions.enu.tolist(), positions.gps_std.tolist()]
    matched = cache_key(found, placed, options.num_neighbors, options.exhaustive_max)
    mapped = cache_key(matched, options.focal)
    points = plan.gcps.points if plan.gcps else ()
    capture = cache_key(mapped, options.max_output_size, [record_to_dict(point) for point in points])
    return {"features": found, "matches": matched, "model": mapped, "capture": capture}


def _masked_images(plan: ReconstructionPlan) -> list[tuple[Any, ...]]:
    """Photographs of which something may be left out, and what says so."""
    masked = [photo for photo in plan.image_list.images if photo.may_be_masked]
    files = [photo.mask.stat() if photo.mask is not None else None for photo in masked]
    return [
        (photo.name, photo.has_alpha_channel, file and (file.st_size, file.st_mtime_ns))
        for photo, file in zip(masked, files, strict=True)
    ]


def _is_finished(output: Path, key: str) -> bool:
    return (output / RECONSTRUCTION_FILE).is_file() and Workspace(output).is_done("capture", key)


def _check_output_folder(output: Path) -> None:
    """Only a new folder, an empty one, or one of an earlier reconstruction is written to."""
    if output.is_dir() and not is_reconstruction(output) and _has_foreign_files(output):
        raise VdgsError(f"{output}: holds other things already. Choose a new folder with --output.")
    if output.exists() and not output.is_dir():
        raise VdgsError(f"{output}: is a file. Choose a new folder with --output.")


def _has_foreign_files(output: Path) -> bool:
    """Whether a folder holds anything but what a reconstruction begins with."""
    return any(each.name not in (".lock", POSITIONS_FIGURE) and each.suffix != ".tmp" for each in output.iterdir())


def _steps(
    plan: ReconstructionPlan, workspace: Workspace, keys: dict[str, str], console: Console
) -> ReconstructionReport:
    began = time.monotonic()
    request, output = plan.request, plan.request.output
    photographs, threads = plan.image_list.images, plan.threads
    kinds = feature_extraction.group_by_camera(photographs)
    lost = _features(plan, workspace, kinds, keys["features"], console)
    usable = [photo for photo in photographs if photo.name not in {each.name for each in lost}]
    pairs = _matches(plan, workspace, keys["matches"], console)
    held = incremental_mapper.should_fix_focal(photographs, plan.gps_priors, request.options)
    models = _models(plan, workspace, keys["model"], len(usable), held[0], console)
    left_out = exclusion_reasons(
        models[0],
        models[1:],
        [photo.name for photo in photographs],
        feature_matching.count_verified_matches(workspace),
        lost,
    )
    placed, origin, surveyed = _georegister(models[0], plan, held[0])
    _write(plan, workspace, models[0], keys["capture"], threads, console)
    outcome = ReconstructionResult(
        camera_groups=kinds, registration=placed, origin=origin, survey=surveyed, excluded=left_out,
        components=[model.num_reg_images() for model in models], pairs=pairs, focal_fixed=held,
        seconds=time.monotonic() - began,
    )  # fmt: skip
    facts = make_reconstruction_report(models[0], plan, outcome)
    points = georegistration.model_points(models[0])
    marks = dict(zip((each.name for each in surveyed), _gcp_positions(plan), strict=False))
    plot_residuals(points, plan.gps_priors, outcome.georegistration, marks, output / RECONSTRUCTION_FIGURE)
    if origin is not None:
        write_json(output / "georef.json", _georef(facts, origin))
    capture_writer.write_model(output, models[0], _lenses(models[0], request.options.max_output_size))
    write_json(
        output / RECONSTRUCTION_FILE,
        to_jsonable(record_to_dict(facts)) | {"options": to_jsonable(to_dict(request.options))},
    )
    Workspace(output).finish("capture", keys["capture"])
    return facts


def _features(
    plan: ReconstructionPlan,
    workspace: Workspace,
    camera_groups: Sequence[feature_extraction.CameraGroup],
    key: str,
    console: Console,
) -> list[ExcludedImage]:
    options, photographs = plan.request.options, plan.image_list.images
    if not workspace.is_begun("features", key):
        workspace.remove()
        workspace.begin("features", key)
    feature_extraction.create_database(workspace, camera_groups)
    failed = feature_extraction.write_upright_images(workspace, photographs)
    counts = feature_extraction.count_features(workspace)
    if not workspace.is_done("features", key):
        mask_files.write_upright_masks(workspace, photographs, plan.threads)
        counts = feature_extraction.extract_features(
            workspace, camera_groups, options.max_image_size, options.max_num_features, plan.threads, console
        )
        workspace.finish("features", key)
    named = {each.name for each in failed}
    return failed + [
        each for each in feature_extraction.images_without_features(photographs, counts) if each.name not in named
    ]


def _matches(plan: ReconstructionPlan, workspace: Workspace, key: str, console: Console) -> int:
    photographs = plan.image_list.images
    chosen = feature_matching.select_pairs(workspace, photographs, plan.gps_priors, plan.request.options)
    there = feature_extraction.count_features(workspace)
    chosen = [pair for pair in chosen if all(there.get(name) for name in pair)]
    if workspace.is_done("matches", key):
        return len(chosen)
    if not workspace.is_begun("matches", key):
        feature_matching.delete_matches(workspace)
        workspace.begin("matches", key)
    feature_matching.match_pairs(workspace, chosen, plan.threads, console)
    workspace.finish("matches", key)
    return len(chosen)


def _models(
    plan: ReconstructionPlan, workspace: Workspace, key: str, count: int, fix_focal: bool, console: Console
) -> list[pycolmap.Reconstruction]:
    if workspace.is_done("model", key):
        return incremental_mapper.read_models(workspace)
    if not workspace.is_begun("model", key):
        incremental_mapper.delete_models(workspace)
        workspace.begin("model", key)
    incremental_mapper.write_pose_priors(workspace, plan.image_list.images, plan.gps_priors)
    models = incremental_mapper.run_mapper(workspace, count, fix_focal, plan.gps_priors.usable, plan.threads, console)
    workspace.finish("model", key)
    return models


def _georegister(
    model: pycolmap.Reconstruction, plan: ReconstructionPlan, fix_focal: bool
) -> tuple[
    georegistration.Georegistration | georegistration.AlignmentFailure,
    tuple[float, float, float] | None,
    tuple[GcpReport, ...],
]:
    """Bring the model to metres east, north, up, its median point to height 0; the origin that this has on Earth, and
    what it makes of surveyed points."""
    photographs, positions, control = plan.image_list.images, plan.gps_priors, plan.gcps
    doubtful = set[str]()
    if control is not None and control.has_control_points:
        how, doubtful = gcp_adjustment.adjust_to_gcps(model, control, plan.origin, fix_focal, plan.threads)
        placed: georegistration.Georegistration | georegistration.AlignmentFailure = (
            georegistration.registration_in_place(model, photographs, positions, how)
        )
    else:
        placed = georegistration.georegister(model, photographs, positions)
        if isinstance(placed, georegistration.Georegistration):
            georegistration.transform_model(model, placed.similarity)
    if isinstance(placed, georegistration.AlignmentFailure):
        return placed, None, ()
    surveyed = gcp_adjustment.measure_gcps(model, control, plan.origin, doubtful) if control is not None else ()
    ground = float(np.median(georegistration.model_points(model)[:, 2]))
    georegistration.transform_model(model, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -ground])))
    latitude, longitude, altitude = plan.origin
    return placed, (latitude, longitude, altitude + ground), surveyed


def _gcp_positions(plan: ReconstructionPlan) -> np.ndarray:
    """Surveyed points [n, 3], none where nothing was placed."""
    return plan.gcps.enu(plan.origin) if plan.gcps else np.zeros((0, 3))


def _lenses(model: pycolmap.Reconstruction, max_size: int) -> dict[int, capture_writer.Undistortion]:
    used = sorted({image.camera_id for image in model.images.values() if image.has_pose})
    return {number: capture_writer.make_undistortion(model.cameras[number], max_size) for number in used}


def _write(
    plan: ReconstructionPlan,
    workspace: Workspace,
    model: pycolmap.Reconstruction,
    key: str,
    threads: int,
    console: Console,
) -> None:
    output = plan.request.output
    if not Workspace(output).is_begun("capture", key):
        for name in (*(folder for folder, _ in capture_writer.IMAGE_SIZES), capture_writer.MASK_FOLDER, "sparse"):
            shutil.rmtree(output / name, ignore_errors=True)
        for name in (RECONSTRUCTION_FILE, "georef.json", RECONSTRUCTION_FIGURE):
            (output / name).unlink(missing_ok=True)
        Workspace(output).begin("capture", key)
    shutil.rmtree(output / "sparse", ignore_errors=True)
    names: dict[int, list[str]] = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            names.setdefault(image.camera_id, []).append(image.name)
    capture_writer.write_images(
        output, workspace, names, _lenses(model, plan.request.options.max_output_size), threads, console
    )


def _georef(report: ReconstructionReport, origin: tuple[float, float, float]) -> JsonObject:
    latitude, longitude, altitude = origin
    return {
        "frame": "ENU, metres, x east y north z up",
        "origin_lat_deg": latitude, "origin_lon_deg": longitude, "origin_alt_m": altitude,
        "alt_reference": report.altitude_reference,
        "method": f"bundle adjustment with positions as priors, then a similarity to the {report.georeferenced}",
        "gps_outliers_left_out": report.positions_rejected,
        "gps_residual_rms_m_xyz": list(report.residual_rms_m or ()),
        "z0": "median height of the 3D points",
    }  # fmt: skip
