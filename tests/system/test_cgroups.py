"""Limits of control groups, of memory and of processors: of nested ones too, of both versions, as containers and SLURM
show them."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from vdgs.cli.doctor import system_checks as doctor
from vdgs.kernels import cpu_count, default_num_threads
from vdgs.system import cgroups
from vdgs.system.cgroups import CgroupLimit, cgroup_cpus, cgroup_limits, slurm_memory_limit
from vdgs.system.memory import process_memory

GB = 10**9
#: What version 1 says where there is no limit.
NONE = 9223372036854771712


def escaped(path: Path) -> str:
    """As mountinfo has a path."""
    return str(path).replace("\\", r"\134").replace(" ", r"\040")


class Machine:
    """A made-up /proc/self and the hierarchies of control groups that it tells of."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.mounts = [f"22 1 8:1 / {escaped(folder)} rw - ext4 /dev/sda1 rw"]

    def mount(self, name: str, version: int, root: str = "/") -> Path:
        kind, options = ("cgroup2", "rw") if version == 2 else ("cgroup", "rw,memory" if version == 1 else "rw,cpu")
        mounted = self.folder / "sys" / name
        self.mounts.append(f"31 23 0:28 {root} {escaped(mounted)} rw,relatime shared:9 - {kind} {kind} {options}")
        return mounted

    def limits(self, groups: str) -> list[CgroupLimit]:
        """As seen by a process whose /proc/self/cgroup has these lines."""
        return cgroup_limits(self._seen_by(groups))

    def cpus(self, groups: str) -> float | None:
        return cgroup_cpus(self._seen_by(groups))

    def _seen_by(self, groups: str) -> Path:
        (self.folder / "cgroup").write_text(groups)
        (self.folder / "mountinfo").write_text("\n".join(self.mounts) + "\n")
        return self.folder


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def second(folder: Path, most: int | str, used: int, droppable: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{most}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon {used - droppable}\ninactive_file {droppable}\nactive_file 0\n")


def first(folder: Path, most: int, used: int, droppable: int = 0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.limit_in_bytes").write_text(f"{most}\n")
    (folder / "memory.usage_in_bytes").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"inactive_file 1\ntotal_inactive_file {droppable}\n")


def least(limits: list[CgroupLimit]) -> int:
    return min(limit.free for limit in limits)


def test_a_job_of_slurm_is_limited_by_the_group_above_its_step(machine):
    """Version 2: the root has no limit, the step says "max", the job has one."""
    root = machine.mount("cgroup", 2)
    job = root / "system.slice/slurmstepd.scope/job_7"
    second(job, 32 * GB, 3 * GB)
    second(job / "step_batch/user/task_0", "max", 3 * GB)
    own = "0::/system.slice/slurmstepd.scope/job_7/step_batch/user/task_0\n"
    assert machine.limits(own) == [CgroupLimit(32 * GB, 3 * GB)]
    # The least room counts, not the least limit.
    second(job.parent, 40 * GB, 38 * GB)
    assert least(machine.limits(own)) == 2 * GB
    # A neighbor's limit is none of ours.
    second(root / "user.slice", GB, 0)
    assert least(machine.limits(own)) == 2 * GB


def test_version_1_is_seen_beside_other_hierarchies(machine):
    cpu, memory, unified = machine.mount("cpu", 0), machine.mount("memory", 1), machine.mount("unified", 2)
    first(memory, NONE, 9 * GB)
    first(memory / "slurm/uid_1/job_7", 32 * GB, 10 * GB, droppable=4 * GB)
    first(memory / "slurm/uid_1/job_7/step_0", NONE, 10 * GB)
    first(cpu / "elsewhere", GB, 0)
    unified.mkdir()
    found = machine.limits("4:memory:/slurm/uid_1/job_7/step_0\n2:cpu,cpuacct:/elsewhere\n0::/\n")
    assert least(found) == 26 * GB
    assert min(limit.limit for limit in found) == 32 * GB


@pytest.mark.parametrize("group", ["0::/", "0::/../../somewhere"])
def test_the_root_that_a_container_sees_limits_it(group, machine):
    second(machine.mount("cgroup", 2), 8 * GB, 5 * GB, droppable=2 * GB)
    assert least(machine.limits(group)) == 5 * GB


@pytest.mark.parametrize("group", ["/docker/4f", "/docker/4f/inner", "/"])
def test_a_container_may_be_told_the_names_of_its_host(group, machine):
    """Version 1 without a namespace: the mount's root is the container's group."""
    first(machine.mount("memory", 1, root="/docker/4f"), 8 * GB, GB)
    assert machine.limits(f"4:memory:{group}") == [CgroupLimit(8 * GB, GB)]


def test_names_that_mountinfo_escapes_are_found(machine):
    second(machine.mount("cgroup", 2, root=r"/machine\134x2d1.scope") / "run", 8 * GB, GB)
    assert least(machine.limits("0::/machine\\x2d1.scope/run")) == 7 * GB


def test_without_a_limit_or_control_groups_there_is_none(machine, tmp_path):
    assert cgroup_limits(tmp_path / "nowhere") == []
    second(machine.mount("cgroup", 2) / "user.slice", "max", GB)
    assert machine.limits("0::/user.slice/session-2.scope") == []
    (tmp_path / "cgroup").write_text("what is this")
    assert cgroup_limits(tmp_path) == []


def test_a_group_that_uses_more_than_its_limit_leaves_nothing_and_needs_no_statistics(machine):
    root = machine.mount("cgroup", 2)
    second(root, GB, 2 * GB)
    (root / "memory.stat").unlink()
    assert least(machine.limits("0::/")) == 0


def test_quotas_of_processors_are_seen_in_version_2(machine, tmp_path):
    job = machine.mount("cgroup", 2) / "docker/4f"
    (job / "inner").mkdir(parents=True)
    assert machine.cpus("0::/docker/4f/inner") is None
    for folder, text in ((job / "inner", "max 100000"), (job, "150000 100000"), (job.parent, "800000 100000")):
        (folder / "cpu.max").write_text(f"{text}\n")
    assert machine.cpus("0::/docker/4f/inner") == 1.5
    assert machine.cpus("0::/docker") == 8
    assert machine.cpus("0::/elsewhere") is None
    assert cgroup_cpus(tmp_path / "nowhere") is None


def test_quotas_of_processors_are_seen_in_version_1(machine):
    cpu, memory = machine.mount("cpu", 0), machine.mount("memory", 1)
    for folder, quota in ((cpu, -1), (cpu / "job", 50_000), (memory / "job", 10_000)):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "cpu.cfs_quota_us").write_text(f"{quota}\n")
        (folder / "cpu.cfs_period_us").write_text("100000\n")
    assert machine.cpus("4:memory:/job\n2:cpu,cpuacct:/job\n") == 0.5
    assert machine.cpus("4:memory:/job\n2:cpu,cpuacct:/\n") is None


