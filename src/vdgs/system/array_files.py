"""Files of several numpy arrays (.npz without pickle), such as the parts of a stage that shards leave to be joined."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from vdgs.errors import RunError
from vdgs.system.atomic_files import write_bytes

#: What zipfile and numpy raise on damaged bytes, and readers on arrays that are not theirs, has no common base.
DAMAGED_FILE_ERRORS = (
    OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, NotImplementedError,
    RuntimeError, SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by their names (the same bytes for the same content), atomically."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The inverse of `save_arrays`. Raises one of `DAMAGED_FILE_ERRORS` if the file is missing or damaged."""
    with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@contextmanager
def explain_damaged_part(path: Path) -> Iterator[None]:
    """RunError for what reading a part of a stage raises that is missing or damaged: the same command makes it anew."""
    try:
        yield
    except DAMAGED_FILE_ERRORS as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error
