"""Whether positions can be those of one flight over Earth, or are metres of a local system read as degrees."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from vdgs.captures.odd_positions import are_nowhere, places_apart
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_from_geodetic, median_place

#: What helps where metres of a local system are at hand.
LOCAL_METERS = (
    "Positions in metres of a local system (SLAM, VIO, a simulator, a tabletop) have no place on Earth, and --gps does "
    "not read them. Write the poses as transforms.json (world from camera, axes of OpenGL, with the lens) beside the "
    "photographs, or leave --gps out and give a known distance (--scale-bar)"
)
#: Photographs of one flight that overlap are nearer to each other than this, in the median, in metres: a manned
#: aircraft at 10 km takes one every few kilometres (choice).
_LARGEST_STEP_M = 20_000.0
#: From this step on (metres) altitudes are compared with it: photographs whose steps are so many times their height
#: over the ground, which may lie this deep under the sea, do not overlap (choice).
_STEP_TO_COMPARE_M, _STEP_PER_HEIGHT, _LOWEST_GROUND_M = 3_000.0, 3.0, 500.0
#: No land lies within so many degrees of 0, 0, about which local systems lie. Positions are compared with it that
#: spread by so many metres: less is no local system in metres, but may be angles in radians.
NO_LAND_DEG, _SPREAD_AT_SEA_M = 4.0, 2_000.0
#: No scene is wider (metres): power lines of 200 km are (choice).
WIDEST_M = 500_000.0
#: No camera is farther from the ground, in metres: aircraft are at 10 to 20 km, balloons at 35 km (choice).
HIGHEST_OVER_GROUND_M = 40_000.0
_MIN_PLACES = 3
#: Cameras of a scene are compared without 5 % on each side.
_ENDS = (0.05, 0.95)


def why_no_flight(geodetic: Float[np.ndarray, "n 3"], photographs: int = 0) -> str:
    """Why positions (degrees, metres; NaN where unknown) cannot be of photographs of one flight, in words; empty where
    they can. Those at 0, 0 and copies of others do not count, few strays and several sites do no harm. Where there are
    more `photographs` than positions, others lie between these."""
    known = geodetic[np.isfinite(geodetic[:, :2]).all(axis=1) & ~are_nowhere(geodetic)]
    distinct = np.unique(known[:, :2], axis=0)
    if len(distinct) < _MIN_PLACES:
        return ""
    level = np.column_stack([distinct, np.zeros(len(distinct))])
    step = _median_step(level) * min(1.0, len(distinct) / max(len(geodetic), photographs))
    if step > _LARGEST_STEP_M:
        return f"they lie {step / 1000:,.0f} km from one to the next (median)"
    altitudes = known[np.isfinite(known[:, 2]), 2]
    height = float(np.median(np.abs(altitudes))) if altitudes.any() else np.inf
    if step > max(_STEP_TO_COMPARE_M, _STEP_PER_HEIGHT * (height + _LOWEST_GROUND_M)):
        return f"they lie {step / 1000:,.1f} km from one to the next (median) at an altitude of {height:.3g} m"
    enu = enu_from_geodetic(level, median_place(level))
    spread = float(np.median(np.linalg.norm(enu, axis=1)))
    if (np.abs(np.median(distinct, axis=0)) < NO_LAND_DEG).all() and spread > _SPREAD_AT_SEA_M:
        return "they lie about 0, 0, in the open sea"
    wide = float(np.ptp(enu[places_apart(enu) == 0], axis=0).max())
    return f"they lie over {wide / 1000:,.0f} km without a gap" if wide > WIDEST_M else ""


def why_no_scene(centers: Float[np.ndarray, "n 3"], ground: float) -> str:
    """Why cameras at `centers` (metres, z up) over a ground at the height `ground` cannot be right, in words; empty
    where they can."""
    if not len(centers):
        return ""
    height = float(np.median(centers[:, 2])) - ground
    if abs(height) > HIGHEST_OVER_GROUND_M:
        return f"the cameras would be {abs(height) / 1000:,.0f} km {'over' if height > 0 else 'under'} the ground"
    # Few cameras that were placed badly do no harm.
    wide = float(np.ptp(np.quantile(centers, _ENDS, axis=0), axis=0).max())
    return f"the cameras would lie over {wide / 1000:,.0f} km" if wide > WIDEST_M else ""


def _median_step(level: Float[np.ndarray, "n 3"]) -> float:
    """The median distance in metres from a place (degrees, height 0) to the nearest other one."""
    from scipy.spatial import cKDTree

    ecef = ecef_from_geodetic(level)
    return float(np.median(cKDTree(ecef).query(ecef, k=2)[0][:, 1]))
