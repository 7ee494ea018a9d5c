"""The tiles of a map drawn in pieces, elsewhere or by several processes, and gathered one at a time.

FOLDER/pieces/KEY/NN/   of piece NN: a file for each of its tiles (`executors.work`), the arrays that it shows, whole
"""

from __future__ import annotations

import io
import os
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, fields, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from vdgs.errors import RunError
from vdgs.executors.errand import Errand, Wish
from vdgs.executors.fitness import Question, photographs_of
from vdgs.executors.kinds import Kind
from vdgs.executors.placement import Share
from vdgs.executors.work import PieceWork, at_work, clear, remove, spans_of
from vdgs.maps.grid import TILE_PX
from vdgs.maps.plan import Plan
from vdgs.maps.sharpening import HALO_PX, held_bytes
from vdgs.maps.tiles import Tile
from vdgs.memory.estimate import drawing_bytes
from vdgs.runs.folder import RunFolder
from vdgs.runs.locks import hold
from vdgs.runs.opening import FoundModel, open_run
from vdgs.settings.requests import MapRequest
from vdgs.storage.files import write_bytes
from vdgs.watching.interrupts import stop_if_asked

#: Tiles of a piece, least and most, and how many pieces there are in between (choice).
TILES_OF_PIECE = 2, 100, 16
TILES = Kind("piece", "pieces", "draw", "at work", "tiles", "tiles/s")


@contextmanager
def drawn_elsewhere(
    plan: Plan, asked: MapRequest, run: RunFolder, found: FoundModel, wish: Wish, console: Console
) -> Iterator[Iterator[Tile]]:
    """All tiles of a map, in their order, once pieces have drawn them; what they left is removed at the end.

    Raises what `Errand.run` raises, and RunError where another process draws the same map.
    """
    work = _work(plan)
    clear(plan.folder, work.key)
    with hold(work.folder):
        if left := work.left:
            images = held_bytes(plan.sharp, plan.above.capture)
            side = (TILE_PX + (2 * HALO_PX if plan.sharp else 0)) * plan.samples
            errand = Errand(
                TILES, work.folder, len(work.spans), left, work.piece,
                lambda index, share, device: _command(plan, asked, run, found, index, share, device),
                drawing_bytes(found.stage.model.stat().st_size, images.depths, side * side),
                lambda: Question(work.folder, _files(plan, run, found)),
            )  # fmt: skip
            errand.run(replace(wish, image_gb=max(images.pictures, 1) / 1e9), console, work.mark_queued)
        yield (load_tile(work.file(item)) for item in range(plan.grid.tile_count()))
        remove(work)


def _work(plan: Plan) -> PieceWork:
    """The tiles in pieces, and what they depend on."""
    depends_on = [
        plan.model, plan.model_identity, plan.placement.crs, list(astuple(plan.grid)), plan.samples, plan.sharp
    ]  # fmt: skip
    return PieceWork.of(plan.folder, depends_on, spans_of(plan.grid.tile_count(), *TILES_OF_PIECE))


def _files(plan: Plan, run: RunFolder, found: FoundModel) -> list[Path]:
    return [run.config_file, found.stage.model, *photographs_of(plan.above.capture.train_views)]


def _command(
    plan: Plan, asked: MapRequest, run: RunFolder, found: FoundModel, index: int, share: Share, device: str
) -> list[str]:
    """As it was asked for, so that a piece finds the same plan; floats with all their digits."""
    where = [] if asked.gsd is None else ["--gsd", repr(asked.gsd)]
    where += [] if asked.bbox is None else ["--bbox", *map(repr, asked.bbox)]
    where += [] if asked.crs is None else ["--crs", asked.crs]
    return [
        sys.executable, "-m", "vdgs.cli", "map", str(run.path), "--piece", str(index), "--model", found.name,
        "--output", os.path.abspath(plan.folder), *where, *(["--sharp"] if asked.sharp else []),
        "--threads", str(share.needs.processors), "--device", device,
    ]  # fmt: skip


def map_piece(asked: MapRequest, index: int, console: Console) -> None:
    """Draw one piece of the tiles, continue it, or do nothing if it is done. Its tiles stay beside its status until all
    pieces are gathered."""
    opened = open_run(Path(os.path.abspath(asked.run)), asked.model, asked.device)
    plan = Plan.of(asked, opened.folder.path, opened.name, opened.status.model, opened.capture)
    work = _work(plan)
    folder, span = work.piece(index), work.span(index)
    if work.is_done(index):
        console.print(f"{folder.path}: already drawn; nothing to do", highlight=False)
        return
    left = [item for item in span if not work.file(item).exists()]
    with at_work(folder, len(span) - len(left), len(span)) as tell, plan.surveyor(opened.model) as surveyor:
        console.print(f"drawing tiles {span.start} to {span.stop - 1} of the {opened.line}", highlight=False)
        for done, item in enumerate(left, start=len(span) - len(left) + 1):
            stop_if_asked()
            save_tile(work.file(item), surveyor.tile(plan.grid.tile(item)[2]))
            tell(done)


def save_tile(path: Path, tile: Tile) -> None:
    """Write an .npz file (without pickle), atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{each.name: getattr(tile, each.name) for each in fields(Tile)})
    write_bytes(path, buffer.getvalue())


def load_tile(path: Path) -> Tile:
    """The inverse of `save_tile`. Raises RunError if the file is missing or damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            return Tile(**{each.name: file[each.name] for each in fields(Tile)})
    # What zipfile and numpy raise on damaged bytes has no common base.
    except (OSError, ValueError, KeyError, TypeError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error
