"""RUN/report.html, made of files of the run folder alone."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import yaml

from vdgs.errors import RunError
from vdgs.report.cost_sections import costs_section, settings_section
from vdgs.report.html_page import Html, document, escape_html, join_html, paragraph, table_of_contents
from vdgs.report.result_sections import (
    by_visibility_section,
    read_metrics,
    result_summary,
    result_table,
    seams_section,
    views_section,
)
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.report.scene_sections import (
    assignment_section,
    blocks_section,
    html_export_link,
    ortho_section,
    visibility_section,
)
from vdgs.report.sfm_section import sfm_section
from vdgs.report.training_section import training_section
from vdgs.runs.run_folder import REPORT_FILE, RunFolder
from vdgs.runs.run_status import RunStatus, StageStatus, get_run_status
from vdgs.system.atomic_files import write_text

#: name and title of the sections, for the links at the top
SECTION_LINKS = (
    ("visibility", "visibility"), ("blocks", "blocks"), ("cameras", "cameras"), ("training", "training"),
    ("views", "test views"), ("maps", "maps"), ("by-visibility", "quality by visibility"), ("seams", "per block"),
    ("costs", "time and memory"), ("settings", "settings"),
)  # fmt: skip
#: Name of the line of the page that says which standing of the run it shows, and where it is to be found at the latest.
STATUS_META_NAME, MAX_HEAD_CHARS = "vdgs-status", 2000


def write_report(run: RunFolder) -> Path:
    """Write RUN/report.html and return its path: one file that needs no other, of whatever is there so far.

    What is missing or damaged is left out, and a sentence says so. Raises RunError if there is no such folder,
    VdgsError if the file cannot be written.
    """
    if not run.path.is_dir():
        raise RunError(f"{run.path}: is not a run folder. Train first: vdgs run CAPTURE --output RUN")
    shown = ReportedRun(run, get_run_status(run))
    photographs = sfm_section(shown)
    sections = [
        *([photographs] if photographs else []),
        visibility_section(shown),
        blocks_section(shown),
        assignment_section(shown),
        training_section(shown),
        views_section(shown),
        ortho_section(shown),
        by_visibility_section(shown),
        seams_section(shown),
        costs_section(shown),
        settings_section(shown),
    ]
    links = [*([("photographs", "photographs")] if photographs else []), *SECTION_LINKS]
    header, title = _header(shown)
    path = run.path / REPORT_FILE
    write_text(
        path, document(title, [header, table_of_contents(links), *sections], {STATUS_META_NAME: shown.status.digest})
    )
    return path


def report_status(run: RunFolder, status: RunStatus) -> StageStatus:
    """Whether the report is there and shows the run as it stands."""
    path = run.path / REPORT_FILE
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            head = file.read(MAX_HEAD_CHARS)
    except OSError:
        return StageStatus(name="report", state="missing", folder=REPORT_FILE)
    if f'<meta name="{STATUS_META_NAME}" content="{status.digest}">' in head:
        return StageStatus(name="report", state="done", folder=REPORT_FILE)
    return StageStatus(name="report", state="stale", folder=REPORT_FILE, reason="the run went on since it was written")


def _header(report: ReportedRun) -> tuple[Html, str]:
    source = report.files()
    config = _config(source)
    version = config.child("vdgs")
    made_of = source.record("capture.json")
    name = _capture_name(config, made_of)
    coarse, merged = read_metrics(source)
    title = f"{name} – vdgs report"
    facts = [
        f"Report of {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"run begun with vdgs {version.text('version') or 'of unknown version'}"
        + (f", commit {commit[:12]}" if (commit := version.text("commit")) else ""),
        _image_counts(made_of),
    ]
    parts = [
        Html(f"<h1>{escape_html(name)}</h1>"),
        paragraph(" · ".join(fact for fact in facts if fact), "facts"),
        *(paragraph(note, "note") for note in [*source.notes, *report.warnings()]),
        paragraph(result_summary(coarse, merged), "verdict"),
        result_table(coarse, merged),
        html_export_link(report),
        *(paragraph(warning, "note") for warning in made_of.texts("warnings")),
    ]
    return Html(f"<header>\n{join_html(parts)}\n</header>"), title


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
