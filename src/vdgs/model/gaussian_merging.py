"""Fewer Gaussians that look like many: which neighbors join (`group_neighbors`), and what they become together.

A group becomes the Gaussian that has its weight, mean and covariance: the spread within its members and that of their
centers. A weight is opacity times area, what a Gaussian covers seen from its broad side, unless the caller knows what
cameras see of it. Neighbors join in pairs, the cheapest of the whole scene first. A pair costs what the mixture loses
by it (Runnalls' bound of the Kullback-Leibler divergence, "Kullback-Leibler approach to Gaussian mixture reduction",
IEEE TAES 43(3), 2007) and what the colors lose (Ward's sum of squares), both by weight: what covers little, or has
neighbors of its own color on its own surface, goes first; a roof's edge and a red car on a gray road go late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.kernels.spherical_harmonics import SH_C0
from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import AnyGaussians, Gaussians, NodeGaussians

#: Opacities of merged Gaussians end here, as those that are drawn do.
MAX_OPACITY = 0.999
#: No more surfaces than so many are counted behind each other (`NodeGaussians`).
MAX_COVERS = 1e4
#: Merged Gaussians are enlarged so much at most where they would cover less than their members.
MAX_ENLARGED = 2.0
#: Of so many nearest neighbors each Gaussian may join one in a pass.
NEIGHBORS = 5
#: A pass joins at most this part of the Gaussians that are left: what is dear now may be cheaper for the next pass.
PASS_SHARE = 0.2
#: How much a squared difference of colors, RGB in 0 .. 1, counts against the lost shape (in nats).
COLOR_WEIGHT = 40.0
#: Gaussians count at least this part of the median size thick: no more of a flat one can be seen.
MIN_THICKNESS = 0.1
#: Pairs are priced so many at a time.
CHUNK = 1 << 17


def merge_by_moments(
    gaussians: AnyGaussians, groups: Int[np.ndarray, " n"], weights: Float[np.ndarray, " n"] | None = None,
    enlarge: float = MAX_ENLARGED,
) -> AnyGaussians:  # fmt: skip
    """One Gaussian for each group, in the order of their numbers, 0 .. the number of groups - 1, none empty.

    Weight, mean and covariance of a group are conserved, coefficients of color are its weighted means. So is what it
    covers, opacity times area: where an opaque Gaussian of this covariance covers less, as on a closed surface, it is
    larger, up to `enlarge` times, and `NodeGaussians` keep what is still missing. What is alone in its group stays as
    it is.
    """
    pool = _Pool.of(gaussians, groups, weights)
    means = pool.mean(gaussians.means)
    apart = gaussians.means.double() - means[pool.groups]
    spread = pool.mean(gaussian_covariances(gaussians).double() + apart[:, :, None] * apart[:, None, :])
    log_scales, quaternions = ellipsoid_axes(spread)
    colors = gaussians.color_weight if isinstance(gaussians, NodeGaussians) else None
    together = Gaussians(
        means=means, log_scales=log_scales, quaternions=quaternions, opacity_logits=means[:, 0],
        sh0=pool.mean(gaussians.sh0, colors), shN=pool.mean(gaussians.shN, colors),
    )  # fmt: skip
    opacity = pool.sum(torch.from_numpy(gaussian_weights(gaussians))) / _areas(together)
    larger = (opacity / MAX_OPACITY).clamp(1, enlarge**2)
    merged = together.tensors() | {
        "opacity_logits": torch.logit((opacity / larger).clamp(1e-6, MAX_OPACITY)),
        "log_scales": log_scales + larger.log()[:, None] / 2,
    }
    if isinstance(gaussians, NodeGaussians):
        merged |= _merged_members(gaussians, pool)
        merged["covers"] = (opacity / larger / MAX_OPACITY).clamp(1, MAX_COVERS)
    first = gaussians.select(pool.first)
    return replace(gaussians, **{
        name: torch.where(pool.alone.reshape(-1, *[1] * (value.dim() - 1)), first.tensors()[name], value.float())
        for name, value in merged.items()
    })  # fmt: skip


def single_members(gaussians: Gaussians, color_weights: Float[np.ndarray, " n"] | None = None) -> NodeGaussians:
    """Gaussians to be merged, each of which stands for itself alone. Their colors count by their weights, times
    `color_weights` where given."""
    one = torch.ones(len(gaussians), dtype=torch.float32, device="cpu")
    return NodeGaussians(
        **gaussians.tensors(), covers=one, log_weight_mean=torch.from_numpy(gaussian_weights(gaussians)).log().float(),
        log_weight_std=0 * one, color_weight=one if color_weights is None else torch.from_numpy(color_weights).float(),
        sh0_log_weight_cov=torch.zeros_like(gaussians.sh0),
    )  # fmt: skip


def _merged_members(gaussians: NodeGaussians, pool: _Pool) -> dict[str, Tensor]:
    """What merged Gaussians know of the members of all."""
    mean = pool.mean(gaussians.log_weight_mean)
    apart = gaussians.log_weight_mean.double() - mean[pool.groups]
    std = pool.mean(gaussians.log_weight_std.double() ** 2 + apart**2).sqrt()
    shifted = gaussians.sh0.double() - pool.mean(gaussians.sh0)[pool.groups]
    cov = pool.mean(gaussians.sh0_log_weight_cov.double() + shifted * apart[:, None])
    return {
        "log_weight_mean": mean, "log_weight_std": std, "color_weight": pool.mean(gaussians.color_weight),
        "sh0_log_weight_cov": cov,
    }  # fmt: skip


@dataclass(frozen=True)
class _Pool:
    """The m groups of n Gaussians, and how much each Gaussian weighs in its own."""

    groups: Int64[Tensor, " n"]
    #: The Gaussians in the order of their groups; where each group begins there, and its first member.
    order: Int64[Tensor, " n"]
    starts: Int[np.ndarray, " m"]
    first: Int64[Tensor, " m"]
    #: Whether a group has one member.
    alone: Bool[Tensor, " m"]
    #: Of the weight of the group, in that order.
    shares: Float[np.ndarray, " n"]

    @staticmethod
    def of(gaussians: Gaussians, groups: Int[np.ndarray, " n"], weights: Float[np.ndarray, " n"] | None) -> _Pool:
        order = np.argsort(groups, kind="stable")
        starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
        sizes = np.diff(starts, append=len(order))
        weights = gaussian_weights(gaussians) if weights is None else np.maximum(weights, 1e-30)
        shares = weights[order] / np.repeat(np.add.reduceat(weights[order], starts), sizes)
        rows = torch.from_numpy(order)
        return _Pool(
            torch.from_numpy(groups).long(), rows, starts, rows[torch.from_numpy(starts)],
            torch.from_numpy(sizes == 1), shares,
        )  # fmt: skip

    def sum(self, values: Float[Tensor, " n *c"]) -> Float[Tensor, " m *c"]:
        """The sum of each group, in float64."""
        return torch.from_numpy(np.add.reduceat(values[self.order].double().numpy(), self.starts))

    def mean(self, values: Float[Tensor, " n *c"], also: Float[Tensor, " n"] | None = None) -> Float[Tensor, " m *c"]:
        """The mean of each group by weight, in float64; by weight times `also` where given."""
        shares = self.shares if also is None else self.shares * also[self.order].double().numpy()
        flat = values.reshape(len(values), -1)[self.order].double().numpy()
        sums = np.add.reduceat(flat * shares[:, None], self.starts)
        if also is not None:
            sums /= np.add.reduceat(shares, self.starts)[:, None]
        return torch.from_numpy(sums.reshape(len(self.starts), *values.shape[1:]))


def merge_to(gaussians: Gaussians, max_count: int) -> tuple[Gaussians, float]:
    """At most so many Gaussians that look like these from afar, and how wide they merged: the edge of the squares that
    would scatter what they hold as widely, by weight. 0 where nothing had to be merged."""
    if len(gaussians) <= max_count:
        return gaussians, 0.0
    groups, weights = group_neighbors(gaussians, max_count), gaussian_weights(gaussians)
    merged = merge_by_moments(gaussians, groups, weights)
    apart = (gaussians.means.double() - merged.means.double()[torch.from_numpy(groups)]).square().sum(1).numpy()
    return merged, float(np.sqrt(6 * np.average(apart, weights=weights)))


def gaussian_weights(gaussians: Gaussians) -> Float[np.ndarray, " n"]:
    """Opacity times area of each, or what its members cover; never 0."""
    opacities = gaussians.opacity_logits.double().sigmoid()
    if isinstance(gaussians, NodeGaussians):
        opacities = opacities * gaussians.covers
    return np.maximum((opacities * _areas(gaussians)).numpy(), 1e-30)


def _areas(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """Product of the two largest standard deviations: what a Gaussian covers, seen from its broad side."""
    return gaussians.log_scales.double().topk(2, dim=-1).values.sum(-1).exp()


def ellipsoid_axes(spread: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Logarithms of the standard deviations and rotations (wxyz) of covariances."""
    variances, axes = torch.linalg.eigh(spread)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    least = variances[:, -1:].clamp_min(1e-18) * 1e-8
    return variances.clamp_min(least).log() / 2, _quaternions(axes)


