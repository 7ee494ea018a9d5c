"""The scene cut into blocks, and cameras for each: visibility, partition, assignment (section III-B).

RUN/visibility/  visibility.json, map.png
RUN/partition/   blocks.geojson (ground frame), blocks_wgs84.geojson (if georeferenced), scores.npz,
                 partition.json, blocks.png, block_facts.png, scores.png
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from vdgs.captures.capture import Capture
from vdgs.config import MethodConfig
from vdgs.evaluation.saving import write_json
from vdgs.memory import forget_peak, peak_memory_bytes
from vdgs.partition import figures
from vdgs.partition.assignment import Assignment, assign, assignment_table, block_rows, load_scores, save_scores
from vdgs.partition.blocks import Blocks, load_blocks, save_blocks, save_blocks_wgs84
from vdgs.partition.cut import choose_block_count, cut_scene
from vdgs.partition.scores import Scores, score_matrix
from vdgs.run import RunFolder
from vdgs.stages.block import places
from vdgs.stages.opening import TrainedRun, open_run
from vdgs.visibility import imbalance


def measure_visibility(run: RunFolder, console: Console) -> None:
    """V_i of every anchor: its distribution and a map from above. Skipped where it is there for this coarse model."""
    file, key = run.visibility / "visibility.json", run.keys().coarse
    if read_facts(file).get("key") == key:
        console.print(f"{file}: already there; nothing to do", highlight=False)
        return
    with run.locked():
        opened = open_run(run.path, "coarse")
        seen = opened.views_of_anchors().numpy()
        facts = asdict(imbalance(seen))
        figures.draw_visibility_map(
            run.visibility / "map.png", opened.model.anchors.positions.numpy(), seen, train_cameras(opened.capture),
            unit(opened.capture),
        )  # fmt: skip
        write_json(file, {"key": key, "anchors": len(seen), "training_views": len(opened.capture.train_views), **facts})
    quantiles = ", ".join(f"{share} %: {value:g}" for share, value in facts["quantiles"].items())
    console.print(
        f"cameras that see an anchor (V), by quantile: {quantiles}; Gini {facts['gini']:.2f}\n"
        f"map: {run.visibility / 'map.png'}",
        highlight=False,
    )


def partition_run(run: RunFolder, console: Console) -> None:
    """Cut the scene of a run and assign its cameras; what is there for the same settings is kept.

    Raises RunError without a coarse model.
    """
    keys, before = run.keys(), run.partition_facts()
    if (before.get("key"), before.get("assignment_key")) == (keys.partition, keys.assignment):
        console.print(f"{run.partition}: already cut; nothing to do", highlight=False)
        return
    with run.locked():
        forget_peak()
        began = time.monotonic()
        opened, method = open_run(run.path, "coarse"), run.method()
        positions, seen = opened.model.anchors.positions.numpy(), opened.views_of_anchors().numpy()
        if before.get("key") == keys.partition:
            blocks, warnings = load_blocks(run.partition / "blocks.geojson"), list(before.get("warnings", []))
        else:
            blocks, warnings = _cut(opened, positions, seen, method, console)
        with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
            task = bar.add_task("assigning cameras")
            scores = score_matrix(
                opened.model, blocks, train_cameras(opened.capture), method.assignment,
                lambda done, total: bar.update(task, completed=done, total=total),
            )  # fmt: skip
        assignment = assign(scores, method.assignment)
        for warning in warnings + assignment.complaints:
            console.print(f"[yellow]note[/] {warning}", highlight=False)
        _write(run, opened, blocks, scores, assignment, method, seen, warnings)
        facts = run.partition_facts()
        seconds, peak = time.monotonic() - began, peak_memory_bytes()
        write_json(
            run.partition / "partition.json",
            facts | {"seconds": seconds, "peak_memory_bytes": peak, "key": keys.partition, "assignment_key": keys.assignment},
        )  # fmt: skip
    console.print(assignment_table(facts["blocks"]))
    console.print(f"figures: {run.partition / 'blocks.png'} and beside it", highlight=False)


def read_facts(file: Any) -> dict[str, Any]:
    from vdgs.files import read_json

    facts = read_json(file) if file.exists() else {}
    return facts if isinstance(facts, dict) else {}


def train_cameras(capture: Capture) -> list[Any]:
    return [view.camera for view in capture.train_views]


def unit(capture: Capture) -> str:
    """What one unit of the ground frame is called."""
    return "m" if capture.ground.metric else "units"
