"""Packages of an installation that are missing or broken: which, by the error that they raise, and what to type."""

from __future__ import annotations

import re
import sys
from traceback import walk_tb

from vdgs.system.memory.memory_errors import barred_library, is_out_of_memory

#: What packages are called where they are installed from, if not as they are imported.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "sklearn": "scikit-learn", "yaml": "pyyaml"}
#: What torch says where it was built for another numpy; packages that were built so say it in a ValueError.
_OTHER_NUMPY = re.compile(r"numpy is not available", re.IGNORECASE)
#: What is said of libraries too many for one process, and of a backend that the environment names.
_OF_THE_PROCESS = re.compile(r"cannot allocate memory in static TLS|is not a valid value for backend", re.IGNORECASE)
#: Where numpy hides what went wrong in a page of advice.
_ORIGINAL = re.compile(r"original error was: *(.+)", re.IGNORECASE)


def broken_packages(error: BaseException) -> tuple[str, ...]:
    """The packages beside vdgs that could not be imported where this was raised, the one that vdgs asked for first;
    none where it has another reason."""
    if isinstance(error, RuntimeError) and _OTHER_NUMPY.search(str(error)):
        return "torch", "numpy"
    if is_out_of_memory(error) or (isinstance(error, OSError) and error.errno is not None):
        return ()  # the machine's fault; ctypes finds libraries missing without a number
    if _OF_THE_PROCESS.search(str(error)):
        return ()
    found: list[str] = []
    for frame, _ in walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package == "vdgs":
            found.clear()  # what follows is what this called or imported
        elif frame.f_code.co_name == "<module>":
            found.append(package)
    if not found and isinstance(error, ImportError) and error.name:
        found = [error.name.partition(".")[0]]
    return tuple(dict.fromkeys(each for each in found if each not in ("vdgs", "__main__")))


def import_reason(error: BaseException) -> str:
    """Why a package could not be imported, in a line."""
    text = str(error).strip()
    original = _ORIGINAL.search(text)
    return original[1] if original else next(iter(text.splitlines()), "") or type(error).__name__


def explain_broken_packages(error: BaseException) -> str:
    """What is broken and what to do, for people; empty where no package is."""
    packages = broken_packages(error)
    if not packages:
        return ""
    if all(each in sys.stdlib_module_names for each in packages):
        remedy = "This Python lacks a part of itself: install a whole one."
    elif barred := barred_library(error):
        remedy = f"No program may run where {barred} lies (noexec): install vdgs in another file system."
    else:
        remedy = f"{reinstall_command(packages)} mends it; `vdgs doctor` tests all packages."
    return f"{packages[0]} cannot be used ({import_reason(error)}). {remedy}"


def reinstall_command(packages: tuple[str, ...]) -> str:
    """What to type to have these packages whole."""
    named = [_DISTRIBUTIONS.get(each, each) for each in packages if each not in sys.stdlib_module_names]
    return f"pip install --force-reinstall {' '.join(named)}"
