"""The tiles of a map drawn in shards, elsewhere or by several processes, and gathered one at a time.

FOLDER/shards/KEY/NN/   of shard NN: a file for each of its tiles (`distributed.sharded_job`), the arrays that it shows
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, fields, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from vdgs.config.commands import OrthoRequest
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.shard import Results, Shard
from vdgs.distributed.sharded_job import ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.rendering.ortho.detail_transfer import HALO_PX, cache_sizes
from vdgs.rendering.ortho.ortho_plan import OrthoPlan
from vdgs.rendering.ortho.pixel_grid import TILE_PX
from vdgs.rendering.ortho.tile_renderer import OrthoTile
from vdgs.runs.lod_folder import drawn_scene
from vdgs.runs.open_run import ModelLocation
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.array_files import explain_damaged_part, load_arrays, save_arrays
from vdgs.system.memory.memory_estimate import render_bytes

#: Tiles of a shard, least and most, and how many shards there are in between (choice).
TILES_OF_SHARD = 2, 100, 16
TILE_LABELS = shard_kind("draw", "tiles")


@contextmanager
def distributed_tiles(
    plan: OrthoPlan,
    request: OrthoRequest,
    run: RunFolder,
    model: ModelLocation,
    execution: ExecutionOptions,
    console: Console,
) -> Iterator[Iterator[OrthoTile]]:
    """All tiles of a map, in their order, once shards have drawn them; what they left is removed at the end.

    Raises what `ShardedJob.send` raises, and RunError where another process draws the same map.
    """
    request = OrthoRequest(
        run=run.path, output=Path(os.path.abspath(plan.folder)), gsd=request.gsd, bbox=request.bbox, crs=request.crs,
        detail_from_images=request.detail_from_images, model=model.name, lod_error=request.lod_error,
    )  # fmt: skip
    job = _job(plan, request)
    images = cache_sizes(plan.detail_from_images, plan.nadir_camera.capture)
    side = (TILE_PX + (2 * HALO_PX if plan.detail_from_images else 0)) * plan.samples
    files = [run.config_file, model.stage.model, *image_and_mask_files(plan.nadir_camera.capture.train_views)]
    needs = ShardNeeds(
        render_bytes(model.stage.model.stat().st_size, images.depths, side * side),
        lambda: NodeRequirements(job.folder, files),
    )
    with job.exclusive():
        job.run(needs, replace(execution, image_gb=max(images.images, 1) / 1e9), console)
        yield job.gather(load_tile)


def _job(plan: OrthoPlan, request: OrthoRequest) -> ShardedJob:
    """The tiles in shards, and what they depend on."""
    grid, how = list(astuple(plan.grid)), [plan.samples, plan.detail_from_images, plan.lod_error]
    depends_on = [plan.model, plan.model_digest, plan.placement.crs, grid, *how]
    spans = split_ranges(plan.grid.tile_count(), *TILES_OF_SHARD)
    return ShardedJob.create("tiles", request, plan.folder, TILE_LABELS, depends_on, spans)


def draw_shard(shard: Shard) -> None:
    """Draw a shard of the tiles. They stay beside its status until all are gathered."""
    request = shard.request(OrthoRequest)
    context = RunContext.from_path(request.run)
    run = context.open_model(request.model, shard.device, mapped=request.lod_error is not None)
    scene = drawn_scene(run, request.lod_error, shard.device)
    plan = OrthoPlan.of(request, request.run, run.name, run.status.model_id, run.capture)

    def results(left: Sequence[int]) -> Results:
        shard.console.print(f"drawing {len(left)} tiles of the {run.summary}", highlight=False)
        with plan.tile_renderer(scene) as renderer:
            for item in left:
                yield partial(save_tile, tile=renderer.render_tile(plan.grid.tile(item)[2]))

    shard.do(_job(plan, request), results)


def save_tile(path: Path, tile: OrthoTile) -> None:
    """Write an .npz file (without pickle), atomically."""
    save_arrays(path, {each.name: getattr(tile, each.name) for each in fields(OrthoTile)})


def load_tile(path: Path) -> OrthoTile:
    """The inverse of `save_tile`. Raises RunError if the file is missing or damaged."""
    with explain_damaged_part(path):
        arrays = load_arrays(path)
        return OrthoTile(**{each.name: arrays[each.name] for each in fields(OrthoTile)})
