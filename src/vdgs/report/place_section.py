"""What a report begins with: the orthophoto of the place, and the facts that a person asks for first."""

from __future__ import annotations

import contextlib

from vdgs.captures.place_record import PlaceFacts, format_area, place_rows
from vdgs.errors import RunError
from vdgs.report.embedded_images import EmbeddedImage
from vdgs.report.html_page import Html, Overlay, facts_table, map_figure, paragraph, side_by_side
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.runs.run_folder import PLACE_FILE
from vdgs.system.records import record_from_dict
from vdgs.system.units import floor_to_nice_length, format_length

MAP_FILE, PICTURE_FILE = "maps/map.json", "maps/orthophoto.png"
#: Which share of the width of a map its scale bar has, at most.
_BAR_SHARE = 0.3


def read_place(source: RunFiles) -> PlaceFacts | None:
    """The facts of the place that a run keeps; None where it has none, or they are damaged (which a note says)."""
    written = source.record(PLACE_FILE)
    if not written:
        return None
    try:
        return record_from_dict(PlaceFacts, written.values)
    except ValueError as error:
        source.notes.append(f"{PLACE_FILE} is damaged ({error}); what it says is left out.")
        return None


def current_map(report: ReportedRun, source: RunFiles) -> JsonRecord:
    """What map.json says, where the maps are of the merged model that is there; else empty."""
    metadata = source.record(MAP_FILE)
    with contextlib.suppress(RunError):  # a damaged status, of which another section tells
        if metadata and metadata.text("model_digest") == report.run.merged.status().model_id:
            return metadata
    return JsonRecord({})


def levels_of(metadata: JsonRecord) -> str:
    """What to say of maps that were drawn from levels of detail; empty for those in full detail."""
    error = metadata.number("lod_error")
    return "" if error is None else f", drawn from levels of detail (off by {error:g} px at most)"


def place_panel(report: ReportedRun, source: RunFiles, facts: PlaceFacts | None) -> Html:
    """The orthophoto with scale bar and north, and beside it the facts."""
    metadata = current_map(report, source)
    rows = _map_rows(metadata)
    rows = place_rows(facts, rows) if facts is not None else rows
    image = source.image(PICTURE_FILE) if metadata else None
    if image is None:
        picture = paragraph("There is no orthophoto of this model yet: `vdgs ortho RUN` draws it.", "facts")
    else:
        picture = _map_figure(image, metadata)
    return side_by_side(picture, facts_table(rows))


def _map_rows(metadata: JsonRecord) -> list[tuple[str, str]]:
    gsd, unit = metadata.number("gsd"), metadata.text("unit") or "units"
    width, height, share = (metadata.number(key) for key in ("width", "height", "mapped_share"))
    if gsd is None or width is None or height is None:
        return []
    on_ground = gsd / _stretch(metadata)
    mapped = f"{format_area(share * width * height * on_ground**2, unit)} mapped" if share is not None else ""
    return [("Pixel of the map", ", ".join(part for part in (format_length(gsd, unit), mapped) if part))]


def _map_figure(image: EmbeddedImage, metadata: JsonRecord) -> Html:
    gsd, width, unit = metadata.number("gsd"), metadata.number("width"), metadata.text("unit") or "units"
    bar = None
    if gsd and width and gsd > 0 and width > 0:
        across = gsd * width / _stretch(metadata)
        length = floor_to_nice_length(_BAR_SHARE * across)
        bar = Overlay(f"{length:g} {unit}", 100 * length / across)
    north_deg = metadata.number("north_deg")
    caption = f"Orthophoto, {metadata.text('crs_name')}{levels_of(metadata)}."
    if north_deg is None:
        caption += " The direction of north is not known."
    return map_figure(image, caption, "orthophoto of the place", bar, north_deg)


def _stretch(metadata: JsonRecord) -> float:
    """How many times as long as on the ground lengths are on the map."""
    stretch = metadata.number("stretch")
    return stretch if stretch and stretch > 0 else 1.0
