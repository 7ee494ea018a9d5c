"""Work on a real Ray of several nodes on this machine: whatever is lost, the results are those of the local run."""

import importlib.util
import os
import re
import shutil
import signal
import sys
from functools import partial
from pathlib import Path

import pytest

from support.clusters import (
    BLOCKS,
    FINE,
    KILLED,
    MIDDLE,
    NODE_LOST,
    QUICK_STARTS,
    TESTS,
    Cluster,
    alive,
    copy_run,
    evaluated,
    keeper_of,
    models,
    shard_of,
    waiting_shards,
)  # fmt: skip
from support.commands import PATIENCE_SECONDS, Command, begun, do_tasks_here, python, vdgs, wait_until
from support.shard_server import shard_server
from vdgs import cli

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("shards"),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'vdgs[ray]'"),
    pytest.mark.skipif(sys.platform != "linux", reason="who runs on which node is read from /proc"),
]


@pytest.fixture(scope="module")
def cluster():
    with shard_server() as variables:
        cluster = Cluster(variables)
        cluster.add("a")
        cluster.add("b")
        yield cluster
        cluster.close()


def on_ray(run: Path, cluster: Cluster) -> tuple[object, ...]:
    return ("train-blocks", run, *BLOCKS, "--executor", "ray", "--address", cluster.address)


def another_code() -> None:
    """Let this process take itself for another version of vdgs."""
    from vdgs.distributed import node_check

    node_check.code_digest = lambda: "of this machine"  # type: ignore[assignment]


def test_a_run_starts_a_ray_of_its_own_for_each_job(tmp_path):
    """One after the other, in one process, as `vdgs run --executor ray` does without an address; where the folder of
    temporary files is too long for sockets too."""
    long = tmp_path / ("long" * 30)
    long.mkdir()
    done = python(
        f"""
from support.ray_agents import wait_for_nodes
from vdgs.distributed import ray_executor
begin = ray_executor._ray_driver
def patiently(*arguments):  # whose token is to be known before Ray is imported
    wait_for_nodes({PATIENCE_SECONDS})
    return begin(*arguments)
ray_executor._ray_driver = patiently
for _ in range(2):
    with ray_executor.connect(None):
        print(len(ray_executor.list_nodes()), "node")
""",
        **QUICK_STARTS,
        TMPDIR=str(long),
    )
    assert done.stdout.splitlines() == ["1 node", "1 node"], done.stderr


def test_nodes_that_cannot_work_on_a_run_are_named_before_anything_starts(cut, cluster, tmp_path):
    run = copy_run(cut, tmp_path / "run")
    done = vdgs(*on_ray(run, cluster), prepare=another_code, environment=cluster.token)
    assert done.returncode == 1
    assert f"node {os.uname().nodename}: its vdgs" in done.stderr
    assert "not the same code" in done.stderr
    assert not list(run.glob("blocks/*/output.log"))
    assert not list(run.glob(".fitness*"))


def test_a_driver_that_was_killed_finds_its_shards_again_and_stops_them_when_asked(uncut, mapped, cluster, tmp_path):
    """Two shards that draw tiles, on two nodes; what they saved leads to the maps of one process."""
    run = copy_run(uncut, tmp_path / uncut.name)  # whose name is on the sheet
    command = ("ortho", run, *FINE, "--executor", "ray", "--address", cluster.address)
    with begun(*command, pause_at=("*/shards/*/00000[13].npz", 1), environment=cluster.token) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGKILL)
        first.finished()
        shards = {shard_of(process): process for process in first.paused()}
        assert cluster.node_of(shards[0]) != cluster.node_of(shards[1])
        with begun(*command, environment=cluster.token) as second:
            wait_until(lambda: second.printed().count("is still at work") == 2)
            second.send_signal(signal.SIGINT)
            done = second.finished()
        assert done.returncode == 130, done.stderr + done.stdout
        assert "every shard that was at work is saved" in done.stderr
        assert not any(alive(process) for process in first.paused())
    assert {file.stem for file in run.glob("maps/shards/*/*/*.npz")} == {"000000", "000002"}
    done = vdgs("ortho", run, *FINE, "--jobs", "2", prepare=do_tasks_here)  # it is the same job
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards done" in done.stdout
    assert evaluated(run / "maps") == mapped


