"""How a process of vdgs ends: its exit code, and what it prints of an error that a person can mend."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vdgs.system.broken_packages import explain_broken_packages, import_reason
from vdgs.system.memory.memory_errors import is_library_out_of_memory, is_out_of_memory

#: Required packages that an installation may leave out (`docs/third-party.md`), and what then does not work.
REMOVABLE_PACKAGES = {
    "pycolmap": "photographs cannot become a capture, lenses cannot be undistorted, and vdgs synth cannot write its "
    "model. Run pip install pycolmap, or bring a capture of undistorted photographs, which works without it."
}


def exit_code_of(name: str, action: Callable[[], Any], when_interrupted: str, fit: Callable[[str], str] = str) -> int:
    """Run an action: 0 (or its result) when done, 1 after a printed error, 130 when stopped. `name` begins the message,
    which `fit` may change. Errors that a user cannot cause are raised."""
    from vdgs.errors import Interrupted, Stopped, VdgsError
    from vdgs.system.stop_signals import catch_stop_signals

    _open_streams()
    try:
        os.getcwd()
    except FileNotFoundError:
        print(f"{name}: the current folder does not exist any more. Go to another one (cd).", file=sys.stderr)
        return 1
    try:
        with catch_stop_signals(interrupts=True), _printed():
            return int(action() or 0)
    except (KeyboardInterrupt, Interrupted):
        print(f"{name}: interrupted. {when_interrupted}", file=sys.stderr)
        return 130
    except VdgsError as error:
        print(f"{name}: {_fitted(str(error), fit)}", file=sys.stderr)
        return 130 if isinstance(error, Stopped) else 1
    except BrokenPipeError:
        _forget_output()
        return 1
    except Exception as error:
        if not (what := _explain(error)):
            raise
        print(_fitted(f"{name}: {what}", fit), file=sys.stderr)
        return 1


def _fitted(text: str, fit: Callable[[str], str]) -> str:
    """A message as `fit` changes it; as it is where that fails, for memory may be short here too."""
    try:
        return fit(text)
    except Exception:
        return text


def _explain(error: Exception) -> str:
    """What an error of the machine or of the installation means, in words; empty for faults of the program."""
    if isinstance(error, ModuleNotFoundError) and error.name in REMOVABLE_PACKAGES:
        return f"{error.name} is not installed: {REMOVABLE_PACKAGES[error.name]}"
    if isinstance(error, MemoryError | RuntimeError | ImportError | OSError) and is_out_of_memory(error):
        return _explain_out_of_memory(error)
    if broken := explain_broken_packages(error):
        return broken
    if isinstance(error, OSError):  # a disk that is full, a folder that cannot be written: no news from a traceback
        if not error.filename:
            _forget_output()
        what = error.filename or "a file, or what is printed"
        if isinstance(error, PermissionError) and isinstance(what, str):
            from vdgs.system.permissions import barred_by

            what = barred_by(Path(what))  # else perhaps a file of which nobody knows whether it is there
        return f"{what}: {error.strerror or error}{_remedy(error)}"
    return ""


def _explain_out_of_memory(error: Exception) -> str:
    reason = import_reason(error) if str(error) else "no room"
    if is_library_out_of_memory(error):
        remedy = "Even loading the program needs more: raise the limit (ulimit -v), or end other programs."
    else:
        remedy = "Smaller photographs (--downscale 2) or fewer --jobs need less."
    return f"out of memory ({reason}). What was saved is kept. {remedy}"


@contextmanager
def _printed() -> Iterator[None]:
    """A context whose output is with its reader in the end: that it cannot be is known before the process ends."""
    try:
        yield
    finally:
        if sys.stdout is not None:
            sys.stdout.flush()


def _forget_output() -> None:
    """Send what was not printed nowhere, lest Python tries it once more, with a traceback, when it ends."""
    with suppress(OSError, ValueError, AttributeError):  # no stream of a process
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_streams() -> None:
    """Make standard streams such that every text can be printed, and no other file is taken for one of them.

    Where one is closed (`2>&-`) the next file that is opened would get its number, and what libraries print. Characters
    that its encoding lacks, and bytes of file names that are no text, are escaped.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _remedy(error: OSError) -> str:
    """What to do about a file that the system refuses, where that is plain."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return ". See whose it is and who may use it (ls -l, chmod), or choose another."
    if error.errno in (errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ELOOP):
        from vdgs.system.atomic_files import disk_hint

        return f". {disk_hint(error)}."
    return ""
