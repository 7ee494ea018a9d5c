"""The scene cut into blocks, and cameras for each: partition and assignment (section IV-B).

RUN/partition/   blocks.geojson (ground frame), blocks_wgs84.geojson (if georeferenced), scores.npz,
                 partition.json, blocks.png, block_facts.png, scores.png
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from vdgs.cameras import Camera
from vdgs.errors import RunError
from vdgs.memory.process import forget_peak, peak_memory_bytes
from vdgs.partition.assignment.assign import Assignment, assign
from vdgs.partition.assignment.saving import load_scores, save_scores
from vdgs.partition.assignment.scores import Scores, score_matrix
from vdgs.partition.assignment.tables import assignment_rows, assignment_table, explain
from vdgs.partition.blocks import Blocks, load_blocks, places_of, save_blocks, save_blocks_wgs84
from vdgs.partition.cut import choose_block_count, cut_scene
from vdgs.partition.figures import maps as figures
from vdgs.partition.records import AssignedBlock, CutBlock, PartitionRecord
from vdgs.partition.strategies import STRATEGIES
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.runs.visibility import keep_visibility
from vdgs.settings.method import AssignmentConfig, PartitionConfig
from vdgs.storage.files import write_json
from vdgs.storage.records import plain
from vdgs.watching.interrupts import stop_if_asked


@dataclass(frozen=True)
class _Scene:
    """What is cut: the coarse anchors and who sees them."""

    opened: TrainedRun
    positions: Float[np.ndarray, "n 3"]
    visibility: Int[np.ndarray, " n"]
    cameras: list[Camera]

    @staticmethod
    def of(run: RunFolder, device: str) -> _Scene:
        opened = open_run(run.path, "coarse", device)
        cameras = [view.camera for view in opened.capture.train_views]
        positions = opened.model.anchors.positions.cpu().numpy()
        return _Scene(opened, positions, keep_visibility(opened).numpy(), cameras)


def partition_run(run: RunFolder, console: Console, device: str = "cpu") -> None:
    """Cut the scene of a run and assign its cameras, drawing on a device; what is there for the same settings is kept.

    Raises RunError without a coarse model.
    """
    keys, before = run.keys(), _record_before(run)
    kept = _kept_blocks(run) if before.key == keys.partition else None
    if kept is not None and before.assignment_key == keys.assignment and _scores_are_whole(run):
        console.print(f"{run.partition}: already cut; nothing to do", highlight=False)
        return
    with run.locked():
        forget_peak()
        began, method, scene = time.monotonic(), run.method(), _Scene.of(run, device)
        if kept is not None:
            blocks, warnings = kept, list(before.warnings)
        else:
            blocks, warnings = _cut(scene, method.partition, method.training.seed)
        config = method.assignment
        if method.partition.strategy != "visibility":
            config = STRATEGIES[method.partition.strategy].assignment(config)
        scores = _score(scene, blocks, config, method.partition, console)
        assignment = assign(scores, config)
        for note in warnings + assignment.complaints:
            console.print(f"[yellow]note[/] {note}", highlight=False)
        rows = assignment_rows(blocks, scene.positions, scene.visibility, assignment)
        _save(run.partition, scene, blocks, scores, assignment, rows)
        spatial = _spatial(scene, method.partition, method.training.seed, blocks)
        _draw(run.partition, scene, blocks, scores, assignment, method.partition, spatial)
        record = PartitionRecord(
            keys.partition, keys.assignment, method.partition.strategy,
            lambda_vis=method.partition.lambda_vis if method.partition.strategy == "visibility" else None,
            warnings=tuple(warnings), complaints=tuple(assignment.complaints), blocks=tuple(rows),
            spatial=_cut_blocks(scene, spatial),
            seconds=time.monotonic() - began, peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        write_json(run.partition / "partition.json", plain(record))  # last: where it stands, the rest is complete
    console.print(assignment_table(rows))
    console.print(f"figures: {run.partition / 'blocks.png'} and beside it", highlight=False)


def explain_view(run: RunFolder, view: str, console: Console) -> None:
    """How well a training view shows each block, and why it was assigned to it or not. RunError for another name."""
    names, scores, assignment = load_scores(run.partition / "scores.npz")
    table = Table(box=box.SIMPLE_HEAD, title=view, title_justify="left")
    for heading in ("block", "score", "anchors held", "why"):
        table.add_column(heading, justify="left" if heading == "why" else "right")
    for row in explain(names, scores, assignment, view):
        table.add_row(str(row.block), f"{row.score:.3f}", f"{row.held:,}", row.why)
    console.print(table)


def _cut(scene: _Scene, config: PartitionConfig, seed: int) -> tuple[Blocks, list[str]]:
    camera = scene.cameras[0]
    count = choose_block_count(
        len(scene.visibility), len(scene.cameras), camera.width * camera.height, config,
        offsets=scene.opened.model.anchors.offsets.shape[1],
    )  # fmt: skip
    if config.strategy != "visibility":
        return STRATEGIES[config.strategy].cut(scene.positions, scene.cameras, count)
    return cut_scene(scene.positions, scene.visibility, replace(config, blocks=count), seed)


def _spatial(scene: _Scene, config: PartitionConfig, seed: int, cut: Blocks) -> Blocks:
    """The cut that place alone would give, to compare with."""
    if config.lambda_vis == 0 or len(cut) == 1:
        return cut
    return cut_scene(scene.positions, scene.visibility, replace(config, blocks=len(cut), lambda_vis=0.0), seed)[0]


def _record_before(run: RunFolder) -> PartitionRecord:
    """How the scene was cut before; nothing if the file is damaged: the scene is then cut again."""
    try:
        return run.partition_record()
    except RunError:
        return PartitionRecord()


def _kept_blocks(run: RunFolder) -> Blocks | None:
    """The blocks that were cut before; None if their file is missing or damaged: the scene is then cut again."""
    try:
        return load_blocks(run.partition / "blocks.geojson")
    except RunError:
        return None


def _scores_are_whole(run: RunFolder) -> bool:
    try:
        load_scores(run.partition / "scores.npz")
    except RunError:
        return False
    return True


def _score(
    scene: _Scene, blocks: Blocks, config: AssignmentConfig, partition: PartitionConfig, console: Console
) -> Scores:
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("assigning cameras")

        def show(done: int, total: int) -> None:
            stop_if_asked()
            bar.update(task, completed=done, total=total)

        scores = score_matrix(scene.opened.model, blocks, scene.cameras, config, show)
    if partition.strategy == "visibility":
        return scores
    return STRATEGIES[partition.strategy].rescored(scores, scene.positions, blocks, scene.cameras)


def _cut_blocks(scene: _Scene, blocks: Blocks) -> tuple[CutBlock, ...]:
    """Anchors, area and visibility of each block of a cut."""
    owner = blocks.owner(places_of(scene.positions))
    return tuple(
        CutBlock(
            index, int((owner == index).sum()), float(block.core.area),
            mean_v=float(scene.visibility[owner == index].mean()) if (owner == index).any() else None,
            std_v=float(scene.visibility[owner == index].std()) if (owner == index).any() else None,
        )
        for index, block in enumerate(blocks.items)
    )  # fmt: skip


def _save(
    folder: Path, scene: _Scene, blocks: Blocks, scores: Scores, assignment: Assignment, rows: Sequence[AssignedBlock]
) -> None:  # fmt: skip
    """The files that later stages read, and the place of the blocks on Earth where it is known."""
    for stale in ("partition.json", "blocks_wgs84.geojson"):
        (folder / stale).unlink(missing_ok=True)
    facts = [plain(row) for row in rows]
    save_blocks(folder / "blocks.geojson", blocks, facts)
    ground = scene.opened.capture.ground
    if ground.origin_geo is not None:
        save_blocks_wgs84(folder / "blocks_wgs84.geojson", blocks, facts, ground)
    save_scores(
        folder / "scores.npz", [view.name for view in scene.opened.capture.train_views], scores, assignment
    )  # fmt: skip


def how_cut(config: PartitionConfig) -> str:
    """How a scene is cut, in a few words: λ_vis says nothing of the partitions of others, nor of one block."""
    if config.strategy != "visibility":
        return STRATEGIES[config.strategy].cites.split(", ")[-2] + " partition"
    return f"λ_vis = {config.lambda_vis:g}" if config.blocking else "not cut"


def _draw(
    folder: Path, scene: _Scene, blocks: Blocks, scores: Scores, assignment: Assignment, config: PartitionConfig,
    spatial: Blocks,
) -> None:  # fmt: skip
    ours = config.strategy == "visibility" and config.lambda_vis > 0
    compare = spatial if ours and len(blocks) > 1 else None
    cuts = [(how_cut(config), blocks)] + ([] if compare is None else [(figures.BY_PLACE, compare)])
    figures.draw_blocks(
        folder / "blocks.png", scene.positions, scene.visibility, scene.cameras, assignment.cameras, cuts,
        scene.opened.capture.ground.axis_names,
    )  # fmt: skip
    figures.draw_block_facts(
        folder / "block_facts.png", scene.positions, scene.visibility, blocks, assignment.cameras,
        scene.opened.capture.ground.unit, compare,
    )  # fmt: skip
    figures.draw_scores(folder / "scores.png", scores.scores, assignment.cameras)
