"""Every operation on a card beside the same on the processor: images within 1e-4, gradients within 1e-3.

Differences are norms over the norm of the processor's result; of whole numbers, the share that differs: what lies at a
threshold may go either way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.microbench import step
from vdgs.kernels import cuda, gsplat
from vdgs.kernels.gsplat import GsplatUnavailable
from vdgs.kernels.kernel_types import (
    SPLAT_TENSORS,
    AdamState,
    AnchorSplats,
    DecoderWeights,
    DensificationStats,
    MergedGaussians,
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
    backend: str
    result: str
    kind: str
    size: float

    @property
    def agrees(self) -> bool:
        return self.size <= TOLERANCES[self.kind]


class ParityScene:
    """The same anchors, cameras and pictures on any device."""

    def __init__(self, device: torch.device, anchors: int, width: int, height: int):
        self.device, self.width, self.height = device, width, height
        on_cpu, self.camera = step.scene(anchors, width, height, hidden=anchors)
        self.anchors = on_cpu.to(device)
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
        """Drawn numbers and not decoded ones: the same for every rasterizer."""
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


def cull(kernels: KernelBackend, scene: ParityScene) -> Results:
    rows = kernels.cull(scene.anchors.positions, scene.anchors.log_scales, scene.camera)
    return {"whole rows": row_mask(rows, len(scene.anchors))}


def decode(kernels: KernelBackend, scene: ParityScene) -> Results:
    a = scene.anchors
    leaves = tuple(t.detach().clone().requires_grad_(True) for t in (a.features, a.offsets, a.log_scales))
    rows, splats = scene.decoded(kernels, leaves)
    count, k = len(a), a.offsets.shape[1]
    drawn = (rows[splats.source.long() // k] * k + splats.source.long() % k).detach()
    results: Results = {"whole splats": row_mask(drawn, count * k)}
    loss: Any = 0.0
    for name in ("means_px", "conics", "colors", "opacities", "volumes"):
        values = getattr(splats, name)
        everywhere = values.new_zeros(count * k, *values.shape[1:])
        everywhere[drawn] = values.detach()
        results[name] = everywhere
        weight = scene.random(count * k, *values.shape[1:])[drawn] * (0.01 if name == "means_px" else 1.0)
        loss = loss + (values * weight).sum()
    gradients = torch.autograd.grad(loss, leaves)
    return results | {f"gradient {i}": gradient for i, gradient in enumerate(gradients)}


def decode_for_training(kernels: KernelBackend, scene: ParityScene) -> Results:
    """Drawn in the order that splats are given with: where each of them stands is left to the card."""
    a = scene.anchors
    rows = kernels.cull(a.positions, a.log_scales, scene.camera)
    splats = kernels.decode_for_training(
        a.positions, a.features, a.offsets, a.log_scales, scene.weights, scene.camera, rows
    )
    raster, pullback = kernels.rasterize_vjp(splats, scene.background, scene.width, scene.height)
    gradients = pullback(scene.random(scene.height, scene.width, 3))
    count = torch.tensor([float(len(splats.source))])
    sums = torch.stack([gradients.colors.sum(), gradients.opacities.sum()])
    return {"image": raster.image, "volume": splats.volume, "splats": count, "gradients added up": sums}


def decode_backward_adam(kernels: KernelBackend, scene: ParityScene) -> Results:
    """First moments say what the gradients were; how far Adam moves says nothing where a gradient is near zero."""
    rows, splats = scene.decoded(kernels)
    a, k = scene.anchors, scene.anchors.offsets.shape[1]
    drawn = rows[splats.source.long() // k] * k + splats.source.long() % k
    count = len(a) * k
    gradients = SplatGradients(
        means_px=0.01 * scene.random(count, 2)[drawn], conics=scene.random(count, 3)[drawn],
        colors=scene.random(count, 3)[drawn], opacities=scene.random(count)[drawn], volume=0.1, source=splats.source,
        color_values=splats.colors, opacity_values=splats.opacities, depths=scene.random(count, seed=2)[drawn],
    )  # fmt: skip
    states = [
        AdamState(t.clone(), torch.zeros_like(t), torch.zeros_like(t), 1e-3)
        for t in (a.features, a.offsets, a.log_scales)
    ]
    updates = torch.zeros(len(a), dtype=torch.int32).to(scene.device)
    weights = scene.weights.map(lambda t: t.detach().clone().requires_grad_(True))
    finite, of_weights = kernels.decode_backward_adam(
        a.positions, states, weights, scene.camera, rows, gradients, updates
    )
    assert finite
    assert of_weights is not None
    moments = {f"gradient of moved {i}": state.first for i, state in enumerate(states)}
    decoder = {f"gradient of decoder {i}": gradient for i, gradient in enumerate(of_weights)}
    return moments | decoder | {"whole updates": updates}


def project(kernels: KernelBackend, scene: ParityScene) -> Results:
    a = scene.anchors
    # Of different lengths: to turn a ball changes nothing, and the gradient would be all rounding.
    scales = (a.log_scales[:, :3] + 0.5 * scene.random(len(a), 3, seed=4)).exp()
    leaves = tuple(
        t.detach().clone().requires_grad_(True) for t in (a.positions, scales, scene.random(len(a), 4, seed=3))
    )
    projected = kernels.project(*leaves, scene.camera)
    values = {"means_px": projected.means_px, "conics": projected.conics, "depths": projected.depths}
    loss = sum((t * scene.random(*t.shape)).sum() for t in values.values())
    gradients = torch.autograd.grad(loss, leaves)
    named = {f"gradient {i}": gradient for i, gradient in enumerate(gradients)}
    return {name: t.detach() for name, t in values.items()} | {"whole valid": projected.valid} | named


def rasterize(kernels: KernelBackend, scene: ParityScene) -> Results:
    """With depth, as pictures for people are drawn; median depth jumps from splat to splat."""
    raster = kernels.rasterize(scene.splats(), scene.background, scene.width, scene.height, depth=True)
    assert raster.depth is not None
    results = {"image": raster.image, "alpha": raster.alpha, "depth": raster.depth}
    return results if raster.median_depth is None else results | {"whole median depth": raster.median_depth}


def rasterize_vjp(kernels: KernelBackend, scene: ParityScene) -> Results:
    raster, pullback = kernels.rasterize_vjp(scene.splats(), scene.background, scene.width, scene.height, depth=True)
    shape = (scene.height, scene.width)
    gradients = pullback(scene.random(*shape, 3), scene.random(*shape), scene.random(*shape, seed=2))._asdict()
    named = {f"gradient {name}": gradient for name, gradient in gradients.items() if gradient is not None}
    return {"image": raster.image, "alpha": raster.alpha} | named


def splat_contributions(kernels: KernelBackend, scene: ParityScene) -> Results:
    target = scene.random(scene.height, scene.width, 3).sigmoid()
    return kernels.splat_contributions(scene.splats(), scene.background, scene.width, scene.height, target)._asdict()


def photometric_loss_vjp(kernels: KernelBackend, scene: ParityScene) -> Results:
    image = scene.random(scene.height, scene.width, 3).sigmoid()
    found, gradient = kernels.photometric_loss_vjp(image, scene.target, None)
    return found._asdict() | {"gradient": gradient}


def photometric_loss(kernels: KernelBackend, scene: ParityScene) -> Results:
    image = scene.random(scene.height, scene.width, 3).sigmoid().requires_grad_(True)
    photometric = kernels.photometric_loss(image, scene.target, scene.mask)
    (gradient,) = torch.autograd.grad(photometric.loss, image)
    return {"loss": photometric.loss.detach(), "l1": photometric.l1, "ssim": photometric.ssim, "gradient": gradient}


def adam_rows(kernels: KernelBackend, scene: ParityScene) -> Results:
    features = scene.anchors.features.clone()
    state = AdamState(features, torch.zeros_like(features), torch.zeros_like(features), 1e-2, lr_boost=5.0)
    rows = torch.arange(0, len(features), 3).to(scene.device)
    step = (rows % 50 + 1).to(torch.int32)
    assert kernels.adam_rows(state, rows, scene.random(len(rows), features.shape[1]), step)
    return {"parameter": state.parameter, "first": state.first, "second": state.second}


def adam_tensors(kernels: KernelBackend, scene: ParityScene) -> Results:
    tensors = [scene.random(*shape) for shape in ((32, 35), (32,), (70, 32), (500, 12))]
    states = [AdamState(t.clone(), torch.zeros_like(t), torch.zeros_like(t), 1e-2) for t in tensors]
    assert kernels.adam_tensors(states, tensors, 3)
    return {f"{name} {i}": getattr(s, name) for i, s in enumerate(states) for name in ("parameter", "second")}


def add_view_statistics(kernels: KernelBackend, scene: ParityScene) -> Results:
    rows, splats = scene.decoded(kernels)
    inside = kernels.mark_visible(scene.anchors.positions[rows], scene.camera)
    sums = DensificationStats.zeros(len(scene.anchors), scene.anchors.offsets.shape[1], scene.device)
    by_px = splats.means_px * 1e-3
    kernels.add_view_statistics(
        sums, rows, inside, splats.source, splats.opacities, by_px, scene.width, scene.height
    )  # fmt: skip
    return sums.tensors()


def count_visibility(kernels: KernelBackend, scene: ParityScene) -> Results:
    return {"whole V": kernels.count_visibility(scene.anchors.positions, [scene.camera] * 3)}


def fade_factors(kernels: KernelBackend, scene: ParityScene) -> Results:
    """About a picture of half the size, beyond whose edge much lies."""
    small = replace(scene.camera, width=scene.camera.width // 2, height=scene.camera.height // 2)
    return {"factors": kernels.fade_factors(scene.anchors.positions, [small] * 3, 2, 0.15)}


def merged_splats(kernels: KernelBackend, scene: ParityScene) -> Results:
    """Of members about as large as the least that is drawn; those beside the picture may be left out."""
    a, count = scene.anchors, len(scene.anchors)
    std = scene.random(count, seed=3).abs()
    gaussians = MergedGaussians(
        a.positions, a.log_scales[:, :3], scene.random(count, 4), scene.random(count), scene.random(count, 3),
        scene.random(count, 3, 3), 1 + scene.random(count).abs(), scene.random(count, seed=2) - 12, std,
        0.1 * std[:, None] * scene.random(count, 3),
    )  # fmt: skip
    splats = kernels.merged_splats([gaussians], scene.camera)
    size = splats.means_px.new_tensor([scene.width, scene.height])
    drawn = (splats.opacities > 0.005) & ((splats.means_px > 0) & (splats.means_px < size)).all(1)
    values = {name: getattr(splats, name) for name in SPLAT_TENSORS}
    return {name: torch.where(drawn.view(-1, *[1] * (t.dim() - 1)), t, 0) for name, t in values.items()}


def mark_visible(kernels: KernelBackend, scene: ParityScene) -> Results:
    return {"whole marks": kernels.mark_visible(scene.anchors.positions, scene.camera)}


def cell_keys(kernels: KernelBackend, scene: ParityScene) -> Results:
    return {"whole keys": keys_of(kernels, scene)}


def cell_centers(kernels: KernelBackend, scene: ParityScene) -> Results:
    return {"centers": kernels.cell_centers(keys_of(kernels, scene), 0.5, scene.background)}


def group_cells(kernels: KernelBackend, scene: ParityScene) -> Results:
    unique, group = kernels.group_cells(keys_of(kernels, scene))
    return {"whole keys": unique, "whole groups": group}


def group_max(kernels: KernelBackend, scene: ParityScene) -> Results:
    unique, group = kernels.group_cells(keys_of(kernels, scene))
    return {"greatest": kernels.group_max(scene.anchors.features, group, len(unique))}


def contains(kernels: KernelBackend, scene: ParityScene) -> Results:
    keys = keys_of(kernels, scene)
    return {"whole": kernels.contains(keys[::2].contiguous(), keys)}


def morton_order(kernels: KernelBackend, scene: ParityScene) -> Results:
    return {"whole order": kernels.morton_order(scene.anchors.positions)}


def keys_of(kernels: KernelBackend, scene: ParityScene) -> Tensor:
    return kernels.cell_keys(scene.anchors.positions, 0.5, scene.background)


def harmonic_colors(kernels: KernelBackend, scene: ParityScene) -> Results:
    means, count = scene.anchors.positions, len(scene.anchors)
    rows = torch.arange(0, count, 3).to(scene.device)
    coefficients = scene.random(count, 48)
    return {"colors": kernels.harmonic_colors(means[rows], coefficients, rows, scene.background, 3)}


def fit_harmonics(kernels: KernelBackend, scene: ParityScene) -> Results:
    """Twenty pairs of each Gaussian, so that the third degree is known."""
    pairs = 20 * (len(scene.anchors) // 20)
    directions = torch.nn.functional.normalize(scene.random(pairs, 3), dim=1)
    starts = torch.arange(0, pairs, 20).to(scene.device)
    weights = scene.random(pairs).abs() + 0.1
    return {"coefficients": kernels.fit_harmonics(directions, scene.random(pairs, 3, seed=2), weights, starts, 3, 1e-3)}


def mean_ellipsoids(kernels: KernelBackend, scene: ParityScene) -> Results:
    """Three pairs of each Gaussian. As logarithms: where two axes are alike, rounding names them."""
    pairs = 3 * (len(scene.anchors) // 3)
    shapes = scene.random(pairs, 3), scene.random(pairs, 4, seed=2)
    starts = torch.arange(0, pairs, 3).to(scene.device)
    return {"means": log_covariances(*kernels.mean_ellipsoids(*shapes, scene.random(pairs).abs() + 0.1, starts))}


def row_mask(rows: Tensor, count: int) -> Tensor:
    """Which of so many are among the rows."""
    mask = torch.zeros(count, dtype=torch.bool).to(rows.device)
    mask[rows] = True
    return mask


#: By the name of the operation.
CASES: dict[str, Callable[[KernelBackend, ParityScene], Results]] = {
    case.__name__: case
    for case in (
        adam_rows, adam_tensors, add_view_statistics, cell_centers, cell_keys, contains, count_visibility, cull, decode,
        decode_for_training, decode_backward_adam, fade_factors, fit_harmonics, group_cells, group_max, harmonic_colors,
        mark_visible, mean_ellipsoids, merged_splats, morton_order, photometric_loss, photometric_loss_vjp, project,
        rasterize, rasterize_vjp, splat_contributions,
    )
}  # fmt: skip


def differences(device: torch.device, anchors: int, width: int, height: int) -> Iterator[Difference]:
    """All results of all operations; those of the rasterizers by each of them."""
    from vdgs.kernels import cpu, gpu

    on_cpu, on_device = (
        ParityScene(torch.device("cpu"), anchors, width, height),
        ParityScene(device, anchors, width, height),
    )
    for name, case in CASES.items():
        expected = case(cpu, on_cpu)
        sets: dict[str, Any] = {"cuda": cuda, "gsplat": gsplat} if name.startswith("rasterize") else {"": gpu}
        for backend, kernels in sets.items():
            with suppress(GsplatUnavailable):
                yield from compare(name, backend, case(kernels, on_device), expected)


def compare(operation: str, backend: str, results: Results, expected: Results) -> Iterator[Difference]:
    for name, value in results.items():
        kind = next((kind for kind in ("gradient", "whole") if name.startswith(kind)), "value")
        ours, theirs = value.detach().cpu(), expected[name].detach()
        if ours.shape != theirs.shape:
            size = float("inf")
        elif kind == "whole":
            size = float((ours != theirs).double().mean()) if ours.numel() else 0.0
        else:
            error, norm = ((t.double().norm()) for t in (ours.double() - theirs.double(), theirs))
            size = float(error / norm.clamp(min=1e-12))
        yield Difference(operation, backend, name, kind, size if np.isfinite(size) else float("inf"))
