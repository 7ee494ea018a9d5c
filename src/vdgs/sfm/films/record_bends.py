"""How far a position between two records of a film may be off: where the drone turned between them it cut no corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vdgs.geometry.geodesy import enu_from_geodetic
from vdgs.sfm.films.telemetry import MAX_GAP_S, Telemetry

#: A position between records that may lie so far (metres) beside the way is none (choice): all of a flight lie on the
#: inner side of its turns, which makes it smaller, and nothing in them tells that.
MAX_BESIDE_M = 1.0
#: What latitudes and longitudes may be rounded to, in degrees, and in metres for each degree.
_STEPS_DEG, _DEGREE_M = (1e-3, 1e-4, 1e-5), 111_000.0
#: Rounded positions on a straight way bend by up to so many steps at two records together.
_STEPS_OF_BENDS = 4.0
#: Between records of an arc the way lies by this share of both bends as far beside as it would at a corner.
_EVENLY = 0.25


class RecordBends:
    """By how much the way of a film bends at each of its records with a place."""

    def __init__(self, records: Sequence[Telemetry]) -> None:
        placed = [record for record in records if record.lat_lon is not None]
        self._times = np.array([record.seconds for record in placed])
        places = np.array([record.lat_lon for record in placed]).reshape(-1, 2)
        self.step_m = _step_m(places)
        """What positions are rounded to; 0 for less than a metre."""
        self._bends = np.zeros(len(placed))
        if len(placed) > 2:
            at = enu_from_geodetic(np.c_[places, np.zeros(len(places))], (*places[0].tolist(), 0.0))
            self._bends[1:-1] = np.linalg.norm(at[2:] - 2 * at[1:-1] + at[:-2], axis=1)
            self._bends[[0, -1]] = self._bends[[1, -2]]  # as far as is known

    def beside_m(self, seconds: float) -> float:
        """How far a position that is interpolated at a moment may lie beside the way, in metres.

        A corner between two records bends by as much at both together as the speed changes there, and not at those
        around them. A way that bends as much there, as around something, turns evenly: a quarter as far beside.
        """
        after = int(np.searchsorted(self._times, seconds, side="right"))
        if not 0 < after < len(self._times):
            return 0.0
        span = float(self._times[after] - self._times[after - 1])
        if not 0 < span <= MAX_GAP_S:
            return 0.0
        share = (seconds - float(self._times[after - 1])) / span
        bends = self._bends[after - 1 : after + 1]
        around = self._bends[[max(after - 2, 0), min(after + 1, len(self._bends) - 1)]]
        evenly = float(np.minimum(bends, around).sum())
        bent = float(bends.sum()) - evenly + _EVENLY * evenly
        return share * (1 - share) * max(0.0, bent - _STEPS_OF_BENDS * self.step_m)

    def checked(self, known: Telemetry) -> Telemetry:
        """What is known at a moment, without the position if that may lie far beside the way."""
        if known.lat_lon is None or self.beside_m(known.seconds) <= MAX_BESIDE_M:
            return known
        return replace(known, lat_lon=None, altitude=None)


def _step_m(places: np.ndarray) -> float:
    """What all of the places [n, 2] in degrees are rounded to, in metres; 0 where that is finer than a metre."""
    if not np.ptp(places, axis=0).any() if len(places) else True:
        return 0.0
    found = (s for s in _STEPS_DEG if np.abs(places - s * np.round(places / s)).max() < 1e-3 * s)
    return next(found, 0.0) * _DEGREE_M
