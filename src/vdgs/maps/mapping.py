"""`vdgs map`: from a run to GeoTIFFs and pictures of them, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from vdgs.errors import VdgsError
from vdgs.maps.geotiff import Layer, bounded_cache, cloud_optimised, require_rasterio, write_tile, writing
from vdgs.maps.grid import Grid, extent_of, grid_over, ground_sampling, middle_of, refuse_elsewhere
from vdgs.maps.pictures import Sheet, hillshade_png, preview_png
from vdgs.maps.sharpening import Sharpener
from vdgs.maps.tiles import NO_COUNT, NO_HEIGHT, Surveyor, Tile, samples_for
from vdgs.placing.placement import Placement
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.settings.requests import MapRequest
from vdgs.storage.files import jsonable, read_record, write_json

ORTHOPHOTO, DSM, VISIBILITY = "orthophoto.tif", "dsm.tif", "visibility.tif"
HILLSHADE, PREVIEW, FACTS = "hillshade.png", "preview.png", "map.json"
#: What a map takes on the disk while it is written, in parts of its uncompressed size: tiles, overviews, the result.
_DISK_SHARE = 2.4


def map_run(asked: MapRequest, console: Console) -> Path:
    """Write the maps of a run, on a device that is chosen already; returns their folder.

    Raises VdgsError, before anything is drawn, for a system, pixel size or extent that makes no map, a disk without
    room, and where rasterio or pyproj is missing.
    """
    require_rasterio()
    run = open_run(asked.run, asked.model, asked.device)
    capture = run.capture
    placement = Placement.of(capture.ground, asked.crs)
    scale = placement.similarity_at(middle_of(capture)).scale
    finest = ground_sampling(capture, scale)
    shown = extent_of(capture, placement)
    grid = grid_over(asked.bbox or shown, finest if asked.gsd is None else asked.gsd)
    refuse_elsewhere(grid, shown, placement)
    sharpener = Sharpener(run.model, capture) if asked.sharp else None
    surveyor = Surveyor.of(run.model, capture, placement, samples_for(grid.gsd, finest), sharpener)
    surveyor.camera(grid.part(0, 0, 1, 1))  # a system that makes no map is refused here
    folder = asked.output or run.folder.path / "maps"
    for note in placement.notes:
        console.print(f"[yellow]note[/] {note}", highlight=False)
    _announce(grid, placement, folder, console)
    started = time.monotonic()
    layers = layers_of(placement)
    with ExitStack() as ending, _staged(folder) as staging, bounded_cache():
        if sharpener is not None:
            ending.callback(sharpener.close)
        facts = _facts(run, grid, placement, surveyor)
        facts |= _draw(surveyor, grid, layers, staging, facts, console)
        if not facts["mapped_share"]:
            raise VdgsError(
                f"{folder}: the {run.name} model shows nothing solid there, or no training photograph looks there. "
                "Give another --bbox or leave it out."
            )
        for layer in layers:
            rough = staging / f"rough-{layer.name}"
            cloud_optimised(rough, staging / layer.name, layer)
            rough.unlink()
        sheet = Sheet(run.folder.path.name, grid, placement, facts)
        hillshade_png(staging / DSM, staging / HILLSHADE, grid)
        preview_png(staging / ORTHOPHOTO, staging / DSM, staging / VISIBILITY, staging / PREVIEW, sheet)
        write_json(staging / FACTS, jsonable(facts))
    console.print(
        f"maps: {folder} ({facts['mapped_share']:.0%} of the pixels, {time.monotonic() - started:.0f} s)",
        highlight=False,
    )
    return folder


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
        Layer(ORTHOPHOTO, "orthophoto: colours seen from straight above", ("red", "green", "blue", "alpha"), "uint8",
              None, "average"),
        Layer(DSM, f"surface model: {placement.heights}", (f"height, {placement.heights}",), "float32", NO_HEIGHT,
              "average", placement.unit),
        Layer(VISIBILITY, "V: training cameras whose picture holds the place", ("training cameras",), "uint16",
              NO_COUNT, "nearest", "cameras"),
    )  # fmt: skip


def _announce(grid: Grid, placement: Placement, folder: Path, console: Console) -> None:
    """Say how large the map will be; raise VdgsError where the disk has no room for it."""
    pixels = grid.width * grid.height
    needed = int(_DISK_SHARE * pixels * sum(layer.bytes_per_pixel for layer in layers_of(placement))) + 5_000_000
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    free = shutil.disk_usage(existing).free
    across, along = grid.width * grid.gsd, grid.height * grid.gsd
    console.print(
        f"map: {grid.width} x {grid.height} pixels of {grid.gsd:g} {placement.unit}, {across:.1f} x {along:.1f} "
        f"{placement.unit}, {placement.name}; heights {placement.heights}; at most {_size(needed)} on the disk",
        highlight=False,
    )
    if needed > free:
        raise VdgsError(
            f"{folder}: the map may take {_size(needed)} while it is written, and {_size(free)} are free. Give a "
            f"larger --gsd than {grid.gsd:g}, a smaller --bbox, or an --output on another disk."
        )


def _draw(
    surveyor: Surveyor, grid: Grid, layers: tuple[Layer, ...], staging: Path, facts: dict[str, Any], console: Console
) -> dict[str, Any]:
    """Draw all tiles into files beside the final ones; what came out. One tile is in memory at a time."""
    tags = {"CRS_NAME": facts["crs_name"], "HEIGHTS": facts["heights"], "MODEL": facts["model"],
            "SOFTWARE": facts["software"]}  # fmt: skip
    mapped, poorly, low, high = 0, 0, np.inf, -np.inf
    with ExitStack() as open_files:
        files = [
            open_files.enter_context(writing(staging / f"rough-{layer.name}", layer, grid, surveyor.placement, tags))
            for layer in layers
        ]
        tiles = track(
            grid.tiles(), "drawing", total=grid.tile_count(), console=console, disable=not console.is_terminal
        )
        for column, row, part in tiles:
            tile = surveyor.tile(part)
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


def _facts(run: TrainedRun, grid: Grid, placement: Placement, surveyor: Surveyor) -> dict[str, Any]:
    from vdgs import __version__

    return {
        "software": f"vdgs {__version__}", "model": run.name, "model_identity": run.status.model,
        "crs": placement.crs, "crs_name": placement.name,
        "unit": placement.unit, "heights": placement.heights, "georeference": run.capture.ground.how,
        "gsd": grid.gsd, "width": grid.width, "height": grid.height, "bounds": list(grid.bounds),
        "samples_per_pixel": surveyor.samples**2, "sharpened": surveyor.sharpener is not None,
        "training_cameras": len(run.capture.train_views),
        "notes": list(placement.notes),
    }  # fmt: skip


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` whose files come to stand in it when all are there; nothing is left if not.

    Raises VdgsError, with the remedy, where the disk refuses.
    """
    staging = folder / f".maps-{os.getpid()}"
    try:
        staging.mkdir(parents=True, exist_ok=True)
        yield staging
        for file in sorted(staging.iterdir()):
            os.replace(file, folder / file.name)
    except OSError as error:  # rasterio's errors are such too
        raise VdgsError(
            f"{folder}: the maps cannot be written ({error.strerror or error}). Free some space or give another "
            "--output; maps that were there are kept."
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
