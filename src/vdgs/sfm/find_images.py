"""Which files of folders are photographs, by their names: what lies beside them, and what is not even looked into."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from vdgs.captures.image_files import readable_images, readable_suffixes
from vdgs.captures.image_suffixes import (
    AVIF_SUFFIXES,
    HEIF_SUFFIXES,
    IMAGE_SUFFIXES,
    JPEG_SUFFIXES,
    OTHER_IMAGE_SUFFIXES,
    PROXY_SUFFIXES,
    RAW_SUFFIXES,
    VIDEO_SUFFIXES,
)
from vdgs.captures.name_resolution import to_colmap_name, to_nfc
from vdgs.captures.optional_decoders import INSTALL
from vdgs.captures.reconstruction import FILMS_FILE, FRAMES_FOLDER
from vdgs.captures.strays import MASKED, is_result, is_system_file, previewed_stem, walk
from vdgs.errors import CaptureError
from vdgs.sfm.picture_layers import layer_folders, picture_layers, unnamed_pictures
from vdgs.system.atomic_files import read_json_or_empty
from vdgs.system.quoting import check_is_text
from vdgs.system.units import first_names, some_names

#: What photographs are sent and downloaded in.
_ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz", ".tar.zst")


@dataclass
class Found:
    """The photographs of folders by their names in the capture, sorted, and what is none."""

    named: dict[str, Path] = field(default_factory=dict)
    others: int = 0
    """Files that are no images."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Images that are no photographs by their names, with the reason."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Folders that are not looked into, with the reason."""
    unread: Counter[str] = field(default_factory=Counter)
    """Photographs of kinds that are not read, by their suffix."""
    doubled: Counter[str] = field(default_factory=Counter)
    """HEIC and raw files beside a picture of the same name, by their suffix."""
    films: list[str] = field(default_factory=list)
    """Names of films that are not used."""
    archives: list[str] = field(default_factory=list)
    """Names of files in which photographs may be packed."""
    dangling: list[Path] = field(default_factory=list)
    """Links to what is not there."""
    renamed: dict[str, str] = field(default_factory=dict)
    """Images' own names, by those in the capture, where the two differ (blanks)."""

    def notes(self) -> list[str]:
        """What people should know of what is not used."""
        kinds = [kind for kind in self.unread if kind not in VIDEO_SUFFIXES | PROXY_SUFFIXES]
        notes = [f"{said}."] if (said := self.films_beside()) else []
        notes += [f"{_count(self.unread[kind], kind)} not read: {_remedy(kind)}." for kind in kinds]
        notes += [
            f"{_count(number, kind)} not used, but the pictures of the same names beside. To use the others, give a "
            "folder of those alone."
            for kind, number in self.doubled.items()
        ]
        notes += [f"{said}."] if (said := self.dangling_links()) else []
        if self.renamed:
            names = [f"{name} is {own!r}" for name, own in self.renamed.items()]
            notes.append(f"names here have _ for blanks (and a # in front): {first_names(names)}.")
        for why in dict.fromkeys(self.skipped.values()):
            names = [name for name, reason in self.skipped.items() if reason == why]
            shown = some_names(names)
            notes.append(f"not read: {shown} ({why}).")
        return notes

    def films_beside(self) -> str:
        """What to tell of films that are not used; empty where there are none."""
        if not self.films:
            return ""
        count = f"{len(self.films)} film{'s' if len(self.films) > 1 else ''}"
        return f"{count} beside the photographs: not used ({first_names(self.films)}). To use a film too, name it"

    def dangling_links(self) -> str:
        """What to tell of links to what is not there; empty where there are none."""
        if not self.dangling:
            return ""
        first, count = self.dangling[0], len(self.dangling)
        return (
            f"left out {count} link{'s' if count > 1 else ''} to files that are not there (first {first.name}, to "
            f"{os.readlink(first)}): connect the disk that they are on, or copy the files"
        )


def is_dangling(path: Path) -> bool:
    """Whether a path is a link to what is not there: a file or a folder of a disk that is not connected."""
    return path.is_symlink() and not os.path.exists(path)


