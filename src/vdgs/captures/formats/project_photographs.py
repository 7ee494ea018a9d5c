"""Photographs on disk by the names that projects have for them: paths of other machines, URIs, labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vdgs.captures.image_files import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES, readable_images
from vdgs.captures.name_resolution import to_nfc, without_uri
from vdgs.captures.strays import is_mask_folder, walk
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word

#: The folder of undistorted photographs, which are not those of a camera.
UNDISTORTED = "undistorted"
_SUFFIXES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES


@dataclass(frozen=True)
class FoundPhotographs:
    """The folder (relative to the capture, or absolute), and for each camera the name in it and the file, which is not
    there where none was found."""

    folder: str
    names: tuple[str, ...]
    paths: tuple[Path, ...]
    warnings: tuple[str, ...]


def find_photographs(
    root: Path, options: CaptureOptions, names: Sequence[tuple[str, ...]], file: Path
) -> FoundPhotographs:
    """The photographs of cameras, each known by some `names`, below the folder that `options` name, else images/, else
    the whole capture.

    Raises `CaptureError` where none is there, and for photographs that are several cameras'.
    """
    folder = image_root(root, options)
    images = _find_images(folder, options)
    index = PhotographIndex(images)
    found = [next(filter(None, map(index.find, each)), None) for each in names]
    relative = folder.relative_to(root).as_posix() if folder.is_relative_to(root) else folder.as_posix()
    if not any(found):
        wanted = ", ".join(each[0] for each in names[:3]) + (", ..." if len(names) > 3 else "")
        have = f"holds {len(images)} others ({', '.join(list(images)[:3])}, ...)" if images else "holds no photographs"
        raise CaptureError(
            f"{file}: none of its {len(names)} photographs is in {folder}, which {have}. It names {wanted}. Say where "
            f"they are: vdgs run {shell_word(file)} --images FOLDER --output RUN"
        )
    twice = sorted(name for name, count in Counter(filter(None, found)).items() if count > 1)
    if twice:
        raise CaptureError(
            f"{file}: several of its cameras mean the same photograph: {', '.join(twice[:10])}. Photographs of one "
            "name need their folders, on disk and in the project: give the folder above them with --images."
        )
    unclear = [each[0] for each, name in zip(names, found, strict=True) if name is None and index.is_ambiguous(each)]
    notes = [f"{len(unclear)} names of the project may be of several photographs in {folder}, and are taken for none "
             f"({', '.join(unclear[:10])})."] if unclear else []  # fmt: skip
    called = [name or _plain(each[0]) for name, each in zip(found, names, strict=True)]
    paths = tuple(images.get(name, folder / name) for name in called)
    return FoundPhotographs(relative, tuple(called), paths, tuple(notes))


def image_root(root: Path, options: CaptureOptions) -> Path:
    """The folder that `--images` names, in the capture or anywhere else; else images/, else the capture itself."""
    if options.images is None:
        return root / "images" if (root / "images").is_dir() else root
    for folder in (root / options.images, Path(options.images)):
        if folder.is_dir():
            return folder if folder.is_relative_to(root) and ".." not in folder.parts else folder.resolve()
    raise CaptureError(f"--images {options.images}: no such folder, neither in {root} nor from here.")


def _find_images(root: Path, options: CaptureOptions) -> dict[str, Path]:
    """Photographs in and below a folder, without masks, results and undistorted copies."""
    apart = options.undistorted_folder.resolve() if options.undistorted_folder else None
    found = {}
    for folder, files, _ in walk(root):
        inside = folder.relative_to(root).parts
        if UNDISTORTED in inside or any(map(is_mask_folder, inside)) or (apart and folder.resolve() == apart):
            continue
        found.update({(folder / file.name).relative_to(root).as_posix(): file for file in _images(files)})
    return dict(sorted(found.items()))


def _images(files: Iterable[Path]) -> list[Path]:
    return [file for file in readable_images(files) if not file.name.startswith(".")]


class PhotographIndex:
    """Finds photographs on disk by the file names, else by these without extension, and of several by the folders that
    both paths end in."""

    def __init__(self, names: Sequence[str] | dict[str, Path]) -> None:
        self._by_name: dict[str, list[str]] = {}
        for name in names:
            last = _parts(name)[-1]
            for key in dict.fromkeys((last, _stem(last))):
                self._by_name.setdefault(key, []).append(name)

    def find(self, name: str) -> str | None:
        """The name on disk; None where there is none, or several are as likely."""
        best = self._best(name)
        return best[0] if len(best) == 1 else None

    def is_ambiguous(self, names: Sequence[str]) -> bool:
        return any(len(self._best(name)) > 1 for name in names)

    def _best(self, name: str) -> list[str]:
        parts = _parts(name)
        if not parts:
            return []
        found = self._by_name.get(parts[-1]) or self._by_name.get(_stem(parts[-1]), [])
        found = [each for each in found if _parts(each) == parts] or found
        shared = [_shared_tail(parts, _parts(each)) for each in found]
        return [each for each, count in zip(found, shared, strict=True) if count == max(shared)]


def _plain(name: str) -> str:
    """A name of a project as a path inside a folder."""
    name = without_uri(name)
    parts = [
        part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "..") and ":" not in part
    ]
    plain = "".join(letter for letter in "/".join(parts) if ord(letter) >= 32)
    return plain or "photograph without a name"


def _parts(name: str) -> tuple[str, ...]:
    """The folders and the file of a name, in lower case."""
    name = without_uri(name)
    return PurePosixPath(to_nfc(name).replace("\\", "/").lower()).parts


def _stem(last: str) -> str:
    path = PurePosixPath(last)
    return path.stem if path.suffix in _SUFFIXES else last


def _shared_tail(one: Sequence[str], other: Sequence[str]) -> int:
    """How many folders above the file are the same."""
    count = 0
    for a, b in zip(reversed(one[:-1]), reversed(other[:-1]), strict=False):
        if a != b:
            break
        count += 1
    return count
