"""RUN/report.html, made of files of the run folder alone."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import yaml

from vdgs.errors import RunError
from vdgs.report.cost_sections import costs_section, settings_section
from vdgs.report.html_page import Html, contents, document, escaped, joined, paragraph
from vdgs.report.result_sections import (
    by_visibility_section,
    metrics_of,
    result_table,
    seams_section,
    verdict,
    views_section,
)
from vdgs.report.run_reader import Record, Shown, Source
from vdgs.report.scene_sections import assignment_section, blocks_section, maps_section, page_link, visibility_section
from vdgs.report.sfm_section import photographs_section
from vdgs.report.training_section import training_section
from vdgs.runs.run_folder import REPORT, RunFolder
from vdgs.runs.run_status import RunStanding, Standing, standing_of
from vdgs.system.atomic_files import write_text

#: name and title of the sections, for the links at the top
CONTENTS = (
    ("visibility", "visibility"), ("blocks", "blocks"), ("cameras", "cameras"), ("training", "training"),
    ("views", "test views"), ("maps", "maps"), ("by-visibility", "quality by visibility"), ("seams", "per block"),
    ("costs", "time and memory"), ("settings", "settings"),
)  # fmt: skip
#: Name of the line of the page that says which standing of the run it shows, and where it is to be found at the latest.
STANDING, HEAD_CHARACTERS = "vdgs-standing", 2000


def write_report(run: RunFolder) -> Path:
    """Write RUN/report.html and return its path: one file that needs no other, of whatever is there so far.

    What is missing or damaged is left out, and a sentence says so. Raises RunError if there is no such folder,
    VdgsError if the file cannot be written.
    """
    if not run.path.is_dir():
        raise RunError(f"{run.path}: is not a run folder. Train first: vdgs run CAPTURE --output RUN")
    shown = Shown(run, standing_of(run))
    photographs = photographs_section(shown)
    sections = [
        *([photographs] if photographs else []),
        visibility_section(shown),
        blocks_section(shown),
        assignment_section(shown),
        training_section(shown),
        views_section(shown),
        maps_section(shown),
        by_visibility_section(shown),
        seams_section(shown),
        costs_section(shown),
        settings_section(shown),
    ]
    links = [*([("photographs", "photographs")] if photographs else []), *CONTENTS]
    header, title = _header(shown)
    path = run.path / REPORT
    write_text(path, document(title, [header, contents(links), *sections], {STANDING: shown.standing.digest}))
    return path


def report_standing(run: RunFolder, standing: RunStanding) -> Standing:
    """Whether the report is there and shows the run as it stands."""
    path = run.path / REPORT
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            head = file.read(HEAD_CHARACTERS)
    except OSError:
        return Standing(name="report", state="missing", folder=REPORT)
    if f'<meta name="{STANDING}" content="{standing.digest}">' in head:
        return Standing(name="report", state="done", folder=REPORT)
    return Standing(name="report", state="stale", folder=REPORT, why="the run went on since it was written")


def _header(shown: Shown) -> tuple[Html, str]:
    source = shown.source()
    config = _config(source)
    version = config.inner("vdgs")
    made_of = source.record("capture.json")
    name = _capture_name(config, made_of)
    coarse, merged = metrics_of(source)
    title = f"{name} – vdgs report"
    facts = [
        f"Report of {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"run begun with vdgs {version.text('version') or 'of unknown version'}"
        + (f", commit {commit[:12]}" if (commit := version.text("commit")) else ""),
        _photographs(made_of),
    ]
    parts = [
        Html(f"<h1>{escaped(name)}</h1>"),
        paragraph(" · ".join(fact for fact in facts if fact), "facts"),
        *(paragraph(note, "note") for note in [*source.notes, *shown.cautions()]),
        paragraph(verdict(coarse, merged), "verdict"),
        result_table(coarse, merged),
        page_link(shown),
        *(paragraph(warning, "note") for warning in made_of.texts("warnings")),
    ]
    return Html(f"<header>\n{joined(parts)}\n</header>"), title


def _config(source: Source) -> Record:
    text = source.text("config.yaml")
    try:
        config = yaml.safe_load(text or "")
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        first = str(error).splitlines()[0] if str(error) else "unknown"
        source.notes.append(f"config.yaml is damaged, not valid YAML ({first}).")
        return Record({})
    return Record(config if isinstance(config, dict) else {})


def _capture_name(config: Record, made_of: Record) -> str:
    """The last folder of the capture's path, whatever system wrote it."""
    path = config.inner("capture").text("path") or made_of.text("root") or ""
    names = [part for part in re.split(r"[/\\]", path) if part not in ("", ".", "..")]
    return names[-1] if names else "A run without a name"


def _photographs(made_of: Record) -> str:
    training, test = (made_of.values.get(key) for key in ("training_views", "test_views"))
    if not isinstance(training, list) or not isinstance(test, list):
        return ""
    return f"{len(training)} training and {len(test)} test photographs"
