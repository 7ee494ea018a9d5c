"""The full check of the photographs, before anyone trains on them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vdgs.captures.capture import Capture, View, spread_evenly
from vdgs.captures.formats.source_capture import format_list
from vdgs.captures.image_files import gray_masks_note, masked_shares, verify_image
from vdgs.errors import CaptureError
from vdgs.system.content_digests import find_copies
from vdgs.system.units import some_names

#: Rounding by this share of the distance between cameras and points is about a pixel (choice).
MAX_ROUNDING_RATIO = 1e-3
#: An axis with fewer distinct values may be made of steps (floors, terraces), not rounded.
MIN_DISTINCT_VALUES = 20
#: How far a rounded value may be off its step, as a share of it.
STEP_TOLERANCE = 1e-3


def detect_rounding(points: np.ndarray, distance: float) -> float:
    """The step to which some axis of the points [n, 3] is rounded, in their unit; 0 where none can be seen from
    `distance`. Steps are powers of two (float32) and of ten (decimals)."""
    least = MAX_ROUNDING_RATIO * distance
    if not least > 0:
        return 0.0
    powers = np.concatenate([2.0 ** np.arange(-20, 21), 10.0 ** np.arange(-6, 7)])
    steps = [step for step in sorted(powers, reverse=True) if least <= step <= distance]
    axes = [axis for axis in points.T if len(np.unique(axis)) >= MIN_DISTINCT_VALUES]
    return max((_step(axis, steps) for axis in axes), default=0.0)


def _step(values: np.ndarray, steps: list[float]) -> float:
    """The largest of the steps, in falling order, of which all values are multiples; 0 for none."""
    for step in steps:
        if (np.abs(values / step - np.round(values / step)) <= STEP_TOLERANCE).all():
            return float(step)
    return 0.0


NUM_DECODER_THREADS = 2
#: Masks that leave out more than this share of the photographs may be inverted.
MAX_MASKED_FRACTION = 0.6


@dataclass(frozen=True)
class ImageCheckReport:
    """What decoding all photographs and masks told."""

    #: Files that were decoded.
    files: int
    #: Share of the pixels of these photographs that masks and transparency leave out.
    masked_fraction: float
    #: What a person should know but need not mend.
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _CheckedView:
    name: str
    problem: str | None = None
    blank: bool = False
    kept: float = 1.0
    #: `gray_fraction` of its mask.
    gray: float = 0.0


def check_images(
    capture: Capture, sample: Literal["all"] | int = "all", on_progress: Callable[[int, int], None] | None = None
) -> ImageCheckReport:
    """Decode photographs and masks once.

    `sample` is "all" or the number of views to check, spread evenly. `on_progress(done, total)` is called
    after each view. Raises `CaptureError` that lists up to ten files that are truncated or damaged, or of which masks
    or transparency leave nothing, and where no photograph shows more than one color.
    """
    views = capture.views
    if sample != "all":
        views = spread_evenly(views, max(sample, 1))
    checked: list[_CheckedView] = []
    with ThreadPoolExecutor(NUM_DECODER_THREADS) as pool:
        for view in pool.map(_check_view, views):
            checked.append(view)
            if on_progress is not None:
                on_progress(len(checked), len(views))
    folder, files = capture.root / capture.images, len(views) + sum(view.mask_path is not None for view in views)
    problems = [view.problem for view in checked if view.problem is not None]
    if problems:
        raise CaptureError(
            f"{folder}: {len(problems)} of {len(views)} photographs or their masks cannot be used. "
            f"Copy those that are damaged again, or remove them from the model.{format_list(problems)}"
        )
    blank = [view.name for view in checked if view.blank]
    if len(blank) == len(checked):
        raise CaptureError(f"{folder}: every photograph is of one color only. Copy the photographs again.")
    masked = 1.0 - sum(view.kept for view in checked) / len(checked)
    shown = [view for view in views if view.name not in set(blank)]
    copies = [tuple(shown[k].name for k in group) for group in find_copies([view.image_path for view in shown])]
    shares = {
        view.mask_path: each.gray for view, each in zip(views, checked, strict=True) if view.mask_path is not None
    }
    return ImageCheckReport(files, masked, tuple(_warnings(blank, masked, copies) + gray_masks_note(shares)))


def _check_view(view: View) -> _CheckedView:
    """A photograph and its mask, decoded."""
    try:
        photograph = verify_image(view.image_path)
        if view.mask_path is not None:
            verify_image(view.mask_path)
        kept, gray = masked_shares(view.image_path, view.mask_path, photograph.has_alpha_channel)
    except CaptureError as error:
        return _CheckedView(view.name, str(error))
    return _CheckedView(view.name, None, not photograph.has_content, kept, gray)


def _warnings(blank: list[str], masked: float, copies: list[tuple[str, ...]]) -> list[str]:
    found = []
    if copies:
        shown = some_names([" = ".join(names[:3]) for names in copies], 3)
        found.append(
            f"{sum(map(len, copies))} photographs are the same file as another one, under other names ({shown}). Where "
            "their poses differ, only one of these can be right: remove the copies, or put the right photographs there."
        )
    if blank:
        shown = some_names(blank)
        found.append(f"photographs of one color only, which teach nothing but that: {len(blank)} ({shown}).")
    if masked > MAX_MASKED_FRACTION:
        found.append(f"masks leave out {masked:.0%} of the photographs. White is kept: are they inverted?")
    return found
