"""How the capture was made of photographs, where it was made here: facts, residuals, what was left out."""

from __future__ import annotations

from vdgs.captures.reconstruction import FIGURE, FILE, ReconstructionFacts, facts_rows, left_out_lines, survey_table
from vdgs.report.html_page import Html, details, figure, heading, joined, paragraph, section, table
from vdgs.report.run_reader import Shown
from vdgs.system.records import record_of

#: Photographs left out that are named.
MOST_NAMED = 500


def photographs_section(shown: Shown) -> Html:
    """Nothing where the capture came from elsewhere."""
    source = shown.source()
    written = source.record(FILE)
    if not written and not source.notes:
        return Html("")
    parts: list[Html] = []
    try:
        facts = record_of(ReconstructionFacts, written.values)
    except ValueError as error:
        source.notes.append(f"{FILE} is damaged ({error}); what it says is left out.")
        return section("photographs", "From photographs to cameras", parts, source.notes)
    parts.append(table(["what", "how much"], facts_rows(facts), wordy=True))
    parts += [paragraph(warning, "note") for warning in facts.warnings]
    if facts.survey:
        names = ["point", "used as", "photographs", "east [m]", "north [m]", "up [m]", "error [px]"]
        parts.append(heading("Surveyed points: seen minus surveyed"))
        parts.append(table(names, survey_table(facts)))
    words = "The points from above; arrows lead from the recorded position of a photograph to where it was placed."
    parts.append(figure(source.picture(FIGURE), words, "residuals of the positions from above", True))
    parts.append(_left_out(left_out_lines(facts)))
    if facts.advice:
        parts.append(heading("For the next flight"))
        parts += [paragraph(line) for line in facts.advice]
    return section("photographs", "From photographs to cameras", parts, source.notes)


def _left_out(lines: list[str]) -> Html:
    more = len(lines) - MOST_NAMED
    shown = [*lines[:MOST_NAMED], *([f"and {more} more"] if more > 0 else [])]
    title = f"{len(lines)} photograph{'s' if len(lines) != 1 else ''} left out, and why"
    return details(title, joined(paragraph(line) for line in shown)) if lines else Html("")
