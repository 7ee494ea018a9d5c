"""Errors that a person can act on.

Every error that vdgs raises on purpose is a `VdgsError`; the command line prints its message alone,
without a traceback. A message names the file, says what is wrong and what to do.
"""

from __future__ import annotations


class VdgsError(Exception):
    """Something that the user can mend. The message is all they see."""


class CaptureError(VdgsError):
    """The capture on disk cannot be used as it is."""


class RunError(VdgsError):
    """The run folder cannot be used or continued as it is."""


class TrainingDiverged(VdgsError):
    """The loss or a parameter is no longer a finite number; the last good checkpoint is kept."""


class Stopped(VdgsError):
    """Work was asked to stop; what it had done is saved."""


class Interrupted(Stopped):
    """Work was asked to stop between two steps of it: nothing had to be saved."""


class UnsupportedOption(VdgsError, NotImplementedError):
    """A function of the Python API was asked for what it does not have; the message says what to do instead."""


def check_kind(name: str, value: object, *kinds: type, remedy: str = "") -> None:
    """Raise TypeError, which names the argument of a function of the API, unless `value` is of one of the kinds."""
    if not isinstance(value, kinds):
        known = " or ".join(f"{each.__module__.partition('.')[0]}.{each.__name__}" for each in kinds)
        raise TypeError(f"{name} must be {known}, not {type(value).__name__}{remedy and ': ' + remedy}")
