"""Formats by the endings of their files: who writes and reads them, what they keep, and what opens them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError
from vdgs.export.formats.axes import Y_DOWN, Y_UP, Z_UP, Axes
from vdgs.export.formats.compressed_ply import compressed_ply_pieces, is_compressed, write_compressed_ply
from vdgs.export.formats.export_scene import ExportScene, InitialView, concatenate, metadata_path
from vdgs.export.formats.file_folders import FileFolder
from vdgs.export.formats.foreign_gaussians import finite_pieces
from vdgs.export.formats.gaussian_ply import beside_ply, read_ply_chunks, reads_as_written_beside, write_ply
from vdgs.export.formats.gltf import check_glb_size, write_glb
from vdgs.export.formats.html import check_page, html_capacity, read_html_chunks, write_html
from vdgs.export.formats.ply_header import read_ply_header
from vdgs.export.formats.point_cloud import (
    LAS_REACH_IN_EXTENTS,
    MAX_LAS_COORDINATE,
    check_las,
    write_laz,
    write_points,
)
from vdgs.export.formats.rad import write_rad
from vdgs.export.formats.sog import write_sog
from vdgs.export.formats.splat import read_splat_chunks, write_splat
from vdgs.export.formats.spz import MAX_COORDINATE, check_range, read_spz_chunks, write_spz
from vdgs.export.formats.streamed_page import NODE_FOLDER, PAGE_FILE, SCENE_FILE, check_page_folder, write_streamed_page
from vdgs.export.formats.streamed_sog import LOD_FILE, LOD_FOLDER, check_lod_folder, write_streamed_sog
from vdgs.export.formats.tiles_3d import TILE_FOLDER, TILESET_FILE, check_tileset_folder, write_tiles
from vdgs.model.gaussians import Gaussians
from vdgs.system.scratch import remove_leftovers

#: What files that vdgs wrote say within so many bytes.
_PROGRAM, _HEAD_BYTES = b"vdgs", 1 << 20


@dataclass(frozen=True, kw_only=True)
class ExportFormat:
    """One kind of file. `write` returns a sentence for each thing that was lost."""

    #: How the file's name ends, in lower case.
    suffix: str
    #: What it is, in a few words.
    description: str
    write: Callable[[Path, ExportScene], tuple[str, ...]]
    #: How its axes stand where no others are asked for.
    axes: Axes = Z_UP
    #: Reads a file back into the ground frame, piece by piece, where that makes sense.
    read: Callable[[Path], Iterator[Gaussians]] | None = None
    #: Raises VdgsError for what can be known to fail before the first chunk is asked for.
    check: Callable[[Path, ExportScene], None] = lambda path, scene: None
    #: Whether facts are written to FILE.json, for the format has no room for them.
    writes_metadata_file: bool = False
    #: Which file beside it is written or removed with it, where there is one.
    facts_file: Callable[[Path], Path] | None = None
    #: Coordinates lie below this, from the origin.
    max_coordinate: float = math.inf
    #: Where their unit is unknown: below so many times what 99 of 100 Gaussians reach. None: no such distinction.
    reach_in_extents: float | None = None
    #: Whether its colors do not change with the direction: best baked so, where all files are of that kind.
    fixed_colors: bool = False
    #: Whether it rounds the coefficients of changing colors so that they may be worth less than the room they take.
    rounds_harmonics: bool = False
    #: Whether it holds points without shapes, which stand where a map has them exactly.
    only_points: bool = False
    #: Whether it stands on the globe, in no map's coordinates.
    on_globe: bool = False
    #: How many Gaussians like these a file has room for, where that depends on what is asked of it.
    capacity: Callable[[Gaussians, InitialView], int] | None = None
    #: Where other files lie that the file names.
    folder: FileFolder | None = None
    #: What is written beside the file under a name of its own.
    page_file: str | None = None

    @property
    def holds_changing_colors(self) -> bool:
        """Whether colors may change with the direction."""
        return not (self.fixed_colors or self.only_points)

    def names(self, path: Path) -> list[Path]:
        """The files that are written under names which another output could have too."""
        return [path, *([path.with_name(self.page_file)] if self.page_file else [])]

    def files(self, path: Path) -> list[Path]:
        """A file that was written, with those that it names."""
        return [path, *(self.folder.files(path) if self.folder else [])]

    def tidy(self, path: Path) -> list[Path]:
        """Remove what killed exports left beside a file, and return it."""
        return self.folder.remove_killed(path) if self.folder else remove_leftovers(path)


def read_any_ply(path: Path) -> Iterator[Gaussians]:
    """The Gaussians of a PLY by what its header says: compressed ones have names of plain ones elsewhere."""
    return (compressed_ply_pieces if is_compressed(read_ply_header(path)) else read_ply_chunks)(path)


#: The longer endings first: `.points.ply` and `.compressed.ply` are `.ply` too.
FORMATS: tuple[ExportFormat, ...] = (
    ExportFormat(
        suffix=".points.ply",
        description="point cloud, local coordinates",
        write=write_points,
        facts_file=beside_ply,
        only_points=True,
    ),
    ExportFormat(
        suffix=".compressed.ply",
        description="PlayCanvas' compressed PLY, a quarter",
        write=write_compressed_ply,
        rounds_harmonics=True,
        axes=Y_DOWN,
        read=read_any_ply,
        facts_file=beside_ply,
    ),
    ExportFormat(
        suffix=".ply",
        description="3DGS PLY, nothing lost",
        write=write_ply,
        read=read_any_ply,
        facts_file=beside_ply,
    ),
    ExportFormat(
        suffix=".spz",
        description="SPZ, a sixth of the PLY or less",
        write=write_spz,
        rounds_harmonics=True,
        axes=Y_UP,
        read=read_spz_chunks,
        check=check_range,
        writes_metadata_file=True,
        facts_file=metadata_path,
        max_coordinate=MAX_COORDINATE,
    ),
    ExportFormat(
        suffix=".splat",
        description="32 bytes a Gaussian, fixed colors",
        write=write_splat,
        fixed_colors=True,
        axes=Y_DOWN,
        read=read_splat_chunks,
        writes_metadata_file=True,
        facts_file=metadata_path,
    ),
    ExportFormat(
        suffix=".sog",
        description="PlayCanvas' SOG, a twelfth of the PLY or less",
        write=write_sog,
        rounds_harmonics=True,
        axes=Y_DOWN,
        writes_metadata_file=True,
        facts_file=metadata_path,
    ),
    ExportFormat(
        suffix=".rad",
        description="Spark's RAD, with levels",
        write=write_rad,
        rounds_harmonics=True,
        axes=Y_UP,
        writes_metadata_file=True,
        facts_file=metadata_path,
    ),
    ExportFormat(
        suffix=".glb",
        description="glTF with KHR_gaussian_splatting, nothing lost",
        write=write_glb,
        axes=Y_UP,
        check=check_glb_size,
    ),
    ExportFormat(
        suffix=TILESET_FILE,
        description="3D Tiles for CesiumJS, in levels",
        write=write_tiles,
        rounds_harmonics=True,
        check=check_tileset_folder,
        on_globe=True,
        folder=TILE_FOLDER,
    ),
    ExportFormat(
        suffix=LOD_FILE,
        description="PlayCanvas' streamed SOG, in levels",
        write=write_streamed_sog,
        rounds_harmonics=True,
        axes=Y_DOWN,
        check=check_lod_folder,
        writes_metadata_file=True,
        facts_file=metadata_path,
        folder=LOD_FOLDER,
    ),
    ExportFormat(
        suffix=SCENE_FILE,
        description="folder with a page that streams, for a web server",
        write=write_streamed_page,
        check=check_page_folder,
        fixed_colors=True,
        folder=NODE_FOLDER,
        page_file=PAGE_FILE,
    ),
    ExportFormat(
        suffix=".html",
        description="page that shows the scene offline",
        write=write_html,
        read=read_html_chunks,
        check=check_page,
        fixed_colors=True,
        capacity=html_capacity,
    ),
    ExportFormat(
        suffix=".laz",
        description="point cloud, map coordinates, compressed",
        write=write_laz,
        check=check_las,
        max_coordinate=MAX_LAS_COORDINATE,
        reach_in_extents=LAS_REACH_IN_EXTENTS,
        facts_file=metadata_path,
        only_points=True,
    ),
    ExportFormat(
        suffix=".las",
        description="point cloud, map coordinates",
        write=write_laz,
        check=check_las,
        max_coordinate=MAX_LAS_COORDINATE,
        reach_in_extents=LAS_REACH_IN_EXTENTS,
        facts_file=metadata_path,
        only_points=True,
    ),
)


def find_format(path: Path) -> ExportFormat | None:
    """The format that a file's name asks for; None for a name of no format."""
    name = path.name.lower()
    for each in FORMATS:
        if name == each.suffix if each.folder else name.endswith(each.suffix) and name != each.suffix:
            return each
    return None


