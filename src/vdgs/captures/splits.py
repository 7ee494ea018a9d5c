"""Which photographs train and which test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from vdgs.captures.capture import Split, View
from vdgs.captures.options import CaptureOptions
from vdgs.captures.photographs import Names
from vdgs.captures.source import listing
from vdgs.errors import CaptureError


def nearest_to_middle(views: list[View], count: int) -> list[View]:
    """The `count` views nearest to the median camera centre: a compact patch keeps its overlap."""
    centres = np.stack([view.camera.position for view in views])
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    chosen = np.sort(np.argsort(distance, kind="stable")[:count])
    return [views[index] for index in chosen]


def choose_splits(
    root: Path, views: list[View], explicit: Mapping[str, Split | None], options: CaptureOptions
) -> list[View]:
    """The views in name order, each with its split. Raises `CaptureError` if a side stays empty."""
    views = sorted(views, key=lambda view: view.name)
    own = all(explicit.get(view.name) is not None for view in views)
    if options.test_list is not None and options.split != "every":
        tests = _listed(options.test_list, views)
        splits: list[Split] = ["test" if view.name in tests else "train" for view in views]
    elif own and options.split != "every":
        splits = ["test" if explicit[view.name] == "test" else "train" for view in views]
    elif options.split == "explicit":
        raise CaptureError(
            f"{root}: --split explicit, but the capture brings no split of its own (train/ and val/ "
            "folders). Name the test photographs with --test-list, or use --split every."
        )
    else:
        splits = ["test" if index % options.test_every == 0 else "train" for index in range(len(views))]
    chosen = [replace(view, split=split) for view, split in zip(views, splits, strict=True)]
    if options.validation:
        kept = [view for view in chosen if view.split == "train"]
        chosen = [replace(v, split="train" if i % options.test_every else "test") for i, v in enumerate(kept)]
    for side in ("train", "test"):
        if side not in {view.split for view in chosen}:
            raise CaptureError(
                f"{root}: no photograph is left to {side} on ({len(views)} in all). Check --test-list, "
                "--split and --max-images; at least two photographs are needed."
            )
    return chosen


def _listed(file: Path, views: list[View]) -> set[str]:
    """The names of views in a text file, one a line; extensions and case may differ."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{file}: cannot be read ({error}).") from None
    wanted = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    names = Names({view.name: view.image_path for view in views})
    found = {name: names.find(name) for name in wanted}
    unknown = [name for name, match in found.items() if match is None]
    if unknown:
        raise CaptureError(
            f"{file}: {len(unknown)} of its names are not photographs of this capture. "
            f"Write one image name a line.{listing(unknown)}"
        )
    return {match for match in found.values() if match is not None}
