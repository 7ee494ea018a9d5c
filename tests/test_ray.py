"""Work on a real Ray of several nodes on this machine: whatever is lost, the results are those of the local run."""

import importlib.util
import os
import re
import shutil
import signal
import sys
from pathlib import Path

import pytest

from cli_support import begun, vdgs, wait_until
from cluster_support import (
    BLOCKS,
    MIDDLE,
    Cluster,
    alive,
    block_of,
    copy_run,
    evaluated,
    make_run,
    models,
    parent_of,
    piece_of,
    train_here,
)  # fmt: skip
from vdgs import cli

pytestmark = [
    pytest.mark.xdist_group("ray"),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: pip install 'vdgs[ray]'"),
    pytest.mark.skipif(sys.platform != "linux", reason="who runs on which node is read from /proc"),
]


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    return make_run(tmp_path_factory.mktemp("ray"))


@pytest.fixture(scope="module")
def local(cut) -> Path:
    return train_here(cut, cut.parent / "local")


@pytest.fixture(scope="module")
def cluster():
    cluster = Cluster()
    cluster.add("a")
    cluster.add("b")
    yield cluster
    cluster.close()


def on_ray(run: Path, cluster: Cluster) -> tuple[object, ...]:
    return ("train", run, *BLOCKS, "--executor", "ray", "--address", cluster.address)


def another_code() -> None:
    """Let this process take itself for another version of vdgs."""
    from vdgs.executors import fitness

    fitness.code_identity = lambda: "of this machine"  # type: ignore[assignment]


def test_nodes_that_cannot_work_on_a_run_are_named_before_anything_starts(cut, cluster, tmp_path):
    run = copy_run(cut, tmp_path / "run")
    done = vdgs(*on_ray(run, cluster), prepare=another_code, environment=cluster.token)
    assert done.returncode == 1
    assert f"node {os.uname().nodename}: its vdgs" in done.stderr
    assert "not the same code" in done.stderr
    assert not list(run.glob("blocks/*/output.log"))
    assert not list(run.glob(".fitness*"))


def of_another_version(folder: Path) -> dict[str, str]:
    """What makes a node import another vdgs."""
    source = Path(cli.__file__).parent
    shutil.copytree(source, folder / "vdgs", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    (folder / "vdgs/of_another_version.py").touch()
    # An installation that leads to its sources by a hook would lead there from that node too.
    (folder / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [each for each in sys.meta_path if 'editable' not in type(each).__module__]\n"
    )
    return {"PYTHONPATH": str(folder)}


def test_whatever_is_lost_the_models_are_those_of_the_local_run(cut, local, cluster, tmp_path):
    """A node dies under a block; of two that join late one cannot work on the run, the other takes the block; a command
    is killed, then the worker that keeps it."""
    run = copy_run(cut, tmp_path / "run")
    with begun(*on_ray(run, cluster), pause_at=(MIDDLE, 1), environment=cluster.token) as driver:

        def wait_for(count: int) -> dict[int, int]:
            """The process of each block that waits now, once so many have waited in all."""
            driver.wait_until_paused(count)
            there = [process for process in driver.paused() if Path(f"/proc/{process}/cmdline").exists()]
            return {block_of(process): process for process in there}

        processes = wait_for(2)
        cluster.remove(cluster.node_of(processes[1]))
        wait_until(lambda: not alive(processes[1]))
        cluster.add("stranger", of_another_version(tmp_path / "stranger"))
        wait_until(lambda: "cannot work on the run" in driver.printed())
        cluster.add("late")
        processes = wait_for(3)
        assert cluster.node_of(processes[1]) == "late"
        os.kill(processes[0], signal.SIGKILL)
        processes = wait_for(4)
        os.kill(parent_of(processes[0]), signal.SIGKILL)
        wait_for(5)
        driver.go_on()
        done = driver.finished()
    cluster.remove("stranger")
    assert done.returncode == 0, done.stderr + done.stdout
    assert models(run) == models(local)
    assert "block 01: crashed by the loss of its node" in done.stdout
    assert done.stdout.count("crashed by a node that cannot work on the run") == 1
    assert "not the same code" in done.stdout
    assert "block 00: crashed by SIGKILL; continues from its last checkpoint, attempts left: 2" in done.stdout
    assert "block 00: crashed by the loss of its worker" in done.stdout
    assert "2 of 2 blocks done" in done.stdout
    assert (run / "blocks/00/output.log").read_text().count("--- ") == 3


def test_a_driver_that_was_killed_finds_its_blocks_again_and_stops_them_when_asked(cut, local, cluster, tmp_path):
    run = copy_run(cut, tmp_path / "run")
    with begun(*on_ray(run, cluster), pause_at=(MIDDLE, 1), environment=cluster.token) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGKILL)
        first.finished()
        assert all(alive(process) for process in first.paused())
        with begun(*on_ray(run, cluster), environment=cluster.token) as second:
            wait_until(lambda: "is watched again" in second.printed())
            wait_until(lambda: second.printed().count("is watched again") == 2)
            second.send_signal(signal.SIGINT)
            done = second.finished()
        assert done.returncode == 130, done.stderr + done.stdout
        assert "every block that was training is saved" in done.stderr
        assert not any(alive(process) for process in first.paused())
    done = vdgs(*on_ray(run, cluster), environment=cluster.token)
    assert done.returncode == 0, done.stderr + done.stdout
    assert models(run) == models(local)
    for block in (0, 1):
        assert "continuing at iteration 40" in (run / f"blocks/{block:02d}/output.log").read_text()


