"""What is to be drawn before anything is: the pixels of a map, the cameras above them, and of which model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vdgs.captures.capture import Capture
from vdgs.captures.output_guard import check_not_among_inputs
from vdgs.config.commands import OrthoRequest
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.anchor_model import AnchorModel
from vdgs.rendering.ortho.detail_transfer import DetailTransfer
from vdgs.rendering.ortho.nadir_camera import NadirCamera
from vdgs.rendering.ortho.pixel_grid import (
    PixelGrid,
    capture_extent,
    check_grid_overlap,
    grid_from_bbox,
    ground_sampling_distance,
    median_point,
)
from vdgs.rendering.ortho.tile_renderer import TileRenderer, samples_per_side


def output_folder(request: OrthoRequest, run: Path) -> Path:
    """Where the files of a map go."""
    return request.output or run / "maps"


@dataclass(frozen=True, eq=False, kw_only=True)
class OrthoPlan:
    """A map that is to be drawn."""

    folder: Path
    """Where its files go."""
    run_name: str
    model: str
    """Which model, in a word; `model_digest` tells it from every other."""
    model_digest: str | None
    nadir_camera: NadirCamera
    grid: PixelGrid
    samples: int
    """Samples per pixel, each way."""
    detail_from_images: bool
    """Whether detail is taken from the photographs."""

    @staticmethod
    def of(request: OrthoRequest, run: Path, model: str, model_digest: str | None, capture: Capture) -> OrthoPlan:
        """The map that is asked for of a run folder. Raises VdgsError for a system, pixel size or extent that makes
        none, and for an output among inputs of the capture."""
        folder = output_folder(request, run)
        check_not_among_inputs(folder, capture)
        placement = MapProjection.of(capture.ground, request.crs)
        finest = ground_sampling_distance(capture, placement.similarity_at(median_point(capture)).scale)
        shown = capture_extent(capture, placement)
        grid = grid_from_bbox(request.bbox or shown, finest if request.gsd is None else request.gsd)
        check_grid_overlap(grid, shown, placement)
        above = NadirCamera.of(capture, placement)
        above.camera(grid.subgrid(0, 0, 1, 1))  # a system that makes no map is refused here
        return OrthoPlan(
            folder=folder, run_name=run.name, model=model, model_digest=model_digest, nadir_camera=above, grid=grid,
            samples=samples_per_side(grid.gsd, finest), detail_from_images=request.detail_from_images,
        )  # fmt: skip

    @property
    def placement(self) -> MapProjection:
        return self.nadir_camera.placement

    @contextmanager
    def tile_renderer(self, model: AnchorModel) -> Iterator[TileRenderer]:
        """What draws its tiles."""
        sharpener = DetailTransfer(model, self.nadir_camera.capture) if self.detail_from_images else None
        try:
            yield TileRenderer(model, self.nadir_camera, self.samples, sharpener)
        finally:
            if sharpener is not None:
                sharpener.close()
