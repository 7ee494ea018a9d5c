"""What a person may say about how a capture is read. Imports nothing heavy: the command line shows it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from vdgs.config.output_paths import Output
from vdgs.config.ranges import MAX_COUNT, Range
from vdgs.config.typed_paths import MaybeFolder

UpAxis = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
SplitMode = Literal["auto", "explicit", "every", "strips", "obliques"]
CaptureFormat = Literal[
    "auto", "colmap", "transforms", "mega-nerf", "matrixcity", "mvsnet", "llff", "metashape", "blocks-exchange", "opf",
    "pix4d", "opensfm", "realityscan", "openmvg", "alicevision", "visualsfm", "bundler",
]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """How to read a folder of photographs with cameras."""

    format: CaptureFormat = "auto"
    """Format to read, where a folder holds several. auto: of a COLMAP model and transforms.json the
    model, unless transforms.json lists training and test photographs or names masks."""
    images: Annotated[str | None, MaybeFolder()] = None
    """Image folder to use, such as images_4, in the capture or elsewhere. Default: images, or where absent the largest
    images_N. Of a project of another program: any folder that its photographs are in or below; default: images, or the
    whole folder."""
    strict: bool = False
    """Refuse a capture of which photographs are missing. By default the others are used where two
    thirds are there. Of a project of another program also one with cameras that cannot be used."""
    downscale: Annotated[float, Range(1, 1000)] = 1.0
    """Shrink images by this factor when they are loaded. 2: half the width and height."""
    test_every: Annotated[int, Range(2, MAX_COUNT)] = 8
    """Every n-th photograph in name order is kept for testing. Those are 0, n, 2n and so on, as in 3DGS (llffhold)."""
    test_list: Path | None = None
    """Text file with the names of the test photographs, one a line. Default: test.txt of the capture, if any."""
    split: SplitMode = "auto"
    """How photographs are kept for testing. auto: the capture's own split or test list where there is one, else every
    n-th (where transforms.json lists training and test photographs, those in neither list are left out); explicit:
    insist on it; every: always every n-th. To measure away from where photographs train, whatever lists there are:
    strips leaves out whole strips of the flight, obliques all photographs that do not look straight down (with
    --validation other strips, and every second oblique, are tested)."""
    validation: bool = False
    """Test on photographs for validation instead. The test photographs are left out altogether, and tests are on those
    named in validation.txt of the capture folder instead, or where there is none on every n-th training photograph: for
    choosing settings without looking at the test set. Photographs named in validation.txt never train."""
    up: UpAxis = "auto"
    """Which axis of the capture points up. auto: georeference, GPS, or estimated."""
    gps: Path | None = None
    """Table of the photographs' GPS positions. Columns name,lat,lon,alt as exiftool, Metashape, Pix4D, RealityScan and
    others name them (further ones allowed), or ODM's geo.txt. Names need no folder and no extension where they are told
    apart without."""
    georef: Path | None = None
    """georef.json saying that the world already is ENU metres. Default: the one in the capture folder."""
    scale_bar: Path | None = None
    """Text file of known distances, which give the scale in metres: lines `NAME px py photograph` (pixels) or `NAME ray
    x y photograph` mark points in two photographs or more, lines `NAME NAME metres` say how far they are apart. `vdgs
    view` writes such a file."""
    max_images: Annotated[int | None, Range(2, MAX_COUNT)] = None
    """Use only this many photographs. Those nearest to the middle of the flight are taken."""
    undistort: bool = False
    """Says that photographs are bent by their lens. It is undone without being asked, once, and reused; then the folder
    of photographs as the cameras took them is used, whatever smaller ones there are."""
    undistorted_folder: Annotated[Path | None, Output()] = None
    """Where undistorted photographs are kept. Default: undistorted/ inside the capture folder."""
    masks: Annotated[str, MaybeFolder()] = "masks"
    """Folder of masks (white = keep), named like the photographs. That is name.png or name.jpg.png."""
