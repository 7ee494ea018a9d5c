"""What tells the content of a file from any other: files that are copied, moved or touched stay what they were."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import blake2b, file_digest
from pathlib import Path

from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.stop_signals import check_stop_requested

#: Files that are read at the same time: the digest of one is computed while the disk serves others.
_READERS = 4
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
        return ContentDigests(record, {
            name: known for name, known in read_json_or_empty(record).items() if isinstance(known, list)
        })  # fmt: skip

    def of(self, path: Path) -> str:
        """The digest of a file; empty for one that cannot be read."""
        check_stop_requested()
        try:
            name, status = str(path.resolve()), path.stat()
            stamp = [status.st_size, status.st_mtime_ns]
            known = self._known.get(name)
            if known is None or known[:2] != stamp:
                with path.open("rb") as file:
                    known = [*stamp, file_digest(file, lambda: blake2b(digest_size=16)).hexdigest()]
                self._known[name], self._is_new = known, True
            return str(known[2])
        except OSError:
            return ""

    def of_all(self, paths: Iterable[Path]) -> dict[Path, str]:
        """The digest of each file."""
        files = list(paths)
        with ThreadPoolExecutor(_READERS) as pool:
            return dict(zip(files, pool.map(self.of, files), strict=True))

    def write(self) -> None:
        """Write what was not known before. Raises VdgsError where the disk refuses."""
        if self._is_new:
            write_json(self.record, self._known)
            self._is_new = False
