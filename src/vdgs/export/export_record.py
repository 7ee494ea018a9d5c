"""RUN/export.json: which files were exported from a run, of which model and of how much of it, and what was lost."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.documents import ExportDocument, JsonObject

#: Beside the run's other results.
RECORD_FILE = "export.json"


def note_export(record: ExportDocument, folder: Path, console: Console) -> None:
    """Write the record of an export into a run folder, with the files of earlier exports that are still there: a page
    of the scene stays known when another format is written later. Files in the run stand there by their paths from it,
    as it may be moved or copied. A run that may only be read gets none, and a note says so."""
    noted, root = record.copy(), folder.resolve()
    noted["files"] = [{**each, "file": _shortened(each["file"], root)} for each in record["files"]]
    noted["losses"] = [
        {**each, "file": _shortened(file, root) if isinstance(file := each["file"], str) else None}
        for each in record["losses"]
    ]
    before = read_json_or_empty(folder / RECORD_FILE)
    written = {os.path.realpath(each["file"]) for each in record["files"]}
    kept = [each for each in _of_files(before, "files") if _is_kept(root / each["file"], written)]
    names = {each["file"] for each in kept}
    noted["files"] += kept  # type: ignore[arg-type]  # as they were written
    noted["losses"] += [each for each in _of_files(before, "losses") if each["file"] in names]
    try:
        write_json(folder / RECORD_FILE, noted)
    except VdgsError:
        file = escape(str(folder / RECORD_FILE))
        console.print(f"[yellow]note[/] {file} cannot be written: the report will not know of these files")


def _shortened(file: str, root: Path) -> str:
    """The path of a file from the run where it lies in it."""
    path = Path(file)
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else file


def _of_files(record: dict[str, Any], key: str) -> Iterator[JsonObject]:
    """The objects of a list in an earlier record that are of a file; what else a damaged one holds is left out."""
    listed = record.get(key)
    for each in listed if isinstance(listed, list) else []:
        if isinstance(each, dict) and isinstance(each.get("file"), str):
            yield each


def _is_kept(file: Path, written: set[str]) -> bool:
    """Whether a file of an earlier export is still there; not where this one wrote it again (real paths)."""
    return os.path.isfile(file) and os.path.realpath(file) not in written
