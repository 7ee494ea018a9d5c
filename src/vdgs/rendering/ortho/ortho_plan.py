"""What is to be drawn before anything is: the pixels of a map, the cameras above them, and of which model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vdgs.captures.capture import Capture
from vdgs.captures.output_guard import refuse_among_inputs
from vdgs.config.commands import MapRequest
from vdgs.geometry.map_projection import Placement
from vdgs.model.anchor_model import AnchorModel
from vdgs.rendering.ortho.detail_transfer import Sharpener
from vdgs.rendering.ortho.nadir_camera import Overhead
from vdgs.rendering.ortho.pixel_grid import Grid, extent_of, grid_over, ground_sampling, middle_of, refuse_elsewhere
from vdgs.rendering.ortho.tile_renderer import Surveyor, samples_for


def folder_of(asked: MapRequest, run: Path) -> Path:
    """Where the files of a map go."""
    return asked.output or run / "maps"


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan:
    """A map that is to be drawn."""

    folder: Path
    """Where its files go."""
    run_name: str
    model: str
    """Which model, in a word; `model_identity` tells it from every other."""
    model_identity: str | None
    above: Overhead
    grid: Grid
    samples: int
    """Samples per pixel, each way."""
    sharp: bool
    """Whether detail is taken from the photographs."""

    @staticmethod
    def of(asked: MapRequest, run: Path, model: str, model_identity: str | None, capture: Capture) -> Plan:
        """The map that is asked for of a run folder. Raises VdgsError for a system, pixel size or extent that makes
        none, and for an output among inputs of the capture."""
        folder = folder_of(asked, run)
        refuse_among_inputs(folder, capture)
        placement = Placement.of(capture.ground, asked.crs)
        finest = ground_sampling(capture, placement.similarity_at(middle_of(capture)).scale)
        shown = extent_of(capture, placement)
        grid = grid_over(asked.bbox or shown, finest if asked.gsd is None else asked.gsd)
        refuse_elsewhere(grid, shown, placement)
        above = Overhead.of(capture, placement)
        above.camera(grid.part(0, 0, 1, 1))  # a system that makes no map is refused here
        return Plan(
            folder=folder, run_name=run.name, model=model, model_identity=model_identity, above=above, grid=grid,
            samples=samples_for(grid.gsd, finest), sharp=asked.sharp,
        )  # fmt: skip

    @property
    def placement(self) -> Placement:
        return self.above.placement

    @contextmanager
    def surveyor(self, model: AnchorModel) -> Iterator[Surveyor]:
        """What draws its tiles."""
        sharpener = Sharpener(model, self.above.capture) if self.sharp else None
        try:
            yield Surveyor(model, self.above, self.samples, sharpener)
        finally:
            if sharpener is not None:
                sharpener.close()
