"""Names of photographs as cards, programs and people write them: which of them mean the same one.

Unicode writes an accented letter in one piece (NFC) or in two (NFD, which macOS leaves on cards); a name is the same in
both.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Generic, TypeVar
from urllib.parse import unquote

from vdgs.errors import CaptureError

_URI = re.compile(r"file:/*(?:localhost/)?", re.IGNORECASE)
T = TypeVar("T")


def to_nfc(name: str) -> str:
    """The name with accented letters in one piece."""
    return unicodedata.normalize("NFC", name)


def without_uri(name: str) -> str:
    """The path of a `file://` URI; other names as they are."""
    return unquote(_URI.sub("", name)) if _URI.match(name) else name


def to_colmap_name(name: str) -> str:
    """The name as COLMAP's lists, which part words at blanks and skip lines that begin with `#`, can hold it: `_` for
    each blank and for a `#` that it begins with, letters composed."""
    plain = "".join("_" if letter.isspace() else letter for letter in to_nfc(name))
    return f"_{plain[1:]}" if plain.startswith("#") else plain


def jpeg_name(name: str) -> str:
    """What the JPEG that is made of a photograph is called, whatever that was."""
    return name if name.lower().endswith((".jpg", ".jpeg")) else f"{name}.jpg"


def match_key(name: str) -> str:
    """The key by which names match across extensions: no suffix, lower case."""
    path = PurePosixPath(name)
    return to_nfc((str(path.with_suffix("")) if path.suffix else name).lower())


def match_stem(name: str) -> str:
    """The key by which photographs are matched across folders and extensions: file stem, lower case."""
    return to_nfc(PurePosixPath(name.replace("\\", "/")).stem.lower())


def find_file(folder: Path, name: str) -> Path | None:
    """The file of this name below a folder, whichever way its letters are written there; None where there is none."""
    ways = dict.fromkeys((name, to_nfc(name), unicodedata.normalize("NFD", name)))
    return next((folder / way for way in ways if (folder / way).is_file()), None)


def largest_shrunk(root: Path, folder: str) -> str | None:
    """The largest of the folders `folder`_N of shrunk photographs in `root`; None where there is none."""
    shrunk = [entry.name for entry in root.glob(f"{folder}_*") if entry.is_dir()]
    factors = {int(name.removeprefix(f"{folder}_")): name for name in shrunk if name[len(folder) + 1 :].isdigit()}
    return factors[min(factors)] if factors else None


class ImageNameIndex:
    """Looks images up by name: exactly, else by the only one that differs in how its letters are written, else by the
    only one that differs in extension or case."""

    def __init__(self, images: dict[str, Path]) -> None:
        self.images = images
        self._alike: tuple[dict[str, list[str]], ...] = ({}, {})
        for name in images:
            for alike, key in zip(self._alike, (to_nfc(name), match_key(name)), strict=True):
                alike.setdefault(key, []).append(name)

    def find(self, name: str) -> str | None:
        """The name on disk, or None."""
        if name in self.images:
            return name
        for alike, key in zip(self._alike, (to_nfc(name), match_key(name)), strict=True):
            if len(alike.get(key, [])) == 1:
                return alike[key][0]
        return None


class NameLookup(Generic[T]):
    """Finds things by what people write of their names: the whole path, the end of it, or what it is the end of; in
    other letters (case, `_` for blanks), with another extension."""

    def __init__(self, named: Iterable[tuple[str, T]]) -> None:
        self._exact: dict[str, list[T]] = {}
        self._whole: dict[str, list[T]] = {}
        self._ending: dict[str, list[T]] = {}
        for name, thing in named:
            self._exact.setdefault(_posix(name), []).append(thing)
            for spelled in dict.fromkeys(_spellings(name)):
                self._whole.setdefault(spelled, []).append(thing)
                for ending in _endings(spelled):
                    self._ending.setdefault(ending, []).append(thing)

    def find(self, name: str) -> tuple[tuple[int, int], list[T]]:
        """What a name means, and how well it says so (less is better). Several things where it says too little; none
        where nothing has this name, or only in another folder."""
        exact = self._exact.get(_posix(name))
        if exact:
            return (0, 0), exact
        for level, spelled in enumerate(_spellings(name), 1):
            ends = (self._whole.get(ending) for ending in _endings(spelled)[1:])
            for way, found in enumerate((self._whole.get(spelled), self._ending.get(spelled), *ends)):
                if found:
                    return (level, way), found
        return (3, 0), []

    def find_elsewhere(self, name: str) -> tuple[tuple[int, int], list[T]]:
        """What has the name's file name, in whichever folder."""
        return self.find(PurePosixPath(_posix(name)).name)


def find_in_other_folders(
    names: Sequence[str], available: Collection[str], folder: Path, warnings: list[str]
) -> Sequence[str | None]:
    """The names below `folder` of images that a model has in other folders (`images/a.jpg` for `a.jpg`, or the other
    way round), a warning where they are; None of each where two would be the same, or one is of several."""
    lookup = NameLookup((name, name) for name in available)
    found = [lookup.find(name)[1] for name in names]
    single = [each[0] if len(each) == 1 else None for each in found]
    known = [name for name in single if name is not None]
    if not known or len(set(known)) < len(known):
        return [None] * len(names)
    first = next(name for name, each in zip(names, single, strict=True) if each is not None)
    warnings.append(f"the model names images by other folders than those of {folder}: {first} is taken as {known[0]}.")
    return single


def several_places(names: Sequence[str], available: Collection[str]) -> list[str]:
    """A sentence about names of a model without photograph that several in folders below may be; nothing where none is
    of these."""
    lookup = NameLookup((name, name) for name in available)
    several = {name: found for name in names if len(found := lookup.find(name)[1]) > 1}
    if not several:
        return []
    name, found = next(iter(several.items()))
    return [
        f"{len(several)} of the missing images are there several times, and which is meant is not known: {name!r} may "
        f"be {found[0]} or {found[1]}. Give the folder of the right ones with --images."
    ]


def find_one(lookup: NameLookup[T], written: str, where: str, name_of: Callable[[T], str]) -> T:
    """The photograph that a line means, if need be in another folder. Raises CaptureError, which says `where` the line
    is, for a name of none and for one of several."""
    found = lookup.find(written)[1] or lookup.find_elsewhere(written)[1]
    if not found:
        raise CaptureError(f"{where}: there is no photograph {written!r}. Mend the name, or remove the line.")
    if len(found) > 1:
        raise CaptureError(f"{where}: {ambiguity_message(written, name_of(found[0]), name_of(found[1]))}")
    return found[0]


def ambiguity_message(written: str, one: str, other: str) -> str:
    """What to tell people who wrote a name that may be either of two."""
    apart = PurePosixPath(one).parent != PurePosixPath(other).parent
    return f"{written!r} may be {one} or {other}: write {'the folder too' if apart else 'it as it stands here'}."


def _posix(name: str) -> str:
    return str(PurePosixPath(to_nfc(name).replace("\\", "/")))


def _spellings(name: str) -> tuple[str, str]:
    """A name in ever less exact ways: in lower case with `_` for blanks, then without its extension."""
    folded = to_colmap_name(_posix(name).lower())
    return folded, match_key(folded)


def _endings(path: str) -> list[str]:
    """A path, and what is left of it as its folders go, one after the other."""
    parts = PurePosixPath(path).parts
    return ["/".join(parts[k:]) for k in range(len(parts))]
