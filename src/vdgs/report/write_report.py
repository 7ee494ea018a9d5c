"""RUN/report.html, made of files of the run folder alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import yaml
from rich.console import Console
from rich.markup import escape

from vdgs.captures.output_guard import check_output
from vdgs.errors import RunError, VdgsError
from vdgs.report.html_page import Html, document, escape_html, join_html, paragraph, table_of_contents
from vdgs.report.place_section import place_panel, read_place
from vdgs.report.report_status import STATUS_META_NAME
from vdgs.report.result_sections import (
    by_visibility_section,
    metrics_section,
    off_path_section,
    seams_section,
    views_section,
)
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.report.scene_sections import (
    assignment_section,
    blocks_section,
    html_export_link,
    motion_section,
    ortho_section,
    sfm_section,
    visibility_section,
)
from vdgs.report.training_section import costs_section, settings_section, training_section
from vdgs.runs.run_folder import REPORT_FILE, RunFolder
from vdgs.runs.run_status import get_run_status
from vdgs.system.atomic_files import write_text

#: The sections, each with its name and title for the links at the top; those that say nothing of a run are empty.
SECTIONS: tuple[tuple[Callable[[ReportedRun], Html], str, str], ...] = (
    (views_section, "views", "test views"),
    (metrics_section, "metrics", "metrics"),
    (by_visibility_section, "by-visibility", "quality by visibility"),
    (off_path_section, "off-path", "off the path"),
    (ortho_section, "maps", "maps"),
    (sfm_section, "photographs", "photographs"),
    (visibility_section, "visibility", "visibility"),
    (motion_section, "motion", "what moves"),
    (blocks_section, "blocks", "blocks"),
    (assignment_section, "cameras", "cameras"),
    (seams_section, "seams", "per block"),
    (training_section, "training", "training"),
    (costs_section, "costs", "time and memory"),
    (settings_section, "settings", "settings"),
)


def write_report(run: RunFolder) -> Path:
    """Write RUN/report.html and return its path: one file that needs no other, of whatever is there so far.

    What is missing or damaged is left out, and a sentence says so. Raises RunError if there is no such folder,
    VdgsError if the file cannot be written, or the folder is one of photographs.
    """
    if not run.path.is_dir():
        raise RunError(f"{run.path}: is not a run folder. Train first: vdgs run CAPTURE --output RUN")
    check_output(run.path / REPORT_FILE)
    report = ReportedRun(run, get_run_status(run))
    sections = [(make_section(report), name, title) for make_section, name, title in SECTIONS]
    links = [(name, title) for content, name, title in sections if content]
    header, title = _header(report)
    page = document(
        title,
        [header, table_of_contents(links), *(content for content, _, _ in sections)],
        {STATUS_META_NAME: report.status.digest},
    )
    write_text(run.path / REPORT_FILE, page)
    return run.path / REPORT_FILE


def link_exports(run: RunFolder, console: Console) -> None:
    """Write the report again, which links to what was exported; a note where the run may only be read."""
    try:
        write_report(run)
    except VdgsError:
        file = escape(str(run.path / REPORT_FILE))
        console.print(f"[yellow]note[/] {file} cannot be written: it will not link to the page")


def _header(report: ReportedRun) -> tuple[Html, str]:
    source = report.files()
    config, capture = _config(source), source.record("capture.json")
    version, commit = (config.child("vdgs").text(key) for key in ("version", "commit"))
    place = read_place(source)
    name = place.name if place is not None and place.name else _capture_name(config, capture)
    facts = [
        f"Report of {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"run begun with vdgs {version or 'of unknown version'}{f', commit {commit[:12]}' if commit else ''}",
        _image_counts(capture) if place is None else "",
    ]
    panel = place_panel(report, source, place)  # may add notes
    parts = [
        Html(f"<h1>{escape_html(name)}</h1>"),
        panel,
        html_export_link(report),
        *(paragraph(note, "note") for note in [*source.notes, *report.warnings(), *capture.texts("warnings")]),
        paragraph(" · ".join(fact for fact in facts if fact), "facts"),
    ]
    return Html(f"<header>\n{join_html(parts)}\n</header>"), f"{name} – vdgs report"


def _config(source: RunFiles) -> JsonRecord:
    text = source.text("config.yaml")
    try:
        config = yaml.safe_load(text or "")
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        first = str(error).splitlines()[0] if str(error) else "unknown"
        source.notes.append(f"config.yaml is damaged, not valid YAML ({first}).")
        return JsonRecord({})
    return JsonRecord(config if isinstance(config, dict) else {})


def _capture_name(config: JsonRecord, capture_record: JsonRecord) -> str:
    """The last folder of the capture's path, whatever system wrote it."""
    path = config.child("capture").text("path") or capture_record.text("root") or ""
    names = [part for part in re.split(r"[/\\]", path) if part not in ("", ".", "..")]
    return names[-1] if names else "A run without a name"


def _image_counts(capture_record: JsonRecord) -> str:
    training, test = (capture_record.values.get(key) for key in ("training_views", "test_views"))
    if not isinstance(training, list) or not isinstance(test, list):
        return ""
    return f"{len(training)} training and {len(test)} test photographs"
