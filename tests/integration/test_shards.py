"""Stages whose work goes out in shards: whatever is lost on the way, the files are those of one process."""

import importlib
import io
import json
import os
import re
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from support.clusters import COARSE, KILLED, alive, copy_run, evaluated, merge_run, train_here
from support.commands import CommandsHere, begun, do_tasks_here, python, threads_as_before, vdgs, wait_until
from support.forking import start_tasks
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.serialization import to_dict
from vdgs.distributed import run_shard as entry
from vdgs.distributed.job_folders import clear, remove
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.shard import WORKERS, Results, Shard, run_shard, shard_session
from vdgs.distributed.sharded_job import REQUEST, ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.block_seams import BlockViewMetrics
from vdgs.evaluation.by_block import BlockMetrics, SeamMetrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.comparison_images import Thumbnail
from vdgs.evaluation.depth_errors import DepthErrors
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.evaluation.view_metrics import ViewMetrics
from vdgs.evaluation.view_metrics_io import load_view_metrics, save_view_metrics
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import write_json
from vdgs.system.file_locks import lock_folder
from vdgs.system.stop_signals import catch_stop_signals, check_stop_requested

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("shards")]  # one worker, which trains once


@given(st.integers(1, 5000), st.integers(1, 5), st.integers(5, 40), st.integers(1, 30))
def test_spans_hold_every_item_once_and_are_about_equal(items, least, most, shards):
    spans = split_ranges(items, least, most, shards)
    assert [item for span in spans for item in span] == list(range(items))
    lengths = [len(span) for span in spans]
    assert max(lengths) <= most
    assert max(lengths) - min(lengths) <= 1
    assert len(spans) <= max(shards, -(-items // most))


def random_view(rng: np.random.Generator) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    visibility = rng.integers(0, 40, (6, 7)).astype(np.float32)
    visibility[rng.random((6, 7)) < 0.2] = np.nan
    return visibility, {name: rng.random((6, 7)) for name in ("squared_error", "ssim")}


def test_what_views_come_to_merges_to_the_bits_of_one_count_and_is_read_back_to_the_last(tmp_path):
    rng = np.random.default_rng(3)
    whole, parts = VisibilityHistogram(["squared_error", "ssim"]), VisibilityHistogram(["squared_error", "ssim"])
    blocks, blocks_parts, seams, seams_parts = (
        BlockMetrics(3, ["a"]),
        BlockMetrics(3, ["a"]),
        SeamMetrics(),
        SeamMetrics(),
    )
    errors, errors_parts = DepthErrors(), DepthErrors()
    for place in range(12):
        visibility, values = random_view(rng)
        own, of_blocks, of_seams, depth = (
            VisibilityHistogram([*values]),
            BlockMetrics(3, ["a"]),
            SeamMetrics(),
            DepthErrors(),
        )
        labels = rng.integers(-1, 3, (6, 7)).astype(np.int16)
        per_block = {"a": np.where(labels == 1, np.nan, values["ssim"])}
        per_seam = {name: rng.random((6, 7)) for name in seams._sums}
        found = rng.random(9)
        for histogram in (whole, own):
            histogram.add(visibility, values)
        for metrics in (blocks, of_blocks):
            metrics.add(labels, per_block)
        for each in (seams, of_seams):
            each.add(labels, per_seam)
        for each in (errors, depth):
            each.add(found)
        row = {
            "psnr": float(rng.normal()),
            "inf": float("inf"),
            "nothing": None,
            "name": "ü/1.jpg",
            "nan": float("nan"),
        }
        pixels = rng.integers(0, 255, (3, 4, 3), np.uint8)
        cell = Thumbnail("ü", "1 dB", pixels, pixels[::-1].copy()) if place % 2 else None
        save_view_metrics(
            tmp_path / "1.npz",
            ViewMetrics(row, own, {"median": depth}, cell),
            BlockViewMetrics(row, of_blocks, of_seams),
        )
        read, read_blocks = load_view_metrics(tmp_path / "1.npz")
        assert repr(read.row) == repr(row) == repr(read_blocks.row)
        assert (read.cell is None) == (cell is None)
        if cell is not None:
            assert (read.cell.name, read.cell.caption) == (cell.name, cell.caption)
            assert (read.cell.render == cell.render).all()
            assert (read.cell.photograph == cell.photograph).all()
        parts.merge(read.by_visibility)
        blocks_parts.merge(read_blocks.by_block)
        seams_parts.merge(read_blocks.seams)
        errors_parts.merge(read.depth_errors["median"])
    assert parts.bins(5) == whole.bins(5)
    for one, other in ((whole, parts), (blocks, blocks_parts), (seams, seams_parts), (errors, errors_parts)):
        ours, theirs = one.to_arrays(), other.to_arrays()
        assert {name: each.tobytes() for name, each in ours.items()} == {
            n: each.tobytes() for n, each in theirs.items()
        }


def test_a_file_of_a_view_that_is_damaged_is_named(tmp_path):
    file = tmp_path / "03/1.npz"
    with pytest.raises(RunError, match=r"1\.npz: is missing or damaged .* Delete .*03 and run"):
        load_view_metrics(file)
    save_view_metrics(file, ViewMetrics({}))
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(RunError, match="is missing or damaged"):
        load_view_metrics(file)


def test_a_shard_says_how_far_it_is_and_how_it_ended(tmp_path):
    folder = StageFolder(tmp_path / "00")
    with shard_session(folder, 1, 3) as tell:
        assert folder.is_locked_elsewhere()
        assert (folder.status().state, folder.status().iteration, folder.status().iterations) == ("running", 1, 3)
        tell(3)
    assert (folder.status().state, folder.status().iteration) == ("done", 3)
    with pytest.raises(VdgsError, match="gone"), shard_session(folder, 1, 3):
        raise VdgsError("a.jpg: gone")
    assert (folder.status().state, folder.status().reason) == ("failed", "a.jpg: gone")
    with pytest.raises(Stopped, match="Stopped after 2 of 3"), catch_stop_signals():
        _stopped_at_two(folder)
    assert (folder.status().state, folder.status().iteration) == ("stopped", 2)


def _stopped_at_two(folder: StageFolder) -> None:
    with shard_session(folder, 1, 3) as tell:
        tell(2)
        os.kill(os.getpid(), signal.SIGTERM)
        wait_until(check_stop_requested)


@dataclass(frozen=True)
class Halving:
    """What the shards of `job_of` are asked for."""

    output: Path
    number: float
    name: str
    box: tuple[float, float] | None = None
    device: str = "cpu"


def job_of(output: Path, name: str, number: float = 0.1) -> ShardedJob:
    """A job whose items are halved again and again."""
    request = Halving(output, number, name, (1e-17, 1 / 3), device="of the driver")
    return ShardedJob.create("halves", request, output, shard_kind("halve", "numbers"), name, [range(2), range(2, 5)])


def halve_shard(shard: Shard) -> None:
    """A worker; the third item has no half before it is allowed to."""
    asked = shard.request(Halving)
    assert (asked.box, asked.device) == ((1e-17, 1 / 3), "cpu")  # as it was, but for what changes no result

    def results(left: Sequence[int]) -> Results:
        for item in left:
            if item == 3 and not (asked.output / "go").exists():
                raise RunError("3: has no half")
            yield lambda file, item=item: file.write_text(repr(asked.number / 2**item))

    shard.do(job_of(asked.output, asked.name), results)


@pytest.fixture
def halves(monkeypatch):
    monkeypatch.setitem(WORKERS, "halves", f"{__name__}:halve_shard")


def shard_of(job: ShardedJob, index: int) -> Shard:
    return Shard(job.folder, index, "cpu", 0.0, Console(file=io.StringIO()))


def test_workers_are_there():
    for worker in WORKERS.values():
        module, _, name = worker.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


def test_a_job_keeps_what_is_done_and_is_gathered_in_the_order_of_its_items(tmp_path, halves, monkeypatch):
    monkeypatch.setattr("vdgs.distributed.backend_selection.LocalExecutor", CommandsHere)
    job, console = job_of(tmp_path, "this"), Console(file=io.StringIO(), width=200)
    needs, wish = (
        ShardNeeds(1, lambda: pytest.fail("asked of this machine")),
        ExecutionOptions(ExecutorOptions(), jobs=2),
    )
    with pytest.raises(AssertionError, match="exit code 1"), job.exclusive():
        job.run(needs, wish, console)
    assert job.pending == [1]
    assert "3: has no half" in (job.shard(1).path / "output.log").read_text()
    (tmp_path / "go").touch()
    kept = job.file(2).stat().st_mtime_ns
    with job.exclusive():
        job.run(needs, wish, console)
        assert "1 of 2 shards to halve" in console.file.getvalue()
        assert job.file(2).stat().st_mtime_ns == kept
        assert [float(text) for text in job.gather(Path.read_text)] == [0.1 / 2**item for item in range(5)]
    assert [each.name for each in tmp_path.iterdir()] == ["go"]


def test_a_shard_refuses_what_it_was_not_made_for(tmp_path, halves):
    job = job_of(tmp_path, "this")
    with threads_as_before():
        assert entry.main([str(job.folder), "0", "--threads", "1"]) == 1  # no request
    for request, said in (
        ({"worker": "os:system", "request": {}}, "names no worker of this vdgs"),
        (["halves"], "names no worker of this vdgs"),
        ({"worker": "halves", "request": {"numbers": 1}}, "is damaged .*did you mean 'number'"),
        ({"worker": "halves"}, "is damaged"),
    ):
        write_json(job.folder / REQUEST, request)
        with pytest.raises(RunError, match=said):
            run_shard(shard_of(job, 0))
    asked = to_dict(job.request) | {"device": "cpu"}
    write_json(job.folder / REQUEST, {"worker": "halves", "request": asked})
    with pytest.raises(RunError, match="there is no shard 2; they are 0 to 1"):
        run_shard(shard_of(job, 2))
    write_json(job.folder / REQUEST, {"worker": "halves", "request": asked | {"name": "that"}})
    with pytest.raises(RunError, match="is for another model, other settings or another vdgs"):
        run_shard(shard_of(job, 0))
    assert not job.file(0).exists()


def test_shards_of_other_jobs_go_unless_they_are_at_work(tmp_path):
    wanted, other = (job_of(tmp_path, name) for name in ("this", "that"))
    assert wanted.key != other.key
    for job in (wanted, other):
        job.mark_queued()
    with wanted.exclusive(), pytest.raises(RunError, match="another vdgs process"), wanted.exclusive():
        pass
    assert not list(tmp_path.iterdir())
    for job in (wanted, other):
        job.mark_queued()
    with wanted.shard(0).locked(), pytest.raises(RunError, match="that an earlier command sent out"):
        clear(tmp_path)
    with (
        lock_folder(wanted.folder),
        pytest.raises(RunError, match="another vdgs process gathers shards there"),
        other.exclusive(),
    ):
        pass
    assert wanted.folder.exists()


def test_what_a_person_keeps_in_a_folder_of_that_name_stays(tmp_path):
    """A folder for maps may be any: `shards` in it may hold a chess set, folders named by digests, links to others."""
    theirs = [tmp_path / "shards" / name for name in ("rook.png", "white/king.png", "0123456789ab/queen.png")]
    for file in theirs:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"ours")
    elsewhere = job_of(tmp_path / "elsewhere", "that")
    elsewhere.mark_queued()
    (tmp_path / "shards" / "ba9876543210").symlink_to(elsewhere.folder)
    wanted, other = (job_of(tmp_path, name) for name in ("this", "that"))
    for job in (wanted, other):
        job.mark_queued()
    clear(tmp_path, wanted.key)
    assert wanted.folder.exists()
    assert not other.folder.exists()
    remove(wanted.folder)
    clear(tmp_path)
    assert not wanted.folder.exists()
    assert all(file.read_bytes() == b"ours" for file in theirs)
    assert elsewhere.shard(0).status().state == "queued"


def test_the_folder_of_all_jobs_goes_with_the_last(tmp_path):
    """Also where a driver ended before any shard was queued, and where another works for the same folder."""
    begun, other = (job_of(tmp_path, name) for name in ("begun", "other"))
    begun.folder.mkdir(parents=True)
    other.mark_queued()
    remove(other.folder)
    assert begun.folder.exists()
    clear(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def merged(uncut, tmp_path_factory) -> Path:
    """Cut into two blocks, trained and merged."""
    run = copy_run(uncut, tmp_path_factory.mktemp("merged") / "cut")
    done = vdgs("partition", run, "--blocks", "2", "--assignment.min-cameras", "3")
    assert done.returncode == 0, done.stderr + done.stdout
    return merge_run(train_here(run, run.parent / "local"), run.parent / "merged")


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
    assert loss["psnr"] == pytest.approx(figures["psnr"], abs=1e-9)
    assert loss["ssim"] == pytest.approx(figures["ssim"], abs=1e-9)
    assert abs(loss["psnr_baked"] - loss["psnr"]) < 0.5
    done = vdgs("eval", run, "--views", "training")
    assert done.returncode == 0, done.stderr + done.stdout
    of_training = json.loads((measured.with_name("evaluation_training") / "metrics.json").read_text())
    assert "in the exposure that was fitted to each" in " ".join(of_training["notes"])


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
    with begun(*command, pause_at=("*/shards/*/000001.npz", 1), prepare=start_tasks) as first:
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
