"""`vdgs ortho`: from a run to GeoTIFFs and pictures of them, written whole or not at all."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rich.console import Console

from vdgs.config.commands import OrthoRequest
from vdgs.distributed.job_folders import clear
from vdgs.distributed.sharded_job import ExecutionOptions
from vdgs.errors import VdgsError
from vdgs.geometry.map_projection import MapProjection
from vdgs.rendering.ortho import geotiff, ortho_plan
from vdgs.rendering.ortho.geotiff import RasterLayer
from vdgs.rendering.ortho.map_status import METADATA_FILE
from vdgs.rendering.ortho.ortho_plan import DSM_FILE, ORTHOPHOTO_FILE, VISIBILITY_FILE, OrthoPlan
from vdgs.rendering.ortho.previews import PreviewSheet, write_hillshade, write_picture, write_preview
from vdgs.rendering.ortho.tile_renderer import NODATA_COUNT, NODATA_HEIGHT, OrthoTile
from vdgs.rendering.ortho.tile_shards import distributed_tiles
from vdgs.runs.lod_folder import drawn_scene
from vdgs.runs.open_run import locate_model
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.console import print_warning, track
from vdgs.system.documents import MapMetadata
from vdgs.system.scratch import nearest_existing
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size

#: What a map takes on the disk while it is written, in parts of its uncompressed size: tiles, overviews, the result.
_DISK_SHARE = 2.4


def render_ortho(
    context: RunContext, request: OrthoRequest, console: Console, execution: ExecutionOptions | None = None
) -> Path:
    """Write the maps of a run, on a device that is chosen already; returns their folder.

    Tiles are drawn in this process, or in shards where `execution` sends them: the files are the same. Raises
    VdgsError, before anything is drawn, for a system, pixel size or extent that makes no map, a folder among a
    capture's inputs or with such files of others, a disk without room, and where rasterio or pyproj is missing; and
    what `ShardedJob.send` raises.
    """
    geotiff.require_rasterio()
    ortho_plan.check_output_folder(output := ortho_plan.output_folder(request, request.run))
    ortho_plan.remove_killed(output, console)
    began = time.monotonic()
    if execution is not None and execution.is_distributed:
        share, folder = _render_sharded(context, request, execution, console)
    else:
        share, folder = _render_locally(context, request, console)
    console.print(f"maps: {folder} ({share:.0%} of the pixels, {time.monotonic() - began:.0f} s)", highlight=False)
    return folder


def _render_locally(context: RunContext, request: OrthoRequest, console: Console) -> tuple[float, Path]:
    """Draw in this process; returns the share of the pixels that are mapped, and the folder."""
    run = context.open_model(request.model, request.device, mapped=request.lod_error is not None)
    scene = drawn_scene(run, request.lod_error, request.device)
    plan = OrthoPlan.of(request, run.folder.path, run.name, run.status.model_id, run.capture, run.warning)
    _print_plan(plan, console)
    clear(plan.folder)
    with plan.tile_renderer(scene) as renderer:
        tiles = (renderer.render_tile(part) for _, _, part in plan.grid.tiles())
        return _write(plan, _counted(context.run, plan, tiles), console), plan.folder


def _render_sharded(
    context: RunContext, request: OrthoRequest, execution: ExecutionOptions, console: Console
) -> tuple[float, Path]:
    """Let shards of the tiles be drawn elsewhere, and gather them one at a time. This process holds no model."""
    context.release_models()
    run = RunFolder(Path(os.path.abspath(request.run)))  # as in `pipeline.train_blocks`: other machines may mount it so
    model = locate_model(run, request.model)
    model_id = model.stage.status().model_id
    plan = OrthoPlan.of(request, run.path, model.name, model_id, context.capture, model.warning)
    _print_plan(plan, console, sharded=True)
    with distributed_tiles(plan, request, run, model, execution, console) as tiles:
        return _write(plan, _counted(run, plan, tiles), console), plan.folder


def _counted(run: RunFolder, plan: OrthoPlan, tiles: Iterable[OrthoTile]) -> Iterator[OrthoTile]:
    """The tiles, counted for `vdgs status`: maps are what comes before the report."""
    progress = run.begin_step("report", "maps", "tiles", plan.grid.tile_count())
    for done, tile in enumerate(tiles, 1):
        yield tile
        progress(done)


def _write(plan: OrthoPlan, tiles: Iterable[OrthoTile], console: Console) -> float:
    """Make maps of all tiles, which come in their order: files that come to stand in the folder together. Returns
    the share of the pixels that are mapped."""
    layers = raster_layers(plan.placement)
    with ortho_plan.staging_folder(plan.folder) as staging, geotiff.limit_gdal_cache():
        metadata = _metadata(plan)
        metadata |= _draw(plan, tiles, layers, staging, metadata, console)
        if not metadata["mapped_share"]:
            raise VdgsError(
                f"{plan.folder}: the {plan.model} model shows nothing solid there, or no training photograph looks "
                "there. Give another --bbox or a smaller --gsd, or leave them out."
            )
        for layer in layers:
            rough = staging / f"rough-{layer.name}"
            geotiff.write_cog(rough, staging / layer.name, layer)
            rough.unlink()
        sheet = PreviewSheet(plan.run_name, plan.grid, plan.placement, metadata)
        orthophoto, dsm, visibility = (staging / layer.name for layer in layers)
        write_hillshade(dsm, staging / ortho_plan.HILLSHADE_FILE, plan.grid)
        write_picture(orthophoto, staging / ortho_plan.PICTURE_FILE)
        write_preview(orthophoto, dsm, visibility, staging / ortho_plan.PREVIEW_FILE, sheet)
        write_json(staging / METADATA_FILE, to_jsonable(metadata))
    return metadata["mapped_share"]


def raster_layers(placement: MapProjection) -> tuple[RasterLayer, RasterLayer, RasterLayer]:
    """The files of a map."""
    return (
        RasterLayer(
            name=ORTHOPHOTO_FILE,
            title="orthophoto: colors seen from straight above",
            bands=("red", "green", "blue", "alpha"),
            dtype="uint8",
            overviews="average",
        ),
        RasterLayer(
            name=DSM_FILE,
            title=f"surface model: {placement.height_reference}",
            bands=(f"height, {placement.height_reference}",),
            dtype="float32",
            nodata=NODATA_HEIGHT,
            unit=placement.unit,
        ),
        RasterLayer(
            name=VISIBILITY_FILE,
            title="V: training cameras whose picture holds the place",
            bands=("training cameras",),
            dtype="uint16",
            nodata=NODATA_COUNT,
            unit="cameras",
        ),
    )


def _print_plan(plan: OrthoPlan, console: Console, sharded: bool = False) -> None:
    """Print how large the map will be; raise VdgsError where the disk has no room for it, or rasterio cannot name its
    system."""
    grid, placement, folder = plan.grid, plan.placement, plan.folder
    geotiff.rasterio_crs(placement)
    print_warning(console, plan.warning)
    for note in plan.notes:
        console.print(f"[yellow]note[/] {note}", highlight=False)
    share = _DISK_SHARE + sharded  # tiles of shards lie beside it until all are gathered
    bytes_per_pixel = sum(layer.bytes_per_pixel for layer in raster_layers(placement))
    needed = int(share * grid.width * grid.height * bytes_per_pixel) + 5_000_000
    free = shutil.disk_usage(nearest_existing(folder.absolute())).free
    size = f"{grid.width * grid.gsd:.1f} x {grid.height * grid.gsd:.1f} {placement.unit}"
    console.print(
        f"map: {grid.width} x {grid.height} pixels of {grid.gsd:g} {placement.unit}, {size}, {placement.name}; heights "
        f"{placement.height_reference}; at most {data_size(needed)} on the disk",
        highlight=False,
    )
    if needed > free:
        raise VdgsError(
            f"{folder}: the map may take {data_size(needed)} while it is written, and {data_size(free)} are free. Free "
            f"some space, or give a larger --gsd than {grid.gsd:g}, a smaller --bbox, or an --output on another disk."
        )


def _draw(
    plan: OrthoPlan, tiles: Iterable[OrthoTile], layers: tuple[RasterLayer, ...], staging: Path, metadata: MapMetadata,
    console: Console,
) -> MapMetadata:  # fmt: skip
    """Write all tiles into files beside the final ones; returns what they show. One tile is in memory at a time."""
    grid = plan.grid
    keys = ("crs_name", "heights", "model", "georeference", "software")
    tags = {key.upper(): str(metadata[key]) for key in keys}  # type: ignore[literal-required]
    mapped, poorly, low, high = 0, 0, np.inf, -np.inf
    with ExitStack() as open_files:
        files = [
            open_files.enter_context(
                geotiff.open_geotiff(staging / f"rough-{layer.name}", layer, grid, plan.placement, tags)
            )
            for layer in layers
        ]
        placed = zip(grid.tiles(), tiles, strict=True)
        for (column, row, _), tile in track(placed, "drawing", grid.tile_count(), console):
            check_stop_requested()
            shown = tile.alpha > 0
            if shown.any():
                mapped += int(shown.sum())
                poorly += int((tile.visibility[shown] < 5).sum())
                low, high = min(low, float(tile.heights[shown].min())), max(high, float(tile.heights[shown].max()))
            for file, bands in zip(files, _bands(tile), strict=True):
                geotiff.write_tile(file, column, row, bands)
    return {
        "mapped_share": mapped / (grid.width * grid.height),
        "seen_by_fewer_than_5_share": poorly / mapped if mapped else None,
        "lowest": low if mapped else None, "highest": high if mapped else None,
    }  # fmt: skip


def _bands(tile: OrthoTile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    colored = np.concatenate([tile.colors, tile.alpha[..., None]], axis=-1)
    return np.moveaxis(colored, -1, 0), tile.heights[None], tile.visibility[None]


def _metadata(plan: OrthoPlan) -> MapMetadata:
    grid, placement, capture = plan.grid, plan.placement, plan.nadir_camera.capture
    middle = plan.nadir_camera.middle_of(grid)
    return {
        "software": ortho_plan.software_name(), "model": plan.model, "model_digest": plan.model_digest,
        "crs": placement.crs, "crs_name": placement.name, "unit": placement.unit,
        "heights": placement.height_reference, "georeference": capture.ground.description,
        "north_deg": placement.true_north(capture.ground, middle), "stretch": placement.stretch_at(middle),
        "gsd": grid.gsd, "width": grid.width, "height": grid.height, "bounds": list(grid.bounds),
        "samples_per_pixel": plan.samples**2, "sharpened": plan.detail_from_images,
        "training_cameras": len(capture.train_views),
        # Of the warning what is wrong, without the command, which has the path of the run.
        "notes": [*filter(None, [plan.warning.partition(":")[0]]), *plan.notes],
        "lod_error": plan.lod_error, "seen_at_grazing_angles_share": plan.grazing_share,
    }  # fmt: skip
