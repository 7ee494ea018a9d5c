"""North by positions against the headings that a drone recorded with its photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from vdgs.captures.plane_fit import fit_plane, in_plane
from vdgs.captures.position_adjustment import PositionFit
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.units import two_digits

#: Recorded headings count from so many on that agree so well (mean of unit vectors); the other way round is so far.
ENOUGH_HEADINGS, ALIKE, OTHER_WAY_DEG = 5, 0.95, 150.0
#: Headings contradict the positions where they differ by so many degrees more than north may be off (choice).
APART_DEG = 3.0
#: Positions may lie so many metres behind or ahead of the photographs along the track: as shutters wait, or positions
#: are written late (choice).
MOST_LAG_M = 5.0


def checked_by_headings(
    fit: PositionFit, images: Mapping[str, pycolmap.Image], taken: Sequence[ImageMetadata], times: np.ndarray
) -> tuple[PositionFit, list[str]]:
    """The fit with north and scale as uncertain as recorded headings show, and notes. `taken` are the photographs of
    the fit's positions, `times` [n] when they were taken.

    Positions that lag, or run ahead, along the track turn an orbit, but no strips flown back and forth: only where that
    explains what headings and positions differ by is north that uncertain. Else the compass is taken to be off.
    """
    away = _turned(fit, images, taken)
    if away is None:
        return fit, []
    if abs(away) >= OTHER_WAY_DEG:
        note = (
            f"north is turned by {abs(away):.0f}° from what the drone recorded. Are both hemispheres (S and W) missing "
            "from the positions?"
        )
        return fit, [note]
    lag, scale = _lag(fit, times, away)
    if abs(away) < fit.north_error_deg + APART_DEG or lag > MOST_LAG_M:
        return fit, []
    note = (
        f"north by the positions is turned by {two_digits(abs(away))}° from the recorded headings, as it would be by "
        f"positions that lie {two_digits(lag)} m behind or ahead along the track: which of the two is right is not "
        "known, and north is stated no better."
    )
    return replace(fit, north_error_deg=abs(away) + fit.north_error_deg, scale_error=fit.scale_error + scale), [note]


def _turned(fit: PositionFit, images: Mapping[str, pycolmap.Image], taken: Sequence[ImageMetadata]) -> float | None:
    """By how many degrees recorded headings say that the scene is turned; None where they are few or disagree."""
    turns = np.array(
        [
            fit.similarity.rotation @ images[photo.name].cam_from_world().rotation.matrix().T
            @ photo.attitude.camera_from_enu
            for photo in taken if photo.attitude is not None and photo.attitude.has_heading
        ]
    ).reshape(-1, 3, 3)  # fmt: skip
    if len(turns) < ENOUGH_HEADINGS:
        return None
    mean = np.mean(np.exp(1j * np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1])))
    return float(np.degrees(np.angle(mean))) if abs(mean) >= ALIKE else None


def _lag(fit: PositionFit, times: np.ndarray, turn_deg: float) -> tuple[float, float]:
    """How far positions must lie behind or ahead, along the track, to turn the scene so far, in metres, and by what
    share that changes its scale."""
    order = np.argsort(times, kind="stable")
    places = in_plane(fit.placed[order])
    along = np.gradient(places)
    along /= np.maximum(np.abs(along), 1e-9)
    turned = abs(float(np.angle(fit_plane(places, places - along)[0])))
    lag = abs(np.radians(turn_deg)) / max(turned, 1e-9)
    return float(lag), abs(abs(fit_plane(places, places - lag * along)[0]) - 1)
