"""Which Gaussians of a scene go into which file, and in which coordinates: said before they are baked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console

from vdgs.config.commands import ExportRequest
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import ExportScene, InitialView
from vdgs.export.local_frame import MAX_LOCAL_COORDINATE, LocalFrame, default_crs, make_local_frame
from vdgs.export.programs import axes_for
from vdgs.geometry.ground_frame import UNKNOWN_UNIT
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.decode_world import gaussian_means
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.visibility_store import get_run_visibility, require_some_seen, with_fade

#: A file goes without Gaussians beyond its reach where they make at most this part of what the training cameras see.
MAX_DROPPED_SHARE = 1e-3


def with_faded_edge(run: OpenedRun, request: ExportRequest) -> OpenedRun:
    """The run with its model faded out where few training cameras see it, if that is asked for. Raises VdgsError where
    nothing would be left."""
    if not request.min_visibility:
        return run
    cameras = [view.camera for view in run.capture.train_views]
    visibility = get_run_visibility(run, cameras)
    require_some_seen(visibility, request.min_visibility)
    return replace(run, model=with_fade(run.model, cameras, request.min_visibility))


def check_files(frames: Mapping[Path, LocalFrame], request: ExportRequest, page: InitialView) -> None:
    """Raise VdgsError for what no file of a format can hold, or be, whichever Gaussians it is given."""
    for path, frame in frames.items():
        registry.check_export(path, _unwritten(frame, 1, request, page))


def asked_gaussians(run: OpenedRun, request: ExportRequest) -> Bool[np.ndarray, " g"]:
    """Whether each Gaussian of the model is of the block and within the box that are asked for. Raises VdgsError where
    there is no such block, or nothing of the model in the box."""
    k = run.model.anchors.offsets.shape[1]
    asked = np.ones(len(run.model.anchors.positions) * k, bool)
    if request.block is not None:
        asked = np.repeat(_anchors_of_block(run, request.block), k)
    if request.bbox is not None:
        asked &= _is_in_box(run, request, request.bbox, asked)
    return asked


def _is_in_box(
    run: OpenedRun, request: ExportRequest, bbox: tuple[float, float, float, float], among: Bool[np.ndarray, " g"]
) -> Bool[np.ndarray, " g"]:
    """Whether each Gaussian is in a box. Raises VdgsError where the box has no inside, or holds none of some."""
    x0, y0, x1, y1 = bbox
    box = f"--bbox {x0:.12g} {y0:.12g} {x1:.12g} {y1:.12g}"
    if not (x0 < x1 and y0 < y1):
        raise VdgsError(f"{box}: is empty. Give X0 Y0 X1 Y1, the lower corner first.")
    placement = MapProjection.of(run.capture.ground, request.crs or default_crs(run.capture.ground, request.output[0]))
    means = gaussian_means(run.model.anchors).cpu().double().reshape(-1, 3).numpy()
    places = placement.project(means)[:, :2]
    inside = np.asarray(((places >= (x0, y0)) & (places <= (x1, y1))).all(1))
    if among.any() and not (inside & among).any():
        low, high = places[among].min(0), places[among].max(0)
        what = "the scene" if request.block is None else f"block {request.block}"
        raise VdgsError(
            f"{box}: holds nothing of {what}, which lies within "
            f"{low[0]:.1f} {low[1]:.1f} {high[0]:.1f} {high[1]:.1f} of --crs {placement.crs}."
        )
    return inside


def select_gaussians(
    pixels: Float[np.ndarray, " g"], asked: Bool[np.ndarray, " g"], run: OpenedRun
) -> Int[np.ndarray, " m"]:
    """The Gaussians to write, ascending: asked for, and drawn by a training camera. `pixels`: how many each makes.
    Raises VdgsError where none is left."""
    kept = np.flatnonzero(asked & (pixels > 0))
    if not len(kept):
        raise VdgsError(f"{run.model_path}: no training camera draws anything of what was asked for.")
    return kept


def _anchors_of_block(run: OpenedRun, block: int) -> np.ndarray:
    """Which anchors of a merged model a block has made."""
    counts = [part.count for part in run.model.decoder_spans]
    if run.name != "merged" or not 0 <= block < len(counts):
        have = f"has blocks 0 to {len(counts) - 1}" if counts else "is not made of blocks with decoders of their own"
        raise VdgsError(f"--block {block}: the {run.name} model {have}.")
    return np.repeat(np.arange(len(counts)) == block, counts)


def frame_for_file(path: Path, run: OpenedRun, request: ExportRequest, center: np.ndarray) -> LocalFrame:
    """The coordinates of a file: those that do not reach far have their origin nearby.

    3D Tiles stand on the globe wherever it is known how, whatever --crs says of other files: no map lies between.
    Raises VdgsError for a scene in Earth-centered coordinates, which would lie on its side: points alone are measured.
    """
    ground, kind = run.capture.ground, registry.format_from_path(path)
    far = min(MAX_LOCAL_COORDINATE, kind.max_coordinate / 2)
    frame = make_local_frame(
        ground, request.crs or default_crs(ground, path), center, far
    )  # which refuses what is no system
    if kind.on_globe and ground.origin_geo is not None:
        return make_local_frame(ground, "enu", center, far)
    if frame.is_geocentric and not (kind.only_points and axes_for(path, request) is None):
        raise VdgsError(
            f"--crs {request.crs}: the third axis of {frame.name} does not point up here, and {path.name} needs one "
            "that does. Leave --crs out, give a projected system, or write .las, .laz or .points.ply (without --axes "
            "and --for); tileset.json stands on the globe by itself."
        )
    return frame


def select_rows(
    frames: Mapping[Path, LocalFrame], means: Float[np.ndarray, "m 3"], pixels: Float[np.ndarray, " m"],
    request: ExportRequest, page: InitialView, console: Console,
) -> dict[Path, Int[np.ndarray, " r"]]:  # fmt: skip
    """Which of the Gaussians each file is given. What a format cannot hold is said before the work.

    A format that does not reach far goes without the few Gaussians that lie beyond and of which the photographs show
    next to nothing; more of them are refused.
    """
    rows = {}
    for path, frame in frames.items():
        far, reach, why = _distances(path, frame, means)
        beyond = far >= reach
        share = float(pixels[beyond].sum() / pixels.sum())
        if share > MAX_DROPPED_SHARE:
            beyond[:] = False  # it is refused below
        elif beyond.any():
            console.print(
                f"[yellow]note[/] {path.name}: {np.count_nonzero(beyond):,} of {len(means):,} Gaussians lie more than "
                f"{reach:.4g} units away, {why}; they are left out. They make {share:.2g} of what the training "
                "cameras see.",
                highlight=False,
            )
        rows[path] = np.flatnonzero(~beyond)
        count = min(len(rows[path]), request.max_gaussians or len(rows[path]))
        scene = _unwritten(frame, count, request, page)
        registry.check_export(path, replace(scene, bounds=local_bounds(frame, means[rows[path]])))
    return rows


def _unwritten(frame: LocalFrame, count: int, request: ExportRequest, page: InitialView) -> ExportScene:
    """What is known of the scene of a file before anything is baked."""
    return ExportScene(
        chunks=(), count=count, degree=request.baked_sh_degree, metadata=frame.facts, page=page,
        spz_version=request.spz_version,
    )  # fmt: skip


def rows_within_reach(path: Path, frame: LocalFrame, means: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, " r"]:
    """Those that the format of a file can hold."""
    far, reach, _ = _distances(path, frame, means)
    return np.flatnonzero(far < reach)


def _distances(
    path: Path, frame: LocalFrame, means: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, " m"], float, str]:
    """The largest local coordinate of each, how far a file of this format reaches, and why no farther."""
    kind, far = registry.format_from_path(path), np.abs(_local(frame, means)).max(1)
    if kind.reach_in_extents is not None and frame.facts.unit == UNKNOWN_UNIT:
        why = (
            f"more than {kind.reach_in_extents:.0f} times as far as 99 of 100 Gaussians: with them, coordinates of all "
            "would be coarser"
        )
        return far, kind.reach_in_extents * float(np.quantile(far, 0.99)), why
    return far, 0.999 * kind.max_coordinate, "where the format does not reach"


def _local(frame: LocalFrame, means: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    local: np.ndarray = frame.apply(means.astype(np.float64))
    return local


def local_bounds(
    frame: LocalFrame, means: Float[np.ndarray, "m 3"]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Lowest and highest local coordinates."""
    local = _local(frame, means)
    (x0, y0, z0), (x1, y1, z1) = local.min(axis=0).tolist(), local.max(axis=0).tolist()
    return (x0, y0, z0), (x1, y1, z1)
