"""Stages whose work goes out in shards: whatever is lost on the way, the files are those of one process."""

import json
import re
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from support.clusters import COARSE, KILLED, alive, copy_run, evaluated, merge_run
from support.commands import begun, do_tasks_here, python, vdgs, wait_until
from support.hand_made_models import quadrants
from vdgs.config.method import AssignmentConfig
from vdgs.evaluation.evaluate_run import make_renderable_model
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.partition.assignment.score_matrix import compute_score_matrix
from vdgs.runs.open_run import OpenedRun, open_run
from vdgs.runs.run_folder import RunFolder

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("shards")]  # one worker, which trains once


@pytest.fixture(scope="module")
def merged(local, tmp_path_factory) -> Path:
    """Cut into two blocks, trained and merged."""
    return merge_run(local, tmp_path_factory.mktemp("merged") / "merged")


@pytest.fixture(scope="module")
def measured(merged) -> dict[str, object]:
    """What one process makes of it."""
    run = copy_run(merged, merged.parent / "measured")
    done = vdgs("eval", run)
    assert done.returncode == 0, done.stderr + done.stdout
    figures = evaluated(run / "evaluation")
    assert {"metrics.json", "by_block.json", "contact_sheet.png"} <= figures.keys()
    assert any(name.startswith("seams/") for name in figures)
    return figures


def test_views_measured_in_shards_are_those_of_one_process(merged, measured, tmp_path):
    run = copy_run(merged, tmp_path / "run")
    done = vdgs("eval", run, "--jobs", "2", prepare=do_tasks_here)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards done" in done.stdout
    assert evaluated(run / "evaluation") == measured
    assert json.loads((run / "evaluation/metrics.json").read_text())["fps"] is None
    assert not (run / "evaluation/shards").exists()
    assert vdgs("status", run).stdout.count("evaluation") == vdgs("status", merged).stdout.count("evaluation")


def test_exposed_views_are_the_same_in_shards_and_where_a_file_is_compared(uncut, tmp_path):
    run, measured = tmp_path / "run", tmp_path / "run" / "coarse" / "evaluation"
    trained = (
        "train-coarse",
        uncut.parent / "capture",
        "--output",
        run,
        *COARSE,
        "--test-every",
        "4",
        "--exposure-compensation",
    )
    for command in (trained, ("eval", run)):
        done = vdgs(*command)
        assert done.returncode == 0, done.stderr + done.stdout
    assert "in the exposure that the training photographs" in " ".join(done.stdout.split())
    figures, rows = (json.loads((measured / f"{name}.json").read_text()) for name in ("metrics", "per_view"))
    assert all(row["psnr"] != row["psnr_reference_exposure"] for row in rows)
    assert figures["psnr_reference_exposure"] == pytest.approx(
        np.mean([row["psnr_reference_exposure"] for row in rows])
    )
    one = evaluated(measured)
    assert is_evaluated(RunFolder(run), "coarse", None, 4)
    status = json.loads((measured / "status.json").read_text())
    assert status.pop("exposed") == "interpolated and metered"
    (measured / "status.json").write_text(json.dumps(status))  # as if measured in neutral colors
    assert not is_evaluated(RunFolder(run), "coarse", None, 4)
    done = vdgs("eval", run, "--jobs", "2", prepare=do_tasks_here)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "2 of 2 shards done" in done.stdout
    assert evaluated(measured) == one
    done = vdgs("export", run, "--output", tmp_path / "scene.ply")
    assert done.returncode == 0, done.stderr + done.stdout
    (loss,) = json.loads((run / "export.json").read_text())["losses"]
    assert loss["psnr"] == pytest.approx(figures["psnr_reference_exposure"], abs=1e-9)
    assert loss["ssim"] == pytest.approx(figures["ssim_reference_exposure"], abs=1e-9)
    assert abs(loss["psnr_baked"] - loss["psnr"]) < 0.5
    for command in (("lod", run, "--model", "coarse"), ("eval", run, "--lod-error", "0")):
        done = vdgs(*command)
        assert done.returncode == 0, done.stderr + done.stdout
    of_tree = json.loads((measured.with_name("evaluation_lod_0") / "metrics.json").read_text())
    assert of_tree["psnr"] == pytest.approx(figures["psnr_reference_exposure"], abs=1e-9)
    assert of_tree["psnr_reference_exposure"] is None
    assert json.loads((measured.with_name("evaluation_lod_0") / "status.json").read_text())["exposed"] is None
    assert_exposures_depart_from_one_exposure_for_all(open_run(run, "coarse"))
    done = vdgs("eval", run, "--views", "training")
    assert done.returncode == 0, done.stderr + done.stdout
    of_training = json.loads((measured.with_name("evaluation_training") / "metrics.json").read_text())
    assert "in the exposure that was fitted to each" in " ".join(of_training["notes"])


