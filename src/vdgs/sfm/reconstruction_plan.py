"""Before the work: photographs collected and looked at, options checked, a plan told. Nothing is written."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from vdgs.captures.output_guard import refuse_in_a_capture
from vdgs.config.ranges import refuse
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.errors import VdgsError
from vdgs.kernels import default_threads
from vdgs.sfm import feature_matching, incremental_mapper
from vdgs.sfm.console_report import tell_look
from vdgs.sfm.gcp_list import Control, check_near, read_control
from vdgs.sfm.gps_priors import Positions, find_positions
from vdgs.sfm.image_list import Collection, collect
from vdgs.sfm.preflight import Look, look_at, seconds
from vdgs.system.units import data_size, rough_duration

#: Bytes of disk for a feature, with its descriptor and its matches; and for a pixel of a written photograph.
FEATURE_BYTES, PIXEL_BYTES = 250, 0.9


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """What is known before the work."""

    request: SfmRequest
    collection: Collection
    positions: Positions
    look: Look
    threads: int
    seconds: float
    control: Control | None = None

    @property
    def origin(self) -> tuple[float, float, float]:
        """Of all metres east, north, up: latitude and longitude in degrees, altitude in metres."""
        return self.control.middle if self.control and not self.positions.usable else self.positions.origin


def prepare(request: SfmRequest) -> Prepared:
    """The look before the work; nothing is written. Raises CaptureError for photographs that cannot become one."""
    refuse(request)
    collection = collect(request.photographs)
    refuse_among_photographs(request.output, collection)
    positions = find_positions(collection.photographs, request.gps, request.options.gps_deviation_m)
    control = _control(request.options, collection, positions)
    look = look_at(collection, positions)
    look = replace(look, warnings=[*look.warnings, *(control.notes if control else ())])
    threads = request.threads or default_threads()
    pairs = feature_matching.expected_pairs(collection.photographs, positions, request.options)
    takes = seconds(collection.photographs, pairs, request.options, threads)
    return Prepared(
        request=request, collection=collection, positions=positions, look=look, threads=threads, seconds=takes,
        control=control,
    )  # fmt: skip


def _control(options: SfmOptions, collection: Collection, positions: Positions) -> Control | None:
    if options.gcp is None:
        if options.check_points:
            raise VdgsError("--check-points names points of a list: give it with --gcp")
        return None
    control = read_control(options.gcp, collection, options.check_points)
    check_near(control, positions.enu, positions.origin, options.gcp)
    return control


def tell(prepared: Prepared, console: Console) -> None:
    """Print the look, and what will be done."""
    photographs, options = prepared.collection.photographs, prepared.request.options
    pairs = feature_matching.expected_pairs(photographs, prepared.positions, options)
    held, why = incremental_mapper.holds_focal(photographs, prepared.positions, options)
    how = "near each other by their positions" if prepared.positions.usable else (
        "all with all" if len(photographs) <= options.exhaustive else "next in order, and alike")  # fmt: skip
    metres = "metres east, north, up, " if prepared.positions.usable or prepared.control else ""
    plan = [
        f"features, about {pairs} pairs ({how}), poses and points, {metres}photographs without distortion",
        *_plan_of(prepared.control),
        f"the focal length is {'held' if held else 'fitted'}: {why}",
        f"about {rough_duration(prepared.seconds)} on {prepared.threads} threads, if they are idle",
    ]
    tell_look(prepared.look, prepared.collection, plan, console)


def _plan_of(control: Control | None) -> list[str]:
    if control is None:
        return []
    held_out = sum(point.held_out for point in control.points)
    used = len(control.points) - held_out
    parts = [f"{used} place the model"] if used else []
    parts += [f"{held_out} are held out to measure it"] if held_out else []
    return [f"surveyed points of {control.source} ({control.system}): {', '.join(parts)}"]


def refuse_among_photographs(output: Path, collection: Collection) -> None:
    """Raise VdgsError where the output would lie among the photographs, or in a capture."""
    refuse_in_a_capture(output)
    real = output.resolve()
    for folder in collection.folders:
        if real == folder.resolve() or folder.resolve() in real.parents:
            raise VdgsError(
                f"{output}: lies among the photographs in {folder}, where it would be taken for more of them. Choose a "
                "folder beside it."
            )


def check_disk(prepared: Prepared) -> None:
    photographs, options = prepared.collection.photographs, prepared.request.options
    pixels = sum(photo.width * photo.height for photo in photographs)
    needed = PIXEL_BYTES * 1.32 * pixels + FEATURE_BYTES * options.features * len(photographs)
    parent = next(
        folder
        for folder in (prepared.request.output.resolve(), *prepared.request.output.resolve().parents)
        if folder.exists()
    )
    free = shutil.disk_usage(parent).free
    if free < needed:
        raise VdgsError(
            f"{prepared.request.output}: needs about {data_size(needed)}, {data_size(free)} are free there. Free "
            "some space, choose another --output, or write smaller photographs (--max-size 2000)."
        )


def in_time(prepared: Prepared) -> list[int]:
    """Rows of the positions in the order in which the photographs were taken."""
    photographs, index = prepared.collection.photographs, prepared.positions.index
    return sorted(
        range(len(index)), key=lambda row: (photographs[int(index[row])].taken, photographs[int(index[row])].name)
    )
