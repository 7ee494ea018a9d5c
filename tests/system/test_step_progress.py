"""The small file that tells how far a step is."""

import os

import psutil

from vdgs.system.atomic_files import host_mark
from vdgs.system.step_progress import StepProgress, StepRecord, read_step


def test_what_a_killed_process_left_beside_it_goes(tmp_path):
    file, gone = tmp_path / "progress.json", next(n for n in range(2**22, 2, -1) if not psutil.pid_exists(n))
    left, at_work = (tmp_path / f".progress.json.{host_mark()}-{each}.tmp" for each in (gone, os.getppid()))
    left.touch()
    at_work.touch()
    StepProgress(file, StepRecord(stage="maps", total=3))(1)
    assert sorted(tmp_path.iterdir()) == sorted([file, at_work])
    assert read_step(file).done == 1