def format_from_path(path: Path) -> ExportFormat:
    """The format that a file's name asks for. Raises VdgsError, naming those there are, for any other."""
    found = find_format(path)
    if found is not None:
        return found
    known = ", ".join(f"{each.suffix} ({each.description})" for each in FORMATS)
    raise VdgsError(f"{path}: no format is known by this name. Let it end in one of: {known}.")


def check_not_foreign(path: Path) -> None:
    """Raise VdgsError where a file stands at the path that says nowhere, nor its FILE.json, that vdgs wrote it; or at
    that of FILE.json or FILE.prj one that is not ours."""
    chosen = format_from_path(path)
    check_ours(path, *([metadata_path(path)] if chosen.writes_metadata_file else []))
    if chosen.facts_file is metadata_path:
        check_ours(metadata_path(path))
    elif chosen.facts_file is not None:
        beside = chosen.facts_file(path)  # names no program: it is ours beside a file of ours
        if not (beside.is_file() and reads_as_written_beside(beside)):
            check_ours(beside, path)


def check_ours(path: Path, *beside: Path) -> None:
    """Raise VdgsError where a file stands at the path that says nowhere, nor those beside it, that vdgs wrote it."""
    try:
        if not path.is_file() or not path.stat().st_size or any(map(_names_vdgs, (path, *beside))):
            return
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error}). Choose another name.") from error
    raise VdgsError(f"{path}: is there already and was not written by vdgs. Choose another name, or remove the file.")


