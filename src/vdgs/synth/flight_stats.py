"""How unevenly a flight sees the place: the distribution of V over the true surface, with occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.mesh import Mesh
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.true_visibility import count_visibility, sample_surface_points
from vdgs.visibility.visibility_counts import visibility_stats

#: Places drawn on the surface.
_NUM_POINTS = 40_000
#: The place reaches this far from the middle, in halves of the flown extent: what lies beyond is backdrop.
_AREA_FACTOR = 2.0


@dataclass(frozen=True)
class FlightStats:
    """V over places spread evenly by area on the surface that at least one training photograph truly sees.

    V by percentile; Gini coefficient (0: all seen alike); share of the area with V below a limit.
    """

    photographs: int
    mean: float
    quantiles: dict[int, float]
    gini: float
    share_below: dict[int, float]

    @property
    def summary(self) -> str:
        """For people, in one line."""
        quantiles = ", ".join(f"{share} %: {value:g}" for share, value in self.quantiles.items())
        return (
            f"photographs that truly see a place (V), of {self.photographs}, by quantile of the visible surface: "
            f"{quantiles}; Gini {self.gini:.2f}"
        )


def sample_visible_points(
    tracer: RayTracer, mesh: Mesh, training: list[Camera], half_extent: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 3] (m) of the surface that training truly sees, evenly by area, and V [n] of each (at least 1)."""
    places = sample_surface_points(mesh, _AREA_FACTOR * half_extent, _NUM_POINTS, rng)
    views = count_visibility(tracer, training, places)
    seen = views > 0
    return places[seen], views[seen]


def compute_flight_stats(views: np.ndarray, photographs: int) -> FlightStats:
    """The distribution of V [n] in numbers."""
    found = visibility_stats(views.astype(np.int64))
    return FlightStats(photographs, found.mean, found.quantiles, found.gini, found.fraction_below)
