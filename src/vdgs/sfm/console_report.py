"""Words for the console: the look before the work, and the page of facts after it."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vdgs.captures.reconstruction import ReconstructionFacts, facts_rows, left_out_lines
from vdgs.sfm.image_list import Collection
from vdgs.sfm.preflight import Look

#: Left out photographs that are named on the console; the file names all.
MOST_NAMED = 12


def tell_look(look: Look, collection: Collection, plan: list[str], console: Console) -> None:
    """What there is, and what will be done."""
    rows = [
        ("Photographs", _photographs(look, collection)),
        ("Cameras", _several([f"{name} ({n})" for name, n in look.cameras])),
    ]
    rows.append(("Sizes", _several([f"{width} x {height} ({n})" for width, height, n in look.sizes])))
    if look.masks or look.transparent:
        rows.append(("Masks", _masks(look)))
    if look.days:
        rows.append(("Taken", look.days[0] if len(look.days) == 1 else f"{look.days[0]} to {look.days[-1]}"))
    rows.append(("Positions", _positions(look)))
    if look.height_m is not None:
        rows.append(("Flying height", f"{look.height_m:.1f} m {look.height_from}"))
    if look.gsd_m is not None:
        rows.append(("A pixel shows", f"about {100 * look.gsd_m:.1f} cm of the ground"))
    if look.forward_overlap is not None and look.views_per_place is not None:
        seen = f"{look.forward_overlap:.0%} along the flight; a place is seen by about {look.views_per_place:.0f}"
        rows.append(("Overlap", f"about {seen}, were the ground level"))
    if look.oblique is not None:
        rows.append(("Oblique views", f"{look.oblique} of {look.photographs}"))
    rows += [("Plan" if k == 0 else "", line) for k, line in enumerate(plan)]
    _table(rows, console)
    for warning in look.warnings:
        console.print(f"[yellow]note[/] {escape(warning)}", highlight=False)
    _name([f"{each.name}: {each.why}" for each in collection.left_out], console)


def tell_facts(facts: ReconstructionFacts, console: Console) -> None:
    """What came out."""
    _table(facts_rows(facts), console)
    for warning in facts.warnings:
        console.print(f"[yellow]note[/] {escape(warning)}", highlight=False)
    _name(left_out_lines(facts), console)
    for line in facts.advice:
        console.print(f"next flight: {escape(line)}", highlight=False)


def _name(lines: list[str], console: Console) -> None:
    for line in lines[:MOST_NAMED]:
        console.print(f"[yellow]left out[/] {escape(line)}", highlight=False)
    if len(lines) > MOST_NAMED:
        console.print(f"[yellow]left out[/] and {len(lines) - MOST_NAMED} more", highlight=False)


def _table(rows: list[tuple[str, str]], console: Console) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for label, value in rows:
        table.add_row(label, escape(value))
    console.print(table)


def _photographs(look: Look, collection: Collection) -> str:
    left_out = f", {len(collection.left_out)} left out" if collection.left_out else ""
    others = f", {collection.other_files} other files beside them" if collection.other_files else ""
    return f"{look.photographs}{left_out}{others}"


def _masks(look: Look) -> str:
    alpha = f"{look.transparent} have an alpha channel, which counts as one" if look.transparent else ""
    files = f"{look.masks} of {look.photographs} photographs have one" if look.masks else ""
    return "; ".join(each for each in (files, alpha) if each)


def _positions(look: Look) -> str:
    if not look.positions or look.spread_m is None:
        return "none: the scale will be arbitrary, north unknown"
    east, north = look.spread_m
    rtk = f"; {look.rtk} say how accurate they are (RTK)" if look.rtk else ""
    spread = f"over {east:.0f} m x {north:.0f} m"
    return f"{look.positions} of {look.photographs}, {spread}; altitude: {look.altitude_reference}{rtk}"


def _several(values: list[str]) -> str:
    more = len(values) - 4
    return ", ".join(values[:4]) + (f" and {more} more" if more > 0 else "")
