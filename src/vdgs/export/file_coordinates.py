"""What the coordinates of an exported file mean, for people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from vdgs.config.commands import ExportRequest
from vdgs.export.formats import registry
from vdgs.export.formats.axes import EARTH_CENTERED, Z_UP, Axes
from vdgs.export.local_frame import LocalFrame
from vdgs.export.programs import axes_for
from vdgs.geometry.crs import ELLIPSOIDAL_REFERENCE

#: The system of 3D Tiles, whose transform takes what stands east, north and up about a place on Earth there.
ON_GLOBE = "Earth-centered, Earth-fixed (WGS 84, EPSG:4978)"
#: What is said of its heights, which no axis counts.
GLOBE_HEIGHTS = (
    f"heights on the globe are {ELLIPSOIDAL_REFERENCE}; where those are above the sea, the scene stands too low or too "
    "high by the height of the geoid"
)


@dataclass(frozen=True)
class FileCoordinates:
    """The system of a file and its axes."""

    name: str
    #: Where the axes go, as the file itself says it.
    axes: str
    #: What the third coordinate counts from, where it counts upwards.
    heights: str | None
    #: What a person should know of the system.
    notes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The system in a line."""
        return f"{self.name}; {self.axes if self.heights is None else f'heights {self.heights}'}"


def axes_of_file(path: Path, frame: LocalFrame, request: ExportRequest) -> Axes:
    """How the axes of a file stand that is written in these coordinates."""
    if frame.is_geocentric:
        return EARTH_CENTERED
    return axes_for(path, request) or registry.format_from_path(path).axes


def coordinates_of_file(path: Path, frame: LocalFrame, request: ExportRequest) -> FileCoordinates:
    """What to say of a file's coordinates."""
    if registry.format_from_path(path).on_globe and frame.facts.geodetic is not None:
        return FileCoordinates(ON_GLOBE, EARTH_CENTERED.description, None, (*frame.notes, GLOBE_HEIGHTS))
    axes = axes_of_file(path, frame, request)
    heights = frame.height_reference if axes is Z_UP else None
    return FileCoordinates(frame.name, axes.words(frame.facts.has_compass), heights, frame.notes)
