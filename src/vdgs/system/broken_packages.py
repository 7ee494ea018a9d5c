"""Packages of an installation that are missing, broken or hidden by a file of their name: which, by the error that they
raise, and what to do."""

from __future__ import annotations

import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from traceback import walk_tb
from types import ModuleType

from vdgs.system.memory.memory_errors import barred_library, is_out_of_memory

#: What packages are called where they are installed from, if not as they are imported.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "sklearn": "scikit-learn", "yaml": "pyyaml"}
#: What torch says where it was built for another numpy; packages that were built so say it in a ValueError.
_OTHER_NUMPY = re.compile(r"numpy is not available", re.IGNORECASE)
#: What folders are called into which packages are installed.
_INSTALLED = ("site-packages", "dist-packages")
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
    if shadow := explain_shadows((*packages, *_modules_in_error(error))):
        return f"{shadow} ({import_reason(error)})"
    if not packages:
        return ""
    if all(each in sys.stdlib_module_names for each in packages):
        remedy = "This Python lacks a part of itself: install a whole one."
    elif barred := barred_library(error):
        remedy = f"No program may run where {barred} lies (noexec): install vdgs in another file system."
    else:
        remedy = f"{reinstall_command(packages)} mends it; `vdgs doctor` tests all packages."
    return f"{packages[0]} cannot be used ({import_reason(error)}). {remedy}"


def explain_shadows(packages: Iterable[str]) -> str:
    """Which file Python takes for the first of these packages that is hidden, and what to do; empty where none is."""
    for name in dict.fromkeys(packages):
        if (file := shadowing_file(name)) is not None:
            here, on_path = file.parent == Path.cwd(), str(file.parent) in _python_path()
            other = " or start vdgs in another folder" if here else ""
            other += " or take its folder out of PYTHONPATH" if on_path else ""
            return f"{file} is taken for the package {name} and hides it: rename it{other}"
    return ""


def shadowing_file(name: str) -> Path | None:
    """The file or folder that Python imports by the name of a package though an installed one, or one of Python's own,
    lies behind it on the path; None where none does."""
    places = [Path(entry or os.curdir).absolute() for entry in sys.path]
    for index, place in enumerate(places):
        if (first := _origin(name, [place])) is None:
            continue
        behind = _origin(name, [each for each in places[index + 1 :] if each != place])
        if behind is None or behind == first or _is_installed(place):
            return None
        return first.parent if first.name == "__init__.py" else first
    return None


def _origin(name: str, places: Iterable[Path]) -> Path | None:
    """The file that is imported by a name from these folders."""
    spec = PathFinder.find_spec(name, [str(place) for place in places])
    return None if spec is None or spec.origin is None else Path(spec.origin)


def _is_installed(place: Path) -> bool:
    """Whether a folder of the path is one of packages that were installed, or of Python's own modules."""
    own = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"))
    return place.name in _INSTALLED or any(place.is_relative_to(folder) for folder in own)


def _python_path() -> list[str]:
    return [os.path.abspath(entry) for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]


def _modules_in_error(error: BaseException | None) -> Iterator[str]:
    """The top-level modules that lack what was asked of them, by an error and those that led to it."""
    while error is not None:
        if isinstance(error, ImportError) and error.name:
            yield error.name.partition(".")[0]
        elif isinstance(error, AttributeError) and isinstance(error.obj, ModuleType):
            yield error.obj.__name__.partition(".")[0]
        error = error.__cause__ or error.__context__


def reinstall_command(packages: tuple[str, ...]) -> str:
    """What to type to have these packages whole."""
    named = [_DISTRIBUTIONS.get(each, each) for each in packages if each not in sys.stdlib_module_names]
    return f"pip install --force-reinstall {' '.join(named)}"


def imported_name(distribution: str) -> str:
    """What a package is imported as."""
    names = {installed: name for name, installed in _DISTRIBUTIONS.items()}
    return names.get(distribution.lower(), distribution)
