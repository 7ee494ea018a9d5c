"""Whether the maps of a run are drawn and can be. Imports nothing heavy."""

from __future__ import annotations

from importlib.util import find_spec

from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json_or_empty

METADATA_FILE = "map.json"


def is_ortho_current(run: RunFolder) -> bool:
    """Whether RUN/maps shows the merged model that is there, in full detail."""
    metadata = read_json_or_empty(run.path / "maps" / METADATA_FILE)
    drawn, in_full = metadata.get("model_digest"), metadata.get("lod_error") is None
    return drawn is not None and drawn == run.merged.status().model_id and in_full


def has_ortho_dependencies() -> bool:
    """Whether what `vdgs ortho` needs is installed."""
    return all(find_spec(name) is not None for name in ("rasterio", "pyproj"))
