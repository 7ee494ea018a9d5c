"""What a map is made of (pixels, cameras above them, a model), and the folder that its files come to stand in."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from vdgs import __version__
from vdgs.captures.capture import Capture
from vdgs.captures.grazing_views import grazing_note, grazing_share
from vdgs.captures.output_guard import check_not_among_inputs, check_output
from vdgs.captures.strays import folder_in_run
from vdgs.config.commands import OrthoRequest
from vdgs.errors import VdgsError
from vdgs.geometry.map_projection import MapProjection
from vdgs.model.renderer import Drawable
from vdgs.rendering.ortho import pixel_grid
from vdgs.rendering.ortho.detail_transfer import DetailTransfer
from vdgs.rendering.ortho.map_status import METADATA_FILE
from vdgs.rendering.ortho.nadir_camera import NadirCamera
from vdgs.rendering.ortho.pixel_grid import PixelGrid
from vdgs.rendering.ortho.tile_renderer import TileRenderer, samples_per_side
from vdgs.rendering.picture_sidecars import remove_sidecars
from vdgs.runs.motion_masks import with_motion_masks
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json_or_empty, reason_of, write_json
from vdgs.system.scratch import remove_leftovers, scratch_folder

ORTHOPHOTO_FILE, DSM_FILE, VISIBILITY_FILE = "orthophoto.tif", "dsm.tif", "visibility.tif"
HILLSHADE_FILE, PICTURE_FILE, PREVIEW_FILE = "hillshade.png", "orthophoto.png", "preview.png"
FILE_NAMES = (
    ORTHOPHOTO_FILE, DSM_FILE, VISIBILITY_FILE, HILLSHADE_FILE, PICTURE_FILE, PREVIEW_FILE, METADATA_FILE
)  # fmt: skip
#: The folder in a folder of maps where new ones are drawn, by the name that `scratch_folder` takes.
STAGING = "maps"


def output_folder(request: OrthoRequest, run: Path) -> Path:
    """Where the files of a map go: where a run is asked for, into its folder of maps."""
    return run / "maps" if request.output is None else folder_in_run(request.output, "maps")


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
    lod_error: float | None
    """How many pixels places may be off, drawn through the level-of-detail tree; None: drawn from all anchors."""

    warning: str = ""
    """Why it is not the model that one would expect (`runs.open_run`); empty where it is."""
    grazing_share: float = 0.0
    """What of the ground is seen at grazing angles alone (`captures.grazing_views`)."""

    @staticmethod
    def of(
        request: OrthoRequest, run: Path, model: str, model_digest: str | None, capture: Capture, warning: str = ""
    ) -> OrthoPlan:  # fmt: skip
        """The map that is asked for of a run folder. Raises VdgsError for a system, pixel size or extent that makes
        none, and for an output among inputs of the capture."""
        folder = output_folder(request, run)
        check_not_among_inputs(folder, capture)
        if request.detail_from_images:  # nothing that moves in the photographs may be painted on the ground
            capture = with_motion_masks(RunFolder(run), capture, needed=False)
        placement = MapProjection.of(capture.ground, request.crs)
        scale = placement.similarity_at(pixel_grid.median_point(capture)).scale
        finest = pixel_grid.ground_sampling_distance(capture, scale)
        extent = pixel_grid.capture_extent(capture, placement)
        grid = pixel_grid.grid_of_map(capture, extent, finest, request.bbox, request.gsd)
        if request.bbox is not None and extent is not None:
            pixel_grid.check_overlap(request.bbox, extent, placement)
        above = NadirCamera.of(capture, placement)
        above.camera(grid.subgrid(0, 0, 1, 1))  # a system that makes no map is refused here
        return OrthoPlan(
            folder=folder, run_name=run.name, model=model, model_digest=model_digest, nadir_camera=above, grid=grid,
            samples=samples_per_side(grid.gsd, finest), detail_from_images=request.detail_from_images,
            lod_error=request.lod_error, warning=warning, grazing_share=grazing_share(capture),
        )  # fmt: skip

    @property
    def placement(self) -> MapProjection:
        return self.nadir_camera.placement

    @property
    def notes(self) -> list[str]:
        """What people should know of its place and of its photographs."""
        return [*self.placement.notes, *filter(None, [grazing_note(self.grazing_share)])]

    @contextmanager
    def tile_renderer(self, model: Drawable) -> Iterator[TileRenderer]:
        """What draws its tiles."""
        details = DetailTransfer(model, self.nadir_camera.capture) if self.detail_from_images else None
        try:
            yield TileRenderer(model, self.nadir_camera, self.samples, details)
        finally:
            if details is not None:
                details.close()


def remove_killed(folder: Path, console: Console) -> None:
    """Remove what a killed `vdgs ortho` left in a folder of maps."""
    if found := remove_leftovers(folder / STAGING):
        said = f"[yellow]note[/] removed what a killed command had left: {', '.join(map(str, found))}"
        console.print(said, highlight=False)


def software_name() -> str:
    """What map.json calls the program that drew the files beside it."""
    return f"vdgs {__version__}"


def check_output_folder(folder: Path) -> None:
    """Raise VdgsError where maps may not go: among inputs of a capture, or where files of their names are not ours."""
    check_output(folder)
    if folder.exists() and not folder.is_dir():
        raise VdgsError(f"{folder}: is a file. Give a folder for the maps.")
    if folder.suffix.lower() in (".tif", ".tiff", ".vrt", ".png") and not folder.exists():
        raise VdgsError(f"{folder}: maps are several files. Give a folder for them, such as {folder.with_suffix('')}")
    present = [name for name in FILE_NAMES if os.path.lexists(folder / name)]
    is_ours = str(read_json_or_empty(folder / METADATA_FILE).get("software")).startswith("vdgs ")
    if present and not is_ours:
        raise VdgsError(
            f"{folder}: holds {', '.join(present)}, and no {METADATA_FILE} says that `vdgs ortho` wrote them. Nothing "
            "was drawn. Give a new or an empty folder for --output; one with maps of vdgs gets the new ones in their "
            "place."
        )


@contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` whose files come to stand in it when all are there; nothing is left if not.

    map.json comes last: while files take their places it says only whose they are. What programs have laid beside an
    earlier file goes with it: they would show its numbers for those of the new one. Raises VdgsError, with the remedy,
    where the disk refuses.
    """
    try:
        with scratch_folder(folder / STAGING) as scratch:
            staging = scratch / "maps"
            staging.mkdir()
            try:
                yield staging
                write_json(folder / METADATA_FILE, {"software": software_name(), "finished": False})
                for file in sorted(staging.iterdir(), key=lambda file: (file.name == METADATA_FILE, file.name)):
                    os.replace(file, folder / file.name)
                    remove_sidecars(folder / file.name)
            except OSError as error:  # rasterio's errors are such too, and GDAL's own words mislead
                raise reason_of(error, staging) from error
    except OSError as error:
        raise VdgsError(
            f"{folder}: the maps cannot be written ({error.strerror or error}). Free some space, allow writing "
            "there, or give another --output; maps that were there are kept."
        ) from error
    finally:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
