"""How the capture was made of photographs, where it was made here: facts, residuals, what was left out."""

from __future__ import annotations

from vdgs.captures.reconstruction import (
    RECONSTRUCTION_FIGURE,
    RECONSTRUCTION_FILE,
    ReconstructionReport,
    excluded_lines,
    gcp_table,
    report_rows,
)
from vdgs.report.html_page import Html, details, figure, heading, join_html, paragraph, section, table
from vdgs.report.run_reader import ReportedRun
from vdgs.system.records import record_from_dict

#: Photographs left out that are named.
MAX_LISTED = 500


def sfm_section(report: ReportedRun) -> Html:
    """Nothing where the capture came from elsewhere."""
    source = report.files()
    written = source.record(RECONSTRUCTION_FILE)
    if not written and not source.notes:
        return Html("")
    parts: list[Html] = []
    try:
        facts = record_from_dict(ReconstructionReport, written.values)
    except ValueError as error:
        source.notes.append(f"{RECONSTRUCTION_FILE} is damaged ({error}); what it says is left out.")
        return section("photographs", "From photographs to cameras", parts, source.notes)
    parts.append(table(["what", "how much"], report_rows(facts), wrap_last_column=True))
    parts += [paragraph(warning, "note") for warning in facts.warnings]
    if facts.survey:
        names = ["point", "used as", "photographs", "east [m]", "north [m]", "up [m]", "error [px]"]
        parts.append(heading("Surveyed points: seen minus surveyed"))
        parts.append(table(names, gcp_table(facts)))
    words = "The points from above; arrows lead from the recorded position of a photograph to where it was placed."
    parts.append(figure(source.image(RECONSTRUCTION_FIGURE), words, "residuals of the positions from above", True))
    parts.append(_excluded_images(excluded_lines(facts)))
    if facts.advice:
        parts.append(heading("For the next flight"))
        parts += [paragraph(line) for line in facts.advice]
    return section("photographs", "From photographs to cameras", parts, source.notes)


def _excluded_images(lines: list[str]) -> Html:
    more = len(lines) - MAX_LISTED
    shown = [*lines[:MAX_LISTED], *([f"and {more} more"] if more > 0 else [])]
    title = f"{len(lines)} photograph{'s' if len(lines) != 1 else ''} left out, and why"
    return details(title, join_html(paragraph(line) for line in shown)) if lines else Html("")
