"""Words for the console: the look before the work, and the page of facts after it."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vdgs.captures.reconstruction import ReconstructionReport, excluded_lines, flying_height, report_rows
from vdgs.sfm.image_list import ImageList
from vdgs.sfm.preflight import PreflightReport

#: Left out photographs that are named on the console; the file names all.
MAX_LISTED = 12


def print_preflight(preflight: PreflightReport, collection: ImageList, plan: list[str], console: Console) -> None:
    """What there is, and what will be done."""
    rows = [
        ("Photographs", _images_text(preflight, collection)),
        ("Cameras", _several([f"{name} ({n})" for name, n in preflight.cameras])),
    ]
    rows.append(("Sizes", _several([f"{width} x {height} ({n})" for width, height, n in preflight.sizes])))
    if preflight.num_masks or preflight.transparent:
        rows.append(("Masks", _masks_text(preflight)))
    if preflight.days:
        rows.append(
            ("Taken", preflight.days[0] if len(preflight.days) == 1 else f"{preflight.days[0]} to {preflight.days[-1]}")
        )
    rows.append(("Positions", _positions_text(preflight)))
    if preflight.height_m is not None:
        height = flying_height(preflight.height_m, preflight.heights_m)
        rows.append(("Flying height", f"{height} {preflight.height_from}"))
    if preflight.gsd_m is not None:
        rows.append(("A pixel shows", f"about {100 * preflight.gsd_m:.1f} cm of the ground"))
    elif not preflight.shows_ground:
        rows += _rows_of_level_views(preflight)
    if preflight.forward_overlap is not None and preflight.views_per_point is not None:
        seen = f"a place is seen by about {preflight.views_per_point:.0f}"
        rows.append(
            ("Overlap", f"about {preflight.forward_overlap:.0%} along the flight; {seen}, were the ground level")
        )
    if preflight.oblique is not None:
        rows.append(("Oblique views", f"{preflight.oblique} of {preflight.num_images}"))
    rows += [("Plan" if k == 0 else "", line) for k, line in enumerate(plan)]
    _table(rows, console)
    for warning in preflight.warnings:
        console.print(f"[yellow]note[/] {escape(warning)}", highlight=False)
    _print_excluded([each.line for each in collection.excluded], console)


def print_reconstruction_report(report: ReconstructionReport, console: Console) -> None:
    """What came out."""
    _table(report_rows(report), console)
    for warning in report.warnings:
        console.print(f"[yellow]note[/] {escape(warning)}", highlight=False)
    _print_excluded(excluded_lines(report), console)
    for line in report.advice:
        console.print(f"next flight: {escape(line)}", highlight=False)


def _print_excluded(lines: list[str], console: Console) -> None:
    for line in lines[:MAX_LISTED]:
        console.print(f"[yellow]left out[/] {escape(line)}", highlight=False)
    if len(lines) > MAX_LISTED:
        console.print(f"[yellow]left out[/] and {len(lines) - MAX_LISTED} more", highlight=False)


def _table(rows: list[tuple[str, str]], console: Console) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for label, value in rows:
        table.add_row(label, escape(value))
    console.print(table)


def _images_text(preflight: PreflightReport, collection: ImageList) -> str:
    left_out = f", {len(collection.excluded)} left out" if collection.excluded else ""
    others = f", {collection.other_files} other files beside them" if collection.other_files else ""
    return f"{preflight.num_images}{left_out}{others}"


def _rows_of_level_views(preflight: PreflightReport) -> list[tuple[str, str]]:
    """What is known of photographs that show no ground."""
    look = f"level or up: {preflight.tilt_deg:.0f}° from straight down (median)"
    rows = [("Views", f"{look}; nothing says how far away what they show is, nor how far they overlap")]
    if preflight.pixel_rad is not None:
        rows.append(("A pixel shows", f"about {100 * 10 * preflight.pixel_rad:.2g} cm of what is 10 m away"))
    return rows


def _masks_text(preflight: PreflightReport) -> str:
    alpha = f"{preflight.transparent} have an alpha channel, which counts as one" if preflight.transparent else ""
    files = f"{preflight.num_masks} of {preflight.num_images} photographs have one" if preflight.num_masks else ""
    return "; ".join(each for each in (files, alpha) if each)


def _positions_text(preflight: PreflightReport) -> str:
    if not preflight.positions or preflight.spread_m is None:
        return "none: the scale will be arbitrary, north unknown"
    east, north = preflight.spread_m
    accurate = f"; {preflight.accurate} say how accurate they are" if preflight.accurate else ""
    accurate += " (RTK)" if preflight.rtk else ""
    spread = f"over {east:.0f} m x {north:.0f} m"
    placed = f"{preflight.positions} of {preflight.num_images}, {spread}"
    return f"{placed}; altitude: {preflight.altitude_reference}{accurate}"


def _several(values: list[str]) -> str:
    more = len(values) - 4
    return ", ".join(values[:4]) + (f" and {more} more" if more > 0 else "")
