"""What becomes of tasks whatever engine begins them, on an engine that does what a test says."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.captures import tiny_scene, write_colmap
from vdgs.cli import run_cmd
from vdgs.config.executor_options import ExecutorOptions, SlurmOptions
from vdgs.config.presets import PRESETS
from vdgs.distributed import node_check
from vdgs.distributed.backend_selection import select_backend
from vdgs.distributed.executor import AttemptResult, AttemptStarted, LogListener, Task, TaskListener, TaskResources
from vdgs.distributed.node_check import NodeRequirements, check_node
from vdgs.distributed.resource_allocation import (
    MachineResources,
    ShardWorkload,
    allocate_cluster,
    allocate_local,
    allocate_queue,
    exceeds_memory,
)
from vdgs.distributed.scheduler import ExecutionPolicy, run_tasks
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.memory_estimate import block_workload, decoded_image_bytes, estimate_memory

GB = 10**9
SAVED = AttemptResult(130, out_of_time=True)


class Scripted:
    """An engine whose attempts end as a list says, one after the other; it remembers what they asked for."""

    def __init__(
        self, ends: list[AttemptResult | OSError], max_memory_bytes: int | None = None, there: tuple[str, ...] = ()
    ):
        self.max_memory_bytes, self._ends, self._there = max_memory_bytes, list(ends), there
        self.asked: list[tuple[str, int, TaskResources]] = []

    def start(self, tasks):
        self.asked += [(task.name, attempt, task.resources) for task, attempt in tasks]
        return [self._next() for _ in tasks]

    def find_running(self, task):
        return self._next() if task.name in self._there else None

    def refresh(self):
        pass

    def _next(self):
        end = self._ends.pop(0)
        return end if isinstance(end, OSError) else Attempt(end)


@dataclass
class Attempt:
    end: AttemptResult
    start_info: AttemptStarted | None = field(default_factory=lambda: AttemptStarted(0, "node-7"))

    def poll(self) -> AttemptResult:
        return self.end

    def request_stop(self) -> None:
        raise AssertionError("nobody asked")

    kill = request_stop


class Heard(LogListener):
    """All that is said of the tasks."""

    def __init__(self):
        self.lines: list[str] = []
        super().__init__(lambda text, _: self.lines.append(text))

    def on_placed(self, task: Task, where: str, resumed: bool) -> None:
        self.lines.append(f"{task.name} on {where}" + (" again" if resumed else ""))


def run(folder: Path, engine: Scripted, task: Task | None = None, retries: int = 2):
    heard = Heard()
    task = task or Task(
        name="block 00", command=["train"], output=folder / "output.log", resources=TaskResources(1, 4 * GB)
    )
    (outcome,) = run_tasks([task], engine, ExecutionPolicy(1, retries, 1e-6), heard)
    return outcome, heard.lines


def test_memory_that_ran_out_is_asked_for_up_to_what_the_largest_node_has(tmp_path):
    killed = AttemptResult(-9, out_of_memory=True)
    engine = Scripted([killed, killed, killed], max_memory_bytes=7 * GB)
    outcome, lines = run(tmp_path, engine)
    assert [needs.memory_bytes for _, _, needs in engine.asked] == [4 * GB, 6 * GB, 7 * GB]
    assert (outcome.state, outcome.attempts) == ("failed", 3)
    assert "crashed by SIGKILL (out of memory; it asks for 6.00 GB now)" in lines[1]
    assert "no node has more than the 7.00 GB" in outcome.reason


def test_a_lost_place_is_worded_and_the_task_tried_a_bounded_number_of_times(tmp_path):
    lost = AttemptResult(None, "the loss of its node node-7")
    outcome, lines = run(tmp_path, Scripted([lost, AttemptResult(0)]))
    assert (outcome.state, outcome.attempts) == ("done", 2)
    assert lines[1].startswith("block 00: crashed by the loss of its node node-7; continues from its last checkpoint")
    outcome, _ = run(tmp_path, Scripted([lost] * 3))
    assert (outcome.state, outcome.attempts) == ("failed", 3)
    assert outcome.reason.startswith("crashed 3 times, at last by the loss of its node node-7")


def test_a_time_limit_costs_no_attempt_as_long_as_the_task_gets_further(tmp_path):
    folder = StageFolder(tmp_path / "00")
    folder.path.mkdir()

    class Further(Scripted):
        def start(self, tasks):
            folder.set_status(StatusRecord(state="running", iteration=10 * min(len(self.asked) + 1, 6)))
            return super().start(tasks)

    task = Task(name="block 00", command=["train"], output=tmp_path / "output.log", folder=folder.path)
    engine = Further([SAVED] * 5 + [AttemptResult(0)])
    outcome, lines = run(tmp_path, engine, task, retries=0)
    assert (outcome.state, outcome.attempts) == ("done", 1)
    assert sum("saved and waits for another turn" in line for line in lines) == 5
    outcome, _ = run(tmp_path, Further([SAVED] * 9), task, retries=1)
    assert outcome.state == "failed"
    assert "its time limit, before it got any further" in outcome.reason


def test_what_an_earlier_driver_began_is_watched_and_not_begun_again(tmp_path):
    engine = Scripted([AttemptResult(0)], there=("block 00",))
    outcome, lines = run(tmp_path, engine)
    assert (outcome.state, engine.asked) == ("done", [])
    assert lines == ["block 00 on node-7 again"]


def test_a_card_has_no_more_tasks_at_once_than_it_has_room_for(tmp_path):
    """Those of one card end sooner than those of the other."""
    begun, most = dict[str, int](), dict[str, int]()

    class Working(Attempt):
        def __init__(self, card: str):
            super().__init__(AttemptResult(0))
            self.card, self.polls = card, 9 if card == "cuda:0" else 1
            begun[card] = begun.get(card, 0) + 1
            most[card] = max(begun[card], most.get(card, 0))

        def poll(self):
            self.polls -= 1
            begun[self.card] -= self.polls == 0
            return self.end if self.polls == 0 else None

    class Cards(Scripted):
        def start(self, tasks):
            return [Working(task.resources.device) for task, _ in tasks]

    tasks = [
        Task(name=str(place), command=["train"], output=tmp_path, resources=TaskResources(device=f"cuda:{place % 2}"))
        for place in range(8)
    ]
    for each in (1, 2):
        policy = ExecutionPolicy(2 * each, poll_seconds=1e-6, max_per_device=each)
        assert [found.state for found in run_tasks(tasks, Cards([]), policy, TaskListener())] == ["done"] * 8
        assert most == dict.fromkeys(("cuda:0", "cuda:1"), each)


@pytest.mark.parametrize(("at_once", "cards"), [(1, ("", "")), (2, ("", "")), (2, ("cuda:0", "cuda:1"))])
def test_what_another_command_works_on_is_begun_after_all_else(tmp_path, at_once, cards):
    """It waits in its place, which nothing else of the run may need then, however long it was waited for before."""

    class Engine(Scripted):
        def _next(self):
            return Slow(AttemptResult(0))

    class Slow(Attempt):
        polls = 0

        def poll(self):
            self.polls += 1
            return self.end if self.polls > 2 else None

    folders = [tmp_path / f"{place:02d}" for place in range(6)]
    tasks = [
        Task(
            name=folder.name, command=["train"], output=tmp_path / "output.log", folder=folder,
            resources=TaskResources(device=cards[place % 2]),
        )
        for place, folder in enumerate(folders)
    ]  # fmt: skip
    engine, heard = Engine([]), Heard()
    policy = ExecutionPolicy(at_once, poll_seconds=1e-6, lock_timeout_seconds=0, max_per_device=1)
    with lock_folder(folders[0]), lock_folder(folders[2]):
        found = run_tasks(tasks, engine, policy, heard)
    begun = [name for name, _, _ in engine.asked]
    assert [each.state for each in found] == ["done"] * 6
    assert sorted(begun) == [task.name for task in tasks]
    of_card = [name for name in begun if not cards[0] or int(name) % 2 == 0]  # where they could take another's place
    assert of_card[-2:] == ["00", "02"]
    assert sum("waiting for another process" in line for line in heard.lines) == 2


def test_what_the_system_refuses_is_named(tmp_path):
    outcome, _ = run(tmp_path, Scripted([OSError(28, "No space left on device", "/runs/00/output.log")]))
    assert outcome.state == "failed"
    assert outcome.reason.startswith("/runs/00/output.log: No space left on device. Free some space")


@dataclass(frozen=True)
class Node:
    cpus: int
    memory_bytes: int


node_lists = st.lists(st.builds(Node, st.integers(1, 64), st.integers(GB, 10**12)), min_size=1, max_size=5)


@given(node_lists, st.integers(1, 40), st.integers(0, 8), st.integers(10**8, 10**11))
def test_blocks_find_room_on_a_cluster(nodes, blocks, jobs, each):
    share = allocate_cluster(
        ShardWorkload(shards=blocks, shard_bytes=each, jobs=jobs), nodes, ExecutorOptions(executor="ray")
    )
    needs, most = share.resources, max(node.memory_bytes for node in nodes)
    assert share.max_concurrent == min(blocks, jobs or blocks)
    assert 1 <= needs.cpus <= max(node.cpus for node in nodes)
    room = sum(node.cpus // needs.cpus for node in nodes)
    assert needs.cpus == 1 or room >= share.max_concurrent
    assert min(each, most) <= needs.memory_bytes <= most


works = st.builds(
    ShardWorkload, shards=st.integers(1, 60), shard_bytes=st.integers(10**8, 10**11), jobs=st.just(0),
    image_gb=st.sampled_from([0.0, 0.5, 20.0]), images_bytes=st.integers(0, 10**12),
)  # fmt: skip


@given(works, st.integers(1, 128), st.integers(0, 10**12))
def test_blocks_at_once_and_their_photographs_fit_into_one_machine(work, cores, free):
    share = allocate_local(work, MachineResources(cores, free))
    photographs = min(work.images_bytes, 1e9 * share.image_gb)
    assert share.max_concurrent == 1 or share.max_concurrent * (work.shard_bytes + photographs) <= free + 1
    assert share.max_concurrent == 1 or not exceeds_memory(work, share.max_concurrent, free)
    assert (
        exceeds_memory(replace(work, image_gb=0), 1, free)
        or allocate_local(replace(work, image_gb=0), MachineResources(1, free)).image_gb
    )


def test_large_photographs_leave_room_for_fewer_blocks():
    """Photographs of 20 MP: 3 GB for the picture of a block and 16 GB for those that are kept."""
    large = ShardWorkload(shards=32, shard_bytes=3_800_000_000, images_bytes=10**11)
    share = allocate_local(large, MachineResources(32, 64 * GB))
    assert (share.max_concurrent, share.image_gb) == (12, 16 / 12)
    assert allocate_local(replace(large, image_gb=40), MachineResources(32, 64 * GB)).max_concurrent == 6
    # Small ones need no quarter of the memory.
    small = ShardWorkload(shards=32, shard_bytes=2 * GB, images_bytes=10**7)
    assert allocate_local(small, MachineResources(32, 64 * GB)).max_concurrent == 31


def test_two_small_blocks_fit_into_a_laptop_with_4_gb_free():
    """`make demo`: 56 photographs of 400 x 300 pixels, four blocks; with more anchors than it has."""
    cameras = [Camera(camera_from_world=np.eye(4), fx=1, fy=1, cx=0, cy=0, width=400, height=300)] * 56
    largest = block_workload(PRESETS["laptop"], 100_000, 200_000, 400 * 300)
    work = ShardWorkload(
        shards=4, shard_bytes=estimate_memory(largest).total, images_bytes=decoded_image_bytes(cameras)
    )
    assert allocate_local(work, MachineResources(2, 4 * GB)).max_concurrent == 2
    assert not exceeds_memory(work, 2, 4 * GB)


@pytest.mark.parametrize(("cards", "at_once"), [((80 * GB,), 2), ((80 * GB, 80 * GB), 4), ((4 * GB, 80 * GB), 2)])
def test_cards_take_two_blocks_each_where_there_is_room(cards, at_once, question):
    """However much memory and however many cores the machine has."""
    work = ShardWorkload(shards=9, shard_bytes=2 * GB)
    machine = MachineResources(16, 128 * GB, cards)
    assert allocate_local(work, machine).max_concurrent == at_once
    assert allocate_local(replace(work, jobs=7), machine).max_concurrent == 7
    with select_backend(ExecutorOptions(), work, machine, lambda: question) as chosen:
        assert f"{at_once} at once on {'one card' if len(cards) == 1 else '2 cards'} with" in chosen.description
        assert chosen.executor.max_per_device == at_once // len(cards)


def test_photographs_give_way_to_blocks_that_a_person_asked_for():
    work = ShardWorkload(shards=4, shard_bytes=3 * GB, jobs=2, images_bytes=10**11)
    assert allocate_local(work, MachineResources(4, 7 * GB)).image_gb == 0.5
    assert allocate_local(work, MachineResources(4, 6 * GB)).image_gb == 0.1
    assert [exceeds_memory(work, 2, free) for free in (6 * GB, 7 * GB)] == [True, False]
    assert exceeds_memory(replace(work, image_gb=2), 2, 7 * GB)


def test_people_are_told_what_blocks_and_their_photographs_take(question):
    work = ShardWorkload(shards=4, shard_bytes=2 * GB, images_bytes=10**11)
    with select_backend(ExecutorOptions(), work, MachineResources(4, 8 * GB), lambda: question) as chosen:
        assert "a block takes at most 2.00 GB and 667 MB for photographs, of 8.00 GB free" in chosen.description
        assert chosen.description.startswith("3 at once")
        assert not chosen.notes
    with select_backend(
        ExecutorOptions(), replace(work, jobs=4), MachineResources(4, 8 * GB), lambda: question
    ) as chosen:
        assert "4 at once may run out of memory. What helps: less --jobs" in chosen.notes[0]


def test_what_a_person_asks_for_is_asked_of_the_cluster():
    asked = ExecutorOptions(executor="ray", cpus=3, mem_gb=5, gpus=0.5)
    for share in (
        allocate_cluster(ShardWorkload(shards=4, shard_bytes=GB), [Node(8, 64 * GB)], asked),
        allocate_queue(ShardWorkload(shards=4, shard_bytes=GB), asked),
    ):
        assert share.resources == TaskResources(3, 5 * GB, 0.5)
    assert (
        allocate_cluster(
            ShardWorkload(shards=4, shard_bytes=GB, image_gb=2), [Node(8, 64 * GB)], ExecutorOptions(executor="ray")
        ).image_gb
        == 2
    )
    assert (
        allocate_local(ShardWorkload(shards=8, shard_bytes=2 * GB, image_gb=4), MachineResources(2, 8 * GB)).image_gb
        == 2
    )


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (ExecutorOptions(executor="slurm", gpus=0.5), "SLURM gives whole GPUs"),
        (ExecutorOptions(executor="local", address="auto"), "add --executor ray"),
        (ExecutorOptions(executor="ray", address="ray://head:10001"), "on one of its machines"),
        (ExecutorOptions(executor="slurm", slurm=SlurmOptions(grace_seconds=0)), "--slurm.grace-seconds 0"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(asked, said):
    with pytest.raises(VdgsError, match=said):
        asked.check()


@pytest.mark.parametrize(
    ("options", "said"),
    [(("--executor", "slurm"), "There is no sbatch"), (("--executor", "ray"), "Ray is not installed: pip install")],
)
def test_where_blocks_could_not_be_trained_no_coarse_model_is_trained_before_that_is_said(
    options, said, tmp_path, monkeypatch
):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    write_colmap(tmp_path / "capture", tiny_scene())
    with pytest.raises(VdgsError, match=said):
        run_cmd.run_command([str(tmp_path / "capture"), "--output", str(tmp_path / "run"), *options])
    assert not (tmp_path / "run").exists()


@pytest.fixture
def question(tmp_path) -> NodeRequirements:
    photograph = tmp_path / "a.jpg"
    photograph.write_bytes(b"pixels")
    (tmp_path / "run").mkdir()
    return NodeRequirements(tmp_path / "run", [photograph])


def test_a_machine_that_sees_the_same_can_work_on_a_run(question):
    with question.with_lock_probe() as plain:
        assert check_node(plain)["problems"] == []
    assert check_node(question.to_dict())["problems"] == []  # nobody waits for the answer
    assert list(question.folder.iterdir()) == []


def test_what_a_machine_does_not_see_is_named(question, monkeypatch):
    with question.with_lock_probe() as plain:

        def said(**other) -> str:
            (problem,) = check_node(plain | other)["problems"]
            return problem

        assert "there is no /elsewhere" in said(folder="/elsewhere")
        assert "another folder there" in said(held=str(question.folder / ".fitness-of-another"))
        assert "there is no /b.jpg" in said(files=[["/b.jpg", 6]])
        assert "has 6 bytes there and 7 here" in said(files=[[str(question.files[0]), 7]])
        assert "it has vdgs" in said(version="9.9")
        assert "not the same code" in said(code="other")
        monkeypatch.setattr(node_check, "is_locked", lambda _: False)
        assert "reach no other node" in said()

        def refuse(_: Path) -> bool:
            raise OSError(38, "Function not implemented")

        monkeypatch.setattr(node_check, "is_locked", refuse)
        assert "do not work there (Function not implemented)" in said()


def test_of_many_photographs_some_are_looked_for(question):
    many = replace(question, files=[question.folder / f"{number}.jpg" for number in range(1000)])
    names = [name for name, _ in many.to_dict()["files"]]
    assert names[0].endswith("/0.jpg")
    assert names[-1].endswith("/999.jpg")
    assert len(names) < 12


def test_listeners_need_not_listen():
    listener, task = TaskListener(), Task(name="a", command=["b"], output=Path("c"))
    assert listener.on_placed(task, "node", False) is listener.on_paused(task, "") is None
