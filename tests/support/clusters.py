"""Runs to be trained on clusters, and a real Ray of several nodes on this machine, in a process of its own."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from support.commands import PATIENCE_SECONDS, Command, do_tasks_here, vdgs
from support.shard_server import parent_of, started
from vdgs.runs.run_folder import RunFolder

#: What makes a run of two blocks that is small enough to be trained again and again.
COARSE = (
    "--preset",
    "laptop",
    "--images",
    "images",
    "--iterations",
    "60",
    "--model.num-offsets",
    "3",
    "--densify.num-levels",
    "0",
    "--save-every",
    "20",
)
CUT = ("--blocks", "2", "--assignment.min-cameras", "4")
BLOCKS = ("--save-every", "10", "--block.iterations", "30", "--overwrite")
#: Where each block waits once, on its way or when it is continued there.
MIDDLE = "*/blocks/0?/checkpoints/00000020.json"
#: Pixels so small that the map of `uncut` has four tiles, two for each shard.
FINE = ("--gsd", "0.022")

#: Figures that depend on the machine and on what else it does.
TIMES = ("fps", "render_seconds", "seconds", "peak_memory_bytes")

#: How the end of a command is told that was killed. Where the machine, whose count is that of all its processes, has
#: meanwhile killed any for want of memory, this one may be taken for one of them.
KILLED = r"crashed by SIGKILL( \(out of memory; [^)]*\))?"
#: How the loss of a node is told, by what Ray says first: that the node has died, that its worker does not answer, or,
#: where the worker ends late, that the worker has killed its command.
NODE_LOST = rf"(crashed by the loss of its (node|worker on node)|{KILLED})"

#: Serves commands, one line each: starts and removes nodes. Nodes have one processor; the head has none.
SERVER = """
import json, os, sys, warnings
warnings.simplefilter("ignore")
from ray.cluster_utils import Cluster
from support.ray_agents import wait_for_nodes
wait_for_nodes(float(sys.argv[1]))
own = {"object_store_memory": 80 << 20, "memory": 8 << 30}
head = {"num_cpus": 0, "include_dashboard": False, "include_log_monitor": False, "no_monitor": True}
cluster = Cluster(initialize_head=True, head_node_args={**own, **head})
nodes = {}
def tell(**facts):
    print("ANSWER", json.dumps(facts), flush=True)
tell(address=cluster.address)
for line in sys.stdin:
    verb, name, options = json.loads(line)
    if verb == "add":
        nodes[name] = cluster.add_node(num_cpus=1, **own | options)
        tell(raylet=nodes[name].all_processes["raylet"][0].process.pid)
    elif verb == "remove":
        cluster.remove_node(nodes.pop(name), allow_graceful=False)
        tell()
for node in nodes.values():
    cluster.remove_node(node, allow_graceful=False)
