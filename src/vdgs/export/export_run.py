"""`vdgs export`: a run's scene baked once, and written into as many files as were asked for."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from rich.console import Console
from rich.markup import escape
from torch import Tensor

from vdgs.captures.first_view import default_view
from vdgs.captures.output_guard import check_no_link, check_not_among_inputs, check_output
from vdgs.captures.reconstruction import place_name
from vdgs.config.commands import ExportRequest
from vdgs.distributed.sharded_job import ExecutionOptions
from vdgs.errors import VdgsError
from vdgs.export.background_image import check_background, write_background
from vdgs.export.bake import gaussian_count
from vdgs.export.bake_plan import drop_unused_sh_degrees
from vdgs.export.color_refinement import BakedGaussians
from vdgs.export.distributed_bake import DistributedBake, distributed_bake, forget_shards
from vdgs.export.export_loss import ExportLoss, measure_loss, views_to_measure
from vdgs.export.export_record import note_export
from vdgs.export.file_coordinates import FileCoordinates, axes_of_file, coordinates_of_file
from vdgs.export.formats import registry
from vdgs.export.formats.export_scene import CHUNK_SIZE, ExportScene, InitialView
from vdgs.export.formats.gaussian_store import GaussianStore
from vdgs.export.gaussian_optimization import optimize_gaussians
from vdgs.export.gaussian_selection import (
    asked_gaussians,
    check_files,
    frame_for_file,
    local_bounds,
    rows_within_reach,
    select_gaussians,
    select_rows,
    with_faded_edge,
)
from vdgs.export.local_bake import BAKING, LocalBake
from vdgs.export.local_frame import LocalFrame
from vdgs.export.merged_scene import SceneMerging
from vdgs.export.novel_cameras import color_iteration_count, endless_cameras
from vdgs.export.programs import axes_for, with_files
from vdgs.export.sh_degree_choice import FixedColors, choose_fixed_colors
from vdgs.geometry.camera import Camera
from vdgs.model.decode_world import gaussian_means
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_folder import REPORT_FILE
from vdgs.system.atomic_files import read_json_or_empty, to_jsonable
from vdgs.system.console import make_progress_bar, print_warning
from vdgs.system.documents import ExportDocument, ExportedFile, JsonObject, RecordedFile
from vdgs.system.scratch import check_takes_files, remove_leftovers
from vdgs.system.stop_signals import check_stop_requested
from vdgs.visibility.visibility_counts import count_visibility


@dataclass(frozen=True, eq=False)
class _BakedScene:
    """The Gaussians of a scene on the disk, in the ground frame."""

    spool: GaussianStore
    degree: int
    #: How pages show it first, in the ground frame.
    page: InitialView
    request: ExportRequest

    def scene(self, frame: LocalFrame, rows: Int[np.ndarray, " r"], path: Path) -> ExportScene:
        """What a writer is given for a file: the Gaussians of these rows."""
        to_local = frame.points_to_local if registry.format_from_path(path).only_points else frame.to_local
        chunks = (to_local(piece) for piece in self.pieces(rows))
        bounds, page = local_bounds(frame, self.spool.means[rows]), _view_in_frame(self.page, frame)
        return ExportScene(
            chunks=chunks,
            count=len(rows),
            degree=self.degree,
            metadata=frame.facts,
            bounds=bounds,
            page=page,
            axes=axes_of_file(path, frame, self.request),
            spz_version=self.request.spz_version,
        )

    def pieces(self, rows: Int[np.ndarray, " r"]) -> Iterator[Gaussians]:
        """These Gaussians, some thousand at a time."""
        for first in range(0, len(rows), CHUNK_SIZE):
            check_stop_requested()
            yield self.spool.rows(rows[first : first + CHUNK_SIZE])
            self.spool.release_pages()


@dataclass(frozen=True, eq=False)
class _WrittenFile:
    """What is to be said of a file, and the Gaussians that its writer was given: rows of a scene."""

    facts: ExportedFile
    scene: _BakedScene
    rows: Int[np.ndarray, " r"]


def make_initial_view(run: OpenedRun, most_bytes: int) -> InitialView:
    """The first view (`default_view`), before the color that the model has behind it; ground frame."""
    position, target = default_view(run.capture)
    red, green, blue = (float(each) for each in run.model.background)
    recorded = read_json_or_empty(run.folder.place_file).get("name")  # as the report is headed
    title = str(recorded or place_name(run.capture.root) or "scene")
    cameras = [view.camera for view in run.capture.train_views]
    return InitialView(
        _point(position), _point(target), (red, green, blue), title, most_bytes,
        lambda places: count_visibility(places, cameras),
    )  # fmt: skip


def _view_in_frame(page: InitialView, frame: LocalFrame) -> InitialView:
    """A page in local coordinates."""
    ground, count = np.array([page.position, page.target]), page.count_visibility
    position, target = frame.apply(ground)

    def count_local(places: Tensor) -> Tensor:
        assert count is not None
        return count(torch.from_numpy(frame.apply_inverse(places.double().numpy())))

    return replace(
        page, position=_point(position), target=_point(target), count_visibility=count_local if count else None
    )


def _point(place: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in place)
    return x, y, z


def resolve_request(request: ExportRequest) -> ExportRequest:
    """The request with its files named, checked before the run is opened, and the degree that they need.

    Raises VdgsError for file names of no format, and for outputs that are the run's report or that vdgs did not write.
    """
    request = with_files(request)
    _check_names(request)
    return drop_unused_sh_degrees(request)


def export_run(
    run: OpenedRun, request: ExportRequest, console: Console, execution: ExecutionOptions | None = None
) -> ExportDocument:
    """`write_files`, in this process or in shards where `execution` sends them, noted in RUN/export.json."""
    if execution is None or not execution.is_distributed:
        forget_shards(run)
    record = write_files(run, request, console, execution)
    note_export(record, run.folder.path, console)
    return record


def write_files(
    run: OpenedRun, request: ExportRequest, console: Console, execution: ExecutionOptions | None = None
) -> ExportDocument:
    """Write the files of a resolved request from an opened run, or a scene in memory; returns what was done.

    The scene is baked in this process, or in shards where `execution` sends them: the files are the same. Raises
    VdgsError, before any view is drawn, for outputs among a capture's inputs, a block or box without anything, and a
    system, packages or folders that a file needs and has not; before any Gaussian is baked, for a choice of which no
    view shows anything, and coordinates that a format does not have; and what `ShardedJob.send` raises.
    """
    print_warning(console, run.warning)
    for path in _all_outputs(request):
        check_not_among_inputs(path, run.capture)
    if request.background is not None:
        check_background(run, request.background)
    center = np.median(run.model.anchors.positions.cpu().double().numpy(), axis=0)
    frames = {path: frame_for_file(path, run, request, center) for path in request.output}
    for path in _all_outputs(request):
        check_takes_files(path.parent)
    _print_systems({path: coordinates_of_file(path, frame, request) for path, frame in frames.items()}, console)
    _tidy(request.output, console)
    began = time.monotonic()
    page = make_initial_view(run, int(request.html_max_mb * 1e6))
    check_files(frames, request, page)
    asked = asked_gaussians(run, request)
    whole, run = run, with_faded_edge(run, request)
    with _make_baker(run, request, execution, console) as baker, ExitStack() as stack:
        pixels = baker.pixels()
        kept = select_gaussians(pixels, asked, run)
        del asked
        means = gaussian_means(run.model.anchors).cpu().reshape(-1, 3).numpy()[kept]
        rows = select_rows(frames, means, pixels[kept], request, page, console)
        console.print(
            f"{run.summary}: {len(kept):,} Gaussians of {len(pixels):,} are drawn by the training cameras"
            + (" and asked for" if len(kept) < np.count_nonzero(pixels) else ""),
            highlight=False,
        )
        pixels = pixels[kept]
        del means
        shown = BakedGaussians(run.model, kept, stack.enter_context(baker.spool(kept)))
        rounds = color_iteration_count(request.color_iterations, gaussian_count(run.model))
        console.print(
            f"baked in {time.monotonic() - began:.1f} s, colors fitted again in {rounds} rounds", highlight=False
        )
        merging = SceneMerging(shown, pixels, request.output[0].parent / BAKING, baker.training, console, stack)
        if 0 < request.max_gaussians < len(kept):
            shown = merging.merged(request.max_gaussians)
            rows = {path: rows_within_reach(path, frame, shown.spool.means) for path, frame in frames.items()}
        _optimize(shown, baker.training, request.optimize_seconds, console)
        seconds = time.monotonic() - began
        scene = _BakedScene(shown.spool, request.baked_sh_degree, page, request)
        fixed = FixedColors(baker.training, request.output[0].parent / BAKING, stack)
        written = {
            path: _write_fitting(path, frames[path], scene, rows[path], merging, fixed, whole)
            for path in request.output
        }
        losses = _measure_losses(whole, frames, written, console) if request.evaluate else []
    if request.background is not None:
        write_background(run, request.background)
    record: ExportDocument = to_jsonable({
        "gaussians": len(scene.spool.means), "sh_degree": request.baked_sh_degree,
        "rounds": rounds, "seconds_to_bake": seconds, "seconds_to_refine": request.optimize_seconds,
        "files": [_recorded(each, whole, request) for each in written.values()], "losses": losses,
    })  # fmt: skip
    return record


def _recorded(written: _WrittenFile, run: OpenedRun, request: ExportRequest) -> RecordedFile:
    """A file for the record: also which model it is of, and which part of it."""
    return {**written.facts, "sh_degree": written.scene.degree, "model": run.name, "model_id": run.status.model_id,
            "block": request.block, "bbox": request.bbox, "min_visibility": request.min_visibility}  # fmt: skip


def _print_systems(systems: Mapping[Path, FileCoordinates], console: Console) -> None:
    """Say before the work in which coordinates the files stand, and what is to be known of each system: a choice of
    `--crs` that was wrong should not be paid for."""
    files = dict[FileCoordinates, list[str]]()
    for path, system in systems.items():
        files.setdefault(system, []).append(path.name)
    for system, names in files.items():
        console.print(f"{', '.join(names)}: {system.text}", markup=False, highlight=False)
    for note in dict.fromkeys(note for system in files for note in system.notes):
        console.print(f"[yellow]note[/] {escape(note)}", highlight=False)


def _write_fitting(
    path: Path, frame: LocalFrame, scene: _BakedScene, rows: Int[np.ndarray, " r"], merging: SceneMerging,
    fixed: FixedColors, run: OpenedRun,
) -> _WrittenFile:  # fmt: skip
    """Write a file, of as many Gaussians as it has room for, in colors that it holds well."""
    notes, count = list[str](), _capacity(path, scene)
    if count < len(rows):
        notes.append(f"merged from {len(rows):,} Gaussians to {count:,}, which the file has room for")
        scene, rows = replace(scene, spool=merging.merged(count).spool), np.arange(count)
    if not registry.format_from_path(path).only_points and (note := frame.departure_note(scene.spool.means[rows])):
        notes.append(note)
    scene, note = _with_fitting_colors(path, frame, scene, rows, fixed, run)
    notes += [note] if note else []
    system = coordinates_of_file(path, frame, scene.request)
    return _WrittenFile(_write(path, system, scene.scene(frame, rows, path), merging.console, notes), scene, rows)


def _with_fitting_colors(
    path: Path, frame: LocalFrame, scene: _BakedScene, rows: Int[np.ndarray, " r"], fixed: FixedColors, run: OpenedRun
) -> tuple[_BakedScene, str]:
    """The scene with fixed colors for a file that holds no others or, where nobody asked for a degree, is no better for
    them; and what is to be said of it."""
    chosen = registry.format_from_path(path)
    if not scene.degree:
        return scene, ""
    if not chosen.holds_changing_colors:
        plain = replace(scene, spool=fixed.of(scene.spool), degree=0)
        return plain, "colors are the mean of those from the directions of the training cameras"
    if scene.request.sh_degree is not None or not (chosen.rounds_harmonics and scene.request.evaluate):
        return scene, ""
    plain = replace(scene, spool=fixed.of(scene.spool), degree=0)
    is_fixed, note = choose_fixed_colors(
        run, path, frame, lambda: scene.scene(frame, rows, path), lambda: scene.pieces(rows), lambda: plain.pieces(rows)
    )
    return plain if is_fixed else scene, note


def _capacity(path: Path, scene: _BakedScene) -> int:
    """How many Gaussians of a scene a file has room for."""
    capacity = registry.format_from_path(path).capacity
    return sys.maxsize if capacity is None else capacity(scene.spool.sample(CHUNK_SIZE), scene.page)


def _make_baker(
    run: OpenedRun, request: ExportRequest, execution: ExecutionOptions | None, console: Console
) -> AbstractContextManager[LocalBake | DistributedBake]:
    """What bakes the scene: this process, or shards."""
    if execution is not None and execution.is_distributed:
        return distributed_bake(run, request, execution, console)
    return nullcontext(LocalBake(run, request, console))


def _optimize(baked: BakedGaussians, training: Sequence[Camera], seconds: float, console: Console) -> None:
    """Move all that is baked for so many seconds, by this process' clock."""
    if seconds <= 0:
        return
    with make_progress_bar(console) as bar:
        task = bar.add_task("refining", total=seconds)

        def after_step(passed: float) -> None:
            check_stop_requested()
            bar.update(task, completed=passed)

        optimize_gaussians(baked, endless_cameras(training), seconds, after_step)


