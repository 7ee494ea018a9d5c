"""What is decided before a map is drawn: which pixels, in which coordinates, from which model, into which folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vdgs.captures.capture import Capture
from vdgs.maps.grid import Grid, extent_of, grid_over, ground_sampling, middle_of, refuse_elsewhere
from vdgs.maps.overhead import Overhead
from vdgs.maps.sharpening import Sharpener
from vdgs.maps.tiles import Surveyor, samples_for
from vdgs.model.anchor_model import AnchorModel
from vdgs.placing.placement import Placement
from vdgs.settings.requests import MapRequest


@dataclass(frozen=True, eq=False)
class MapPlan:
    """A map that can be drawn."""

    folder: Path
    run: Path
    model: str
    """Which model of the run, "coarse" or "merged", and the identity of its file."""
    identity: str
    overhead: Overhead
    grid: Grid
    samples: int
    """Samples per pixel, each way."""
    sharp: bool

    @property
    def capture(self) -> Capture:
        return self.overhead.capture

    @property
    def placement(self) -> Placement:
        return self.overhead.placement

    @contextmanager
    def surveyor(self, model: AnchorModel) -> Iterator[Surveyor]:
        """What draws the tiles of this map."""
        sharpener = Sharpener(model, self.capture) if self.sharp else None
        try:
            yield Surveyor(model, self.overhead, self.samples, sharpener)
        finally:
            if sharpener is not None:
                sharpener.close()


def plan_map(asked: MapRequest, run: Path, capture: Capture, model: str, identity: str) -> MapPlan:
    """The map that is asked for, of a model of a run with this capture.

    Raises VdgsError for a system, pixel size or extent that makes no map.
    """
    placement = Placement.of(capture.ground, asked.crs)
    finest = ground_sampling(capture, placement.similarity_at(middle_of(capture)).scale)
    shown = extent_of(capture, placement)
    grid = grid_over(asked.bbox or shown, finest if asked.gsd is None else asked.gsd)
    refuse_elsewhere(grid, shown, placement)
    overhead = Overhead.of(capture, placement)
    overhead.camera(grid.part(0, 0, 1, 1))  # a system that makes no map is refused here
    folder = asked.output or run / "maps"
    return MapPlan(folder, run, model, identity, overhead, grid, samples_for(grid.gsd, finest), asked.sharp)
