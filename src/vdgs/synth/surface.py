"""What a shader is given and what it returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_SIDE = 1024
_TEXELS = 16  # per wavelength: fine enough that nearest lookup shows no steps at the footprints we draw
_ORIGIN = np.float32(1 << 18)  # keeps coordinates positive, so that truncation is floor
_CELLS = np.random.default_rng(12).random(1 << 16, dtype=np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Places where rays met the scene, float32.

    position [n, 3] m; normal [n, 3] unit, facing the viewer; uv [n, 2] and panel [n, 2] m; color [n, 3]
    linear albedo; seed [n]; footprint [n]: side of a pixel on the surface, m; view [n, 3]: unit direction
    in which the ray travels.
    """

    position: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    panel: np.ndarray
    color: np.ndarray
    seed: np.ndarray
    footprint: np.ndarray
    view: np.ndarray

    def take(self, index: np.ndarray) -> Surface:
        """Some of the places."""
        return Surface(**{name: value[index] for name, value in vars(self).items()})


def mix_colors(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Colors [n, 3] or [3] mixed by share [n]: 0 gives a, 1 gives b."""
    return a + (b - a) * share[:, None]


def scale_color(color: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """A color [3] or [n, 3] times a factor [n], [n, 3] float32."""
    return (color * factor[:, None]).astype(np.float32)


def _smooth_tile(rng: np.random.Generator) -> np.ndarray:
    """Periodic Gaussian-filtered white noise, unit variance, [_SIDE, _SIDE] float32."""
    spectrum = np.fft.rfft2(rng.normal(size=(_SIDE, _SIDE)))
    fy, fx = np.fft.fftfreq(_SIDE)[:, None], np.fft.rfftfreq(_SIDE)[None, :]
    spectrum *= np.exp(-(fx**2 + fy**2) * (_TEXELS * 0.9) ** 2)
    tile = np.fft.irfft2(spectrum, s=(_SIDE, _SIDE))
    return ((tile - tile.mean()) / tile.std()).astype(np.float32)


# Fixed seeds: the grain is a property of the materials, the town's seed decides what stands where.
_TILE = _smooth_tile(np.random.default_rng(11)).ravel()


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
    """Coverage in [0, 1] of a line whose center is `distance` metres away, anti-aliased by the footprint."""
    soft = 0.5 * footprint + np.float32(0.01)
    return np.clip((half_width - np.abs(distance)) / soft + 0.5, 0, 1) * np.minimum(1, 2 * half_width / soft).astype(
        np.float32
    )