def assert_exposures_depart_from_one_exposure_for_all(opened: OpenedRun) -> None:
    """What is compared with photographs, and what chooses cameras, does not see the local exposure of the model."""
    without = replace(opened, model=opened.model.without_local_exposure())
    assert opened.model.local_exposure is not None
    local, plain = (make_renderable_model(run, run, "test") for run in (opened, without))
    view = opened.capture.test_views[0]
    assert torch.equal(local.render(view.camera).image, plain.render(view.camera).image)
    assert torch.equal(local.exposure(view), plain.exposure(view))
    assert plain.render_neutral is None
    assert not torch.equal(local.render_neutral(view.camera).image, plain.render(view.camera).image)
    cameras, blocks = [each.camera for each in opened.capture.train_views[:2]], quadrants(core=1e3)
    scores = [
        compute_score_matrix(run.model, blocks, cameras, AssignmentConfig(mode="paper")) for run in (opened, without)
    ]
    assert np.array_equal(scores[0].scores, scores[1].scores)


def test_whatever_is_stopped_or_killed_views_that_were_measured_are_not_measured_again(merged, measured, tmp_path):
    run = copy_run(merged, tmp_path / "run")
    with begun("eval", run, "--jobs", "2", pause_at=("*/shards/*/00000[13].npz", 1)) as first:
        first.wait_until_paused(2)
        first.send_signal(signal.SIGINT)
        done = first.finished()
    assert done.returncode == 130, done.stderr + done.stdout
    assert "every shard that was at work is saved. The same command continues" in done.stderr
    (work,) = (run / "evaluation/shards").iterdir()
    kept = {file: file.stat().st_mtime_ns for file in work.glob("*/*.npz")}
    assert {file.stem for file in kept} == {"000000", "000002"}
    assert {json.loads(file.read_text())["state"] for file in work.glob("0[01]/status.json")} == {"stopped"}
    with begun("eval", run, "--jobs", "2", pause_at=("*/shards/*/000001.npz", 1)) as second:
        second.wait_until_paused(1)
        second.kill_paused()  # the shard alone: it is started again
        wait_until(lambda: "crashed by SIGKILL" in second.printed())
        assert {file: file.stat().st_mtime_ns for file in kept} == kept
        done = second.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert re.search(f"shard 00: {KILLED}; continues from its last checkpoint, attempts left: 2", done.stdout)
    assert evaluated(run / "evaluation") == measured


def test_cameras_scored_in_shards_are_assigned_as_by_one_process(tmp_path, uncut):
    """Also where the driver was killed after it had cut, and then the shard that was left."""
    one, run = copy_run(uncut, tmp_path / "one"), copy_run(uncut, tmp_path / "run")
    cut = ("--blocks", "3", "--assignment.min-cameras", "3")
    assert vdgs("partition", one, *cut).returncode == 0
    command = ("partition", run, *cut, "--jobs", "2")
    with begun(*command, pause_at=("*/shards/*/000001.npz", 1)) as first:
        first.wait_until_paused(1)
        pattern = "partition/shards/*/00/status.json"
        wait_until(lambda: [json.loads(file.read_text())["state"] for file in run.glob(pattern)] == ["done"])
        first.send_signal(signal.SIGKILL)
        first.finished()
        (shard,) = first.paused()
        wait_until(lambda: not alive(shard))
    with begun(*command, pause_at=("*/shards/*/000001.npz", 1)) as second:
        second.wait_until_paused(1)
        second.kill_paused()
        done = second.finished()
    assert done.returncode == 0, done.stderr + done.stdout
    assert "1 of 2 shards to score cameras" in done.stdout
    assert "shard 01: crashed by SIGKILL" in done.stdout
    assert evaluated(run / "partition") == evaluated(one / "partition")


def test_what_a_shard_cannot_do_is_said_in_its_words(merged, tmp_path):
    run = copy_run(merged, tmp_path / "run")
    folder = Path(RunFolder(run).settings().capture_path) / "images"
    whole = {file: file.read_bytes() for file in folder.iterdir()}
    try:
        for file, content in whole.items():
            file.write_bytes(content[: len(content) // 2])
        done = vdgs("eval", run, "--jobs", "2")
    finally:
        for file, content in whole.items():
            file.write_bytes(content)
    assert done.returncode == 1
    assert "2 of 2 shards failed:" in done.stderr
    assert done.stderr.count("changed: photographs. Restore the capture") == 2
    assert "NN/output.log. The same command tries them again" in done.stderr
    (job,) = (run / "evaluation/shards").iterdir()
    done = python(f"import sys\nfrom vdgs.distributed.run_shard import main\nsys.exit(main([{str(job)!r}, '7']))")
    assert done.returncode == 1
    assert "vdgs shard: " in done.stderr
    assert "there is no shard 7; they are 0 to 1" in done.stderr