def test_views_are_measured_in_pieces_of_several_nodes_for_whatever_driver_lives(uncut, cluster, tmp_path):
    """The driver is killed while both pieces are at work; the next finds them, and the worker of one is killed."""
    here, run = (copy_run(uncut, tmp_path / name / "run") for name in ("here", "there"))
    done = vdgs("eval", here, "--views", "training")
    assert done.returncode == 0, done.stderr + done.stdout
    command = ("eval", run, "--views", "training", "--executor", "ray", "--address", cluster.address)
    with begun(*command, pause_at=("*/pieces/*/00000[19].npz", 1), environment=cluster.token) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGKILL)
        first.finished()
        keeper = {piece_of(piece): parent_of(piece) for piece in first.paused()}[0]
        assert len({cluster.node_of(piece) for piece in first.paused()}) == 2
        with begun(*command, environment=cluster.token) as second:
            wait_until(lambda: second.printed().count("is still at work") == 2)
            os.kill(keeper, signal.SIGKILL)
            wait_until(lambda: "piece 00: crashed by the loss of its worker" in second.printed())
            first.go_on()
            done = second.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert evaluated(run / "coarse/evaluation_training") == evaluated(here / "coarse/evaluation_training")


def test_a_map_is_put_together_from_pieces_of_several_nodes(uncut, cluster, tmp_path):
    pytest.importorskip("rasterio")
    command = ("map", uncut, "--gsd", "0.02", "--output")
    on_nodes = ("--executor", "ray", "--address", cluster.address)
    one = vdgs(*command, tmp_path / "one")
    pieces = vdgs(*command, tmp_path / "pieces", *on_nodes, environment=cluster.token)
    assert one.returncode == pieces.returncode == 0, one.stderr + pieces.stderr + pieces.stdout
    assert re.search(r"([2-9]) of \1 pieces done", pieces.stdout)
    assert evaluated(tmp_path / "pieces") == evaluated(tmp_path / "one")


def test_a_block_for_which_a_node_has_no_memory_goes_to_a_larger_one_and_a_slow_node_is_waited_for(
    cut, local, cluster, tmp_path
):
    """Ray itself ends the block on a node whose memory it takes for full; the other block stands still meanwhile."""
    run = copy_run(cut, tmp_path / "run")
    for name in list(cluster.names):
        cluster.remove(name)
    cluster.add("slow")
    with begun(*on_ray(run, cluster), "--memory-gb", "1", pause_at=(MIDDLE, 1), environment=cluster.token) as driver:
        driver.wait_until_paused(1)
        (slow,) = driver.paused()
        full = {"RAY_memory_monitor_refresh_ms": "100", "RAY_memory_usage_threshold": "0.001"}
        cluster.add("small", full, memory=1 << 30)
        wait_until(lambda: "crashed by Ray, to free memory" in driver.printed())
        cluster.add("large")
        wait_until(lambda: any(cluster.has(process, "large") for process in driver.paused()))
        os.kill(slow, signal.SIGSTOP)
        driver.go_on()
        wait_until((run / f"blocks/{1 - block_of(slow):02d}/model.safetensors").exists)
        os.kill(slow, signal.SIGCONT)
        done = driver.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert models(run) == models(local)
    assert "(out of memory; it asks for 1.50 GB now)" in done.stdout
