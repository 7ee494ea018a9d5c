"""What an evaluation measures against: test views, their photographs and masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from vdgs.captures.capture import View
from vdgs.errors import CaptureError


def read_mask(view: View) -> Bool[np.ndarray, "h w"] | None:
    """The view's mask at the size of its camera, true where it is white; None where it has none."""
    if view.mask_path is None:
        return None
    mask = cv2.imread(str(view.mask_path), cv2.IMREAD_GRAYSCALE) if view.mask_path.is_file() else None
    if mask is None:
        raise CaptureError(f"{view.mask_path}: the mask of {view.name} cannot be read. Restore or remove it.")
    size = (view.camera.width, view.camera.height)
    return cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 127


@dataclass(frozen=True, eq=False)
class ReferenceViews:
    """Test views, and how to load their photographs and masks (true = keep; None: all of it counts)."""

    views: Sequence[View]
    load_image: Callable[[View], UInt8[np.ndarray, "h w 3"]]
    load_mask: Callable[[View], Bool[np.ndarray, "h w"] | None] = read_mask
