"""The scene in blocks, and cameras for each: partition and assignment (section IV-B).

RUN/partition/   blocks.geojson (ground frame), blocks_wgs84.geojson (if georeferenced), scores.npz,
                 partition.json, blocks.png, block_facts.png, scores.png
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int
from rich import box
from rich.console import Console
from rich.table import Table

from vdgs.captures.capture import Capture
from vdgs.config.method import PartitionConfig
from vdgs.distributed.job_folders import clear, remove
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.shard import Results, Shard
from vdgs.distributed.sharded_job import ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.errors import RunError
from vdgs.geometry.camera import Camera
from vdgs.partition.assignment.assign_cameras import (
    Assignment,
    assign_cameras,
    assignment_rows,
    block_rows,
    explain_assignment,
    make_assignment_table,
)
from vdgs.partition.assignment.score_file import load_score_rows, load_scores, save_score_rows, save_scores
from vdgs.partition.assignment.score_matrix import CameraScorer, ScoreMatrix, compute_score_matrix, concatenate_scores
from vdgs.partition.block_records import BlockCamerasRecord, PartitionRecord
from vdgs.partition.blocks import Blocks, load_blocks, save_blocks, save_blocks_wgs84
from vdgs.partition.partition_scene import partition_scene
from vdgs.partition.plots import block_maps as figures
from vdgs.partition.strategies import STRATEGIES, adjust_scores, assignment_config, cut_scene
from vdgs.runs.open_run import OpenedRun
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import load_or_count_visibility
from vdgs.system.atomic_files import read_json, write_json
from vdgs.system.console import show_share
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.memory_estimate import render_bytes
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.records import record_to_dict

#: Cameras that are scored and saved together; such groups of a shard, least and most, and how many shards there are in
#: between (choice).
CAMERAS_PER_ITEM = 8
SHARD_ITEMS = 1, 8, 16
CAMERA_LABELS = shard_kind("score cameras", "groups")
#: The blocks, in the folder of the partition and in that of a job that scores cameras for them; the scores.
BLOCKS_FILE, SCORES_FILE = "blocks.geojson", "scores.npz"

Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class ScoreRequest:
    """The request of shards that score cameras: the run folder."""

    run: Path


@dataclass(frozen=True)
class _Scene:
    """What is partitioned: the coarse anchors and the cameras that see them."""

    opened: OpenedRun
    positions: Float[np.ndarray, "n 3"]
    visibility: Int[np.ndarray, " n"]
    cameras: list[Camera]

    @staticmethod
    def open(context: RunContext, device: str) -> _Scene:
        opened = context.open_model("coarse", device)
        cameras = [view.camera for view in opened.capture.train_views]
        positions = opened.model.anchors.positions.cpu().numpy()
        return _Scene(opened, positions, load_or_count_visibility(opened).numpy(), cameras)


def partition_run(
    context: RunContext, console: Console, device: str = "cpu", execution: ExecutionOptions | None = None
) -> None:
    """Partition the scene of a run and assign its cameras, drawing on a device; what is there for the same settings is
    kept.

    Cameras are scored in this process, or in shards where `execution` is distributed: the scores are the same. Raises
    RunError without a coarse model, and what `ShardedJob.send` raises.
    """
    run = context.run
    keys, before, saved = run.keys(), _record_or_empty(run), _saved_blocks(run)
    if is_cut(run):
        console.print(f"{run.partition}: already cut; nothing to do", highlight=False)
        return
    with run.locked():
        reset_peak_memory()
        start, method, scene = time.monotonic(), run.method(), _Scene.open(context, device)
        job, config = _job(run, len(scene.cameras)), assignment_config(method)
        shard_blocks = job.folder / BLOCKS_FILE
        if shard_blocks.exists():  # shards of an earlier command score cameras for these blocks
            blocks, warnings = load_blocks(shard_blocks), list(read_json(shard_blocks)["warnings"])
        elif saved is not None:
            blocks, warnings = saved, list(before.warnings)
        else:
            blocks, warnings = cut_scene(scene.positions, scene.visibility, scene.cameras, method)
        is_distributed = execution is not None and execution.is_distributed
        clear(run.partition, job.key if is_distributed else None)
        if execution is not None and is_distributed:
            with lock_folder(job.folder):  # from here on `job_folders` knows it as a job, whenever this process ends
                save_blocks(shard_blocks, blocks, [{} for _ in blocks.items], {"warnings": warnings})
            scores = _score_in_shards(run, scene, job, len(blocks), execution, console)
        else:
            with show_share(console, "assigning cameras") as on_progress:
                scores = compute_score_matrix(scene.opened.model, blocks, scene.cameras, config, on_progress)
        scores = adjust_scores(scores, scene.positions, blocks, scene.cameras, method.partition.strategy)
        assignment = assign_cameras(scores, config)
        for note in warnings + assignment.warnings:
            console.print(f"[yellow]note[/] {note}", highlight=False)
        rows = assignment_rows(blocks, scene.positions, scene.visibility, assignment)
        _save(run.partition, scene.opened.capture, blocks, scores, assignment, rows)
        seconds = time.monotonic() - start
        with context.drawing_figures():
            spatial = _spatial(scene, method.partition, method.training.seed, blocks)
            _draw(run.partition, scene, blocks, scores, assignment, method.partition, spatial)
        record = PartitionRecord(
            key=keys.partition, assignment_key=keys.assignment, strategy=method.partition.strategy,
            lambda_vis=method.partition.lambda_vis if method.partition.strategy == "visibility" else None,
            warnings=tuple(warnings), assignment_warnings=tuple(assignment.warnings), blocks=tuple(rows),
            spatial_only_blocks=(
                () if spatial is None else block_rows(spatial, scene.positions, scene.visibility)
            ),
            seconds=seconds, peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        write_json(run.partition / "partition.json", record_to_dict(record))  # last: the rest is complete
        if is_distributed:
            remove(job.folder)
    console.print(make_assignment_table(rows))
    console.print(f"figures: {run.partition / 'blocks.png'} and beside it", highlight=False)


def is_cut(run: RunFolder) -> bool:
    """Whether the scene is cut and its cameras are assigned, with the settings of the run."""
    has_assignment = _saved_blocks(run) is not None and _record_or_empty(run).assignment_key == run.keys().assignment
    return has_assignment and _or_none(lambda: load_scores(run.partition / SCORES_FILE)) is not None


def explain_view(run: RunFolder, view: str, console: Console) -> None:
    """How well a training view shows each block, and why it was assigned to it or not. RunError for another name."""
    names, scores, assignment = load_scores(run.partition / SCORES_FILE)
    table = Table(box=box.SIMPLE_HEAD, title=view, title_justify="left")
    for heading in ("block", "score", "anchors held", "why"):
        table.add_column(heading, justify="left" if heading == "why" else "right")
    for row in explain_assignment(names, scores, assignment, view):
        table.add_row(str(row.block), f"{row.score:.3f}", f"{row.visible_anchors:,}", row.reason)
    console.print(table)


def _spatial(scene: _Scene, config: PartitionConfig, seed: int, blocks: Blocks) -> Blocks | None:
    """The blocks that positions alone would give, to compare with; None where visibility has no part in the cut."""
    if config.strategy != "visibility" or config.lambda_vis == 0 or len(blocks) == 1:
        return None
    config = replace(config, blocks=len(blocks), lambda_vis=0.0)
    return partition_scene(scene.positions, scene.visibility, config, seed)[0]


def _or_none(load: Callable[[], Loaded]) -> Loaded | None:
    """What an earlier command left; None where its file is missing or damaged: it is then made again."""
    try:
        return load()
    except RunError:
        return None


def _record_or_empty(run: RunFolder) -> PartitionRecord:
    return _or_none(run.partition_record) or PartitionRecord()


def _saved_blocks(run: RunFolder) -> Blocks | None:
    """The blocks that are there, if they were cut with the settings of the run."""
    is_current = _record_or_empty(run).key == run.keys().partition
    return _or_none(lambda: load_blocks(run.partition / BLOCKS_FILE)) if is_current else None


def _job(run: RunFolder, cameras: int) -> ShardedJob:
    """Groups of training cameras in shards, and what their scores depend on."""
    request = ScoreRequest(Path(os.path.abspath(run.path)))
    depends_on = [run.keys().assignment, run.coarse_model_id(), cameras]
    spans = split_ranges(-(-cameras // CAMERAS_PER_ITEM), *SHARD_ITEMS)
    return ShardedJob.create("scores", request, run.partition, CAMERA_LABELS, depends_on, spans)


def _score_in_shards(
    run: RunFolder, scene: _Scene, job: ShardedJob, block_count: int, execution: ExecutionOptions, console: Console
) -> ScoreMatrix:
    """Let shards of the cameras be scored elsewhere, and join their rows."""
    pixels = max(camera.width * camera.height for camera in scene.cameras)
    model, images = run.coarse.model, image_and_mask_files(scene.opened.capture.train_views)
    needs = ShardNeeds(
        render_bytes(model.stat().st_size, len(scene.positions) * block_count, pixels),
        lambda: NodeRequirements(job.folder, [run.config_file, model, *images]),
    )
    job.run(needs, execution, console)
    return concatenate_scores(list(job.gather(load_score_rows)))


def score_shard(shard: Shard) -> None:
    """Score a shard of the cameras for the blocks of the job; scores stay beside its status until all are joined."""
    context = RunContext.from_path(shard.request(ScoreRequest).run)
    run, opened = context.run, context.open_model("coarse", shard.device)
    cameras = [view.camera for view in opened.capture.train_views]

    def results(left: Sequence[int]) -> Results:
        scorer = CameraScorer(opened.model, load_blocks(shard.folder / BLOCKS_FILE), assignment_config(run.method()))
        for item in left:
            scores = scorer.scores(cameras[item * CAMERAS_PER_ITEM : (item + 1) * CAMERAS_PER_ITEM])
            yield partial(save_score_rows, scores=scores)

    shard.do(_job(run, len(cameras)), results)


def _save(
    folder: Path, capture: Capture, blocks: Blocks, scores: ScoreMatrix, assignment: Assignment,
    rows: Sequence[BlockCamerasRecord],
) -> None:  # fmt: skip
    """Write the files that later stages read, and the blocks in WGS 84 where the capture is georeferenced."""
    for stale in ("partition.json", "blocks_wgs84.geojson"):
        (folder / stale).unlink(missing_ok=True)
    properties = [record_to_dict(row) for row in rows]
    save_blocks(folder / BLOCKS_FILE, blocks, properties)
    if capture.ground.origin_geo is not None:
        save_blocks_wgs84(folder / "blocks_wgs84.geojson", blocks, properties, capture.ground)
    save_scores(folder / SCORES_FILE, [view.name for view in capture.train_views], scores, assignment)


def describe_partition(config: PartitionConfig) -> str:
    """How a scene is partitioned, in a few words: λ_vis means nothing for other strategies, nor for one block."""
    if config.strategy != "visibility":
        return STRATEGIES[config.strategy].citation.split(", ")[-2] + " partition"
    return f"λ_vis = {config.lambda_vis:g}" if config.blocks != 1 else "not cut"


def _draw(
    folder: Path, scene: _Scene, blocks: Blocks, scores: ScoreMatrix, assignment: Assignment, config: PartitionConfig,
    compare: Blocks | None,
) -> None:  # fmt: skip
    partitions = [(describe_partition(config), blocks)]
    partitions += [] if compare is None else [(figures.SPATIAL_ONLY_LABEL, compare)]
    figures.plot_blocks(
        folder / "blocks.png", scene.positions, scene.visibility, scene.cameras, assignment.cameras, partitions,
        scene.opened.capture.ground.axis_names,
    )  # fmt: skip
    figures.plot_block_stats(
        folder / "block_facts.png", scene.positions, scene.visibility, blocks, assignment.cameras,
        scene.opened.capture.ground.unit, compare,
    )  # fmt: skip
    figures.plot_scores(folder / "scores.png", scores.scores, assignment.cameras)
