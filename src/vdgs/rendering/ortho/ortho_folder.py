"""The folder of a map: what its files are called, whose they are, and how they come to stand in it together."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vdgs.captures.output_guard import check_not_in_capture
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json

ORTHOPHOTO_FILE, DSM_FILE, VISIBILITY_FILE = "orthophoto.tif", "dsm.tif", "visibility.tif"
HILLSHADE_FILE, PREVIEW_FILE, METADATA_FILE = "hillshade.png", "preview.png", "map.json"
FILE_NAMES = (ORTHOPHOTO_FILE, DSM_FILE, VISIBILITY_FILE, HILLSHADE_FILE, PREVIEW_FILE, METADATA_FILE)


def software_name() -> str:
    """What map.json calls the program that drew the files beside it."""
    from vdgs import __version__

    return f"vdgs {__version__}"


def check_output_folder(folder: Path) -> None:
    """Raise VdgsError where maps may not go: among inputs of a capture, or where files of their names are not ours."""
    check_not_in_capture(folder)
    if folder.exists() and not folder.is_dir():
        raise VdgsError(f"{folder}: is a file. Give a folder for the maps.")
    there = [name for name in FILE_NAMES if os.path.lexists(folder / name)]
    if there and not _is_ours(folder):
        raise VdgsError(
            f"{folder}: holds {', '.join(there)}, and no {METADATA_FILE} says that `vdgs ortho` wrote them. Nothing was drawn. "
            "Give a new or an empty folder for --output; one with maps of vdgs gets the new ones in their place."
        )


def _is_ours(folder: Path) -> bool:
    return str(read_json_or_empty(folder / METADATA_FILE).get("software")).startswith("vdgs ")


@contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` whose files come to stand in it when all are there; nothing is left if not.

    map.json comes last: while files take their places it says only whose they are. Raises VdgsError, with the remedy,
    where the disk refuses.
    """
    staging = folder / f".maps-{os.getpid()}"
    try:
        staging.mkdir(parents=True, exist_ok=True)
        yield staging
        write_json(folder / METADATA_FILE, {"software": software_name(), "finished": False})
        for file in sorted(staging.iterdir(), key=lambda file: (file.name == METADATA_FILE, file.name)):
            os.replace(file, folder / file.name)
    except OSError as error:  # rasterio's errors are such too
        raise VdgsError(
            f"{folder}: the maps cannot be written ({error.strerror or error}). Free some space or give another "
            "--output; maps that were there are kept."
        ) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
