"""The photographs of one or several folders: which are used, under which names, and which are left out, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path

from vdgs.captures.formats.colmap import partial_model
from vdgs.captures.formats.source_capture import format_list
from vdgs.captures.image_files import IMAGE_SUFFIXES
from vdgs.captures.name_resolution import match_key, to_colmap_name
from vdgs.captures.output_guard import is_capture
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import ImageMetadata, UnusableImage, read_image_metadata
from vdgs.sfm.mask_files import check_mask, find_masks

#: Fewer photographs are no scene.
MIN_IMAGES = 3
#: So many bytes at both ends of files of one size tell whether they are copies.
_DIGEST_BYTES = 1 << 16
#: Two files beside a photograph that are no news.
_IGNORED_FILES = {".ds_store", "thumbs.db"}


@dataclass(frozen=True)
class ExcludedImage:
    """A photograph that is not used, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class ImageList:
    """Photographs in order of their names, and what else lay in their folders."""

    folders: tuple[Path, ...]
    images: tuple[ImageMetadata, ...]
    excluded: tuple[ExcludedImage, ...]
    other_files: int
    notes: tuple[str, ...] = ()
    """What people should know of their masks."""


def collect_images(folders: Sequence[Path]) -> ImageList:
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
    photographs = [each for each in read if isinstance(each, ImageMetadata)]
    left_out = [each for each in read if isinstance(each, ExcludedImage)]
    photographs, doubled = _drop_duplicates(photographs)
    left_out += doubled
    if len(photographs) < MIN_IMAGES:
        reasons = format_list(f"{each.name}: {each.reason}" for each in left_out)
        raise CaptureError(
            f"{', '.join(map(str, folders))}: {len(photographs)} photograph{'s' if len(photographs) != 1 else ''} that "
            f"can be used; a scene needs {MIN_IMAGES} at the very least, and each place two or three that show "
            f"it from different positions.{reasons}"
        )
    return ImageList(tuple(folders), tuple(photographs), tuple(left_out), others, tuple(notes))


def is_image_folder(folder: Path) -> bool:
    """Whether photographs lie in the folder or below it and no capture, whole or in part, is there."""
    if (
        not folder.is_dir()
        or is_capture(folder)
        or is_reconstruction(folder)
        or partial_model(folder)
        or (folder / "sparse").exists()
    ):
        return False
    return any(_is_image(path) for path in folder.rglob("*"))


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _named(folders: Sequence[Path]) -> tuple[dict[str, Path], int]:
    """Photographs by their names in the capture, sorted, and the number of other files. Raises CaptureError for two of
    one name."""
    prefixes = _prefixes(folders)
    found, others = dict[str, Path](), 0
    seen = set[Path]()
    for folder, prefix in zip(folders, prefixes, strict=True):
        for path in sorted(folder.rglob("*")):
            if not _is_image(path):
                others += path.is_file() and path.name.lower() not in _IGNORED_FILES
                continue
            real = path.resolve()
            if real not in seen:  # a folder and one inside it may both be named
                seen.add(real)
                name = to_colmap_name(prefix + path.relative_to(folder).as_posix())
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
    names = [to_colmap_name(folder.resolve().name) or "photographs" for folder in folders]
    counts = Counter(names)
    return [f"{name}_{k + 1}/" if counts[name] > 1 else f"{name}/" for k, name in enumerate(names)]


def _read(path: Path, name: str, mask: Path | None) -> ImageMetadata | ExcludedImage:
    try:
        photo = replace(read_image_metadata(path, name), mask=mask)
    except UnusableImage as why:
        return ExcludedImage(name, str(why))
    check_mask(photo)
    return photo


def _drop_duplicates(photographs: list[ImageMetadata]) -> tuple[list[ImageMetadata], list[ExcludedImage]]:
    """Leave out copies of the same file, and files whose names differ in their endings only."""
    kept, left_out = list[ImageMetadata](), list[ExcludedImage]()
    sizes = Counter(photo.file_bytes for photo in photographs)
    contents, stems = dict[tuple[int, bytes], str](), dict[str, str]()
    for photo in photographs:
        stem = match_key(photo.name)
        if stem in stems:
            left_out.append(ExcludedImage(photo.name, f"has the name of {stems[stem]} with another ending"))
            continue
        if sizes[photo.file_bytes] > 1:
            content = photo.file_bytes, _digest(photo.path)
            if content in contents:
                left_out.append(ExcludedImage(photo.name, f"is a copy of {contents[content]}"))
                continue
            contents[content] = photo.name
        stems[stem] = photo.name
        kept.append(photo)
    return kept, left_out


def _digest(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_DIGEST_BYTES)
        file.seek(max(0, path.stat().st_size - _DIGEST_BYTES))
        return blake2b(head + file.read()).digest()