def _names_vdgs(file: Path) -> bool:
    """Whether the beginning of a file, in which every format names the program that wrote it, names this one."""
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        return _PROGRAM in stream.read(_HEAD_BYTES)


def check_export(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError for what would fail: a name, a missing package, too many or too far. Asks for no chunk."""
    chosen = format_from_path(path)
    if scene.count < 1:
        raise VdgsError(f"{path}: the scene has no Gaussians, there is nothing to write.")
    if path.is_dir() and chosen.folder is None:
        raise VdgsError(f"{path}: is a folder. Give the name of a file.")
    chosen.check(path, scene)


def write_scene(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write a scene in the format of the file's name, whole or not at all. Returns what was lost. Raises VdgsError."""
    check_export(path, scene)
    return format_from_path(path).write(path, scene)


def read_gaussians(path: Path) -> Gaussians:
    """Read Gaussians back, in the ground frame of the scene that was written. Raises VdgsError."""
    return concatenate(read_chunks(path))


def read_chunks(path: Path) -> Iterator[Gaussians]:
    """The same, some thousand at a time."""
    chosen = format_from_path(path)
    if chosen.read is None:
        able = ", ".join(each.suffix for each in FORMATS if each.read)
        raise VdgsError(f"{path}: such files are written but not read. Readable are: {able}.")
    return finite_pieces(path, chosen.read(path))
