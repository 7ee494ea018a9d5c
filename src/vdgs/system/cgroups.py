"""Limits of memory and processors of Linux control groups (containers, SLURM jobs, systemd units). Standard library
only, for `vdgs doctor`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

#: What the kernel says of this process.
PROC_SELF = Path("/proc/self")


@dataclass(frozen=True)
class CgroupLimit:
    """What the processes of one control group may take together, and take now, in bytes."""

    limit: int
    used: int

    @property
    def free(self) -> int:
        return max(0, self.limit - self.used)


def cgroup_limits(process: Path = PROC_SELF) -> list[CgroupLimit]:
    """The limits of this process's control group and of all above it (versions 1 and 2); [] where none is set. Groups
    that are not visible (above a container's root, not mounted) are left out."""
    return [limit for folder, version in _groups("memory", process) if (limit := _limit(folder, version)) is not None]


def cgroup_cpus(process: Path = PROC_SELF) -> float | None:
    """How many processors this process's control group and all above it leave it at most, by their quotas of time
    (`docker run --cpus=1.5`); None where none is set."""
    quotas = [quota for folder, version in _groups("cpu", process) if (quota := _quota(folder, version)) is not None]
    return min(quotas, default=None)


def slurm_memory_limit(environment: Mapping[str, str] = os.environ) -> int | None:
    """Bytes that the SLURM job requested on this node; None outside of jobs and without a request. SLURM may enforce it
    without a control group."""
    if "SLURM_JOB_ID" not in environment:
        return None

    def number(name: str) -> int:
        text = environment.get(name, "")
        return int(text) if text.isdecimal() else 0

    # Both are in MiB; 0 is all of the node.
    mib = number("SLURM_MEM_PER_NODE") or number("SLURM_MEM_PER_CPU") * number("SLURM_CPUS_ON_NODE")
    return mib << 20 or None


def _groups(controller: str, process: Path) -> list[tuple[Path, int]]:
    """The folders of this process's groups in the hierarchies of a controller, from its own up to where the hierarchy
    is mounted, and their version."""
    with suppress(OSError, ValueError):  # no Linux
        own = _own_groups(controller, (process / "cgroup").read_text())
        return list(_visible_groups(controller, own, (process / "mountinfo").read_text()))
    return []


def _own_groups(controller: str, text: str) -> dict[int, str]:
    """This process's group in the hierarchy that may limit it, by version, as /proc/self/cgroup names it."""
    own = dict[int, str]()
    for line in text.splitlines():
        number, controllers, path = line.split(":", 2)
        if controller in controllers.split(","):
            own[1] = path
        elif number == "0" and not controllers:
            own[2] = path
    return own


def _visible_groups(controller: str, own: Mapping[int, str], mounts: str) -> Iterator[tuple[Path, int]]:
    for line in mounts.splitlines():
        before, _, after = line.partition(" - ")
        kind, _, options = after.split(" ", 2)
        version = 2 if kind == "cgroup2" else 1 if kind == "cgroup" and controller in options.split(",") else 0
        if version not in own:
            continue
        root, mounted = (_unescaped(field) for field in before.split(" ")[3:5])
        path = PurePosixPath(own[version])
        # Below another root (a container that shows the host's names, or only its own part): that root alone.
        below = path.relative_to(root) if path.is_relative_to(root) and ".." not in path.parts else PurePosixPath()
        for group in (below, *below.parents):
            yield Path(mounted) / group, version


def _unescaped(field: str) -> str:
    """A path of mountinfo, which writes spaces and backslashes in octal."""
    return re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), field)


def _limit(folder: Path, version: int) -> CgroupLimit | None:
    """The limit of one group; None where it has none. Copies of files that can be dropped at once do not count."""
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    # `total_`: with the groups below, as usage counts them; version 2 counts all so.
    droppable = "inactive_file" if version == 2 else "total_inactive_file"
    with suppress(OSError, ValueError):  # no such file (a root has no limit); "max"
        limit, used = (int((folder / name).read_text()) for name in names)
        with suppress(OSError, ValueError, KeyError):
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            used -= int(stat[droppable])
        return CgroupLimit(limit, max(0, used))
    return None


def _quota(folder: Path, version: int) -> float | None:
    """The processors that one group may keep busy; None where it may all."""
    with suppress(OSError, ValueError):  # no such file (a root has no quota); "max"
        if version == 2:
            quota, period = map(int, (folder / "cpu.max").read_text().split())
        else:
            quota, period = (int((folder / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        if quota > 0 and period > 0:  # version 1 says -1 for all
            return quota / period
    return None
