"""Jobs side by side: each ends as it should, none harms another, and none outlives the one who started it unasked."""

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from support.commands import PATIENCE_SECONDS, wait_until
from support.shard_scripts import job, run
from vdgs.distributed import local_executor
from vdgs.distributed.executor import LogListener, Task, TaskListener, TaskResult
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.distributed.scheduler import stop_message
from vdgs.distributed.shard_runner import ShardCommand
from vdgs.distributed.task_process import PARENT_PID_VARIABLE, stop_when_parent_dies
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.stop_signals import STOP_SIGNALS

FINE = 'tell("done", iteration=10, iterations=10, psnr_training=25.5, anchors=1234)'
#: Runs until asked to stop, then saves until it may end; a second SIGTERM would be noticed.
LONG = """
tell("running", iteration=3, iterations=10)
(folder / "ready").touch()
wait_for((folder / "terms").exists)
wait_for((folder.parent / "may_end").exists)
tell("stopped", iteration=4)
sys.exit(130)
"""


class Told(TaskListener):
    """What it was told, in order."""

    def __init__(self):
        self.news: list[tuple[str, str | int]] = []

    def on_started(self, task: Task, attempt: int) -> None:
        self.news.append((task.name, attempt))

    def on_ended(self, task: Task, outcome: TaskResult) -> None:
        self.news.append((task.name, outcome.state))


@pytest.mark.parametrize("terminal", [False, True])
def test_all_are_done_and_shown(tmp_path, terminal):
    outcomes, text = run([job(tmp_path, i, FINE) for i in (0, 3, 5)], terminal=terminal)
    assert [(o.name, o.state, o.attempts, o.reason) for o in outcomes] == [
        (f"block {i:02d}", "done", 1, "") for i in (0, 3, 5)
    ]
    assert "3 of 3 blocks done" in text
    expected = ("3/3 done", "25.50", "1,234", "100 %") if terminal else ("block 05: started", "block 05: done after")
    assert all(word in text for word in expected)


def test_no_jobs_are_no_trouble():
    assert run([])[0] == []


def test_never_more_than_asked_for_at_once_and_not_fewer(tmp_path):
    script = """
        log = os.open(folder.parent / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.write(log, b"+")
        own, begun = os.lseek(log, 0, os.SEEK_CUR), lambda: os.fstat(log).st_size
        wait_for(lambda: begun() > own or begun() == 6)  # each but the last ends only after another has begun
    """
    told = Told()
    outcomes = LocalExecutor(2, poll_seconds=0.02).run([job(tmp_path, i, script).task() for i in range(6)], told)
    assert [outcome.state for outcome in outcomes] == ["done"] * 6
    steps = [1 if isinstance(news, int) else -1 for _, news in told.news]
    assert max(sum(steps[:end]) for end in range(len(steps) + 1)) == 2


def test_a_crash_is_continued_and_said(tmp_path):
    script = """
        if not (folder / "state").exists():
            (folder / "state").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        print("continued", block)
        tell("done")
    """
    (outcome,), text = run([job(tmp_path, 4, script)])
    assert (outcome.state, outcome.attempts) == ("done", 2)
    assert "block 04: crashed by SIGKILL" in text
    assert "attempt 2" in text
    output = (tmp_path / "04/output.log").read_text()
    assert output.count("--- ") == 2  # both attempts are in the one log
    assert "continued 4" in output


def test_a_crash_that_comes_back_fails_and_leaves_no_running_status(tmp_path):
    script = 'tell("running", iteration=7); print("last words", flush=True); os._exit(77)'
    (outcome,), text = run([job(tmp_path, 0, script)], retries=1)
    assert (outcome.state, outcome.attempts) == ("failed", 2)
    assert "crashed 2 times" in outcome.reason
    assert "exit code 77" in outcome.reason
    assert "last words" in text
    status = StageFolder(tmp_path / "00").status()
    assert (status.state, status.iteration) == ("failed", 7)


