"""Random splats for the tests of the rasterizer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import pytest
import torch
from torch import Tensor

from vdgs.kernels.cpu.extension import load_extension
from vdgs.kernels.cpu.rasterize import rasterize
from vdgs.kernels.kernel_types import OrderedSplats, Raster, RasterPullback, Splats
from vdgs.kernels.splat_segments import SplatSegments


def assert_gradients_of_another_picture_are_refused(
    name: str, pullback_of: Callable[[Splats, Tensor], RasterPullback]
) -> None:
    """For a picture of 37x29 with depth: a smaller one's would be read beyond its end."""
    tail = (3,) if name == "image" else ()
    given = dict.fromkeys(("image", "alpha", "depth"))
    pullback = pullback_of(*splats_of([each.detach() for each in make_scene(9, 37, 29).tensors]))
    for shape in ((4, 4, *tail), (37, 29, *tail), (1, 29, 37, *tail)):
        with pytest.raises(ValueError, match=f"the gradient by {name} must have shape .29, 37"):
            pullback(**given | {name: torch.ones(shape)})
    with pytest.raises(TypeError, match=f"the gradient by {name} must be float32, not torch.float64"):
        pullback(**given | {name: torch.ones(29, 37, *tail, dtype=torch.float64)})


def assert_first_gradients_are_those_of_all(
    pullback: Callable[[], RasterPullback], splats: int, width: int, height: int
) -> None:
    """Assert that the way back of a picture gives the first splats the bits that it gives them among all."""
    g = torch.Generator().manual_seed(5)
    by_image, by_alpha = torch.randn(height, width, 3, generator=g), torch.randn(height, width, generator=g)
    whole = pullback()(by_image, by_alpha)
    for count in sorted({0, min(1, splats), splats // 30, splats // 3, splats}):
        room = torch.full((count, 2), torch.nan), torch.full((count, 3), torch.nan)
        *found, background = pullback()(by_image, by_alpha, out=room, count=count)
        assert found[0] is room[0]
        assert found[1] is room[1]
        assert torch.equal(background, whole.background)
        for few, all_of_them in zip(found, whole, strict=False):
            assert few is all_of_them is None or torch.equal(few, all_of_them[:count])


def splats_of(tensors: tuple[Tensor, ...]) -> tuple[Splats, Tensor]:
    """Splats and background from means, conics, colors, opacities, depths and background."""
    means, conics, colors, opacities, depths, background = tensors
    return Splats(means, conics, depths, colors, opacities), background


def in_runs(splats: Splats, runs: int, seed: int = 0) -> tuple[OrderedSplats, Tensor]:
    """The same splats in so many runs (one of them empty), which stand in any order, and where each splat went."""
    g, m = torch.Generator().manual_seed(seed), len(splats.means_px)
    cuts = torch.randint(0, m + 1, (runs - 2,), generator=g).sort()[0]
    ends = torch.cat([cuts, cuts[-1:], torch.tensor([m])])
    lengths = ends.diff(prepend=torch.zeros(1, dtype=ends.dtype))
    stand = torch.randperm(runs, generator=g)
    begins = torch.empty_like(lengths)
    begins[stand] = lengths[stand].cumsum(0) - lengths[stand]
    order = torch.cat([torch.arange(int(b), int(b + n)) for b, n in zip(begins, lengths, strict=True)])
    moved = {field.name: torch.empty_like(getattr(splats, field.name)) for field in fields(Splats)}
    for name, tensor in moved.items():
        tensor[order] = getattr(splats, name).detach()
    return OrderedSplats(**moved, segments=SplatSegments(begins.to(torch.int32), lengths.to(torch.int32))), order


@dataclass(frozen=True)
class Scene:
    tensors: tuple[Tensor, ...]
    width: int
    height: int

    def to(self, dtype: torch.dtype) -> Scene:
        tensors = tuple(t.detach().to(dtype).clone().requires_grad_() for t in self.tensors)
        return Scene(tensors, self.width, self.height)


def draw(scene: Scene, isa: str, depth: bool = True) -> Raster:
    return rasterize(*splats_of(scene.tensors), scene.width, scene.height, depth=depth, module=load_extension(isa))


def make_scene(
    n: int,
    width: int,
    height: int,
    seed: int = 0,
    size: float = 2.0,
    spread: float = 0.75,
    thinness: float = 0.6,
    opacity: float = 0.0,
    margin: float = 0.1,
) -> Scene:
    """Splats with log-normal sizes around `size` pixels, and opacities of logistic-normal distribution."""
    g = np.random.default_rng(seed)
    means = g.uniform([-margin * width, -margin * height], [(1 + margin) * width, (1 + margin) * height], (n, 2))
    sigma = np.exp(g.normal(np.log(size), spread, n))
    aspect = np.exp(np.abs(g.normal(0, thinness, n)))
    long, short = sigma * np.sqrt(aspect), sigma / np.sqrt(aspect)
    angle = g.uniform(0, np.pi, n)
    cos, sin = np.cos(angle), np.sin(angle)
    xx = (cos * long) ** 2 + (sin * short) ** 2 + 0.3
    xy = cos * sin * (long**2 - short**2)
    yy = (sin * long) ** 2 + (cos * short) ** 2 + 0.3
    conics = np.stack([yy, -xy, xx], 1) / (xx * yy - xy**2)[:, None]
    opacities = 1 / (1 + np.exp(-g.normal(opacity, 1.7, n)))
    arrays = (
        means,
        conics,
        g.uniform(0, 1, (n, 3)),
        opacities,
        g.uniform(1, 100, n),
        np.array([0.2, 0.3, 0.4]),
    )
    return Scene(tuple(torch.from_numpy(a).float() for a in arrays), width, height).to(torch.float32)


def weights_of(raster: Raster, seed: int = 1) -> list[Tensor]:
    g = torch.Generator().manual_seed(seed)
    # Depths run to 100: their weight is smaller, so that no part of the gradient drowns.
    return [
        torch.randn(t.shape, generator=g, dtype=torch.float64) * s
        for t, s in zip(smooth(raster), (1, 1, 0.05), strict=True)
    ]


def smooth(raster: Raster) -> tuple[Tensor, Tensor, Tensor]:
    """What gradients pass through: image, alpha and expected depth."""
    assert raster.depth is not None
    return raster.image, raster.alpha, raster.depth


def loss_of(raster: Raster) -> Tensor:
    return sum((t * w.to(t.dtype)).sum() for t, w in zip(smooth(raster), weights_of(raster), strict=True))


def assert_same_picture(actual: Raster, exact: Raster, tolerance: float) -> None:
    for a, e in zip(smooth(actual), smooth(exact), strict=True):
        assert_close(a, e, tolerance)
    # It jumps from splat to splat: where transmittance is one half but for rounding, either side is right.
    assert actual.median_depth is not None
    assert exact.median_depth is not None
    differs = actual.median_depth.double() != exact.median_depth.double()
    assert int(differs.sum()) <= differs.numel() // 1000


def assert_close(actual: Tensor, exact: Tensor, tolerance: float) -> None:
    """Close in the norm: a pixel at a threshold may go either way, and both are right."""
    error = (actual.detach().double() - exact.detach()).norm()
    assert error <= tolerance * exact.detach().norm().clamp(min=1e-6), f"relative error {error / exact.norm():.2e}"
