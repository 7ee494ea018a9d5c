"""Pictures for the tests of the photometric loss."""

from __future__ import annotations

import cv2
import numpy as np
import torch


def scene(height: int, width: int, seed: int = 0, kept: float | None = None):
    """A smooth picture, the same with noise, and a mask."""
    generator = np.random.default_rng(seed)
    base = cv2.GaussianBlur(generator.random((height, width, 3)), (0, 0), 2.0).reshape(height, width, 3)
    base = (base - base.min()) / max(np.ptp(base), 1e-3)
    noisy = np.clip(base + generator.normal(0, 0.1, base.shape), -0.2, 1.2)
    target = torch.from_numpy((base * 255).astype(np.uint8))
    mask = None if kept is None else torch.from_numpy((generator.random((height, width)) < kept) * np.uint8(9))
    return torch.from_numpy(noisy.astype(np.float32)), target, mask


def with_gradient(implementation, image, target, mask=None, **settings_):
    leaf = image.clone().requires_grad_()
    result = implementation.photometric_loss(leaf, target, mask, **settings_)
    (gradient,) = torch.autograd.grad(result.loss, leaf)
    return result, gradient