def is_photograph(path: Path) -> bool:
    """Whether a file is an image that can be read, by its name."""
    return path.suffix.lower() in readable_suffixes() and not path.name.startswith(".") and path.is_file()


def is_film(path: Path) -> bool:
    """Whether a file is a film by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".") and path.is_file()


def is_archive(path: Path) -> bool:
    """Whether photographs may be packed in a file, by its name."""
    return path.name.lower().endswith(_ARCHIVES) and not path.name.startswith(".") and path.is_file()


def films_in(paths: Sequence[Path]) -> list[Path]:
    """The films among the paths, and those of folders without photographs, each once."""
    found = dict[Path, Path]()
    for path in dict.fromkeys(paths):
        films = [path] if is_film(path) else _films_alone(path) if path.is_dir() else []
        for film in films:
            found.setdefault(film.resolve(), film)
    return list(found.values())


def _films_alone(folder: Path) -> list[Path]:
    """The films in a folder and below it, where no photographs are."""
    films = list[Path]()
    for _, files, _ in walk(folder):
        if any(is_photograph(path) for path in files):
            return []
        films += [path for path in files if is_film(path)]
    return films


def find_files(folders: Sequence[Path]) -> Found:
    """The photographs in the folders and those below them. Raises CaptureError for two of one name."""
    found, seen, used = Found(), set[Path](), _films_of_frames(folders)
    for folder, prefix in zip(folders, _prefixes(folders), strict=True):
        for _, files, skipped in walk(folder):
            found.skipped |= {prefix + path.relative_to(folder).as_posix(): why for path, why in skipped.items()}
            images = {path for path in readable_images(files) if is_photograph(path)}
            stems = {path.stem.lower() for path in images}
            for path in files:
                if path in images:
                    real = path.resolve()
                    if real not in seen:  # a folder and one inside it may both be named
                        seen.add(real)
                        _add(found, path, prefix + path.relative_to(folder).as_posix(), stems)
                elif not (is_film(path) and str(path.resolve()) in used):
                    _count_other(found, path, stems)
    layers = picture_layers(found.named) | unnamed_pictures(found.named)
    found.left_out |= layers
    about = layer_folders({name: path for name, path in found.named.items() if name not in layers})
    found.skipped |= dict.fromkeys(about, "results of a program, of the photographs of these names elsewhere")
    found.named = {
        name: path
        for name, path in sorted(found.named.items())
        if name not in layers and not any(str(folder) in about for folder in PurePosixPath(name).parents)
    }
    return found


def _films_of_frames(folders: Sequence[Path]) -> set[str]:
    """The films whose frames lie in one of the folders."""
    found = set[str]()
    for folder in folders:
        if folder.name == FRAMES_FOLDER:
            try:
                found |= {record["film"] for record in read_json_or_empty(folder.parent / FILMS_FILE).values()}
            except (ValueError, TypeError, KeyError):
                continue  # of another program
    return found


def _add(found: Found, path: Path, written: str, stems: set[str]) -> None:
    check_is_text(path)
    name = to_colmap_name(written)
    if name != to_nfc(written):
        found.renamed[name] = to_nfc(written)
    preview = previewed_stem(path.stem)
    if preview is not None and preview.lower() in stems:
        found.left_out[name] = "is a preview, by its name"
    elif path.stem.endswith(MASKED) and path.stem.removesuffix(MASKED).lower() in stems:
        found.left_out[name] = "is a masked copy, by its name"
    elif is_result(path):
        found.left_out[name] = "is a map or another result, by its name"
    elif name in found.named:
        raise CaptureError(
            f"{path}: would be called {name} in the capture, whose names have _ for blanks, as would "
            f"{found.named[name]}. Rename one of the two, or remove it if it is a copy."
        )
    else:
        found.named[name] = path


def _count_other(found: Found, path: Path, stems: set[str]) -> None:
    """A file that is no image that is read, or not used because its picture lies beside it."""
    suffix = path.suffix.lower()
    if is_system_file(path.name):
        return
    if is_dangling(path):
        if not path.name.startswith("."):  # editors' locks are such links
            found.dangling.append(path)
        return
    found.others += path.is_file()
    if is_archive(path):
        found.archives.append(path.name)
    if suffix in OTHER_IMAGE_SUFFIXES | VIDEO_SUFFIXES | PROXY_SUFFIXES and path.stem.lower() not in stems:
        found.unread[suffix] += 1
        if suffix in VIDEO_SUFFIXES:
            found.films.append(path.name)
    elif suffix in HEIF_SUFFIXES | RAW_SUFFIXES:
        found.doubled[suffix] += 1


def nothing_found(folders: Sequence[Path], found: Found) -> CaptureError:
    """What to tell of folders without photographs that can be read."""
    said = f"{', '.join(map(str, folders))}: holds no photographs ({', '.join(sorted(IMAGE_SUFFIXES))})"
    if dangling := found.dangling_links():
        return CaptureError(f"{said}: {dangling}.")
    if found.unread:
        kinds = "; ".join(
            f"{_count(number, suffix)} not read: {_remedy(suffix)}" for suffix, number in found.unread.items()
        )
        return CaptureError(f"{said}. {kinds}.")
    others = f", but {found.others} other file{'s' if found.others > 1 else ''}" if found.others else ""
    if found.archives:
        return CaptureError(
            f"{said}{others}. Unpack {first_names(found.archives)}, and give the folder of what was in it."
        )
    if found.left_out:
        name, why = next(iter(found.left_out.items()))
        return CaptureError(
            f"{said}{others}, and {len(found.left_out)} images that are left out by their names: {name} {why}. Rename "
            "them if they are photographs (IMG_0001.JPG, ...)."
        )
    skipped = f" Not looked into: {', '.join(list(found.skipped)[:5])}." if found.skipped else ""
    return CaptureError(f"{said}{others}.{skipped}")


def check_decoders(folders: Sequence[Path], found: Found) -> None:
    """Raise CaptureError where photographs of which a decoder is not installed are as many as those that are read."""
    waiting = {kind: number for kind, number in found.unread.items() if kind in HEIF_SUFFIXES | RAW_SUFFIXES}
    if waiting and sum(waiting.values()) >= len(found.named):
        kinds = ", ".join(f"{number} {kind}" for kind, number in waiting.items())
        raise CaptureError(
            f"{', '.join(map(str, folders))}: holds {len(found.named)} photographs that can be read, and {kinds} files "
            f"that cannot, without their decoder: {INSTALL} (or move the latter elsewhere)."
        )


def _count(number: int, suffix: str) -> str:
    return f"{number} {suffix} file{'s are' if number > 1 else ' is'}"


def _remedy(suffix: str) -> str:
    if suffix in HEIF_SUFFIXES | RAW_SUFFIXES:
        return f"{INSTALL} to read them, or convert them to JPEG, with their tags"
    if suffix in AVIF_SUFFIXES:
        return "pip install 'pillow>=11.3' to read them, or convert them to JPEG (magick mogrify -format jpg *.avif)"
    if suffix == ".jxl":
        return "convert them to JPEG, with their tags (djxl IN.jxl OUT.jpg, of libjxl, or: magick mogrify -format jpg)"
    if suffix in JPEG_SUFFIXES:
        return "they are JPEG; rename them to .jpg"
    if suffix in PROXY_SUFFIXES:
        return "copies of films in low resolution (proxies); give the films themselves"
    if suffix in VIDEO_SUFFIXES:
        return "name the films themselves"
    return "convert them to JPEG, PNG or TIFF, with their tags"


def _prefixes(folders: Sequence[Path]) -> list[str]:
    """What tells photographs of several folders apart: the folders' own names, numbered where they are alike."""
    if len(folders) == 1:
        return [""]
    names = [to_colmap_name(folder.resolve().name) or "photographs" for folder in folders]
    counts = Counter(name.lower() for name in names)  # on some disks names of other letters are one
    found, taken = list[str](), {name for name, count in counts.items() if count == 1}
    for number, name in enumerate(names, start=1):
        written = name
        if counts[name.lower()] > 1:
            written = next(each for k in itertools.count(number) if (each := f"{name}_{k}").lower() not in taken)
            taken.add(written.lower())
        found.append(f"{written}/")
    return found
