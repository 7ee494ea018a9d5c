"""The scene cut into blocks, and cameras for each: partition and assignment (section IV-B).

RUN/partition/   blocks.geojson (ground frame), blocks_wgs84.geojson (if georeferenced), scores.npz,
                 partition.json, blocks.png, block_facts.png, scores.png
"""

from __future__ import annotations

import os
import sys
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
from vdgs.executors.errand import Errand, Wish
from vdgs.executors.fitness import Question, photographs_of
from vdgs.executors.kinds import Kind
from vdgs.executors.placement import Share
from vdgs.executors.work import PieceWork, at_work, clear, remove, spans_of
from vdgs.memory.estimate import drawing_bytes, largest_picture
from vdgs.memory.process import forget_peak, peak_memory_bytes
from vdgs.partition.assignment.assign import Assignment, assign
from vdgs.partition.assignment.saving import load_part, load_scores, save_part, save_scores
from vdgs.partition.assignment.scores import Scorer, Scores, joined, score_matrix
from vdgs.partition.assignment.tables import assignment_rows, assignment_table, cut_rows, explain
from vdgs.partition.blocks import Blocks, load_blocks, save_blocks, save_blocks_wgs84
from vdgs.partition.cut import choose_block_count, cut_scene
from vdgs.partition.figures import maps as figures
from vdgs.partition.records import AssignedBlock, PartitionRecord
from vdgs.partition.strategies import STRATEGIES
from vdgs.runs.folder import RunFolder
from vdgs.runs.locks import hold
from vdgs.runs.opening import TrainedRun
from vdgs.runs.run_context import RunContext
from vdgs.runs.visibility import keep_visibility
from vdgs.settings.method import AssignmentConfig, MethodConfig, PartitionConfig
from vdgs.storage.files import read_json, write_json
from vdgs.storage.records import plain
from vdgs.watching.interrupts import stop_if_asked

#: Cameras that are scored and saved together; how many such groups a piece has, least and most, and how many pieces
#: there are in between (choice).
CAMERAS_OF_ITEM = 8
ITEMS_OF_PIECE = 1, 8, 16
CAMERAS = Kind("piece", "pieces", "score cameras", "at work", "cameras", "cameras/s")
#: The blocks that pieces score cameras for, in the folder of the pieces.
CUT = "blocks.geojson"


@dataclass(frozen=True)
class _Scene:
    """What is cut: the coarse anchors and who sees them."""

    opened: TrainedRun
    positions: Float[np.ndarray, "n 3"]
    visibility: Int[np.ndarray, " n"]
    cameras: list[Camera]

    @staticmethod
    def of(context: RunContext, device: str) -> _Scene:
        opened = context.open_model("coarse", device)
        cameras = [view.camera for view in opened.capture.train_views]
        positions = opened.model.anchors.positions.cpu().numpy()
        return _Scene(opened, positions, keep_visibility(opened).numpy(), cameras)


def partition_run(context: RunContext, console: Console, device: str = "cpu", wish: Wish | None = None) -> None:
    """Cut the scene of a run and assign its cameras, drawing on a device; what is there for the same settings is kept.

    Cameras are scored in this process, or in pieces where a `wish` sends them: the scores are the same. Raises RunError
    without a coarse model, and what `Errand.run` raises.
    """
    run = context.run
    keys, before = run.keys(), _record_before(run)
    kept = _kept_blocks(run) if before.key == keys.partition else None
    if kept is not None and before.assignment_key == keys.assignment and _scores_are_whole(run):
        console.print(f"{run.partition}: already cut; nothing to do", highlight=False)
        return
    with run.locked():
        forget_peak()
        began, method, scene = time.monotonic(), run.method(), _Scene.of(context, device)
        work, config = _work(run, len(scene.cameras)), _assignment(method)
        begun = _begun_cut(work)
        if begun is not None:
            blocks, warnings = begun
        elif kept is not None:
            blocks, warnings = kept, list(before.warnings)
        else:
            blocks, warnings = _cut(scene, method)
        sends = wish is not None and wish.sends
        clear(run.partition, work.key if sends else None)
        if wish is not None and sends:
            scores = _score_in_pieces(run, scene, work, (blocks, warnings), wish, console)
        else:
            scores = _score(scene, blocks, config, console)
        if method.partition.strategy != "visibility":
            scores = STRATEGIES[method.partition.strategy].rescored(scores, scene.positions, blocks, scene.cameras)
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
            spatial=cut_rows(spatial, scene.positions, scene.visibility),
            seconds=time.monotonic() - began, peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        write_json(run.partition / "partition.json", plain(record))  # last: where it stands, the rest is complete
        if sends:
            remove(work)
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


