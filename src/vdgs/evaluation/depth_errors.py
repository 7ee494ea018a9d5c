"""How far a model's depth is from the truth, where there is one: generated captures that were written with it.

Errors are in camera heights above ground, so that they mean the same for every flight. A pixel that is not drawn has no
depth: its error is infinite, and it counts.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from vdgs.evaluation.by_block import MIN_ALPHA
from vdgs.evaluation.by_visibility import NUM_KEYS, histogram_keys, histogram_values
from vdgs.kernels.kernel_types import Raster

#: Errors up to this share of the camera height count as within one percent, and within two.
NEAR_THRESHOLD, WITHIN_THRESHOLD = 0.01, 0.02
#: Two depths of a pixel: the mean over what is blended, and where it becomes half opaque.
DEPTH_KINDS = ("expected", "median")
#: What is reported of each kind.
METRIC_NAMES = tuple(
    f"{name}_{kind}"
    for kind in DEPTH_KINDS
    for name in ("depth_error_median", "depth_within_1_percent", "depth_within_2_percent")
)


class DepthErrors:
    """Errors of pixels, of any number of views: counted in a histogram, so that memory does not grow with them."""

    def __init__(self) -> None:
        self._counts = np.zeros(NUM_KEYS, np.int64)
        self._near = 0

    def add(self, errors: Float[np.ndarray, " n"]) -> None:
        """Count errors: shares of the camera height, or infinity."""
        self._counts += np.bincount(histogram_keys(errors), minlength=NUM_KEYS)
        self._near += int(np.count_nonzero(errors <= NEAR_THRESHOLD))

    def merge(self, other: DepthErrors) -> None:
        """Add another's counts."""
        self._counts += other._counts
        self._near += other._near

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The counts that are not zero, for files."""
        keys = np.flatnonzero(self._counts)
        return {"keys": keys, "counts": self._counts[keys], "near": np.array(self._near)}

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> DepthErrors:
        """The inverse of `to_arrays`."""
        found = cls()
        found._counts[arrays["keys"]] = arrays["counts"]
        found._near = int(arrays["near"])
        return found

    @property
    def count(self) -> int:
        return int(self._counts.sum())

    def median(self) -> float | None:
        """To 1 in 2,000; of two in the middle the smaller. Infinite if more than half are; None without any."""
        if not self.count:
            return None
        middle = np.searchsorted(np.cumsum(self._counts), (self.count + 1) // 2)
        return float(histogram_values(np.array([middle]))[0])

    def near_share(self) -> float | None:
        """Of the errors, how many are at most NEAR_THRESHOLD; exact."""
        return self._near / self.count if self.count else None

    def within_share(self) -> float | None:
        """Of the errors, how many are at most WITHIN_THRESHOLD (to 1 in 2,000)."""
        end = int(histogram_keys(np.array([WITHIN_THRESHOLD]))[0]) + 1
        return int(self._counts[:end].sum()) / self.count if self.count else None


def compute_depth_errors(
    raster: Raster, true_depth: Float[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"], camera_height: float
) -> dict[str, Float[np.ndarray, " n"]]:
    """|depth - truth| / camera height at the covered pixels whose truth is known (not sky), by kind.

    `true_depth` is along the camera's axis, in the units of the model like `camera_height` (> 0), infinite for sky.
    A kind that the renderer does not know is left out.
    """
    counted = covered & np.isfinite(true_depth)
    alpha = raster.alpha.double().cpu().numpy()[counted]
    shown = alpha > MIN_ALPHA
    result = {}
    for kind, depth in zip(DEPTH_KINDS, (raster.depth, raster.median_depth), strict=True):
        if depth is None:
            continue
        depths = depth.double().cpu().numpy()[counted]
        if kind == "expected":
            depths = depths / np.where(shown, alpha, 1.0)
        result[kind] = np.where(shown, np.abs(depths - true_depth[counted]) / camera_height, np.inf)
    return result


def summarize_depth_errors(errors: Mapping[str, DepthErrors]) -> dict[str, float | None]:
    """The figures of METRIC_NAMES; None for a kind that is missing."""
    figures: dict[str, float | None] = dict.fromkeys(METRIC_NAMES)
    for kind, each in errors.items():
        figures[f"depth_error_median_{kind}"] = each.median()
        figures[f"depth_within_1_percent_{kind}"] = each.near_share()
        figures[f"depth_within_2_percent_{kind}"] = each.within_share()
    return figures
