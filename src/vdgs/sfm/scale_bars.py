"""Known distances between points that photographs show: a scale without positions, or better than theirs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.errors import CaptureError
from vdgs.sfm.gcp_adjustment import triangulate
from vdgs.sfm.gcp_list import (
    MIN_OBSERVATIONS,
    GcpObservation,
    GroundControlPoint,
    find_sighting,
    photographs_by_name,
    text_lines,
)
from vdgs.sfm.image_list import ImageList
from vdgs.system.colmap import pycolmap

#: What a mark is off by in pixels at least, and what a measured distance is good to as a share (choice).
LEAST_PX, LEAST_SHARE = 0.5, 0.002
#: Distances that make scales differ by more than this share contradict each other (choice).
MOST_APART = 0.1
FORM = "`NAME px py photograph` for a mark, or `NAME NAME metres` for a distance"


@dataclass(frozen=True, eq=False)
class ScaleBars:
    """Marked points, and known distances between them."""

    points: tuple[GroundControlPoint, ...]
    distances: tuple[tuple[str, str, float], ...]
    """Two names, and metres."""
    source: str


def read_scale_bars(file: Path, collection: ImageList) -> ScaleBars:
    """The marks and distances of a text file.

    Lines are `NAME px py photograph`, a mark as in a gcp_list.txt, or `NAME NAME metres`, a distance; `#` for
    comments. Raises CaptureError, naming the line, for a file that cannot be read, lines that are neither, distances
    that are none, and points that fewer than two photographs show.
    """
    by_name = photographs_by_name(collection)
    marks: dict[str, list[GcpObservation]] = {}
    distances: list[tuple[str, str, float]] = []
    for number, line in text_lines(file, "known distances"):
        words = line.split("\t") if "\t" in line else line.split()
        where = f"{file}: line {number}:"
        try:
            if len(words) == 3:
                distances.append((words[0], words[1], _meters(words[2])))
                continue
            name, pixel, photograph = words[0], (float(words[1]), float(words[2])), words[3].strip()
        except (ValueError, IndexError):
            raise CaptureError(f"{where} {line[:80]!r} is not {FORM}. Mend the line.") from None
        sighting = find_sighting(pixel, photograph, number, by_name, file)
        marks.setdefault(name, []).extend([sighting] if sighting is not None else [])
    if not distances:
        raise CaptureError(f"{file}: names no distance. Lines are {FORM}.")
    for name in dict.fromkeys(name for one, other, _ in distances for name in (one, other)):
        if len({each.image for each in marks.get(name, [])}) < MIN_OBSERVATIONS:
            raise CaptureError(f"{file}: the point {name} is marked in fewer than two photographs. Mark it in more.")
    points = tuple(GroundControlPoint(name, (0.0, 0.0, 0.0), tuple(seen), True) for name, seen in marks.items())
    return ScaleBars(points, tuple(distances), file.name)


def _meters(word: str) -> float:
    value = float(word)
    if not (math.isfinite(value) and 0 < value < 1e6):
        raise ValueError(word)
    return value


def known_scale(model: pycolmap.Reconstruction, bars: ScaleBars) -> tuple[float, float]:
    """The factor from the model's world to metres, and its standard deviation as a share.

    Raises CaptureError for points that placed photographs do not show, marks that are wrong, and distances that
    contradict each other.
    """
    seen = {}
    for point in bars.points:
        found = triangulate(model, point)
        if found is not None:
            seen[point.name] = found
    factors, shares = [], []
    for one, other, meters in bars.distances:
        for name in (one, other):
            if name not in seen:
                raise CaptureError(
                    f"{bars.source}: the point {name} is not shown by two placed photographs that agree on it. Mark it "
                    "in more of them."
                )
        length = float(np.linalg.norm(seen[one].position - seen[other].position))
        pixel = _pixel(model)
        off = max(LEAST_PX, math.hypot(seen[one].error_px, seen[other].error_px)) * pixel
        if not length > 2 * off:
            raise CaptureError(
                f"{bars.source}: {one} and {other} are {length / pixel:.0f} pixels apart and their marks are off by "
                f"{off / pixel:.0f}. Look at the marks again, or measure a longer distance."
            )
        factors.append(meters / length)
        shares.append(math.hypot(LEAST_SHARE, off / length))
    weights = 1 / np.square(shares)
    mean = float(np.exp((weights * np.log(factors)).sum() / weights.sum()))
    apart = max(abs(factor / mean - 1) for factor in factors)
    if apart > MOST_APART:
        raise CaptureError(
            f"{bars.source}: its distances contradict each other by {apart:.0%}. Look at marks and metres again."
        )
    return mean, max(float(1 / np.sqrt(weights.sum())), apart / 2)


def _pixel(model: pycolmap.Reconstruction) -> float:
    """What a pixel shows of the median point, in the model's world."""
    points = np.array([point.xyz for point in model.points3D.values()])
    sizes = [
        float(np.median(np.linalg.norm(points - image.projection_center(), axis=1)))
        / model.cameras[image.camera_id].mean_focal_length()
        for image in model.images.values()
        if image.has_pose
    ]
    return float(np.median(sizes))