def _tidy(paths: tuple[Path, ...], console: Console) -> None:
    """Remove what killed exports left beside the files that are written now."""
    found = remove_leftovers(paths[0].parent / BAKING)
    for path in paths:
        found += registry.format_from_path(path).tidy(path)
    if found:
        console.print(
            f"[yellow]note[/] removed what a killed export had left: {', '.join(map(str, found))}", highlight=False
        )


def _check_names(asked: ExportRequest) -> None:
    run, paths = asked.run, asked.output
    if not paths:
        raise VdgsError("Nothing to write: give --output FILE, such as --output scene.ply, or --for PROGRAM.")
    for path in _all_outputs(asked):
        check_output(path)
        check_no_link(path)
    if asked.background is not None:
        registry.check_ours(asked.background)
    for path in paths:
        axes_for(path, asked)
        registry.check_not_foreign(path)
        if path.name.lower() == REPORT_FILE and os.path.realpath(path.parent) == os.path.realpath(run):
            raise VdgsError(
                f"--output {path}: is the report of the run, which would be overwritten, and written again over the "
                "page. Choose another name, such as scene.html."
            )
    _check_written_once(paths)


def _all_outputs(asked: ExportRequest) -> list[Path]:
    return [*asked.output, *([] if asked.background is None else [asked.background])]


