"""Smooth noise and random cells, looked up in tables: the grain of every procedural texture.

A lookup costs a few nanoseconds, which is what lets a laptop shade tens of millions of samples.
Every lookup fades out where its wavelength falls below the pixel's footprint, so that textures
neither alias nor flicker from one image to the next.
"""

from __future__ import annotations

import numpy as np

_SIDE = 1024
_TEXELS = 16  # per wavelength: fine enough that nearest lookup shows no steps at the footprints we draw
_ORIGIN = np.float32(1 << 18)  # keeps coordinates positive, so that truncation is floor


def _smooth_tile(rng: np.random.Generator) -> np.ndarray:
    """Periodic Gaussian-filtered white noise, unit variance, [_SIDE, _SIDE] float32."""
    spectrum = np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE)))
    fy, fx = np.fft.fftfreq(_SIDE)[:, None], np.fft.rfftfreq(_SIDE)[None, :]
    spectrum *= np.exp(-(fx**2 + fy**2) * (_TEXELS * 0.9) ** 2)
    tile = np.fft.irfft2(spectrum, s=(_SIDE, _SIDE))
    return ((tile - tile.mean()) / tile.std()).astype(np.float32)


# Fixed seeds: the grain is a property of the materials, the town's seed decides what stands where.
_TILE = _smooth_tile(np.random.default_rng(11)).ravel()
_CELLS = np.random.default_rng(12).random(1 << 16, dtype=np.float32)


def fade(wavelength: float, footprint: np.ndarray) -> np.ndarray:
    """How much of a detail of this wavelength (m) survives a pixel's footprint (m), [n] in [0, 1]."""
    return np.clip(1.9 - footprint * np.float32(1.2 / wavelength), 0, 1)


def smooth(x: np.ndarray, y: np.ndarray, wavelength: float, footprint: np.ndarray | None = None) -> np.ndarray:
    """Noise of zero mean and unit variance at plane coordinates in metres, [n] float32."""
    scale = np.float32(_TEXELS / wavelength)
    column = (x * scale + _ORIGIN).astype(np.int32) & (_SIDE - 1)
    row = (y * scale + _ORIGIN).astype(np.int32) & (_SIDE - 1)
    value = _TILE[row * _SIDE + column]
    return value if footprint is None else value * fade(wavelength, footprint)


def cells(i: np.ndarray, j: np.ndarray, salt: int | np.ndarray = 0) -> np.ndarray:
    """A uniform number in [0, 1) for every integer cell, [n] float32."""
    i, j = np.asarray(i, np.int32), np.asarray(j, np.int32)
    return _CELLS[(i * 7919 + j * 15731 + i * j * 31 + np.asarray(salt, np.int32) * 104729) & 0xFFFF]


def line(distance: np.ndarray, half_width: float, footprint: np.ndarray) -> np.ndarray:
    """Coverage in [0, 1] of a line whose centre is `distance` metres away, anti-aliased by the footprint."""
    soft = 0.5 * footprint + np.float32(0.01)
    return np.clip((half_width - np.abs(distance)) / soft + 0.5, 0, 1) * np.minimum(1, 2 * half_width / soft).astype(
        np.float32
    )
