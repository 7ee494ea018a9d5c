"""A run that is stopped, killed, damaged or given other settings on its way: the same command continues it, and nothing
is built on what is out of date."""

import json
import shutil
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from support.commands import begun, is_free, vdgs, wait_until
from support.pipeline_run import SETTINGS, model

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pipeline")]


@pytest.mark.parametrize(("number", "blocks"), [(signal.SIGINT, ["00", "01"]), (signal.SIGKILL, ["01"])])
def test_a_run_that_is_cut_off_while_blocks_train_continues_to_the_same_bits(capture, unbroken, copied, number, blocks):
    """test_coarse.py shows that each other signal stops training as Ctrl-C does."""
    for name in ("merged", "evaluation", *(f"blocks/{block}" for block in blocks)):
        shutil.rmtree(copied / name)
    command = ("run", capture, "--output", copied, *SETTINGS)
    with begun(*command, pause_at=("*/blocks/*/checkpoints/00000040.json", 1)) as process:
        process.wait_until_paused(processes=len(blocks))
        process.send_signal(number)
        cut_off = process.finished()
    wait_until(lambda: is_free(copied))  # blocks notice that their driver is gone, save and end
    assert cut_off.returncode == (-number if number == signal.SIGKILL else 130)
    assert ("The same command continues" in cut_off.stderr) == (number != signal.SIGKILL)
    for block in blocks:
        status = json.loads((copied / "blocks" / block / "status.json").read_text())
        assert (status["state"], status["iteration"]) == ("stopped", 40)
    done = vdgs(*command)
    assert done.returncode == 0, done.stderr + done.stdout
    assert model(copied) == model(unbroken)


def test_a_block_that_is_killed_is_started_again(unbroken, copied):
    shutil.rmtree(copied / "blocks/01")
    with begun(
        "train-blocks", copied, "--save-every", "20", pause_at=("*/blocks/*/checkpoints/00000040.json", 1)
    ) as process:
        process.wait_until_paused()
        process.kill_paused()
        done = process.finished()
    assert done.returncode == 0, done.stderr
    assert "crashed by SIGKILL" in done.stdout
    assert "continuing at iteration 20" in (copied / "blocks/01/output.log").read_text()
    assert model(copied, "blocks/01/model.safetensors") == model(unbroken, "blocks/01/model.safetensors")


def swallow_ctrl_c() -> None:
    """Let Ctrl-C come between two stages, inside something that swallows it."""
    from vdgs.pipeline import run_pipeline

    def measure_visibility(*_: object) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    run_pipeline.count_run_visibility = measure_visibility  # type: ignore[assignment]


def test_ctrl_c_between_stages_stops_the_run_and_the_same_command_continues(capture, copied):
    shutil.rmtree(copied / "merged")
    stopped = vdgs("run", capture, "--output", copied, *SETTINGS, prepare=swallow_ctrl_c)
    assert stopped.returncode == 130
    assert "interrupted. The same command continues" in stopped.stderr
    assert not (copied / "merged").exists()
    done = vdgs("run", capture, "--output", copied, *SETTINGS, "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    status = vdgs("status", copied)
    assert status.returncode == 0, status.stdout
    assert "next: vdgs view" in status.stdout


def test_damaged_files_of_a_partition_are_named(copied):
    shutil.rmtree(copied / "blocks/00")
    for file in ("blocks.geojson", "scores.npz", "partition.json"):
        path = copied / "partition" / file
        whole = path.read_bytes()
        path.write_bytes(whole[:50])
        done = vdgs("train-blocks", copied, "--block", "0")
        assert done.returncode == 1
        assert file in done.stderr
        assert "Traceback" not in done.stderr
        assert "vdgs partition" in done.stderr
        mended = vdgs("partition", copied)  # what the message advises helps
        assert mended.returncode == 0, mended.stderr
        assert path.stat().st_size > 50
    assert vdgs("train-blocks", copied, "--block", "0").returncode == 0


#: Of a change of the coarse stage's settings: they are written, the old model is deleted, it is gone.
MOMENTS_OF_A_CHANGE = [("*/coarse/key", 3), ("*/coarse/model.safetensors", 1), ("*/coarse/.key.*", 1)]
OTHER_SEED = (*SETTINGS, "--seed", "7")


def change_cut_off(capture: Path, run: Path, moment: tuple[str, int]) -> None:
    """Ask for another seed, and kill the command before it trains."""
    with begun("run", capture, "--output", run, *OTHER_SEED, "--overwrite", pause_at=moment) as process:
        process.wait_until_paused()
        process.send_signal(signal.SIGKILL)
        process.finished()
    assert "seed: 7" in (run / "config.yaml").read_text()


def assert_not_cut(run: Path) -> None:
    refused = vdgs("partition", run)
    assert refused.returncode == 1
    assert "no coarse model of its settings" in refused.stderr


@pytest.mark.parametrize("moment", MOMENTS_OF_A_CHANGE[1:])
def test_nothing_is_built_on_a_model_of_other_settings(capture, copied, moment):
    """A change of the coarse stage's settings counts at once, even if training it again never began."""
    change_cut_off(capture, copied, moment)
    assert_not_cut(copied)


def test_all_that_was_built_on_a_model_of_other_settings_is_made_again(capture, copied):
    change_cut_off(capture, copied, MOMENTS_OF_A_CHANGE[0])
    assert_not_cut(copied)
    coarse_settings = OTHER_SEED[: OTHER_SEED.index("--blocks")]
    commands = (
        ("train-coarse", capture, "--output", copied, *coarse_settings, "--seed", "7"),
        ("visibility", copied), ("partition", copied), ("train-blocks", copied, "--block", "0"),
    )  # fmt: skip
    for command in commands:
        done = vdgs(*command)
        assert done.returncode == 0, done.stderr
        assert "nothing to do" not in done.stdout
    stale = vdgs("merge", copied)
    assert stale.returncode == 1
    assert "not all blocks are trained:\n  block 1" in stale.stderr


def test_a_block_trained_again_is_merged_again(unbroken, copied):
    shutil.rmtree(copied / "blocks/01")
    assert vdgs("merge", copied, "--allow-missing-blocks").returncode == 0
    assert model(copied) != model(unbroken)
    again = vdgs("merge", copied)
    assert again.returncode == 1
    assert "block 1: not trained yet" in again.stderr
    assert "nothing to do" in vdgs("merge", copied, "--allow-missing-blocks").stdout
    assert vdgs("train-blocks", copied, "--block", "1").returncode == 0
    assert vdgs("merge", copied).returncode == 0
    assert model(copied) == model(unbroken)