def _check_written_once(paths: Sequence[Path]) -> None:
    """Raise VdgsError where one file, by whichever name, is written for two outputs."""
    writers = dict[str, int]()
    for number, path in enumerate(paths):
        for file in registry.format_from_path(path).names(path):
            other = paths[first := writers.setdefault(os.path.realpath(file), number)]
            if first == number:
                continue
            if file.name == path.name == other.name:
                raise VdgsError(f"--output {path}: is given twice.")
            raise VdgsError(f"--output {path} and --output {other}: both write {file}. Choose another folder for one.")


def _write(
    path: Path, system: FileCoordinates, scene: ExportScene, console: Console, notes: Sequence[str]
) -> ExportedFile:
    began = time.monotonic()
    lost = [*notes, *registry.write_scene(path, scene)]
    seconds, size = time.monotonic() - began, _size(path)
    console.print(f"{path}: {size / 1e6:,.1f} MB in {seconds:.1f} s", highlight=False)
    for each in lost:
        console.print(f"[yellow]note[/] {path.name}: {each}", highlight=False)
    return {"file": str(path.resolve()), "gaussians": scene.count, "bytes": size, "seconds": seconds,
            "crs_name": system.name, "axes": system.axes, "heights": system.heights,
            "notes": [*system.notes, *lost]}  # fmt: skip


