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
    FIGURE,
    FILE,
    WORK,
    ReconstructionFacts,
    SurveyFacts,
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
from vdgs.sfm.console_report import tell_facts
from vdgs.sfm.image_list import LeftOut
from vdgs.sfm.position_plots import draw_positions, draw_residuals
from vdgs.sfm.reconstruction_plan import Prepared, check_disk, in_time, prepare, tell
from vdgs.sfm.reconstruction_report import Outcome, facts_of, why_left_out
from vdgs.sfm.workspace import Work, key_of, quiet_colmap
from vdgs.system.atomic_files import jsonable, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.file_locks import hold
from vdgs.system.records import plain

#: Where the positions are shown before the work, inside the output.
MAP = "photographs.png"


def reconstruct(
    request: SfmRequest, console: Console, alone: AbstractContextManager[None] | None = None
) -> ReconstructionFacts:
    """Make a capture of photographs in `request.output`, or go on with one that was begun.

    `alone` is held while anything is written; not where all is done already. Raises what it raises, CaptureError for
    photographs that cannot become one, VdgsError for an output that is something else and a disk that is full. What was
    done is kept.
    """
    quiet_colmap()
    prepared = prepare(request)
    output = request.output
    work, keys = Work(output / WORK), _keys(prepared)
    facts = read_reconstruction(output) if _is_finished(output, keys["capture"]) else None
    if facts is not None:
        console.print(f"{output}: made of these photographs already; nothing to do", highlight=False)
        return facts
    _refuse_other_things(output)
    tell(prepared, console)
    check_disk(prepared)
    with alone or nullcontext(), hold(output):
        work.path.mkdir(exist_ok=True)
        draw_positions(prepared.positions, in_time(prepared), "Where the photographs were taken", output / MAP)
        facts = _steps(prepared, work, keys, console)
        if not request.keep_work:
            work.remove()
    tell_facts(facts, console)
    return facts


def _keys(prepared: Prepared) -> dict[str, str]:
    """What each step depends on, each on those before it."""
    options, positions = prepared.request.options, prepared.positions
    files = [
        (photo.name, photo.bytes, photo.path.stat().st_mtime_ns, photo.width, photo.height, photo.orientation)
        for photo in prepared.collection.photographs
    ]
    lenses = [photo.lens and photo.lens.focal for photo in prepared.collection.photographs]
    found = key_of(__version__, files, lenses, options.feature_size, options.features, *_masked(prepared))
    placed = [positions.index.tolist(), positions.enu.tolist(), positions.deviations.tolist()]
    matched = key_of(found, placed, options.neighbours, options.exhaustive)
    mapped = key_of(matched, options.focal)
    points = prepared.control.points if prepared.control else ()
    capture = key_of(mapped, options.max_size, [plain(point) for point in points])
    return {"features": found, "matches": matched, "model": mapped, "capture": capture}


def _masked(prepared: Prepared) -> list[tuple[Any, ...]]:
    """Photographs of which something may be left out, and what says so."""
    masked = [photo for photo in prepared.collection.photographs if photo.may_be_masked]
    files = [photo.mask.stat() if photo.mask is not None else None for photo in masked]
    return [
        (photo.name, photo.may_be_transparent, file and (file.st_size, file.st_mtime_ns))
        for photo, file in zip(masked, files, strict=True)
    ]


def _is_finished(output: Path, key: str) -> bool:
    return (output / FILE).is_file() and Work(output).is_done("capture", key)


def _refuse_other_things(output: Path) -> None:
    """Only a new folder, an empty one, or one of an earlier reconstruction is written to."""
    if output.is_dir() and not is_reconstruction(output) and _strangers(output):
        raise VdgsError(f"{output}: holds other things already. Choose a new folder with --output.")
    if output.exists() and not output.is_dir():
        raise VdgsError(f"{output}: is a file. Choose a new folder with --output.")


def _strangers(output: Path) -> bool:
    """Whether a folder holds anything but what a reconstruction begins with."""
    return any(each.name not in (".lock", MAP) and each.suffix != ".tmp" for each in output.iterdir())


def _steps(prepared: Prepared, work: Work, keys: dict[str, str], console: Console) -> ReconstructionFacts:
    began = time.monotonic()
    request, output = prepared.request, prepared.request.output
    photographs, threads = prepared.collection.photographs, prepared.threads
    kinds = feature_extraction.kinds_of(photographs)
    lost = _features(prepared, work, kinds, keys["features"], console)
    usable = [photo for photo in photographs if photo.name not in {each.name for each in lost}]
    pairs = _matches(prepared, work, keys["matches"], console)
    held = incremental_mapper.holds_focal(photographs, prepared.positions, request.options)
    models = _models(prepared, work, keys["model"], len(usable), held[0], console)
    left_out = why_left_out(
        models[0], models[1:], [photo.name for photo in photographs], feature_matching.verified_counts(work), lost
    )
    placed, origin, surveyed = _place(models[0], prepared, held[0])
    _write(prepared, work, models[0], keys["capture"], threads, console)
    outcome = Outcome(
        kinds=kinds, placed=placed, origin=origin, survey=surveyed, left_out=left_out,
        components=[model.num_reg_images() for model in models], pairs=pairs, held=held,
        seconds=time.monotonic() - began,
    )  # fmt: skip
    facts = facts_of(models[0], prepared, outcome)
    points = georegistration.points_of(models[0])
    marks = dict(zip((each.name for each in surveyed), _places(prepared), strict=False))
    draw_residuals(points, prepared.positions, outcome.on_earth, marks, output / FIGURE)
    if origin is not None:
        write_json(output / "georef.json", _georef(facts, origin))
    capture_writer.write_model(output, models[0], _lenses(models[0], request.options.max_size))
    write_json(output / FILE, jsonable(plain(facts)) | {"options": jsonable(to_dict(request.options))})
    Work(output).finish("capture", keys["capture"])
    return facts


