"""The verbs of the command line: options as dataclasses, each handed to the room that does the work.

Nothing heavy is imported before the options are parsed, so that help and usage errors come at once.
"""

from __future__ import annotations

from vdgs.cli.bench_cmd import bench
from vdgs.cli.capture_cmds import inspect, synth
from vdgs.cli.doctor_cmd import doctor
from vdgs.cli.export_cmd import export
from vdgs.cli.ortho_cmd import map
from vdgs.cli.result_cmds import eval, render, report, status
from vdgs.cli.run_cmd import coarse, run
from vdgs.cli.sfm_cmd import sfm
from vdgs.cli.stage_cmds import merge, partition, train, visibility
from vdgs.cli.view_cmd import view

__all__ = [
    "bench", "coarse", "doctor", "eval", "export", "inspect", "map", "merge", "partition", "render", "report", "run",
    "sfm", "status", "synth", "train", "view", "visibility",
]  # fmt: skip
