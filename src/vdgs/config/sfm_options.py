"""What a person may say about how photographs become a capture. Imports nothing heavy: the command line shows it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from vdgs.config.output_paths import Output
from vdgs.config.ranges import MAX_COUNT, WORKER_COUNT, FlagName, Range

CameraModel = Literal["auto", "simple-radial", "opencv", "opencv-fisheye", "equirectangular"]

Brackets = Literal["middle", "all"]


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """How photographs become a capture (structure from motion)."""

    focal: Literal["auto", "fixed", "refine"] = "auto"
    """How the focal length is found. fixed: that of EXIF and XMP; refine: fitted; auto: held where the flight cannot
    tell it from the height (straight down from one height, by what the drone recorded or by level positions all over an
    area) and where the maker calibrated it; fitted otherwise."""
    camera_model: CameraModel = "auto"
    """How lenses bend. auto: one radial term, a fisheye's four where EXIF's name of the lens says so, or where the
    photographs do (of lenses up to 20 mm, 35 mm equivalent), and panoramas of 360° by their XMP; opencv: two radial and
    two tangential terms; equirectangular: every photograph twice as wide as high is a panorama of 360°."""
    brackets: Brackets = "middle"
    """Which exposures of a bracket (AEB) are used. middle: the middle one of those of one place and moment, by EXIF;
    all: every photograph."""
    num_neighbors: Annotated[int, Range(2, 1000)] = 16
    """Neighbors that each photograph is matched with. Where positions are known; more where neighbors show
    little of the same: facades, oblique views, several cameras at one place."""
    exhaustive_max: Annotated[int, Range(0, MAX_COUNT)] = 50
    """Up to so many photographs without positions are matched all with all. Of more, those are matched that are next
    to each other in order or look alike."""
    max_image_size: Annotated[int, Range(200, 100_000)] = 2000
    """Longer side at which features are found, in pixels."""
    max_num_features: Annotated[int, Range(200, 1_000_000)] = 8192
    """Features of a photograph, at most about this number."""
    max_output_size: Annotated[int, Range(16, 1_000_000, allow_zero=True)] = 0
    """Longer side of written photographs, in pixels; 0: full size. Of those in images/."""
    num_frames: Annotated[int, Range(3, MAX_COUNT)] = 300
    """Frames of all films together, at most. They are taken where the picture has moved by an eighth, the sharpest of
    those around each place."""
    gcp: Path | None = None
    """Control points and where photographs show them: gcp_list.txt, as for ODM. The model is brought to them; that of
    a finished capture in seconds."""
    check_points: tuple[str, ...] = ()
    """Names of points of --gcp that are only measured; all: every point. The adjustment does not use them."""
    georeference: Literal["auto", "anyway", "off"] = "auto"
    """Whether positions and control points place the scene. auto: as far as they are good, with their accuracy; not
    where that is worse than nothing, and an error where they contradict the photographs; anyway: as they are; off: not
    at all (metres then come from --scale-bar). Changed afterwards, the finished capture is placed anew in seconds."""
    scale_bar: Path | None = None
    """Text file of known distances. Lines `NAME px py photograph` mark points in two photographs or more, lines
    `NAME NAME metres` say how far these are apart. Gives the scale without positions, or together with positions."""
    gps_std_m: Annotated[tuple[float, float], Range(0, 100_000, exclusive_min=True)] = (1.0, 2.0)
    """Standard deviation of GPS across and up, in metres. Where the photographs state none (RTK in XMP;
    GPSHPositioningError in EXIF, with heights worse in the same ratio as here). Poses do not depend on it: the errors
    of positions are estimated from the flight, and the value for a table counts in addition."""


@dataclass(frozen=True, kw_only=True)
class SfmRequest:
    """Photographs to a capture (`vdgs sfm`)."""

    image_folders: tuple[Path, ...]
    output: Annotated[Path, Output()]
    gps: Path | None = None
    threads: Annotated[int, WORKER_COUNT] = 0
    keep_intermediate: bool = False
    overwrite: bool = False
    """Make a capture anew whose photographs were added, removed or changed."""
    options: Annotated[SfmOptions, FlagName("")] = field(default_factory=SfmOptions)
