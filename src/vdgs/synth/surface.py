"""What a shader is given and what it returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Places where rays met the scene, float32.

    position [n, 3] m; normal [n, 3] unit, facing the viewer; uv [n, 2] and panel [n, 2] m; colour [n, 3]
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
    """Colours [n, 3] or [3] mixed by share [n]: 0 gives a, 1 gives b."""
    return a + (b - a) * share[:, None]


def scale_color(color: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """A colour [3] or [n, 3] times a factor [n], [n, 3] float32."""
    return (color * factor[:, None]).astype(np.float32)