@pytest.mark.parametrize(("quota", "threads"), [(None, 8), (0.5, 1), (2.0, 2), (2.5, 3), (64.0, 8)])
def test_threads_are_as_many_as_a_quota_keeps_busy(quota, threads, monkeypatch):
    monkeypatch.delenv("VDGS_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(cgroups, "cgroup_cpus", lambda: quota)
    assert cpu_count() == default_num_threads() == threads


@pytest.mark.parametrize(
    ("asked", "limit"),
    [
        ({"SLURM_MEM_PER_NODE": "2048"}, 2 << 30),
        ({"SLURM_MEM_PER_CPU": "512", "SLURM_CPUS_ON_NODE": "3"}, 3 << 29),
        ({"SLURM_MEM_PER_CPU": "512"}, None),
        ({"SLURM_MEM_PER_NODE": "0"}, None),
        ({}, None),
    ],
)
def test_what_a_job_of_slurm_asked_for(asked, limit):
    assert slurm_memory_limit({"SLURM_JOB_ID": "7", **asked}) == limit
    assert slurm_memory_limit(asked) is None  # sbatch's own variables in a shell, not in a job


@pytest.fixture
def large(monkeypatch) -> None:
    """A machine with 512 GB, most of it free, outside of any job."""
    memory = SimpleNamespace(total=512 * GB, available=500 * GB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)


def test_a_process_may_take_what_its_group_leaves(large, monkeypatch):
    for groups, free in (([], 500), ([CgroupLimit(NONE, GB)], 500), ([CgroupLimit(32 * GB, 2 * GB)], 30)):
        monkeypatch.setattr(process_memory, "cgroup_limits", lambda groups=groups: groups)
        assert process_memory.available_memory_bytes() == free * GB


def test_a_job_that_no_group_limits_takes_what_it_asked_for(large, monkeypatch):
    monkeypatch.setattr(process_memory, "cgroup_limits", lambda: [CgroupLimit(NONE, GB)])
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_MEM_PER_NODE", str(64 << 10))
    taken = (64 << 30) - process_memory.available_memory_bytes()
    assert 0 < taken < 20 * GB  # this process and its children
    monkeypatch.setattr(process_memory, "cgroup_limits", lambda: [CgroupLimit(128 * GB, GB)])
    assert process_memory.available_memory_bytes() == 127 * GB


def test_the_doctor_sees_the_same_limit(large, monkeypatch):
    def memory_with(groups: list[CgroupLimit]) -> str:
        for module in (doctor, process_memory):
            monkeypatch.setattr(module, "cgroup_limits", lambda: groups)
        (check,) = doctor._memory()
        return check.value

    limited = [CgroupLimit(NONE, GB), CgroupLimit(32 * GB, 2 * GB)]
    assert memory_with(limited).startswith("30.0 GB free, limited to 32.0 GB by a control group")
    assert memory_with([]) == "500.0 GB free of 512.0 GB"
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_MEM_PER_NODE", str(64 << 10))
    free, _, why = memory_with([CgroupLimit(NONE, GB)]).partition(" GB free, ")
    assert 40 < float(free) < 68.7
    assert why == "limited to 68.7 GB by what the SLURM job asked for"
    assert memory_with(limited).endswith("(container, SLURM job, systemd unit)")
