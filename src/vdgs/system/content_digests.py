"""What tells the content of a file from any other: files that are copied, moved or touched stay what they were."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.stop_signals import check_stop_requested

#: Files that are read at the same time: the digest of one is computed while the disk serves others.
_READERS = 4
#: Bytes that are read at once; between two such parts a stop is heard.
_PART_BYTES = 1 << 22
#: Bytes at each end of a file that tell it from most others of its length.
END_BYTES = 4096
#: What a digest is kept with: size and time of the file, by which a file is known that did not change.
_Known = list[int | str]


@dataclass
class ContentDigests:
    """The digests of files, kept in a JSON file: a file is read again only where its size or time is another."""

    record: Path
    _known: dict[str, _Known] = field(default_factory=dict)
    _is_new: bool = False

    @staticmethod
    def read(record: Path) -> ContentDigests:
        """Those of a record; none where there is no such file."""
        found = read_json_or_empty(record).items()
        known = {name: each for name, each in found if isinstance(each, list) and len(each) == 3}
        return ContentDigests(record, known)

    def files(self) -> dict[Path, str]:
        """The files that have been read, there or not, with their digests."""
        return {Path(name): str(known[2]) for name, known in self._known.items()}

    def of(self, path: Path) -> str:
        """The digest of a file; empty for one that cannot be read."""
        check_stop_requested()
        try:
            name, status = str(path.resolve()), path.stat()
            stamp = [status.st_size, status.st_mtime_ns]
            known = self._known.get(name)
            if known is None or known[:2] != stamp:
                known = [*stamp, file_digest(path)]
                self._known[name], self._is_new = known, True
            return str(known[2])
        except OSError:
            return ""

    def of_all(self, paths: Iterable[Path]) -> dict[Path, str]:
        """The digest of each file."""
        files = list(dict.fromkeys(paths))
        with ThreadPoolExecutor(_READERS) as pool:
            return dict(zip(files, pool.map(self.of, files), strict=True))

    def write(self) -> None:
        """Write what was not known before. Raises VdgsError where the disk refuses."""
        if self._is_new:
            write_json(self.record, self._known)
            self._is_new = False


def find_copies(files: Sequence[Path]) -> list[list[int]]:
    """The numbers of files that are the same byte for byte, each with its copies. Whole files are read only where
    length and both ends agree. Raises OSError where one cannot be read, and what asked to stop."""
    groups = [list(range(len(files)))]
    for part in (lambda path: path.stat().st_size, _ends, file_digest):
        alike: dict[tuple[int, object], list[int]] = defaultdict(list)
        for number, group in enumerate(groups):
            for index in group:
                alike[number, part(files[index])].append(index)
        groups = [group for group in alike.values() if len(group) > 1]
    return groups


def _ends(path: Path) -> bytes:
    """The first and the last bytes of a file."""
    with path.open("rb") as file:
        first = file.read(END_BYTES)
        file.seek(max(path.stat().st_size - END_BYTES, 0))
        return first + file.read()


def file_digest(path: Path) -> str:
    """The digest of the content of a file. Raises OSError where it cannot be read, and what asked to stop."""
    digest = blake2b(digest_size=16)
    with path.open("rb") as file:
        while part := file.read(_PART_BYTES):
            check_stop_requested()
            digest.update(part)
    return digest.hexdigest()