def test_an_explained_failure_is_not_repeated_and_stops_no_other(tmp_path):
    failing = (
        'print("starting"); print("vdgs train-blocks: a.jpg: is gone.\\nPut it back.", file=sys.stderr); sys.exit(1)'
    )
    jobs = [job(tmp_path, 0, FINE), job(tmp_path, 1, failing), job(tmp_path, 2, FINE), job(tmp_path, 3, FINE)]
    outcomes, text = run(jobs, at_once=1)
    assert [o.state for o in outcomes] == ["done", "failed", "done", "done"]
    assert (outcomes[1].attempts, outcomes[1].reason) == (1, "a.jpg: is gone.\nPut it back.")
    assert "block 01 failed: a.jpg: is gone." in text
    assert "3 of 4 blocks done" in text
    assert str(jobs[1].output) in text.replace("\n", "")


def test_a_job_that_someone_else_stopped_is_not_started_again(tmp_path):
    (outcome,), _ = run([job(tmp_path, 0, 'print("vdgs train-blocks: Stopped at iteration 9; saved."); sys.exit(130)')])
    assert (outcome.state, outcome.attempts) == ("stopped", 1)
    assert "someone else" in outcome.reason
    assert "iteration 9" in outcome.reason


def test_memory_that_ran_out_lowers_the_number_at_once(tmp_path, monkeypatch):
    kills = iter([5, 6, 6, 6])
    monkeypatch.setattr(local_executor, "oom_kill_count", lambda: next(kills))
    script = """
        if not (folder / "state").exists() and block == 0:
            (folder / "state").touch()
            os.kill(os.getpid(), signal.SIGKILL)
    """
    outcomes, text = run([job(tmp_path, i, script) for i in range(3)])
    assert [o.state for o in outcomes] == ["done"] * 3
    assert "at most 1 at once" in text


def test_each_of_several_that_memory_ended_at_once_is_one_of_those_that_the_system_counts(monkeypatch):
    """Three were killed between two polls, two of them for want of memory."""
    kills = iter([5, 7, 7, 7])
    monkeypatch.setattr(local_executor, "oom_kill_count", lambda: next(kills))
    engine = local_executor._LocalEngine()
    killed = Task(name="block 00", command=["sh", "-c", "kill -9 $$"], output=Path(os.devnull))
    attempts = [attempt for attempt in engine.start([(killed, 1)] * 3) if not isinstance(attempt, OSError)]
    for attempt in attempts:
        attempt._process.wait()
    ends = [attempt.poll() for attempt in attempts]
    assert [(end.code, end.out_of_memory) for end in ends if end] == [(-9, True), (-9, True), (-9, False)]


@pytest.mark.parametrize("content", [b"", b'{"sta', b"\xff\xfe\x00", b"[1, 2]", b"[" * 100_000, b'{"state": 3}'])
def test_a_damaged_status_file_is_no_reason_to_fall(tmp_path, content):
    script = f'(folder / "status.json").write_bytes({content[:50]!r}); os._exit(9)'
    made = job(tmp_path, 0, script)
    made.folder.path.mkdir()
    made.folder.status_file.write_bytes(content)
    (outcome,), _ = run([made], retries=0, terminal=True)
    assert outcome.state == "failed"
    assert "exit code 9" in outcome.reason


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "blocks").write_text("a file where a folder should be")
    outcomes, _ = run([job(tmp_path / "blocks", 0, FINE), job(tmp_path, 1, FINE)])
    assert [o.state for o in outcomes] == ["failed", "done"]
    assert str(tmp_path / "blocks/00") in outcomes[0].reason
    assert "Not a directory" in outcomes[0].reason
    assert "run the same command again" in outcomes[0].reason


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_named(tmp_path):
    made = job(tmp_path, 0, FINE)
    made.folder.path.mkdir()
    made.output.symlink_to("/dev/full")
    (outcome,), _ = run([made])
    assert outcome.state == "failed"
    assert "No space left on device" in outcome.reason
    assert str(made.output) in outcome.reason


def test_a_command_that_is_not_there_is_named(tmp_path):
    (outcome,), _ = run([ShardCommand(0, StageFolder(tmp_path), ["/nowhere/python"])])
    assert outcome.state == "failed"
    assert "/nowhere/python" in outcome.reason


