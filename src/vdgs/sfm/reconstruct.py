"""`vdgs sfm`: photographs to a capture. Each step keeps what it has done; the same command goes on."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from vdgs.captures.formats.colmap_writing import write_model_files
from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.captures.georeference import ENU_FRAME, LOCAL_FRAME, ORIGIN_KEYS
from vdgs.captures.reconstruction import (
    MAPPED,
    RECONSTRUCTION_FIGURE,
    RECONSTRUCTION_FILE,
    WORK_FOLDER,
    ReconstructionReport,
    read_digests,
    read_reconstruction,
)
from vdgs.config.serialization import to_dict
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import VdgsError
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm import (
    capture_writer,
    feature_extraction,
    feature_matching,
    mask_files,
)
from vdgs.sfm.console_report import print_reconstruction_report
from vdgs.sfm.discarding import (
    agree_to_discard,
    check_nothing_trained,
    check_trained_on_this,
    discard_training,
    forget_agreement,
)
from vdgs.sfm.films.take_frames import with_frames
from vdgs.sfm.georeferencing import Georeferenced, georeference
from vdgs.sfm.image_list import ExcludedImage
from vdgs.sfm.mapping import map_photographs
from vdgs.sfm.panoramas import apply_rigs
from vdgs.sfm.position_plots import plot_positions, plot_residuals
from vdgs.sfm.reconstruction_plan import (
    POSITIONS_FIGURE,
    ReconstructionPlan,
    check_disk_space,
    plan_reconstruction,
    print_plan,
    time_order,
)
from vdgs.sfm.reconstruction_report import (
    ReconstructionResult,
    check_enough_placed,
    exclusion_reasons,
    focal_reason,
    make_reconstruction_report,
)
from vdgs.sfm.sfm_estimate import SfmEstimate, estimate_sfm
from vdgs.sfm.source_images import SourceImages, check_unchanged
from vdgs.sfm.step_keys import step_keys
from vdgs.sfm.up_direction import model_points
from vdgs.sfm.workspace import Workspace, report_progress, silence_colmap
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.file_locks import lock_folder
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.records import record_to_dict

#: A lens that moves pixels by no more leaves the photographs without distortion as they are.
LENS_PX = 0.05
#: What the same command has left to do of a capture: nothing, to place a finished one anew, or to make it or go on.
WorkLeft = Literal["nothing", "placing", "all"]


def reconstruct(
    request: SfmRequest,
    console: Console,
    run: RunFolder | None = None,
    command: str | None = None,
    on_estimate: Callable[[ReconstructionPlan, SfmEstimate], None] | None = None,
) -> ReconstructionReport:
    """Make a capture of photographs in `request.output`, or go on with one that was begun.

    `run` is the run that the capture is for: this process drives it while anything is written, and what was trained on
    another capture is deleted (`request.overwrite`) when the new one takes its place. `command` is the command line,
    recorded for `vdgs status`. `on_estimate` is called before work that begins, once it is told. Raises
    CaptureError for photographs that cannot become a capture, RunError for a run that another process drives, VdgsError
    for an output that is something else, other photographs than before and a disk that is full. What was done is kept.
    """
    silence_colmap()
    output = request.output
    request = with_frames(request, console, run)
    prepared, digests = plan_reconstruction(request), read_digests(output)
    work, keys = Workspace(output / WORK_FOLDER), step_keys(prepared, digests)
    sources = SourceImages.of(request.image_folders, digests, command)
    if command is None and run is not None and (begun := SourceImages.read(output)) is not None:
        sources = replace(sources, command=begun.command)  # that of the run, which goes on with it
    left = _work_left(prepared, keys, sources, run)
    before = None if left == "all" else read_reconstruction(output)
    if before is not None and left == "nothing":
        check_trained_on_this(request, run)
        console.print(describe_work_left(request, left), highlight=False)
        with suppress(VdgsError):  # they save reading and advice, and the folder may be read-only
            if SourceImages.read(output) != sources:  # of files that are not used, or the command
                sources.write(output)
            digests.write()
            forget_agreement(output)
        if not request.keep_intermediate:
            work.remove()
        return before
    if before is not None:
        began = time.monotonic()
        found = _placed_again(prepared, before)  # may be refused: before anything is deleted or noted
        with writing(request, run):
            sources.write(output)
            digests.write()
            discard_training(output, run)
            facts = _place_anew(prepared, before, found, keys, began, console)
        console.print(f"{output}: placed anew; its photographs and poses stay", highlight=False)
        print_reconstruction_report(facts, console)
        return facts
    check_disk_space(prepared)
    goes_on = work.is_begun("features", keys["features"])
    estimate = None if goes_on else estimate_sfm(prepared)
    print_plan(prepared, "" if estimate is None else estimate.text(prepared.threads), console)
    if estimate is not None and on_estimate is not None:
        on_estimate(prepared, estimate)
    with writing(request, run):
        sources.write(output)
        digests.write()
        if estimate is not None:
            work.remove()
            work.begin("features", keys["features"])
            write_json(work.expected_file, estimate.expected_seconds)
        agree_to_discard(output, keys["placed"], run)
        plot_positions(
            prepared.gps_priors, time_order(prepared), "Where the photographs were taken", output / POSITIONS_FIGURE
        )
        facts = _steps(prepared, work, keys, console, run)
    print_reconstruction_report(facts, console)
    return facts


def look_at_work(request: SfmRequest, run: RunFolder | None) -> tuple[ReconstructionPlan, WorkLeft]:
    """The look before the work, and what `reconstruct` has left to do, of frames in place of films; nothing is written.
    Raises what it raises before its work."""
    prepared, output = plan_reconstruction(request), request.output
    if SourceImages.read(output) is None and read_reconstruction(output) is None:  # no need to read all photographs
        check_nothing_trained(request, run)
        return prepared, "all"
    digests = read_digests(output)
    sources = SourceImages.of(request.image_folders, digests)
    return prepared, _work_left(prepared, step_keys(prepared, digests), sources, run)


def describe_work_left(request: SfmRequest, left: WorkLeft) -> str:
    """What happens to the capture that is there; empty where none is finished."""
    if read_reconstruction(request.output) is None:
        return ""
    return {
        "nothing": f"{request.output}: made of these photographs already; nothing to do",
        "placing": f"{request.output}: is placed anew, in seconds; its photographs and poses stay",
        "all": f"{request.output}: was made of other photographs or with other settings (--sfm.*); it is made anew",
    }[left]


def _work_left(
    prepared: ReconstructionPlan, keys: dict[str, str], sources: SourceImages, run: RunFolder | None
) -> WorkLeft:
    """Raises VdgsError where photographs are others than before, RunError for a run that was trained on the capture."""
    request, output = prepared.request, prepared.request.output
    if _is_finished(output, keys["placed"]) and read_reconstruction(output) is not None:
        return "nothing"
    check_unchanged(output, sources, request.overwrite)
    check_nothing_trained(request, run, keys["placed"])
    return "placing" if _is_placed_otherwise(output, keys["capture"]) else "all"


@contextmanager
def writing(request: SfmRequest, run: RunFolder | None) -> Iterator[None]:
    """Hold the locks while the capture is written, then delete the work folder, unless the work was interrupted.
    RunError where another process works on the run, or drives it: what was trained is to be deleted."""
    with run.drive_lock() if run is not None else nullcontext(), lock_folder(request.output):
        if run is not None:
            with run.locked():
                pass
        yield
        if not request.keep_intermediate:
            Workspace(request.output / WORK_FOLDER).remove()


def _is_finished(output: Path, key: str) -> bool:
    return (output / RECONSTRUCTION_FILE).is_file() and Workspace(output).is_done("placed", key)


def _is_placed_otherwise(output: Path, key: str) -> bool:
    """Whether a capture of the same photographs was finished, and is to be placed anew."""
    finished = Workspace(output)
    is_capture = finished.is_done("capture", key) or finished.is_begun("capture", key)  # being placed anew
    return is_capture and (output / MAPPED).is_dir() and read_reconstruction(output) is not None


def _placed_again(prepared: ReconstructionPlan, before: ReconstructionReport) -> Georeferenced:
    """The model of a finished capture where it belongs now. Nothing is written; raises CaptureError for positions,
    distances and control points that are refused, and for a lens that these fit to none that there is."""
    model = pycolmap.Reconstruction(prepared.request.output / MAPPED)
    found = georeference(model, prepared, (before.focal_fixed, focal_reason(before.focal_reason)))
    _lenses(found.model)
    return found


def _place_anew(
    prepared: ReconstructionPlan,
    before: ReconstructionReport,
    found: Georeferenced,
    keys: dict[str, str],
    began: float,
    console: Console,
) -> ReconstructionReport:
    """Write where a finished capture lies now. Photographs are written again only where what places it tells another
    lens, and where that was interrupted. `began`: when placing did, by the monotonic clock."""
    collection = prepared.image_list
    output, photographs = prepared.request.output, collection.images
    kinds, finished = feature_extraction.group_by_camera(photographs), Workspace(output)
    if not finished.is_done("capture", keys["capture"]) or _lens_moved(output, found.model):
        work = Workspace(output / WORK_FOLDER)
        feature_extraction.write_upright_images(work, photographs, prepared.threads)
        mask_files.write_upright_masks(work, photographs, prepared.threads)
        finished.begin("placed", keys["placed"])
        finished.begin("capture", keys["capture"])  # until all photographs are of this lens
        shutil.rmtree(output / "sparse", ignore_errors=True)
        _write_images(prepared, work, found.model, console)
        finished.finish("capture", keys["capture"])
    known = {each.name for each in collection.excluded}
    left_out = [
        ExcludedImage(photo.name, photo.excluded_reason)
        for photo in before.photographs
        if photo.excluded_reason is not None and photo.name not in known
    ]
    held = before.focal_fixed, focal_reason(before.focal_reason)
    seconds = time.monotonic() - began
    outcome = ReconstructionResult(
        camera_groups=kinds,
        found=found,
        excluded=left_out,
        components=before.components,
        pairs=before.pairs,
        focal_fixed=held,
        seconds=seconds,
    )
    return _finish(prepared, outcome, keys["placed"])


def _steps(
    plan: ReconstructionPlan, workspace: Workspace, keys: dict[str, str], console: Console, run: RunFolder | None
) -> ReconstructionReport:
    began = time.monotonic()
    photographs = plan.image_list.images
    kinds = feature_extraction.group_by_camera(photographs)
    lost = _features(plan, workspace, kinds, keys["features"], console)
    usable = [photo for photo in photographs if photo.name not in {each.name for each in lost}]
    apply_rigs(workspace, photographs)
    pairs = _matches(plan, workspace, keys["matches"], console)
    models, held = map_photographs(plan, workspace, kinds, keys["model"], len(usable), console)
    left_out = exclusion_reasons(
        models[0],
        models[1:],
        [photo.name for photo in photographs],
        feature_matching.count_verified_matches(workspace),
        lost,
    )
    check_enough_placed(models[0], left_out, workspace)
    mapped = pycolmap.Reconstruction(models[0])
    found = georeference(models[0], plan, held)
    discard_training(plan.request.output, run)
    _write(plan, workspace, mapped, found.model, keys["capture"], console)
    outcome = ReconstructionResult(
        camera_groups=kinds,
        found=found,
        excluded=left_out,
        components=[len(capture_writer.placed_images(model)) for model in models],
        pairs=pairs,
        focal_fixed=held,
        seconds=time.monotonic() - began,
    )
    return _finish(plan, outcome, keys["placed"])


def _finish(prepared: ReconstructionPlan, outcome: ReconstructionResult, key: str) -> ReconstructionReport:
    """Write what depends on where the scene lies; the facts come last."""
    request, output, model = prepared.request, prepared.request.output, outcome.found.model
    facts = make_reconstruction_report(prepared, outcome)
    Workspace(output).begin("placed", key)
    shutil.rmtree(output / "sparse", ignore_errors=True)
    (output / "georef.json").unlink(missing_ok=True)
    marks = dict(zip((each.name for each in outcome.found.survey), _gcp_positions(prepared), strict=False))
    plot_residuals(model_points(model), prepared.gps_priors, outcome.metric, marks, output / RECONSTRUCTION_FIGURE)
    if outcome.metric is not None:
        write_json(output / "georef.json", _georef(facts, outcome.found.origin))
    size = request.options.max_output_size
    pinholes = {number: capture_writer.straight_camera(lens, size) for number, lens in _lenses(model).items()}
    capture_writer.write_model(output, model, pinholes)
    write_json(
        output / RECONSTRUCTION_FILE,
        to_jsonable(record_to_dict(facts)) | {"options": to_jsonable(to_dict(request.options))},
    )
    Workspace(output).finish("placed", key)
    return facts


def _features(
    plan: ReconstructionPlan,
    workspace: Workspace,
    camera_groups: Sequence[feature_extraction.CameraGroup],
    key: str,
    console: Console,
) -> list[ExcludedImage]:
    options, photographs = plan.request.options, plan.image_list.images
    feature_extraction.create_database(workspace, camera_groups)
    failed = feature_extraction.prepare_images(workspace, photographs, plan.threads, console)
    counts = feature_extraction.count_features(workspace)
    if not workspace.is_done("features", key):
        mask_files.write_upright_masks(workspace, photographs, plan.threads)
        counts = feature_extraction.extract_features(workspace, camera_groups, options, plan.threads, console)
        workspace.finish("features", key)
    return feature_extraction.images_without_features(photographs, counts, failed)


def _matches(plan: ReconstructionPlan, workspace: Workspace, key: str, console: Console) -> int:
    """Match what may show the same; the number of pairs."""
    if workspace.is_done("matches", key):  # to choose them again may last: by looks it takes all descriptors
        return feature_matching.count_pairs(workspace)
    photographs = plan.image_list.images
    chosen = feature_matching.select_pairs(workspace, photographs, plan.gps_priors, plan.request.options)
    there = feature_extraction.count_features(workspace)
    chosen = [pair for pair in chosen if all(there.get(name) for name in pair)]
    if not workspace.is_begun("matches", key):
        feature_matching.delete_matches(workspace)
        workspace.begin("matches", key)
    feature_matching.match_pairs(workspace, chosen, plan.threads, console)
    workspace.finish("matches", key)
    return feature_matching.count_pairs(workspace)


def _gcp_positions(plan: ReconstructionPlan) -> np.ndarray:
    """Surveyed points [n, 3], none where nothing was placed."""
    return plan.gcps.enu(plan.origin) if plan.gcps else np.zeros((0, 3))


def _lenses(model: pycolmap.Reconstruction) -> dict[int, Intrinsics]:
    """The lenses of the cameras whose photographs are placed, by the numbers of the cameras."""
    used = sorted({image.camera_id for image in capture_writer.placed_images(model)})
    return {number: capture_writer.fitted_intrinsics(model.cameras[number]) for number in used}


def _lens_moved(output: Path, model: pycolmap.Reconstruction) -> bool:
    """Whether photographs that are written lost their distortion by other lenses than those of the model."""
    return capture_writer.lens_shift_px(capture_writer.read_lenses(output), _lenses(model)) > LENS_PX


def _write(
    plan: ReconstructionPlan,
    workspace: Workspace,
    mapped: pycolmap.Reconstruction,
    model: pycolmap.Reconstruction,
    key: str,
    console: Console,
) -> None:
    """Photographs without distortion, by the lenses of the placed model, and the model as it was mapped."""
    output = plan.request.output
    if not Workspace(output).is_begun("capture", key):
        Workspace(output).forget("capture", "placed")  # before: an interrupted removal is no finished capture
        for name in (*capture_writer.IMAGE_FOLDERS, "sparse", MAPPED):
            shutil.rmtree(output / name, ignore_errors=True)
        for name in (RECONSTRUCTION_FILE, "georef.json", RECONSTRUCTION_FIGURE):
            (output / name).unlink(missing_ok=True)
        Workspace(output).begin("capture", key)
    shutil.rmtree(output / "sparse", ignore_errors=True)
    _write_images(plan, workspace, model, console)
    write_model_files(mapped, output / MAPPED)
    Workspace(output).finish("capture", key)


def _write_images(
    prepared: ReconstructionPlan, work: Workspace, model: pycolmap.Reconstruction, console: Console
) -> None:
    """Photographs without distortion by the lenses of a model. Those that are there are kept, unless they were made by
    other lenses."""
    output, max_size = prepared.request.output, prepared.request.options.max_output_size
    if _lens_moved(output, model):
        for name in capture_writer.IMAGE_FOLDERS:
            shutil.rmtree(output / name, ignore_errors=True)
        capture_writer.write_lenses(output, _lenses(model))
    names: dict[int, list[str]] = {}
    for image in sorted(capture_writer.placed_images(model), key=lambda image: image.name):
        names.setdefault(image.camera_id, []).append(image.name)
    total = sum(map(len, names.values()))
    with report_progress(work, console, "writing", total, "without distortion, ") as tell:
        capture_writer.write_images(output, work, names, _lenses(model), max_size, prepared.threads, tell)


def _georef(report: ReconstructionReport, origin: tuple[float, float, float] | None) -> dict[str, Any]:
    place = {} if origin is None else dict(zip(ORIGIN_KEYS, origin, strict=True))
    return {
        "frame": ENU_FRAME if origin is not None else LOCAL_FRAME,
        **place,
        "alt_reference": report.altitude_reference,
        "method": f"poses from the photographs alone, then a similarity: {report.georeferenced}",
        "accuracy": report.accuracy and report.accuracy.summary,
        "accuracy_95": report.accuracy and record_to_dict(report.accuracy),
        "gps_outliers_left_out": report.positions_rejected,
        "gps_residual_rms_m_xyz": list(report.residual_rms_m or ()),
        "z0": "median height of the 3D points",
    }  # fmt: skip
