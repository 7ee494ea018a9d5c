"""The photographs of one or several folders: which are used, under which names, and which are left out, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

from vdgs.captures.formats.colmap import partial_model
from vdgs.captures.formats.source_capture import listing
from vdgs.captures.image_files import IMAGE_SUFFIXES
from vdgs.captures.name_resolution import listable, without_suffix
from vdgs.captures.output_guard import is_capture
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import Photograph, Unusable, read_photograph
from vdgs.sfm.mask_files import check_mask, find_masks

#: Fewer photographs are no scene.
LEAST_PHOTOGRAPHS = 3
#: So many bytes at both ends of files of one size tell whether they are copies.
_COMPARED = 1 << 16
#: Two files beside a photograph that are no news.
_SILENT = {".ds_store", "thumbs.db"}


@dataclass(frozen=True)
class LeftOut:
    """A photograph that is not used, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Collection:
    """Photographs in order of their names, and what else lay in their folders."""

    folders: tuple[Path, ...]
    photographs: tuple[Photograph, ...]
    left_out: tuple[LeftOut, ...]
    other_files: int
    notes: tuple[str, ...] = ()
    """What people should know of their masks."""


def collect(folders: Sequence[Path]) -> Collection:
    """Read the heads of all photographs in the folders and those below them.

    Raises CaptureError for folders that are not there or hold no photographs, captures, names that are alike but for
    blanks, masks that belong to nothing, and where too few are usable.
    """
    folders = list(dict.fromkeys(folders))
    for folder in folders:
        if not folder.is_dir():
            raise CaptureError(f"{folder}: no such folder. Give the folder that the photographs are in.")
        if is_reconstruction(folder) and not is_capture(folder):
            raise CaptureError(
                f"{folder}: is a capture that is not finished. Give its photographs and --output {folder}"
            )
        if is_capture(folder):
            raise CaptureError(f"{folder}: is a capture already. Use it as it is: vdgs run {folder} --output RUN")
    named, others = _named(folders)
    if not named:
        raise CaptureError(
            f"{', '.join(map(str, folders))}: holds no photographs ({', '.join(sorted(IMAGE_SUFFIXES))})"
            + (f", but {others} other files" if others else "")
            + ". Raw files (.dng) must be developed first."
        )
    masks, notes = find_masks(folders, named.values())
    named = {name: path for name, path in named.items() if path in masks}
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(_read, named.values(), named.keys(), masks.values()))
    photographs = [each for each in read if isinstance(each, Photograph)]
    left_out = [each for each in read if isinstance(each, LeftOut)]
    photographs, doubled = _without_doubles(photographs)
    left_out += doubled
    if len(photographs) < LEAST_PHOTOGRAPHS:
        reasons = listing(f"{each.name}: {each.why}" for each in left_out)
        raise CaptureError(
            f"{', '.join(map(str, folders))}: {len(photographs)} photograph{'s' if len(photographs) != 1 else ''} that "
            f"can be used; a scene needs {LEAST_PHOTOGRAPHS} at the very least, and each place two or three that show "
            f"it from different positions.{reasons}"
        )
    return Collection(tuple(folders), tuple(photographs), tuple(left_out), others, tuple(notes))


def only_photographs(folder: Path) -> bool:
    """Whether photographs lie in the folder or below it and no capture, whole or in part, is there."""
    if (
        not folder.is_dir()
        or is_capture(folder)
        or is_reconstruction(folder)
        or partial_model(folder)
        or (folder / "sparse").exists()
    ):
        return False
    return any(_is_photograph(path) for path in folder.rglob("*"))


def _is_photograph(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _named(folders: Sequence[Path]) -> tuple[dict[str, Path], int]:
    """Photographs by their names in the capture, sorted, and the number of other files. Raises CaptureError for two of
    one name."""
    prefixes = _prefixes(folders)
    found, others = dict[str, Path](), 0
    seen = set[Path]()
    for folder, prefix in zip(folders, prefixes, strict=True):
        for path in sorted(folder.rglob("*")):
            if not _is_photograph(path):
                others += path.is_file() and path.name.lower() not in _SILENT
                continue
            real = path.resolve()
            if real not in seen:  # a folder and one inside it may both be named
                seen.add(real)
                name = listable(prefix + path.relative_to(folder).as_posix())
                if name in found:
                    raise CaptureError(
                        f"{path}: would be called {name} in the capture, whose names have _ for blanks, as would "
                        f"{found[name]}. Rename one of the two, or remove it if it is a copy."
                    )
                found[name] = path
    return dict(sorted(found.items())), others


def _prefixes(folders: Sequence[Path]) -> list[str]:
    """What tells photographs of several folders apart: the folders' own names, numbered where they are alike."""
    if len(folders) == 1:
        return [""]
    names = [listable(folder.resolve().name) or "photographs" for folder in folders]
    counts = Counter(names)
    return [f"{name}_{k + 1}/" if counts[name] > 1 else f"{name}/" for k, name in enumerate(names)]


def _read(path: Path, name: str, mask: Path | None) -> Photograph | LeftOut:
    try:
        photo = replace(read_photograph(path, name), mask=mask)
    except Unusable as why:
        return LeftOut(name, str(why))
    check_mask(photo)
    return photo


def _without_doubles(photographs: list[Photograph]) -> tuple[list[Photograph], list[LeftOut]]:
    """Leave out copies of the same file, and files whose names differ in their endings only."""
    kept, left_out = list[Photograph](), list[LeftOut]()
    sizes = Counter(photo.bytes for photo in photographs)
    contents, stems = dict[tuple[int, bytes], str](), dict[str, str]()
    for photo in photographs:
        stem = without_suffix(photo.name)
        if stem in stems:
            left_out.append(LeftOut(photo.name, f"has the name of {stems[stem]} with another ending"))
            continue
        if sizes[photo.bytes] > 1:
            content = photo.bytes, _digest(photo.path)
            if content in contents:
                left_out.append(LeftOut(photo.name, f"is a copy of {contents[content]}"))
                continue
            contents[content] = photo.name
        stems[stem] = photo.name
        kept.append(photo)
    return kept, left_out


def _digest(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_COMPARED)
        file.seek(max(0, path.stat().st_size - _COMPARED))
        return blake2b(head + file.read()).digest()
