"""The folder that a render writes into: what an earlier render wrote there gives way, nothing else does.

render.json lists what was written, and says what it shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path, PurePath
from typing import Any

from vdgs.captures.strays import is_of_system
from vdgs.errors import VdgsError
from vdgs.rendering.picture_sidecars import remove_sidecars, sidecar_names
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.units import some_names

MANIFEST_FILE = "render.json"
_WRITER = "vdgs render"


def begin_render(folder: Path, names: Sequence[str]) -> list[str]:
    """Make a folder ready for files of these names; returns those that an earlier render left in it.

    They stay until `finish_render`. The manifest lists both from here on, so that a render that was cut off is known
    again. Raises VdgsError, before anything is written, for a folder that holds anything but an earlier render; what
    systems lay into folders and programs beside pictures counts for nothing.
    """
    if folder.exists() and not folder.is_dir():
        raise VdgsError(f"{folder}: is a file. Give a folder for pictures, or a name that ends in .mp4 for a film.")
    present = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    earlier = _listed_files(folder) & present
    ours = {*earlier, *chain.from_iterable(map(sidecar_names, earlier))}
    ours |= {MANIFEST_FILE} if _has_manifest(folder) else set()
    foreign = sorted(name for name in present - ours if name in names or not is_of_system(name))
    if foreign:
        shown = some_names(foreign, 3)
        raise VdgsError(
            f"{folder}: holds {len(foreign)} files or folders that no render wrote ({shown}). Give a new or an empty "
            f"folder for --output; one that `vdgs render` filled is replaced."
        )
    files = sorted(earlier | set(names))
    write_json(folder / MANIFEST_FILE, {"written_by": _WRITER, "finished": False, "files": files})
    return sorted(earlier)


def finish_render(folder: Path, earlier: Sequence[str], names: Sequence[str], metadata: Mapping[str, Any]) -> None:
    """Remove what the earlier render left and this one did not write again; note what is there and what it shows."""
    for name in set(earlier) - set(names):
        (folder / name).unlink(missing_ok=True)
    for name in {*earlier, *names}:
        remove_sidecars(folder / name)
    write_json(folder / MANIFEST_FILE, {"written_by": _WRITER, "finished": True, **metadata, "files": sorted(names)})


def _has_manifest(folder: Path) -> bool:
    return read_json_or_empty(folder / MANIFEST_FILE).get("written_by") == _WRITER


def _listed_files(folder: Path) -> set[str]:
    """The files in a folder that its list names: plain names of files only, whoever edited the list."""
    files = read_json_or_empty(folder / MANIFEST_FILE).get("files") if _has_manifest(folder) else None
    names = {name for name in files if isinstance(name, str)} if isinstance(files, list) else set()
    return {name for name in names if PurePath(name).name == name and (folder / name).is_file()}
