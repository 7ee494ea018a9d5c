"""`vdgs map`: from a run to GeoTIFFs and pictures of them, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from vdgs.config.commands import MapRequest
from vdgs.distributed.job_folders import clear
from vdgs.distributed.sharded_job import Wish
from vdgs.errors import VdgsError
from vdgs.geometry.map_projection import Placement
from vdgs.rendering.ortho.geotiff import Layer, bounded_cache, cloud_optimised, require_rasterio, write_tile, writing
from vdgs.rendering.ortho.ortho_folder import (
    DSM,
    FACTS,
    HILLSHADE,
    ORTHOPHOTO,
    PREVIEW,
    VISIBILITY,
    refuse_foreign,
    software,
    staged,
)
from vdgs.rendering.ortho.ortho_plan import Plan, folder_of
from vdgs.rendering.ortho.previews import Sheet, hillshade_png, preview_png
from vdgs.rendering.ortho.tile_renderer import NO_COUNT, NO_HEIGHT, Tile
from vdgs.rendering.ortho.tile_shards import drawn_elsewhere
from vdgs.runs.open_run import find_model
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import jsonable, read_record, write_json
from vdgs.system.documents import MapMetadata
from vdgs.system.stop_signals import stop_if_asked
from vdgs.system.units import data_size

#: What a map takes on the disk while it is written, in parts of its uncompressed size: tiles, overviews, the result.
_DISK_SHARE = 2.4


def map_run(context: RunContext, asked: MapRequest, console: Console, wish: Wish | None = None) -> Path:
    """Write the maps of a run, on a device that is chosen already; returns their folder.

    Tiles are drawn in this process, or in shards where a `wish` sends them: the files are the same. Raises VdgsError,
    before anything is drawn, for a system, pixel size or extent that makes no map, a folder among a capture's inputs or
    with such files of others, a disk without room, and where rasterio or pyproj is missing; and what
    `ShardedJob.send` raises.
    """
    require_rasterio()
    refuse_foreign(folder_of(asked, asked.run))
    began = time.monotonic()
    if wish is not None and wish.sends:
        facts, folder = _map_in_pieces(context, asked, wish, console)
    else:
        facts, folder = _map_here(context, asked, console)
    console.print(
        f"maps: {folder} ({facts['mapped_share']:.0%} of the pixels, {time.monotonic() - began:.0f} s)",
        highlight=False,
    )
    return folder


def _map_here(context: RunContext, asked: MapRequest, console: Console) -> tuple[MapMetadata, Path]:
    """Draw in this process; what came out, and where."""
    run = context.open_model(asked.model, asked.device)
    plan = Plan.of(asked, run.folder.path, run.name, run.status.model, run.capture)
    _announce(plan, console)
    clear(plan.folder)
    with plan.surveyor(run.model) as surveyor:
        return _write(plan, (surveyor.tile(part) for _, _, part in plan.grid.tiles()), console), plan.folder


def _map_in_pieces(context: RunContext, asked: MapRequest, wish: Wish, console: Console) -> tuple[MapMetadata, Path]:
    """Let shards of the tiles be drawn elsewhere, and gather them one at a time. No model is in the memory of this
    process."""
    context.release_models()
    run = RunFolder(Path(os.path.abspath(asked.run)))  # as in `stages.train`: other machines may mount it so
    found, capture = find_model(run, asked.model), context.capture
    plan = Plan.of(asked, run.path, found.name, found.stage.status().model, capture)
    _announce(plan, console, in_pieces=True)
    with drawn_elsewhere(plan, asked, run, found, wish, console) as tiles:
        return _write(plan, tiles, console), plan.folder


def _write(plan: Plan, tiles: Iterable[Tile], console: Console) -> MapMetadata:
    """Make maps of all tiles, which come in their order: files that come to stand in the folder together. Returns
    what map.json says."""
    layers = layers_of(plan.placement)
    with staged(plan.folder) as staging, bounded_cache():
        facts = _facts(plan)
        facts |= _draw(plan, tiles, layers, staging, facts, console)
        if not facts["mapped_share"]:
            raise VdgsError(
                f"{plan.folder}: the {plan.model} model shows nothing solid there, or no training photograph looks "
                "there. Give another --bbox or leave it out."
            )
        for layer in layers:
            rough = staging / f"rough-{layer.name}"
            cloud_optimised(rough, staging / layer.name, layer)
            rough.unlink()
        sheet = Sheet(plan.run_name, plan.grid, plan.placement, facts)
        hillshade_png(staging / DSM, staging / HILLSHADE, plan.grid)
        preview_png(staging / ORTHOPHOTO, staging / DSM, staging / VISIBILITY, staging / PREVIEW, sheet)
        write_json(staging / FACTS, jsonable(facts))
    return facts


def is_mapped(run: RunFolder) -> bool:
    """Whether RUN/maps shows the merged model that is there."""
    drawn = read_record(run.path / "maps" / FACTS).get("model_identity")
    return drawn is not None and drawn == run.merged.status().model


def can_map() -> bool:
    """Whether what `vdgs map` needs is installed."""
    return all(find_spec(name) is not None for name in ("rasterio", "pyproj"))


def layers_of(placement: Placement) -> tuple[Layer, Layer, Layer]:
    """The files of a map."""
    return (
        Layer(
            name=ORTHOPHOTO,
            title="orthophoto: colours seen from straight above",
            bands=("red", "green", "blue", "alpha"),
            dtype="uint8",
            nodata=None,
            overviews="average",
        ),
        Layer(
            name=DSM,
            title=f"surface model: {placement.heights}",
            bands=(f"height, {placement.heights}",),
            dtype="float32",
            nodata=NO_HEIGHT,
            overviews="nearest",
            unit=placement.unit,
        ),
        Layer(
            name=VISIBILITY,
            title="V: training cameras whose picture holds the place",
            bands=("training cameras",),
            dtype="uint16",
            nodata=NO_COUNT,
            overviews="nearest",
            unit="cameras",
        ),
    )


def _announce(plan: Plan, console: Console, in_pieces: bool = False) -> None:
    """Say how large the map will be; raise VdgsError where the disk has no room for it."""
    grid, placement, folder = plan.grid, plan.placement, plan.folder
    for note in placement.notes:
        console.print(f"[yellow]note[/] {note}", highlight=False)
    # What shards have drawn lies beside it until all is gathered.
    share = _DISK_SHARE + 1 if in_pieces else _DISK_SHARE
    needed = int(share * grid.width * grid.height * sum(layer.bytes_per_pixel for layer in layers_of(placement)))
    needed += 5_000_000
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    free = shutil.disk_usage(existing).free
    across, along = grid.width * grid.gsd, grid.height * grid.gsd
    console.print(
        f"map: {grid.width} x {grid.height} pixels of {grid.gsd:g} {placement.unit}, {across:.1f} x {along:.1f} "
        f"{placement.unit}, {placement.name}; heights {placement.heights}; at most {data_size(needed)} on the disk",
        highlight=False,
    )
    if needed > free:
        raise VdgsError(
            f"{folder}: the map may take {data_size(needed)} while it is written, and {data_size(free)} are free. Give "
            f"a larger --gsd than {grid.gsd:g}, a smaller --bbox, or an --output on another disk."
        )


def _draw(
    plan: Plan, tiles: Iterable[Tile], layers: tuple[Layer, ...], staging: Path, facts: MapMetadata,
    console: Console,
) -> MapMetadata:  # fmt: skip
    """Put all tiles into files beside the final ones; what came out. One tile is in memory at a time."""
    grid = plan.grid
    tags = {"CRS_NAME": facts["crs_name"], "HEIGHTS": facts["heights"], "MODEL": facts["model"],
            "SOFTWARE": facts["software"]}  # fmt: skip
    mapped, poorly, low, high = 0, 0, np.inf, -np.inf
    with ExitStack() as open_files:
        files = [
            open_files.enter_context(writing(staging / f"rough-{layer.name}", layer, grid, plan.placement, tags))
            for layer in layers
        ]
        shown_tiles = track(
            zip(grid.tiles(), tiles, strict=True), "drawing", total=grid.tile_count(), console=console,
            disable=not console.is_terminal,
        )  # fmt: skip
        for (column, row, _), tile in shown_tiles:
            stop_if_asked()
            shown = tile.alpha > 0
            if shown.any():
                mapped += int(shown.sum())
                poorly += int((tile.visibility[shown] < 5).sum())
                low, high = min(low, float(tile.heights[shown].min())), max(high, float(tile.heights[shown].max()))
            for file, bands in zip(files, _bands(tile), strict=True):
                write_tile(file, column, row, bands)
    return {
        "mapped_share": mapped / (grid.width * grid.height),
        "seen_by_fewer_than_5_share": poorly / mapped if mapped else None,
        "lowest": low if mapped else None, "highest": high if mapped else None,
    }  # fmt: skip


def _bands(tile: Tile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    coloured = np.concatenate([tile.colours, tile.alpha[..., None]], axis=-1)
    return np.moveaxis(coloured, -1, 0), tile.heights[None], tile.visibility[None]


def _facts(plan: Plan) -> MapMetadata:
    grid, placement, capture = plan.grid, plan.placement, plan.above.capture
    return {
        "software": software(), "model": plan.model, "model_identity": plan.model_identity,
        "crs": placement.crs, "crs_name": placement.name,
        "unit": placement.unit, "heights": placement.heights, "georeference": capture.ground.how,
        "gsd": grid.gsd, "width": grid.width, "height": grid.height, "bounds": list(grid.bounds),
        "samples_per_pixel": plan.samples**2, "sharpened": plan.sharp,
        "training_cameras": len(capture.train_views),
        "notes": list(placement.notes),
    }  # fmt: skip
