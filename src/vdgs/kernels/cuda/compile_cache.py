"""A disk cache of compiled code.

An entry is written atomically, carries the digest of its code, and is named by a digest of sources, headers, options,
compiler and target. A damaged entry is compiled again.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import write_bytes

#: Overrides the folder of compiled code.
CUDA_CACHE_ENV_VAR = "VDGS_CUDA_CACHE"
MAGIC = b"vdgs code 1\n"


def cache_folder() -> Path:
    """Where compiled code is kept: $VDGS_CUDA_CACHE, or the platform's folder for caches."""
    if named := os.environ.get(CUDA_CACHE_ENV_VAR):
        return Path(named)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "vdgs" / "cuda"


def digest_parts(parts: Mapping[str, str]) -> str:
    """A digest of named texts: of the names, of the texts and of where one ends and the next begins."""
    digest = hashlib.sha256()
    for part in (part.encode() for pair in sorted(parts.items()) for part in pair):
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.hexdigest()


def load_or_compile(name: str, parts: Mapping[str, str], make: Callable[[], bytes]) -> bytes:
    """The code made from these parts, from the cache or by `make`. `name` begins the file's name. A folder that cannot
    be read or written is ignored."""
    path = cache_folder() / f"{name}-{digest_parts(parts)[:40]}.bin"
    if (code := _read(path)) is not None:
        return code
    code = make()
    with suppress(VdgsError):
        write_bytes(path, MAGIC + hashlib.sha256(code).digest() + code)
    return code


def _read(path: Path) -> bytes | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    head, digest, code = content[: len(MAGIC)], content[len(MAGIC) : len(MAGIC) + 32], content[len(MAGIC) + 32 :]
    return code if head == MAGIC and digest == hashlib.sha256(code).digest() else None
