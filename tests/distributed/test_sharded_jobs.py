"""Jobs in shards and what one shard does: spans, folders, files of what views come to, and what is refused."""

from __future__ import annotations

import importlib
import io
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from support.commands import CommandsHere, threads_as_before, wait_until
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.serialization import to_dict
from vdgs.distributed import run_shard as entry
from vdgs.distributed.executor import TaskResources
from vdgs.distributed.job_folders import clear, remove
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.resource_allocation import Allocation
from vdgs.distributed.shard import WORKERS, Results, Shard, run_shard, shard_session
from vdgs.distributed.sharded_job import REQUEST, ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.block_seams import BlockViewMetrics
from vdgs.evaluation.by_block import BlockMetrics, SeamMetrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.comparison_images import Thumbnail
from vdgs.evaluation.depth_errors import DepthErrors
from vdgs.evaluation.view_metrics import ViewMetrics
from vdgs.evaluation.view_metrics_io import load_view_metrics, save_view_metrics
from vdgs.kernels.device_selection import AnyCard
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import write_json
from vdgs.system.file_locks import lock_folder
from vdgs.system.stop_signals import catch_stop_signals, check_stop_requested


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
            ViewMetrics(row, own, {"median": depth}, cell=cell),
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


def test_shards_are_given_to_the_cards_in_turn(tmp_path):
    job, share = job_of(tmp_path, "this"), Allocation(4, TaskResources(2, 10**9), 1.0)
    commands = job._commands([1, 4, 5], share, ("cuda:0", "cuda:1"), "cuda:0")
    cards = ["cuda:0", "cuda:1", "cuda:0"]
    assert [each.command[-1] for each in commands] == [each.resources.device for each in commands] == cards
    for device, on in (("cpu", "cpu"), ("cuda:1", "cuda:1"), (AnyCard("cuda:1"), "cuda")):
        (alone,) = job._commands([1], share, (), device)
        assert (alone.command[-1], alone.resources) == (on, share.resources)


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


def test_a_gathered_job_goes_where_open_files_keep_their_folder(tmp_path, monkeypatch):
    """NFS renames a file that is removed while a process has it open, and its folder is not empty then."""
    plain = os.unlink

    def unlink(path, *, dir_fd=None):
        folder = Path(path).parent if dir_fd is None else Path(os.readlink(f"/proc/self/fd/{dir_fd}"))
        file = (folder / Path(path).name).resolve()
        handles = [Path("/proc/self/fd") / number for number in os.listdir("/proc/self/fd")]
        if any(os.path.realpath(handle) == str(file) for handle in handles):
            file.rename(file.with_name(f".nfs{len(handles):08x}"))
        else:
            plain(path, dir_fd=dir_fd)

    monkeypatch.setattr(os, "unlink", unlink)
    monkeypatch.setattr(Path, "unlink", lambda path, missing_ok=False: unlink(path) if path.exists() else None)
    job, other = (job_of(tmp_path, name) for name in ("this", "that"))
    with job.exclusive():
        job.mark_queued()
    assert not list(tmp_path.iterdir())
    with job.exclusive():
        job.mark_queued()
        log = (job.shard(0).path / "output.log").open("w")  # of a shard that has not ended yet
    (kept,) = job.shard(0).path.iterdir()
    log.close()
    kept.unlink()  # as NFS does once nobody has it open
    with other.exclusive():
        pass
    assert not list(tmp_path.iterdir())


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
