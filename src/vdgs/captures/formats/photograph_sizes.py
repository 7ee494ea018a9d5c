"""What readers of projects ask of the photographs, and say of those that cannot be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from vdgs.captures.formats.project_photographs import find_photographs
from vdgs.captures.formats.source_capture import LEAST_THERE, MAX_MISSING_LISTED, format_list
from vdgs.captures.image_files import read_header
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

GIVE_ALIGNED = "Give the photographs that were aligned (--images)."


def photograph_sizes(root: Path, options: CaptureOptions, names: Sequence[str], file: Path) -> list[tuple[int, int]]:
    """Width and height of each photograph, for files that do not tell them: those of the photographs as they were taken
    where these are there too, and not of a folder of smaller ones. A photograph that is missing is taken to be as large
    as most. Raises `CaptureError` where none is there."""
    try:
        return sizes_in_folder(root, replace(options, images=None), names, file)
    except CaptureError:
        return sizes_in_folder(root, options, names, file)


def sizes_in_folder(root: Path, options: CaptureOptions, names: Sequence[str], file: Path) -> list[tuple[int, int]]:
    """As `photograph_sizes`, of the photographs in the folder that `options` name alone."""
    found = find_photographs(root, options, [(name,) for name in names], file)
    headers = [read_header(path) if path.is_file() else None for path in found.paths]
    sizes = [(header.width, header.height) if header else None for header in headers]
    usual = Counter(size for size in sizes if size).most_common(1)[0][0]
    return [size or usual for size in sizes]


def leave_out(
    refused: Mapping[str, Sequence[str]], used: int, file: Path, remedy: str, *, strict: bool = False
) -> list[str]:
    """A warning about cameras that cannot be used, by the reasons; CaptureError where too few are left, and of any
    where a person is `strict`."""
    lost = sum(map(len, refused.values()))
    if not lost:
        return []
    reasons, count = [f"{why} ({_shown(names)})" for why, names in refused.items()], used + lost
    if strict or used < max(1, LEAST_THERE * count):
        hint = " (or leave --strict out to use the others)" if strict and used >= max(1, LEAST_THERE * count) else ""
        raise CaptureError(
            f"{file}: {lost} of its {count} cameras cannot be used. {remedy}{hint}.{format_list(reasons, len(reasons))}"
        )
    return [f"{lost} of {count} cameras cannot be used, and are left out: {'; '.join(reasons)}."]


def name_unaligned(names: Sequence[str]) -> list[str]:
    """A warning about photographs that the project has not placed."""
    return (
        [f"{len(names)} photographs of the project were not aligned, and are left out ({_shown(names)})."]
        if names
        else []
    )


def _shown(names: Sequence[str]) -> str:
    more = len(names) - MAX_MISSING_LISTED
    return ", ".join(names[:MAX_MISSING_LISTED]) + (f", ... and {more} more" if more > 0 else "")
