"""The verbs of the command line: options as dataclasses, each handed to the room that does the work.

Nothing heavy is imported before the options are parsed, so that help and usage errors come at once.
"""

from __future__ import annotations

from vdgs.verbs.captures import inspect, synth
from vdgs.verbs.experiments import bench
from vdgs.verbs.exporting import export
from vdgs.verbs.machine import doctor
from vdgs.verbs.mapping import map
from vdgs.verbs.photographs import sfm
from vdgs.verbs.results import eval, render, report, status
from vdgs.verbs.stages import merge, partition, train, visibility
from vdgs.verbs.starting import coarse, run
from vdgs.verbs.viewing import view

__all__ = [
    "bench", "coarse", "doctor", "eval", "export", "inspect", "map", "merge", "partition", "render", "report", "run",
    "sfm", "status", "synth", "train", "view", "visibility",
]  # fmt: skip
