"""Folders below a folder of photographs, as deep as models of them are looked for, and what they hold."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePath

from vdgs.captures.image_suffixes import IMAGE_SUFFIXES

#: So many levels deep a model is looked for: processing/2024/colmap/WORKSPACE/dense/0 with sparse in it.
DEEPEST = 6
#: Below so many levels in no more than so many folders: whoever has more has an archive, not one scene (choice).
_ALL_OF, _MOST_DEEPER = 3, 1000


def folders_below(root: Path) -> Iterator[Path]:
    """Folders below `root`, those that lie higher first, without hidden ones and those that cannot be listed."""
    level, left = [root], _MOST_DEEPER
    for depth in range(DEEPEST):
        level = [folder for above in level for folder in _folders_in(above)]
        if depth >= _ALL_OF:
            level = level[:left]
            left -= len(level)
        yield from level


def _folders_in(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            found = [each for each in entries if not each.name.startswith(".") and each.is_dir(follow_symlinks=False)]
    except OSError:
        return []
    return [Path(entry.path) for entry in sorted(found, key=lambda entry: entry.name)]


def holds_pictures_alone(folder: Path) -> bool:
    """Whether a folder has nothing but pictures in it, as most large ones; False for one that cannot be listed."""
    try:
        with os.scandir(folder) as entries:
            return all(PurePath(entry.name).suffix.lower() in IMAGE_SUFFIXES for entry in entries)
    except OSError:
        return False
