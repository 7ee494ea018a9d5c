"""What QGIS, GDAL and viewers lay beside a picture: it is of that picture alone."""

from __future__ import annotations

from pathlib import Path

#: How such files end, after the picture's whole name: statistics, overviews, a mask.
_ENDINGS = (".aux.xml", ".ovr", ".msk")


def sidecar_names(picture: str) -> list[str]:
    """What files are called that belong to a picture of this name."""
    return [picture + ending for ending in _ENDINGS]


def remove_sidecars(picture: Path) -> None:
    """Remove what was made of an earlier picture: programs would show its numbers for those of the new one."""
    for name in sidecar_names(picture.name):
        picture.with_name(name).unlink(missing_ok=True)
