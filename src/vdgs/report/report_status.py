"""Whether the report of a run is there and up to date. Imports nothing heavy."""

from __future__ import annotations

from vdgs.runs.run_folder import REPORT_FILE, RunFolder
from vdgs.runs.run_status import RunStatus, StageStatus

#: Name of the meta element with the status of the run that the page shows; it stands within so many characters.
STATUS_META_NAME, MAX_HEAD_CHARS = "vdgs-status", 2000


def report_status(run: RunFolder, status: RunStatus) -> StageStatus:
    """Whether the report is there and shows the run as it stands."""
    try:
        with (run.path / REPORT_FILE).open(encoding="utf-8", errors="replace") as file:
            head = file.read(MAX_HEAD_CHARS)
    except OSError:
        return StageStatus(name="report", state="missing", folder=REPORT_FILE)
    if f'<meta name="{STATUS_META_NAME}" content="{status.digest}">' in head:
        return StageStatus(name="report", state="done", folder=REPORT_FILE)
    return StageStatus(name="report", state="stale", folder=REPORT_FILE, reason="the run went on since it was written")
