"""What becomes of jobs of SLURM where its controller is busy, a node is unfit, or a person cancels one; no cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed import slurm_commands, slurm_executor
from vdgs.distributed.executor import LogListener, Task, TaskResources, TaskResult
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.slurm_commands import ArrayTaskId, JobState, QueueEntry, SlurmError
from vdgs.distributed.slurm_executor import SlurmExecutor, make_batch_script
from vdgs.distributed.slurm_job import SlurmTaskRecord
from vdgs.errors import VdgsError
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import read_json, write_json


class Controller:
    """SLURM's commands, of which `answers` to sbatch come one by one: words that refuse, or None; and what happens at
    which poll, where jobs end as `ends` says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answers: list[str | None], at: dict[int, Callable[[], object]]):
        self.answers, self.at, self.polls = answers, at, 0
        self.scripts, self.signals = list[Path](), list[tuple[str, str]]()
        self.queue = dict[ArrayTaskId, QueueEntry]()
        self.states = dict[str, str]()
        for name in ("submit", "list_queue", "query_job_state", "signal_batch", "cancel"):
            monkeypatch.setattr(slurm_commands, name, getattr(self, name))

    def submit(self, script: Path) -> str:
        self.scripts.append(script)
        if self.answers and (refusal := self.answers.pop(0)) is not None:
            raise SlurmError(f"sbatch: error: {refusal}")
        return self.take(script)

    def take(self, script: Path) -> str:
        number = str(len(self.scripts))
        for index in read_json(script.with_name("tasks.json"))["tasks"]:
            task_id = ArrayTaskId(number, int(index))
            self.queue[task_id] = QueueEntry(task_id, "RUNNING", script.parent.name, "n1")
            self.record(task_id)
        return number

    def record(self, task_id: ArrayTaskId, **values: Any) -> None:
        folder = self.scripts[int(task_id.array) - 1].parent
        write_json(folder / f"{task_id.index}.json", asdict(SlurmTaskRecord(node="n1", output_from=0)) | values)

    def end(self, array: int, index: int, **values: Any) -> None:
        """A job leaves the queue; what it wrote, if anything."""
        task_id = ArrayTaskId(str(array), index)
        del self.queue[task_id]
        self.record(task_id, **values)

    def list_queue(self, prefix: str) -> list[QueueEntry]:
        self.polls += 1
        self.at.get(self.polls, lambda: None)()
        return list(self.queue.values())

    def query_job_state(self, task_id: ArrayTaskId) -> JobState:
        return JobState(self.states.get(str(task_id), "FAILED"))

    def signal_batch(self, task_id: ArrayTaskId, name: str) -> None:
        self.signals.append((str(task_id), name))
        self.end(int(task_id.array), task_id.index, code=130)

    def cancel(self, task_id: ArrayTaskId) -> None:
        self.signals.append((str(task_id), "cancel"))


def run(folder: Path, count: int, said: list[str]) -> list[TaskResult]:
    executor = SlurmExecutor(
        max_concurrent=count, poll_seconds=1e-3, requirements=NodeRequirements(folder, []), retries=1
    )
    tasks = [
        Task(name=f"block {index:02d}", command=["train"], output=folder / f"{index}.log", folder=folder / f"b{index}")
        for index in range(count)
    ]  # fmt: skip
    return executor.run(tasks, LogListener(lambda text, _: said.append(text)))


BUSY = "Batch job submission failed: Socket timed out on send/recv operation"


