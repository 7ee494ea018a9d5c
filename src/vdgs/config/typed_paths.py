"""Paths as people type them, in options, in files of settings and in Python: what begins with ~ lies in a home folder.

Shells say so of words that begin with it, but not of `--output=~/run` nor of words in quotes. What really begins with ~
is written as ./~name; a name that is no user's stays as it is, as in shells.
"""

from __future__ import annotations

import os
import typing
from pathlib import Path
from typing import Any


class MaybeFolder:
    """Marks an option of text that may name a folder by its path: `images: Annotated[str | None, MaybeFolder()]`."""


def holds_path(hint: Any) -> bool:
    """Whether a field's type is a path or marked as one, at any depth."""
    return hint is Path or isinstance(hint, MaybeFolder) or any(map(holds_path, typing.get_args(hint)))


def home_path(path: str | Path) -> Path:
    """A path with the whole path of a home folder that it begins with."""
    return Path(os.path.expanduser(path))


def expand_home(word: str, hint: Any) -> str:
    """A word for a field of this type, with the whole path of a home folder that it begins with."""
    return os.path.expanduser(word) if holds_path(hint) else word
