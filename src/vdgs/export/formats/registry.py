"""Formats by the endings of their files: who writes and reads them, what they keep, and what opens them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError
from vdgs.export.formats.export_scene import Scene, beside, joined
from vdgs.export.formats.gaussian_ply import ply_pieces, write_ply
from vdgs.export.formats.gltf import refuse_too_large, write_glb
from vdgs.export.formats.html import html_pieces, refuse_without_viser, write_html
from vdgs.export.formats.point_cloud import refuse_without_laspy, write_laz, write_points
from vdgs.export.formats.sog import write_sog
from vdgs.export.formats.splat import splat_pieces, write_splat
from vdgs.export.formats.spz import REACH, refuse_too_far, spz_pieces, write_spz
from vdgs.export.formats.tiles_3d import NAME, refuse_other_names, write_tiles
from vdgs.model.gaussians import Gaussians


@dataclass(frozen=True, kw_only=True)
class Format:
    """One kind of file. `write` returns a sentence for each thing that was lost."""

    #: How the file's name ends, in lower case.
    ending: str
    #: What it is, in a few words.
    what: str
    write: Callable[[Path, Scene], tuple[str, ...]]
    #: Reads a file back into the ground frame, piece by piece, where that makes sense.
    read: Callable[[Path], Iterator[Gaussians]] | None = None
    #: Raises VdgsError for what can be known to fail before the first chunk is asked for.
    check: Callable[[Path, Scene], None] = lambda path, scene: None
    #: Whether facts are written to FILE.json, for the format has no room for them.
    facts_beside: bool = False
    #: Coordinates lie below this, from the origin.
    reach: float = math.inf
    #: Whether its colours do not change with the direction: best baked so, where all files are of that kind.
    fixed: bool = False
    #: Whether it stands on the globe, in no map's coordinates.
    on_globe: bool = False


#: The longer endings first: `.points.ply` is a `.ply` too.
FORMATS: tuple[Format, ...] = (
    Format(ending=".points.ply", what="point cloud, local coordinates", write=write_points),
    Format(ending=".ply", what="3DGS PLY, nothing lost", write=write_ply, read=ply_pieces),
    Format(
        ending=".spz",
        what="SPZ, a sixth of the PLY or less",
        write=write_spz,
        read=spz_pieces,
        check=refuse_too_far,
        facts_beside=True,
        reach=REACH,
    ),
    Format(
        ending=".splat",
        what="32 bytes a Gaussian, fixed colours",
        write=write_splat,
        read=splat_pieces,
        facts_beside=True,
    ),
    Format(ending=".sog", what="PlayCanvas' SOG, a twelfth of the PLY or less", write=write_sog, facts_beside=True),
    Format(
        ending=".glb", what="glTF with KHR_gaussian_splatting, nothing lost", write=write_glb, check=refuse_too_large
    ),
    Format(
        ending=NAME, what="3D Tiles for CesiumJS, in levels", write=write_tiles, check=refuse_other_names, on_globe=True
    ),
    Format(
        ending=".html",
        what="page that shows the scene offline",
        write=write_html,
        read=html_pieces,
        check=refuse_without_viser,
        fixed=True,
    ),
    Format(ending=".laz", what="point cloud, map coordinates, compressed", write=write_laz, check=refuse_without_laspy),
    Format(ending=".las", what="point cloud, map coordinates", write=write_laz, check=refuse_without_laspy),
)


def format_of(path: Path) -> Format:
    """The format that a file's name asks for. Raises VdgsError, naming those there are, for any other."""
    name = path.name.lower()
    for each in FORMATS:
        if name == NAME == each.ending or (
            each.ending[0] == "." and name.endswith(each.ending) and name != each.ending
        ):
            return each
    known = ", ".join(f"{each.ending} ({each.what})" for each in FORMATS)
    raise VdgsError(f"{path}: no format is known by this name. Let it end in one of: {known}.")


def check(path: Path, scene: Scene) -> None:
    """Raise VdgsError for what would fail: a name, a missing package, too many or too far. Asks for no chunk."""
    chosen = format_of(path)
    if scene.count < 1:
        raise VdgsError(f"{path}: the scene has no Gaussians, there is nothing to write.")
    if path.is_dir() and chosen.ending != NAME:
        raise VdgsError(f"{path}: is a folder. Give the name of a file.")
    chosen.check(path, scene)


def write(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write a scene in the format of the file's name, whole or not at all. Returns what was lost. Raises VdgsError."""
    check(path, scene)
    return format_of(path).write(path, scene)


def read(path: Path) -> Gaussians:
    """Read Gaussians back, in the ground frame of the scene that was written. Raises VdgsError."""
    return joined(pieces(path))


def pieces(path: Path) -> Iterator[Gaussians]:
    """The same, some thousand at a time."""
    chosen = format_of(path)
    if chosen.read is None:
        able = ", ".join(each.ending for each in FORMATS if each.read)
        raise VdgsError(f"{path}: such files are written but not read. Readable are: {able}.")
    return chosen.read(path)


def written_by(path: Path) -> tuple[Path, ...]:
    """The files that writing `path` replaces, beside the tiles of a tileset."""
    return (path, beside(path)) if format_of(path).facts_beside else (path,)