cluster.shutdown()
"""
#: What Ray is told where it starts.
TESTS = Path(__file__).parents[1]
QUICK_STARTS = {
    # What nodes start can be paused, as `pausing` says.
    "PYTHONPATH": os.pathsep.join(map(str, (TESTS / "support" / "startup", TESTS, TESTS.parent / "src"))),
    "RAY_enable_worker_prestart": "0", "RAY_prestart_worker_first_driver": "0",
    "RAY_agent_register_timeout_ms": "600000", "RAY_gcs_server_port_wait_time_s": "600",
}  # fmt: skip


class Cluster:
    """A Ray cluster; every node but the head has one processor."""

    def __init__(self, variables: Mapping[str, str]) -> None:
        """With environment variables of all its nodes."""
        #: With which a driver is let in; Ray listens on all addresses.
        self.token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        environment = os.environ | {
            "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0", "PYTHONWARNINGS": "ignore",
            # A node that is gone refuses to be asked, at once; one that is slow to answer is not taken for dead.
            "RAY_health_check_initial_delay_ms": "0", "RAY_health_check_period_ms": "1000",
            "RAY_health_check_failure_threshold": "2", "RAY_health_check_timeout_ms": "600000",
            "RAY_gcs_rpc_server_reconnect_timeout_s": "600",
            "RAY_memory_monitor_refresh_ms": "0",  # what other tests take is not for Ray to free
            "VDGS_THREADS": "1", "OMP_NUM_THREADS": "1", **variables, **QUICK_STARTS, **self.token,
        }  # fmt: skip
        self._server = subprocess.Popen(
            [sys.executable, "-c", SERVER, str(PATIENCE_SECONDS)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip
        self._raylets, self.names = dict[int, str](), list[str]()
        self.address = str(self._answer()["address"])

    def add(self, name: str, variables: Mapping[str, str] | None = None, **options: Any) -> None:
        """Start a node with environment variables and options of its own."""
        where = {"env_vars": dict(variables)} if variables else {}
        self._raylets[int(self._ask("add", name, **options, **where)["raylet"])] = name
        self.names.append(name)

    def remove(self, name: str) -> None:
        """Let a node die without a word."""
        self._ask("remove", name)
        self.names.remove(name)

    def node_of(self, process: int) -> str:
        """On which node a command of a block runs: its keeper is a child of the node's own process."""
        return self._raylets[parent_of(keeper_of(process))]

    def has(self, process: int, name: str) -> bool:
        """Whether a process of a block lives on a node; no if it is just being killed."""
        try:
            return alive(process) and self.node_of(process) == name
        except (OSError, KeyError):  # it, or its keeper, has ended since
            return False

    def close(self) -> None:
        assert self._server.stdin is not None
        self._server.stdin.close()
        self._server.wait(PATIENCE_SECONDS)
        assert self._server.stdout is not None
        self._server.stdout.close()

    def _ask(self, verb: str, name: str, **options: Any) -> dict[str, Any]:
        assert self._server.stdin is not None
        self._server.stdin.write(json.dumps([verb, name, options]) + "\n")
        self._server.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._server.stdout is not None
        for line in self._server.stdout:
            if line.startswith("ANSWER"):
                return dict(json.loads(line.removeprefix("ANSWER")))
        raise AssertionError("the Ray cluster ended")


def keeper_of(process: int) -> int:
    """The process that started that of a shard, or block."""
    return parent_of(started(process))


def shard_of(process: int) -> int:
    """Which shard, or block, a process does."""
    words = Path(f"/proc/{started(process)}/cmdline").read_bytes().decode().split("\0")
    return int(words[words.index("vdgs.distributed.run_shard") + 2])


def waiting_shards(driver: Command, count: int) -> dict[int, int]:
    """The process of each shard, or block, that waits now, once so many have waited in all."""
    driver.wait_until_paused(count)
    found = dict[int, int]()
    for process in driver.paused():
        with suppress(OSError, ValueError):  # it has just ended
            if alive(process):
                found[shard_of(process)] = process
    return found


def train_here(run: Path, to: Path) -> Path:
    """A copy of a run, its blocks trained by this machine alone."""
    local = copy_run(run, to)
    done = vdgs("train-blocks", local, *BLOCKS, prepare=do_tasks_here)
    assert done.returncode == 0, done.stderr + done.stdout
    return local


def merge_run(trained: Path, to: Path) -> Path:
    """A copy of a run whose blocks are trained, merged."""
    merged = copy_run(trained, to)
    done = vdgs("merge", merged)
    assert done.returncode == 0, done.stderr + done.stdout
    return merged


def copy_run(run: Path, to: Path) -> Path:
    return Path(shutil.copytree(run, to, ignore=shutil.ignore_patterns(".lock")))


def models(run: Path) -> list[bytes]:
    """The model of every block: the whole file."""
    folder = RunFolder(run)
    assert len(folder.block_folders()) == 2
    return [each.model.read_bytes() for each in folder.block_folders()]


def alive(process: int) -> bool:
    """Whether a process is there, and no mere remains of one."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def evaluated(folder: Path) -> dict[str, object]:
    """What an evaluation wrote, by name, without what depends on the machine."""
    found: dict[str, object] = {}
    for file in sorted(each for each in folder.rglob("*") if each.is_file() and each.name[0] != "."):
        name, content = file.relative_to(folder).as_posix(), file.read_bytes()
        found[name] = _without(json.loads(content), TIMES) if file.suffix == ".json" else content
    return found


def _without(value: Any, names: tuple[str, ...]) -> Any:
    if isinstance(value, dict):
        return {name: _without(each, names) for name, each in value.items() if name not in names}
    return [_without(each, names) for each in value] if isinstance(value, list) else value
