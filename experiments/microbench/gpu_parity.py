"""Every operation on a card beside the same on the processor: pictures within 1e-4, gradients within 1e-3.

Differences are norms over the norm of the processor's result; of whole numbers, the share that differs: what lies at a
threshold may go either way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.microbench.step import scene
from vdgs.kernels import cuda, gsplat
from vdgs.kernels.gsplat import GsplatUnavailable
from vdgs.kernels.kernel_types import (
    AdamState,
    AnchorSplats,
    DecoderWeights,
    DensificationStats,
    SplatGradients,
    Splats,
)
from vdgs.kernels.operations import KernelBackend
from vdgs.kernels.torch_ref.ellipsoids import log_covariances
from vdgs.model.decoder import Decoder

#: Largest difference of a value, of a gradient and share of whole numbers that differ.
TOLERANCES = {"value": 1e-4, "gradient": 1e-3, "whole": 1e-3}
Results = dict[str, Tensor]


@dataclass(frozen=True)
class Difference:
    """How far a result of an operation is from that of the processor."""

    operation: str
    by: str
    result: str
    kind: str
    size: float

    @property
    def agrees(self) -> bool:
        return self.size <= TOLERANCES[self.kind]


class Place:
    """The same anchors, cameras and pictures on any device."""

    def __init__(self, device: torch.device, anchors: int, width: int, height: int):
        self.device, self.width, self.height = device, width, height
        made, self.camera = scene(anchors, width, height, hidden=anchors)
        self.anchors = made.to(device)
        self.weights: DecoderWeights = Decoder.init_random(10, False, 0, 1, generator()).to(device).weights
        self.target = torch.randint(256, (height, width, 3), generator=generator(), dtype=torch.uint8).to(device)
        self.mask = (torch.rand(height, width, generator=generator()) < 0.9).byte().to(device)
        self.background = torch.tensor([0.2, 0.3, 0.4]).to(device)

    def random(self, *shape: int, seed: int = 1) -> Tensor:
        """The same numbers on any device."""
        return torch.randn(shape, generator=generator(seed)).to(self.device)

    def decoded(self, kernels: KernelBackend, leaves: tuple[Tensor, ...] | None = None) -> tuple[Tensor, AnchorSplats]:
        a = self.anchors
        rows = kernels.cull(a.positions, a.log_scales, self.camera)
        features, offsets, log_scales = leaves or (a.features, a.offsets, a.log_scales)
        return rows, kernels.decode(a.positions, features, offsets, log_scales, self.weights, self.camera, rows)

    def splats(self) -> Splats:
        """Drawn numbers and not decoded ones: the same for every rasteriser."""
        count = 4 * len(self.anchors)
        g = generator(2)
        spread = 0.3 + 3 * torch.rand(count, generator=g) ** 4 * 10
        tensors = (
            torch.rand(count, 2, generator=g) * torch.tensor([float(self.width), float(self.height)]),
            torch.stack([1 / spread, 0.3 / spread, 1 / spread], dim=1),
            1 + torch.rand(count, generator=g), torch.rand(count, 3, generator=g), torch.rand(count, generator=g),
        )  # fmt: skip
        return Splats(*(tensor.to(self.device) for tensor in tensors))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cull(kernels: KernelBackend, place: Place) -> Results:
    rows = kernels.cull(place.anchors.positions, place.anchors.log_scales, place.camera)
    return {"whole rows": member(rows, len(place.anchors))}


def decode(kernels: KernelBackend, place: Place) -> Results:
    a = place.anchors
    leaves = tuple(t.detach().clone().requires_grad_(True) for t in (a.features, a.offsets, a.log_scales))
    rows, splats = place.decoded(kernels, leaves)
    count, k = len(a), a.offsets.shape[1]
    drawn = (rows[splats.source.long() // k] * k + splats.source.long() % k).detach()
    found: Results = {"whole splats": member(drawn, count * k)}
    loss: Any = 0.0
    for name in ("means_px", "conics", "colors", "opacities", "volumes"):
        values = getattr(splats, name)
        everywhere = values.new_zeros(count * k, *values.shape[1:])
        everywhere[drawn] = values.detach()
        found[name] = everywhere
        weight = place.random(count * k, *values.shape[1:])[drawn] * (0.01 if name == "means_px" else 1.0)
        loss = loss + (values * weight).sum()
    gradients = torch.autograd.grad(loss, leaves)
    return found | {f"gradient {i}": gradient for i, gradient in enumerate(gradients)}


def decode_to_train(kernels: KernelBackend, place: Place) -> Results:
    """Drawn in the order that splats are given with: where each of them stands is left to the card."""
    a = place.anchors
    rows = kernels.cull(a.positions, a.log_scales, place.camera)
    splats = kernels.decode_for_training(
        a.positions, a.features, a.offsets, a.log_scales, place.weights, place.camera, rows
    )
    raster, pullback = kernels.rasterize_vjp(splats, place.background, place.width, place.height)
    gradients = pullback(place.random(place.height, place.width, 3))
    count = torch.tensor([float(len(splats.source))])
    sums = torch.stack([gradients.colors.sum(), gradients.opacities.sum()])
    return {"image": raster.image, "volume": splats.volume, "splats": count, "gradients added up": sums}


def decode_backward_adam(kernels: KernelBackend, place: Place) -> Results:
    """First moments say what the gradients were; how far Adam moves says nothing where a gradient is near zero."""
    rows, splats = place.decoded(kernels)
    a, k = place.anchors, place.anchors.offsets.shape[1]
    drawn = rows[splats.source.long() // k] * k + splats.source.long() % k
    count = len(a) * k
    gradients = SplatGradients(
        means_px=0.01 * place.random(count, 2)[drawn], conics=place.random(count, 3)[drawn],
        colors=place.random(count, 3)[drawn], opacities=place.random(count)[drawn], volume=0.1, source=splats.source,
        color_values=splats.colors, opacity_values=splats.opacities,
    )  # fmt: skip
    states = [
        AdamState(t.clone(), torch.zeros_like(t), torch.zeros_like(t), 1e-3)
        for t in (a.features, a.offsets, a.log_scales)
    ]
    updates = torch.zeros(len(a), dtype=torch.int32).to(place.device)
    weights = place.weights.map(lambda t: t.detach().clone().requires_grad_(True))
    finite, of_weights = kernels.decode_backward_adam(
        a.positions, states, weights, place.camera, rows, gradients, updates
    )
    assert finite
    assert of_weights is not None
    moments = {f"gradient of moved {i}": state.first for i, state in enumerate(states)}
    decoder = {f"gradient of decoder {i}": gradient for i, gradient in enumerate(of_weights)}
    return moments | decoder | {"whole updates": updates}


def project(kernels: KernelBackend, place: Place) -> Results:
    a = place.anchors
    # Of different lengths: to turn a ball changes nothing, and the gradient would be all rounding.
    scales = (a.log_scales[:, :3] + 0.5 * place.random(len(a), 3, seed=4)).exp()
    leaves = tuple(
        t.detach().clone().requires_grad_(True) for t in (a.positions, scales, place.random(len(a), 4, seed=3))
    )
    found = kernels.project(*leaves, place.camera)
    values = {"means_px": found.means_px, "conics": found.conics, "depths": found.depths}
    loss = sum((t * place.random(*t.shape)).sum() for t in values.values())
    gradients = torch.autograd.grad(loss, leaves)
    named = {f"gradient {i}": gradient for i, gradient in enumerate(gradients)}
    return {name: t.detach() for name, t in values.items()} | {"whole valid": found.valid} | named


def rasterize(kernels: KernelBackend, place: Place) -> Results:
    """With depth, as pictures for people are drawn; median depth jumps from splat to splat."""
    raster = kernels.rasterize(place.splats(), place.background, place.width, place.height, depth=True)
    assert raster.depth is not None
    found = {"image": raster.image, "alpha": raster.alpha, "depth": raster.depth}
    return found if raster.median_depth is None else found | {"whole median depth": raster.median_depth}


def rasterize_vjp(kernels: KernelBackend, place: Place) -> Results:
    raster, pullback = kernels.rasterize_vjp(place.splats(), place.background, place.width, place.height)
    shape = (place.height, place.width)
    gradients = pullback(place.random(*shape, 3), place.random(*shape))._asdict()
    named = {f"gradient {name}": gradient for name, gradient in gradients.items() if gradient is not None}
    return {"image": raster.image, "alpha": raster.alpha} | named


def shares(kernels: KernelBackend, place: Place) -> Results:
    wanted = place.random(place.height, place.width, 3).sigmoid()
    return kernels.splat_contributions(place.splats(), place.background, place.width, place.height, wanted)._asdict()


def photometric_loss(kernels: KernelBackend, place: Place) -> Results:
    image = place.random(place.height, place.width, 3).sigmoid().requires_grad_(True)
    found = kernels.photometric_loss(image, place.target, place.mask)
    (gradient,) = torch.autograd.grad(found.loss, image)
    return {"loss": found.loss.detach(), "l1": found.l1, "ssim": found.ssim, "gradient": gradient}


def adam_rows(kernels: KernelBackend, place: Place) -> Results:
    features = place.anchors.features.clone()
    state = AdamState(features, torch.zeros_like(features), torch.zeros_like(features), 1e-2, lr_boost=5.0)
    rows = torch.arange(0, len(features), 3).to(place.device)
    step = (rows % 50 + 1).to(torch.int32)
    assert kernels.adam_rows(state, rows, place.random(len(rows), features.shape[1]), step)
    return {"parameter": state.parameter, "first": state.first, "second": state.second}


def add_view_statistics(kernels: KernelBackend, place: Place) -> Results:
    rows, splats = place.decoded(kernels)
    inside = kernels.mark_visible(place.anchors.positions[rows], place.camera)
    sums = DensificationStats.zeros(len(place.anchors), place.anchors.offsets.shape[1], place.device)
    by_px = splats.means_px * 1e-3
    kernels.add_view_statistics(
        sums, rows, inside, splats.source, splats.opacities, by_px, place.width, place.height
    )  # fmt: skip
    return sums.tensors()


def count_visibility(kernels: KernelBackend, place: Place) -> Results:
    return {"whole V": kernels.count_visibility(place.anchors.positions, [place.camera] * 3)}


def mark_visible(kernels: KernelBackend, place: Place) -> Results:
    return {"whole marks": kernels.mark_visible(place.anchors.positions, place.camera)}


def cell_keys(kernels: KernelBackend, place: Place) -> Results:
    return {"whole keys": keys_of(kernels, place)}


def cell_centers(kernels: KernelBackend, place: Place) -> Results:
    return {"centers": kernels.cell_centers(keys_of(kernels, place), 0.5, place.background)}


def group_cells(kernels: KernelBackend, place: Place) -> Results:
    unique, group = kernels.group_cells(keys_of(kernels, place))
    return {"whole keys": unique, "whole groups": group}


def group_max(kernels: KernelBackend, place: Place) -> Results:
    unique, group = kernels.group_cells(keys_of(kernels, place))
    return {"greatest": kernels.group_max(place.anchors.features, group, len(unique))}


def contains(kernels: KernelBackend, place: Place) -> Results:
    keys = keys_of(kernels, place)
    return {"whole": kernels.contains(keys[::2].contiguous(), keys)}


def morton_order(kernels: KernelBackend, place: Place) -> Results:
    return {"whole order": kernels.morton_order(place.anchors.positions)}


def keys_of(kernels: KernelBackend, place: Place) -> Tensor:
    return kernels.cell_keys(place.anchors.positions, 0.5, place.background)


def harmonic_colors(kernels: KernelBackend, place: Place) -> Results:
    means, count = place.anchors.positions, len(place.anchors)
    rows = torch.arange(0, count, 3).to(place.device)
    coefficients = place.random(count, 48)
    return {"colors": kernels.harmonic_colors(means[rows], coefficients, rows, place.background, 3)}


def fit_harmonics(kernels: KernelBackend, place: Place) -> Results:
    """Twenty pairs of each Gaussian, so that the third degree is known."""
    pairs = 20 * (len(place.anchors) // 20)
    directions = torch.nn.functional.normalize(place.random(pairs, 3), dim=1)
    starts = torch.arange(0, pairs, 20).to(place.device)
    weights = place.random(pairs).abs() + 0.1
    return {"coefficients": kernels.fit_harmonics(directions, place.random(pairs, 3, seed=2), weights, starts, 3, 1e-3)}


def mean_ellipsoids(kernels: KernelBackend, place: Place) -> Results:
    """Three pairs of each Gaussian. As logarithms: where two axes are alike, rounding names them."""
    pairs = 3 * (len(place.anchors) // 3)
    shapes = place.random(pairs, 3), place.random(pairs, 4, seed=2)
    starts = torch.arange(0, pairs, 3).to(place.device)
    return {"means": log_covariances(*kernels.mean_ellipsoids(*shapes, place.random(pairs).abs() + 0.1, starts))}


def member(rows: Tensor, count: int) -> Tensor:
    """Which of so many are among the rows."""
    found = torch.zeros(count, dtype=torch.bool).to(rows.device)
    found[rows] = True
    return found


#: By the name of the operation.
CASES: dict[str, Callable[[KernelBackend, Place], Results]] = {
    case.__name__: case
    for case in (
        adam_rows, add_view_statistics, cell_centers, cell_keys, contains, count_visibility, cull, decode,
        decode_to_train, decode_backward_adam, fit_harmonics, group_cells, group_max, harmonic_colors, mark_visible,
        mean_ellipsoids, morton_order, photometric_loss, project, rasterize, rasterize_vjp,
        shares,
    )
}  # fmt: skip


def differences(device: torch.device, anchors: int, width: int, height: int) -> Iterator[Difference]:
    """All results of all operations; those of the rasterisers by each of them."""
    from vdgs.kernels import cpu, gpu

    here, there = Place(torch.device("cpu"), anchors, width, height), Place(device, anchors, width, height)
    for name, case in CASES.items():
        expected = case(cpu, here)
        sets: dict[str, Any] = {"cuda": cuda, "gsplat": gsplat} if name.startswith("rasterize") else {"": gpu}
        for by, kernels in sets.items():
            with suppress(GsplatUnavailable):
                yield from compared(name, by, case(kernels, there), expected)


def compared(operation: str, by: str, found: Results, expected: Results) -> Iterator[Difference]:
    for name, value in found.items():
        kind = next((kind for kind in ("gradient", "whole") if name.startswith(kind)), "value")
        ours, theirs = value.detach().cpu(), expected[name].detach()
        if ours.shape != theirs.shape:
            size = float("inf")
        elif kind == "whole":
            size = float((ours != theirs).double().mean()) if ours.numel() else 0.0
        else:
            error, norm = ((t.double().norm()) for t in (ours.double() - theirs.double(), theirs))
            size = float(error / norm.clamp(min=1e-12))
        yield Difference(operation, by, name, kind, size if np.isfinite(size) else float("inf"))
