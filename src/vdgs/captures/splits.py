"""Which photographs train and which test.

A capture may bring its own lists (`split_lists`). Photographs of either list never train; those of `validation.txt` are
used with `--validation` only. Formats may say it too; where one says it of some photographs only, the others are left
out, as nerfstudio does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from vdgs.captures.capture import Split, View
from vdgs.captures.flight_parts import MIN_STRIP, OBLIQUE_DEGREES, flight_strips, oblique_views
from vdgs.captures.split_lists import TEST_LIST, TEST_LISTS, VALIDATION_LIST, listed_photographs, own_list
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.units import some_names

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
    *,
    images: str,
) -> list[View]:
    """The views in name order, each with its split, without those that are kept for the other purpose or for none.

    `explicit` names every photograph of the capture (`views` may be some of them) with the split that its format
    gives it; `images` is their folder, in the capture or elsewhere. Raises `CaptureError` if a side stays empty or a
    list names what is no photograph.
    """
    views = sorted(views, key=lambda view: view.name)
    names = list(explicit)
    splits = _splits(root, images, views, explicit, options, warnings)
    chosen = [replace(view, split=split) for view, split in zip(views, splits, strict=True) if split is not None]
    unlisted = [view.name for view, split in zip(views, splits, strict=True) if split is None]
    if unlisted and options.split not in _BY_FLIGHT:
        shown = some_names(unlisted)
        warnings.append(
            f"{len(unlisted)} of {len(views)} photographs stand in none of the capture's lists of training and test "
            f"photographs and are left out ({shown}). --split every uses them all."
        )
    ignored = options.split in ("every", *_BY_FLIGHT)
    own = None if ignored else own_list(root, images, (VALIDATION_LIST,), names, warnings)
    if options.split in _BY_FLIGHT:
        pass  # they know of validation themselves
    elif own is not None:
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
    root: Path, images: str, names: Sequence[str], options: CaptureOptions, warnings: list[str]
) -> dict[str, set[str]]:
    """The photographs, of those in the folder `images`, that `--test-list` or a capture's own lists keep from training,
    by the names of the lists."""
    found = dict[str, set[str]]()
    if options.split in ("every", *_BY_FLIGHT):
        return found
    files = {VALIDATION_LIST: own_list(root, images, (VALIDATION_LIST,), names, warnings)}
    files[TEST_LIST] = options.test_list or own_list(root, images, TEST_LISTS, names, warnings)
    for name, file in files.items():
        if file is not None:
            found[name], notes = listed_photographs(file, names, some=name == TEST_LIST, strict=options.strict)
            warnings += notes
    return found


def _splits(
    root: Path, images: str, views: list[View], explicit: Mapping[str, Split | None], options: CaptureOptions,
    warnings: list[str],
) -> list[Split | None]:  # fmt: skip
    """The split of each view: by the list asked for, the capture's list, its format (None where that knows others
    only), or every n-th."""
    if options.split in _BY_FLIGHT:
        return _splits_by_flight(root, views, options)
    if options.split != "every":
        listed = options.test_list or own_list(root, images, TEST_LISTS, list(explicit), warnings)
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
