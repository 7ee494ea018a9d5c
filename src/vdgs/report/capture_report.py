"""A capture looked at before anyone trains: numbers as a table and as report.json, and figures."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vdgs.captures.capture import Capture
from vdgs.captures.image_checks import ImageCheckReport
from vdgs.captures.output_guard import check_not_among_inputs
from vdgs.captures.place_record import place_rows
from vdgs.captures.reconstruction import ReconstructionReport, excluded_lines, report_rows
from vdgs.captures.strays import folder_in_run
from vdgs.captures.validation import format_reprojection, validate_capture
from vdgs.geometry.similarity import sample_points
from vdgs.report.capture_figures import draw_capture_map, draw_visibility_histogram
from vdgs.report.capture_stats import CaptureReport, measure_capture
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.units import format_length
from vdgs.visibility.visibility_counts import count_visibility

#: Points looked at when there are more, and fewer where there are many cameras.
MAX_POINTS = 200_000
MIN_POINTS = 20_000
MAX_PROJECTIONS = 2e8


def inspect_capture(capture: Capture, output: Path, image_check: ImageCheckReport | None = None) -> CaptureReport:
    """Measure the capture; write report.json and two figures into the folder `output` (made if absent), or into
    `inspect` in it where it is a run.

    `image_check` is the result of decoding its photographs, where they were decoded. Raises VdgsError for an output
    among the capture's inputs.
    """
    output = folder_in_run(output, "inspect")
    check_not_among_inputs(output, capture)
    output.mkdir(parents=True, exist_ok=True)
    few_enough = int(np.clip(MAX_PROJECTIONS / len(capture.train_views), MIN_POINTS, MAX_POINTS))
    points = sample_points(capture.points, few_enough)
    cameras = [view.camera for view in capture.train_views]
    visibility = count_visibility(torch.from_numpy(np.ascontiguousarray(points)), cameras).numpy().astype(np.int64)
    report = measure_capture(capture, points, visibility, validate_capture(capture), image_check)
    figures = [output / "visibility_map.png", output / "visibility.png"]
    draw_capture_map(capture, report, points, visibility, figures[0])
    draw_visibility_histogram(report, visibility, figures[1])
    report = replace(report, figures=[file.name for file in figures])
    write_json(output / "report.json", to_jsonable(asdict(report)))
    return report


def print_report(
    report: CaptureReport, console: Console | None = None, reconstruction_report: ReconstructionReport | None = None
) -> None:
    """The report as a table for people, with how the capture was made of photographs, where it was made here."""
    console = console or Console()
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for label, value in _rows(report):
        table.add_row(label, escape(value))
    for label, value in report_rows(reconstruction_report) if reconstruction_report is not None else ():
        table.add_row(label, escape(value))
    console.print(table)
    for warning in report.warnings:
        console.print(f"[yellow]Warning:[/] {escape(warning)}", highlight=False)
    for problem in report.problems:
        console.print(f"[red]Problem:[/] {escape(problem)}", highlight=False)
    if reconstruction_report is not None:
        for line in excluded_lines(reconstruction_report):
            console.print(f"[yellow]Left out:[/] {escape(line)}", highlight=False)
        for line in reconstruction_report.advice:
            console.print(f"Next flight: {escape(line)}", highlight=False)


def _rows(report: CaptureReport) -> list[tuple[str, str]]:
    unit = report.unit
    sizes = ", ".join(f"{width} x {height}" for width, height in report.image_sizes[:3])
    more = len(report.image_sizes) - 3
    quantiles = ", ".join(f"{value:g} ({q} %)" for q, value in report.visibility_quantiles.items())
    below = ", ".join(f"{share:.1%} by < {limit}" for limit, share in report.fraction_below.items())
    low, middle, high = report.camera_height
    rows = [
        *place_rows(report.place),
        ("Source", report.source),
        ("Images", f"{report.place.image_source}: {sizes}" + (f" and {more} more sizes" if more > 0 else "") + " px"),
        ("Focal length", f"{report.focal_px:.1f} px ({report.field_of_view_deg:.0f}° across)"),
        ("Sparse points", f"{report.points}, median spacing {format_length(report.point_spacing, unit)}"),
        ("Ground frame", report.ground + ("" if report.metric else " (not metric)")),
        ("Camera height", f"{middle:.4g} {unit} (from {low:.4g} to {high:.4g}), tilt {report.tilt_deg:.1f}°"),
        ("Cameras per point V", quantiles),
        ("Poorly seen points", f"{below} cameras; Gini {report.visibility_gini:.2f}"),
        ("Masks", _masks(report)),
        ("Cameras and points", _agreement(report)),
        ("Images in memory", f"{report.image_bytes / 2**20:.0f} MiB"),
    ]
    if report.origin_geo is not None:
        latitude, longitude, altitude = report.origin_geo
        rows.append(("Origin", f"{latitude:.7f}, {longitude:.7f}, {altitude:.1f} m"))
    return rows


def _masks(report: CaptureReport) -> str:
    """How much of the photographs is left out."""
    left_out = (
        "photographs not decoded" if report.masked_fraction is None else f"{report.masked_fraction:.1%} masked out"
    )
    if not report.masks and not report.masked_fraction:
        return "none"
    transparent = "" if report.masks else ", by transparency"
    return f"of {report.masks} of {report.num_images} photographs; {left_out}{transparent}"


def _agreement(report: CaptureReport) -> str:
    """Whether the points lie where the photographs show them, and by what that was judged."""
    seen = f"{report.seen_fraction:.1%} of the points lie in front of and inside a training camera"
    if not report.num_observations:
        return f"{seen} (the capture has no tracks to reproject)"
    error = format_reprojection(float("inf") if report.reprojection_px is None else report.reprojection_px)
    return f"median reprojection error {error} ({report.num_observations} sightings of the model's tracks); {seen}"
