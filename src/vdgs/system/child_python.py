"""The command of another Python process, which imports what this one would and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress


def python_command(module: str, *arguments: object) -> list[str]:
    """The command that runs a module with this interpreter and its options (-O, -W, -X, ...).

    `-m` alone would import from the current folder first: of a person who typed `vdgs` there, whose files may be called
    random.py or torch. `-P` leaves that folder out, unless this process imports from it too, as one that was begun by
    `python -m vdgs` in a checkout does. What PYTHONPATH or the installation names is found either way.
    """
    options: list[str] = subprocess._args_from_interpreter_flags()  # type: ignore[attr-defined]  # multiprocessing's
    if not {"-P", "-I"} & {*options} and not _imports_from_current_folder():
        options = [*options, "-P"]
    return [sys.executable, *options, "-m", module, *map(str, arguments)]


def _imports_from_current_folder() -> bool:
    here = {""}  # as in `python -c`
    with suppress(FileNotFoundError):  # a folder that was removed meanwhile
        here.add(os.getcwd())
    return not here.isdisjoint(sys.path)
