"""The faces of a cube around an equirectangular panorama: perspective views of 90°."""

from __future__ import annotations

import cv2
import numpy as np

#: Right, down and forward of each face in the axes of the panorama: x right, y down, z to its middle.
FACES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
#: Pixels of the other end that are put beside each end, so that nothing is seen of the seam.
_EDGE = 4


def cut_face(panorama: np.ndarray, face: str, side: int, interpolation: int = cv2.INTER_CUBIC) -> np.ndarray:
    """A face [side, side, ...] of a panorama [h, 2 h, ...]."""
    height, width = panorama.shape[:2]
    across = (np.arange(side) + 0.5) * 2 / side - 1
    x, y = np.meshgrid(across, across)
    right, down, forward = np.moveaxis(np.stack([x, y, np.ones_like(x)], axis=-1) @ np.array(FACES[face]), -1, 0)
    longitude, latitude = np.arctan2(right, forward), np.arctan2(down, np.hypot(right, forward))
    column = ((longitude / (2 * np.pi) + 0.5) * width - 0.5 + _EDGE).astype(np.float32)
    row = ((latitude / np.pi + 0.5) * height - 0.5).clip(0, height - 1).astype(np.float32)
    wrapped = np.concatenate([panorama[:, -_EDGE:], panorama, panorama[:, :_EDGE]], axis=1)
    return cv2.remap(wrapped, column, row, interpolation, borderMode=cv2.BORDER_REPLICATE)
