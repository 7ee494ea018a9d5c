"""A map drawn in pieces: groups of tiles, each by a process of its own, on this machine or on others.

A tile is a file of its four arrays, whole or absent, until all are gathered (`executors.work`).
"""

from __future__ import annotations

import os
import sys
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from vdgs.errors import RunError
from vdgs.executors.errand import Errand, Wish
from vdgs.executors.fitness import Question, photographs_of
from vdgs.executors.kinds import Kind
from vdgs.executors.placement import LEAST_IMAGES_GB, Share
from vdgs.executors.work import PieceWork, at_work, spans_of
from vdgs.maps.grid import TILE_PX
from vdgs.maps.plan import MapPlan, plan_map
from vdgs.maps.sharpening import SHARPENING_BYTES
from vdgs.maps.tiles import Tile
from vdgs.memory.estimate import drawing_bytes
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import FoundModel, open_run
from vdgs.settings.requests import MapRequest
from vdgs.storage.files import write_atomically
from vdgs.watching.interrupts import stop_if_asked

#: Tiles of a piece, least and most, and how many pieces there are in between (choice): a process of its own is worth
#: some tiles, and what is lost with one is little.
TILES_OF_PIECE = 4, 64, 16
TILES = Kind("piece", "pieces", "draw", "at work", "tiles", "tiles/s")


def work_of(plan: MapPlan) -> PieceWork:
    """The tiles in pieces, and what they depend on."""
    grid = plan.grid
    depends_on = [
        plan.model, plan.identity, plan.placement.crs, [grid.left, grid.top, grid.gsd, grid.width, grid.height],
        plan.samples, plan.sharp,
    ]  # fmt: skip
    return PieceWork.of(plan.folder, depends_on, spans_of(grid.tile_count(), *TILES_OF_PIECE))


def draw_pieces(
    plan: MapPlan, work: PieceWork, found: FoundModel, asked: MapRequest, wish: Wish, console: Console
) -> None:
    """Let the tiles that are left be drawn elsewhere. No model is in the memory of this process.

    Raises what `Errand.run` raises.
    """
    work.folder.mkdir(parents=True, exist_ok=True)
    if left := work.left:
        run = RunFolder(plan.run)
        side = min(TILE_PX, max(plan.grid.width, plan.grid.height)) * plan.samples
        image_gb = SHARPENING_BYTES / 1e9 if plan.sharp else LEAST_IMAGES_GB
        photographs = photographs_of(plan.capture.train_views)
        errand = Errand(
            TILES, work.folder, len(work.spans), left, work.piece, partial(_command, plan, asked),
            drawing_bytes(found.stage.model.stat().st_size, 0, side**2),
            lambda: Question(work.folder, [run.config_file, found.stage.model, *photographs]),
        )  # fmt: skip
        errand.run(replace(wish, image_gb=image_gb), console, work.mark_queued)


def _command(plan: MapPlan, asked: MapRequest, index: int, share: Share, device: str) -> list[str]:
    # As they were given, so that the piece comes to the same grid, to the last bit.
    chosen = [] if asked.gsd is None else ["--gsd", repr(asked.gsd)]
    chosen += [] if asked.bbox is None else ["--bbox", *map(repr, asked.bbox)]
    chosen += [] if asked.crs is None else ["--crs", asked.crs]
    return [
        sys.executable, "-m", "vdgs.cli", "map", str(plan.run), "--piece", str(index), "--model", plan.model,
        "--output", os.path.abspath(plan.folder), *chosen, *(["--sharp"] if plan.sharp else []),
        "--threads", str(share.needs.processors), "--device", device,
    ]  # fmt: skip


def map_piece(asked: MapRequest, index: int, console: Console) -> None:
    """Draw one piece of the tiles, continue it, or do nothing if it is done."""
    opened = open_run(Path(os.path.abspath(asked.run)), asked.model, asked.device)
    plan = plan_map(asked, opened.folder.path, opened.capture, opened.name, opened.status.model or "")
    work = work_of(plan)
    folder, span = work.piece(index), work.span(index)
    if work.is_done(index):
        console.print(f"{folder.path}: already drawn; nothing to do", highlight=False)
        return
    parts = [part for _, _, part in plan.grid.tiles()]
    done = sum(work.file(item).exists() for item in span)
    with at_work(folder, done, len(span)) as tell, plan.surveyor(opened.model) as surveyor:
        console.print(f"drawing the {opened.line}, tiles {span.start} to {span.stop - 1}", highlight=False)
        for item in (item for item in span if not work.file(item).exists()):
            stop_if_asked()
            save_tile(work.file(item), surveyor.tile(parts[item]))
            done += 1
            tell(done)


def save_tile(path: Path, tile: Tile) -> None:
    """Write an .npz file (without pickle), atomically."""
    arrays = {field.name: getattr(tile, field.name) for field in fields(Tile)}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as handle:
            np.savez_compressed(handle, allow_pickle=False, **arrays)

    write_atomically(path, write)


def load_tile(path: Path) -> Tile:
    """The inverse of `save_tile`. Raises RunError if the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return Tile(**{field.name: file[field.name] for field in fields(Tile)})
    # What zipfile, zlib and numpy raise on damaged bytes has no common base.
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error


def tiles_of(work: PieceWork) -> Iterator[Tile]:
    """What the pieces have drawn, in the order of the grid, a tile at a time."""
    return (load_tile(work.file(item)) for item in range(work.spans[-1].stop))
