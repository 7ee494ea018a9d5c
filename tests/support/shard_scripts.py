"""Jobs that do what a script says, and how an executor runs them."""

from __future__ import annotations

import io
import sys
import textwrap
from pathlib import Path

from rich.console import Console

from support.commands import PATIENCE_SECONDS
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.distributed.shard_runner import ShardCommand, run_shards
from vdgs.runs.stage_folder import StageFolder

#: What every fake block begins with: it knows its folder, can say how far it is, and lists the SIGTERMs it gets.
PRELUDE = f"""
import json, os, pathlib, signal, sys, time
folder = pathlib.Path(sys.argv[1])
def tell(state, **values):
    (folder / "status.tmp").write_text(json.dumps({{"state": state, **values}}))
    (folder / "status.tmp").rename(folder / "status.json")
def stop(*_):
    with (folder / "terms").open("a") as terms:
        terms.write("TERM ")
signal.signal(signal.SIGTERM, stop)
def wait_for(condition):
    end = time.monotonic() + {PATIENCE_SECONDS}
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
"""


def job(root: Path, index: int, script: str) -> ShardCommand:
    folder = StageFolder(root / f"{index:02d}")
    who = f"block = {index}\n"
    return ShardCommand(
        index, folder, [sys.executable, "-S", "-c", PRELUDE + who + textwrap.dedent(script), str(folder.path)]
    )


def run(jobs, *, at_once=2, retries=2, terminal=False):
    """Outcomes, and what was printed."""
    console = Console(file=io.StringIO(), width=120, height=40, force_terminal=terminal, color_system=None)
    outcomes = run_shards(jobs, LocalExecutor(at_once, retries, poll_seconds=0.02), console)
    return outcomes, console.file.getvalue()
