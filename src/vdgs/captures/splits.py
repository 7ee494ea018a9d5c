"""Which photographs train and which test.

A capture may bring its own lists, `test.txt` and `validation.txt` beside its photographs' folder or beside its COLMAP
model, where 3DGS reads them, one name a line; or the `train_test_lists.json` of ScanNet++ there. Photographs of either
list never train; those of `validation.txt` are used with `--validation` only. Formats may say it too; where one says it
of some photographs only, the others are left out, as nerfstudio does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from vdgs.captures.capture import Split, View
from vdgs.captures.flight_parts import MIN_STRIP, OBLIQUE_DEGREES, flight_strips, oblique_views
from vdgs.captures.formats.colmap import find_models
from vdgs.captures.formats.listed_names import find_listed
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

#: Lists that a capture may bring.
TEST_LIST, VALIDATION_LIST = "test.txt", "validation.txt"
#: The list for the test by its names, the first that is there counts.
_TEST_LISTS = (TEST_LIST, "train_test_lists.json")
#: Splits that follow from positions and headings.
_BY_FLIGHT = ("strips", "obliques")


def select_central_views(views: list[View], count: int) -> list[View]:
    """The `count` views nearest to the median camera center: a compact patch keeps its overlap."""
    centers = np.stack([view.camera.position for view in views])
    distance = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    chosen = np.sort(np.argsort(distance, kind="stable")[:count])
    return [views[index] for index in chosen]


def assign_splits(
    root: Path,
    views: list[View],
    explicit: Mapping[str, Split | None],
    options: CaptureOptions,
    warnings: list[str],
) -> list[View]:
    """The views in name order, each with its split, without those that are kept for the other purpose or for none.

    `explicit` names every photograph of the capture (`views` may be some of them) with the split that its format
    gives it. Raises `CaptureError` if a side stays empty or a list names what is no photograph.
    """
    views = sorted(views, key=lambda view: view.name)
    names = list(explicit)
    splits = _splits(root, views, explicit, options, warnings)
    chosen = [replace(view, split=split) for view, split in zip(views, splits, strict=True) if split is not None]
    unlisted = [view.name for view, split in zip(views, splits, strict=True) if split is None]
    if unlisted and options.split not in _BY_FLIGHT:
        shown = ", ".join(unlisted[:5]) + (", ..." if len(unlisted) > 5 else "")
        warnings.append(
            f"{len(unlisted)} of {len(views)} photographs stand in none of the capture's lists of training and test "
            f"photographs and are left out ({shown}). --split every uses them all."
        )
    own = _list_of(root, VALIDATION_LIST)
    if options.split in _BY_FLIGHT:
        pass  # they know of validation themselves
    elif own is not None and options.split != "every":
        listed, notes = listed_photographs(own, names, some=options.validation, strict=options.strict)
        chosen = _with_validation_list(chosen, listed, options.validation)
        warnings += notes
    elif options.validation:
        kept = [view for view in chosen if view.split == "train"]
        chosen = [replace(v, split="train" if i % options.test_every else "test") for i, v in enumerate(kept)]
    for side in ("train", "test"):
        if side not in {view.split for view in chosen}:
            raise CaptureError(
                f"{root}: no photograph is left to {side} on ({len(views)} in all). Check --test-list and "
                "--max-images, or keep every n-th for the test, whatever lists there are: --split every. At least two "
                "photographs are needed."
            )
    return chosen


def held_out_by_capture(
    root: Path, names: Sequence[str], options: CaptureOptions, warnings: list[str]
) -> dict[str, set[str]]:
    """The photographs that `--test-list` or a capture's own lists keep from training, by the names of the lists."""
    found, files = dict[str, set[str]](), {VALIDATION_LIST: _list_of(root, VALIDATION_LIST)}
    files[TEST_LIST] = options.test_list or _list_of(root, *_TEST_LISTS)
    for name, file in files.items():
        if file is not None and options.split not in ("every", *_BY_FLIGHT):
            found[name], notes = listed_photographs(file, names, some=name == TEST_LIST, strict=options.strict)
            warnings += notes
    return found


def _list_of(root: Path, *names: str) -> Path | None:
    """A list that a capture brings, by the first of its names: in its folder, or beside its COLMAP model."""
    files = (folder / name for name in names for folder in (root, *find_models(root)))
    return next((file for file in files if file.is_file()), None)