def test_a_folder_that_another_process_holds_is_waited_for(tmp_path):
    made, said = job(tmp_path, 0, FINE), []

    class Holding(LogListener):
        """Lets go of the folder once it hears that it is waited for."""

        def on_waiting(self, task: Task) -> None:
            super().on_waiting(task)
            lock.close()

    with ExitStack() as lock:
        lock.enter_context(made.folder.locked())
        (outcome,) = LocalExecutor(1, poll_seconds=0.02).run([made.task()], Holding(lambda text, _: said.append(text)))
    assert outcome.state == "done"
    assert "waiting for another process" in said[0]


def task(root: Path, name: str, script: str, after: str | None = None) -> Task:
    return Task(
        name=name,
        command=[sys.executable, "-S", "-c", script],
        output=root / f"{name}.log",
        environment={"WHO": name},
        after=after,
    )


def test_a_failed_task_stops_only_those_that_come_after_it(tmp_path):
    tasks = [
        task(tmp_path, "a", "import sys; print('vdgs bench: no such place', file=sys.stderr); sys.exit(1)"),
        task(tmp_path, "b", "print('never')", after="a"),
        task(tmp_path, "c", "print('fine')"),
        task(tmp_path, "d", "print('never')", after="b"),
    ]
    told = Told()
    outcomes = LocalExecutor(1, poll_seconds=0.02).run(tasks, told)
    assert [(o.name, o.state, o.attempts) for o in outcomes] == [
        ("a", "failed", 1), ("b", "failed", 0), ("c", "done", 1), ("d", "failed", 0)
    ]  # fmt: skip
    assert [o.reason for o in outcomes[:2]] == ["no such place", "a failed: no such place"]
    assert told.news == [("a", 1), ("a", "failed"), ("b", "failed"), ("c", 1), ("d", "failed"), ("c", "done")]


def test_a_task_waits_for_the_one_that_it_comes_after(tmp_path):
    """However often that one crashes on its way, and whatever was done before this call."""
    crash = "import os, pathlib, time; seen = pathlib.Path('{0}'); first = not seen.exists(); seen.touch()\n"
    crash += "time.sleep(0.1)\nif first: os.kill(os.getpid(), 9)"
    tasks = [
        task(tmp_path, "second", "print('after')", after="first"),
        task(tmp_path, "first", crash.format(tmp_path / "seen")),
        task(tmp_path, "third", "import os; print('alone', os.environ['WHO'])", after="one of an earlier call"),
    ]
    told = Told()
    outcomes = LocalExecutor(3, poll_seconds=0.02).run(tasks, told)
    assert [o.state for o in outcomes] == ["done"] * 3
    assert "alone third" in tasks[2].output.read_text()
    assert [each for each in told.news if each[0] != "third"] == [
        ("first", 1), ("first", 2), ("first", "done"), ("second", 1), ("second", "done")
    ]  # fmt: skip


#: Runs jobs; every look at them leaves a dot in a file.
DRIVER = """
import json, sys
from pathlib import Path
from rich.console import Console
from vdgs.distributed.shard_runner import ShardCommand, run_shards
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.runs.stage_folder import StageFolder

class Counted(LocalExecutor):
    def run(self, tasks, listener):
        on_tick = listener.on_tick
        def counted():
            on_tick()
            with open(sys.argv[2], "a") as looks: looks.write(".")
        listener.on_tick = counted
        return super().run(tasks, listener)

jobs = [
    ShardCommand(index, StageFolder(Path(folder)), command) for index, folder, command in json.loads(sys.argv[1])
]
outcomes = run_shards(jobs, Counted(2, poll_seconds=0.02), Console())
print("OUTCOMES", json.dumps([[o.state, o.attempts, o.reason, o.was_killed] for o in outcomes]))
"""


