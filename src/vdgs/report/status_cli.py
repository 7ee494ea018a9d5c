"""`vdgs status`: how far a run is, in lines for people and as plain values for programs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from vdgs.captures.place_record import PlaceFacts, place_summary
from vdgs.captures.reconstruction import PROGRESS_FILE, SFM_STAGE, WORK_FOLDER, is_finished
from vdgs.errors import VdgsError
from vdgs.report.report_status import report_status
from vdgs.runs.lod_status import lod_status
from vdgs.runs.run_folder import PLACE_FILE, REPORT_FILE, RunFolder
from vdgs.runs.run_inputs import input_changes
from vdgs.runs.run_status import RunStatus, StageState, StageStatus, get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.sfm.source_images import SourceImages, source_changes
from vdgs.system.atomic_files import read_json_or_empty, to_jsonable
from vdgs.system.documents import RunStatusDocument, StageStatusDocument
from vdgs.system.quoting import shell_line
from vdgs.system.records import record_from_dict, record_to_dict
from vdgs.system.step_progress import read_step
from vdgs.system.units import rough_duration

#: Exit code of `vdgs status` for a run that is not whole: something of it is missing, runs, failed or is out of date.
EXIT_INCOMPLETE = 3
#: What a capture is called where it is not made of photographs by the run, and changed.
CAPTURE_STAGE = "capture"
STATE_STYLES = {
    "done": "green", "running": "cyan", "queued": "dim", "stopped": "yellow", "failed": "red", "stale": "yellow",
    "missing": "dim", "unknown": "yellow",
}  # fmt: skip


def full_run_status(run: RunFolder) -> RunStatus:
    """How far a run is, its photographs and its report included. Raises RunError for a folder that holds no run."""
    photographs = _photographs_status(run)
    if not run.config_file.exists() and photographs is None:
        run.settings()  # which says that there is none
    status = get_run_status(run)
    if photographs is None:
        photographs = _capture_status(run)
    elif not run.config_file.exists():  # it is written once there is a capture
        status = replace(status, problem="", command=photographs.command)
    before = () if photographs is None else (photographs,)
    return replace(status, stages=(*before, *status.stages, *lod_status(run, status), report_status(run, status)))


def _photographs_status(run: RunFolder) -> StageStatus | None:
    """How far the capture is that a run makes of its photographs; None for a run of another capture."""
    root = run.own_capture
    sources = SourceImages.read(root)
    if sources is None or (run.config_file.exists() and not _is_capture_of(run, root)):
        return None
    alone = shell_line(["vdgs", "sfm", *sources.folders, "--output", str(root.resolve())])
    command = sources.command or alone
    changes = "; ".join(filter(None, (source_changes(root), input_changes(run, of_photographs=True))))
    stage = StageStatus(name=SFM_STAGE, state="done", folder=root.name, command=command)
    if not is_finished(root):
        step = read_step(root / WORK_FOLDER / PROGRESS_FILE)
        state: StageState = "running" if run.is_running() else "stopped"
        stage = replace(stage, state=state, step=step)
    if changes and stage.state != "running":
        stage = replace(stage, state="stale", reason=changes, command=f"{command} --overwrite")
    return stage


def _capture_status(run: RunFolder) -> StageStatus | None:
    """That the capture of a run, or a table that its command names, changed since; None where nothing did. The command
    that began the run says more, and goes on where no result depends on it."""
    changes = input_changes(run, of_photographs=False)
    if not changes:
        return None
    return StageStatus(name=CAPTURE_STAGE, state="stale", folder=".", reason=changes)


def _is_capture_of(run: RunFolder, root: Path) -> bool:
    try:
        return Path(run.settings().capture_path).resolve() == root.resolve()
    except VdgsError:  # then nothing says that it is another one
        return True


def print_status(run: RunFolder, console: Console) -> int:
    """Say how far every stage and block is and what to type next; 0 if the run is whole, else `EXIT_INCOMPLETE`."""
    status, place = full_run_status(run), _place(run)
    if place is not None:
        console.print(escape(place_summary(place)), highlight=False)
    width = max(len(stage.name) for stage in status.stages)
    for stage in status.stages:
        step = stage.step.text(stage.state == "running") if stage.step is not None else ""
        note = "; ".join(part for part in (progress_text(stage.status), step, stage.reason) if part)
        state = f"[{STATE_STYLES[stage.state]}]{stage.state:<8}[/]"
        console.print(f"{stage.name:<{width}}  {state}  {escape(note)}".rstrip(), highlight=False)
    counted = Counter(stage.state for stage in status.stages)
    console.print(", ".join(f"{count} {state}" for state, count in counted.items()), highlight=False)
    if status.is_complete:
        console.print(escape(f"report: {status.path / REPORT_FILE}"), highlight=False)
    missing = "" if status.is_running else _missing_capture(run)
    console.print(escape(f"to mend: {missing}" if missing else next_line(status)), highlight=False)
    return 0 if status.is_complete else EXIT_INCOMPLETE


def status_json(run: RunFolder) -> RunStatusDocument:
    """The same for programs."""
    status, place = full_run_status(run), _place(run)
    missing = "" if status.is_running else _missing_capture(run)
    return {
        "run": str(run.path), "place": None if place is None else to_jsonable(record_to_dict(place)),
        "complete": status.is_complete, "running": status.is_running,
        "next_command": (not missing and status.next_command()) or None, "problem": missing or status.problem or None,
        "stages": [_stage_json(stage) for stage in status.stages],
    }  # fmt: skip


def _missing_capture(run: RunFolder) -> str:
    """That the capture of the run is not there, and what to do; empty where it is, or where nothing says which."""
    try:
        return run.missing_capture()
    except VdgsError:  # no settings yet, or damaged ones
        return ""


def _place(run: RunFolder) -> PlaceFacts | None:
    """The facts of the place, as the report begins with them; None where the run has none."""
    try:
        return record_from_dict(PlaceFacts, read_json_or_empty(run.path / PLACE_FILE))
    except ValueError:  # none, or damaged
        return None


def next_line(status: RunStatus) -> str:
    """What a person does next. What follows `next: ` is a command that a shell takes as it stands."""
    if command := status.next_command():
        return f"next: {command}"
    if status.is_running:
        return "at work: nothing to type"
    if status.problem or not status.is_complete:
        return f"to mend: {status.problem or 'see above'}"
    return f"next: {shell_line(['vdgs', 'view', status.path])}"


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
    status, step = stage.status or StatusRecord(), stage.step
    if step is not None:
        status = StatusRecord(iteration=step.done, iterations=step.total or None)
    left = step.seconds_left if step is not None and stage.state == "running" else status.seconds_left
    return {
        "stage": stage.name, "state": stage.state, "reason": stage.reason or None, "folder": stage.folder,
        "step": step.step if step is not None else None, "iteration": status.iteration,
        "iterations": status.iterations, "seconds_left": left,
    }  # fmt: skip
