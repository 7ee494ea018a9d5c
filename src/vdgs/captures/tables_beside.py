"""Tables of positions, tracks and lists of control points that lie beside photographs, and that nobody has given."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from vdgs.captures.georeference import match_rows
from vdgs.captures.gps_columns import HoldsPoses, NoSystem
from vdgs.captures.gps_tables import BY_TIME, GpsRow, read_gps_table
from vdgs.captures.text_tables import read_lines
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word

#: What ODM calls its table and its list.
ODM_POSITIONS, ODM_CONTROL_POINTS = "geo.txt", "gcp_list.txt"
#: How files of surveyed points are called, and a line of a name, x, y, z and accuracies.
_POINTS_NAME = re.compile(r"(^|[^a-z])gcps?([^a-z]|$)|ground.?control|control.?points?|passpunkte", re.I)
_POINT = re.compile(r"\s*[^,;\t]+?(?:\s*[,;\t]\s*|\s+)[-+]?\d+\.?\d*(?:(?:\s*[,;\t]\s*|\s+)[-+]?\d+\.?\d*){2,4}\s*$")
#: Positions of fewer photographs are not worth a word.
_MIN_ROWS = 3
_SUFFIXES = frozenset({".txt", ".csv", ".tsv", ".mrk"})
_TRACK_SUFFIXES = frozenset({".gpx", ".kml", ".tcx", ".nmea", ".pos"}) | _SUFFIXES
#: Larger files are no tables of photographs; a folder of more of them is one for other things (choice).
_MAX_BYTES, _MAX_FILES = 5_000_000, 20


class TableBeside(NamedTuple):
    """A table, and of how many photographs it has a position."""

    file: Path
    photographs: int
    problem: str = ""
    """Why one of photographs that are there, or ODM's own, cannot be used."""


def position_tables(
    folders: Iterable[Path], names: Sequence[str], *, without_system: bool = False
) -> list[TableBeside]:
    """Tables in the folders that hold positions of the photographs of these names; those of most photographs first, and
    where asked those that do not say of which coordinate system they are, and poses."""
    found = []
    for file in _candidates(folders):
        try:
            table = read_gps_table(file)
            found.append(TableBeside(file, len(match_rows(names, table.rows, file, table.numbered))))
        except NoSystem as error:
            rows = [GpsRow(0, name, (0.0, 0.0, 0.0)) for name in error.names]
            is_told = without_system and error.are_positions and _count(names, rows, file) >= _MIN_ROWS
            if is_told or file.name.lower() == ODM_POSITIONS:
                found.append(TableBeside(file, 0, str(error)))
        except HoldsPoses as error:
            found += [TableBeside(file, 0, str(error))] if without_system else []
        except CaptureError as error:  # mostly some other text
            found += [TableBeside(file, 0, str(error))] if file.name.lower() == ODM_POSITIONS else []
    return sorted(
        (each for each in found if each.photographs >= _MIN_ROWS or each.problem), key=lambda each: -each.photographs
    )


def _count(names: Sequence[str], rows: Sequence[GpsRow], file: Path) -> int:
    """Of how many photographs rows are."""
    with suppress(CaptureError):
        return len(match_rows(names, rows, file))
    return 0


def track_notes(folders: Iterable[Path]) -> list[str]:
    """How to use tracks in the folders, which have positions by time, for photographs that have none."""
    return [
        f"positions beside the photographs, which say none, are not used: {why}" for why in tracks(folders).values()
    ]


def tracks(folders: Iterable[Path]) -> dict[Path, str]:
    """The tracks in the folders, which have positions by time, and why they are no tables of photographs."""
    found = ((file, why_track(file)) for file in _candidates(folders, _TRACK_SUFFIXES))
    return {file: why for file, why in found if why}


def why_track(file: Path) -> str:
    """Why a file is no table of photographs, if that is because it has positions by time; else empty."""
    try:
        read_gps_table(file)
    except CaptureError as error:
        return str(error) if str(error).endswith(BY_TIME) else ""
    return ""


def control_point_notes(folders: Iterable[Path]) -> list[str]:
    """How to use ODM's list of control points in one of the folders, or else what surveyed points without their marks
    (Pix4D's gcp.txt) need to be used."""
    files = _candidates(folders)
    points = next((file for file in files if file.name.lower() == ODM_CONTROL_POINTS), None)
    if points is not None:
        return [f"{points.name} beside the photographs is not used. To use it: --gcp {shell_word(points)}"]
    alone = next((file for file in files if _POINTS_NAME.search(file.stem) and _has_points_alone(file)), None)
    if alone is None:
        return []
    return [
        f"{alone.name} beside the photographs has surveyed points, and not where photographs show them; not used. To "
        "use them, mark them: --gcp takes a line that names the system, and lines `x y z px py photograph name`."
    ]


def _has_points_alone(file: Path) -> bool:
    """Whether most lines of a file are a name and three numbers or more, and no photograph."""
    with suppress(CaptureError):
        lines = [_with_points(line.text) for line in read_lines(file, "surveyed points") if line.text.strip()]
        return len(lines) > 2 and 2 * sum(bool(_POINT.match(line)) for line in lines) > len(lines)
    return False


def _with_points(line: str) -> str:
    """A line whose decimal sign is a point: where others part the columns, commas are those signs."""
    return line.replace(",", ".") if re.search(r"[;\t]", line) else line


def table_note(table: TableBeside, number: int) -> str:
    """How to use a table that nobody has given, or why it cannot be used."""
    if table.problem:
        return f"positions beside the photographs are not used: {table.problem}"
    return (
        f"{table.file.name} beside the photographs holds positions of {table.photographs} of {number}; not used. To "
        f"use it: --gps {shell_word(table.file)}"
    )


def _candidates(folders: Iterable[Path], suffixes: frozenset[str] = _SUFFIXES) -> list[Path]:
    found: dict[Path, None] = {}
    for folder in dict.fromkeys(folders):
        with suppress(OSError):
            files = [each for each in sorted(folder.iterdir()) if each.suffix.lower() in suffixes and each.is_file()]
            if len(files) <= _MAX_FILES:
                found |= dict.fromkeys(each for each in files if each.stat().st_size <= _MAX_BYTES)
    return list(found)
