"""Names of files and other strings inside the languages of other programs: one function for each language."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

from vdgs.errors import VdgsError

#: What `sbatch` takes as it stands, and words that it blanks wherever a line holds them.
_PLAIN_SBATCH = re.compile(r"[\w@%+=:,./-]+", re.ASCII)
_BLANKED_BY_SBATCH = re.compile(r"(het|pack)(job)", re.IGNORECASE)


def shell_word(text: str | Path) -> str:
    """One word for a POSIX shell, also for lines that people copy; a path is none of a command's options, and
    in no home folder."""
    word = f"./{text}" if isinstance(text, Path) and str(text).startswith(("-", "~")) else str(text)
    return shlex.quote(word)


def shell_line(words: Iterable[str | Path]) -> str:
    """A command for a POSIX shell."""
    return " ".join(map(shell_word, words))


def check_is_text(path: Path) -> None:
    """Raise VdgsError for a file or folder whose name, with those of the folders around it, holds bytes that are no
    text: libraries for images, films and maps cannot open it."""
    try:
        os.path.abspath(path).encode()
    except UnicodeEncodeError:
        encoding = sys.getfilesystemencoding()
        raise VdgsError(
            f"{path}: the name, or that of a folder around it, is no text in {encoding}, so libraries cannot open it. "
            + ("Rename it." if encoding == "utf-8" else "Set the environment variable PYTHONUTF8=1, or rename it.")
        ) from None


def sbatch_directive(option: str) -> str:
    """A line `#SBATCH --name=value` of a batch script.

    sbatch expands nothing, but splits words at blanks, takes quotes and backslashes away (these also inside quotes) and
    ends a line at `#`. Raises VdgsError for what no line can hold.
    """
    if re.search(r"[\n\r\0]", option):
        raise VdgsError(f"{option!r}: SLURM's scripts cannot hold a line break. Choose another name.")
    if not _PLAIN_SBATCH.fullmatch(option) or _BLANKED_BY_SBATCH.search(option):
        escaped = re.sub(r'(["\\])', r"\\\1", option)
        option = '"' + _BLANKED_BY_SBATCH.sub(r"\1\\\2", escaped) + '"'
    return f"#SBATCH {option}"


def slurm_file_pattern(folder: Path, pattern: str) -> str:
    """A file for `--output` whose name has SLURM's symbols (`%a`), in a folder whose name has none.

    Raises VdgsError for a folder with a backslash, which turns off all symbols of a name.
    """
    if "\\" in str(folder):
        raise VdgsError(f"{folder}: SLURM cannot write into a folder with a backslash in its name. Rename it.")
    return str(folder).replace("%", "%%") + f"/{pattern}"


def header_line(text: str) -> str:
    """Text as one line of a header in ASCII (PLY), as inside a JSON string."""
    return json.dumps(" ".join(text.split()))[1:-1]


def wkt_string(text: str) -> str:
    """A name in well-known text, which has no line breaks and whose readers disagree on quotes inside."""
    return '"' + " ".join(text.replace('"', "'").split()) + '"'