def _features(
    prepared: Prepared, work: Work, kinds: Sequence[feature_extraction.Kind], key: str, console: Console
) -> list[LeftOut]:
    options, photographs = prepared.request.options, prepared.collection.photographs
    if not work.is_begun("features", key):
        work.remove()
        work.begin("features", key)
    feature_extraction.open_database(work, kinds)
    failed = feature_extraction.stand_upright(work, photographs)
    counts = feature_extraction.feature_counts(work)
    if not work.is_done("features", key):
        mask_files.write_upright_masks(work, photographs, prepared.threads)
        counts = feature_extraction.find_features(
            work, kinds, options.feature_size, options.features, prepared.threads, console
        )
        work.finish("features", key)
    named = {each.name for each in failed}
    return failed + [
        each for each in feature_extraction.without_features(photographs, counts) if each.name not in named
    ]


def _matches(prepared: Prepared, work: Work, key: str, console: Console) -> int:
    photographs = prepared.collection.photographs
    chosen = feature_matching.choose_pairs(work, photographs, prepared.positions, prepared.request.options)
    there = feature_extraction.feature_counts(work)
    chosen = [pair for pair in chosen if all(there.get(name) for name in pair)]
    if work.is_done("matches", key):
        return len(chosen)
    if not work.is_begun("matches", key):
        feature_matching.forget_matches(work)
        work.begin("matches", key)
    feature_matching.match(work, chosen, prepared.threads, console)
    work.finish("matches", key)
    return len(chosen)


def _models(
    prepared: Prepared, work: Work, key: str, count: int, hold_focal: bool, console: Console
) -> list[pycolmap.Reconstruction]:
    if work.is_done("model", key):
        return incremental_mapper.read_models(work)
    if not work.is_begun("model", key):
        incremental_mapper.forget_models(work)
        work.begin("model", key)
    incremental_mapper.write_priors(work, prepared.collection.photographs, prepared.positions)
    models = incremental_mapper.find_models(
        work, count, hold_focal, prepared.positions.usable, prepared.threads, console
    )
    work.finish("model", key)
    return models


def _place(
    model: pycolmap.Reconstruction, prepared: Prepared, hold_focal: bool
) -> tuple[
    georegistration.Placed | georegistration.Unplaced, tuple[float, float, float] | None, tuple[SurveyFacts, ...]
]:
    """Bring the model to metres east, north, up, its median point to height 0; the origin that this has on Earth, and
    what it makes of surveyed points."""
    photographs, positions, control = prepared.collection.photographs, prepared.positions, prepared.control
    doubtful = set[str]()
    if control is not None and control.places_the_model:
        how, doubtful = gcp_adjustment.bring_to_control(model, control, prepared.origin, hold_focal, prepared.threads)
        placed: georegistration.Placed | georegistration.Unplaced = georegistration.as_it_lies(
            model, photographs, positions, how
        )
    else:
        placed = georegistration.place(model, photographs, positions)
        if isinstance(placed, georegistration.Placed):
            georegistration.move(model, placed.similarity)
    if isinstance(placed, georegistration.Unplaced):
        return placed, None, ()
    surveyed = gcp_adjustment.survey(model, control, prepared.origin, doubtful) if control is not None else ()
    ground = float(np.median(georegistration.points_of(model)[:, 2]))
    georegistration.move(model, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -ground])))
    latitude, longitude, altitude = prepared.origin
    return placed, (latitude, longitude, altitude + ground), surveyed


def _places(prepared: Prepared) -> np.ndarray:
    """Surveyed points [n, 3], none where nothing was placed."""
    return prepared.control.enu(prepared.origin) if prepared.control else np.zeros((0, 3))


def _lenses(model: pycolmap.Reconstruction, max_size: int) -> dict[int, capture_writer.Straightened]:
    used = sorted({image.camera_id for image in model.images.values() if image.has_pose})
    return {number: capture_writer.straighten(model.cameras[number], max_size) for number in used}


def _write(
    prepared: Prepared, work: Work, model: pycolmap.Reconstruction, key: str, threads: int, console: Console
) -> None:
    output = prepared.request.output
    if not Work(output).is_begun("capture", key):
        for name in (*(folder for folder, _ in capture_writer.SIZES), capture_writer.MASKS, "sparse"):
            shutil.rmtree(output / name, ignore_errors=True)
        for name in (FILE, "georef.json", FIGURE):
            (output / name).unlink(missing_ok=True)
        Work(output).begin("capture", key)
    shutil.rmtree(output / "sparse", ignore_errors=True)
    names: dict[int, list[str]] = {}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            names.setdefault(image.camera_id, []).append(image.name)
    capture_writer.write_images(
        output, work, names, _lenses(model, prepared.request.options.max_size), threads, console
    )


def _georef(facts: ReconstructionFacts, origin: tuple[float, float, float]) -> JsonObject:
    latitude, longitude, altitude = origin
    return {
        "frame": "ENU, metres, x east y north z up",
        "origin_lat_deg": latitude, "origin_lon_deg": longitude, "origin_alt_m": altitude,
        "alt_reference": facts.altitude_reference,
        "method": f"bundle adjustment with positions as priors, then a similarity to the {facts.georeferenced}",
        "gps_outliers_left_out": facts.positions_left_out,
        "gps_residual_rms_m_xyz": list(facts.residual_rms_m or ()),
        "z0": "median height of the 3D points",
    }  # fmt: skip
