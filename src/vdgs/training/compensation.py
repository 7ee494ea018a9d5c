"""Compensated anchor growth: gradients of positions that few cameras see are cached and added (VDGS section IV-C).

Dimensions: n anchors, k offsets. At the end of a growth cycle (between two growth decisions), `densify` calls:

    low, threshold = low_visibility_mask(ratio, config)                      # eq. 8's c_k -> the set L, eq. 9
    compensated = close_cycle(compensation, statistics, low, threshold, growth, config)     # g_k, eq. 10
    decide_densification(..., compensated=compensated)                       # grows; resets what was judged
    begin_cycle(compensation, statistics)                                    # the next cycle counts from here

c_k belongs to the source anchor, hence L is a set of anchors; g_k belongs to the offset.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.config.method import CompensationConfig, DensifyConfig
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.training.densification import CompensatedGradient, DensificationDecision

#: An offset of low visibility is judged only when it was drawn more often than this (choice).
MIN_SCALED_DRAWS = 2.0


@dataclass
class CompensationState:
    """The state of each offset that lasts over cycles (float32). The statistics at the begin of a cycle are kept, since
    the statistics carry over until they are judged: the sums of a cycle are a difference."""

    #: The cache g_k, a gradient norm in NDC units.
    cache: Float[Tensor, "n k"]
    #: `Statistics.gradient` and `.drawn` when the cycle began.
    gradient_before: Float[Tensor, "n k"]
    drawn_before: Float[Tensor, "n k"]

    @staticmethod
    def zeros(n: int, k: int, device: torch.device | str = "cpu") -> CompensationState:
        return CompensationState(*(torch.zeros(n, k, device=device, dtype=torch.float32) for _ in range(3)))

    def tensors(self) -> dict[str, Tensor]:
        return {item.name: getattr(self, item.name) for item in fields(self)}


def low_visibility_mask(ratio: Float[Tensor, " n"], config: CompensationConfig) -> tuple[Bool[Tensor, " n"], float]:
    """The set L = {c_k < T_low} of anchors, and the T_low used.

    `ratio` is c_k: the share in [0, 1] of the cycle's cameras whose frustum holds the anchor. With `t_low_quantile`
    above 0, T_low is that quantile of the shares above 0. Where many anchors have a share of exactly T_low, L takes all
    anchors up to the share at which its size is nearest to the quantile (choice; of two as near the larger).
    """
    if config.t_low_quantile <= 0:
        return ratio < config.t_low, config.t_low
    some = ratio[ratio > 0].cpu().numpy()
    if not len(some):
        return torch.zeros_like(ratio, dtype=torch.bool), 0.0
    # Not torch.quantile, which refuses more than 16 million numbers.
    return ratio <= _highest_of(some, config.t_low_quantile), float(np.quantile(some, config.t_low_quantile))


def _highest_of(shares: Float[np.ndarray, " s"], quantile: float) -> float:
    """The highest share in the set of lowest ones whose size is nearest to the quantile; 0 if that set is empty."""
    values, counts = np.unique(shares, return_counts=True)
    sizes = np.concatenate([[0], np.cumsum(counts)])
    off = np.abs(sizes - quantile * len(shares))
    nearest = int(np.flatnonzero(off == off.min())[-1])
    return float(values[nearest - 1]) if nearest else 0.0


def begin_cycle(compensation: CompensationState, statistics: DensificationStats) -> None:
    """From here on the statistics count for the next cycle. To be called after the resets of a decision.

    Raises ValueError if the two do not describe the same offsets.
    """
    _check_aligned(compensation, statistics)
    compensation.gradient_before.copy_(statistics.gradient)
    compensation.drawn_before.copy_(statistics.drawn)


def cycle_gradient(compensation: CompensationState, statistics: DensificationStats) -> Float[Tensor, "n k"]:
    """The mean gradient norm of each offset over the times it was drawn in this cycle; 0 where it was not."""
    _check_aligned(compensation, statistics)
    times = (statistics.drawn - compensation.drawn_before).clamp_(min=1)
    return (statistics.gradient - compensation.gradient_before).div_(times)


def update_cache(
    compensation: CompensationState, statistics: DensificationStats, low: Bool[Tensor, " n"], config: CompensationConfig
) -> None:
    """End of a cycle, in place (eq. 10): g_k <- gamma g_k + beta_g times the cycle's mean gradient for k in L.

    The others only decay, so that what was poorly seen once is not compensated for ever. To be called before
    the decision, which resets statistics.
    """
    fed = cycle_gradient(compensation, statistics).mul_(config.beta_g).mul_(low[:, None])
    # Two operations: one fused multiply-add would round differently where vector and remainder code differ.
    compensation.cache.mul_(config.gamma).add_(fed)


def close_cycle(
    compensation: CompensationState,
    statistics: DensificationStats,
    low: Bool[Tensor, " n"],
    threshold: float,
    growth: DensifyConfig,
    config: CompensationConfig,
) -> CompensatedGradient:
    """End of a cycle: `update_cache` and `compensate`, in the order of `config.history`.

    `past`: what is added is g_k as the cycle before left it, 0 in the first cycle.
    """
    if config.history == "past":
        added = compensate(compensation, low, threshold, growth, config)
        update_cache(compensation, statistics, low, config)
        return added
    update_cache(compensation, statistics, low, config)
    return compensate(compensation, low, threshold, growth, config)


def compensate(
    compensation: CompensationState,
    low: Bool[Tensor, " n"],
    threshold: float,
    growth: DensifyConfig,
    config: CompensationConfig,
) -> CompensatedGradient:
    """What this cycle's decision adds to the gradients, to their mean or their sum, and from when on it judges offsets
    of L.

    Gate `scaled` (choice): T_low times the plain gate, but at least twice and never more than the plain gate.
    `threshold` is the T_low that `low_visibility_mask` used.
    """
    plain = growth.min_draw_fraction * growth.every
    gate = plain if config.min_draws == "paper" else min(plain, max(MIN_SCALED_DRAWS, threshold * plain))
    return CompensatedGradient(compensation.cache * low[:, None], low, gate, to_sum=config.target == "sum")


def cycle_log(
    compensated: CompensatedGradient,
    ratio: Float[Tensor, " n"],
    threshold: float,
    decision: DensificationDecision,
    config: CompensationConfig,
) -> dict[str, float | None]:
    """Numbers of one cycle for the log.

    `low_share`: share of the anchors in L; `low_share_of_seen`: the same of those that a camera of the cycle sees;
    `t_low`: the threshold used; `mean_cache`, `max_cache`: g over the offsets of L (null where L is empty);
    `grown_low`, `grown_other`: new anchors in cells with a parent in L, and the others; `pruned`: anchors removed.
    """
    low, offsets = int(compensated.low.sum()), compensated.added.shape[1]
    seen = ratio > 0
    added = compensated.added.cpu().numpy()  # numpy sums in one order for any number of threads
    return {
        "low_share": low / max(len(compensated.low), 1),
        "low_share_of_seen": int((compensated.low & seen).sum()) / max(int(seen.sum()), 1),
        "t_low": threshold,
        "mean_cache": float(added.sum(dtype=np.float64)) / (low * offsets) if low else None,
        "max_cache": float(added.max()) if low else None,
        "grown_low": decision.grown_low,
        "grown_other": decision.grown_other,
        "pruned": decision.pruned,
    }


def _check_aligned(compensation: CompensationState, statistics: DensificationStats) -> None:
    if compensation.cache.shape != statistics.drawn.shape:
        raise ValueError(
            f"compensation is kept of {list(compensation.cache.shape)} offsets, "
            f"statistics of {list(statistics.drawn.shape)}"
        )
