"""Textures of leaves, bark and water. Shaders as in `facades`."""

from __future__ import annotations

import numpy as np

from vdgs.synth.facades import AlbedoAndGloss
from vdgs.synth.noise import smooth
from vdgs.synth.surface import Surface, scale_color


def foliage(s: Surface) -> AlbedoAndGloss:
    """Leaves: dark in the hollows between clumps, light and yellowish on top, speckled all over."""
    u, v = _facing_plane(s)
    crown = s.seed >= 0  # hedges carry no crown coordinates
    hollow = np.where(crown, 0.5 + 0.62 * s.uv[:, 0], 0.95)
    height = np.where(crown, 0.7 + 0.38 * s.uv[:, 1], np.clip(0.6 + 0.5 * s.normal[:, 2], 0.5, 1.05))
    leaves = 1 + 0.26 * smooth(u, v, 0.6, s.footprint) + 0.26 * smooth(v, u, 0.27, s.footprint)
    leaves = leaves + 0.1 * smooth(u, v, 1.9)
    color = scale_color(s.color, hollow * height * np.clip(leaves, 0.3, 1.8))
    warm = np.clip(height - 0.85, 0, 0.3) * hollow
    color *= 1 + warm[:, None] * np.array([0.9, 0.5, -0.2], np.float32)
    return color, np.zeros(len(u), np.float32)


def _facing_plane(s: Surface) -> tuple[np.ndarray, np.ndarray]:
    """World coordinates in whichever of the three axis planes a place faces most (m, [n] each)."""
    x, y, z = s.position.T
    axis = np.abs(s.normal * np.array([1, 1, 1.2], np.float32)).argmax(1)
    return np.where(axis == 0, y + 11, x), np.where(axis == 2, y, z + 37)


def bark(s: Surface) -> AlbedoAndGloss:
    """Bark with upright ridges."""
    ridges = 1 + 0.25 * smooth(s.uv[:, 0] * 4, s.uv[:, 1], 0.6, s.footprint)
    return scale_color(s.color, ridges), np.zeros(len(ridges), np.float32)


def water(s: Surface) -> AlbedoAndGloss:
    """Still water: its own colour below, the sky on top, faint ripples."""
    x, y = s.position[:, 0], s.position[:, 1]
    ripples = 1 + 0.1 * smooth(x, y * 1.6, 1.1, s.footprint) + 0.16 * smooth(x, y, 6.0)
    ripples = ripples + 0.07 * smooth(y, x, 0.5, s.footprint)
    return scale_color(s.color, ripples), np.full(len(x), 1.0, np.float32)
