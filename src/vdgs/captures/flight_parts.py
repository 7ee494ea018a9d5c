"""Parts of a flight that are left out as a whole, to measure a model from where nobody flew: strips and obliques."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vdgs.captures.capture import View
from vdgs.captures.capture_order import flight_positions
from vdgs.geometry.camera import Camera

#: A camera looks obliquely if its axis is farther than this from straight down.
OBLIQUE_DEGREES = 25
#: A strip ends where the drone turns by more than this, or moves more than so many of its usual steps.
_TURN, _JUMP = np.radians(30), 3.0
#: Fewer photographs in a row are a turn, not a strip.
MIN_STRIP = 3


def is_oblique(camera: Camera) -> bool:
    """Whether a camera looks obliquely."""
    return bool(camera.forward[2] > -np.cos(np.radians(OBLIQUE_DEGREES)))


def oblique_views(views: Sequence[View]) -> list[int]:
    """Which views look obliquely."""
    return [k for k, view in enumerate(views) if is_oblique(view.camera)]


def flight_strips(views: Sequence[View]) -> list[list[int]]:
    """The views of each straight part of the flight, in the order in which they were taken; no view of a turn. A strip
    is what is flown in one direction at one tilt, by positions; names give the order."""
    order = flight_positions(view.name for view in views)
    ranked = sorted(range(len(views)), key=lambda k: order[views[k].name])
    centers = np.stack([view.camera.position[:2] for view in views])
    obliques, strips = set(oblique_views(views)), list[list[int]]()
    steps = [float(np.linalg.norm(centers[b] - centers[a])) for a, b in pairwise(ranked)]
    usual = float(np.median(steps)) if steps else 0.0
    strip, before = ranked[:1], None
    for (last, view), length in zip(pairwise(ranked), steps, strict=True):
        step = centers[view] - centers[last]
        goes_on = 0 < length <= _JUMP * usual and order[views[last].name].flight == order[views[view].name].flight
        goes_on &= (last in obliques) == (view in obliques)
        if goes_on and before is not None:
            goes_on = float(step @ before) > np.cos(_TURN) * length * float(np.linalg.norm(before))
        if not goes_on:
            strips.append(strip)
            # The photograph of a turn begins the next strip if it lies on its line; a step aside belongs to none.
            strip, before = [view], None
            continue
        strip, before = [*strip, view], step if before is None else centers[view] - centers[strip[0]]
    strips.append(strip)
    return [strip for strip in strips if len(strip) >= MIN_STRIP]
