"""The verb that makes maps of a run: `map`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from vdgs.settings.requests import MapRequest
from vdgs.verbs.shared import open_console, parse, use_device, use_threads


@dataclass(frozen=True)
class MapArguments(MapRequest):
    """Make maps of a run: orthophoto, surface model and visibility as GeoTIFFs, hillshade and preview as PNG.

    Needs rasterio and pyproj: pip install 'vdgs[geo]'.
    """

    run: Positional[Path]
    """Run folder."""


def map(arguments: list[str]) -> None:
    asked = parse(MapArguments, arguments, "vdgs map")
    from vdgs.maps.mapping import map_run

    device = use_device(asked.device)
    use_threads(asked.threads)
    map_run(replace(asked, device=device), open_console())
