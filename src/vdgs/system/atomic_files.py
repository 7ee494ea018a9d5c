"""Files that are either whole or absent: written under a temporary name, synced, then renamed."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import platform
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from safetensors import SafetensorError

from vdgs.errors import VdgsError

if TYPE_CHECKING:
    import numpy as np
    from PIL import Image

#: Free bytes of a full disk.
FULL_DISK_BYTES = 1 << 20


#: How the names of temporary files end (regular expression).
TEMPORARY_ENDING = r"\.[0-9a-f]{6}-[0-9]+\.tmp"


def process_mark() -> str:
    """What the names of temporary files carry of the process that writes them: a mark of its machine, and its number
    there."""
    return f"{host_mark()}-{os.getpid()}"


def host_mark() -> str:
    """A mark of this machine, and of the container on it whose processes are counted by themselves."""
    counted = platform.node()
    with suppress(OSError):  # Linux alone has it
        counted += os.readlink("/proc/self/ns/pid")
    return hashlib.sha256(counted.encode()).hexdigest()[:6]


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it over `path`. Raises VdgsError, with file and
    remedy, when the disk refuses (full, read-only, ...); `path` is then untouched."""
    temporary = path.with_name(f".{path.name}.{process_mark()}.tmp")
    try:
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(temporary)
            with temporary.open("rb") as handle:
                os.fsync(handle.fileno())
            os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def write_values(file: IO[bytes], values: np.ndarray) -> None:
    """Write the bytes of an array to a buffered file. Raises OSError where the disk has no room for all of them;
    `ndarray.tofile` loses the last block without a word."""
    contiguous = values if values.flags.c_contiguous else values.copy(order="C")
    file.write(contiguous.reshape(-1).view("u1").data)


@contextmanager
def explain_disk_errors(path: Path) -> Iterator[None]:
    """A context that writes to a file or folder: what the disk refuses becomes a VdgsError with name and remedy."""
    try:
        yield
    except (OSError, SafetensorError) as error:  # safetensors hides the system's error in one of its own
        why = reason_of(error, path.parent)
        raise VdgsError(
            f"{path}: cannot be written ({getattr(why, 'strerror', None) or why}). {disk_hint(why)}, then run the same "
            "command again: what was finished is kept."
        ) from error


def reason_of(error: BaseException, folder: Path) -> BaseException:
    """Why a folder could not be written to: libraries with files of their own hide that the disk is full."""
    hidden = getattr(error, "errno", None) is None and is_disk_full(folder)
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if hidden else error


def disk_hint(error: BaseException) -> str:
    """What to do about a file or folder that cannot be written: the beginning of a sentence."""
    number = getattr(error, "errno", None)
    if number is None and (match := re.search(r"os error (\d+)", str(error))):  # of safetensors
        number = int(match[1])
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "Allow writing there (chmod u+w, or another mount) or choose another folder"
    if number in (errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENOTEMPTY, errno.ELOOP):
        return "Move away what stands there under this name, or choose another"
    if number == errno.ENAMETOOLONG:
        return "Choose a shorter name"
    if number in (errno.ENOSPC, errno.EDQUOT):
        return "Free some space or choose another folder"
    return "Free some space, see that the folder can be written, or choose another"


def is_disk_full(folder: Path) -> bool:
    """Whether so little room is left that a failure without a reason is put down to it."""
    with suppress(OSError):
        return shutil.disk_usage(folder).free < FULL_DISK_BYTES
    return False


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    write_atomic(path, lambda temporary: temporary.write_bytes(content))


def write_array(path: Path, values: np.ndarray) -> None:
    """Write a numpy array of any shape (.npy) atomically. Raises ValueError for Python objects, which it cannot hold.

    `numpy.save` writes by `ndarray.tofile`, which loses the last block without a word: see `write_values`.
    """
    import numpy as np  # when there is one to write: files of text do without

    if values.dtype.hasobject:
        raise ValueError("Python objects are not written to .npy files")
    ordered = np.asarray(values, order="C")

    def write(temporary: Path) -> None:
        with temporary.open("wb") as handle:
            np.lib.format.write_array_header_1_0(handle, np.lib.format.header_data_from_array_1_0(ordered))
            write_values(handle, ordered)

    write_atomic(path, write)


def write_image(path: Path, image: Image.Image, kind: str, **options: Any) -> None:
    """Write an image of Pillow atomically in the format `kind`, with Pillow's options for it. It is encoded in memory:
    where Pillow itself writes a JPEG or TIFF file, it loses the end that a full disk refuses without a word."""
    encoded = io.BytesIO()
    image.save(encoded, kind, **options)
    write_bytes(path, encoded.getvalue())


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) atomically. Bytes of file names that are no text are escaped, as JSON does it."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically. ValueError for NaN and infinity, since JSON has no such numbers: see `to_jsonable`."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def to_jsonable(value: Any) -> Any:
    """The value with numpy scalars as Python numbers, and NaN or infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_jsonable(each) for each in value]
    if hasattr(value, "item"):  # of numpy, which files of text do without
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json_or_empty(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty if the file is missing or damaged (the stage then runs again)."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def read_json(path: Path) -> Any:
    """Read JSON; VdgsError names the file if it is missing or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise VdgsError(f"{path}: is damaged, not valid JSON ({error}). Delete it and run again.") from error
