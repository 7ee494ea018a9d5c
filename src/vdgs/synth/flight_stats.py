"""How unevenly a flight sees the place: the distribution of V over the true surface, with occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.mesh import Mesh
from vdgs.synth.ray_tracing import Tracer
from vdgs.synth.true_visibility import count_visibility, surface_places
from vdgs.visibility.visibility_counts import imbalance

#: Places drawn on the surface.
_PLACES = 40_000
#: The place reaches this far from the middle, in halves of the flown extent: what lies beyond is backdrop.
_REACH = 2.0


@dataclass(frozen=True)
class FlightImbalance:
    """V over places spread evenly by area on the surface that at least one training photograph truly sees.

    V by percentile; Gini coefficient (0: all seen alike); share of the area with V below a limit.
    """

    photographs: int
    mean: float
    quantiles: dict[int, float]
    gini: float
    share_below: dict[int, float]

    @property
    def line(self) -> str:
        """For people, in one line."""
        quantiles = ", ".join(f"{share} %: {value:g}" for share, value in self.quantiles.items())
        return (
            f"photographs that truly see a place (V), of {self.photographs}, by quantile of the visible surface: "
            f"{quantiles}; Gini {self.gini:.2f}"
        )


def survey(
    tracer: Tracer, mesh: Mesh, training: list[Camera], half_extent: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 3] (m) of the surface that training truly sees, evenly by area, and V [n] of each (at least 1)."""
    places = surface_places(mesh, _REACH * half_extent, _PLACES, rng)
    views = count_visibility(tracer, training, places)
    seen = views > 0
    return places[seen], views[seen]


def flight_imbalance(views: np.ndarray, photographs: int) -> FlightImbalance:
    """The distribution of V [n] in numbers."""
    found = imbalance(views.astype(np.int64))
    return FlightImbalance(photographs, found.mean, found.quantiles, found.gini, found.share_below)
