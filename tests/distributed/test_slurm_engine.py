"""What becomes of jobs of SLURM where its controller is busy, a node is unfit, or a person cancels one; no cluster."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed import slurm_commands, slurm_executor
from vdgs.distributed.executor import EXIT_STOPPED, AttemptResult, LogListener, Task, TaskResources, TaskResult
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.scheduler import MAX_NODE_REJECTIONS
from vdgs.distributed.slurm_commands import ArrayTaskId, JobState, QueueEntry, SlurmError, UnreadableAnswerError
from vdgs.distributed.slurm_executor import SlurmExecutor, make_batch_script
from vdgs.distributed.slurm_job import SlurmTaskRecord
from vdgs.errors import VdgsError
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import read_json, write_json


class Controller:
    """SLURM's commands, of which `answers` to sbatch come one by one: words that refuse, or None; and what happens at
    which poll, where jobs end as `ends` says."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        answers: Sequence[str | SlurmError | None],
        at: dict[int, Callable[[], object]],
    ):
        self.answers, self.at, self.polls = list(answers), at, 0
        self.scripts, self.signals = list[Path](), list[tuple[str, str]]()
        self.queue = dict[ArrayTaskId, QueueEntry]()
        self.states = dict[str, str]()
        for name in ("submit", "list_queue", "query_job_state", "signal_batch", "cancel"):
            monkeypatch.setattr(slurm_commands, name, getattr(self, name))

    def submit(self, script: Path) -> str:
        self.scripts.append(script)
        if self.answers and (refusal := self.answers.pop(0)) is not None:
            raise refusal if isinstance(refusal, SlurmError) else SlurmError(f"sbatch: error: {refusal}")
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
TOO_LARGE = "Batch job submission failed: Requested node configuration is not available"


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


UNREADABLE = UnreadableAnswerError("sbatch took it, but its answer has no line with the number: 'Welcome'")


@pytest.mark.parametrize("answer", [BUSY, "Zero Bytes were transmitted or received", UNREADABLE])
def test_a_first_array_that_was_taken_without_a_number_is_found_by_its_name(tmp_path, monkeypatch, answer):
    slurm = Controller(monkeypatch, [answer], {})
    slurm.at = {2: lambda: slurm.take(slurm.scripts[-1]), 5: lambda: slurm.end(1, 0, code=0)}
    assert [each.state for each in run(tmp_path, 1, [])] == ["done"]
    assert len(slurm.scripts) == 1


def test_what_was_taken_and_is_not_found_is_not_submitted_again(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [UNREADABLE], {})
    (result,) = run(tmp_path, 1, [])
    assert result.state == "failed"
    assert "'Welcome'. squeue does not list it either" in result.reason
    assert len(slurm.scripts) == 1


def test_a_driver_that_stops_names_what_slurm_may_have_taken(tmp_path, monkeypatch):
    said = list[str]()
    slurm = Controller(monkeypatch, [UNREADABLE], {3: lambda: signal.raise_signal(signal.SIGTERM)})
    (result,) = run(tmp_path, 1, said)
    assert result.state == "stopped"
    assert f"`scancel --name={slurm.scripts[0].parent.name}` ends them" in said[-1]


@pytest.mark.parametrize(
    ("state", "reason", "said_of"),
    [
        ("PENDING", "JobHeldUser", "scontrol release 1`"), ("REQUEUE_HOLD", "None", "scontrol release 1`"),
        ("PENDING", "PartitionTimeLimit", "--slurm.time"), ("PENDING", "Priority", ""),
    ],
)  # fmt: skip
def test_jobs_that_wait_for_what_time_does_not_bring_are_named_once(tmp_path, monkeypatch, state, reason, said_of):
    said = list[str]()
    slurm = Controller(monkeypatch, [], {})

    def hold() -> None:
        for task_id, entry in slurm.queue.items():
            slurm.queue[task_id] = replace(entry, state=state, reason=reason)

    slurm.at = {3: hold, 6: lambda: slurm.end(1, 0, code=0), 8: lambda: slurm.end(1, 1, code=0)}
    assert [each.state for each in run(tmp_path, 2, said)] == ["done", "done"]
    stuck = [line for line in said if "does not start" in line]
    assert len(stuck) == bool(said_of)
    assert all(line.startswith("SLURM does not start 1_0, 1_1 (") and said_of in line for line in stuck)


def test_a_driver_ends_where_jobs_cannot_be_cancelled_and_names_them(tmp_path, monkeypatch):
    said = list[str]()
    monkeypatch.setattr(slurm_executor, "CANCEL_SECONDS", 0.05)
    monkeypatch.setattr(slurm_executor, "CANCEL_AGAIN_SECONDS", 0.01)
    slurm = Controller(monkeypatch, [], {})

    def hold() -> None:
        (task_id,) = slurm.queue
        slurm.queue[task_id] = replace(slurm.queue[task_id], state="PENDING")

    slurm.at = {2: hold, 4: lambda: signal.raise_signal(signal.SIGTERM)}
    (result,) = run(tmp_path, 1, said)
    assert result.state == "stopped"
    assert said[0] == "stopping: block 00 will leave the queue"
    assert "Try `scancel 1`" in said[-1]
    assert slurm.signals.count(("1_0", "cancel")) > 1  # it is asked again