def _quaternions(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions, wxyz, of rotation matrices, by the largest of the four (Shepperd, 1978)."""
    m = rotations.numpy()
    trace = np.trace(m, axis1=1, axis2=2)
    squares = np.stack([1 + trace, *(1 + 2 * m[:, i, i] - trace for i in range(3))], 1)
    largest = squares.argmax(1)
    parts = np.empty((len(m), 4, 4))
    parts[:, range(4), range(4)] = squares
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0)), 1):
        parts[:, 0, k] = parts[:, k, 0] = m[:, i, j] - m[:, j, i]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        parts[:, a + 1, b + 1] = parts[:, b + 1, a + 1] = m[:, a, b] + m[:, b, a]
    chosen = parts[np.arange(len(m)), largest]
    return torch.from_numpy(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))


def group_neighbors(
    gaussians: Gaussians, max_count: int, weights: Float[np.ndarray, " n"] | None = None
) -> Int[np.ndarray, " n"]:
    """The group of each, 0 .. `max_count` - 1, where there are more Gaussians than that; else each its own.

    Deterministic. Memory: about 0.5 kB for each Gaussian. Groups are numbered by their first members.
    """
    if max_count < 1:
        raise ValueError("at least one Gaussian must be left")
    groups = np.arange(len(gaussians))
    if len(gaussians) <= max_count:
        return groups
    mixture = _Mixture.of(gaussians, weights)
    while (count := len(mixture.weights)) > max_count:
        first, second = mixture.cheapest_pairs(min(count - max_count, max(int(PASS_SHARE * count), 1)))
        numbers = np.arange(count)
        numbers[second] = first
        kept, numbers = np.unique(numbers, return_inverse=True)
        mixture, groups = mixture.joined(first, second, kept), numbers[groups]
    return groups


class _Mixture:
    """What is left of a scene while pairs join: weights, means, covariances (upper triangles) and colors."""

    def __init__(
        self, weights: Float[np.ndarray, " n"], means: Float[np.ndarray, "n 3"], spread: Float[np.ndarray, "n 6"],
        colors: Float[np.ndarray, "n 3"],
    ) -> None:  # fmt: skip
        self.weights, self.means, self.spread, self.colors = weights, means, spread, colors
        self.log_dets = _log_det(spread)

    @staticmethod
    def of(gaussians: Gaussians, weights: Float[np.ndarray, " n"] | None) -> _Mixture:
        weights = gaussian_weights(gaussians) if weights is None else np.maximum(weights, 1e-30)
        spread = gaussian_covariances(gaussians).numpy().reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].astype(np.float64)
        thickness = MIN_THICKNESS * float(gaussians.log_scales.amax(1).median().exp())
        spread[:, [0, 3, 5]] += thickness**2
        colors = SH_C0 * gaussians.sh0.double().numpy()
        return _Mixture(weights.astype(np.float64), gaussians.means.double().numpy(), spread, colors)

    def cheapest_pairs(self, most: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """At most so many pairs of neighbors, the cheapest, none in two of them; at least one.

        Each proposes to the neighbor with whom it loses least. A pair is made where neither has a better proposal.
        """
        count = len(self.means)
        partner, cost = np.empty(count, np.int64), np.full(count, np.inf)
        tree = cKDTree(self.means)
        for start in range(0, count, CHUNK):
            own = np.arange(start, min(start + CHUNK, count))
            for near in tree.query(self.means[own], min(NEIGHBORS + 1, count))[1].T:
                price = np.where(near == own, np.inf, self._cost(own, near))
                better = own[price < cost[own]]
                partner[better], cost[better] = near[better - start], price[better - start]
        least = cost.copy()
        np.minimum.at(least, partner, cost)
        made = np.flatnonzero((cost == least) & (cost == least[partner]))
        order = made[np.argsort(cost[made], kind="stable")]
        first, second = np.minimum(order, partner[order]), np.maximum(order, partner[order])
        # Where several pairs cost the same, the first of each member is made.
        places = np.full(count, len(order))
        np.minimum.at(places, first, np.arange(len(order)))
        np.minimum.at(places, second, np.arange(len(order)))
        chosen = np.flatnonzero((places[first] == np.arange(len(order))) & (places[second] == np.arange(len(order))))
        return first[chosen[:most]], second[chosen[:most]]

    def _cost(self, first: Int[np.ndarray, " e"], second: Int[np.ndarray, " e"]) -> Float[np.ndarray, " e"]:
        """What is lost where pairs join."""
        a, b = self.weights[first], self.weights[second]
        apart = self.colors[first] - self.colors[second]
        color = a * b / (a + b) * (apart * apart).sum(1)
        loss = (a + b) * _log_det(self._pooled_spread(first, second))
        loss -= a * self.log_dets[first] + b * self.log_dets[second]
        return loss / 2 + COLOR_WEIGHT * color

    def _pooled_spread(self, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]) -> Float[np.ndarray, "p 6"]:
        a, b = self.weights[first][:, None], self.weights[second][:, None]
        apart = self.means[first] - self.means[second]
        between = apart[:, [0, 0, 0, 1, 1, 2]] * apart[:, [0, 1, 2, 1, 2, 2]]
        share = a / (a + b)
        pooled: np.ndarray = share * self.spread[first] + (1 - share) * (self.spread[second] + share * between)
        return pooled

    def joined(
        self, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"], kept: Int[np.ndarray, " m"]
    ) -> _Mixture:
        """The mixture with each second in its first, of which the given rows are left."""
        spread = self._pooled_spread(first, second)
        a, b = self.weights[first, None], self.weights[second, None]
        for values in (self.means, self.colors):
            values[first] = (a * values[first] + b * values[second]) / (a + b)
        self.spread[first] = spread
        self.weights[first] += self.weights[second]
        return _Mixture(*(each[kept] for each in (self.weights, self.means, self.spread, self.colors)))


def _log_det(spread: Float[np.ndarray, "e 6"]) -> Float[np.ndarray, " e"]:
    xx, xy, xz, yy, yz, zz = spread.T
    return np.log(np.maximum(xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz), 1e-300))
