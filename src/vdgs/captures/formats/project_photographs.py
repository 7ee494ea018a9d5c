"""Photographs on disk by the names that projects have for them: paths of other machines, URIs, labels."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vdgs.captures.formats.source_capture import LEAST_THERE
from vdgs.captures.image_files import read_header, readable_images
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.captures.name_resolution import to_nfc, without_uri
from vdgs.captures.strays import is_mask_folder, walk
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.units import some_names

#: The folder of undistorted photographs, which are not those of a camera.
UNDISTORTED = "undistorted"
_SUFFIXES = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES
#: What folders of one side of a split are called.
_SIDES = {"train", "training", "test", "testing", "val", "valid", "validation", "eval"}


@dataclass(frozen=True)
class FoundPhotographs:
    """The folder (relative to the capture, or absolute), and for each camera the name in it and the file, which is not
    there where none was found."""

    folder: str
    names: tuple[str, ...]
    paths: tuple[Path, ...]
    warnings: tuple[str, ...]


def find_photographs(
    root: Path, options: CaptureOptions, names: Sequence[tuple[str, ...]], file: Path,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> FoundPhotographs:  # fmt: skip
    """The photographs of cameras, each known by some `names`, below the folder that `options` name, else images/, else
    the whole capture. Of several that a name may mean the one is taken that alone has the camera's width and height,
    where `sizes` says these; photographs of another folder than the one that is meant are not taken
    (`_without_others`).

    Raises `CaptureError` where none is there, where too many may be any of several, and for photographs that are
    several cameras'.
    """
    folder = image_root(root, options)
    images = images_below(folder, options)
    index = PhotographIndex(images)
    meant, others = _without_others(names, [index.find_all(each) for each in names])
    found = [each[0] if len(each) == 1 else None for each in meant]
    if sizes is not None:
        found = [name or _of_size(each, size, images) for name, each, size in zip(found, meant, sizes, strict=True)]
    unclear = [each for name, each in zip(found, meant, strict=True) if name is None and len(each) > 1]
    alike = [each for each, count in Counter(names).items() if count > 1]
    _refuse_many_unclear(unclear, len(names) - found.count(None), len(names), alike, file)
    notes = _note_others(others, len(names) - found.count(None), len(names), file)
    if not any(found):
        raise _none_there(names, folder, images, file)
    _refuse_shared(found, alike, file)
    chosen = [name for name, each in zip(found, meant, strict=True) if name is not None and len(each) > 1]
    notes += _notes_on_several(unclear, chosen, folder)
    called = [name or _plain(each[0]) for name, each in zip(found, names, strict=True)]
    paths = tuple(images.get(name, folder / name) for name in called)
    relative = folder.relative_to(root) if folder.is_relative_to(root) else folder
    return FoundPhotographs(relative.as_posix(), tuple(called), paths, notes)


def _without_others(
    names: Sequence[tuple[str, ...]], meant: Sequence[list[str]]
) -> tuple[list[list[str]], list[tuple[str, str]]]:
    """What each camera may mean without photographs of other folders, and the names of cameras that nothing is left
    for, each with such a photograph: cards number the photographs of all their folders alike."""
    tails = {folders[-k:] for each in names for name in each if (folders := _parts(name)[:-1]) for k in _upto(folders)}
    kept, others = [], []
    for called, there in zip(names, meant, strict=True):
        kept.append([each for each in there if not _is_of_other_folder(called, each, tails)])
        if there and not kept[-1]:
            others.append((called[0], there[0]))
    return kept, others


def _upto(folders: Sequence[str]) -> range:
    return range(1, len(folders) + 1)


def _is_of_other_folder(called: Sequence[str], found: str, tails: Collection[tuple[str, ...]]) -> bool:
    """Whether the folders of a photograph that was found are others than all those that the names of a camera tell:
    such as the project has for other cameras (by the ends of their paths, `tails`), or of the same kind
    (`is_of_another`)."""
    there = _parts(found)
    told = [parts for parts in map(_parts, called) if len(parts) > 1 and _stem(parts[-1]) == _stem(there[-1])]
    return bool(told) and all(_contradict(meant, there, tails) for meant in told)


def _contradict(meant: Sequence[str], there: tuple[str, ...], tails: Collection[tuple[str, ...]]) -> bool:
    same = _shared_tail(meant, there)
    if same >= min(len(meant), len(there)) - 1:
        return False
    above = ("/".join((*each[: -1 - same], each[-1])) for each in (meant, there))
    return there[-2 - same : -1] in tails or is_of_another(*above)


def is_of_another(written: str, found: str) -> bool:
    """Whether a photograph is of another folder of the same kind than the one that is meant, by the names of both: the
    other side of a split (train/ for test/), or another number (flight2/ for flight1/). These have other photographs
    under the same names; shrunk ones (images_4) are the same."""
    meant, there = (PurePosixPath(path.replace("\\", "/")).parts[:-1] for path in (written, found))
    sides = [{side for side in map(str.lower, folders) if side in _SIDES} for folders in (meant, there)]
    if all(sides) and sides[0] != sides[1]:
        return True
    ends = [folders[-1].lower() if folders else "" for folders in (meant, there)]
    kinds = [re.sub(r"\d+", "#", end) for end in ends]
    return ends[0] != ends[1] and kinds[0] == kinds[1] and "#" in kinds[0] and not ends[0].startswith("images_")


def _note_others(others: Sequence[tuple[str, str]], found: int, count: int, file: Path) -> tuple[str, ...]:
    """A warning about photographs that only other folders have; CaptureError where too few are left without them."""
    if not others:
        return ()
    said = (
        f"{len(others)} of its {count} photographs are only in other folders than the project says, such as "
        f"{_plain(others[0][0])}, for which {others[0][1]} is there: another photograph under the same name, it seems"
    )
    hint = "If all were gathered in one folder, give that folder with --images"
    if found < LEAST_THERE * count <= found + len(others):
        raise CaptureError(f"{file}: {said}. Copy the right ones there. {hint}.")
    return (f"{said}. They count as missing. {hint}.",)


def _none_there(names: Sequence[tuple[str, ...]], folder: Path, images: dict[str, Path], file: Path) -> CaptureError:
    wanted = some_names([each[0] for each in names], 3)
    have = f"holds {len(images)} others ({', '.join(list(images)[:3])}, ...)" if images else "holds no photographs"
    return CaptureError(
        f"{file}: none of its {len(names)} photographs is in {folder}, which {have}. It names {wanted}. Say which "
        "folder they are in: --images FOLDER"
    )


def _names_of_their_own(alike: Sequence[tuple[str, ...]]) -> str:
    """What to do where a project has the same names for several cameras, which no choice of a folder tells apart."""
    shown = some_names([each[0] for each in alike], 3)
    return (
        f"The project itself has one name for several of its photographs ({shown}): give all photographs names of "
        "their own, align them under these, and export it again (of Metashape, give the .psx, or put the cameras into "
        "groups that are called as the folders)."
    )


def _refuse_shared(found: Sequence[str | None], alike: Sequence[tuple[str, ...]], file: Path) -> None:
    """Raise `CaptureError` for photographs that were found for several cameras."""
    twice = sorted(name for name, count in Counter(filter(None, found)).items() if count > 1)
    if twice:
        remedy = (
            "Photographs of one name need their folders, on disk and in the project: give the folder above them with "
            "--images."
        )
        raise CaptureError(
            f"{file}: several of its cameras mean the same photograph: {', '.join(twice[:10])}. "
            f"{_names_of_their_own(alike) if alike else remedy}"
        )


def _notes_on_several(unclear: Sequence[Sequence[str]], chosen: Sequence[str], folder: Path) -> tuple[str, ...]:
    """What to say of names that may be of several photographs: those of none, and those chosen by their size."""
    several = f"names of the project may be of several photographs in {folder}"
    notes = [f"{len(unclear)} {several}, and are taken for none ({_either(unclear[:10])})."] if unclear else []
    if chosen:
        notes.append(
            f"{len(chosen)} {several}; those are taken that are as large as the cameras ({', '.join(chosen[:10])})."
        )
    return tuple(notes)


def _of_size(names: Sequence[str], size: tuple[int, int], images: dict[str, Path]) -> str | None:
    """The only photograph of a width and height, if one alone has these."""
    fitting = []
    for name in names:
        with suppress(CaptureError):
            header = read_header(images[name])
            fitting += [name] if (header.width, header.height) == size else []
    return fitting[0] if len(fitting) == 1 else None


def _refuse_many_unclear(
    unclear: Sequence[Sequence[str]], found: int, count: int, alike: Sequence[tuple[str, ...]], file: Path
) -> None:
    """Raise `CaptureError` where photographs would be enough if it were known which of several they are."""
    if not unclear or not found < LEAST_THERE * count <= found + len(unclear):
        return
    apart = all(len({PurePosixPath(name).parent for name in each}) > 1 for each in unclear)
    remedy = f"Of these {'choose the folder of one with --images' if apart else 'keep only one of each there'}."
    raise CaptureError(
        f"{file}: {len(unclear)} of its {count} names may be of several photographs each: "
        f"{_either(unclear[:3])}{', ...' if len(unclear) > 3 else ''}. "
        f"{_names_of_their_own(alike) if alike else remedy}"
    )


def _either(unclear: Sequence[Sequence[str]]) -> str:
    return ", ".join(" or ".join(each[:3]) for each in unclear)


def image_root(root: Path, options: CaptureOptions) -> Path:
    """The folder that `--images` names, in the capture or anywhere else; else images/, else the capture itself."""
    if options.images is None:
        return root / "images" if (root / "images").is_dir() else root
    for folder in (root / options.images, Path(options.images)):
        if folder.is_dir():
            return folder if folder.is_relative_to(root) and ".." not in folder.parts else folder.resolve()
    raise CaptureError(f"--images {options.images}: no such folder, neither in {root} nor from here.")


def images_below(root: Path, options: CaptureOptions) -> dict[str, Path]:
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

    def find_all(self, names: Sequence[str]) -> list[str]:
        """The names on disk of a photograph that is called by all these: one where some name is of one alone, several
        where they are as likely, none where there is none."""
        found = [self._best(name) for name in names]
        return min(filter(None, found), key=lambda each: len(each) > 1, default=[])

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
