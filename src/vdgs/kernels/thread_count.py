"""How many threads to use, without loading anything that uses them."""

from __future__ import annotations

import math
import os

from vdgs.errors import VdgsError

#: As `--threads` has it: more than any machine has cores, and few enough to start.
MAX_NUM_THREADS = 1024


def cpu_count() -> int:
    """The number of cores that this process may use: those that it is bound to, or fewer where the quota of a control
    group (a container) is less, rounded up."""
    from vdgs.system.cgroups import cgroup_cpus  # `import vdgs` does without

    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cgroup_cpus()
    return bound if quota is None else min(bound, math.ceil(quota))


def default_num_threads() -> int:
    """`VDGS_THREADS`, or the number of cores that this process may use. VdgsError for another value of the variable."""
    text = os.environ.get("VDGS_THREADS")
    if not text:
        return cpu_count()
    if not text.isdecimal() or not 1 <= int(text) <= MAX_NUM_THREADS:
        raise VdgsError(f"VDGS_THREADS must be a whole number from 1 to {MAX_NUM_THREADS}, not {text!r}.")
    return int(text)
