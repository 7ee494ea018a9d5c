"""The full check of the photographs, before anyone trains on them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np

from vdgs.captures.capture import Capture
from vdgs.captures.formats.source import listing
from vdgs.captures.photographs import pillow_quietly, verify
from vdgs.errors import CaptureError

DECODERS = 2


def check_images(
    capture: Capture, which: Literal["all"] | int = "all", progress: Callable[[int, int], None] | None = None
) -> int:
    """Decode photographs and masks once; return how many files were checked.

    `which` is "all" or the number of views to check, spread evenly. `progress(done, total)` is called
    after each file. Raises `CaptureError` that lists up to ten files that are truncated or damaged.
    """
    views = capture.views
    if which != "all":
        chosen = np.unique(np.linspace(0, len(views) - 1, min(max(which, 1), len(views))).round().astype(int))
        views = tuple(views[index] for index in chosen)
    files = [view.image_path for view in views]
    files += [view.mask_path for view in views if view.mask_path is not None]
    problems = []
    with pillow_quietly(), ThreadPoolExecutor(DECODERS) as pool:
        for done, problem in enumerate(pool.map(verify, files), 1):
            if problem is not None:
                problems.append(problem)
            if progress is not None:
                progress(done, len(files))
    if problems:
        raise CaptureError(
            f"{capture.root / capture.images}: {len(problems)} of {len(files)} images cannot be decoded. "
            f"Copy them again, or remove them from the model.{listing(problems)}"
        )
    return len(files)
