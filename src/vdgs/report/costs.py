"""What the run cost, stage by stage, and the settings it was made with."""

from __future__ import annotations

from pathlib import Path

from vdgs.report.page import Html, details, paragraph, preformatted, section, table
from vdgs.report.reading import Record, Source
from vdgs.report.training import block_names
from vdgs.report.words import duration, memory
from vdgs.runs.folder import RunFolder

#: Characters of config.yaml that are shown.
LONGEST_SETTINGS = 60_000


def costs_section(run: RunFolder) -> Html:
    source = Source(run.path)
    stages = [(name, record) for name, record in _stages(source, run) if record]
    rows = [
        [
            name,
            duration(record.number("seconds")),
            memory(record.number("peak_memory_bytes")),
            record.text("state") or "",
        ]
        for name, record in stages
    ]
    if rows:
        seconds = [record.number("seconds") or 0.0 for _, record in stages]
        peaks = [record.number("peak_memory_bytes") or 0.0 for _, record in stages]
        rows.append(["sum, highest", duration(sum(seconds)), memory(max(peaks)), ""])
    parts = [
        table(["stage", "time", "peak memory", "state"], rows, "Blocks trained side by side count one by one"),
        Html("") if rows else paragraph("No stage has run yet.", "absent"),
    ]
    return section("costs", "Time and memory", parts, source.notes)


def _stages(source: Source, run: RunFolder) -> list[tuple[str, Record]]:
    merged = source.record("merged/status.json").values
    merge = {
        "seconds": merged.get("merge_seconds"), "peak_memory_bytes": merged.get("merge_peak_memory_bytes"),
        "state": merged.get("state"),
    }  # fmt: skip
    return [
        ("coarse training", source.record("coarse/status.json")),
        ("coarse evaluation", source.record("coarse/evaluation/status.json")),
        ("partition and assignment", source.record("partition/partition.json")),
        *((f"block {index}", source.record(f"{name}/status.json")) for index, name in block_names(run)),
        ("merge", Record(merge if merged else {})),
        ("evaluation", source.record("evaluation/status.json")),
    ]


def settings_section(root: Path) -> Html:
    source = Source(root)
    text = source.text("config.yaml")
    parts: list[Html] = []
    if text is None:
        parts.append(paragraph("There is no config.yaml.", "absent"))
    else:
        more = len(text) - LONGEST_SETTINGS
        ending = f"\n… {more} characters more" if more > 0 else ""
        parts.append(details("config.yaml", preformatted(text[:LONGEST_SETTINGS] + ending)))
    return section("settings", "Settings", parts, source.notes)
