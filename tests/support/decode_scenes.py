"""Cameras, anchors and decoders for the tests of projection, culling and decoding."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from vdgs.geometry.camera import Camera, CameraModel
from vdgs.kernels import cpu
from vdgs.kernels.kernel_types import AdamState, DecoderWeights, SplatGradients
from vdgs.kernels.splat_segments import SplatMask
from vdgs.kernels.torch_ref.project import project


def looking_down(model: CameraModel = "pinhole", width: int = 64, height: int = 48) -> Camera:
    """Ten units above the origin, looking straight down, x of the image along x of the world."""
    camera_from_world = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 10], [0, 0, 0, 1]])
    focal = 80.0 if model == "pinhole" else 8.0
    focal *= width / 64
    return Camera(
        camera_from_world=camera_from_world, fx=focal, fy=focal * 1.1, cx=width / 2 + 1, cy=height / 2 - 2, width=width,
        height=height, model=model,
    )  # fmt: skip


def turned(width: int = 64, height: int = 48) -> Camera:
    """An oblique view of the origin."""
    rng = np.random.default_rng(5)
    forward = np.array([0.6, 0.3, -0.74])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.1, 0.2, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation, -rotation @ (-9.0 * forward + 0.1 * rng.normal(size=3))
    return Camera(
        camera_from_world=rigid, fx=1.2 * width, fy=1.1 * width, cx=width / 2, cy=height / 2, width=width, height=height
    )


def near(camera: Camera) -> Camera:
    """The same view, nearer to a part of what it shows than the photographs were."""
    scale = 1.0 if camera.model == "orthographic" else 9.0
    return replace(camera, photograph_pixel=1.05 * scale / camera.fx)


@dataclass(frozen=True)
class Scene:
    """The arguments of `decode`, but for the camera."""

    positions: Tensor
    features: Tensor
    offsets: Tensor
    log_scales: Tensor
    weights: DecoderWeights

    @staticmethod
    def random(
        v: int,
        k: int = 10,
        *,
        with_distance: bool = False,
        seed: int = 0,
        spread: float = 3.0,
        log_scale: float = -1.5,
    ) -> Scene:
        """Anchors scattered about the origin, about half of their splats opaque; float32."""
        g = torch.Generator().manual_seed(seed)
        return Scene(
            positions=torch.randn(v, 3, generator=g) * torch.tensor([spread, spread, 1.0]),
            features=torch.randn(v, 32, generator=g),
            offsets=torch.randn(v, k, 3, generator=g),
            log_scales=0.5 * torch.randn(v, 6, generator=g) + log_scale,
            weights=DecoderWeights.random(k, with_distance, g),
        )

    @property
    def trainable(self) -> tuple[Tensor, ...]:
        """Features, offsets, log-scales and the twelve tensors of the decoder."""
        return (self.features, self.offsets, self.log_scales, *self.weights.tensors())

    def with_trainable(self, tensors) -> Scene:
        """The same scene with other trainable tensors."""
        features, offsets, log_scales, *weights = tensors
        return Scene(self.positions, features, offsets, log_scales, DecoderWeights.from_tensors(tuple(weights)))

    def to(self, dtype: torch.dtype, frozen: bool = False) -> Scene:
        """A copy in another precision, as leaves that require gradients (but the decoder, where frozen)."""
        tensors = [t.detach().to(dtype).clone() for t in self.trainable]
        for index, tensor in enumerate(tensors):
            tensor.requires_grad_(not frozen or index < 3)
        moved = self.with_trainable(tensors)
        return Scene(self.positions.to(dtype), moved.features, moved.offsets, moved.log_scales, moved.weights)

    @property
    def arguments(self) -> tuple:
        """What `decode` takes before the camera."""
        return self.positions, self.features, self.offsets, self.log_scales, self.weights


CAMERAS = [looking_down(), near(looking_down("orthographic")), turned(), near(turned().cropped(20, 5, 50, 40))]


def anchors(n: int, seed: int, spread: float = 8.0, log_scale: float = -1.0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return spread * torch.randn(n, 3, generator=g), torch.randn(n, 6, generator=g) + log_scale


def ellipse_touches_image(positions, log_scales, camera) -> torch.Tensor:
    """Whether the box around the projected 3-sigma ellipse (axes of the world) meets the image."""
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(positions), 4)
    projected = project(positions.double(), log_scales[:, :3].double().exp(), identity, camera)
    xx, xy, yy = projected.conics.unbind(-1)
    reach = 3 * torch.sqrt(torch.stack([yy, xx], -1) / (xx * yy - xy * xy)[:, None])
    size = torch.tensor([camera.width, camera.height])
    inside = (projected.means_px + reach > 1e-3) & (projected.means_px - reach < size - 1e-3)
    return projected.valid & inside.all(-1)


def view_statistics(seed: int, n: int = 3000, k: int = 7):
    """Arguments of `add_view_statistics`: what a view showed, and sums to add it to."""
    g = torch.Generator().manual_seed(seed)
    visible = torch.nonzero(torch.rand(n, generator=g) < 0.6)[:, 0]
    source = torch.nonzero(torch.rand(len(visible) * k, generator=g) < 0.4)[:, 0].int()
    m = len(source)
    sums = [torch.rand(n, k, generator=g), torch.rand(n, k, generator=g), torch.rand(n, generator=g), torch.rand(n)]
    inside = torch.rand(len(visible), generator=g) < 0.7
    return (visible, inside, source, torch.rand(m, generator=g), torch.randn(m, 2, generator=g), 400, 300), sums


def moved_by(
    kernels, scene: Scene, camera: Camera, rows: torch.Tensor, frozen: bool = False, spoil: bool = False,
    shown: SplatMask | None = None,
):  # fmt: skip
    """Whether all was finite, and after a step of Adam: parameters and moments, updates, gradients of the decoder.
    `shown`: where splats stand, if not in the order of the anchors."""
    with torch.no_grad():
        splats = cpu.decode(scene.positions, *scene.trainable[:3], scene.weights, camera, rows)
    g = torch.Generator().manual_seed(8)
    m = len(splats.source)
    gradients = SplatGradients(
        means_px=0.1 * torch.randn(m, 2, generator=g),
        conics=torch.randn(m, 3, generator=g),
        colors=torch.randn(m, 3, generator=g),
        opacities=torch.randn(m, generator=g),
        volume=0.3,
        source=splats.source,
        color_values=splats.colors,
        opacity_values=splats.opacities,
    )
    if spoil:
        gradients.means_px[0] = torch.nan
    if shown is not None:
        gradients = elsewhere(gradients, shown)
    states = [
        AdamState(t.clone(), 0.1 * torch.randn(t.shape, generator=g), torch.rand(t.shape, generator=g), rate, 4.0)
        for t, rate in zip(scene.trainable[:3], (0.01, 0.02, 0.005), strict=True)
    ]
    updates = (torch.arange(len(scene.positions)) ** 2 % 97).to(torch.int32)
    updates[3] = 30_000  # more than the tables tell apart
    weights = scene.weights.map(lambda t: t.clone().requires_grad_(not frozen))
    finite, found = kernels(scene.positions, states, weights, camera, rows, gradients, updates)
    return bool(finite), [t for state in states for t in state[:3]], updates, found


def elsewhere(gradients: SplatGradients, shown: SplatMask) -> SplatGradients:
    """Gradients of splats in their order, as those of splats that stand otherwise; what these looked like is lost."""
    order = shown.segments.order(len(shown))
    moved = {}
    for name in ("means_px", "conics", "colors", "opacities"):
        moved[name] = torch.empty_like(getattr(gradients, name))
        moved[name][order.long()] = getattr(gradients, name)
    nothing = {
        name: torch.full_like(getattr(gradients, name), torch.nan) for name in ("color_values", "opacity_values")
    }
    return replace(gradients, source=shown, **moved, **nothing)