def _cut(scene: _Scene, method: MethodConfig) -> tuple[Blocks, list[str]]:
    config, pixels = method.partition, largest_picture(scene.cameras, method.block.resolutions)
    count = choose_block_count(len(scene.visibility), len(scene.cameras), pixels, method)
    if config.strategy != "visibility":
        return STRATEGIES[config.strategy].cut(scene.positions, scene.cameras, count)
    return cut_scene(scene.positions, scene.visibility, replace(config, blocks=count), method.training.seed)


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


def _assignment(method: MethodConfig) -> AssignmentConfig:
    """The settings of the assignment, as the strategy that cuts wants them."""
    strategy = method.partition.strategy
    return method.assignment if strategy == "visibility" else STRATEGIES[strategy].assignment(method.assignment)


def _score(scene: _Scene, blocks: Blocks, config: AssignmentConfig, console: Console) -> Scores:
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("assigning cameras")

        def show(done: int, total: int) -> None:
            stop_if_asked()
            bar.update(task, completed=done, total=total)

        return score_matrix(scene.opened.model, blocks, scene.cameras, config, show)


def _work(run: RunFolder, cameras: int) -> PieceWork:
    """Groups of training cameras in pieces; what their scores depend on."""
    groups = -(-cameras // CAMERAS_OF_ITEM)
    depends_on = [run.keys().assignment, run.coarse_identity(), cameras]
    return PieceWork.of(run.partition, depends_on, spans_of(groups, *ITEMS_OF_PIECE))


def _begun_cut(work: PieceWork) -> tuple[Blocks, list[str]] | None:
    """The blocks for which pieces of an earlier command score cameras, and the warnings of their cut, if there are."""
    file = work.folder / CUT
    if not file.exists():
        return None
    return load_blocks(file), list(read_json(file)["warnings"])


def _score_in_pieces(
    run: RunFolder, scene: _Scene, work: PieceWork, cut: tuple[Blocks, list[str]], wish: Wish, console: Console
) -> Scores:
    """Let pieces of the cameras be scored elsewhere, and join their rows."""
    blocks, warnings = cut
    with hold(work.folder):  # from here on `executors.work` knows it as a work, whenever this process ends
        save_blocks(work.folder / CUT, blocks, [{} for _ in blocks.items], {"warnings": warnings})
    if left := work.left:
        views = scene.opened.capture.train_views
        pixels = max(camera.width * camera.height for camera in scene.cameras)
        model = run.coarse.model.stat().st_size
        errand = Errand(
            CAMERAS, work.folder, len(work.spans), left, work.piece, lambda *given: _command(run, *given),
            drawing_bytes(model, len(scene.positions) * len(blocks), pixels),
            lambda: Question(work.folder, [run.config_file, run.coarse.model, *photographs_of(views)]),
        )  # fmt: skip
        errand.run(wish, console, work.mark_queued)
    return joined([load_part(work.file(item)) for item in range(work.spans[-1].stop)])


def _command(run: RunFolder, index: int, share: Share, device: str) -> list[str]:
    return [
        sys.executable, "-m", "vdgs.cli", "partition", os.path.abspath(run.path), "--piece", str(index),
        "--threads", str(share.needs.processors), "--device", device,
    ]  # fmt: skip


def score_piece(context: RunContext, index: int, console: Console, device: str = "cpu") -> None:
    """Score one piece of the cameras for the blocks that a command has cut, continue it, or do nothing if it is done.
    Its scores stay beside its status until all pieces are joined. RunError where no command has cut them."""
    run, opened = context.run, context.open_model("coarse", device)
    cameras = [view.camera for view in opened.capture.train_views]
    work = _work(run, len(cameras))
    span, cut = work.span(index), _begun_cut(work)
    if cut is None:
        raise RunError(f"{work.folder}: has no blocks to score cameras for. vdgs partition {run.path} cuts them.")
    if work.is_done(index):
        console.print(f"{work.piece(index).path}: already scored; nothing to do", highlight=False)
        return
    groups = {item: cameras[item * CAMERAS_OF_ITEM : (item + 1) * CAMERAS_OF_ITEM] for item in span}
    done = sum(len(group) for item, group in groups.items() if work.file(item).exists())
    with at_work(work.piece(index), done, sum(map(len, groups.values()))) as tell:
        scorer = Scorer(opened.model, cut[0], _assignment(run.method()))
        for item in (item for item in span if not work.file(item).exists()):
            stop_if_asked()
            save_part(work.file(item), scorer.scores(groups[item]))
            done += len(groups[item])
            tell(done)


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
    return f"λ_vis = {config.lambda_vis:g}" if config.blocks != 1 else "not cut"


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
