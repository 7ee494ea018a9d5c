"""Heights of surveyed points whose x and y are in feet and whose system has none: in metres, or in the same feet."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from vdgs.captures.system_names import AROUND
from vdgs.captures.table_columns import FOOT_M
from vdgs.geometry.similarity import is_collinear
from vdgs.sfm.gcp_adjustment import fit_to_gcps
from vdgs.sfm.gcp_list import MIN_CONTROL_POINTS, GcpList
from vdgs.sfm.georegistration import Georegistration

#: GPS is wrong by no more than this many metres across and, geoids among it, up; no heights by more than the last.
GPS_ACROSS_M, GPS_UP_M, HEIGHTS_M = 100.0, 150.0, 1000.0
#: Heights in feet lie as far from those of GPS, once they are read as such, as it is off and geoids are from the
#: ellipsoid where people count in feet (metres); and by less than this share of how far they lie as metres: heights of
#: a GPS that begin at 0 lie 30 % (choices).
GEOIDS_M, FEET_SHARE = 60.0, 0.25
#: A ratio so near to that of feet and metres is one (share).
ABOUT = 0.12
IN_FEET = " Are they in feet, where metres are expected?"
#: One unit explains points and photographs so many times as well (logarithm of likelihoods; choice).
PLAINLY_BETTER = math.log(1000.0)
#: Heights contradict GPS so many times as far from it as GPS is good to (95 %; choice).
CONTRADICTING = 3.0
#: Datums that agree with WGS 84 differ from it by so much (metres).
DATUMS_APART_M = 2.0
#: Heights of NAVD88 in the EPSG catalogue, by the feet that they count; and in metres.
_NAVD88_FEET, _NAVD88_METERS = {1200 / 3937: 6360, FOOT_M: 8228}, 5703
_CODE = re.compile(r"EPSG\W{0,3}(\d{4,5})", re.I)


class Found(NamedTuple):
    """Which unit heights have."""

    in_feet: bool | None
    """None where nothing tells."""
    why: str = ""


def with_height_unit(
    control: GcpList,
    located: Mapping[int, np.ndarray],
    origin: tuple[float, float, float],
    pixel: float,
    gps: Georegistration | None,
    gps_source: str,
) -> tuple[GcpList, str]:
    """The list with heights in the feet of x and y where points and photographs, or else GPS, tell that they are, and
    neither contradicts the other; and what to say of that, also where nothing tells. Lists whose unit of heights is
    said stay as they are.

    `located` are the places [3] of points in the model by their number, `pixel` what one shows there in its unit.
    """
    if control.unsaid_height_unit_m is None or not any(math.isfinite(each.geodetic[2]) for each in control.points):
        return control, ""
    in_feet = control.with_heights_in(control.unsaid_height_unit_m)
    meters, feet = control.enu(origin), in_feet.enu(origin)
    used = [k for k in located if math.isfinite(meters[k, 2]) and not control.points[k].is_check_point]
    used = used or [k for k in located if math.isfinite(meters[k, 2])]
    places = np.array([located[k] for k in used]).reshape(-1, 3)
    found = by_shape(places, meters[used], feet[used], pixel)
    if gps is not None:
        told = by_gps(places, meters[used], feet[used], gps, gps_source)
        # A bent model may have the shape that the wrong unit gives.
        found = told if found.in_feet is None else found if told.in_feet in (None, found.in_feet) else Found(None)
    ways = _ways_to_say(control)
    if found.in_feet:
        return in_feet, f"{control.source}: its heights are read in feet, as x and y are: {found.why}. {ways}"
    if found.in_feet is None:
        lower = float(np.nanmedian(meters[:, 2] - feet[:, 2]))
        return control, (
            f"{control.source}: x and y are in feet, and nothing tells whether its heights are too. They are read as "
            f"metres; in feet the scene would lie {abs(lower):.3g} m {'lower' if lower > 0 else 'higher'}. {ways}"
        )
    return control, ""


def by_shape(places: np.ndarray, meters: np.ndarray, feet: np.ndarray, pixel: float) -> Found:
    """By which heights surveyed points [n, 3] have the shape that they have in the model; each point counts by the
    order of magnitude of what a similarity leaves of it, so that a wrong one decides nothing."""
    if len(places) < MIN_CONTROL_POINTS or is_collinear(places):
        return Found(None)
    costs, offs = [], []
    for targets in (meters, feet):
        similarity, _ = fit_to_gcps(places, targets, pixel)
        off = ((similarity.apply(places) - targets) ** 2).sum(axis=1)
        costs.append(float(np.log(off + (pixel * similarity.scale) ** 2).mean()))
        offs.append(float(np.sqrt(np.median(off))))
    evidence = (3 * len(places) - 7) / 2 * (costs[0] - costs[1])
    if abs(evidence) < PLAINLY_BETTER:
        return Found(None)
    why = f"as metres, points and photographs disagree by {offs[0]:.2g} m, in feet by {offs[1]:.2g} m"
    return Found(evidence > 0, why)


def by_gps(places: np.ndarray, meters: np.ndarray, feet: np.ndarray, gps: Georegistration, source: str) -> Found:
    """By which heights surveyed points [n, 3] lie where GPS has them: within what it is good to where the others
    contradict it, or else within what geoids and receivers are off by at all."""
    accuracy = gps.accuracy
    if accuracy is None or accuracy.place_m is None or len(accuracy.place_m) < 2 or not len(places):
        return Found(None)
    heights = gps.similarity.apply(places)[:, 2]
    good = accuracy.place_m[1]
    as_meters, as_feet = (float(np.median(targets[:, 2] - heights)) for targets in (meters, feet))
    for near, far in ((good, CONTRADICTING * good), (GPS_UP_M + good, GPS_UP_M + CONTRADICTING * good)):
        fits = [abs(off) <= near for off in (as_meters, as_feet)]
        fits[1] = fits[1] and (near == good or abs(as_feet) <= FEET_SHARE * abs(as_meters))
        contradicts = [abs(off) > far for off in (as_meters, as_feet)]
        if (fits[1] and contradicts[0]) or (fits[0] and contradicts[1]):
            side = "over" if as_meters > 0 else "under"
            why = f"as metres they are {abs(as_meters):.3g} m {side} those of GPS ({source}), good to ±{good:.2g} m"
            return Found(fits[1], why)
    return Found(None)


def are_in_feet(as_meters: float, as_feet: float, good: float) -> bool:
    """Whether heights are plainly in feet that lie so far from those of GPS as metres, and so far as feet; GPS is good
    to `good`. All in metres."""
    return abs(as_feet) <= min(GEOIDS_M + good, FEET_SHARE * abs(as_meters))


def in_feet(ratio: float) -> str:
    """A question where lengths are so many times as long as they should be; empty where feet do not explain that."""
    return IN_FEET if any(abs(ratio / feet - 1) < ABOUT for feet in (FOOT_M, 1 / FOOT_M)) else ""


def _ways_to_say(control: GcpList) -> str:
    """How a list says the unit of its heights."""
    code = _CODE.fullmatch(control.header.strip(AROUND))
    unit = control.unsaid_height_unit_m or 1.0
    navd88 = next((number for meters, number in _NAVD88_FEET.items() if abs(meters - unit) < 1e-9), None)
    if code and navd88:
        system = f"EPSG:{code[1]}"
        return f"A first line of {system}+{navd88} says feet, {system}+{_NAVD88_METERS} metres."
    return "A second line such as x,y,z[ft],px,py,photograph,name (or z[m]) says the unit."


def of_gps(placed: Georegistration, by_gps: Georegistration | None, control: str, gps: str) -> tuple[str, ...]:
    """What to say of a model placed by control points that lies elsewhere than GPS has it, beyond what both are good
    to: both cannot be right, or their heights count from different zeros."""
    if by_gps is None or by_gps.accuracy is None or not by_gps.accuracy.place_m or not len(placed.residuals):
        return ()
    own = placed.accuracy.place_m if placed.accuracy is not None and placed.accuracy.place_m else (0.0, 0.0)
    good, off = by_gps.accuracy.place_m, np.median(placed.residuals, axis=0)
    notes = []
    if len(good) > 1 and len(off) > 2 and abs(off[2]) > CONTRADICTING * (good[1] + max(own[1:], default=0.0)):
        notes.append(
            f"{control} places the scene {abs(off[2]):.3g} m {'higher' if off[2] > 0 else 'lower'} than GPS ({gps}), "
            f"which is good to ±{good[1]:.2g} m. Its heights count. Do they start from another zero (the sea, the "
            "ellipsoid), or are they in another unit?"
        )
    across = float(np.hypot(off[0], off[1]))
    if across > CONTRADICTING * (good[0] + own[0]) + DATUMS_APART_M:
        notes.append(
            f"{control} places the scene {across:.3g} m from where GPS ({gps}) has it, which is good to "
            f"±{good[0]:.2g} m. Its places count. Are they of another datum?"
        )
    return tuple(notes)
