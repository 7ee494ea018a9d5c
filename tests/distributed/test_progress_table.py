"""What is shown of jobs that run side by side, and how many run by default."""

import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from vdgs.distributed.progress_table import build_progress_table, progress_line
from vdgs.distributed.resource_allocation import default_jobs
from vdgs.distributed.shard_progress import ProgressStats, ShardProgress, read_progress_stats, seconds_left_overall
from vdgs.distributed.task_process import error_message

pytestmark = pytest.mark.slow


@given(st.dictionaries(st.sampled_from(["iteration", "iterations", "psnr_training", "anchors", "seconds_left",
    "peak_memory_bytes"]), st.one_of(st.none(), st.booleans(), st.floats(), st.integers(), st.just(10**400),
    st.text(max_size=3), st.lists(st.integers(), max_size=2))))  # fmt: skip
def test_any_status_can_be_shown(tmp_path_factory, status):
    path = tmp_path_factory.getbasetemp() / "any_status.json"
    path.write_text(json.dumps({"state": "running", **status}))
    row = ShardProgress(0)
    row.restart()
    row.observe(read_progress_stats(path), 1.0)
    console = Console(file=io.StringIO(), width=200)
    console.print(build_progress_table([row, ShardProgress(1)], 1, 10))
    assert "0/2 done" in console.file.getvalue()
    assert "1 running" in progress_line([row], 1)


@given(st.integers(1, 60), st.integers(1, 128), st.integers(0, 10**12), st.integers(0, 10**11))
def test_default_jobs_fit_the_machine(blocks, cores, available, each):
    jobs, threads = default_jobs(blocks, cores, available, each)
    assert 1 <= jobs <= min(blocks, cores)
    assert jobs * threads <= cores
    assert jobs == 1 or jobs * each <= available


def test_default_jobs_on_known_machines():
    assert default_jobs(8, 2, 8 * 10**9, 2 * 10**9) == (2, 1)
    assert default_jobs(8, 2, 3 * 10**9, 2 * 10**9) == (1, 2)
    assert default_jobs(4, 64, 10**12, 5 * 10**9) == (4, 16)


def test_time_left_follows_from_speed_and_what_waits():
    first, second, third = rows = [ShardProgress(i) for i in range(3)]
    assert seconds_left_overall(rows, 2) is None
    first.restart()
    first.observe(ProgressStats(iteration=0, iterations=100), 0.0)
    first.observe(None, 5.0)  # a reading that failed
    first.observe(ProgressStats(iteration=50, iterations=100), 10.0)
    assert first.speed == pytest.approx(5.0)
    assert seconds_left_overall(rows, 1) == pytest.approx(10 + 20 + 20)
    assert seconds_left_overall(rows, 2) == pytest.approx(25)
    first.state = second.state = third.state = "done"
    assert seconds_left_overall(rows, 2) == 0.0


def test_a_new_attempt_has_a_speed_of_its_own():
    row = ShardProgress(0)
    row.restart()
    for second in range(3):
        row.observe(ProgressStats(iteration=100 * second, iterations=1000), float(second))
    row.observe(ProgressStats(iteration=50, iterations=1000), 10.0)
    assert row.speed is None


def test_the_table_fits_the_screen_and_keeps_what_matters():
    rows = [ShardProgress(i) for i in range(40)]
    rows[37].restart()
    rows[38].state = "failed"
    console = Console(file=io.StringIO(), width=80)
    figures = ProgressStats(
        iteration=11_200, iterations=15_000, psnr=24.31, anchors=1_234_567, seconds_left=5000.0,
        memory_bytes=1_400_000_000,
    )  # fmt: skip
    rows[37].observe(figures, 0.0)
    console.print(build_progress_table(rows, 2, 5))
    lines = [line for line in console.file.getvalue().splitlines() if line.strip()]
    assert len(lines) <= 5 + 5
    assert "…" not in "".join(lines)  # nothing is cut off on a narrow terminal
    assert "24.31  1,234,567" in "".join(lines)
    assert any(line.split()[:2] == ["37", "running"] for line in lines)
    assert any(line.split()[:2] == ["38", "failed"] for line in lines)
    assert "35 queued" in "\n".join(lines)


def test_the_message_is_found_among_the_output(tmp_path):
    output = tmp_path / "output.log"
    output.write_bytes(
        b"vdgs train-blocks: old\n--- again\nnoise\r\x1b[31m 50 %\x1b[0m\n"
        b"vdgs train-blocks: a.jpg: gone\nPut it back\n\n"
    )
    assert error_message(output) == "a.jpg: gone\nPut it back"
    output.write_bytes(b"Traceback\n  somewhere\nValueError: \xff\x07no\n")
    assert error_message(output) == "ValueError: �no"
    assert error_message(tmp_path / "missing") == ""
