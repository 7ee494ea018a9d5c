"""Quality by block, and what the seams between blocks cost.

Every pixel of a test view is labeled with the block that the point it shows was merged from. PSNR is pooled by block,
and the error near the borders of the labels is compared with the error in the interior. The coarse model, which has no
seams, is measured on the same pixels: borders may lie where images are hard to match anyway. Only sums stay in memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int16

from vdgs.evaluation.metrics import psnr_from_mse
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.partition.merging import BlockLookup
from vdgs.system.documents import JsonObject

#: Pixels this near to a change of label belong to the border.
BORDER_PX = 10.0
#: Less opaque pixels count as showing nothing: their depth says little.
MIN_ALPHA = 0.5
#: A block is measured in the views of which it makes at least this share: a sliver tells little and costs a render.
MIN_VIEW_SHARE = 0.005
#: The label of a pixel where nothing is drawn.
NO_BLOCK = -1


def block_label_map(raster: Raster, camera: Camera, block_at: BlockLookup) -> Int16[np.ndarray, "h w"]:
    """The block whose anchors are at the point that each pixel shows (its center at the median depth); NO_BLOCK where
    alpha is at most one half. The expected depth would lie between roof and ground at the edge of a roof.
    Raises ValueError if the view was rendered without depth.
    """
    if raster.median_depth is None:
        raise ValueError("labels need a render with depth")
    alpha = raster.alpha.double().cpu().numpy()
    seen = alpha > MIN_ALPHA
    labels = np.full(alpha.shape, NO_BLOCK, np.int16)
    depth = raster.median_depth.double().cpu().numpy()[seen]
    labels[seen] = block_at(torch.from_numpy(_unproject_pixels(np.argwhere(seen), depth, camera)))
    return labels


def _unproject_pixels(pixels: np.ndarray, depth: Float[np.ndarray, " n"], camera: Camera) -> Float[np.ndarray, "n 3"]:
    """World points of pixels (row, column) [n, 2] at depths along the camera's axis; the inverse of `project`."""
    x = (pixels[:, 1] + 0.5 - camera.cx) / camera.fx
    y = (pixels[:, 0] + 0.5 - camera.cy) / camera.fy
    spread = depth if camera.model == "pinhole" else np.ones_like(depth)
    local = np.stack([x * spread, y * spread, depth], axis=1)
    return (local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]


