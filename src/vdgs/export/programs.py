"""What each program that draws Gaussians expects: which files, and which axes it shows upright.

`vdgs export --for PROGRAM` writes for one of them, `--axes` names axes alone. Formats that prescribe their axes (glTF,
3D Tiles, LAS, our page) have no others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from vdgs.config.commands import ExportRequest
from vdgs.errors import VdgsError
from vdgs.export.formats import registry
from vdgs.export.formats.axes import BY_NAME, Y_DOWN, Y_UP, Y_UP_LEFT, Z_UP, Axes
from vdgs.export.formats.streamed_sog import LOD_FILE
from vdgs.export.formats.tiles_3d import TILESET_FILE

#: Where files are written whose names nobody gave, in the run folder.
FOLDER = "export"


@dataclass(frozen=True)
class Program:
    """What a program opens."""

    title: str
    #: The file to write where none is named.
    file: str
    #: By the ending of a file, its axes; None: those that the format prescribes.
    axes: Mapping[str, Axes | None]
    #: Why it has no other files.
    why: str


_PLAYCANVAS = Program(
    "SuperSplat and PlayCanvas", "supersplat.compressed.ply",
    {".compressed.ply": Y_DOWN, ".ply": Y_DOWN, ".sog": Y_DOWN, ".splat": Y_DOWN,
     LOD_FILE: Y_DOWN},
    "its versions do not agree how an SPZ stands",
)  # fmt: skip
PROGRAMS: Mapping[str, Program] = {
    "supersplat": _PLAYCANVAS,
    "playcanvas": _PLAYCANVAS,
    "spark": Program(
        "Spark (three.js)", "spark.spz",
        {".spz": Y_UP, ".ply": Y_UP, ".compressed.ply": Y_UP, ".splat": Y_UP, ".sog": Y_UP,
         ".rad": Y_UP},
        "Spark opens no others",
    ),
    "gaussiansplats3d": Program(
        "GaussianSplats3D (three.js)", "gaussiansplats3d.ply",
        {".ply": Y_UP, ".splat": Y_UP},
        "it opens no others upright",
    ),
    "cesium": Program("CesiumJS", f"tiles/{TILESET_FILE}", {TILESET_FILE: None}, "Gaussians come as 3D Tiles only"),
    "blender": Program(
        "Blender", "blender.ply", {".ply": Z_UP, ".points.ply": Z_UP, ".glb": None}, "Blender's add-ons read PLY"
    ),
    "unity": Program(
        "Unity (UnityGaussianSplatting)", "unity.ply", {".ply": Y_UP_LEFT, ".points.ply": Y_UP_LEFT},
        "the plugin takes the numbers of a PLY as they are",
    ),
}  # fmt: skip
#: Formats whose axes may be chosen.
FREE = (".points.ply", ".compressed.ply", ".ply", ".spz", ".splat", ".sog", ".rad", LOD_FILE)


def with_files(asked: ExportRequest) -> ExportRequest:
    """With the file that suits the program, in RUN/export, where none is named."""
    if asked.output or asked.program is None:
        return asked
    return replace(asked, output=(asked.run / FOLDER / PROGRAMS[asked.program].file,))


def axes_for(path: Path, asked: ExportRequest) -> Axes | None:
    """How the axes of a file shall stand; None: as its format has them. Raises VdgsError for a file that the program
    does not open, and for axes that a format does not have."""
    ending = registry.format_from_path(path).suffix
    if asked.axes is not None:
        if asked.program is not None:
            raise VdgsError(f"--axes {asked.axes}: --for {asked.program} chooses the axes. Leave out one of them.")
        if ending not in FREE:
            raise VdgsError(
                f"--axes {asked.axes}: {path.name} has axes of its own ({ending}). --axes is for {', '.join(FREE)}: "
                "leave it out, or write one of those."
            )
        return BY_NAME[asked.axes]
    if asked.program is None:
        return None
    program = PROGRAMS[asked.program]
    if ending not in program.axes:
        raise VdgsError(
            f"--for {asked.program}: {path.name} is no file for {program.title}; {program.why}. Write "
            f"{' or '.join(program.axes)}."
        )
    return program.axes[ending]
