"""Files that lie in a folder beside the file that names them, such as tiles and their tileset.

The folder has a number that nothing there has yet. Its files are written first, then, atomically, the file that names
them; what an earlier one named goes last. Nothing else in the folder beside is touched.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import explain_disk_errors, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.scratch import leftovers, remove_leftovers, scratch_folder

#: The file of a scratch folder that names the folder which is being filled.
_WRITES = "folder"


@dataclass(frozen=True)
class FileFolder:
    """One kind of them."""

    #: Folders are called so, with a number.
    prefix: str
    #: The files within the folder, finished and not, by their paths from it.
    pattern: re.Pattern[str]
    #: The files that the file at a path names, by their paths from its folder, where we wrote it; anything may be
    #: raised where it is another or damaged.
    named: Callable[[Path], list[str]]

    def write(self, path: Path, fill: Callable[[Path, Path], JsonObject]) -> None:
        """Let `fill` write files into the new folder and return the document that names them; it is given the folder
        and one for what waits meanwhile. Raises VdgsError."""
        older = self.files(path)
        taken = [int(each.name[len(self.prefix) + 1 :]) for each in path.parent.glob(f"{self.prefix}-*")
                 if each.name[len(self.prefix) + 1 :].isdecimal()]  # fmt: skip
        folder = path.parent / f"{self.prefix}-{1 + max(taken, default=0)}"
        try:
            with explain_disk_errors(path), scratch_folder(path) as scratch:
                (scratch / _WRITES).write_text(folder.name)
                document = fill(folder, scratch)
            write_json(path, document)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        _remove(older, path.parent)

    def files(self, path: Path) -> list[Path]:
        """The files that the one at `path` names, where it is ours; else none.

        Any other, a damaged one, and what is named otherwise than our own files is not for us to touch.
        """
        try:
            names = sorted({str(name) for name in self.named(path)})
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return []
        return [path.parent / name for name in names if self._is_ours(name)]

    def _is_ours(self, name: str) -> bool:
        folder, _, rest = name.partition("/")
        number = folder.removeprefix(f"{self.prefix}-")
        return number != folder and number.isdecimal() and self.pattern.fullmatch(rest) is not None

    def remove_killed(self, path: Path) -> list[Path]:
        """Remove what killed exports of `path` left: scratch folders, and the files that they had begun. Returns what
        was there. Raises nothing for what cannot be removed."""
        named, begun = set(self.files(path)), list[Path]()
        for each in leftovers(path):
            with suppress(OSError, UnicodeDecodeError):
                name = (each / _WRITES).read_text()
                begun += [file for file in sorted(path.parent.joinpath(name).rglob("*"))
                          if self._is_ours(file.relative_to(path.parent).as_posix()) and file not in named]  # fmt: skip
        _remove(begun, path.parent)
        return [
            *remove_leftovers(path),
            *sorted({path.parent / each.relative_to(path.parent).parts[0] for each in begun}),
        ]


def check_no_folder(path: Path, what: str) -> None:
    """Raise VdgsError where a folder stands in place of the file that names the others."""
    if path.is_dir():
        raise VdgsError(f"{path}: is a folder. {what} are written as FOLDER/{path.name}.")


def _remove(files: list[Path], top: Path) -> None:
    """Remove files and the folders below `top` that are empty then. What people have put beside them stays."""
    for each in files:
        with suppress(OSError):
            each.unlink()
    folders = {folder for each in files for folder in each.parents if top in folder.parents}
    for folder in sorted(folders, key=lambda each: -len(each.parts)):
        with suppress(OSError):
            folder.rmdir()
