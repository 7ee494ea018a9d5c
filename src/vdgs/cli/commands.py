"""The verbs of the command line: options as dataclasses, each handed to the room that does the work.

Nothing heavy is imported before the options are parsed, so that help and usage errors come at once.
"""

from __future__ import annotations

from vdgs.cli.bench_cmd import bench_command
from vdgs.cli.capture_cmds import inspect_command, synth_command
from vdgs.cli.doctor_cmd import doctor_command
from vdgs.cli.export_cmd import export_command
from vdgs.cli.ortho_cmd import ortho_command
from vdgs.cli.result_cmds import eval_command, render_command, report_command, status_command
from vdgs.cli.run_cmd import run_command, train_coarse_command
from vdgs.cli.sfm_cmd import sfm_command
from vdgs.cli.stage_cmds import merge_command, partition_command, train_blocks_command, visibility_command
from vdgs.cli.view_cmd import view_command

__all__ = [
    "bench_command",
    "doctor_command",
    "eval_command",
    "export_command",
    "inspect_command",
    "merge_command",
    "ortho_command",
    "partition_command",
    "render_command",
    "report_command",
    "run_command",
    "sfm_command",
    "status_command",
    "synth_command",
    "train_blocks_command",
    "train_coarse_command",
    "view_command",
    "visibility_command",
]
