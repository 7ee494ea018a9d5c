"""Files and folders that the system does not let be read: which one is in the way, and what opens it."""

from __future__ import annotations

import os
from pathlib import Path

from vdgs.system.quoting import shell_word


def barred_by(path: Path) -> Path:
    """What keeps this process from a file or folder: the first folder on the way that it may not enter, else itself."""
    return next((each for each in reversed(path.parents) if each.is_dir() and not os.access(each, os.X_OK)), path)


def refusal(path: Path, error: OSError) -> str:
    """What to say, behind its name, of a file or folder that the system does not let be read, which says nothing of
    what it holds: for want of a permission, or of a disk."""
    remedy = f"Allow it: {how_to_allow(path)}" if isinstance(error, PermissionError) else "See to its disk"
    return f"cannot be read ({error.strerror or error}). {remedy}"


def how_to_allow(path: Path) -> str:
    """The command that lets everybody read a file or folder which the system refuses."""
    barred = barred_by(path)
    return f"chmod {'+rx' if barred.is_dir() else '+r'} {shell_word(barred)}"
