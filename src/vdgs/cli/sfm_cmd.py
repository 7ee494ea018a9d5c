"""The verb that makes a capture of photographs (`sfm_command`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from vdgs.cli.common import make_console, parse_arguments
from vdgs.config.ranges import WORKER_COUNT, FlagName
from vdgs.config.sfm_options import SfmOptions, SfmRequest


@dataclass(frozen=True, kw_only=True)
class SfmArguments:
    """Photographs to a capture: features, matches, poses and points, metres and north from their positions, photographs
    without lens distortion in three sizes. The same command goes on where it was stopped. Photographs are only read."""

    images: Positional[tuple[Path, ...]]
    """Folders of photographs, those below them included. A folder masks/ beside photographs has their masks (white =
    keep), named like them: name.png or name.jpg.png; name_mask.jpg beside name.jpg is one too."""
    output: Path
    """Folder of the capture; new, or the one to go on with."""
    gps: Path | None = None
    """Table of positions to use instead of those in the photographs: columns name,lat,lon,alt as exiftool, Metashape,
    Pix4D, RealityScan and others name them, ODM's geo.txt or DJI's .MRK. Names need no folder and no extension where
    they are told apart without."""
    dry_run: bool = False
    """Only look: what the photographs say, what would be done and how long it takes. Writes nothing."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads to use; 0 for all cores."""
    keep_intermediate: bool = False
    """Keep COLMAP's database and models in OUTPUT/work once all is done."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    options: Annotated[SfmOptions, arg(name=""), FlagName("")] = field(default_factory=SfmOptions)


def sfm_command(arguments: list[str]) -> None:
    asked = parse_arguments(SfmArguments, arguments, "vdgs sfm")
    from vdgs.errors import VdgsError
    from vdgs.sfm.reconstruction_plan import plan_reconstruction, print_plan

    if not asked.images:
        raise VdgsError("name the folder of the photographs: vdgs sfm PHOTOGRAPHS --output CAPTURE")
    request = SfmRequest(
        image_folders=asked.images, output=asked.output, gps=asked.gps, threads=asked.threads,
        keep_intermediate=asked.keep_intermediate, options=asked.options,
    )  # fmt: skip
    console = make_console(asked.quiet)
    if asked.dry_run:
        print_plan(plan_reconstruction(request), console)
        console.print("Nothing was written.", highlight=False)
        return
    from vdgs.sfm.reconstruct import reconstruct

    reconstruct(request, console)
    console.print(f"capture: {asked.output}\nnext: vdgs run {asked.output} --output RUN", highlight=False)