def more_retries() -> None:
    """Let tasks be tried as often as one run can lose them."""
    from vdgs.distributed import ray_executor

    ray_executor.RayExecutor = partial(ray_executor.RayExecutor, retries=3)  # type: ignore[assignment,misc]


def test_whatever_is_lost_the_models_are_those_of_the_local_run(cut, local, cluster, tmp_path):
    """A block loses its node. Of those that join late one is of another vdgs, which is named and avoided, Ray takes the
    memory of the next for full and ends the block itself, and a larger one takes it. Of the other block the command is
    killed, then the worker that keeps it; at last it stands still, and is waited for."""
    run = copy_run(cut, tmp_path / "run")
    stranger = another_vdgs(tmp_path / "stranger")
    command = (*on_ray(run, cluster), "--mem-gb", "1")
    with begun(*command, pause_at=(MIDDLE, 1), prepare=more_retries, environment=cluster.token) as driver:
        processes = waiting_shards(driver, 2)
        # The driver knows of both attempts: what it has not heard of yet it cannot lose.
        wait_until(lambda: all(f"block 0{block}: started" in driver.printed() for block in range(2)))
        cluster.remove(cluster.node_of(processes[1]))
        wait_until(lambda: not alive(processes[1]))
        cluster.add("stranger", {"PYTHONPATH": os.pathsep.join(map(str, (stranger, TESTS)))})
        wait_until(lambda: "crashed by a node that cannot work on the run" in driver.printed())
        full = {"RAY_memory_monitor_refresh_ms": "100", "RAY_memory_usage_threshold": "0.001"}
        cluster.add("small", full, memory=1 << 30)
        wait_until(lambda: "crashed by Ray, to free memory" in driver.printed())
        cluster.remove("small")  # which the other block would fit
        cluster.add("large")
        wait_until(lambda: any(cluster.has(process, "large") for process in driver.paused()))
        os.kill(processes[0], signal.SIGKILL)
        again = waits_again(driver, 0, processes[0])
        # As above, of the second attempt.
        wait_until(lambda: driver.printed().count("block 00: started") == 2)
        os.kill(keeper_of(again), signal.SIGKILL)
        slow = waits_again(driver, 0, processes[0], again)
        os.kill(slow, signal.SIGSTOP)
        driver.go_on()
        wait_until((run / "blocks/01/model.safetensors").exists)
        os.kill(slow, signal.SIGCONT)
        done = driver.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert models(run) == models(local)
    assert re.search(f"block 01: {NODE_LOST}", done.stdout)
    assert done.stdout.count("block 01: crashed by a node that cannot work on the run") == 1
    assert "not the same code" in done.stdout
    assert "(out of memory; it asks for 1.50 GB now)" in done.stdout
    assert re.search(f"block 00: {KILLED}; continues from its last checkpoint, attempts left: 3", done.stdout)
    assert "block 00: crashed by the loss of its worker" in done.stdout
    assert "2 of 2 blocks done" in done.stdout
    assert (run / "blocks/00/output.log").read_text().count("--- ") == 3


def waits_again(driver: Command, shard: int, *before: int) -> int:
    """The process of a shard, or block, that waits now, when those before have ended."""
    found = dict[int, int]()

    def look() -> bool:
        found.update(waiting_shards(driver, 1))
        return found.get(shard, before[0]) not in before

    wait_until(look)
    return found[shard]


def another_vdgs(folder: Path) -> Path:
    """A folder to import a vdgs from that differs by one file."""
    source = Path(cli.__file__).parents[1]
    shutil.copytree(source, folder / "vdgs", ignore=shutil.ignore_patterns("*.so"))
    (folder / "vdgs/of_another_version.py").touch()
    # An installation that leads to its sources by a hook would lead there from that node too.
    (folder / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [each for each in sys.meta_path if 'editable' not in type(each).__module__]\n"
        "from support.ray_agents import stand_in_for_agents\nstand_in_for_agents()\n"
    )
    return folder
