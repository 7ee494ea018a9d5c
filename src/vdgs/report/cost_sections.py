"""What the run cost, stage by stage, and the settings it was made with."""

from __future__ import annotations

from vdgs.report.html_page import Html, details, paragraph, preformatted, section, table
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.report.training_section import list_blocks
from vdgs.system.units import data_size, duration

#: Characters of config.yaml that are shown.
MAX_SETTINGS_CHARS = 60_000
COST_CAPTION = "Blocks trained side by side count one by one; what is out of date does not count"


def costs_section(report: ReportedRun) -> Html:
    source = report.files()
    stages = [(name, record) for name, record in _stages(source, report) if record]
    rows = [[name, *_cost(record), report.stage_state(_stage_name(name))] for name, record in stages]
    counted = [record for name, record in stages if report.status.of(_stage_name(name)).state != "stale"]
    if counted:
        seconds = [record.number("seconds") or 0.0 for record in counted]
        peaks = [record.number("peak_memory_bytes") or 0.0 for record in counted]
        rows.append(["sum, highest", duration(sum(seconds)), data_size(max(peaks)), ""])
    parts = [
        table(["stage", "time", "peak memory", "state"], rows, COST_CAPTION),
        Html("") if rows else paragraph("No stage has run yet.", "absent"),
    ]
    return section("costs", "Time and memory", parts, source.notes)


def _cost(record: JsonRecord) -> tuple[str, str]:
    return duration(record.number("seconds")), data_size(record.number("peak_memory_bytes"))


def _stage_name(row: str) -> str:
    """The stage that a row of the table is about."""
    return {"coarse training": "coarse", "partition and assignment": "cameras"}.get(row, row)


def _stages(source: RunFiles, report: ReportedRun) -> list[tuple[str, JsonRecord]]:
    merged = source.record("merged/status.json").values
    merge = {
        "seconds": merged.get("merge_seconds"), "peak_memory_bytes": merged.get("merge_peak_memory_bytes"),
    }  # fmt: skip
    return [
        ("coarse training", source.record("coarse/status.json")),
        ("coarse evaluation", source.record("coarse/evaluation/status.json")),
        ("partition and assignment", source.record("partition/partition.json")),
        *((f"block {index}", source.record(f"{name}/status.json")) for index, name in list_blocks(report.run)),
        ("merge", JsonRecord(merge if merged else {})),
        ("evaluation", source.record("evaluation/status.json")),
    ]


def settings_section(report: ReportedRun) -> Html:
    source = report.files()
    text = source.text("config.yaml")
    parts: list[Html] = []
    if text is None:
        parts.append(paragraph("There is no config.yaml.", "absent"))
    else:
        more = len(text) - MAX_SETTINGS_CHARS
        ending = f"\n… {more} characters more" if more > 0 else ""
        parts.append(details("config.yaml", preformatted(text[:MAX_SETTINGS_CHARS] + ending)))
    return section("settings", "Settings", parts, source.notes)
