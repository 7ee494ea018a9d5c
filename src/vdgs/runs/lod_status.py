"""How far the level-of-detail tree of a run is. Imports nothing heavy."""

from __future__ import annotations

from vdgs.model.lod_format import TREE_FILE, is_present_format
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, StageState, StageStatus
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.file_locks import is_known_locked
from vdgs.system.quoting import shell_word


def lod_folder(run: RunFolder) -> StageFolder:
    """Where the tree of a run lies."""
    return StageFolder(run.path / "lod")


def is_of_present_version(run: RunFolder) -> bool:
    """Whether the tree of a run, where there is one, can be read by this version."""
    return is_present_format(lod_folder(run).path / TREE_FILE)


def lod_status(run: RunFolder, status: RunStatus) -> tuple[StageStatus, ...]:
    """The state of the tree, as a stage; none of a run that has no tree and need have none."""
    folder = lod_folder(run)
    if not folder.status_file.exists():
        return ()
    found = folder.status()
    coarse, merged = (status.of(stage).output_id for stage in ("coarse", "merge"))
    state: StageState = "done" if found.state == "done" else "stopped"
    reason = "" if state == "done" else "it continues"
    if state == "done" and found.model_id not in (coarse, merged):
        state, reason = "stale", "made of another model than the run has now"
    elif state == "done" and not is_of_present_version(run):
        state, reason = "stale", "made by another version of vdgs"
    elif state == "stopped" and is_known_locked(folder.path):
        state, reason = "running", ""
    of_coarse = found.model_id == coarse and bool(merged)
    command = f"vdgs lod {shell_word(run.path)}" + (" --model coarse" if of_coarse else "")
    return (StageStatus(name="lod", state=state, folder="lod", reason=reason, status=found, command=command),)
