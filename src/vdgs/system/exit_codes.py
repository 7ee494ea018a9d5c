"""How a process of vdgs ends: its exit code, and what it prints of an error that a person can mend."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from typing import Any

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

    try:
        with catch_stop_signals(interrupts=True):
            return int(action() or 0)
    except (KeyboardInterrupt, Interrupted):
        print(f"{name}: interrupted. {when_interrupted}", file=sys.stderr)
        return 130
    except VdgsError as error:
        print(f"{name}: {fit(str(error))}", file=sys.stderr)
        return 130 if isinstance(error, Stopped) else 1
    except BrokenPipeError:
        return 1
    except ModuleNotFoundError as error:
        if error.name not in REMOVABLE_PACKAGES:
            raise
        print(f"{name}: {error.name} is not installed: {REMOVABLE_PACKAGES[error.name]}", file=sys.stderr)
        return 1
    except OSError as error:  # a disk that is full, a folder that cannot be written: no news from a traceback
        print(f"{name}: {error.filename or 'a file'}: {error.strerror or error}{_remedy(error)}", file=sys.stderr)
        return 1
    except (MemoryError, RuntimeError) as error:
        from vdgs.system.memory.process_memory import is_out_of_memory

        if not is_out_of_memory(error):
            raise
        reason = str(error).strip().splitlines()[0] if str(error) else "no room"
        remedy = "Smaller photographs (--downscale 2) or fewer --jobs need less."
        print(fit(f"{name}: out of memory ({reason}). What was saved is kept. {remedy}"), file=sys.stderr)
        return 1


def _remedy(error: OSError) -> str:
    """What to do about a file that the system refuses, where that is plain."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return ". See whose it is and who may use it (ls -l, chmod), or choose another."
    if error.errno in (errno.EROFS, errno.ENOSPC, errno.EDQUOT):
        from vdgs.system.atomic_files import disk_hint

        return f". {disk_hint(error)}."
    return ""
