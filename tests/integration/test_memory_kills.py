"""Commands that the kernel really ends, for want of memory: they are told from those that someone killed."""

from __future__ import annotations

import os
import secrets
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.shard_scripts import job, run
from vdgs.distributed.executor import AttemptResult
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.ray_actor import RayTaskActor, RayTaskSpec

pytestmark = pytest.mark.slow

#: Where the hierarchies of control groups lie: that of memory alone (version 1), or all in one (version 2).
GROUPS = Path("/sys/fs/cgroup")
MOST_BYTES = 64 << 20
#: Takes four times as much, within the group, on its first attempt.
GREEDY = """
        if not (folder / "tried").exists():
            (folder / "tried").touch()
            pathlib.Path({file!r}).write_text(str(os.getpid()))
            taken = [bytearray(b"x" * (1 << 20)) for _ in range({times})]
"""


@pytest.fixture
def limited() -> Iterator[Path]:
    """A control group whose processes may take `MOST_BYTES` together; skipped where none can be made."""
    first = (GROUPS / "memory").is_dir()
    group = GROUPS / ("memory" if first else "") / f"vdgs-{secrets.token_hex(4)}"
    limit, swap = ("memory.limit_in_bytes", None) if first else ("memory.max", "memory.swap.max")
    try:
        group.mkdir()
        if swap and (group / swap).exists():
            (group / swap).write_text("0")
        (group / limit).write_text(str(MOST_BYTES))
    except OSError as error:
        if group.is_dir():
            group.rmdir()
        pytest.skip(f"no control group with a limit of memory can be made here: {error.strerror}")
    yield group
    group.rmdir()


@pytest.fixture
def greedy(limited) -> str:
    """A command that the kernel ends, once."""
    if Path("/proc/swaps").read_text().count("\n") > 1 and (GROUPS / "memory").is_dir():
        pytest.skip("this machine swaps: a control group of version 1 limits memory alone")
    return GREEDY.format(file=os.fspath(limited / "cgroup.procs"), times=4 * MOST_BYTES >> 20)


def test_what_the_kernel_ends_for_want_of_memory_is_known_as_such_and_started_again(tmp_path, greedy):
    outcomes, text = run([job(tmp_path, 0, greedy), job(tmp_path, 1, "pass"), job(tmp_path, 2, "pass")])
    assert [(outcome.state, outcome.attempts) for outcome in outcomes] == [("done", 2), ("done", 1), ("done", 1)]
    assert "block 00: crashed by SIGKILL (out of memory; from now on at most 1 at once)" in " ".join(text.split())


def test_who_keeps_a_command_on_a_node_says_so_too(tmp_path, greedy):
    made = job(tmp_path, 0, greedy)
    order = RayTaskSpec(
        command=tuple(made.command), output=str(made.output), environment={}, attempt=1, python=sys.executable,
        requirements=NodeRequirements(tmp_path, ()).to_dict(),
    )  # fmt: skip
    for expected in (AttemptResult(-signal.SIGKILL, out_of_memory=True), AttemptResult(0)):
        keeper = RayTaskActor(order, result_timeout_seconds=1e6)  # when nobody collects, it would end this process
        keeper.begin()
        assert keeper.end() == expected
