"""The lists of test and validation photographs that a capture brings.

`test.txt` and `validation.txt` lie in the capture, beside the folder of its photographs, or beside its COLMAP model,
where 3DGS reads them, one name a line; or the `train_test_lists.json` of ScanNet++ does.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

from vdgs.captures.formats.colmap import find_models
from vdgs.captures.formats.listed_names import find_listed
from vdgs.captures.formats.source_capture import TEST_LISTS
from vdgs.captures.name_resolution import NameLookup
from vdgs.errors import CaptureError
from vdgs.system.units import first_names

#: Lists that a capture may bring.
TEST_LIST, VALIDATION_LIST = TEST_LISTS[0], "validation.txt"


def own_list(
    root: Path, images: str, names: Sequence[str], photographs: Sequence[str], notes: list[str]
) -> Path | None:
    """The list of one of these names that counts in a capture whose photographs lie in `images`; None where there is
    none. Notes say where it is, if not in the capture's folder, and which lists beside it name other `photographs`. A
    file outside the capture of whose names less than half are theirs is another's."""
    lists = _lists_of(root, images, names)
    strays = [file for file in lists if not _is_inside(file, root) and _is_of_others(file, photographs)]
    notes += [f"{file} names other photographs than this capture has, and is not used." for file in strays]
    lists = [file for file in lists if file not in strays]
    if not lists:
        return None
    used, *others = lists
    what = "validation" if used.name == VALIDATION_LIST else "the test"
    if used.parent != root:
        notes.append(f"{used} says which photographs are for {what}.")
    meant = _meant(used, photographs)
    for other in others:
        if _meant(other, photographs) != meant:
            notes.append(f"{other} names other photographs for {what} than {used}, and is not used. Keep one list.")
    return used


def _lists_of(root: Path, images: str, names: Sequence[str]) -> list[Path]:
    """The lists of these names that a capture brings, the one that counts first."""
    photographs = root / images
    beside = [] if os.path.abspath(photographs) == os.path.abspath(root) else [photographs.parent]
    found = dict[Path, Path]()
    for file in (folder / name for name in names for folder in (root, *beside, *find_models(root))):
        if file.is_file():
            found.setdefault(file.resolve(), file)
    return list(found.values())


def _is_of_others(file: Path, photographs: Sequence[str]) -> bool:
    """Whether less than half of what a list names are these photographs; False where it cannot be read, which is an
    error once it counts."""
    try:
        wanted = _names_in(file)
    except CaptureError:
        return False
    lookup = NameLookup((name, name) for name in photographs)
    known = sum(bool(lookup.find(name)[1]) for name in wanted)
    return not wanted or 2 * known < len(wanted)


def _is_inside(file: Path, root: Path) -> bool:
    return Path(os.path.abspath(file)).is_relative_to(os.path.abspath(root))


def _meant(file: Path, photographs: Sequence[str]) -> set[str] | None:
    """The photographs that a list names; None where it cannot be read."""
    try:
        return listed_photographs(file, photographs, some=False)[0]
    except CaptureError:
        return None


def listed_photographs(
    file: Path, names: Sequence[str], *, some: bool, strict: bool = False
) -> tuple[set[str], list[str]]:
    """Those of `names` that a text file lists, one a line, or a JSON file under `test`, and warnings about those that
    mean none of them and about photographs that a JSON file has neither there nor under `train`. Raises CaptureError
    for a list that cannot be read or names nothing where `some` are needed, and as `find_listed`."""
    wanted = _names_in(file)
    is_json = file.suffix.lower() == ".json"
    if some and not wanted:
        how = "Name images in the list under test" if is_json else "Write one image name a line"
        raise CaptureError(f"{file}: names no photograph. {how}, or ignore lists with --split every.")
    found, warnings = find_listed(wanted, names, str(file), strict=strict)
    return found, warnings + (_note_of_unlisted(file, wanted, names) if is_json else [])


def _note_of_unlisted(file: Path, tests: Sequence[str], names: Sequence[str]) -> list[str]:
    """A note about the photographs that a JSON file of two lists has in neither; none where it has no list `train`."""
    training = _texts_under("train", file.read_text(encoding="utf-8-sig"))
    if not training:
        return []
    lookup = NameLookup((name, name) for name in names)
    listed = {meant for line in (*training, *tests) for meant in lookup.find(line)[1]}
    unlisted = [name for name in names if name not in listed]
    if not unlisted:
        return []
    return [
        f"{file}: {len(unlisted)} of {len(names)} photographs stand neither under train nor under test, and count as "
        f"training photographs ({first_names(unlisted)})."
    ]


def _names_in(file: Path) -> list[str]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaptureError(
            f"{file}: is not UTF-8 text ({error}). Save it as UTF-8, or ignore lists with --split every."
        ) from None
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from None
    lines = _names_in_json(file, text) if file.suffix.lower() == ".json" else text.splitlines()
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def _names_in_json(file: Path, text: str) -> list[str]:
    """The list `test` of a JSON file. Raises CaptureError where there is none."""
    names = _texts_under("test", text)
    if names is None:
        raise CaptureError(f'{file}: must hold {{"test": [names of photographs]}}. Write that, or use --split every.')
    return names


def _texts_under(key: str, text: str) -> list[str] | None:
    """The list of texts under a key of a JSON object; None where there is none."""
    try:
        names = json.loads(text)[key]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return names if isinstance(names, list) and all(isinstance(name, str) for name in names) else None