def border_lines(labels: Int16[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels on either side of a change from one block to another; the edge of what is drawn is no border."""
    lines = np.zeros(labels.shape, bool)
    for first, second, here, there in (
        (labels[1:], labels[:-1], lines[1:], lines[:-1]),
        (labels[:, 1:], labels[:, :-1], lines[:, 1:], lines[:, :-1]),
    ):
        change = (first != second) & (first >= 0) & (second >= 0)
        here |= change
        there |= change
    return lines


def border_pixels(labels: Int16[np.ndarray, "h w"], width_px: float = BORDER_PX) -> Bool[np.ndarray, "h w"]:
    """Drawn pixels whose center is within `width_px` (Euclidean) of the center of one on a border line."""
    lines = border_lines(labels)
    if not lines.any():
        return lines
    distance = cv2.distanceTransform((~lines).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (distance <= width_px) & (labels >= 0)


def visible_blocks(labels: Int16[np.ndarray, "h w"], blocks: int) -> list[int]:
    """The blocks that at least MIN_VIEW_SHARE of the view shows."""
    counts = np.bincount(labels[labels >= 0].astype(np.int64), minlength=blocks)
    return np.flatnonzero(counts >= max(1.0, MIN_VIEW_SHARE * labels.size)).tolist()


_AnyPooled = TypeVar("_AnyPooled", bound="_PooledErrors")


class _PooledErrors:
    """Pixels by group (blocks, or places), and sums of errors over them by name, one view after the other."""

    def __init__(self, groups: int, names: Sequence[str]) -> None:
        self._pixels = np.zeros(groups, np.int64)
        self._sums = {name: np.zeros(groups) for name in names}

    def merge(self: _AnyPooled, other: _AnyPooled) -> None:
        """Add another's sums. Merged view by view, in order, sums have the bits of one object that counted all."""
        self._pixels += other._pixels
        for name, total in self._sums.items():
            total += other._sums[name]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The counts as arrays, for files."""
        names, sums = np.array([*self._sums], np.str_), np.stack([*self._sums.values()])
        return {"pixels": self._pixels, "names": names, "sums": sums}

    @classmethod
    def of(cls: type[_AnyPooled], arrays: Mapping[str, np.ndarray]) -> _AnyPooled:
        """The inverse of `to_arrays`."""
        result = cls.__new__(cls)
        result._pixels = arrays["pixels"].copy()
        result._sums = {str(name): sums.copy() for name, sums in zip(arrays["names"], arrays["sums"], strict=True)}
        return result


class BlockMetrics(_PooledErrors):
    """Squared errors of named renders, pooled by block; `add` each test view, then read `rows`."""

    def add(
        self,
        labels: Int16[np.ndarray, "h w"],
        squared_errors: Mapping[str, Float[np.ndarray, "h w"]],
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Count one view: the pixels of `visible_blocks` alone, the same for all renders. A name whose errors are NaN
        there has no figure for that block."""
        counted = np.isin(labels, visible_blocks(labels, len(self._pixels)))
        if mask is not None:
            counted &= mask
        keys = labels[counted].astype(np.int64)
        self._pixels += np.bincount(keys, minlength=len(self._pixels))
        for name, total in self._sums.items():
            total += np.bincount(keys, weights=squared_errors[name][counted], minlength=len(total))

    def rows(self) -> list[dict[str, float]]:
        """For each block: block, pixels, and `psnr_NAME` in dB of each render, NaN where it has none."""
        return [{"block": index, **self._figures([index])} for index in range(len(self._pixels))]

    def overall(self) -> dict[str, float]:
        """The same over the pixels of all blocks."""
        return self._figures(list(range(len(self._pixels))))

    def _figures(self, chosen: list[int]) -> dict[str, float]:
        pixels = int(self._pixels[chosen].sum())
        means = {name: float(sums[chosen].sum()) / pixels if pixels else np.nan for name, sums in self._sums.items()}
        return {"pixels": pixels, **{f"psnr_{name}": psnr_from_mse(mean) for name, mean in means.items()}}


class SeamMetrics(_PooledErrors):
    """Errors at the borders of blocks against errors in their interior; `add` each test view, then read `figures`."""

    #: The renders that are compared. The coarse one has no seams: it says how hard the places at the borders are.
    RENDER_NAMES = ("coarse", "merged")

    def __init__(self) -> None:
        super().__init__(2, [f"{kind}_{name}" for kind in ("mae", "mse") for name in self.RENDER_NAMES])

    def add(
        self,
        labels: Int16[np.ndarray, "h w"],
        errors: Mapping[str, Float[np.ndarray, "h w"]],
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Count one view: absolute errors `mae_coarse`, `mae_merged`, squared `mse_coarse`, `mse_merged`."""
        drawn = labels >= 0 if mask is None else mask & (labels >= 0)
        at_border = border_pixels(labels)
        for place, where in enumerate((drawn & at_border, drawn & ~at_border)):
            self._pixels[place] += np.count_nonzero(where)
            for name, sums in self._sums.items():
                sums[place] += errors[name][where].sum()

    def figures(self) -> JsonObject:
        """Means at the border and in the interior, their ratio for each render, and `seam_mae_ratio`, `seam_mse_ratio`:
        the ratio of the merged render over that of the coarse one. Above 1, merging left seams; NaN without borders."""
        result: JsonObject = {"border_pixels": int(self._pixels[0]), "interior_pixels": int(self._pixels[1])}
        for name, sums in self._sums.items():
            border, interior = (_ratio(float(sums[place]), float(self._pixels[place])) for place in (0, 1))
            result[name] = {"border": border, "interior": interior, "ratio": _ratio(border, interior)}
        for kind in ("mae", "mse"):
            coarse, merged = (result[f"{kind}_{name}"]["ratio"] for name in self.RENDER_NAMES)
            result[f"seam_{kind}_ratio"] = _ratio(merged, coarse)
        return result


def _ratio(value: float, reference: float) -> float:
    return value / reference if reference > 0 else float("nan")