@pytest.mark.parametrize("was_taken", [False, True])
def test_a_busy_controller_is_asked_again_and_the_other_blocks_go_on(tmp_path, monkeypatch, was_taken):
    """Also where it took the job and answered too late."""
    slurm = Controller(monkeypatch, [None, BUSY] if was_taken else [None, BUSY, BUSY], {})
    last = 2 if was_taken else 4
    slurm.at = {
        3: lambda: slurm.end(1, 0, code=-11),
        9: lambda: slurm.end(1, 1, code=0),
        10: lambda: slurm.end(last, 0, code=0),
    }
    if was_taken:
        slurm.at[4] = lambda: slurm.take(slurm.scripts[-1])
    done = run(tmp_path, 2, [])
    assert [(each.state, each.attempts) for each in done] == [("done", 2), ("done", 1)]
    assert len(slurm.scripts) == last
    assert not slurm.signals


def test_what_slurm_never_takes_fails_alone_and_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(slurm_executor, "MAX_FAILED_POLLS", 3)
    slurm = Controller(monkeypatch, [None, *["Requested node configuration is not available"] * 20], {})
    slurm.at = {3: lambda: slurm.end(1, 0, code=-11), 30: lambda: slurm.end(1, 1, code=0)}
    first, second = run(tmp_path, 2, [])
    assert (first.state, second.state) == ("failed", "done")
    assert "SLURM, which does not take it (sbatch: error: Requested node" in first.reason
    with pytest.raises(VdgsError, match="does not take the jobs"):  # nothing is at work that could be lost
        run(tmp_path, 1, [])


def test_a_block_that_is_cancelled_while_it_waits_for_its_next_turn_is_stopped(tmp_path, monkeypatch):
    StageFolder(tmp_path / "b0").set_status(StatusRecord(state="stopped", iteration=500, iterations=1000))
    slurm = Controller(monkeypatch, [], {})
    element = ArrayTaskId("1", 0)

    def time_is_up():
        slurm.record(element, code=130, out_of_time=True, progress=500)
        slurm.queue[element] = QueueEntry(element, "PENDING", slurm.queue[element].name, "")

    def cancelled():
        del slurm.queue[element]
        slurm.states["1_0"] = "CANCELLED"

    slurm.at = {3: time_is_up, 6: cancelled}
    (result,) = run(tmp_path, 1, [])
    assert result.state == "stopped"
    assert "stopped by someone else" in result.reason
    assert len(slurm.scripts) == 1


def test_a_node_that_cannot_work_on_the_run_is_avoided_and_costs_no_attempt(tmp_path, monkeypatch):
    said, unfit = list[str](), {"code": 1, "unfit": "there is no /data"}
    slurm = Controller(monkeypatch, [], {})
    slurm.at = {
        3: lambda: (slurm.end(1, 0, **unfit), slurm.end(1, 1, **unfit)),
        5: lambda: (slurm.end(2, 0, **unfit | {"node": "n2"}), slurm.end(2, 1, code=0)),
        7: lambda: slurm.end(3, 0, code=0),
    }  # fmt: skip
    assert [(each.state, each.attempts) for each in run(tmp_path, 2, said)] == [("done", 1)] * 2
    excluded = [[line for line in file.read_text().splitlines() if "exclude" in line] for file in slurm.scripts]
    assert excluded == [[], ["#SBATCH --exclude=n1"], ["#SBATCH --exclude=n1,n2"]]
    assert any("there is no /data" in line for line in said)


def test_a_node_that_slurm_gives_again_all_the_same_costs_attempts(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [], {})
    slurm.at = {3 * turn: lambda turn=turn: slurm.end(turn, 0, code=1, unfit="an old vdgs") for turn in range(1, 9)}
    (result,) = run(tmp_path, 1, [])
    assert result.state == "failed"
    assert "crashed 2 times, at last by a node that cannot work on the run, n1: an old vdgs" in result.reason


def test_nodes_that_a_person_avoids_are_avoided_too(tmp_path):
    options = SlurmOptions(sbatch_args=("--exclude=n7", "--qos=long"))
    script = make_batch_script(tmp_path / "vdgs-a", 1, TaskResources(1), options, 1, {"n1"})
    assert [line for line in script.splitlines() if "exclude" in line][-1] == "#SBATCH --exclude=n7,n1"
