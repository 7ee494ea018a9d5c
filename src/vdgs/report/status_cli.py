"""`vdgs status`: how far a run is, in lines for people and as plain values for programs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from rich.console import Console
from rich.markup import escape

from vdgs.captures.place_facts import PlaceFacts, place_summary
from vdgs.report.place_section import read_place
from vdgs.report.run_reader import RunFiles
from vdgs.report.write_report import report_status
from vdgs.runs.run_folder import REPORT_FILE, RunFolder
from vdgs.runs.run_status import RunStatus, StageStatus, get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.atomic_files import to_jsonable
from vdgs.system.documents import RunStatusDocument, StageStatusDocument
from vdgs.system.quoting import shell_word
from vdgs.system.records import record_to_dict
from vdgs.system.units import rough_duration

#: Exit code of `vdgs status` for a run that is not whole: something of it is missing, runs, failed or is out of date.
EXIT_INCOMPLETE = 3
STATE_STYLES = {
    "done": "green", "running": "cyan", "queued": "dim", "stopped": "yellow", "failed": "red", "stale": "yellow",
    "missing": "dim", "unknown": "yellow",
}  # fmt: skip


def full_run_status(run: RunFolder) -> RunStatus:
    """How far a run is, its report included. Raises RunError for a folder that holds no run."""
    run.config_file.exists() or run.settings()  # which says that there is none
    status = get_run_status(run)
    return replace(status, stages=(*status.stages, report_status(run, status)))


def print_status(run: RunFolder, console: Console) -> int:
    """Say how far every stage and block is and what to type next; 0 if the run is whole, else `EXIT_INCOMPLETE`."""
    status, place = full_run_status(run), _place(run)
    if place is not None:
        console.print(escape(place_summary(place)), highlight=False)
    width = max(len(stage.name) for stage in status.stages)
    for stage in status.stages:
        note = "; ".join(part for part in (progress_text(stage.status), stage.reason) if part)
        state = f"[{STATE_STYLES[stage.state]}]{stage.state:<8}[/]"
        console.print(f"{stage.name:<{width}}  {state}  {escape(note)}".rstrip(), highlight=False)
    counted = Counter(stage.state for stage in status.stages)
    console.print(", ".join(f"{count} {state}" for state, count in counted.items()), highlight=False)
    console.print(escape(f"next: {next_step(status)}"), highlight=False)
    return 0 if status.is_complete else EXIT_INCOMPLETE


def status_json(run: RunFolder) -> RunStatusDocument:
    """The same for programs."""
    status, place = full_run_status(run), _place(run)
    return {
        "run": str(run.path), "place": None if place is None else to_jsonable(record_to_dict(place)),
        "complete": status.is_complete, "running": status.is_running,
        "next_command": status.next_command() or None, "stages": [_stage_json(stage) for stage in status.stages],
    }  # fmt: skip


def _place(run: RunFolder) -> PlaceFacts | None:
    """The facts of the place, as the report begins with them; None where the run has none."""
    return read_place(RunFiles(run.path))


def next_step(status: RunStatus) -> str:
    """What a person does next, in a line."""
    if command := status.next_command():
        return command
    if status.is_running:
        return "nothing to type: it is at work"
    run = shell_word(status.path)
    report = shell_word(status.path / REPORT_FILE)
    return f"open {report}, or film it: vdgs render {run} --views flyover --output flyover.mp4"


def progress_text(status: StatusRecord | None) -> str:
    """How far training came, in a few words."""
    if status is None:
        return ""
    parts = []
    if status.iteration is not None and status.iterations is not None:
        parts.append(f"{status.iteration:,} of {status.iterations:,} iterations")
    elif status.blocks_trained is not None and status.iterations is not None:
        parts.append(f"{status.blocks_trained} trained blocks, {status.iterations:,} iterations in all")
    if status.anchors is not None:
        parts.append(f"{status.anchors:,} anchors")
    if status.psnr_training is not None:
        parts.append(f"{status.psnr_training:.2f} dB while training")
    if status.state == "running" and status.seconds_left is not None:
        parts.append(f"about {rough_duration(status.seconds_left)} left")
    elif status.seconds is not None:
        parts.append(f"{status.seconds:,.0f} s")
    return ", ".join(parts)


def _stage_json(stage: StageStatus) -> StageStatusDocument:
    status = stage.status or StatusRecord()
    return {
        "stage": stage.name, "state": stage.state, "reason": stage.reason or None, "folder": stage.folder,
        "iteration": status.iteration, "iterations": status.iterations, "seconds_left": status.seconds_left,
    }  # fmt: skip