def _splits(
    root: Path, views: list[View], explicit: Mapping[str, Split | None], options: CaptureOptions, warnings: list[str]
) -> list[Split | None]:
    """The split of each view: by the list asked for, the capture's list, its format (None where that knows others
    only), or every n-th."""
    listed = options.test_list or _list_of(root, *_TEST_LISTS)
    if options.split in _BY_FLIGHT:
        return _splits_by_flight(root, views, options)
    if options.split != "every":
        if listed is not None:
            tests, notes = listed_photographs(listed, list(explicit), some=True, strict=options.strict)
            warnings += notes
            return ["test" if view.name in tests else "train" for view in views]
        if any(split is not None for split in explicit.values()):
            return [explicit[view.name] for view in views]
    if options.split == "explicit":
        raise CaptureError(
            f"{root}: --split explicit, but the capture brings no split of its own (train/ and val/ folders, lists in "
            f"transforms.json, or {TEST_LIST}). Name the test photographs with --test-list, or use --split every."
        )
    return ["test" if index % options.test_every == 0 else "train" for index in range(len(views))]


def _splits_by_flight(root: Path, views: list[View], options: CaptureOptions) -> list[Split | None]:
    """Whole strips, or all obliques, for testing; or for validation others, without those for testing.

    Raises CaptureError where the flight has none to leave out.
    """
    if options.split == "obliques":
        parts, least = [[k] for k in oblique_views(views)], 2
        step, found = 2, f"{len(parts)} of {len(views)} photographs look more than {OBLIQUE_DEGREES} degrees from down"
        if len(views) - len(parts) < MIN_STRIP:
            parts = []
    else:
        parts, least = flight_strips(views), 4 if options.validation else 3
        step = max(min(options.test_every, len(parts)), 2)
        found = f"the flight has {len(parts)} straight strips of at least {MIN_STRIP} photographs"
    if len(parts) < least:
        raise CaptureError(
            f"{root}: --split {options.split}, but {found}; at least {least} are needed, and {MIN_STRIP} photographs "
            "that train. Use --split every."
        )
    tests, validation = parts[step // 2 :: step], parts[step // 2 - 1 :: step]
    if options.split == "obliques" and not options.validation:
        tests = parts
    splits: list[Split | None] = ["train"] * len(views)
    for k in chain.from_iterable(tests):
        splits[k] = None if options.validation else "test"
    for k in chain.from_iterable(validation if options.validation else ()):
        splits[k] = "test"
    return splits


def _with_validation_list(views: list[View], listed: set[str], validation: bool) -> list[View]:
    """Leave the listed photographs out; or, for validation, test on them and leave the test photographs out."""
    held_out = {view.name for view in views if view.split == "test"}
    if not validation:
        return [view for view in views if view.name in held_out or view.name not in listed]
    kept = [view for view in views if view.name not in held_out]
    return [replace(view, split="test" if view.name in listed else "train") for view in kept]


def listed_photographs(
    file: Path, names: Sequence[str], *, some: bool, strict: bool = False
) -> tuple[set[str], list[str]]:
    """Those of `names` that a text file lists, one a line, or a JSON file under `test`, and a warning about those that
    mean none of them. Raises CaptureError for a list that cannot be read or names nothing where `some` are needed, and
    as `find_listed`."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaptureError(f"{file}: is not UTF-8 text ({error}). Save it as UTF-8.") from None
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from None
    lines = _names_in_json(file, text) if file.suffix.lower() == ".json" else text.splitlines()
    wanted = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if some and not wanted:
        how = "Name images in the list under test" if file.suffix.lower() == ".json" else "Write one image name a line"
        raise CaptureError(f"{file}: names no photograph. {how}, or ignore lists with --split every.")
    return find_listed(wanted, names, str(file), strict=strict)


def _names_in_json(file: Path, text: str) -> list[str]:
    """The list `test` of a JSON file. Raises CaptureError where there is none."""
    try:
        names = json.loads(text)["test"]
    except (ValueError, KeyError, TypeError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CaptureError(f'{file}: must hold {{"test": [names of photographs]}}. Write that, or use --split every.')
    return names
