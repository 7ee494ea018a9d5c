"""Measuring a run: its test views, and for a merged scene also its blocks and their seams."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from vdgs.captures.capture import Capture, View
from vdgs.evaluation.alone import HELD_BYTES, block_inputs
from vdgs.evaluation.evaluate import conclude, refuse_without_views
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.measured_model import ModelFacts
from vdgs.evaluation.of_run import (
    EVALUATION_IMAGES_BYTES,
    Views,
    cached_photographs,
    evaluate_run,
    evaluation_folder,
    measured_model,
    refuse_bins,
    settings_of,
    views_of,
)
from vdgs.evaluation.records import load_view, save_view
from vdgs.evaluation.saving import file_stems
from vdgs.evaluation.seams import SeamView, block_table, evaluate_blocks, save_picture, worth_seeing
from vdgs.evaluation.seams import conclude as conclude_blocks
from vdgs.evaluation.seams import measure_view as measure_view_of_blocks
from vdgs.evaluation.view import ViewInputs, measure_view
from vdgs.executors.errand import Errand, Wish
from vdgs.executors.fitness import Question, photographs_of
from vdgs.executors.kinds import Kind
from vdgs.executors.placement import Share
from vdgs.executors.work import PieceWork, alone, at_work, remove, spans_of
from vdgs.memory.estimate import drawing_bytes
from vdgs.memory.process import forget_peak, peak_memory_bytes
from vdgs.runs.cut import blocks_of
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import FoundModel, find_model
from vdgs.runs.run_context import RunContext
from vdgs.settings.requests import ModelName
from vdgs.storage.files import read_json, read_record, write_bytes, write_json
from vdgs.storage.records import plain, record_of
from vdgs.watching.interrupts import stop_if_asked

#: Views of a piece, least and most, and how many pieces there are in between (choice): a process of its own is worth
#: some views, and what is lost with one is little.
VIEWS_OF_PIECE = 3, 25, 16
VIEWS = Kind("piece", "pieces", "measure", "at work", "views", "views/s")


@dataclass(frozen=True)
class Measuring:
    """Which figures are wanted."""

    path: Path
    """The run folder."""
    which: ModelName = "best"
    lpips_weights: Path | None = None
    bins: int = 4
    views: Views = "test"
    device: str = "cpu"


def evaluate_stage(context: RunContext, asked: Measuring, console: Console, wish: Wish | None = None) -> None:
    """Measure a model of a run; of the merged one, on test views, also block by block and at the seams.

    In this process, or in pieces where a `wish` sends them: the figures are the same, but for times.

    Raises what `Errand.run` raises, and RunError where another process measures the same.
    """
    refuse_bins(asked.bins)
    run = RunFolder(Path(os.path.abspath(asked.path)))  # as in `stages.train`: other machines may mount it so
    found = find_model(run, asked.which)
    output = evaluation_folder(run, found.name, asked.views)
    if found.caution:
        console.print(f"[yellow]warning[/] {found.caution}", highlight=False)
    began = time.monotonic()
    if wish is not None and wish.sends:
        peak = _measure_in_pieces(context, run, found, asked, wish, console)
    else:
        peak = _measure_here(context, found, asked, console)
    record = _record_of(run, found.name, asked.lpips_weights, asked.bins)
    write_json(output / "status.json", record | {"seconds": time.monotonic() - began, "peak_memory_bytes": peak})


def _measure_here(context: RunContext, found: FoundModel, asked: Measuring, console: Console) -> int:
    """Measure in this process; the most memory that it took (bytes)."""
    run = context.run
    output = evaluation_folder(run, found.name, asked.views)
    with alone(output):
        opened = context.open_model(asked.which, asked.device)
        coarse = context.open_model("coarse", asked.device)
        _announce(found, len(views_of(opened.capture, asked.views)), asked.views, console)
        _forget(output)
        forget_peak()
        evaluate_run(opened, coarse, asked.lpips_weights, asked.bins, console, asked.views)
        if _has_seams(run, found.name, asked.views):
            with cached_photographs(opened.capture.test_views) as photographs:
                console.print(block_table(evaluate_blocks(block_inputs(opened, coarse, photographs), output)))
    return peak_memory_bytes()


def _announce(found: FoundModel, count: int, views: Views, console: Console) -> None:
    console.print(f"measuring the {found.line} on {count} {views} views", highlight=False)


def _has_seams(run: RunFolder, name: str, views: Views) -> bool:
    """Whether blocks and the seams between them are measured too."""
    return views == "test" and name == "merged" and len(blocks_of(run)) > 1


def _measure_in_pieces(
    context: RunContext, run: RunFolder, found: FoundModel, asked: Measuring, wish: Wish, console: Console
) -> int:
    """Let pieces of the views be measured elsewhere, and join them; the most memory that one took (bytes). No model is
    in the memory of this process."""
    context.release_models()
    output, capture = evaluation_folder(run, found.name, asked.views), context.capture
    views = views_of(capture, asked.views)
    refuse_without_views(views, output)
    work = _work(run, found, asked, len(views))
    with alone(output, work.key):
        _announce(found, len(views), asked.views, console)
        _forget(output)
        work.folder.mkdir(parents=True, exist_ok=True)
        if left := work.left:
            errand = Errand(
                VIEWS, work.folder, len(work.spans), left, work.piece,
                lambda index, share, device: _command(run, found.name, asked, index, share, device),
                _piece_bytes(run, found, asked, capture), lambda: _question(run, found, work, views),
            )  # fmt: skip
            errand.run(replace(wish, image_gb=EVALUATION_IMAGES_BYTES / 1e9), console, work.mark_queued)
        _join(run, found, asked, work, console)
        peak = work.peak_memory_bytes
        remove(work)
    return peak


def _work(run: RunFolder, found: FoundModel, asked: Measuring, count: int) -> PieceWork:
    """The views in pieces, and what their figures depend on."""
    blocks = [folder.status().model for folder in run.block_folders()] if found.name == "merged" else []
    depends_on = [
        found.stage.status().model, found.key, run.coarse_identity(), blocks, str(asked.lpips_weights), asked.views
    ]  # fmt: skip
    if exposed := _exposed(run):
        depends_on.append(exposed)
    return PieceWork.of(evaluation_folder(run, found.name, asked.views), depends_on, spans_of(count, *VIEWS_OF_PIECE))


def _command(run: RunFolder, name: str, asked: Measuring, index: int, share: Share, device: str) -> list[str]:
    weights = [] if asked.lpips_weights is None else ["--lpips-weights", os.path.abspath(asked.lpips_weights)]
    return [
        sys.executable, "-m", "vdgs.cli", "eval", str(run.path), "--piece", str(index), "--model", name,
        "--views", asked.views, *weights, "--threads", str(share.needs.processors), "--device", device,
    ]  # fmt: skip


def _question(run: RunFolder, found: FoundModel, work: PieceWork, views: Sequence[View]) -> Question:
    """What a machine must see: the run, the models that are drawn and the photographs."""
    files = [run.config_file, run.coarse.model, found.stage.model, *photographs_of(views)]
    return Question(work.folder, files)


def _piece_bytes(run: RunFolder, found: FoundModel, asked: Measuring, capture: Capture) -> int:
    """Memory by estimate: the models that are drawn, blocks among them as far as they are held, and one picture."""
    models = [run.coarse.model, found.stage.model] + ([run.coarse.model] if found.name == "merged" else [])
    held = HELD_BYTES if _has_seams(run, found.name, asked.views) else 0
    pixels = max(view.camera.width * view.camera.height for view in views_of(capture, asked.views))
    files = sum(model.stat().st_size for model in models)
    return drawing_bytes(files, min(held, files), pixels, asked.lpips_weights is not None)


def evaluate_piece(context: RunContext, asked: Measuring, index: int, console: Console) -> None:
    """Measure one piece of the views, continue it, or do nothing if it is done. What its views come to stays beside its
    status until all pieces are joined; pictures go where they belong."""
    run = RunFolder(Path(os.path.abspath(asked.path)))
    opened, coarse = (context.open_model(which, asked.device) for which in (asked.which, "coarse"))
    views = views_of(opened.capture, asked.views)
    work = _work(run, find_model(run, asked.which), asked, len(views))
    folder, span = work.piece(index), work.span(index)
    if work.is_done(index):
        console.print(f"{folder.path}: already measured; nothing to do", highlight=False)
        return
    done = sum(work.file(item).exists() for item in span)
    with at_work(folder, done, len(span)) as tell, cached_photographs(views) as photographs:
        lpips, note = load_lpips(asked.lpips_weights)
        model = measured_model(opened, coarse, asked.views)
        inputs = ViewInputs(photographs, model, lpips, settings_of(asked.bins, asked.views), work.output)
        seams = block_inputs(opened, coarse, photographs) if _has_seams(run, opened.name, asked.views) else None
        write_json(folder.path / "facts.json", {"model": plain(model.facts), "lpips_note": note})
        console.print(f"measuring the {opened.line} on views {span.start} to {span.stop - 1}", highlight=False)
        pictures = _SeamPictures(work, span) if seams is not None else None
        for item in (item for item in span if not work.file(item).exists()):
            stop_if_asked()
            figures, of_blocks = measure_view(item, inputs), None
            if seams is not None and pictures is not None:
                of_blocks, seen = measure_view_of_blocks(views[item], inputs.stems[item], seams)
                pictures.keep(item, seen)
            save_view(work.file(item), figures, of_blocks)
            done += 1
            tell(done)


class _SeamPictures:
    """Pictures of the views of a piece that are worth seeing, of those that are measured so far."""

    def __init__(self, work: PieceWork, span: range):
        self._work = work
        measured = {item: load_view(work.file(item))[1] for item in span if work.file(item).exists()}
        self._borders = {item: figures.row["border_pixels"] for item, figures in measured.items() if figures}

    def keep(self, item: int, seen: SeamView) -> None:
        """Draw a view if it is worth seeing, and remove the picture of one that no longer is."""
        self._borders[item] = seen.border_pixels
        items = sorted(self._borders)
        best = {items[place] for place in worth_seeing([self._borders[each] for each in items])}
        if item in best:
            save_picture(self._work.file(item, ".png"), seen)
        for other in set(items) - best:
            self._work.file(other, ".png").unlink(missing_ok=True)


def _join(run: RunFolder, found: FoundModel, asked: Measuring, work: PieceWork, console: Console) -> None:
    """Gather what the views came to, in their order, a view at a time."""
    items = range(work.spans[-1].stop)
    facts = read_json(work.piece(0).path / "facts.json")
    conclude(
        (load_view(work.file(item))[0] for item in items), record_of(ModelFacts, facts["model"]), work.output,
        lpips_note=facts["lpips_note"], settings=settings_of(asked.bins, asked.views), timed=False, console=console,
    )  # fmt: skip
    if _has_seams(run, found.name, asked.views):
        figures = [each for item in items if (each := load_view(work.file(item))[1]) is not None]
        stems = file_stems([each.row["name"] for each in figures])
        for item in worth_seeing([each.row["border_pixels"] for each in figures]):
            write_bytes(work.output / "seams" / f"{stems[item]}.png", work.file(item, ".png").read_bytes())
        console.print(block_table(conclude_blocks(figures, len(blocks_of(run)), work.output)))
    console.print(f"pictures and figures: {work.output}", highlight=False)


def is_measured(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> bool:
    """Whether the figures that are there are those of the model that is there, measured in this way."""
    wanted = _record_of(run, name, lpips_weights, bins)
    record = read_record(evaluation_folder(run, name) / "status.json")
    return {key: record.get(key) for key in wanted} == wanted


def _record_of(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> dict[str, Any]:
    stage = run.merged if name == "merged" else run.coarse
    keys = run.keys()
    key = keys.merge if name == "merged" else keys.coarse
    return {
        "key": key, "model": stage.status().model, "lpips_weights": str(lpips_weights), "bins": bins,
        "exposed": _exposed(run),
    }  # fmt: skip


def _exposed(run: RunFolder) -> str | None:
    """How views are exposed, if training fitted exposures; None in neutral colours."""
    return "interpolated and metered" if run.method().training.exposure else None


def _forget(output: Path) -> None:
    """Delete what vouches for figures that are about to change, and what another cut may have left."""
    for stale in ("status.json", "metrics.json", "by_block.json"):
        (output / stale).unlink(missing_ok=True)
    shutil.rmtree(output / "seams", ignore_errors=True)
