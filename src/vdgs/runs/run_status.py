"""How far a run is: the state of every stage and block, and whether it was made with the settings the run has now.

Everything that shows results of a run, builds on them or advises what to do next uses this module.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from vdgs.errors import VdgsError
from vdgs.partition.block_records import PartitionRecord
from vdgs.runs.config_file import run_command
from vdgs.runs.model_integrity import integrity_error, path_to_delete, unreadable_text
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.runs.stage_keys import StageKeys
from vdgs.system.atomic_files import read_json_or_empty
from vdgs.system.file_locks import is_known_locked
from vdgs.system.quoting import shell_word
from vdgs.system.step_progress import StepRecord, read_step

#: `stale`: made with other settings, for another cut or from another model than the run has now. `unknown`: something
#: is there, and no record says with which settings it was made.
StageState = Literal["done", "running", "queued", "stopped", "failed", "stale", "missing", "unknown"]

#: Why a result is stale, in words that end a sentence about it.
OTHER_SETTINGS = "made with other settings than the run has now"
OTHER_PARTITION = "trained for another cut or with other settings than the run has now"
OTHER_BLOCKS = "its blocks are not those that it was merged from"
OTHER_MODEL = "measured with another model than the run has now"


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """How far one stage of a run, or one of its blocks, is."""

    name: str
    state: StageState
    folder: str
    """Its output, relative to the run."""
    reason: str = ""
    """One line, or empty."""
    status: StatusRecord | None = None
    """Its status file, where it trains or merges."""
    output_id: str = ""
    """The identity of its output."""
    hint: str = ""
    """What must be done before the command of the stage, as the beginning of a shell command."""
    command: str = ""
    """The command that makes the stage, where no verb makes this stage alone."""
    step: StepRecord | None = None
    """The progress of the step in which the stage is, or was stopped."""
    problem: str = ""
    """Why its output cannot be read, which says nothing against it (a permission, a disk that is away), and what to
    do."""

    @property
    def recorded_state(self) -> StageState:
        """The state by its record alone, whether or not its output can be read now: what was made of that is judged by
        this."""
        return "done" if self.problem else self.state


@dataclass(frozen=True)
class RunStatus:
    """How far a run is."""

    path: Path
    stages: tuple[StageStatus, ...]
    """In the order in which they are made."""
    command: str | None = None
    """The command that began the run, where its settings are still those that it asked for."""
    written_command: str = ""
    """One with the settings of the run in full."""
    is_driven: bool = False
    """A command takes it from stage to stage."""
    problem: str = ""
    """What to mend by hand before any command is of use."""

    def of(self, name: str) -> StageStatus:
        """A stage by its name: coarse, coarse evaluation, visibility, partition, cameras, block N, merge, evaluation.

        Raises KeyError for a name that there is not.
        """
        return {stage.name: stage for stage in self.stages}[name]

    @property
    def blocks(self) -> list[StageStatus]:
        return [stage for stage in self.stages if stage.name.startswith("block ")]

    @property
    def is_complete(self) -> bool:
        """Every stage is done, with the settings of the run."""
        return all(stage.state == "done" for stage in self.stages)

    @property
    def is_running(self) -> bool:
        return self.is_driven or any(stage.state == "running" for stage in self.stages)

    @property
    def digest(self) -> str:
        """A digest of this status: a report of it is out of date once it differs."""
        content = [[stage.name, stage.recorded_state, stage.output_id] for stage in self.stages]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]

    def next_command(self) -> str:
        """What to type next, as a shell takes it; empty while something runs, where all is done, and where something is
        to be mended by hand."""
        if self.is_running or self.problem:
            return ""
        for stage in self.stages:
            if stage.state != "done":
                if self._continues and not stage.hint:
                    return stage.command or self.command or ""
                return stage.hint + (stage.command or self._command_for(stage.name))
        return ""

    @property
    def _continues(self) -> bool:
        """The command that began the run takes it to its end: it is for all stages, and for the settings of the run."""
        reasons = {stage.reason for stage in self.stages if stage.state == "stale"}
        return (self.command or "").startswith("vdgs run ") and not reasons & {OTHER_SETTINGS, OTHER_PARTITION}

    def _command_for(self, stage: str) -> str:
        run = shell_word(self.path)
        if stage == "coarse":
            return self.command or self.written_command
        verbs = {
            "visibility": f"visibility {run}", "partition": f"partition {run}", "cameras": f"partition {run}",
            "merge": f"merge {run}", "coarse evaluation": f"eval {run} --model coarse", "evaluation": f"eval {run}",
            "report": f"report {run}",
        }  # fmt: skip
        return f"vdgs {verbs.get(stage, f'train-blocks {run}')}"


def get_run_status(run: RunFolder, settings: RunSettings | None = None) -> RunStatus:
    """How far a run is, for its settings or for others. Reads only and never fails: what is damaged is `unknown`, with
    the reason."""
    keys, why, problem = None, "", ""
    try:
        settings = run.settings() if settings is None else settings
        keys = run.keys(settings)
    except VdgsError as error:
        why = _first_line(str(error))
        problem = why if settings else f"correct {run.config_file}, or put back the one that was there: {why}"
    command, driven = run.config.command(), run.is_running()
    stages = tuple(_StatusScanner(run, keys, why).stages())
    if driven and (step := read_step(run.progress_file)) is not None:
        stages = tuple(_at_work(stage, step) if stage.name == step.stage else stage for stage in stages)
    written = "" if why or command else run_command(run.settings(), run.path)
    problem = problem or next((stage.problem for stage in stages if stage.problem), "")
    return RunStatus(run.path, stages, command, written, driven, problem)


def _at_work(stage: StageStatus, step: StepRecord) -> StageStatus:
    """The stage, which the process that drives the run has recorded as its work."""
    if stage.state in ("running", "done"):  # it says more itself
        return stage
    return replace(stage, state="running", reason="", step=step)


@dataclass(frozen=True)
class _StatusScanner:
    """Reads the status of a run; `keys` is None where the settings cannot be read."""

    run: RunFolder
    keys: StageKeys | None
    why_unknown: str

    def stages(self) -> Iterator[StageStatus]:
        run = self.run
        coarse = self._trained("coarse", run.coarse, self._key("coarse"), OTHER_SETTINGS, run.path)
        yield coarse
        yield self._visibility()
        yield self._measured("coarse evaluation", run.coarse.path / "evaluation", coarse)
        yield from self._cut()
        blocks = [
            self._trained(f"block {int(folder.path.name)}", folder, self._key("blocks"), OTHER_PARTITION, folder.path)
            for folder in self._block_folders()
        ]
        yield from blocks
        merged = self._merged(blocks)
        yield merged
        yield self._measured("evaluation", run.evaluation, merged)

    def _key(self, stage: str) -> str | None:
        return None if self.keys is None else str(getattr(self.keys, stage))

    def _judged(
        self, name: str, folder: Path, there: bool, found: object, wanted: object, made: str, why: str = OTHER_SETTINGS
    ) -> StageStatus:
        """A stage by the key in its record (`found`, None where there is none) and the key that it should have."""
        state: StageState
        if not there:
            state, why = "missing", ""
        elif self.keys is None:
            state, why = "unknown", self.why_unknown
        elif found is None:
            state, why = "unknown", "nothing says with which settings it was made"
        elif found != wanted:
            state = "stale"
        else:
            state, why = "done", ""
        return StageStatus(name=name, state=state, folder=self._inside(folder), reason=why, output_id=made)

    def _inside(self, folder: Path) -> str:
        return folder.relative_to(self.run.path).as_posix()

    def _visibility(self) -> StageStatus:
        file = self.run.visibility / "visibility.json"
        found = read_json_or_empty(file).get("key")
        wanted = self._key("visibility")
        return self._judged("visibility", file.parent, file.exists(), found, wanted, str(found))

    def _record(self) -> PartitionRecord:
        try:
            return self.run.partition_record()
        except VdgsError:
            return PartitionRecord()

    def _cut(self) -> Iterator[StageStatus]:
        folder, record = self.run.partition, self._record()
        there = (folder / "partition.json").exists()
        key, assignment_key = record.key, record.assignment_key
        yield self._judged("partition", folder, there, key, self._key("partition"), str(key))
        yield self._judged("cameras", folder, there, assignment_key, self._key("assignment"), str(assignment_key))

    def _block_folders(self) -> list[StageFolder]:
        """The folders of the blocks of the present partition, begun or not, and those that are there."""
        count, keys, record = 0, self.keys, self._record()
        if keys is not None and (record.key, record.assignment_key) == (keys.partition, keys.assignment):
            count = len(record.blocks)
        there = {int(folder.path.name): folder for folder in self.run.block_folders()}
        return [there.get(index, self.run.block(index)) for index in sorted({*there, *range(count)})]

    def _trained(self, name: str, folder: StageFolder, key: str | None, other: str, locked: Path) -> StageStatus:
        inside = self._inside(folder.path)
        try:
            status = folder.status()
        except VdgsError as error:
            hint = f"rm {shell_word(folder.status_file)} && "
            return StageStatus(name=name, state="unknown", folder=inside, reason=_first_line(str(error)), hint=hint)
        state, why = self._state_of(folder, status, key, other, locked)
        output_id = status.model_id or ""
        try:
            wrong = integrity_error(folder, key or "", _number(name)) if state == "done" else ""
            hint = f"rm -r {shell_word(path_to_delete(folder))} && " if wrong else ""
        except OSError as error:
            return StageStatus(
                name=name, state="unknown", folder=inside, status=status, output_id=output_id,
                reason=f"{folder.model.name} cannot be read ({error.strerror})",
                problem=unreadable_text(folder, error),
            )  # fmt: skip
        if wrong:
            reason = f"model.safetensors is {wrong}"
            return StageStatus(name=name, state="stale", folder=inside, reason=reason, status=status, hint=hint)
        return StageStatus(name=name, state=state, folder=inside, reason=why, status=status, output_id=output_id)

    def _state_of(
        self, folder: StageFolder, status: StatusRecord, key: str | None, other: str, locked: Path
    ) -> tuple[StageState, str]:
        if status.state == "new" and not folder.has_output():
            return "missing", ""
        if self.keys is None:
            return "unknown", self.why_unknown
        if folder.key() != key:
            return "stale", other
        if status.state == "done" and not folder.model.exists():
            return "missing", f"{folder.model.name} is gone"
        if status.state == "done":
            return "done", status.reason or ""
        if status.state == "running" and not is_known_locked(locked):
            return "stopped", "its process ended without a word; it continues from its last checkpoint"
        if status.state in ("running", "queued", "stopped", "failed"):
            return status.state, _first_line(status.reason or "")  # type: ignore[return-value]
        return "stopped", "it has a checkpoint, and says nothing of itself"

    def _merged(self, blocks: list[StageStatus]) -> StageStatus:
        merged = self.run.merged
        found = self._trained("merge", merged, self._key("merge"), OTHER_SETTINGS, self.run.path)
        if found.state != "done" or found.status is None:
            return found
        models = tuple(
            (b.status.model_id if b.status else None) if b.recorded_state == "done" else None for b in blocks
        )
        stands_in = [block.name for block, model in zip(blocks, models, strict=True) if model is None]
        if found.status.block_models != models:
            return replace(found, state="stale", reason=OTHER_BLOCKS)
        return replace(found, reason=f"the coarse model stands in for {', '.join(stands_in)}" if stands_in else "")

    def _measured(self, name: str, folder: Path, model: StageStatus) -> StageStatus:
        """The figures of a model: they are out of date where the model is."""
        there = bool(read_json_or_empty(folder / "metrics.json"))
        record = read_json_or_empty(folder / "status.json")
        made = json.dumps([record.get(each) for each in ("model", "lpips_weights", "bins")])
        found = record.get("model")
        known = model.output_id if model.recorded_state == "done" else ""
        return self._judged(name, folder, there, found, known or None, made, OTHER_MODEL)


def _number(name: str) -> int | None:
    """The index of a block, from the name of its stage."""
    return int(name.split()[1]) if name.startswith("block ") else None


def _first_line(text: str) -> str:
    return text.strip().splitlines()[0] if text.strip() else ""
