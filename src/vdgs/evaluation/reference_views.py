"""What an evaluation measures against: test views, their photographs and masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from vdgs.captures.capture import View


@dataclass(frozen=True, eq=False)
class ReferenceViews:
    """Test views, and how to load their photographs and masks (true = keep; None: all of it counts)."""

    views: Sequence[View]
    load_image: Callable[[View], UInt8[np.ndarray, "h w 3"]]
    load_mask: Callable[[View], Bool[np.ndarray, "h w"] | None]