class Driver:
    """A process that runs jobs; begins once the first two say that they are ready."""

    def __init__(self, jobs: list[ShardCommand], root: Path):
        self._looks, self._root = root / "looks", root
        argument = json.dumps([[made.index, str(made.folder.path), made.command] for made in jobs])
        command = [sys.executable, "-c", DRIVER, argument, str(self._looks)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        for made in jobs[:2]:
            wait_until(lambda made=made: (made.folder.path / "ready").exists() or self.process.poll() is not None)
        assert self.process.poll() is None

    def send_signal(self, number: signal.Signals) -> None:
        """Returns when the driver has looked at its jobs since."""
        wait_until(lambda: self._looks.exists() or self.process.poll() is not None)
        self.process.send_signal(number)
        before = self._looks.stat().st_size
        wait_until(lambda: self._looks.stat().st_size >= before + 2 or self.process.poll() is not None)

    def let_jobs_end(self) -> None:
        (self._root / "may_end").touch()

    def outcomes(self) -> list:
        text, _ = self.process.communicate(timeout=PATIENCE_SECONDS)
        assert self.process.returncode == 0
        line = next(line for line in text.splitlines() if line.startswith("OUTCOMES"))
        return json.loads(line.removeprefix("OUTCOMES"))


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_request_to_stop_reaches_each_job_once(tmp_path, number):
    jobs = [job(tmp_path, i, LONG) for i in range(3)]
    driver = Driver(jobs, tmp_path)
    driver.send_signal(number)
    if number != signal.SIGINT:
        driver.send_signal(number)  # a scheduler that asks twice: still once, and no kill
    driver.let_jobs_end()
    assert [o[:2] for o in driver.outcomes()] == [["stopped", 1], ["stopped", 1], ["stopped", 0]]
    assert [made.folder.status().state for made in jobs[:2]] == ["stopped"] * 2
    assert [(made.folder.path / "terms").read_text() for made in jobs[:2]] == ["TERM "] * 2
    assert not jobs[2].folder.path.exists() or not jobs[2].output.exists()


def test_what_was_killed_is_not_called_saved():
    done = [TaskResult(name="block 00", state="stopped", attempts=1), TaskResult(name="block 01", state="done")]
    assert stop_message(done, "every block") == "Stopped; every block is saved. The same command continues."
    killed = [TaskResult(name="block 02", state="stopped", attempts=1, was_killed=True)]
    assert stop_message([*done, *killed], "every block").startswith("Stopped; ended before it could save: block 02. ")


def test_a_second_interrupt_kills(tmp_path):
    jobs = [job(tmp_path, i, LONG) for i in range(2)]  # they may not end
    driver = Driver(jobs, tmp_path)
    for _ in range(2):
        driver.send_signal(signal.SIGINT)
    outcomes = driver.outcomes()
    assert [o[0] for o in outcomes] == ["stopped", "stopped"]
    assert all("SIGKILL" in o[2] and o[3] for o in outcomes)
    assert jobs[0].folder.status().state == "stopped"  # it could not write that itself


def test_a_job_ends_with_a_driver_that_was_killed(tmp_path):
    watched = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from vdgs.distributed.task_process import stop_when_parent_dies\nstop_when_parent_dies(0.05)\n" + LONG
    )
    source = str(Path(local_executor.__file__).parents[2])
    jobs = [job(tmp_path, i, watched) for i in range(2)]
    for made in jobs:
        made.command.append(source)
    driver = Driver(jobs, tmp_path)
    driver.process.kill()
    driver.process.communicate()
    driver.let_jobs_end()
    for made in jobs:
        wait_until(lambda made=made: made.folder.status().state == "stopped")
        assert (made.folder.path / "terms").read_text() == "TERM "


def test_a_process_without_a_driver_is_not_watched(monkeypatch):
    monkeypatch.delenv(PARENT_PID_VARIABLE, raising=False)
    assert stop_when_parent_dies() is None
    monkeypatch.setenv(PARENT_PID_VARIABLE, "no number")
    assert stop_when_parent_dies() is None
    monkeypatch.setenv(PARENT_PID_VARIABLE, str(os.getppid()))
    watch = stop_when_parent_dies(1e6)  # it goes on as long as this process
    assert watch is not None
    assert watch.is_alive()
    assert PARENT_PID_VARIABLE not in os.environ  # what this process starts has another parent