def test_a_job_that_failed_before_its_first_line_is_quoted(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [], {})

    def fail() -> None:
        folder = slurm.scripts[-1].parent
        (folder / "0.out").write_text("Traceback\nModuleNotFoundError: No module named 'vdgs'\n")
        (folder / "0.json").unlink()
        slurm.queue.clear()

    slurm.at = {2: fail, 20: fail}
    (result,) = run(tmp_path, 1, [])
    assert "before its first line: ModuleNotFoundError: No module named 'vdgs' (" in result.reason
    assert "0.out)" in result.reason


def test_what_slurm_never_takes_fails_alone_and_says_why(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [None, *[TOO_LARGE] * 20], {})
    slurm.at = {3: lambda: slurm.end(1, 0, code=-11), 30: lambda: slurm.end(1, 1, code=0)}
    first, second = run(tmp_path, 2, [])
    assert (first.state, second.state) == ("failed", "done")
    assert first.reason.startswith(f"SLURM does not take it (sbatch: error: {TOO_LARGE}; the script: {tmp_path}")
    assert len(slurm.scripts) == 2  # it is not asked again and again
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


def test_a_block_fails_at_once_where_no_node_is_left_and_names_what_the_last_one_lacks(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [None, None, *[TOO_LARGE] * 20], {})
    slurm.at = {
        3: lambda: slurm.end(1, 0, code=1, unfit="an old vdgs"),
        6: lambda: slurm.end(2, 0, code=1, unfit="there is no /data", node="n2"),
    }
    (result,) = run(tmp_path, 1, [])
    assert result.state == "failed"
    assert "2 nodes that cannot work on the run, at last n2: there is no /data (sbatch: error" in result.reason
    assert len(slurm.scripts) == 3
    assert slurm.polls < 9


def test_not_every_node_of_a_large_cluster_is_tried(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [], {})

    def unfit(turn: int) -> None:
        slurm.end(turn, 0, code=1, unfit="there is no /data", node=f"n{turn}")

    slurm.at = {3 * turn: partial(unfit, turn) for turn in range(1, 100)}
    (result,) = run(tmp_path, 1, [])
    assert result.state == "failed"
    assert len(slurm.scripts) == MAX_NODE_REJECTIONS + 2  # and the attempts that it has
    assert f"n{MAX_NODE_REJECTIONS + 2}: there is no /data" in result.reason


@pytest.mark.parametrize(
    ("said", "is_final"),
    [
        (BUSY, False), ("Unable to contact slurm controller (connect failure)", False),
        ("Batch job submission failed: Zero Bytes were transmitted or received", False),
        ("Slurm temporarily unable to accept job, sleeping and retrying", False), (TOO_LARGE, True),
        ("Batch job submission failed: Job violates accounting/QOS policy (job submit limit, user's size and/or time "
         "limits)", False), ("AssocMaxSubmitJobLimit", False),
        ("Batch job submission failed: Required node not available (down, drained or reserved)", False),
        ("Batch job submission failed: Required partition not available (inactive or drain)", False),
        ("I/O error writing script/output to file", False), ("cannot be run (Cannot allocate memory)", False),
        ("Batch job submission failed: Invalid account or account/partition combination specified", True),
        ("invalid partition specified: gpus", True), ("Memory specification can not be satisfied", True),
    ],
)  # fmt: skip
def test_what_slurm_refuses_for_good_is_told_from_what_may_pass(said, is_final):
    assert SlurmError(f"sbatch: error: {said}").is_final is is_final


def test_a_controller_that_stays_silent_costs_attempts(tmp_path, monkeypatch):
    monkeypatch.setattr(slurm_executor, "MAX_FAILED_POLLS", 3)
    slurm = Controller(monkeypatch, [None, *[BUSY] * 20], {})
    slurm.at = {3: lambda: slurm.end(1, 0, code=-11)}
    (result,) = run(tmp_path, 1, [])
    assert result.reason.startswith(f"crashed 2 times, at last by SLURM, which does not take it (sbatch: error: {BUSY}")


def test_what_slurm_never_took_is_not_cancelled_there(tmp_path, monkeypatch):
    slurm = Controller(monkeypatch, [], {})
    engine = slurm_executor._SlurmEngine(NodeRequirements(tmp_path, []), SlurmOptions(), 1)
    attempt = slurm_executor._SlurmAttempt(ArrayTaskId("", 0), tmp_path, engine)
    attempt.kill()
    assert attempt.poll() == AttemptResult(EXIT_STOPPED)
    assert not slurm.signals


def test_nodes_that_a_person_avoids_are_avoided_too(tmp_path):
    options = SlurmOptions(sbatch_args=("--exclude=n7", "--qos=long"))
    script = make_batch_script(tmp_path / "vdgs-a", 1, TaskResources(1), options, 1, {"n1"})
    assert [line for line in script.splitlines() if "exclude" in line][-1] == "#SBATCH --exclude=n7,n1"
