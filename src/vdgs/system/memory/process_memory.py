"""How much memory this process takes, took at most and may still take."""

from __future__ import annotations

import ctypes
import gc
import resource
import sys
from contextlib import suppress
from pathlib import Path

import psutil

from vdgs.system.cgroups import cgroup_limits, slurm_memory_limit


def available_memory_bytes() -> int:
    """What this process may still take: the least of the machine's free memory, that of its control groups (container,
    SLURM job, systemd unit), its own limit and, where no group limits a SLURM job, the job's request."""
    memory, groups = psutil.virtual_memory(), cgroup_limits()
    free = [memory.available, *(group.free for group in groups)]
    job = slurm_memory_limit()
    if job is not None and all(group.limit >= memory.total for group in groups):
        free.append(job - _resident_with_children())
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        free.append(limit - psutil.Process().memory_info().vms)
    return max(0, min(free))


def _resident_with_children() -> int:
    """Resident bytes of this process and its children; shared memory counts for each."""
    total = 0
    for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
        with suppress(psutil.Error):  # it has just ended
            total += process.memory_info().rss
    return int(total)


def peak_memory_bytes() -> int:
    """Largest resident size of this process since it began, or since `reset_peak_memory`."""
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def reset_peak_memory() -> None:
    """Restart the peak at the current size, so that each stage of a run is measured alone (Linux)."""
    gc.collect()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


#: glibc's number for the most arenas that `mallopt` allows.
_M_ARENA_MAX = -8


def limit_malloc_arenas(max_arenas: int = 2) -> None:
    """Let all threads allocate from so few arenas (glibc): each of many threads else keeps what it has freed."""
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, max_arenas)
