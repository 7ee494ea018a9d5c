"""The full check of the photographs, before anyone trains on them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vdgs.captures.capture import Capture, View
from vdgs.captures.formats.source_capture import listing
from vdgs.captures.image_files import pillow_quietly, share_kept, verify
from vdgs.errors import CaptureError

#: Rounding by this share of the distance between cameras and points is about a pixel (choice).
VISIBLE_SHARE = 1e-3
#: An axis with fewer distinct values may be made of steps (floors, terraces), not rounded.
LEAST_VALUES = 20
#: How far a rounded value may be off its step, as a share of it.
SLACK = 1e-3


def rounding_of(points: np.ndarray, distance: float) -> float:
    """The step to which some axis of the points [n, 3] is rounded, in their unit; 0 where none can be seen from
    `distance`. Steps are powers of two (float32) and of ten (decimals)."""
    least = VISIBLE_SHARE * distance
    if not least > 0:
        return 0.0
    powers = np.concatenate([2.0 ** np.arange(-20, 21), 10.0 ** np.arange(-6, 7)])
    steps = [step for step in sorted(powers, reverse=True) if least <= step <= distance]
    axes = [axis for axis in points.T if len(np.unique(axis)) >= LEAST_VALUES]
    return max((_step(axis, steps) for axis in axes), default=0.0)


def _step(values: np.ndarray, steps: list[float]) -> float:
    """The largest of the steps, in falling order, of which all values are multiples; 0 for none."""
    for step in steps:
        if (np.abs(values / step - np.round(values / step)) <= SLACK).all():
            return float(step)
    return 0.0


DECODERS = 2
#: Masks that leave out more than this share of the photographs may be inverted.
MUCH_MASKED = 0.6


@dataclass(frozen=True)
class CheckedImages:
    """What decoding all photographs and masks told."""

    #: Files that were decoded.
    files: int
    #: Share of the pixels of these photographs that masks and transparency leave out.
    masked_share: float
    #: What a person should know but need not mend.
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _CheckedView:
    name: str
    problem: str | None = None
    blank: bool = False
    kept: float = 1.0


def check_images(
    capture: Capture, which: Literal["all"] | int = "all", progress: Callable[[int, int], None] | None = None
) -> CheckedImages:
    """Decode photographs and masks once.

    `which` is "all" or the number of views to check, spread evenly. `progress(done, total)` is called
    after each view. Raises `CaptureError` that lists up to ten files that are truncated or damaged, or of which masks
    or transparency leave nothing, and where no photograph shows more than one colour.
    """
    views = capture.views
    if which != "all":
        chosen = np.unique(np.linspace(0, len(views) - 1, min(max(which, 1), len(views))).round().astype(int))
        views = tuple(views[index] for index in chosen)
    checked: list[_CheckedView] = []
    with pillow_quietly(), ThreadPoolExecutor(DECODERS) as pool:
        for view in pool.map(_check_view, views):
            checked.append(view)
            if progress is not None:
                progress(len(checked), len(views))
    folder, files = capture.root / capture.images, len(views) + sum(view.mask_path is not None for view in views)
    problems = [view.problem for view in checked if view.problem is not None]
    if problems:
        raise CaptureError(
            f"{folder}: {len(problems)} of {len(views)} photographs or their masks cannot be used. "
            f"Copy them again, or remove them from the model.{listing(problems)}"
        )
    blank = [view.name for view in checked if view.blank]
    if len(blank) == len(checked):
        raise CaptureError(f"{folder}: every photograph is of one colour only. Copy the photographs again.")
    masked = 1.0 - sum(view.kept for view in checked) / len(checked)
    return CheckedImages(files, masked, tuple(_warnings(blank, masked)))


def _check_view(view: View) -> _CheckedView:
    """A photograph and its mask, decoded."""
    try:
        photograph = verify(view.image_path)
        if view.mask_path is not None:
            verify(view.mask_path)
        kept = share_kept(view.image_path, view.mask_path, photograph.may_be_transparent)
    except CaptureError as error:
        return _CheckedView(view.name, str(error))
    return _CheckedView(view.name, None, not photograph.shows, kept)


def _warnings(blank: list[str], masked: float) -> list[str]:
    found = []
    if blank:
        shown = ", ".join(blank[:5]) + (", ..." if len(blank) > 5 else "")
        found.append(f"photographs of one colour only, which teach nothing but that: {len(blank)} ({shown}).")
    if masked > MUCH_MASKED:
        found.append(f"masks leave out {masked:.0%} of the photographs. White is kept: are they inverted?")
    return found
