"""Before the work: photographs collected and looked at, options checked, a plan told. Nothing is written."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from vdgs.captures.foreign_poses import foreign_kind
from vdgs.captures.output_guard import check_output
from vdgs.captures.reconstruction import (
    DIGESTS_FILE,
    FILMS_FILE,
    FRAMES_FOLDER,
    SOURCE_IMAGES_FILE,
    WORK_FOLDER,
    is_reconstruction,
)
from vdgs.captures.tables_beside import ODM_POSITIONS, control_point_notes, position_tables, table_note, track_notes
from vdgs.config.ranges import check_ranges
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import VdgsError
from vdgs.kernels import default_num_threads
from vdgs.sfm import feature_matching, fisheyes, flights, focal_decision
from vdgs.sfm.console_report import print_preflight
from vdgs.sfm.gcp_list import GcpList, check_gcps_near, read_gcp_list
from vdgs.sfm.gps_priors import MIN_POSITIONS, GpsPriors, read_gps_priors
from vdgs.sfm.image_list import ImageList, collect_images
from vdgs.sfm.panoramas import with_views
from vdgs.sfm.preflight import PreflightReport, make_preflight_report
from vdgs.sfm.scale_bars import ScaleBars, read_scale_bars
from vdgs.system.scratch import nearest_existing
from vdgs.system.units import data_size

#: Bytes of disk for a feature, with its descriptor and its matches; and for a pixel of a written photograph.
BYTES_PER_FEATURE, BYTES_PER_PIXEL = 250, 0.9
#: Where the positions are shown before the work, inside the output.
POSITIONS_FIGURE = "photographs.png"


@dataclass(frozen=True, kw_only=True)
class ReconstructionPlan:
    """What is known before the work."""

    request: SfmRequest
    image_list: ImageList
    gps_priors: GpsPriors
    preflight: PreflightReport
    threads: int
    pairs: int
    """About how many pairs will be matched."""
    gcps: GcpList | None = None
    scale_bars: ScaleBars | None = None

    @property
    def origin(self) -> tuple[float, float, float]:
        """Of all metres east, north, up: latitude and longitude in degrees, altitude in metres."""
        return self.gcps.median_origin if self.gcps and not self.gps_priors.usable else self.gps_priors.origin


def plan_reconstruction(request: SfmRequest) -> ReconstructionPlan:
    """The look before the work; nothing is written. Raises CaptureError for photographs that cannot become one,
    VdgsError for an output that is something else."""
    check_ranges(request)
    collection = collect_images(request.image_folders, request.options.camera_model, request.options.brackets)
    check_output_outside_images(request.output, collection)
    check_output_folder(request.output)
    request, beside = _with_tables_beside(request, collection)
    _check_marks(request.options, collection)
    positions = read_gps_priors(collection.images, request.gps, request.options.gps_std_m)
    control = _read_gcps(request.options, collection, positions)
    bars = read_scale_bars(request.options.scale_bar, collection) if request.options.scale_bar is not None else None
    look = make_preflight_report(collection, positions)
    look = replace(look, warnings=[*look.warnings, *beside, *(control.notes if control else ())])
    collection, positions = with_views(collection, positions)
    threads = request.threads or default_num_threads()
    pairs = feature_matching.estimate_pair_count(collection.images, positions, request.options)
    return ReconstructionPlan(
        request=request,
        image_list=collection,
        gps_priors=positions,
        preflight=look,
        threads=threads,
        pairs=pairs,
        gcps=control,
        scale_bars=bars,
    )


def _with_tables_beside(request: SfmRequest, collection: ImageList) -> tuple[SfmRequest, list[str]]:
    """The request with ODM's table of positions, where it lies beside photographs that have none of their own; and what
    to say of tables and lists that lie there."""
    folders = _folders_of(collection)
    notes, options = list[str](), request.options
    if options.gcp is None and options.georeference != "off":
        notes += control_point_notes(folders)
    if request.gps is not None or options.georeference == "off":
        return request, notes
    tables = position_tables(folders, [photo.name for photo in collection.images], without_system=True)
    placed, number = sum(photo.lat_lon is not None for photo in collection.images), len(collection.images)
    used = next((table for table in tables if table.photographs and table.file.name.lower() == ODM_POSITIONS), None)
    if used is not None and placed < MIN_POSITIONS:
        notes.append(
            f"{used.file.name} beside the photographs, which say no positions, has those of {used.photographs} of "
            f"{number} and is used. To leave it out: --georeference off"
        )
        return replace(request, gps=used.file), notes
    read = [folder.resolve() for folder in collection.folders]  # where poses of other programs are named already
    tables = [
        each for each in tables
        if not (each.problem and {*read} & {*each.file.resolve().parents} and foreign_kind(each.file))
    ]  # fmt: skip
    notes += [table_note(table, number) for table in tables]
    return request, notes if tables or placed >= MIN_POSITIONS else [*notes, *track_notes(folders)]


def _folders_of(collection: ImageList) -> list[Path]:
    """Where tables of photographs may lie: the folders given, those of the photographs, those between, and those that
    hold the folders given."""
    roots = {folder.resolve() for folder in collection.folders}
    own = list(dict.fromkeys(photo.path.parent for photo in collection.images))
    between = list[Path]()
    for folder in own:
        above = [folder.resolve(), *folder.resolve().parents]
        inside = next((k for k, each in enumerate(above) if each in roots), 0)
        between += [each for each in folder.parents[: max(0, inside - 1)] if each not in between]
    return [*collection.folders, *own, *between, *(root.parent for root in roots)]


def _check_marks(options: SfmOptions, collection: ImageList) -> None:
    if any(photo.is_panorama for photo in collection.images) and (options.gcp or options.scale_bar):
        raise VdgsError(
            "--gcp and --scale-bar take marks in photographs of one view, not in panoramas: place panoramas by their "
            "positions, in EXIF or by --gps."
        )


def _read_gcps(options: SfmOptions, collection: ImageList, positions: GpsPriors) -> GcpList | None:
    if options.gcp is None:
        if options.check_points:
            raise VdgsError("--check-points names points of a list: give it with --gcp")
        return None
    control = read_gcp_list(options.gcp, collection, options.check_points)
    if options.georeference == "off":
        raise VdgsError("--georeference off leaves control points out: give --gcp without it")
    if options.georeference == "anyway":
        return control
    check_gcps_near(control, positions.enu, positions.origin, options.gcp)
    return control


def print_plan(reconstruction_plan: ReconstructionPlan, takes: str, console: Console) -> None:
    """Print the look, what will be done, and how long that `takes`."""
    photographs, options = reconstruction_plan.image_list.images, reconstruction_plan.request.options
    held, why = focal_decision.should_fix_focal(photographs, reconstruction_plan.gps_priors, options)
    how = "near each other by their positions" if reconstruction_plan.gps_priors.usable else (
        "all with all" if len(photographs) <= options.exhaustive_max else "next in order, and alike")  # fmt: skip
    meters = "metres east, north, up, " if reconstruction_plan.gps_priors.usable or reconstruction_plan.gcps else ""
    plan = [
        f"features, about {reconstruction_plan.pairs} pairs ({how}), poses and points, {meters}photographs without "
        "distortion",
        *_gcp_plan_lines(reconstruction_plan.gcps),
        *fisheyes.foretold(photographs, options),
        f"the focal length is {'held' if held else 'fitted'}: {why}",
        *([takes] if takes else []),
    ]
    print_preflight(reconstruction_plan.preflight, reconstruction_plan.image_list, plan, console)


def _gcp_plan_lines(control: GcpList | None) -> list[str]:
    if control is None:
        return []
    held_out = sum(point.is_check_point for point in control.points)
    used = len(control.points) - held_out
    parts = [f"{used} place the model"] if used else []
    parts += [f"{held_out} are held out to measure it"] if held_out else []
    return [f"surveyed points of {control.source} ({control.crs}): {', '.join(parts)}"]


def check_output_outside_images(output: Path, collection: ImageList) -> None:
    """Raise VdgsError where the output would lie among the photographs, or in a capture."""
    check_output(output)
    real = output.resolve()
    for folder in collection.folders:
        if real == folder.resolve() or folder.resolve() in real.parents:
            raise VdgsError(
                f"{output}: lies among the photographs in {folder}, where it would be taken for more of them. Choose a "
                "folder beside it."
            )


def check_output_folder(output: Path) -> None:
    """Raise VdgsError unless the output is a new folder, an empty one, or one of an earlier reconstruction."""
    if output.is_dir() and not is_reconstruction(output) and _has_foreign_files(output):
        raise VdgsError(f"{output}: holds other things already. Choose a new folder with --output.")
    if output.exists() and not output.is_dir():
        raise VdgsError(f"{output}: is a file. Choose a new folder with --output.")


def _has_foreign_files(output: Path) -> bool:
    """Whether a folder holds anything but what a reconstruction begins with."""
    work = output / WORK_FOLDER
    begun = work.is_dir() and all(each.suffix == ".tmp" for each in work.iterdir())  # ended before its first record
    known = (
        ".lock",
        POSITIONS_FIGURE,
        SOURCE_IMAGES_FILE,
        DIGESTS_FILE,
        FILMS_FILE,
        FRAMES_FOLDER,
        *([WORK_FOLDER] if begun else []),
    )
    return any(each.name not in known and each.suffix != ".tmp" for each in output.iterdir())


def check_disk_space(plan: ReconstructionPlan) -> None:
    photographs, options = plan.image_list.images, plan.request.options
    pixels = sum(photo.width * photo.height for photo in photographs)
    copied = sum(photo.width * photo.height for photo in photographs if photo.kind or photo.face)
    needed = BYTES_PER_PIXEL * (1.32 * pixels + copied)
    needed += BYTES_PER_FEATURE * options.max_num_features * len(photographs)
    free = shutil.disk_usage(nearest_existing(plan.request.output.resolve())).free
    if free < needed:
        raise VdgsError(
            f"{plan.request.output}: needs about {data_size(needed)}, {data_size(free)} are free there. Free "
            "some space, choose another --output, or write smaller photographs (--max-output-size 2000)."
        )


def time_order(plan: ReconstructionPlan) -> list[int]:
    """Rows of the positions in the order in which the photographs were taken."""
    return flights.time_order([plan.image_list.images[index] for index in plan.gps_priors.image_indices.tolist()])
