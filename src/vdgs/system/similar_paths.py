"""What a path that does not exist may have been meant to be."""

from __future__ import annotations

import difflib
from pathlib import Path


def suggest_path(path: Path) -> str:
    """`; did you mean DCIM?` where a file or folder beside the first part of the path that is missing is like it."""
    missing = next((each for each in reversed([path, *path.parents]) if not each.exists()), path)
    try:
        names = {each.name.lower(): each.name for each in missing.parent.iterdir()}
    except OSError:
        return ""
    like = difflib.get_close_matches(missing.name.lower(), list(names), n=1)
    if not like:
        return ""
    meant = missing.parent / names[like[0]] / path.relative_to(missing)
    return f"; did you mean {meant if meant.exists() else missing.parent / names[like[0]]}?"