def _size(path: Path) -> int:
    """Bytes of a file, with those that it names."""
    return sum(file.stat().st_size for file in registry.format_from_path(path).files(path))


def _measure_losses(
    run: OpenedRun, frames: Mapping[Path, LocalFrame], written: Mapping[Path, _WrittenFile], console: Console
) -> list[JsonObject]:
    """What each file that can be read back loses, or, where none can, the Gaussians that writers were given; which
    files are not read back is said."""
    readable = [path for path in written if registry.format_from_path(path).read]
    others = [path for path in written if path not in readable]
    alike = [] if readable else _of_same_gaussians(written)
    losses = []
    with make_progress_bar(console) as bar:
        count = (len(readable) + len(alike)) * len(views_to_measure(run))
        task = bar.add_task("comparing with the model", total=count)

        def after_view() -> None:
            check_stop_requested()
            bar.advance(task)

        for path in readable:
            pieces = map(frames[path].to_ground, registry.read_chunks(path))
            losses.append(_measured(f"{path.name}, read back", path, measure_loss(run, pieces, after_view), console))
        for paths in alike:
            first = written[paths[0]]
            what = f"{_names(paths)}: not read back; the Gaussians before they were written to it"
            loss = measure_loss(run, first.scene.pieces(first.rows), after_view)
            losses.append(_measured(what, None, loss, console))
    if readable and others:
        console.print(f"{_names(others)}: not read back, so not compared", markup=False, highlight=False)
    return losses


def _of_same_gaussians(written: Mapping[Path, _WrittenFile]) -> list[list[Path]]:
    """The files by the Gaussians that their writers were given."""
    groups = list[list[Path]]()
    for path, file in written.items():
        for group in groups:
            first = written[group[0]]
            if first.scene.spool is file.scene.spool and np.array_equal(first.rows, file.rows):
                group.append(path)
                break
        else:
            groups.append([path])
    return groups


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(path.name for path in paths)


def _measured(what: str, path: Path | None, loss: ExportLoss, console: Console) -> JsonObject:
    """Print a loss; returns it for the record."""
    console.print(
        f"{what}, on {loss.views} {loss.of} views: PSNR {loss.psnr:.2f} → {loss.psnr_baked:.2f} dB "
        f"({loss.psnr_baked - loss.psnr:+.2f}; with the exposure of each photograph corrected "
        f"{loss.psnr_cc:.2f} → {loss.psnr_cc_baked:.2f}, {loss.psnr_cc_baked - loss.psnr_cc:+.2f}), "
        f"SSIM {loss.ssim:.3f} → {loss.ssim_baked:.3f}",
        markup=False,
        highlight=False,
    )
    return {"file": None if path is None else str(path.resolve()), **asdict(loss)}
