"""Cameras, anchors and decoders for the tests of projection, culling and decoding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from vdgs.cameras import Camera, CameraModel
from vdgs.kernels.types import DecoderWeights


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
