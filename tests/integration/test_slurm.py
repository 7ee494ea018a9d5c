"""Work as jobs of SLURM: a real one of this machine where it is installed, and always a stand-in for its commands."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.clusters import (
    BLOCKS,
    KILLED,
    MIDDLE,
    alive,
    copy_run,
    evaluated,
    keeper_of,
    models,
    waiting_shards,
)  # fmt: skip
from support.commands import begun, vdgs, wait_until
from support.shard_server import VARIABLE, shard_server, started
from support.slurm import is_installed, real, stand_in
from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed import slurm_commands
from vdgs.distributed.executor import TaskResources
from vdgs.distributed.slurm_executor import make_batch_script

pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("shards"),
    pytest.mark.skipif(sys.platform != "linux", reason="who is whose parent is read from /proc"),
]
OWN = ("--cpus", "1", "--mem-gb", "1", "--slurm.poll-seconds", "0.2", "--slurm.time", "1:00:00")
WITHOUT = "SLURM is not installed: apt-get install slurmctld slurmd slurm-client"


BOTH = [pytest.param("real", marks=pytest.mark.skipif(not is_installed(), reason=WITHOUT)), "stand-in"]


@pytest.fixture(params=["real" if is_installed() else "stand-in"])
def slurm(request, tmp_path, monkeypatch) -> str:
    """SLURM's commands find a cluster of two places."""
    folder = tmp_path / "slurm"
    folder.mkdir()
    with shard_server() as forks, real(folder) if request.param == "real" else stand_in(folder) as variables:
        for name, value in (forks | variables).items():
            monkeypatch.setenv(name, value)
        yield request.param


def by_slurm(run: Path) -> tuple[object, ...]:
    return ("train-blocks", run, *BLOCKS, "--executor", "slurm", *OWN)


def variables() -> dict[str, str]:
    """What commands must be told: those of the tests are forked from a process that was started before."""
    names = ("SLURM_CONF", "VDGS_TEST_SLURM", "PATH", "PYTHONPATH", VARIABLE)
    return {name: os.environ[name] for name in names if name in os.environ}


def element_of(process: int) -> str:
    """The job that a process belongs to."""
    words = Path(f"/proc/{started(process)}/environ").read_bytes().decode().split("\0")
    told = dict(word.partition("=")[::2] for word in words)
    return f"{told['SLURM_ARRAY_JOB_ID']}_{told['SLURM_ARRAY_TASK_ID']}"


def let_go_on_at_once(element: str) -> None:
    """Spare a job that was put back into the queue the two minutes that SLURM lets it wait."""
    if is_real():
        wait_until(
            lambda: ("PENDING", element) in {(each.state, str(each.task_id)) for each in slurm_commands.list_queue("")}
        )
        subprocess.run(["scontrol", "update", f"JobId={element}", "StartTime=now"], check=True)


def is_real() -> bool:
    return "VDGS_TEST_SLURM" not in os.environ


@pytest.mark.parametrize("slurm", BOTH, indirect=True)
def test_time_limits_kills_and_lost_jobs_end_in_the_models_of_the_local_run(slurm, cut, local, tmp_path):
    run = copy_run(cut, tmp_path / "run")
    with begun(*by_slurm(run), pause_at=(MIDDLE, 1), environment=variables()) as driver:
        waiting = waiting_shards(driver, 2)
        # What SLURM sends some time before the limit: the block saves, and its job has a second turn.
        subprocess.run(["scancel", "--batch", "--signal=USR1", element_of(waiting[0])], check=True)
        let_go_on_at_once(element_of(waiting[0]))
        os.kill(waiting[1], signal.SIGKILL)
        waiting = waiting_shards(driver, 4)
        os.kill(keeper_of(waiting[1]), signal.SIGKILL)  # the job's own process
        driver.wait_until_paused(5)
        driver.go_on()
        done = driver.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert models(run) == models(local)
    assert re.search(f"block 01: {KILLED}; continues from its last checkpoint, attempts left: 2", done.stdout)
    assert "block 01: crashed by SLURM (FAILED)" in done.stdout
    assert "block 00: saved and waits for another turn" in done.stdout
    assert "block 00: crashed" not in done.stdout


def test_a_driver_that_was_killed_finds_its_jobs_again_and_stops_them_when_asked(slurm, uncut, tmp_path):
    """Two shards that measure views; what they saved leads to the figures of one process."""
    here, run = (copy_run(uncut, tmp_path / name / "run") for name in ("here", "there"))
    assert vdgs("eval", here).returncode == 0
    command = ("eval", run, "--executor", "slurm", *OWN)
    with begun(*command, pause_at=("*/shards/*/00000[13].npz", 1), environment=variables()) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGKILL)
        first.finished()
        with begun(*command, environment=variables()) as second:
            wait_until(lambda: second.printed().count("is watched again") == 2)
            second.send_signal(signal.SIGINT)
            done = second.finished()
        assert done.returncode == 130, done.stderr + done.stdout
        assert not any(alive(process) for process in first.paused())
    (work,) = (run / "coarse/evaluation/shards").iterdir()
    assert {file.stem for file in work.glob("*/*.npz")} == {"000000", "000002"}
    done = vdgs(*command, environment=variables())
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards done" in done.stdout
    assert evaluated(run / "coarse/evaluation") == evaluated(here / "coarse/evaluation")
    assert not (run / "slurm").exists()


def test_what_slurm_refuses_is_said_in_its_own_words(cut, tmp_path, monkeypatch):
    run = copy_run(cut, tmp_path / "run")
    with stand_in(tmp_path) as told:
        for name, value in told.items():
            monkeypatch.setenv(name, value)
        done = vdgs(*by_slurm(run), "--cpus", "64", environment=variables())
    assert done.returncode == 1
    assert "Requested node configuration is not available" in done.stderr
    assert "job.sh" in done.stderr


def test_where_there_is_no_slurm_it_is_said(cut, monkeypatch):
    done = vdgs(*by_slurm(cut), environment={"PATH": "/nowhere"})
    assert done.returncode == 1
    assert "There is no sbatch" in done.stderr


def test_a_script_asks_for_what_a_block_needs(tmp_path):
    options = SlurmOptions(
        partition="gpu", account="lab", time="8:00:00", grace_seconds=300, setup_command="module load cuda",
        sbatch_args=("--qos=long",),
    )  # fmt: skip
    lines = make_batch_script(tmp_path / "vdgs-a", 8, TaskResources(4, 5 << 30, 1), options, 3).splitlines()
    for asked in (
        "--array=0-7%3", "--cpus-per-task=4", "--mem=5120M", "--gres=gpu:1", "--partition=gpu", "--account=lab",
        "--time=8:00:00", "--signal=B:USR1@300", "--requeue", "--qos=long",
    ):  # fmt: skip
        assert f"#SBATCH {asked}" in lines
    assert lines[-2] == "module load cuda"
    assert lines[-1].startswith("exec ")
    plain = make_batch_script(tmp_path / "vdgs-a", 2, TaskResources(1), SlurmOptions(), 2)
    assert not any(word in plain for word in ("--mem", "--gres", "--partition", "--account", "--time", "%2"))
