"""Consensus of blocks on the Gaussians that several of them hold, by ADMM: what DOGS adds to 3DGS.

Every block k has copies x of the Gaussians that it holds. Where more than one block holds a Gaussian, they are to agree
with the global one z: each block minimizes its own loss + rho / 2 |x + u - z|², then z becomes the mean of the copies
and every dual u grows by (1 + alpha) (x - z). Names of tensors are those of `Gaussians`; rho is one for each name.

Source: Chen and Lee, "DOGS: Distributed-Oriented Gaussian Splatting for Large-Scale 3D Reconstruction via Gaussian
Consensus", NeurIPS 2024, its section 4.2; Boyd, Parikh, Chu, Peleato and Eckstein, "Distributed Optimization and
Statistical Learning via the Alternating Direction Method of Multipliers", 2011 (sections 3.4.1 and 3.4.3), for the
values that neither the paper nor its program gives.

Dimensions: n Gaussians of the scene, m that a block holds, s of them shared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Int64
from torch import Tensor

from experiments.baselines.gs3d.density import max_scales
from vdgs.model.gaussians import Gaussians


@dataclass(frozen=True, kw_only=True)
class ConsensusConfig:
    """DOGS; "Boyd": the values that are usual."""

    interval: int = 100
    """Iterations of every block between two steps of consensus (program)."""
    over_relaxation: float = 0.5
    """alpha (Boyd: a factor of 1.5 to 1.8)."""
    mu: float = 10.0
    """A penalty changes where one residual is so many times the other (Boyd)."""
    tau: float = 2.0
    """Factor by which it changes (Boyd)."""
    adapt_until: float = 0.5
    """Share of the steps of consensus after which penalties stay (choice; the program stops too)."""
    penalty: float = 1.0
    """First penalties times the number of Gaussians: the loss is a mean over pixels, and what one Gaussian adds to it
    falls as there are more (program; its value: choice). Means are measured by the median size of the Gaussians."""


@dataclass(frozen=True, eq=False)
class BlockMembers:
    """What a block holds."""

    #: Rows of the scene's Gaussians, ascending; the block's own copies are in this order.
    rows: Int64[Tensor, " m"]
    #: Which of the block's copies other blocks hold too.
    shared: Int64[Tensor, " s"]


def find_members(held: Sequence[Tensor]) -> list[BlockMembers]:
    """From which of the n Gaussians each block holds (masks)."""
    holders = torch.stack(list(held)).sum(dim=0)
    return [BlockMembers(mask.nonzero()[:, 0], (holders[mask] > 1).nonzero()[:, 0]) for mask in held]


@dataclass
class Consensus:
    """The global Gaussians, duals and penalties."""

    config: ConsensusConfig
    members: Sequence[BlockMembers]
    #: z.
    gaussians: Gaussians
    #: rho, and what it was at first.
    rho: dict[str, float]
    first_rho: Mapping[str, float]
    #: u of the shared copies of each block.
    duals: list[dict[str, Tensor]]
    #: The last residuals, for people: |x - z| and rho |z - z before| by name.
    residuals: dict[str, tuple[float, float]] = field(default_factory=dict)

    @staticmethod
    def begin(gaussians: Gaussians, members: Sequence[BlockMembers], config: ConsensusConfig) -> Consensus:
        """Before the first step: every copy is the global Gaussian, duals are 0."""
        n, size = max(len(gaussians), 1), float(max_scales(gaussians).median()) if len(gaussians) else 1.0
        rho = dict.fromkeys(gaussians.tensors(), config.penalty / n)
        rho["means"] /= size**2
        duals = [
            {name: torch.zeros_like(tensor[each.rows[each.shared]]) for name, tensor in gaussians.tensors().items()}
            for each in members
        ]
        return Consensus(config, members, gaussians, rho, dict(rho), duals)

    def move_to(self, device: str) -> None:
        """Go on on a device."""
        self.gaussians = self.gaussians.to(device)
        self.members = [BlockMembers(each.rows.to(device), each.shared.to(device)) for each in self.members]
        self.duals = [{name: tensor.to(device) for name, tensor in each.items()} for each in self.duals]

    def pull(self, index: int, copies: Gaussians) -> dict[str, Tensor]:
        """The gradient of the penalty of a block by its copies: rho (x + u - z) where they are shared, else 0."""
        each, pulled = self.members[index], {}
        for name, tensor in copies.tensors().items():
            apart = tensor[each.shared] + self.duals[index][name] - self._global(name, each)
            pulled[name] = torch.zeros_like(tensor).index_copy_(0, each.shared, self.rho[name] * apart)
        return pulled

    def step(self, copies: Sequence[Gaussians], *, adapt: bool) -> None:
        """z becomes the mean of the copies, duals follow and, with `adapt`, penalties."""
        before, self.gaussians = self.gaussians, mean_gaussians(self.gaussians, copies, self.members)
        relaxed = 1 + self.config.over_relaxation
        for name in self.rho:
            primal, moved = 0.0, self.gaussians.tensors()[name] - before.tensors()[name]
            for index, each in enumerate(self.members):
                apart = copies[index].tensors()[name][each.shared] - self._global(name, each)
                self.duals[index][name] += relaxed * apart
                primal += float(apart.square().sum())
            shared = torch.cat([each.rows[each.shared] for each in self.members]).unique()
            dual = self.rho[name] / self.first_rho[name] * float(moved[shared].square().sum()) ** 0.5
            self.residuals[name] = (primal**0.5, dual)
            if adapt:
                self._adapt(name)

    def _global(self, name: str, each: BlockMembers) -> Tensor:
        return self.gaussians.tensors()[name][each.rows[each.shared]]

    def _adapt(self, name: str) -> None:
        """A larger penalty where the copies are far from agreeing, a smaller one where the global Gaussians run away
        (Boyd, section 3.4.1). Duals are in units of 1 / rho, and change with it."""
        primal, dual = self.residuals[name]
        factor = 1.0
        if primal > self.config.mu * dual:
            factor = self.config.tau
        elif dual > self.config.mu * primal:
            factor = 1 / self.config.tau
        self.rho[name] *= factor
        for of_block in self.duals:
            of_block[name] /= factor


def mean_gaussians(before: Gaussians, copies: Sequence[Gaussians], members: Sequence[BlockMembers]) -> Gaussians:
    """Every Gaussian as the blocks that hold it have it on average; one that a single block holds keeps its bits, one
    that none holds stays."""
    means = {}
    for name, tensor in before.tensors().items():
        mean, total, count = tensor.clone(), torch.zeros_like(tensor), tensor.new_zeros(len(tensor))
        for copy, each in zip(copies, members, strict=True):
            x = copy.tensors()[name]
            mean[each.rows] = x
            total.index_add_(0, each.rows, x)
            count[each.rows] += 1
        several = (count > 1).nonzero()[:, 0]
        divisor = count[several].reshape(-1, *[1] * (tensor.ndim - 1))
        means[name] = mean.index_copy_(0, several, total[several] / divisor)
    return Gaussians(**means)
